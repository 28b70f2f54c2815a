# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The error of the told depth of the array as a state that all reflectors share."""

from helpers.fathometer_runs import run
from helpers.sea_scenes import score_scene, sea_scene
import numpy as np
import pytest

from sonar_imm.measurements import Rejection, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.response import lattice_of_trace
from sonar_imm.trackers.fathometer.tracker import FathometerTracker


def scene_with(scene, heave, seed):
    """Traces whose errors are new in each record or last, and the errors."""
    if heave == 'memory':
        return lasting(scene, seed)
    return list(scene.traces(range(40))), scene.file['array_depth_error'][:40]


def heaves_of(estimates):
    """Heave and its standard deviation (T, 2)."""
    return np.array([[each.extras[k][0] for k in ('heave', 'heave_std')] for each in estimates])


@pytest.fixture(scope='module')
def scene():
    return sea_scene('heave')


def errors(found, scene, after):
    """Common error (T,) of the depths of each record, the errors relative to it, and how wrong the
    heave is, with its stated standard deviation (T,)."""
    common, relative, heave, stated = [], [], [], []
    for stamp, estimate in found.items():
        if stamp <= after * 10**9 or len(estimate) != len(scene.amplitude):
            continue
        error = estimate.state[:, 0] - scene.depth_at(stamp)
        common.append(error.mean())
        relative.append(error - error.mean())
        given = scene.file['array_depth_error'][stamp // 10**9 - 1]
        heave.append(estimate.extras['heave'][0] - given)
        stated.append(estimate.extras['heave_std'][0])
        assert np.ptp(estimate.extras['heave']) == 0.0
    return np.array(common), np.concatenate(relative), np.array(heave), np.array(stated)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def test_layers_are_followed_although_the_array_heaves(scene):
    _, found = run(
        scene.traces(), particles=3000, heave='independent', array_depth_std=0.5,
        sound_speed_std=0.0,
    )  # fmt: skip
    score = score_scene(found, scene, after=20)
    common, relative, heave, stated = errors(found, scene, after=20)
    assert score.right >= 0.95 and score.ospa <= 0.18
    assert rms(common) <= 0.20 and rms(relative) <= 0.02
    # What the heave is not, the depths are.
    assert heave == pytest.approx(-common, abs=0.03)
    assert (np.abs(heave) < 3.0 * stated).all() and stated.mean() < 0.25
    last = found[60 * 10**9]
    assert last.covariance[:, 0, 0] == pytest.approx(stated[-1] ** 2, rel=0.25)
    expected = 2.0 * (last.state[:, 0] - scene.array_depth) / 1500.0
    assert last.extras['two_way_time'] == pytest.approx(expected, abs=1e-12)


def lasting(scene, seed, records=40):
    """The same layers, the errors of an autoregression in place of the independent ones; and these
    errors."""
    rng = np.random.default_rng(seed)
    wrong = 0.5 * rng.standard_normal(records)
    for k in range(1, records):
        wrong[k] = 0.9 * wrong[k - 1] + np.sqrt(1.0 - 0.81) * wrong[k]
    traces = [
        Trace(
            stamp_ns=each.stamp_ns,
            depth=each.depth - scene.file['array_depth_error'][k] + wrong[k],
            amplitude=each.amplitude,
            sigma=each.sigma,
            reference_depth=scene.array_depth,
        )
        for k, each in enumerate(scene.traces(range(records)))
    ]
    return traces, wrong


WINDOW = {'depth_min': 42.5, 'depth_max': 69.0, 'depth_step': 1 / 64}


def kalman(seen, layers, depth_std, std, memory):
    """Mean and sd (T, 2) of the shift whose sum with the mean depth is `seen` (T,)."""
    mean, P, found = np.array([seen[0], 0.0]), np.diag([1e6, std**2]), []
    F, Q = np.diag([1.0, memory]), np.diag([depth_std**2 / layers, std**2 * (1.0 - memory**2)])
    for k, y in enumerate(seen):
        if k:
            mean, P = F @ mean, F @ P @ F.T + Q
        gain = P.sum(axis=1) / P.sum()
        mean, P = mean + gain * (y - mean.sum()), P - np.outer(gain, P.sum(axis=0))
        found.append((mean[1], np.sqrt(P[1, 1])))
    return np.array(found)


@pytest.mark.statistics
@pytest.mark.parametrize('heave', ['independent', 'memory'])
@pytest.mark.parametrize(('seed', 'depth_std'), [(1, 0.1), (2, 0.3)])
def test_the_heave_is_known_as_a_kalman_filter_knows_it(scene, heave, seed, depth_std):
    """Two Gaussian numbers, heave and depth, which no record tells apart."""
    traces, wrong = scene_with(scene, heave, seed)
    options = {'heave': heave, 'array_depth_std': 0.5, 'depth_std': depth_std, **WINDOW}
    _, found = run(traces, particles=3000, seed=seed, **options)
    seen = [scene.depth_at(each.stamp_ns).mean() + w for each, w in zip(traces, wrong)]
    memory = 0.9 if heave == 'memory' else 0.0
    expected = kalman(seen, len(scene.amplitude), depth_std, 0.5, memory)
    heaves = heaves_of(found.values())
    assert heaves[:, 1] == pytest.approx(expected[:, 1], rel=0.08)
    away = (heaves[:, 0] - expected[:, 0]) / expected[:, 1]
    assert rms(away) < 0.1 and np.abs(away).max() < 0.2


def known_later(seen, layers, depth_std, std, memory, lag):
    """As `kalman`, by what is `seen` up to `lag` records later: all of it is jointly Gaussian."""
    records = np.arange(len(seen))
    walk = 1e4 + depth_std**2 / layers * np.minimum.outer(records, records)
    shift = std**2 * np.where(np.eye(len(seen)) > 0, 1.0, 0.0)
    if memory:
        shift = std**2 * memory ** np.abs(np.subtract.outer(records, records))
    found, off = [], np.array(seen) - seen[0]
    for k in range(len(seen) - lag):
        upto = slice(0, k + lag + 1)
        gain = np.linalg.solve((walk + shift)[upto, upto], shift[upto, k])
        found.append((gain @ off[upto], np.sqrt(std**2 - gain @ shift[upto, k])))
    return np.array(found)


@pytest.mark.parametrize(('heave', 'lag'), [('independent', 5), ('memory', 2)])
def test_the_heave_of_revised_records_is_known_as_what_came_later_tells(scene, heave, lag):
    """The offset is known as the newest record knows it, not as the revised one did."""
    traces, wrong = scene_with(scene, heave, 1)
    options = {'heave': heave, 'array_depth_std': 0.5, 'smoothing_lag': lag, **WINDOW}
    _, found = run(traces, particles=3000, seed=1, **options)
    seen = [scene.depth_at(each.stamp_ns).mean() + w for each, w in zip(traces, wrong)]
    known = seen, len(scene.amplitude), 0.1, 0.5, 0.9 if heave == 'memory' else 0.0
    expected = known_later(*known, lag)
    # Without a lag it is the filter of above.
    assert known_later(*known, 0) == pytest.approx(kalman(*known), abs=2e-3)
    heaves = heaves_of(list(found.values())[: len(expected)])
    assert heaves[:, 1] == pytest.approx(expected[:, 1], rel=0.08)
    away = (heaves[:, 0] - expected[:, 0]) / expected[:, 1]
    assert rms(away) < 0.1 and np.abs(away).max() < 0.25


def test_an_error_that_lasts_is_followed_with_a_memory(scene):
    traces, _ = lasting(scene, 2)
    _, found = run(traces, particles=3000, heave='memory', array_depth_std=0.5, **WINDOW)
    assert score_scene(found, scene, after=15).right >= 0.95
    _, relative, _, _ = errors(found, scene, after=15)
    assert rms(relative) <= 0.03


def test_what_heave_needs():
    with pytest.raises(ConfigError, match='array_depth_std'):
        FathometerConfig(heave='memory', array_depth_std=0.0)
    config = FathometerConfig(heave='independent', array_depth_std=1000.0, depth_std=0.01)
    depth = np.arange(100.0, 120.0, 0.01)
    trace = Trace(stamp_ns=1, depth=depth, amplitude=np.sin(depth))
    with pytest.raises(Rejection, match='steps'):
        lattice_of_trace(trace, config)


def test_a_new_spread_of_the_heave_begins_anew(scene):
    options = {'particles': 200, 'heave': 'independent'}
    tracker = FathometerTracker(FathometerConfig(**options, array_depth_std=0.5))
    traces = list(scene.traces(range(3)))
    tracker.process(traces[0])
    tracker.reconfigure(FathometerConfig(**options, array_depth_std=0.1))
    (estimate,) = tracker.process(traces[1])
    assert len(tracker.response.depth) < len(traces[1]) + 2 * 40
    assert np.isfinite(estimate.extras['heave_std']).all()
