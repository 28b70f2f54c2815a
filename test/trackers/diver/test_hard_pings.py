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

"""Hard input: very many receivers, arrays and targets in one line, fixes far better than what is
known. Covariances stay covariances, tracks go on; time and memory: test/system/test_bounds.py."""

from attrs import evolve
import numpy as np
import pytest

from msg_adapters.arrivals import MAX_PAIRS
from sonar_imm.acoustics.localisation import localise
from sonar_imm.estimation.covariance import is_psd
from sonar_imm.measurements import Arrivals, Fix
from sonar_imm.trackers.diver.config import MODEL_SETS
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS

SECOND = 10**9


def ping(rx, toa, stamp_ns=SECOND, tx=(np.nan,) * 3, var_toa=1e-9, **more):
    n = len(rx)
    columns = {'rx_id': np.arange(n), 'bearing': np.full(n, np.nan)} | more
    return Arrivals(
        stamp_ns=stamp_ns,
        tx_id=np.zeros(n),
        rx=rx,
        tx=np.tile(tx, (n, 1)),
        toa=toa,
        var_toa=np.full(n, var_toa),
        var_bearing=np.where(np.isnan(columns['bearing']), np.nan, 1e-4),
        **columns,
    )


def receivers(n, rng):
    return np.column_stack([rng.uniform(-500.0, 500.0, (n, 2)), np.zeros(n)])


def good_tag(rng, stamp_ns):
    rx = receivers(MAX_PAIRS, rng)
    return ping(rx, np.linalg.norm(rx - [20.0, 30.0, 0.0], axis=1) / 1500.0, stamp_ns)


def test_a_tag_that_very_many_receivers_hear_is_one_diver():
    rng = np.random.default_rng(2)
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 5):
        (estimate,) = tracker.process(good_tag(rng, second * SECOND))
    assert len(estimate) == 1
    np.testing.assert_allclose(estimate.state[0, :2], (20.0, 30.0), atol=0.05)


def test_an_echo_that_very_many_receivers_hear_is_taken_whole():
    rng = np.random.default_rng(3)
    tracker = DiverTracker(DiverConfig())
    rx = receivers(300, rng)
    place = np.array([20.0, 30.0, 0.0])
    path = np.linalg.norm(rx - place, axis=1) + np.linalg.norm(place)
    for second in range(1, 5):
        item = ping(rx, path / 1500.0, second * SECOND, tx=(0.0, 0.0, 0.0))
        (estimate,) = tracker.process(item)
    assert len(estimate) == 1
    np.testing.assert_allclose(estimate.state[0, :2], place[:2], atol=0.05)


def in_line(rng):
    """A line array, and a target on its line or a hair beside it."""
    n = rng.integers(2, 8)
    angle = rng.uniform(0.0, 2.0 * np.pi) * rng.integers(2)
    line = np.array([np.cos(angle), np.sin(angle)])
    along = np.arange(n) * 10.0 if rng.integers(2) else rng.uniform(-100.0, 100.0, n)
    far = rng.choice([0.0, 1e4, 1e6])
    rx = np.column_stack([along[:, None] * line + far, np.zeros(n)])
    target = np.append(rng.uniform(-300.0, 300.0) * line + far, 0.0)
    target[:2] += rng.choice([0.0, 0.0, 1e-9, 1e-3])
    leg = np.linalg.norm(rx - target, axis=1)
    tag = bool(rng.integers(2))
    toa = (leg if tag else leg + leg[0]) / 1500.0
    toa += rng.choice([0.0, 1e-7, 1e-5]) * rng.normal(size=n)
    angles = np.arctan2(*(target[:2] - rx[:, :2]).T[::-1])
    return ping(
        rx,
        toa,
        tx=(np.nan,) * 3 if tag else rx[0],
        var_toa=10.0 ** rng.uniform(-18.0, -8.0),
        bearing=angles if rng.random() < 0.3 else np.full(n, np.nan),
    )


def test_a_target_on_the_line_of_a_line_array_breaks_nothing():
    rng = np.random.default_rng(0)
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 151):
        item = in_line(rng)
        fix = localise(
            item.rx,
            item.toa,
            item.var_toa,
            tx=item.tx,
            bearing=item.bearing,
            var_bearing=item.var_bearing,
        )
        for found in (fix, *fix.alternatives) if hasattr(fix, 'covariance') else ():
            assert (np.linalg.eigvalsh(found.covariance) > 0.0).all()
        tracker.process(evolve(item, stamp_ns=second * SECOND))
    assert tracker.health()['broken_tracks'] == 0


# -- covariances that are hardly one --------------------------------------------------------------


QUIET = {'cv': (1e-4,), 'cv_cv': (0.0, 0.1), 'cv_ct': (0.0, 0.1, 0.1)}


def sharp_fixes(seed, count=12):
    """Fixes whose covariances span sixteen decades, nanoseconds to seconds apart."""
    rng = np.random.default_rng(seed)
    stamp = 10**9
    for k in range(count):
        root = rng.normal(size=(2, 2)) * 10.0 ** rng.uniform(-8, 0, size=2)
        covariance = root @ root.T
        yield Fix(
            stamp_ns=stamp,
            position=np.array([0.5 * k + rng.normal(0.0, 0.01), 0.0, 0.0]),
            covariance=covariance + 2e-12 * np.trace(covariance) * np.eye(2),
        )
        stamp += int(10 ** rng.uniform(0.0, 9.3))


def config(model_set, seed=0):
    return DiverConfig(
        model_set=model_set,
        covariance_scale=(1e-4, 1e-2, 1.0)[seed % 3],
        adaptation='fixed',
        velocity_std=20.0,
        acceleration_noise=QUIET.get(model_set, ()),
    )


def least_eigenvalue(covariance):
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return np.linalg.eigvalsh(covariance / (scale[..., :, None] * scale[..., None, :]))[..., 0]


@pytest.mark.parametrize('model_set', MODEL_SETS)
def test_covariances_stay_positive_definite(model_set):
    """Before, a correlation had an eigenvalue of -.16 for `cv`."""
    repairs = 0
    for seed in range(6):
        tracker = DiverTracker(config(model_set, seed))
        for fix in sharp_fixes(seed):
            for estimate in tracker.process(fix):
                assert np.isfinite(estimate.state).all()
                assert (least_eigenvalue(estimate.covariance) > -1e-14).all()
                np.testing.assert_allclose(estimate.probabilities.sum(axis=1), 1.0, rtol=1e-12)
            assert is_psd(tracker._stream.state.P).all()
        health = tracker.health()
        assert health['broken_tracks'] == 0
        repairs += health['covariance_repairs']
    if model_set in ('cv_cv', 'cv_ct'):
        assert repairs > 0


def test_smoothing_keeps_them_and_counts_its_own():
    counted = []
    for seed in range(6):
        tracker = SmoothingDiverTracker(config('cv_ct', seed))
        for fix in sharp_fixes(seed):
            tracker.process(fix)
        filtered = tracker.health()['covariance_repairs']
        for estimate in tracker.smoothed():
            assert np.isfinite(estimate.state).all()
            assert (least_eigenvalue(estimate.covariance) > -1e-14).all()
        counted.append(tracker.health()['covariance_repairs'] - filtered)
    assert min(counted) >= 0


def test_ordinary_fixes_need_no_repair():
    tracker = DiverTracker(DiverConfig())
    for k in range(30):
        tracker.process(Fix(stamp_ns=(k + 1) * 10**9, position=np.array([0.4 * k, 0.0, 0.0])))
    assert tracker.health()['covariance_repairs'] == 0


OFF = {'receiver_position_std': 1.0, 'receiver_clock_std': 5e-4, 'sound_speed_std': 5.0}


def sharp_pings(seed, passive, count=12):
    """Pings whose arrival times are good to 1e-11 s and worse, nanoseconds to seconds apart."""
    rng = np.random.default_rng(seed)
    stamp, tx = 10**9, np.full(3, np.nan) if passive else np.zeros(3)
    for k in range(count):
        diver = np.array([5.0 + 0.5 * k, 30.0, -6.0])
        path = np.linalg.norm(diver - RECEIVERS, axis=1)
        path += 0.0 if passive else np.linalg.norm(diver)
        variance = 10.0 ** rng.uniform(-22, -7, size=4)
        yield Arrivals(
            stamp_ns=stamp,
            tx_id=np.zeros(4),
            rx_id=np.arange(4),
            tx=np.tile(tx, (4, 1)),
            rx=RECEIVERS,
            toa=path / 1500.0 + np.sqrt(variance) * rng.normal(size=4),
            var_toa=variance,
            bearing=np.full(4, np.nan),
            var_bearing=np.full(4, np.nan),
        )
        stamp += int(10 ** rng.uniform(0.0, 9.3))


@pytest.mark.statistics
@pytest.mark.parametrize('passive', [False, True])
@pytest.mark.parametrize(
    'parameters',
    [{}, {'dimensions': 3}, OFF, {**OFF, 'systematic_errors': 'estimate', 'dimensions': 3}],
)
def test_covariances_stay_sound_after_sharp_pings(parameters, passive):
    """Before, a correlation had an eigenvalue of -7, and tracks of misplaced receivers broke."""
    for seed in range(3):
        tracker = DiverTracker(DiverConfig(max_tracks=1, **parameters))
        for ping in sharp_pings(seed, passive):
            for estimate in tracker.process(ping):
                assert np.isfinite(estimate.state).all()
                assert (least_eigenvalue(estimate.covariance) > -1e-14).all()
            assert is_psd(tracker._stream.state.P).all()
        assert tracker.health()['broken_tracks'] == 0
