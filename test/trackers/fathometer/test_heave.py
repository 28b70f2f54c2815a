# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
        told = scene.file['array_depth_error'][stamp // 10**9 - 1]
        heave.append(estimate.extras['heave'][0] - told)
        stated.append(estimate.extras['heave_std'][0])
        assert np.ptp(estimate.extras['heave']) == 0.0
    return np.array(common), np.concatenate(relative), np.array(heave), np.array(stated)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def test_layers_are_followed_although_the_array_heaves(scene):
    _, found = run(scene.traces(), particles=3000, heave='independent', array_depth_std=0.5)
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


def test_without_the_state_they_are_lost(scene):
    _, found = run(scene.traces(range(40)), particles=2000)
    assert score_scene(found, scene, after=20).right < 0.5
    assert all((one.extras['heave'] == 0.0).all() for one in found.values())
    assert all((one.extras['heave_std'] == 0.0).all() for one in found.values())


def test_without_a_spread_at_the_start_the_first_error_stays(scene, monkeypatch):
    """The depths of the layers are then what the first record, told half a metre wrong, says."""
    from sonar_imm.estimation import set_filter

    whole = set_filter.shift_tables

    def sure(shift, log_sum, share):
        tables = whole(shift, log_sum, share)
        return tables._replace(start=np.where(shift.places < 0.0, 0.0, 1.0))

    def common_error():
        options = {'heave': 'independent', 'array_depth_std': 0.5, 'depth_std': 0.05}
        _, found = run(scene.traces(range(40)), particles=1500, **options)
        return rms(errors(found, scene, after=20)[0])

    right = common_error()
    monkeypatch.setattr(set_filter, 'shift_tables', sure)
    assert common_error() > 1.5 * right


def test_an_error_that_lasts_is_followed_with_a_memory(scene):
    """The same layers, the errors of an autoregression put in place of the independent ones."""
    rng = np.random.default_rng(2)
    wrong, now = [], 0.4
    for _ in range(40):
        wrong.append(now)
        now = 0.9 * now + np.sqrt(1.0 - 0.81) * 0.5 * rng.standard_normal()
    traces = [
        Trace(
            stamp_ns=one.stamp_ns,
            depth=one.depth - scene.file['array_depth_error'][k] + wrong[k],
            amplitude=one.amplitude,
            sigma=one.sigma,
            reference_depth=scene.array_depth,
        )
        for k, one in enumerate(scene.traces(range(40)))
    ]
    options = {'particles': 3000, 'depth_min': 42.5, 'depth_max': 69.0, 'depth_step': 1 / 64}
    _, found = run(traces, heave='memory', array_depth_std=0.5, **options)
    assert score_scene(found, scene, after=15).right >= 0.95
    _, relative, _, _ = errors(found, scene, after=15)
    assert rms(relative) <= 0.03


def test_threads_do_not_change_a_byte(scene):
    def columns(**parameters):
        _, found = run(
            scene.traces(range(6)),
            particles=1001,
            heave='memory',
            array_depth_std=0.5,
            polarity='both',
            **parameters,
        )
        return [c.tobytes() for one in found.values() for c in one.columns().values()]

    assert columns() == columns(threads=4)


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
