# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver tracker as its users see it: measurements in, estimates out."""

from helpers.diver_runs import errors, fix, run, SECOND
from helpers.estimates import same
import numpy as np
import pytest

from sonar_imm.estimation.consistency import average_bounds
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import ADAPTATIONS, MODEL_SETS
from sonar_imm.trackers.diver.known import predict_over, track_outputs
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate


@pytest.mark.parametrize(
    'model_set, adaptation',
    [
        ('linear', 'fixed'),
        *((model_set, kind) for model_set in MODEL_SETS for kind in ADAPTATIONS),
    ],
)
def test_every_set_follows_a_diver_better_than_its_fixes(model_set, adaptation):
    scene = simulate(scenario('zigzag'), seed=3)
    tracker = SYSTEMS['diver'].build(
        DiverConfig(
            model_set=model_set, adaptation=adaptation, max_tracks=1, gate_probability=0.999999,
        )
    )  # fmt: skip
    estimates = run(tracker, [item.measurement for item in scene.measurements])
    error, _ = errors(estimates, scene.truth[0])
    raw = (
        np.array([item.measurement.position[:2] for item in scene.measurements])
        - scene.truth[0].position[:, :2]
    )
    assert len(error) >= 95  # confirmed by the third fix or so, never lost
    ours, theirs = (np.sqrt(np.mean(np.sum(each**2, axis=1))) for each in (error, raw))
    # A single CV model swings wide at every corner of a zigzag; it has to beat the fixes only.
    assert ours < (1.0 if model_set == 'linear' else 0.9) * theirs
    for estimate in estimates:
        assert np.isfinite(estimate.state).all()
        np.testing.assert_allclose(estimate.probabilities.sum(axis=1), 1.0)


def test_the_estimate_is_the_contract():
    tracker = DiverTracker(DiverConfig())
    estimate = tracker.process(fix(1, 2.0, 3.0))[0]
    columns = estimate.columns()
    assert list(columns)[:8] == ['x', 'y', 'z', 'px', 'py', 'vx', 'vy', 'cov_px_px']
    models = [name for name in columns if name.startswith('prob_')]
    assert [models[0], models[17], models[-1]] == [
        'prob_steady_heading_000',
        'prob_brisk_heading_000',
        'prob_quiet',
    ]
    assert list(columns)[-19:] == [
        *('track_id', 'track_state', 'nis', 'nis_dof', 'existence', 'target_id'),
        *('side_probability', 'mirror_x', 'mirror_y'),
        *('family_steady', 'family_brisk', 'family_lively', 'family_quiet'),
        *('hover', 'covariance_scale', 'burst', 'offset_x', 'offset_y', 'rows'),
    ]
    assert columns['existence'] > 0.5 and columns['target_id'].tolist() == [-1]
    assert columns['x'].dtype == np.float32 and columns['px'].dtype == np.float64
    assert columns['track_id'].dtype == np.uint32 and columns['track_state'].dtype == np.uint8
    assert estimate.stamp_ns == SECOND and estimate.frame_id == 'map'


@pytest.mark.statistics
def test_consistency_where_the_models_hold():
    """A diver drawn from the models themselves: NEES within its bounds."""
    rng = np.random.default_rng(4)
    config = DiverConfig(
        model_set='heading_speed', adaptation='fixed', max_tracks=1, confirm_hits=1, hover=False,
        gate_probability=0.9999999,
    )  # fmt: skip
    models = SYSTEMS['diver'].build(config).models
    runs, steps, squared = 100, 40, []
    for _ in range(runs):
        tracker = DiverTracker(config)
        mode = rng.integers(16)
        state = np.array([0.0, 0.0, max(rng.normal(0.75, 0.4), 0.05)])
        for k in range(steps):
            if k:
                mode = rng.choice(16, p=models.chain.matrix[mode])
                motion = models.motion(1.0)
                state = rng.multivariate_normal(motion.F[mode] @ state, motion.Q[mode])
            z = state[:2] + 0.5 * rng.normal(size=2)
            estimate = tracker.process(fix(k + 1, *z, 0.25 * np.eye(2)))[-1]
        d = estimate.state[0] - np.concatenate([state[:2], models.E[mode, 2:, 2] * state[2]])
        squared.append(d[:2] @ np.linalg.solve(estimate.covariance[0, :2, :2], d[:2]))
    low, high = average_bounds(runs, 2, 0.999)
    assert low < np.mean(squared) < high


def test_a_scan_that_misses_a_diver_teaches_nothing_of_its_turns():
    """Probabilities move by prediction alone then: learnt from, they would confirm the prior."""
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 8):
        tracker.process(fix(second, 0.75 * second, 0.2 * second))
    before = tracker._stream.state
    learnt, mu = before['learnt'][0].copy(), before.rows.model_probabilities()[0]
    tracker.process(fix(8, 500.0, 500.0))  # a false detection far away
    missed = tracker._stream.state
    assert missed.life.track_id[0] == 1 and missed['nis_dof'][0] == 0
    assert not np.array_equal(missed.rows.model_probabilities()[0], mu)
    assert np.array_equal(missed['learnt'][0], learnt)
    tracker.process(fix(9, 0.75 * 9, 0.2 * 9))
    assert not np.array_equal(tracker._stream.state['learnt'][0], learnt)


def test_no_more_divers_are_confirmed_than_there_can_be():
    """Of three divers, two that are fixed exactly and one that is often missed, the two stay."""
    rng = np.random.default_rng(12)

    def confirmed(max_tracks):
        tracker = DiverTracker(DiverConfig(max_tracks=max_tracks, delete_misses=8))
        found = []
        for second in range(1, 40):
            for place in (-40.0, 0.0, 40.0):
                if place != 40.0 or second % 3:
                    spread = 0.1 * rng.normal(size=2)
                    z = (0.3 * second + spread[0], place + spread[1])
                    last = tracker.process(fix(second, *z, 0.04 * np.eye(2)))[-1]
            sure = last.extras['track_state'] > 0
            found.append(np.sort(np.round(last.state[sure, 1], -1)).tolist())
        return found

    assert confirmed(3)[-1] == [-40.0, 0.0, 40.0]
    limited = confirmed(2)
    assert max(map(len, limited)) == 2
    assert limited[-1] == [-40.0, 0.0]


def test_false_detections_do_not_pile_up_tracks():
    """Room for tentative tracks is ten, and five for each diver there can be."""
    tracker = DiverTracker(DiverConfig(max_tracks=2, delete_misses=100, confirm_window=50))
    for second in range(1, 5):
        for k in range(40):
            last = tracker.process(fix(second, 100.0 * k, 1000.0 * second))[-1]
    assert len(tracker._stream.state) == 20 >= len(last)


def test_polled_divers_are_not_missed_when_another_one_answers():
    tracker, ids = DiverTracker(DiverConfig(scan_period=-1.0, confirm_hits=2)), []
    for second in range(1, 80):
        diver = second % 8
        last = tracker.process(fix(second, 60.0 * diver + 0.05 * second, 0.0))[-1]
        ids.append(sorted(last.extras['track_id'].tolist()))
    # At first, one target with far larger errors explains what eight do: numbers need not begin
    # at 1, but stay.
    assert len(ids[-1]) == 8 and ids[30:] == [ids[-1]] * len(ids[30:])
    there = 60.0 * np.arange(8) + 0.05 * (72 + np.arange(8))
    assert np.sort(last.state[:, 0]) == pytest.approx(there, abs=0.5)
    assert (last.extras['track_state'] == 1).all()


def test_parameters_that_may_change_do_and_others_do_not():
    tracker = DiverTracker(DiverConfig())
    tracker.process(fix(1, 0.0, 0.0))
    tracker.reconfigure(DiverConfig(gate_probability=0.99))
    assert tracker.config.gate_probability == 0.99
    assert len(tracker.process(fix(2, 0.0, 0.0))[-1]) == 1
    with pytest.raises(ValueError, match='directions'):
        tracker.reconfigure(DiverConfig(directions=8))


@pytest.mark.statistics
def test_smoothing_lowers_the_error_and_keeps_the_tracks():
    filtered, smooth = [], []
    for seed in range(3):
        scene = simulate(scenario('table1', {'duration': 60.0}), seed)
        tracker = SmoothingDiverTracker(DiverConfig(max_tracks=1))
        estimates = run(tracker, [item.measurement for item in scene.measurements])
        back = tracker.smoothed()
        assert [item.stamp_ns for item in back] == [item.stamp_ns for item in estimates]
        assert same(back[-1], estimates[-1])
        for series, found in ((estimates, filtered), (back, smooth)):
            found += np.sum(errors(series, scene.truth[0])[0] ** 2, axis=1).tolist()
    assert np.sqrt(np.mean(smooth)) < 0.75 * np.sqrt(np.mean(filtered))


def test_a_long_gap_is_no_straight_line():
    """The spread over half a minute is that of divers who turn as the chain says."""
    rng = np.random.default_rng(11)
    config = DiverConfig(
        model_set='heading_speed', hover=False, adaptation='fixed', speed_noise=0.0,
        lateral_noise=0.0,
    )  # fmt: skip
    tracker = DiverTracker(config)
    tracker.process(fix(1, 0.0, 0.0, 1e-6 * np.eye(2)))
    before, dt = tracker._stream.state, 30.0
    P = tracker.models.chain.matrix
    mode = rng.integers(16, size=4000)
    speed = rng.normal(config.speed_mean, config.speed_std, size=4000)
    place = np.zeros((4000, 2))
    for _ in range(30):
        mode = (rng.uniform(size=(4000, 1)) > np.cumsum(P[mode], axis=1)).sum(axis=1)
        place += speed[:, None] * tracker.models.E[mode, 2:, 2]
    walked = np.mean(np.sum(place**2, axis=1))

    def spread(longest):
        models = tracker.models
        rows = models, tracker._chain, before.rows, before['learnt']
        *_, last = predict_over(*rows, dt, longest)
        _, covariance = track_outputs(last.rows, tuple(part.outputs for part in models.parts))
        return np.trace(covariance[0, :2, :2])

    assert spread(1.0) == pytest.approx(walked, rel=0.1)
    assert spread(config.longest_step) == pytest.approx(walked, rel=0.2)
    assert spread(60.0) > 1.3 * walked
