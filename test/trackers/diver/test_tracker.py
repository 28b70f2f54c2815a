# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The tracker as a whole; names of fixes and tags, sensors with numbers of their own, and tracks
that are begun by a start."""

import itertools

from attrs import evolve
from helpers.diver_runs import arrivals, errors, fix, followed, miss, run, scan, SECOND
import numpy as np
import pytest

from sonar_imm.estimation.consistency import average_bounds
from sonar_imm.measurements import Fix, NOBODY, Start
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import ADAPTATIONS, MODEL_SETS
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.known import predict_over, track_outputs
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.names import scans_to_merge
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate


def measurements_of(name, seed, **changes):
    return [item.measurement for item in simulate(scenario(name, changes), seed).measurements]


@pytest.mark.parametrize('model_set, adaptation', [
    ('linear', 'fixed'), *((each, kind) for each in MODEL_SETS for kind in ADAPTATIONS),
])  # fmt: skip
def test_every_set_follows_a_diver_better_than_its_fixes(model_set, adaptation):
    scene = simulate(scenario('zigzag'), seed=3)
    fixes = [item.measurement for item in scene.measurements]
    known = {'adaptation': adaptation, 'max_tracks': 1, 'gate_probability': 0.999999}
    tracker = SYSTEMS['diver'].build(DiverConfig(model_set=model_set, **known))
    estimates = run(tracker, fixes)
    off = errors(estimates, scene.truth[0])[:, 0]
    raw = np.array([item.position[:2] for item in fixes]) - scene.truth[0].position[:, :2]
    assert len(off) >= 95  # confirmed by the third fix or so, never lost
    ours, theirs = (np.sqrt(np.mean(each**2)) for each in (off, np.hypot(*raw.T)))
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
    rng = np.random.default_rng(4)
    config = DiverConfig(
        model_set='heading_speed', adaptation='fixed', max_tracks=1, confirm_hits=1, hover=False,
        gate_probability=0.9999999,
    )  # fmt: skip
    models, squared = build_models(config), []
    for _ in range(100):
        tracker, mode = DiverTracker(config), rng.integers(16)
        state = np.array([0.0, 0.0, max(rng.normal(0.75, 0.4), 0.05)])
        for k in range(40):
            if k:
                mode = rng.choice(16, p=models.chain.matrix[mode])
                motion = models.motion(1.0)
                state = rng.multivariate_normal(motion.F[mode] @ state, motion.Q[mode])
            z = state[:2] + 0.5 * rng.normal(size=2)
            (estimate,) = tracker.process(fix(k + 1, *z, 0.25 * np.eye(2)))
        squared.append(miss(estimate, state[:2])[1])
    low, high = average_bounds(100, 2, 0.999)
    assert low < np.mean(squared) < high


def test_a_scan_that_misses_a_diver_teaches_nothing_of_its_turns():
    """Probabilities move by prediction alone then: learnt from, they would confirm the prior."""
    tracker = DiverTracker(DiverConfig())
    run(tracker, [fix(second, 0.75 * second, 0.2 * second) for second in range(1, 8)])
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
    rng, fixes = np.random.default_rng(12), []
    for second in range(1, 40):
        for place in (-40.0, 0.0, 40.0):
            if place != 40.0 or second % 3:
                z = [0.3 * second, place] + 0.1 * rng.normal(size=2)
                fixes.append(fix(second, *z, 0.04 * np.eye(2)))

    def confirmed(max_tracks):
        made = run(DiverTracker(DiverConfig(max_tracks=max_tracks, delete_misses=8)), fixes)
        sure = [each.state[each.extras['track_state'] > 0, 1] for each in made]
        return [np.sort(np.round(each, -1)).tolist() for each in sure]

    assert confirmed(3)[-1] == [-40.0, 0.0, 40.0]
    limited = confirmed(2)
    assert max(map(len, limited)) == 2
    assert limited[-1] == [-40.0, 0.0]


def test_false_detections_do_not_pile_up_tracks():
    """Room for tentative tracks is ten, and five for each diver there can be."""
    tracker = DiverTracker(DiverConfig(max_tracks=2, delete_misses=100, confirm_window=50))
    fixes = [fix(s, 100.0 * k, 1000.0 * s) for s in range(1, 5) for k in range(40)]
    *_, last = run(tracker, fixes)
    assert len(tracker._stream.state) == 20 >= len(last)


def test_polled_divers_are_not_missed_when_another_one_answers():
    tracker = DiverTracker(DiverConfig(scan_period=-1.0, confirm_hits=2))
    made = followed(tracker, [fix(k, 60.0 * (k % 8) + 0.05 * k, 0.0) for k in range(1, 80)])
    ids, last = [sorted(each.extras['track_id'].tolist()) for each in made], made[-1]
    # At first, one target with far larger errors explains what eight do: numbers need not begin
    # at 1, but stay.
    assert len(ids[-1]) == 8 and ids[30:] == [ids[-1]] * len(ids[30:])
    there = 60.0 * np.arange(8) + 0.05 * (72 + np.arange(8))
    assert np.sort(last.state[:, 0]) == pytest.approx(there, abs=0.5)
    assert (last.extras['track_state'] == 1).all()


def test_a_long_gap_is_no_straight_line():
    """The spread over half a minute is that of divers who turn as the chain says."""
    rng = np.random.default_rng(11)
    straight = {'model_set': 'heading_speed', 'adaptation': 'fixed', 'hover': False}
    config = DiverConfig(**straight, speed_noise=0.0, lateral_noise=0.0)
    tracker = DiverTracker(config)
    tracker.process(fix(1, 0.0, 0.0, 1e-6 * np.eye(2)))
    before, models = tracker._stream.state, tracker.models
    mode, place = rng.integers(16, size=4000), np.zeros((4000, 2))
    speed = rng.normal(config.speed_mean, config.speed_std, size=4000)
    for _ in range(30):
        steps = np.cumsum(models.chain.matrix[mode], axis=1)
        mode = (rng.uniform(size=(4000, 1)) > steps).sum(axis=1)
        place += speed[:, None] * models.E[mode, 2:, 2]
    walked = np.mean(np.sum(place**2, axis=1))

    def spread(longest):
        rows = models, tracker._chain, before.rows, before['learnt']
        *_, last = predict_over(*rows, 30.0, longest)
        _, covariance = track_outputs(last.rows, tuple(part.outputs for part in models.parts))
        return np.trace(covariance[0, :2, :2])

    assert spread(1.0) == pytest.approx(walked, rel=0.1)
    assert spread(config.longest_step) == pytest.approx(walked, rel=0.2)
    assert spread(60.0) > 1.3 * walked


OFF = {'receiver_position_std': 1.0, 'receiver_clock_std': 5e-4, 'sound_speed_std': 5.0}
NAMED = {'model_set': 'heading_speed'}


def runs_of(name, scene, config, seeds, smooth=False):
    """For each seed the true path with the final estimates, and with those by looking back."""
    for seed in seeds:
        made = simulate(scenario(name, {'duration': 60.0, **scene}), seed)
        tracker = SmoothingDiverTracker(DiverConfig(max_tracks=1, **config))
        estimates = run(tracker, [item.measurement for item in made.measurements])
        back = tracker.smoothed() if smooth else []
        yield (made.truth[0], estimates), (made.truth[0], back)


def scores(runs):
    """Horizontal RMSE and NEES from 10 s on."""
    found = np.concatenate([errors(estimates, track, 10) for track, estimates in runs])
    return np.sqrt(np.mean(found[:, 0] ** 2)), np.mean(found[:, 1])


def test_a_depth_report_fixes_the_depth():
    runs, _ = zip(*runs_of('at_depth', {'depth_std': 0.2}, {'dimensions': 3}, range(4)))
    last = runs[-1][1][-1]
    assert scores(runs)[1] < 2.6 and last.covariance[0, 2, 2] < 0.04
    assert last.state_names == ('px', 'py', 'pz', 'vx', 'vy', 'vz')
    assert last.model_names[0] == 'steady_heading_000'
    np.testing.assert_allclose(last.probabilities.sum(axis=1), 1.0)
    assert last.xyz[0, 2] == last.state[0, 2]


def test_what_is_considered_is_the_same_in_all_models_and_times():
    config = DiverConfig(max_tracks=1, **OFF, systematic_errors='consider')
    tracker = DiverTracker(config)
    run(tracker, measurements_of('misplaced_receivers', 1, duration=30.0))
    known = tracker._stream.state
    x, P = tracker.models.to_common(known.rows.blocks)
    layout = known.memory['instruments'].layout(config, tracker.models)
    assert layout.size == 4 + 1 + 3 * 2 + 4  # the receiver at the transmitter has no offset
    considered = slice(tracker.models.n, layout.size)
    assert (x[..., considered] == 0.0).all()
    inside = P[..., considered, considered]
    due = np.broadcast_to(np.diag(layout.variances), inside.shape)
    np.testing.assert_allclose(inside, due, rtol=1e-9, atol=1e-12)
    assert np.abs(P[..., :2, considered]).max() > 0.1


def test_receivers_that_come_later_bring_their_prior():
    config = DiverConfig(max_tracks=1, receiver_clock_std=1e-3)
    ping = measurements_of('multistatic', 1, duration=5.0, detection_probability=1.0)[0]
    first = Instruments().with_receivers(evolve(ping, rx_id=[7, 7, 3, 3]), config)
    both = first.with_receivers(ping, config)
    for known, ids in ((first, [3, 7]), (both, [3, 7, 0, 1, 2])):
        assert [receiver for receiver, _ in known.known] == ids
    layout = both.layout(config, build_models(config))
    x, P = layout.with_new_constants(np.ones((2, 6)), np.ones((2, 6, 6)))
    assert x.shape == (2, 9) and (P[:, :6, 6:] == 0.0).all()
    np.testing.assert_allclose(P[0, 6:, 6:], 1.5**2 * np.eye(3))


@pytest.mark.statistics
@pytest.mark.parametrize('name, stated', [
    ('at_depth', {'dimensions': 3}), ('misplaced_receivers', OFF),
    ('misplaced_receivers', {**OFF, **NAMED, 'systematic_errors': 'consider'}),
    ('misplaced_receivers', {**OFF, **NAMED, 'systematic_errors': 'estimate'}),
    ('misplaced_receivers', {**OFF, 'dimensions': 3, 'fix_bias_std': 1.0}),
    ('lasting_errors', {'fix_bias_std': 1.0}),
])  # fmt: skip
def test_what_is_stated_is_in_the_covariance_and_looking_back_is_better(name, stated):
    scene = {'duration': 200.0} if name == 'lasting_errors' else {}
    runs, smoothed = zip(*runs_of(name, scene, stated, range(4), smooth=True))
    plain = NAMED if name == 'misplaced_receivers' else {}
    ignored, _ = zip(*runs_of(name, scene, plain, range(4)))
    (rmse, nees), (back_rmse, back_nees) = scores(runs), scores(smoothed)
    ignored_rmse, ignored_nees = scores(ignored)
    assert ignored_nees > (5.0 if name == 'at_depth' else 8.0)
    assert nees < 2.6 and rmse < (1.05 if name == 'lasting_errors' else 1.0) * ignored_rmse
    assert name != 'at_depth' or rmse < 0.4
    assert back_rmse < rmse and back_nees < 2.6


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
    optimistic = run_fixes(0.01, 0.8, 0.0, model_set='heading_speed')
    assert 'fix innovations are too large' in optimistic.warnings()[0]
    assert optimistic.health()['fixes_mean_nis'] > 1.7
    for lasting_or_pessimistic in ((4.0, 0.05, 2.0), (4.0, 0.5, 0.0)):
        assert 'too small or correlated' in run_fixes(*lasting_or_pessimistic).warnings()[0]
    assert run_fixes(0.25, 0.5, 1.0, fix_bias_std=1.0).warnings() == []


def test_arrivals_that_miss_name_what_was_not_stated():
    pings = measurements_of('at_depth', 0, duration=75.0)
    for config in ({}, {'sound_speed_std': 1.0}):
        tracker = DiverTracker(DiverConfig(max_tracks=1, model_set='heading_speed', **config))
        run(tracker, pings)
        more, lasting = tracker.warnings()
        assert 'dimensions: 3' in more and 'receiver_position_std' in more
        assert ('sound_speed_std' in more) == (not config)
        assert 'target_z (or dimensions: 3). Set' in lasting


@pytest.mark.statistics
@pytest.mark.parametrize('name, seeds, stated', [
    ('at_depth', (1, 14, 19), {'dimensions': 3}), ('misplaced_receivers', (0, 11, 15), OFF),
    ('multistatic', (), {}),
])  # fmt: skip
def test_arrivals_that_miss_are_known_within_a_minute(name, seeds, stated):
    def warned(seed, config):
        tracker = DiverTracker(DiverConfig(**config))
        pings = measurements_of(name, seed, duration=60.0)
        return any(tracker.process(ping) and tracker.warnings() for ping in pings)

    assert all(warned(seed, {}) for seed in seeds)
    assert not any(warned(seed, stated) for seed in range(3))


def test_sharp_turns_are_not_taken_for_errors_of_the_fixes():
    """A diver who turns by up to 170 degrees: innovations of nine sigmas, true covariances."""
    tracker, farthest = DiverTracker(DiverConfig(max_tracks=1)), 0.0
    for seed in (1006, 1014):
        tracker.reset()
        for item in measurements_of('table1', seed):
            tracker.process(item)
            assert tracker.warnings() == []
            farthest = max(farthest, float(np.sum(tracker._stream.state['white'][:1, 0] ** 2)))
    assert farthest > 50.0


def test_without_anything_stated_no_state_is_added():
    tracker = DiverTracker(DiverConfig())
    tracker.process(measurements_of('multistatic', 1)[0])
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


BOTH = ('gnn', 'jipda')


def named(second, place, name):
    return evolve(fix(second, *place), target_id=name)


def clutter(association):
    return DiverTracker(DiverConfig(association=association, clutter_density=1e-4))


def test_scans_needed_before_two_tracks_are_one_follow_from_p_d():
    for p_detection in (0.5, 0.7, 0.9):
        scans = scans_to_merge(p_detection)
        apart = (1.0 - p_detection**2) ** np.array([scans, scans - 1])
        assert apart[0] <= 1e-3 < apart[1]


@pytest.mark.parametrize('association', BOTH)
def test_a_diver_heard_by_name_and_seen_without_is_one_track(association):
    tracker, rng = clutter(association), np.random.default_rng(3)
    for second in range(1, 60):
        place = np.array([0.5 * second, 0.0])
        (estimate,) = tracker.process(scan(second, place + 0.5 * rng.normal(size=2)))
        if second == 19:
            (first,) = estimate.extras['track_id'].tolist()
        if second >= 20 and second % 4 == 0:
            tracker.process(named(second + 0.4, place + 0.2, 5))
    assert estimate.extras['target_id'].tolist() == [5]
    assert estimate.extras['track_id'].tolist() == [first]
    assert estimate.covariance[0, 0, 0] < 0.25  # the scans count, not the transponder alone


@pytest.mark.parametrize('association', BOTH)
def test_two_divers_that_swim_together_stay_two(association):
    tracker, rng = clutter(association), np.random.default_rng(4)
    for second in range(1, 80):
        place = np.array([0.5 * second, 0.0])
        both = [place + 0.4 * rng.normal(size=2), place + [0.0, 3.0] + 0.4 * rng.normal(size=2)]
        (estimate,) = tracker.process(scan(second, *(it for it in both if rng.uniform() < 0.9)))
        if second >= 10 and second % 4 == 0:
            tracker.process(named(second + 0.4, place + 0.5 * rng.normal(size=2), 5))
    confirmed = estimate.extras['track_state'] > 0
    assert sorted(estimate.extras['target_id'][confirmed].tolist()) == [NOBODY, 5]


@pytest.mark.parametrize('association', BOTH)
def test_a_name_that_is_said_no_more_is_forgotten_and_the_track_goes_on(association):
    tracker = DiverTracker(DiverConfig(association=association, max_coast=20.0))
    for second in range(1, 60):
        if second < 10:
            tracker.process(named(second - 0.5, (0.3 * second, 0.0), 5))
        (estimate,) = tracker.process(scan(second, (0.3 * second, 0.1 * (second % 2))))
        if second == 25:
            assert 5 in estimate.extras['target_id'].tolist()
    assert estimate.extras['target_id'].tolist() == [NOBODY]
    assert estimate.extras['track_id'].tolist() == [1]


def test_names_without_a_track_are_not_kept():
    """A source that makes up names must not fill the memory."""
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    for second in range(1, 30):
        ids = [1, *range(1000 * second, 1000 * second + 50)]
        places = [(float(k), 0.0) for k in range(len(ids))]
        tracker.process(scan(second, *places, target_id=ids))
    assert len(tracker._stream.state.memory['last_named']) < 100


def ping(second, places, rng):
    """A message with a tag's arrivals for each number in `places`."""
    leg = np.linalg.norm(RECEIVERS - [[[*place, 0.0]] for place in places.values()], axis=2)
    toa = (leg - leg.min(axis=1)[:, None]) / 1500.0 + 0.01 + 1e-4 * rng.normal(size=leg.shape)
    n = len(places)
    known = {'tx_id': np.repeat(list(places), 4), 'rx_id': np.tile(np.arange(4), n)}
    return arrivals(round(second * SECOND), np.tile(RECEIVERS, (n, 1)), toa.ravel(), **known)


@pytest.mark.parametrize('together', [True, False])
def test_the_number_of_a_tag_leads_its_pings_to_their_own_track(together):
    tracker, rng = DiverTracker(DiverConfig()), np.random.default_rng(1)
    for k in range(1, 41):
        places = {4: (-20.0 + k, 30.0), 9: (20.0 - k, 30.5)}
        one = {name: places[name] for name in ((4, 9)[k % 2],)}
        (estimate,) = tracker.process(ping(k, places if together else one, rng))
    by_name = dict(zip(estimate.extras['target_id'].tolist(), estimate.state[:, 0]))
    assert by_name == pytest.approx({4: 20.0, 9: -20.0}, abs=1.5)
    assert tracker._stream.state.life.next_id == 3  # none was lost and found again
    nobody = DiverTracker(DiverConfig())
    *_, estimate = run(nobody, [ping(k, {0: (5.0 + k, 30.0)}, rng) for k in range(1, 10)])
    assert estimate.extras['target_id'].tolist() == [NOBODY]


def test_sensors_have_numbers_of_their_own():
    stated = {
        'sensors': ['radar', 'lidar'], 'radar.fix_std': 4, 'lidar.fix_std': 0.5,
        'radar.detection_probability': 0.5, 'radar.clutter_density': 1e-3,
    }  # fmt: skip
    config = DiverConfig.from_mapping(stated)
    assert stated.items() <= config.as_dict().items()
    assert DiverConfig.from_mapping(config.as_dict()) == config
    radar = config.of_sensor('radar')
    assert (radar.fix_std, radar.detection_probability, radar.clutter_density) == (4.0, 0.5, 1e-3)
    assert config.of_sensor('lidar').detection_probability == config.detection_probability
    assert config.of_sensor('') is config
    spread = []
    for sensor in ('lidar', '', 'radar'):
        plain = {'sensor': sensor, 'frame_id': 'm'}
        fixes = [Fix(stamp_ns=k * SECOND, position=(0.1 * k, 0, 0), **plain) for k in range(1, 10)]
        spread.append(run(DiverTracker(config), fixes)[-1].covariance[0, 0, 0])
    assert spread[0] < spread[1] < spread[2]


def test_the_detection_probability_of_a_sensor_decides_how_soon_existence_fades():
    stated = {'weak.detection_probability': 0.2, 'strong.detection_probability': 0.95}
    config = DiverConfig.from_mapping({'sensors': ['weak', 'strong'], **stated})
    existence = []
    for sensor in config.sensors:
        scans = [scan(k, (0.1 * k, 0.0), sensor=sensor) for k in range(1, 10)]
        *_, last = run(DiverTracker(config), [*scans, scan(10, sensor=sensor)])
        existence.append(last.extras['existence'].max(initial=0.0))
    weak, strong = existence
    assert weak > 0.9 and strong < weak


def test_what_a_sensor_has_of_its_own_changes_as_what_all_have():
    """`fix_std` may change while a tracker runs, `coverage_file` may not."""
    config = {'sensors': ['a'], 'a.fix_std': 4.0}
    tracker = DiverTracker(DiverConfig.from_mapping(config))
    tracker.reconfigure(DiverConfig.from_mapping({**config, 'a.fix_std': 2.0}))
    assert tracker.config.of_sensor('a').fix_std == 2.0
    with pytest.raises(ValueError, match='coverage_file'):
        tracker.reconfigure(DiverConfig.from_mapping({**config, 'a.coverage_file': 'x.csv'}))


def start(second, x, y=0.0, sigma=1.0):
    place = {'position': [x, y, 0.0], 'covariance': np.eye(2) * sigma**2, 'frame_id': 'map'}
    return Start(stamp_ns=round(second * SECOND), **place)


def walk(x=0.0, **more):
    return [named_fix(k, x, **more) for k in range(1, 8)]


def named_fix(second, x, y=0.0, name=NOBODY):
    return evolve(fix(second, x, y, 0.04 * np.eye(2)), target_id=name)


def after(measurements, **options):
    tracker = DiverTracker(DiverConfig(**options))
    return tracker, run(tracker, measurements)[-1]


@pytest.mark.parametrize('options', [
    {}, {'association': 'gnn'}, {'dimensions': 3}, {'max_tracks': 1},
])  # fmt: skip
def test_a_track_begins_confirmed_at_the_place_and_follows_the_fixes_after_it(options):
    tracker, first = after([start(1, 5.0, 7.0, sigma=2.0)], **options)
    assert first.extras['track_state'].tolist() == [1]
    assert first.xyz[0, :2] == pytest.approx([5.0, 7.0])
    assert first.covariance[0, :2, :2] == pytest.approx(np.eye(2) * 4.0)
    *_, last = run(tracker, [named_fix(k, 5.0 + 0.5 * k, 7.0) for k in range(2, 12)])
    assert last.extras['track_id'].tolist() == [1]  # the start's own: no fix began another
    assert last.xyz[0, :2] == pytest.approx([10.5, 7.0], abs=0.5)


@pytest.mark.parametrize('measurements, options, due', [
    # The track that is there gives way, and others stay; one that has a name keeps its place.
    ([*walk(), *walk(50.0), start(7.5, 0.3)], {}, {2: (50.0, 1), 3: (0.3, 1)}),
    ([*walk(name=4), start(7.5, 0.1)], {}, {1: (0.0, 1), 2: (0.1, 1)}),
    # With one diver the start is where it is, however far.
    ([*walk(), start(7.5, 300.0)], {'max_tracks': 1}, {2: (300.0, 1)}),
    ([*walk(), start(7.5, 300.0)], {}, {1: (0.0, 1), 2: (300.0, 1)}),
    ([named_fix(1, 5.0)], {}, {1: (5.0, 0)}),  # without a start the track is tentative
])  # fmt: skip
def test_what_becomes_of_tracks_beside_a_start(measurements, options, due):
    _, last = after(sorted(measurements, key=lambda item: item.stamp_ns), **options)
    states = zip(last.xyz[:, 0], last.extras['track_state'])
    found = dict(zip(last.extras['track_id'].tolist(), states))
    assert found.keys() == due.keys()
    for number, (x, state) in due.items():
        assert found[number] == (pytest.approx(x, abs=0.1), state)


def test_too_many_are_counted_and_said():
    tracker, last = after([start(1 + 0.1 * k, 100.0 * k) for k in range(5)], max_tracks=3)
    assert last.extras['track_id'].tolist() == [1, 2, 3]
    assert tracker.health()['not_started'] == 2
    said = '2 starts ignored: max_tracks (3) tracks are confirmed. Increase max_tracks'
    assert tracker.warnings() == [said]


def test_names_without_end_are_counted_and_said():
    """Each fix has a name of its own: a driver that numbers its fixes, not its targets."""
    fixes = [named_fix(1 + 0.01 * k, 100.0 * k, name=k + 1) for k in range(30)]
    tracker, last = after(fixes, max_tracks=3)
    assert len(last) == 25
    assert tracker.health()['names_without_track'] == 5
    (sentence,) = tracker.warnings()
    assert sentence.startswith('5 positions with a name of their own started no track')


def test_the_order_of_arrival_changes_nothing():
    fixes = [named_fix(*at) for at in ((1, 0.0), (2, 0.2), (3, 0.4), (3, 30.1))]
    items = [*fixes, start(2, 30.0), start(2.5, 0.5)]
    _, expected = after(sorted(items, key=lambda item: item.stamp_ns))
    for order in itertools.islice(itertools.permutations(items), 0, 720, 79):
        _, last = after(order)
        if last.stamp_ns == 3 * SECOND:
            assert (last.state == expected.state).all()
            assert last.extras['track_id'].tolist() == expected.extras['track_id'].tolist()


def test_a_start_may_stand_in_a_smoothed_run():
    smoother = SmoothingDiverTracker(DiverConfig())
    run(smoother, [start(1, 0.0), *(named_fix(k, 0.5 * k) for k in range(2, 9)), start(9, 60.0)])
    made = list(smoother.smoothed())
    assert [len(item) for item in made] == [1] * 8 + [2]
    assert all(np.isfinite(item.state).all() for item in made)
