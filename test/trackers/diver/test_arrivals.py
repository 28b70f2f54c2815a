# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver tracker on raw arrival times: echoes of a known transmitter, tags that emit alone."""

from attrs import evolve
from helpers.diver_runs import arrivals, errors, fix, run, SECOND
import numpy as np
import pytest

from sonar_imm.acoustics.arrivals_3d import BEARING, observe
from sonar_imm.measurements import RelativeFix, VesselPose
from sonar_imm.trackers.diver.instruments import Instruments, MOST_RECEIVERS
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate


@pytest.mark.statistics
def test_arrivals_are_better_than_fixes_made_of_them():
    squared = {'arrivals': [], 'multistatic_fixes': []}
    for sensor, found in squared.items():
        for seed in range(4):
            scene = simulate(
                scenario(
                    'multistatic', {'sensor': sensor, 'outlier_probability': 0.0, 'duration': 60.0}
                ),
                seed,
            )
            tracker = DiverTracker(DiverConfig(max_tracks=1))
            error, _ = errors(
                run(tracker, [item.measurement for item in scene.measurements]), scene.truth[0]
            )
            found += np.sum(error**2, axis=1).tolist()
    rmse = {sensor: np.sqrt(np.mean(found)) for sensor, found in squared.items()}
    assert rmse['arrivals'] < rmse['multistatic_fixes']
    assert rmse['arrivals'] < 0.35


def tag_ping(second, position, rng, receivers=RECEIVERS, emitted=0.123, std=1e-4):
    distance = np.linalg.norm(np.append(position, 0.0) - receivers, axis=1)
    n = len(receivers)
    return arrivals(
        round(second * SECOND),
        receivers,
        emitted + distance / 1500.0 + std * rng.normal(size=n),
        var_toa=std**2,
    )


def test_a_tag_of_unknown_emission_time_is_followed_also_by_two_receivers():
    """Two receivers give one time difference: no fix, but it does hold a track."""
    rng = np.random.default_rng(6)
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    for second in range(1, 60):
        position = np.array([0.6 * second - 20.0, 30.0])
        rx = RECEIVERS if second < 25 or second % 3 == 0 else RECEIVERS[[1, 2]]
        estimate = tracker.process(tag_ping(second, position, rng, rx, rng.uniform(0, 5)))[-1]
    assert np.hypot(*(estimate.state[0, :2] - position)) < 1.0
    assert estimate.extras['track_id'].tolist() == [1]
    assert tracker.health()['confirmed'] == 1


def many_receivers(
    turn, elevation=False, scale=1.0, passive=False, seconds=range(1, 40), **parameters
):
    """The estimates of a diver heard by eight receivers, with bearings, or elevations and a state
    of depth; the scene turned about the first one by `turn` rad. The stated variances are those
    of the errors divided by `scale`."""
    rng = np.random.default_rng(21)
    angle = 2.0 * np.pi * np.arange(7) / 7.0
    rx = np.vstack([[0.0, 0.0], 60.0 * np.column_stack([np.cos(angle), np.sin(angle)])])
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rx = np.column_stack([rx @ R.T, np.full(8, -2.0)])
    tx = np.full(3, np.nan) if passive else rx[0]
    tracker, estimates, divers = DiverTracker(DiverConfig(max_tracks=1, **parameters)), [], []
    none = np.full(8, np.nan)
    for second in seconds:
        diver = np.append(R @ [70.0, 0.6 * second - 12.0], -9.0 if elevation else -2.0)
        leg = diver - rx
        r = np.linalg.norm(leg, axis=1)
        path = r + (0.0 if passive else np.linalg.norm(diver - rx[0]))
        path = path + 0.15 * rng.normal(size=8)
        bearing = np.arctan2(leg[:, 1], leg[:, 0]) + 0.02 * rng.normal(size=8)
        up = np.arctan2(leg[:, 2], np.hypot(leg[:, 0], leg[:, 1])) + 0.02 * rng.normal(size=8)
        ping = arrivals(
            second * SECOND,
            rx,
            path / 1500.0,
            tx=tx,
            var_toa=(0.15 / 1500.0) ** 2 / scale,
            bearing=none
            if elevation or scale != 1.0
            else np.mod(bearing + np.pi, 2 * np.pi) - np.pi,
            var_bearing=0.02**2,
            elevation=up if elevation else none,
            var_elevation=np.full(8, 0.02**2),
        )
        estimates.append(tracker.process(ping)[-1])
        divers.append(diver)
    return estimates, np.array(divers), tracker.health()


@pytest.mark.parametrize('passive', [False, True])
def test_bearings_of_many_receivers_across_half_a_turn_are_bearings(passive):
    """Heavy tails; turned by pi, the diver crosses where bearings jump from pi to -pi."""
    depth = {'target_z': -2.0, 'adaptation': 'fixed', 'passive': passive, 'seconds': range(9, 25)}
    plain, divers, _ = many_receivers(0.0, **depth)
    other, turned, _ = many_receivers(np.pi, **depth)
    for item, two, diver in zip(plain[5:], other[5:], turned[5:]):
        assert two.state[0, :2] == pytest.approx(-item.state[0, :2], abs=1e-5)
        assert two.extras['nis_dof'].tolist() == item.extras['nis_dof'].tolist()
        assert np.hypot(*(two.state[0, :2] - diver[:2])) < 0.6
    with_bearing = np.mean([item.extras['nis_dof'][0] for item in plain[5:]])
    assert with_bearing > (7 if passive else 8)  # more than the arrival times alone


@pytest.mark.statistics
def test_elevations_show_the_depth():
    """Two hundredths of a radian at 70 m are 1.4 m a receiver, and eight of them hear it."""
    exact = {'dimensions': 3, 'systematic_errors': 'exact'}
    seen, divers, _ = many_receivers(0.0, elevation=True, **exact)
    error = np.array([item.state[0, :3] - diver for item, diver in zip(seen, divers)])[5:]
    P = np.array([item.covariance[0, :3, :3] for item in seen])[5:]
    nees = np.einsum('ka,ka->k', error, np.linalg.solve(P, error[..., None])[..., 0])
    assert np.sqrt(np.mean(error[:, 2] ** 2)) < 0.5
    assert np.sqrt(P[-1, 2, 2]) < 0.6 and 1.0 < nees.mean() < 6.0
    unheard, _, _ = many_receivers(0.0, elevation=False, scale=1.01, **exact)
    assert np.sqrt(unheard[-1].covariance[0, 2, 2]) > 1.5 * np.sqrt(P[-1, 2, 2])


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
        toa = path.ravel()[order] / 1500.0 + 1e-4 * rng.normal(size=10)
        known = {'rx_id': receiver, 'tx': np.zeros(3)}
        ping = arrivals(second * SECOND, receivers[receiver], toa, **known)
        estimate = tracker.process(ping)[-1]
    confirmed = estimate.state[estimate.extras['track_state'] > 0, :2]
    assert len(confirmed) == 2
    for diver in divers:
        assert np.hypot(*(confirmed - diver).T).min() < 0.5


# A sensor whose bearings are all off by some degrees: its mount, its heading or its compass.


STD = np.radians(2.0)
EVERYWHERE = (0.0, 0.0, 0.0, 360.0, 0.0, 1e6)
"""A coverage that says no more than that the sensor stands at the origin."""
SINGLE = {'max_tracks': 1, 'model_set': 'linear', 'coverage_sector': EVERYWHERE}


def path(count=40):
    """Fixes of a diver who swims by at 30 to 40 m, good to .5 m."""
    rng = np.random.default_rng(3)
    places = [np.array([30.0, 0.8 * k - 16.0]) + 0.5 * rng.normal(size=2) for k in range(count)]
    return [fix(k, *place, 0.25 * np.eye(2)) for k, place in enumerate(places, start=1)]


def last(config, measurements):
    tracker = DiverTracker(DiverConfig(**config))
    made = [each for item in measurements for each in tracker.process(item)]
    return made[-1], tracker._stream.state


def test_positions_as_a_sensor_shows_them_are_turned_about_it_and_back():
    config = DiverConfig(
        model_set='linear', acceleration_noise=(0.1, 0.1, 0.1), bearing_bias_std_deg=2.0
    )
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
        T = np.stack(
            [(turned(x[row] + h) - turned(x[row] - h)) / 2e-6 for h in 1e-6 * np.eye(5)], axis=1
        )
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
    plain, _ = last(config, path())
    same, _ = last({**config, 'bearing_bias_std_deg': 2.0}, path())
    np.testing.assert_array_equal(same.covariance, plain.covariance)


def around_a_diver(off):
    """A diver who lies still, seen from a vessel that circles, its transceiver `off` rad off."""
    rng, where, made = np.random.default_rng(5), np.array([10.0, 5.0, 0.0]), []
    turn = np.array([[np.cos(off), -np.sin(off), 0.0], [np.sin(off), np.cos(off), 0.0], [0, 0, 1]])
    for k in range(1, 90):
        angle = 2.0 * np.pi * k / 60.0
        vessel = 40.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
        made.append(
            VesselPose(
                stamp_ns=k * 10**9, position=vessel, orientation=(0.0, 0.0, 0.0, 1.0),
                pose_covariance=np.diag([0.01] * 3 + [1e-8] * 3), frame_id='map',
            )
        )  # fmt: skip
        seen = turn @ (where - vessel) + 0.3 * rng.normal(size=3)
        made.append(
            RelativeFix(stamp_ns=k * 10**9, offset=seen, covariance=0.09 * np.eye(3), target_id=1)
        )
    return made, where


def test_a_vessel_that_moves_tells_how_its_transceiver_is_turned():
    off = np.radians(4.0)
    measured, where = around_a_diver(off)
    config = {'max_tracks': 1, 'model_set': 'linear', 'acceleration_noise': (0.02,)}
    ignored, _ = last(config, measured)
    stated = {'bearing_bias_std_deg': 3.0, 'systematic_errors': 'estimate'}
    found, known = last({**config, **stated}, measured)
    assert abs(known.rows.blocks[0].x[0, 4, 0] - off) < np.radians(0.6)
    error = [np.hypot(*(each.state[0, :2] - where[:2])) for each in (ignored, found)]
    assert error[1] < 0.3 * error[0]
    considered, _ = last({**config, 'bearing_bias_std_deg': 3.0}, measured)
    miss = considered.state[0, :2] - where[:2]
    assert miss @ np.linalg.solve(considered.covariance[0, :2, :2], miss) < 6.0


def test_a_bearing_of_an_arrival_has_the_error_of_its_receiver():
    x, nowhere = np.array([[3.0], [4.0], [0.05]]), np.zeros((1, 3))
    columns = np.array([[0, 1, -1, -1, 2, -1, -1]])
    value, gradient = observe(x, 0.0, np.array([BEARING]), columns, nowhere, nowhere)
    assert value[0, 0] == pytest.approx(np.arctan2(4.0, 3.0) + 0.05)
    np.testing.assert_allclose(gradient[0, :, 0], [-4.0 / 25.0, 3.0 / 25.0, 1.0])


def test_a_sonar_of_range_and_bearing_states_what_its_mount_does():
    """One receiver at the transmitter: what it hears is a range and a bearing."""
    place, here = np.array([30.0, 40.0, 0.0]), np.zeros((1, 3))
    seen = {'tx': here, 'bearing': np.arctan2(40.0, 30.0), 'var_bearing': np.radians(1.0) ** 2}
    pings = [arrivals(k * 10**9, here, [100.0 / 1500.0], rx_id=[1], **seen) for k in range(1, 30)]
    config = {'max_tracks': 1, 'model_set': 'linear', 'acceleration_noise': (0.02,)}
    plain, _ = last(config, pings)
    wide, known = last({**config, 'bearing_bias_std_deg': 2.0}, pings)
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
    for seed in range(6):
        made = simulate(
            scenario('random_heading', {'duration': 60.0, 'bearing_bias_std_deg': 2.0}), seed
        )
        track = made.truth[0]
        for stated, found in nees.items():
            config = DiverConfig(
                max_tracks=1, coverage_sector=EVERYWHERE, bearing_bias_std_deg=stated
            )
            tracker = DiverTracker(config)
            for k, item in enumerate(made.measurements):
                estimate = tracker.process(item.measurement)[-1]
                if k >= 10 and len(estimate):
                    error = estimate.state[0, :2] - track.position[k, :2]
                    found.append(error @ np.linalg.solve(estimate.covariance[0, :2, :2], error))
    assert np.mean(nees[0.0]) > 3.5 > 2.6 > np.mean(nees[2.0])


def test_the_place_of_a_sensor_is_part_of_what_a_fix_is():
    plain = fix(1.0, 3.0, 4.0)
    placed = evolve(plain, seen_from=np.zeros(2))
    assert plain.key() != placed.key() and plain.key() == evolve(plain).key()
