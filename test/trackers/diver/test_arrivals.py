# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The tracker on raw arrival times: echoes, tags that emit alone, instruments that are off, stamps
that are rounded."""

from attrs import evolve
from helpers.diver_runs import arrivals, errors, fix, followed, miss, numbers_of, run, SECOND
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.measurements import RelativeFix, VesselPose
from sonar_imm.trackers.diver import estimate, offsets
from sonar_imm.trackers.diver.arrival_stamps import ArrivalStamps, Resolution
from sonar_imm.trackers.diver.instruments import Instruments, MOST_RECEIVERS
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.offsets import BiasTest, chi2_limit, RecentPairs
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate


@pytest.mark.statistics
def test_arrivals_are_better_than_fixes_made_of_them():
    rmse = {}
    for sensor in ('arrivals', 'multistatic_fixes'):
        changes, found = {'sensor': sensor, 'outlier_probability': 0.0, 'duration': 60.0}, []
        for seed in range(4):
            scene = simulate(scenario('multistatic', changes), seed)
            tracker = DiverTracker(DiverConfig(max_tracks=1))
            made = run(tracker, [item.measurement for item in scene.measurements])
            found += errors(made, scene.truth[0])[:, 0].tolist()
        rmse[sensor] = np.sqrt(np.mean(np.square(found)))
    assert rmse['arrivals'] < min(rmse['multistatic_fixes'], 0.35)


def test_a_tag_of_unknown_emission_time_is_followed_also_by_two_receivers():
    """Two receivers give one time difference: no fix, but it does hold a track."""
    rng = np.random.default_rng(6)
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    for second in range(1, 60):
        place = np.array([0.6 * second - 20.0, 30.0])
        rx = RECEIVERS if second < 25 or second % 3 == 0 else RECEIVERS[[1, 2]]
        toa = rng.uniform(0, 5) + np.linalg.norm([*place, 0.0] - rx, axis=1) / SPEED
        toa += 1e-4 * rng.normal(size=len(rx))
        (estimate,) = tracker.process(arrivals(second * SECOND, rx, toa))
    assert miss(estimate, place)[0] < 1.0
    assert estimate.extras['track_id'].tolist() == [1]
    assert tracker.health()['confirmed'] == 1


def many_receivers(turn, angles, passive=False, seconds=range(1, 40), **parameters):
    """The estimates of a diver heard by eight receivers, who measure bearings, elevations (then
    he is deeper) or no angles, and where he is; turned about the first receiver by `turn` rad."""
    rng = np.random.default_rng(21)
    around = 2.0 * np.pi * np.arange(7) / 7.0
    rx = np.vstack([[0.0, 0.0], 60.0 * np.column_stack([np.cos(around), np.sin(around)])])
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rx = np.column_stack([rx @ R.T, np.full(8, -2.0)])
    none, pings, divers = np.full(8, np.nan), [], []
    for second in seconds:
        diver = np.append(R @ [70.0, 0.6 * second - 12.0], -9.0 if angles == 'elevation' else -2.0)
        leg = diver - rx
        path = np.linalg.norm(leg, axis=1) + 0.15 * rng.normal(size=8)
        path = path + (0.0 if passive else np.linalg.norm(diver - rx[0]))
        bearing = np.arctan2(leg[:, 1], leg[:, 0]) + 0.02 * rng.normal(size=8)
        up = np.arctan2(leg[:, 2], np.hypot(leg[:, 0], leg[:, 1])) + 0.02 * rng.normal(size=8)
        bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
        known = {'tx': np.full(3, np.nan) if passive else rx[0], 'var_toa': (0.15 / SPEED) ** 2}
        known |= {'bearing': bearing if angles == 'bearing' else none, 'var_bearing': 0.02**2}
        known |= {'elevation': up if angles == 'elevation' else none}
        known |= {'var_elevation': np.full(8, 0.02**2)}
        pings.append(arrivals(second * SECOND, rx, path / SPEED, **known))
        divers.append(diver)
    return followed(DiverTracker(DiverConfig(max_tracks=1, **parameters)), pings), divers


@pytest.mark.parametrize('passive', [False, True])
def test_bearings_of_many_receivers_across_half_a_turn_are_bearings(passive):
    """Heavy tails; turned by pi, the diver crosses where bearings jump from pi to -pi."""
    scene = {'angles': 'bearing', 'passive': passive, 'seconds': range(9, 25)}
    scene |= {'target_z': -2.0, 'adaptation': 'fixed'}
    (plain, _), (other, divers) = (many_receivers(turn, **scene) for turn in (0.0, np.pi))
    for item, two, diver in zip(plain[5:], other[5:], divers[5:]):
        assert two.state[0, :2] == pytest.approx(-item.state[0, :2], abs=1e-5)
        assert two.extras['nis_dof'].tolist() == item.extras['nis_dof'].tolist()
        assert miss(two, diver[:2])[0] < 0.6
    with_bearing = np.mean([item.extras['nis_dof'][0] for item in plain[5:]])
    assert with_bearing > (7 if passive else 8)  # more than the arrival times alone


@pytest.mark.statistics
def test_elevations_show_the_depth():
    """Two hundredths of a radian at 70 m are 1.4 m a receiver, and eight of them hear it."""
    exact = {'dimensions': 3, 'systematic_errors': 'exact'}
    seen, divers = many_receivers(0.0, 'elevation', **exact)
    z = np.array([item.state[0, 2] - diver[2] for item, diver in zip(seen, divers)])[5:]
    nees = np.mean([miss(item, diver)[1] for item, diver in zip(seen, divers)][5:])
    variance = seen[-1].covariance[0, 2, 2]
    assert np.sqrt(np.mean(z**2)) < 0.5
    assert np.sqrt(variance) < 0.6 and 1.0 < nees < 6.0
    unheard, _ = many_receivers(0.0, None, **exact)
    assert np.sqrt(unheard[-1].covariance[0, 2, 2]) > 1.5 * np.sqrt(variance)


def test_echoes_of_two_divers_at_each_receiver_are_told_apart():
    receivers = np.vstack([RECEIVERS, [[60.0, 70.0, 0.0]]])
    rng = np.random.default_rng(9)
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 25):
        divers = np.array([[0.5 * second - 10.0, 30.0], [30.0 - 0.4 * second, 55.0]])
        reach = np.linalg.norm(divers[:, None] - receivers[:, :2], axis=2)
        path = np.linalg.norm(divers, axis=1)[:, None] + reach
        order = rng.permutation(10)
        receiver = np.tile(np.arange(5), 2)[order]
        toa = path.ravel()[order] / SPEED + 1e-4 * rng.normal(size=10)
        known = {'rx_id': receiver, 'tx': np.zeros(3)}
        (estimate,) = tracker.process(arrivals(second * SECOND, receivers[receiver], toa, **known))
    confirmed = estimate.state[estimate.extras['track_state'] > 0, :2]
    assert len(confirmed) == 2
    for diver in divers:
        assert np.hypot(*(confirmed - diver).T).min() < 0.5


# A sensor whose bearings are all off by some degrees: its mount, its heading or its compass.


STD, TOA_STD, SPEED = np.radians(2.0), 2e-4, 1500.0
EVERYWHERE = (0.0, 0.0, 0.0, 360.0, 0.0, 1e6)
"""A coverage that says no more than that the sensor stands at the origin."""
SINGLE = {'max_tracks': 1, 'model_set': 'linear', 'coverage_sector': EVERYWHERE}
CALM = {'max_tracks': 1, 'model_set': 'linear', 'acceleration_noise': (0.02,)}


def path(count=40):
    """Fixes of a diver who swims by at 30 to 40 m, good to .5 m."""
    rng = np.random.default_rng(3)
    places = [np.array([30.0, 0.8 * k - 16.0]) + 0.5 * rng.normal(size=2) for k in range(count)]
    return [fix(k, *place, 0.25 * np.eye(2)) for k, place in enumerate(places, start=1)]


def last(config, measurements):
    tracker = DiverTracker(DiverConfig(**config))
    return run(tracker, measurements)[-1], tracker._stream.state


def test_positions_as_a_sensor_shows_them_are_turned_about_it_and_back():
    noise = {'acceleration_noise': (0.1, 0.1, 0.1), 'bearing_bias_std_deg': 2.0}
    config = DiverConfig(model_set='linear', **noise)
    models = build_models(config)
    layout = Instruments().with_sensor('').layout(config, models)
    rng, place = np.random.default_rng(1), np.array([5.0, -3.0])
    x = rng.normal(size=(2, 3, 5)) * [20.0, 20.0, 1.0, 1.0, 0.05]
    root = rng.normal(size=(2, 3, 5, 5))
    P = root @ np.swapaxes(root, -1, -2)

    def turned(state):
        c, s = np.cos(state[4]), np.sin(state[4])
        arm = state[:2] - place
        return np.append(place + [c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], state[2:])

    rows = models.make_rows(x[:, None], P[:, None], np.ones((2, 1, 3)) / 3.0, np.zeros((2, 1)))
    rows = layout.rotate_about_sensor(rows, models, '', place)
    seen, covariance = models.to_common(rows.blocks)
    for row in np.ndindex(2, 3):
        np.testing.assert_allclose(seen[row], turned(x[row]), atol=1e-12)
        ends = [turned(x[row] + h) - turned(x[row] - h) for h in 1e-6 * np.eye(5)]
        T = np.stack(ends, axis=1) / 2e-6
        np.testing.assert_allclose(covariance[row], T @ P[row] @ T.T, rtol=1e-6, atol=1e-6)
    again = models.to_common(layout.rotate_about_sensor(rows, models, '', place, back=True).blocks)
    np.testing.assert_allclose(again[0], x, atol=1e-12)
    np.testing.assert_allclose(again[1], P, atol=1e-9)


@pytest.mark.parametrize('association', ['gnn', 'jipda'])
def test_a_considered_bearing_widens_the_ellipse_across_and_moves_no_estimate(association):
    """By the variance of the bearing times the distance squared, across the line of sight."""
    config = {**SINGLE, 'association': association}
    plain, _ = last(config, path())
    wide, known = last({**config, 'bearing_bias_std_deg': 2.0}, path())
    np.testing.assert_allclose(wide.state[0, :2], plain.state[0, :2], atol=1e-3)
    x, y = plain.state[0, :2]
    across = STD**2 * np.outer([-y, x], [-y, x])
    added = wide.covariance[0, :2, :2] - plain.covariance[0, :2, :2]
    np.testing.assert_allclose(added, across, atol=0.03 * np.abs(across).max())
    (block,) = known.rows.blocks
    assert (block.x[:, 4] == 0.0).all()
    np.testing.assert_allclose(block.P[:, 4, 4], STD**2, rtol=1e-9)


def test_where_nobody_knows_where_a_sensor_stands_nothing_is_added():
    config = {'max_tracks': 1, 'model_set': 'linear'}
    plain, same = (last({**config, 'bearing_bias_std_deg': std}, path())[0] for std in (0.0, 2.0))
    np.testing.assert_array_equal(same.covariance, plain.covariance)


def around_a_diver(off):
    """A diver who lies still, seen from a vessel that circles, its transceiver `off` rad off."""
    rng, where, made = np.random.default_rng(5), np.array([10.0, 5.0, 0.0]), []
    turn = np.array([[np.cos(off), -np.sin(off), 0.0], [np.sin(off), np.cos(off), 0.0], [0, 0, 1]])
    pose = {'orientation': (0.0, 0.0, 0.0, 1.0), 'frame_id': 'map'}
    pose |= {'pose_covariance': np.diag([0.01] * 3 + [1e-8] * 3)}
    for k in range(1, 90):
        angle, now = 2.0 * np.pi * k / 60.0, {'stamp_ns': k * SECOND}
        vessel = 40.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
        made.append(VesselPose(position=vessel, **pose, **now))
        seen = turn @ (where - vessel) + 0.3 * rng.normal(size=3)
        made.append(RelativeFix(offset=seen, covariance=0.09 * np.eye(3), target_id=1, **now))
    return made, where


def test_a_vessel_that_moves_tells_how_its_transceiver_is_turned():
    off = np.radians(4.0)
    measured, where = around_a_diver(off)
    ignored, _ = last(CALM, measured)
    stated = {**CALM, 'bearing_bias_std_deg': 3.0}
    found, known = last({**stated, 'systematic_errors': 'estimate'}, measured)
    assert abs(known.rows.blocks[0].x[0, 4, 0] - off) < np.radians(0.6)
    assert miss(found, where[:2])[0] < 0.3 * miss(ignored, where[:2])[0]
    considered, _ = last(stated, measured)
    assert miss(considered, where[:2])[1] < 6.0


def test_a_sonar_of_range_and_bearing_states_what_its_mount_does():
    place, here = np.array([30.0, 40.0, 0.0]), np.zeros((1, 3))
    seen = {'tx': here, 'bearing': np.arctan2(40.0, 30.0), 'var_bearing': np.radians(1.0) ** 2}
    pings = [arrivals(k * SECOND, here, [100.0 / SPEED], rx_id=[1], **seen) for k in range(1, 30)]
    plain, _ = last(CALM, pings)
    wide, known = last({**CALM, 'bearing_bias_std_deg': 2.0}, pings)
    across = np.array([-0.8, 0.6])
    assert across @ plain.covariance[0, :2, :2] @ across < 0.5
    assert across @ wide.covariance[0, :2, :2] @ across > 0.9 * (50.0 * STD) ** 2
    np.testing.assert_allclose(wide.state[0, :2], place[:2], atol=0.1)
    assert [what for _, what in known.memory['instruments'].known] == ['bearings']


def test_instruments_beyond_the_most_are_taken_as_they_are():
    config = DiverConfig(model_set='linear', bearing_bias_std_deg=2.0)
    known = Instruments()
    for k in range(MOST_RECEIVERS + 2):
        known = known.with_sensor(f'sensor_{k}')
    models = build_models(config)
    layout = known.layout(config, models)
    x, P = np.zeros((1, 1, 1, layout.size)), np.eye(layout.size)[None, None, None]
    rows = models.make_rows(x, P, np.ones((1, 1, 1)), np.zeros((1, 1)))
    assert layout.rotate_about_sensor(rows, models, 'sensor_65', np.ones(2)) is rows


@pytest.mark.statistics
def test_the_covariance_of_a_turned_sonar_is_true():
    nees = {0.0: [], 2.0: []}
    scene = scenario('random_heading', {'duration': 60.0, 'bearing_bias_std_deg': 2.0})
    for seed in range(6):
        made = simulate(scene, seed)
        for stated, found in nees.items():
            config = {'coverage_sector': EVERYWHERE, 'bearing_bias_std_deg': stated}
            tracker = DiverTracker(DiverConfig(max_tracks=1, **config))
            estimates = followed(tracker, [item.measurement for item in made.measurements])
            places = made.truth[0].position[:, :2]
            found += [miss(*pair)[1] for pair in zip(estimates[10:], places[10:]) if len(pair[0])]
    assert np.mean(nees[0.0]) > 3.5 > 2.6 > np.mean(nees[2.0])


def test_the_place_of_a_sensor_is_part_of_what_a_fix_is():
    plain = fix(1.0, 3.0, 4.0)
    placed = evolve(plain, seen_from=np.zeros(2))
    assert plain.key() != placed.key() and plain.key() == evolve(plain).key()


def legs(place, tag=False):
    reach = np.linalg.norm(RECEIVERS - [*place, 0.0], axis=1)
    return reach if tag else reach + np.hypot(*place)


def ping_of(place, tag=False, error=0.0, rows=slice(None)):
    """The arrivals of a diver at `place` (2,) at the receivers `rows`, with errors (4,), m."""
    toa = (legs(place, tag) + error)[rows] / SPEED
    known = {'tx': [np.nan if tag else 0.0] * 3, 'var_toa': TOA_STD**2, 'tx_id': np.ones(len(toa))}
    return arrivals(1, RECEIVERS[rows], toa, rx_id=np.arange(4)[rows], **known)


def evidence(places, received, errors, tag=False):
    """The evidence of pings of a diver at `places` (k, 2) whose arrivals, those that were `heard`
    (k, 4), have the errors (k, 4), m of path."""
    config, found = DiverConfig(), BiasTest()
    models = build_models(config)
    for place, rows, error in zip(places, received, errors):
        ping = ping_of(place, tag, error, rows)
        seen = numbers_of(ping, config, models)
        ids = np.column_stack([ping.tx_id, ping.rx_id]).astype(np.int64)
        found = found.with_ping(seen, seen.echo, ids, place + [0.3, -0.2], config)
    return found, config


def scene(pings=60, seed=1):
    """A diver who jumps as nobody can: places, which arrivals were heard, and their noise, m."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-40.0, 60.0, (pings, 2))
    received = rng.uniform(size=(pings, 4)) < 0.9
    return places, received, SPEED * TOA_STD * rng.normal(size=(pings, 4))


@pytest.mark.parametrize('tag', [False, True])
def test_the_evidence_is_what_least_squares_gains_by_an_error_of_each_pair(tag, monkeypatch):
    monkeypatch.setattr(offsets, 'MEMORY', 1e12)
    monkeypatch.setattr(offsets, 'CAPPED', 1e12)
    places, received, noise = scene()
    errors = noise + np.array([0.0, 0.8, -0.5, 0.3])
    found, config = evidence(places, received, errors, tag)
    # All unknowns at once: k of each ping and four errors.
    k, rows, residual = 3 if tag else 2, [], []
    for at, (place, seen, error) in enumerate(zip(places, received, errors)):
        if seen.sum() <= k:
            continue
        slope = [(legs(place + d, tag) - legs(place - d, tag)) / 2e-3 for d in 1e-3 * np.eye(2)]
        slope += [np.ones(4)] if tag else []
        for r in np.flatnonzero(seen):
            row = np.zeros(len(places) * k + 4)
            row[k * at : k * at + k] = [part[r] for part in slope]
            row[len(places) * k + r] = 1.0
            rows.append(row)
            residual.append(error[r])
    A, y = np.array(rows) / (SPEED * TOA_STD), np.array(residual) / (SPEED * TOA_STD)

    def left(part):
        return np.sum((y - part @ np.linalg.lstsq(part, y, rcond=None)[0]) ** 2)

    gain = left(A[:, :-4]) - left(A)
    value, rank = found.evidence(config)['every']
    scatter = max((found.square - gain) / (found.freedom - rank), 1.0)
    assert value * scatter == pytest.approx(gain, rel=0.1)
    assert value > chi2_limit(rank)


def test_noise_alone_is_no_evidence_even_where_more_of_it_than_stated():
    for seed in range(5):
        places, received, noise = scene(seed=seed)
        for times in (1.0, 3.0):
            found, config = evidence(places, received, times * noise)
            assert found.warnings(config) == []


def test_what_is_stated_of_instruments_is_expected_and_no_more():
    places, received, noise = scene()
    found, config = evidence(places, received, noise + np.array([0.0, 0.8, -0.5, 0.3]))
    (warning,) = found.warnings(config)
    assert 'receiver_clock_std' in warning and 'target_z' in warning
    assert found.warnings(DiverConfig(receiver_clock_std=5e-4)) == []
    assert found.warnings(DiverConfig(receiver_position_std=0.7)) == []
    assert found.warnings(DiverConfig(receiver_clock_std=1e-5)) != []


def test_a_single_cause_that_explains_it_all_is_named():
    places, received, noise = scene()
    deep = np.array([np.linalg.norm(RECEIVERS - [*p, -10.0], axis=1) for p in places])
    deep += np.hypot(np.hypot(*places.T), 10.0)[:, None] - np.array([legs(p) for p in places])
    found, config = evidence(places, received, noise + deep)
    assert 'Likely cause: target_z (or dimensions: 3)' in found.warnings(config)[0]
    slow = 0.01 * np.array([legs(place) for place in places])
    found, config = evidence(places, received, noise + slow)
    assert 'Likely cause: sound_speed' in found.warnings(config)[0]
    assert found.warnings(DiverConfig(sound_speed_std=15.0)) == []
    # Pings that any place explains say nothing.
    received[:, 2:] = False
    found, config = evidence(places, received, noise + 1.0)
    assert found.freedom == 0.0 and found.warnings(config) == []


def heard(config, place, tag=False):
    """The pairs heard in one ping, all of whose echoes were taken, of a diver at `place` (2,)."""
    ping, nothing = ping_of(place, tag), (BiasTest(), RecentPairs())
    seen = numbers_of(ping, config, build_models(config))
    taken = {0: np.asarray(place, float)}, {0: np.ones(4, bool)}
    return offsets.accumulate_residuals(*nothing, *taken, ping, seen, config)[1]


def placed(path, guess, receivers, tag):
    """Where path lengths (4,) put a diver, by least squares with these receivers (4, 3)."""
    x = np.array([*guess, 0.0] if tag else guess, float)

    def expected(at):
        reach = np.linalg.norm(receivers - [*at[:2], 0.0], axis=1)
        return reach + (at[2] if tag else np.hypot(*at[:2]))

    for _ in range(6):
        H = np.stack([(expected(x + d) - expected(x - d)) / 2e-4 for d in 1e-4 * np.eye(len(x))])
        x = x + np.linalg.lstsq(H.T, path - expected(x), rcond=None)[0]
    return x[:2]


@pytest.mark.parametrize('tag', [False, True])
def test_what_is_assumed_of_instruments_moves_the_place_of_a_ping_as_it_says(tag):
    """Against draws of receivers, clocks and sound speeds, and least squares of each."""
    config, place = DiverConfig(), np.array([20.0, 30.0])
    mean, nothing = np.array([[*place, 0.0, 0.0]]), np.zeros((1, 4, 4))
    wide = offsets.with_assumed_errors(heard(config, place, tag), mean, nothing, config)
    rng, found = np.random.default_rng(2), []
    off, late, slow = offsets.ASSUMED.values()
    for _ in range(1500):
        moved = RECEIVERS.copy()
        moved[0 if tag else 1 :, :2] += off * rng.normal(size=(4 if tag else 3, 2))
        reach = np.linalg.norm(moved - [*place, 0.0], axis=1)
        path = (reach + (0.0 if tag else np.hypot(*place))) * (1.0 - slow / SPEED * rng.normal())
        found.append(placed(path + late * SPEED * rng.normal(size=4), place, RECEIVERS, tag))
    np.testing.assert_allclose(wide[0, :2, :2], np.cov(np.array(found).T), rtol=0.15, atol=0.01)
    assert (wide[0, 2:] == 0.0).all()


def test_of_a_tag_that_is_also_an_echo_the_better_pairs_say_where_it_is():
    """One of the two by itself where the other one is heard a thousand times worse."""
    config, place = DiverConfig(), np.array([20.0, 30.0])
    tag, echo = (heard(config, place, each) for each in (True, False))
    tag = tag._replace(pairs=tuple((2, receiver) for _, receiver in tag.pairs))
    for good, bad in ((tag, echo), (echo, tag)):
        bad = bad._replace(variance=1e6 * bad.variance)
        parts = (np.concatenate(column) for column in zip(good[1:], bad[1:]))
        both = RecentPairs(good.pairs + bad.pairs, *parts)
        found, due = (each.assumed_covariance([*place, 0.0], 2, SPEED) for each in (both, good))
        np.testing.assert_allclose(found, due, rtol=0.02, atol=0.02 * due.max())


def test_nothing_is_assumed_where_something_is_stated_or_nobody_was_heard():
    mean, nothing = np.array([[20.0, 30.0, 0.0, 0.0]]), np.zeros((1, 4, 4))
    config = DiverConfig()
    found = heard(config, mean[0, :2])
    assert offsets.with_assumed_errors(RecentPairs(), mean, nothing, config) is nothing
    for stated in ({'systematic_errors': 'exact'}, *({name: 1e-6} for name in offsets.STDS)):
        config = DiverConfig(**stated)
        assert offsets.with_assumed_errors(found, mean, nothing, config) is nothing


def test_what_is_assumed_moves_no_estimate_and_ends_with_fixes():
    made = simulate(scenario('multistatic', {'duration': 20.0}), 1)
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    assumed = run(tracker, (item.measurement for item in made.measurements))[-1]
    mean, inside = estimate.published_state(tracker._stream.state, tracker.models, 0.05)
    np.testing.assert_array_equal(assumed.state, mean)
    ratio = np.diag(assumed.covariance[0])[:2] / np.diag(inside[0])[:2]
    assert (ratio > 1.5).all() and (ratio < 30.0).all()
    last = made.measurements[-1].measurement.stamp_ns * 1e-9
    after = tracker.process(fix(last + 1.0, *mean[0, :2]))[-1]
    inside = estimate.published_state(tracker._stream.state, tracker.models, 0.05)[1]
    np.testing.assert_array_equal(after.covariance, inside)


def test_pairs_that_fell_silent_are_forgotten():
    config, place = DiverConfig(), np.array([20.0, 30.0])
    found = heard(config, place)
    nobody = found._replace(age=found.age + float(offsets.RECENT))
    seen = numbers_of(ping_of(place, rows=[2]), config, build_models(config))
    left = nobody.with_ping(seen, np.ones(1, bool), np.array([[1, 2]]))
    assert left.pairs == ((1, 2),) and len(found.pairs) == 4


SQUARE = np.array([[0.0, 0.0, -2.0], [240.0, 0.0, -2.0], [240.0, 240.0, -2.0], [0.0, 240.0, -2]])


def stamped(step, count=60, active=False):
    """Pings of a tag, or echoes of a transmitter, whose times are multiples of `step` s (0: not),
    and where the target is. The times of messages are on whole seconds."""
    rng, n, known = np.random.default_rng(1), len(SQUARE), {'tx': SQUARE[0]} if active else {}
    known |= {'tx_id': np.ones(n, int), 'rx_id': np.arange(1, n + 1)}
    for k in range(count):
        emitted = 100.0 + 3.7 * k + rng.uniform(0.0, 1.0)
        place = np.array([90.0 + 0.4 * 3.7 * k, 100.0 + 20.0 * np.sin(k / 15), 0.0])
        path = np.linalg.norm(SQUARE - place, axis=1)
        path += active * np.linalg.norm(SQUARE[0] - place)
        delay = path / 1500.0 + 1e-4 * rng.normal(size=n)
        start = round(emitted * (1 if active else 1e9)) * (SECOND if active else 1)
        at = np.round(delay * 1e9).astype(np.int64) + (0 if active else start)
        if step:
            at = np.round(at / (step * 1e9)).astype(np.int64) * round(step * 1e9)
        stamp = start if active else int(at.min())
        yield place[:2], arrivals(stamp, SQUARE, (at - (0 if active else stamp)) / 1e9, **known)


def tracked(step, **how):
    """Errors (n,), normalised ones, and the sentences about multiples of a run."""
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    places, pings = zip(*stamped(step, **how))
    pairs = zip(followed(tracker, pings)[30:], places[30:])
    off, nees = np.reshape([miss(*pair) for pair in pairs if len(pair[0])], (-1, 2)).T
    return off, nees, said(tracker), tracker


def said(tracker):
    return [text for text in tracker.warnings() if 'multiples' in text]


def test_the_resolution_is_that_of_an_independent_program():
    v = load_vectors('diver_in_the_field/quantum')
    found = [Resolution().after(stamps).seconds for stamps in v['stamps_ns']]
    np.testing.assert_allclose(found, v['seconds'], rtol=1e-12)
    assert Resolution().after(v['few']).seconds == v['few_seconds'] == 0.0


def test_the_resolution_is_that_of_all_times_in_whatever_parts_they_come():
    stamps = load_vectors('diver_in_the_field/quantum')['stamps_ns'][1]
    known = Resolution()
    for part in np.array_split(stamps, 9):
        known = known.after(part)
    assert known == Resolution().after(np.sort(stamps))._replace(values=known.values)
    assert known.seconds == 0.1 and known.after(np.array([12_345_678_912])).seconds == 0.0
    # Seconds since 1970 as a float are not exact; one delay again and again shows nothing.
    rough = np.array([round((1.7e9 + 0.1 * k) % 1e6 * 1e9) + 119 for k in range(30)])
    assert Resolution().after(rough).seconds == pytest.approx(0.1)
    still = Resolution()
    for _ in range(30):
        still = still.after(np.array([80_000_000]))
    assert still.seconds == 0.0


@pytest.mark.parametrize('active', [False, True])
def test_stamps_of_messages_on_whole_seconds_are_no_resolution(active):
    known = ArrivalStamps()
    for _, ping in stamped(0.0, active=active):
        known = known.after(evolve(ping, stamp_ns=ping.stamp_ns // SECOND * SECOND))
    assert known.resolution == 0.0 and 339.0 < known.span < 340.0


@pytest.mark.parametrize('step, active', [(1e-3, True), (1e-2, False)])
def test_rounding_is_counted_in(step, active):
    _, squared, (sentence,), _ = tracked(step, active=active)
    assert len(squared) > 25 and squared.mean() < 3.0 and (squared < 5.99).mean() > 0.85
    assert f'multiples of {step:g} s: a resolution of {1500 * step:.3g} m' in sentence
    assert f'toa_std raised to {step / 12**0.5:.2g} s' in sentence


def test_no_position_is_had_of_whole_seconds():
    _, _, (sentence,), tracker = tracked(1.0)
    assert 'no position can be had of them' in sentence and '1.5e+03 m' in sentence
    assert not (tracker._stream.state.life.status > 0).any()


def test_what_is_stated_is_used_and_exact_times_say_nothing():
    errors, squared, sentences, _ = tracked(0.0)
    assert np.median(errors) < 0.5 and squared.mean() < 3.0 and not sentences
    stated = np.full(len(SQUARE), np.float32(1e-6 / 12.0), np.float64)  # as who knows states it
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    followed(tracker, [evolve(ping, var_toa=stated) for _, ping in stamped(1e-3)])
    assert not said(tracker)
