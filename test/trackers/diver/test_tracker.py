# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver tracker as its users see it; at sea, what it says of itself is true."""

from attrs import evolve
from helpers.diver_runs import errors, fix, run, SECOND
import numpy as np
import pytest

from sonar_imm.estimation.consistency import average_bounds
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import ADAPTATIONS, MODEL_SETS
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.known import predict_over, track_outputs
from sonar_imm.trackers.diver.models import build_models
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
    assert [models[0], models[17]] == ['prob_steady_heading_000', 'prob_brisk_heading_000']
    assert models[-1] == 'prob_quiet'
    names = 'track_id track_state nis nis_dof existence target_id'
    names += ' side_probability mirror_x mirror_y'
    names += ' family_steady family_brisk family_lively family_quiet'
    names += ' hover covariance_scale burst offset_x offset_y rows'
    assert list(columns)[-19:] == names.split()
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


OFF = {'receiver_position_std': 1.0, 'receiver_clock_std': 5e-4, 'sound_speed_std': 5.0}


def judged(name, scene, config, seeds=range(4)):
    """Horizontal RMSE and NEES from 10 s on, and the estimates of the last run."""
    runs = [run for run, _ in runs_of(name, scene, config, seeds)]
    return *scores(runs), runs[-1][1]


def runs_of(name, scene, config, seeds, smooth=False):
    """For each seed the true path with the final estimates, and with those by looking back."""
    for seed in seeds:
        made = simulate(scenario(name, {'duration': 60.0, **scene}), seed)
        tracker, final = SmoothingDiverTracker(DiverConfig(max_tracks=1, **config)), {}
        for scan in made.measurements:
            final.update((e.stamp_ns, e) for e in tracker.process(scan.measurement))
        estimates = [final[stamp] for stamp in sorted(final)]
        back = tracker.smoothed() if smooth else []
        yield (made.truth[0], estimates), (made.truth[0], back)


def scores(runs):
    """Horizontal RMSE and NEES from 10 s on."""
    squared, nees = [], []
    for track, estimates in runs:
        at = {int(stamp): k for k, stamp in enumerate(track.stamp_ns)}
        for estimate in estimates:
            rows = np.flatnonzero(estimate.extras['track_state'] > 0)
            if len(rows) and at[estimate.stamp_ns] >= 10:
                error = estimate.state[rows[0], :2] - track.position[at[estimate.stamp_ns], :2]
                squared.append(error @ error)
                nees.append(error @ np.linalg.solve(estimate.covariance[rows[0], :2, :2], error))
    return np.sqrt(np.mean(squared)), np.mean(nees)


@pytest.mark.statistics
def test_a_diver_at_an_unknown_depth_is_found_and_its_covariance_is_true():
    misplaced = judged('at_depth', {}, {})
    rmse, nees, estimates = judged('at_depth', {}, {'dimensions': 3})
    assert misplaced[1] > 5.0 and rmse < 0.4 and nees < 2.6
    assert estimates[-1].state_names == ('px', 'py', 'pz', 'vx', 'vy', 'vz')
    assert estimates[-1].model_names[0] == 'steady_heading_000'
    np.testing.assert_allclose(estimates[-1].probabilities.sum(axis=1), 1.0)
    assert estimates[-1].xyz[0, 2] == estimates[-1].state[0, 2]


def test_a_depth_report_fixes_the_depth():
    _, nees, estimates = judged('at_depth', {'depth_std': 0.2}, {'dimensions': 3})
    assert nees < 2.6 and estimates[-1].covariance[0, 2, 2] < 0.04


def test_where_nothing_is_said_of_the_depth_it_stays_as_wide_as_the_water():
    tracker = DiverTracker(DiverConfig(max_tracks=1, dimensions=3, depth_max=30.0))
    for second in range(1, 60):
        estimate = tracker.process(fix(second, 0.5 * second, 0.0))[-1]
        assert estimate.covariance[0, 2, 2] >= 0.9 * 30.0**2 / 12.0


@pytest.mark.statistics
@pytest.mark.parametrize('errors', ['mixed', 'consider', 'estimate'])
def test_misplaced_instruments_are_in_the_covariance(errors):
    named = {'model_set': 'heading_speed'}
    ignored = judged('misplaced_receivers', {}, named)
    assert ignored[1] > 8.0
    for config in ({}, named):
        config = {**config, **OFF, 'systematic_errors': errors}
        rmse, nees, _ = judged('misplaced_receivers', {}, config)
        assert nees < 2.6 and rmse < ignored[0]


def test_what_is_considered_is_the_same_in_all_models_and_times():
    config = DiverConfig(max_tracks=1, **OFF, systematic_errors='consider')
    tracker = DiverTracker(config)
    made = simulate(scenario('misplaced_receivers', {'duration': 30.0}), 1)
    for scan in made.measurements:
        tracker.process(scan.measurement)
    known = tracker._stream.state
    x, P = tracker.models.to_common(known.rows.blocks)
    layout = known.memory['instruments'].layout(config, tracker.models)
    assert layout.size == 4 + 1 + 3 * 2 + 4  # the receiver at the transmitter has no offset
    considered = slice(tracker.models.n, layout.size)
    assert (x[..., considered] == 0.0).all()
    np.testing.assert_allclose(
        P[..., considered, considered],
        np.broadcast_to(np.diag(layout.variances), (*x.shape[:2], 11, 11)),
        rtol=1e-9,
        atol=1e-12,
    )
    assert np.abs(P[..., :2, considered]).max() > 0.1


def test_receivers_that_come_later_bring_their_prior():
    config = DiverConfig(max_tracks=1, receiver_clock_std=1e-3)
    made = simulate(scenario('multistatic', {'duration': 5.0, 'detection_probability': 1.0}), 1)
    ping = made.measurements[0].measurement
    first = Instruments().with_receivers(evolve(ping, rx_id=[7, 7, 3, 3]), config)
    assert [receiver for receiver, _ in first.known] == [3, 7]
    both = first.with_receivers(ping, config)
    assert [receiver for receiver, _ in both.known] == [3, 7, 0, 1, 2]
    x, P = both.layout(config, build_models(config)).with_new_constants(
        np.ones((2, 6)), np.ones((2, 6, 6))
    )
    assert x.shape == (2, 9) and (P[:, :6, 6:] == 0.0).all()
    np.testing.assert_allclose(P[0, 6:, 6:], 1.5**2 * np.eye(3))


@pytest.mark.statistics
def test_lasting_errors_of_fixes_are_in_the_covariance():
    scene = {'duration': 200.0}
    white = judged('lasting_errors', scene, {})
    rmse, nees, _ = judged('lasting_errors', scene, {'fix_bias_std': 1.0})
    assert white[1] > 8.0 and nees < 2.6 and rmse < 1.05 * white[0]


@pytest.mark.statistics
@pytest.mark.parametrize(
    'name, config',
    [
        ('at_depth', {'dimensions': 3}),
        ('misplaced_receivers', OFF),
        ('lasting_errors', {'fix_bias_std': 1.0}),
        ('misplaced_receivers', {**OFF, 'dimensions': 3, 'fix_bias_std': 1.0}),
    ],
)
def test_looking_back_is_better_and_as_true(name, config):
    forward, back = map(scores, zip(*runs_of(name, {}, config, range(3), smooth=True)))
    assert back[0] < forward[0] and back[1] < 2.6


def run_fixes(total, white, bias, **config):
    rng = np.random.default_rng(5)
    tracker, b = DiverTracker(DiverConfig(max_tracks=1, **config)), bias * rng.normal(size=2)
    for second in range(1, 200):
        b = 0.9835 * b + bias * np.sqrt(1.0 - 0.9835**2) * rng.normal(size=2)
        x, y = np.array([0.5 * second, 0.0]) + b + white * rng.normal(size=2)
        tracker.process(fix(second, x, y, covariance=total * np.eye(2)))
    return tracker


def test_covariances_of_fixes_that_cannot_be_true_are_named():
    assert run_fixes(0.25, 0.5, 0.0).warnings() == []
    for model_set, says in (
        ('families', 'fix covariances too small'),
        ('heading_speed', 'fix innovations are too large'),
    ):
        optimistic = run_fixes(0.01, 0.8, 0.0, model_set=model_set)
        assert says in optimistic.warnings()[0]
    assert optimistic.health()['fixes_mean_nis'] > 1.7
    lasting = run_fixes(4.0, 0.05, 2.0)
    assert 'too small or correlated' in lasting.warnings()[0]
    pessimistic = run_fixes(4.0, 0.5, 0.0)
    assert 'too small or correlated' in pessimistic.warnings()[0]
    assert run_fixes(0.25, 0.5, 1.0, fix_bias_std=1.0).warnings() == []


def test_arrivals_that_miss_name_what_was_not_stated():
    made = simulate(scenario('at_depth', {'duration': 75.0}), 0)
    for config, named in (({}, 'dimensions: 3'), ({'sound_speed_std': 1.0}, 'dimensions: 3')):
        tracker = DiverTracker(DiverConfig(max_tracks=1, model_set='heading_speed', **config))
        for scan in made.measurements:
            tracker.process(scan.measurement)
        more, lasting = tracker.warnings()
        assert named in more and 'receiver_position_std' in more
        assert ('sound_speed_std' in more) == (not config)
        assert 'target_z (or dimensions: 3). Set' in lasting


@pytest.mark.statistics
@pytest.mark.parametrize(
    'name, seeds, stated',
    [
        ('at_depth', (1, 14, 19), {'dimensions': 3}),
        ('misplaced_receivers', (0, 11, 15), OFF),
        ('multistatic', (), {}),
    ],
)
def test_arrivals_that_miss_are_known_within_a_minute(name, seeds, stated):
    def warned(seed, config):
        tracker = DiverTracker(DiverConfig(**config))
        for scan in simulate(scenario(name, {'duration': 60.0}), seed).measurements:
            tracker.process(scan.measurement)
            if tracker.warnings():
                return True
        return False

    assert all(warned(seed, {}) for seed in seeds)
    assert not any(warned(seed, stated) for seed in range(3))


def test_sharp_turns_are_not_taken_for_errors_of_the_fixes():
    """A diver who turns by up to 170 degrees: innovations of nine sigmas, true covariances."""
    tracker, farthest = DiverTracker(DiverConfig(max_tracks=1)), 0.0
    for seed in (1006, 1014):
        tracker.reset()
        for scan in simulate(scenario('table1', {}), seed).measurements:
            tracker.process(scan.measurement)
            assert tracker.warnings() == []
            farthest = max(farthest, float(np.sum(tracker._stream.state['white'][:1, 0] ** 2)))
    assert farthest > 50.0


def test_without_anything_stated_no_state_is_added():
    tracker = DiverTracker(DiverConfig())
    tracker.process(simulate(scenario('multistatic'), 1).measurements[0].measurement)
    known = tracker._stream.state
    assert [block.x.shape[1:] for block in known.rows.blocks] == [(3, 34), (4, 3)]
    assert known.memory['instruments'] == Instruments()


@pytest.mark.parametrize('options', [{'sound_speed_std': 15.0}, OFF])
def test_a_fix_before_any_ping_begins_a_track(options) -> None:
    """Instruments have their place in the state before a ping; `warm` needs it at every start."""
    tracker = DiverTracker(DiverConfig(**options))
    tracker.warm()
    (estimate,) = tracker.process(fix(1.0, 3.0, 4.0))
    np.testing.assert_allclose(estimate.state[0, :2], [3.0, 4.0])
