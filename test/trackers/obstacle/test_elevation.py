# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Sonars that measure elevation, and the sea floor ahead, from soundings."""

from attrs import evolve
from helpers import obstacle_runs as runs
from helpers.estimates import same
from helpers.obstacle_runs import level, run, SECOND, still, track
import numpy as np
import pytest
from scipy.stats import norm

from msg_adapters.soundings import read_ground, write_ground, write_soundings
from msg_adapters.table import encode_table
from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Altitude, Detections, Ground, Navigation, Rejection
from sonar_imm.soundings import COLUMNS, Soundings
from sonar_imm.trackers.obstacle import ground as ground_module
from sonar_imm.trackers.obstacle.beam import apply_elevations, Elevations, expected_elevations
from sonar_imm.trackers.obstacle.filters import depth_span, HeightPrior, Mixture
from sonar_imm.trackers.obstacle.ground import Cells, GroundMap
from sonar_imm.trackers.obstacle.pings import Echoes
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

RISE = 0.05
STD = np.array([0.15, np.radians(0.25), np.radians(1.0)])
IDEAL = {
    'ideal_navigation': True, 'sound_speed_error': 0.0, 'range_step': 0.0, 'bearing_step_deg': 0.0,
}  # fmt: skip
FAITHFUL = {**runs.NO_NOISE, 'range_scale_std': 0.0, 'range_std': 0.15, 'bearing_std_deg': 0.25}
POSE = geometry.Pose(np.array([3.0, -2.0, 20.0]), geometry.rotation(0.05, -0.08, 0.7))


def bounds(scene, ranges):
    """Cramer-Rao bounds of the height of a fixed obstacle when it is first nearer than `ranges`,
    given range, azimuth and elevation of all pings before and the poses."""
    truth, given = scene.truth[0], (item.measurement for item in scene.measurements)
    poses = {each.stamp_ns: each for each in given if isinstance(each, Navigation)}
    information, out, steps = np.zeros((3, 3)), [], 1e-4 * np.eye(3)
    for k, stamp in enumerate(truth.stamp_ns.tolist()):
        at, place = poses[stamp], geometry.flip_world(truth.position[k])
        R = geometry.flip_rotation(geometry.rotation_of_quaternion(at.orientation))
        pose = geometry.Pose(geometry.flip_world(at.position), R)

        def echo(x, pose=pose):
            m = geometry.to_body(pose, x)
            return np.array([*geometry.project(m), np.arcsin(m[2] / np.linalg.norm(m))])

        H = np.column_stack([(echo(place + e) - echo(place - e)) / 2e-4 for e in steps])
        H /= STD[:, None]
        information += truth.in_beam[k] * H.T @ H
        if len(out) < len(ranges) and truth.range[k] < ranges[len(out)]:
            out.append((k, np.sqrt(np.linalg.inv(information)[2, 2])))
    return out


@pytest.mark.statistics
def test_the_height_is_known_as_well_as_the_cramer_rao_bound_allows():
    errors, nees = [], []
    for seed in range(30, 46):
        scene, final = runs.track_scene('elevation', seed, IDEAL, **FAITHFUL, **runs.FIXED)
        truth = scene.truth[0]
        for k, bound in bounds(scene, (60.0, 40.0, 25.0)):
            estimate = final[int(truth.stamp_ns[k])]
            (row,) = np.flatnonzero(estimate.extras['track_id'] == 1)
            error = estimate.state[row, 2] - truth.vertical_offset[k]
            errors.append(error / bound)
            nees.append(error**2 / estimate.covariance[row, 2, 2])
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.2
    assert 0.6 < np.mean(nees) < 1.5


def some_mixture():
    rng, x = np.random.default_rng(0), np.zeros((3, 4, 6))
    x[..., :3] = rng.uniform([20.0, -0.3, 16.0], [60.0, 0.3, 24.0], (3, 4, 3))
    root = rng.normal(size=(3, 4, 6, 6)) * np.array([0.3, 0.01, 1.0, 0.003, 0.3, 0.3])[:, None]
    return Mixture(x, root @ np.swapaxes(root, -1, -2), rng.dirichlet(np.ones(4), 3))


@pytest.mark.parametrize('cone', [False, True])
def test_an_elevation_is_expected_where_geometry_has_it(cone):
    mixture = some_mixture()
    angle, H = expected_elevations(mixture, POSE, cone)

    def of(x):
        z = x[..., 2] - 20.0
        m = geometry.reconstruct(x[..., 0], x[..., 1], z, POSE.R, 'cone' if cone else 'plane')
        return np.arcsin(m[..., 2] / x[..., 0])

    np.testing.assert_allclose(angle, of(mixture.x), atol=1e-12)
    for i, step in enumerate((1e-4, 1e-6, 1e-4, 1e-4)):
        moved = step * np.eye(6)[i]
        slope = (of(mixture.x + moved) - of(mixture.x - moved)) / (2.0 * step)
        wanted = H[..., i] if i < 3 else 0.0
        np.testing.assert_allclose(wanted, slope, rtol=1e-5, atol=1e-7)


def test_an_update_is_that_of_kalman_among_outliers():
    mixture, config = some_mixture(), ObstacleConfig()
    angle, H = expected_elevations(mixture, POSE, False)
    seen = Elevations(np.array([0.01, np.nan, -0.05]), np.array([3e-4, 1.0, 1e-4]))
    after, log = apply_elevations(mixture, seen, POSE, config)
    np.testing.assert_array_equal(after.x[1], mixture.x[1])
    np.testing.assert_array_equal(after.mu[1], mixture.mu[1])
    assert log[1] == 0.0
    for t in (0, 2):
        weight = np.empty(4)
        for j in range(4):
            P, h = mixture.P[t, j], np.append(H[t, j], np.zeros(3))
            S = h @ P @ h + seen.variance[t]
            v, K = seen.angle[t] - angle[t, j], P @ h / S
            weight[j] = norm.pdf(v, 0.0, np.sqrt(S))
            np.testing.assert_allclose(after.x[t, j], mixture.x[t, j] + K * v)
            np.testing.assert_allclose(after.P[t, j], P - np.outer(K, K) * S, atol=1e-12)
        total = mixture.mu[t] @ weight
        np.testing.assert_allclose(after.mu[t], mixture.mu[t] * weight / total)
        # Beside clutter at any elevation in the beam.
        fov = np.radians(config.vertical_fov_deg)
        assert log[t] == pytest.approx(np.log(total * fov))


def test_new_obstacles_lie_where_the_elevation_says():
    z, ends = np.full((2, 2), [40.0, 0.1]), np.array([[-0.02, 0.06], [np.nan, np.nan]])
    given = z, level(altitude=10.0), ObstacleConfig()
    low, high = depth_span(*given, HeightPrior(ends, *np.full((2, 2), np.nan)))
    assert (low[0], high[0]) == pytest.approx((-0.8, 2.4), abs=0.01)
    assert (low[1], high[1]) == tuple(end[1] for end in depth_span(*given))


def test_two_obstacles_one_above_the_other_are_two():
    """At the same range and bearing, six degrees apart; their echoes come in turns of order."""
    rng, given = np.random.default_rng(3), []
    for k in range(20):
        echoes = np.array([[40.0, 0.1, 0.05], [40.0, 0.1, -0.055]])
        echoes += rng.normal(size=(2, 3)) * STD * [1, 1, 0.5]
        stamp, columns = (k + 2) * SECOND // 2, echoes[:: 1 if k % 2 else -1].T
        ping = dict(zip(('range', 'bearing', 'elevation'), columns))
        given += [still(stamp), Detections(stamp_ns=stamp, **ping)]
    last = track(given)[-1]
    assert sorted(last.state[:, 2].round().tolist()) == [-2.0, 2.0]
    assert last.extras['track_state'].tolist() == [1, 1]


def unknown(each):
    if not isinstance(each, Detections):
        return each
    elevation, variance = np.full(len(each), np.nan), np.full(len(each), 1e-4)
    return evolve(each, elevation=elevation, var_elevation=variance)


def test_rows_without_an_elevation_are_as_ever():
    scene = simulate(scenario('approach', {'last_range': 60.0}), 2)
    plain = [item.measurement for item in scene.measurements]
    ours, theirs = track(plain), track([unknown(each) for each in plain])
    assert len(ours) == len(theirs) and all(map(same, ours, theirs))


def test_an_obstacle_is_followed_when_only_some_echoes_have_an_elevation():
    scene = simulate(scenario('elevation', {'last_range': 40.0}), 6)
    given = (item.measurement for item in scene.measurements)
    last = track([unknown(each) if k % 3 else each for k, each in enumerate(given)])[-1]
    assert set(last.extras['track_id'].tolist()) == {1}
    assert abs(last.state[0, 2] - scene.truth[0].vertical_offset[-1]) < 0.6
    assert last.covariance[0, 2, 2] < 0.3**2


def soundings(place, stamp_ns=SECOND):
    variance = np.full(len(place), 0.01)
    return Ground(stamp_ns=stamp_ns, position=place, variance=variance, frame_id='odom')


def floor_at(x, y):
    """A floor 26 m deep at the origin that rises to the east and falls to the north."""
    return -26.0 + 0.1 * x - 0.05 * y


def sloping(rng, count=3000, noise=0.0, extent=30.0):
    x, y = rng.uniform(-extent, extent, (2, count))
    return np.column_stack([x, y, floor_at(x, y) + noise * rng.normal(size=count)])


def test_the_floor_between_soundings_is_the_plane_through_them_and_beyond_unknown():
    rng = np.random.default_rng(0)
    ground = GroundMap().added(evolve(soundings(sloping(rng, noise=0.1)), variance=[0.04] * 3000))
    place = rng.uniform(-20.0, 20.0, (30, 2))
    height, std = np.transpose([ground.floor(x, y, 5.0) for x, y in place])
    assert np.abs(height - floor_at(*place.T)).max() < 0.1
    # Common errors of the soundings do not average out; noise of a cell does.
    assert 0.2 < std.min() and std.max() < 0.3
    height, edge = ground.floor(33.0, 0.0, 5.0)
    assert edge > 1.3 * std.max() and abs(height - floor_at(33.0, 0.0)) < 3.0 * edge
    assert np.isnan([ground.floor(36.0, 0.0, 5.0), GroundMap().floor(0.0, 0.0, 5.0)]).all()
    assert not GroundMap() and ground


def test_soundings_can_come_in_any_portions_and_the_oldest_go(monkeypatch):
    place = sloping(np.random.default_rng(2), 8000, 0.1)
    at_once, bit_by_bit, ground = GroundMap().added(soundings(place)), GroundMap(), GroundMap()
    for k in range(80):
        bit_by_bit = bit_by_bit.added(soundings(place[100 * k : 100 * k + 100], SECOND + k))
    ours, theirs = at_once.floor(3.0, 4.0, 5.0), bit_by_bit.floor(3.0, 4.0, 5.0)
    assert ours == pytest.approx(theirs, abs=0.02)  # a cell may be there twice, old and new
    assert len(bit_by_bit.old.key) > 2048
    monkeypatch.setattr(ground_module, 'MOST_CELLS', 3000)
    for k in range(8):
        ground = ground.added(soundings(place + [100.0 * k, 0.0, 0.0], SECOND + k))
    assert len(ground.old.key) <= 3000 and not np.isfinite(ground.floor(0.0, 0.0, 5.0)[0])
    assert np.isfinite(ground.floor(700.0, 0.0, 5.0)[0])


def test_cells_west_and_south_of_the_origin_are_where_they_are():
    place = np.array([[-700.2, -3.4, -20.0], [-1e7 - 0.5, 8e6 + 0.25, -30.0]])
    ground = GroundMap().added(soundings(place))
    assert [ground.floor(x, y, 1.0)[0] for x, y, _ in place] == pytest.approx([-20.0, -30.0])
    assert len(Cells.none().joined(ground.recent).newest(1).key) == 1


def test_an_echo_meets_the_floor_where_it_is():
    """On a slope the floor 40 m ahead is not that below the sonar."""
    ground = GroundMap().added(soundings(sloping(np.random.default_rng(3), 20_000, extent=60.0)))
    sonar = level(altitude=6.0, turned=(0.02, -0.03, np.pi / 2))  # the bow to the east
    places = [np.array([0.1 * way, way, -floor_at(way, 0.1 * way)]) for way in (20.0, 40.0)]
    z = np.array([geometry.project(geometry.to_body(sonar.pose, place)) for place in places])
    found, std = ground.below(z, sonar, ObstacleConfig())
    assert found == pytest.approx([place[2] - 20.0 for place in places], abs=0.1)
    assert (std < 0.3).all()
    away, _ = ground.below(np.array([[95.0, 0.0]]), sonar, ObstacleConfig())
    assert np.isnan(away).all()


@pytest.mark.parametrize('sounded', [False, True])
@pytest.mark.parametrize('elevation', [np.nan, 0.02])
def test_new_obstacles_have_the_elevation_and_the_floor_that_are_known(sounded, elevation):
    seen = {'elevation': [elevation], 'var_elevation': [1e-4]}
    ping = Detections(stamp_ns=SECOND, range=[20.0], bearing=[0.1], **seen)
    ground, config = GroundMap(), ObstacleConfig()
    if sounded:
        ground = ground.added(soundings(sloping(np.random.default_rng(3))))
    prior = Echoes.of(ping, config).height_prior(level(altitude=6.0), ground, config)
    if prior is None:
        assert not sounded and np.isnan(elevation)
    else:
        assert np.isfinite(prior.elevations).all() == np.isfinite(elevation)
        assert np.isfinite(prior.floor).all() == np.isfinite(prior.floor_std).all() == sounded


def sloping_scene(seed, sounded):
    """An obstacle on a floor that rises towards it by 4.5 m; the altimeter looks down."""
    config = scenario('approach', {'vertical_offset': 1.0, 'altitude': 6.0, 'last_range': 25.0})
    scene = simulate(config, seed)
    given = [item.measurement for item in scene.measurements]
    course, first = np.radians(config.course_deg), given[0].stamp_ns
    for k, each in enumerate(given):
        if isinstance(each, Altitude):
            way = config.speed * ((each.stamp_ns - first) * 1e-9 - 1.0)
            given[k] = evolve(each, altitude=each.altitude - RISE * way)
    if sounded:
        rng = np.random.default_rng(seed)
        along, across = rng.uniform(-20.0, 120.0, 4000), rng.uniform(-20.0, 20.0, 4000)
        height = -26.0 + RISE * along + 0.1 * rng.normal(size=4000)
        east, north = np.sin(course), np.cos(course)
        place = [east * along + north * across, north * along - east * across, height]
        given.insert(0, soundings(np.column_stack(place), first))
    return scene.truth[0], given


@pytest.mark.statistics
def test_what_stands_on_a_slope_is_found_by_soundings():
    error, probable = np.zeros((2, 6)), np.zeros((2, 6))
    for sounded, seed in np.ndindex(2, 6):
        truth, measurements = sloping_scene(seed, sounded)
        k = int(np.flatnonzero(truth.range < 50.0)[0])
        estimate = run(ObstacleTracker(ObstacleConfig()), measurements)[int(truth.stamp_ns[k])]
        error[sounded, seed] = estimate.state[0, 2] - truth.vertical_offset[k]
        probable[sounded, seed] = estimate.extras['prob_seabed'][0]
    without, by_soundings = np.sqrt(np.mean(np.square(error), axis=1))
    assert by_soundings < 0.8 * without
    assert probable[0].mean() < 0.15 and probable[1].mean() > 0.35


def test_soundings_that_come_late_count_as_if_they_had_come_in_time():
    ground, *others = sloping_scene(1, True)[1]
    late = [*others[:13], ground, *others[13:]]
    assert all(map(same, track([ground, *others]), track(late)))
    tracker = ObstacleTracker(ObstacleConfig())
    run(tracker, [evolve(ground, frame_id='map'), *others[:9]])
    assert tracker.counts['other_frame'] > 0


def test_soundings_of_the_bathymetry_node_are_ground():
    columns = {name: np.zeros(2, kind) for name, kind in COLUMNS.items()}
    place = np.array([[500_000.25, 6e6 + 0.125, -20.5], [1.0, 2.0, -21.0]])
    for coarse, exact, values in zip('xyz', ('px', 'py', 'pz'), place.T):
        columns[exact], columns[coarse] = values, values.astype(np.float32)
    columns['vertical_uncertainty'] = np.array([0.04, np.nan], np.float32)
    ground = read_ground(write_soundings(Soundings(SECOND, 'odom', columns), ros_message))
    assert ground.position.tolist() == place.tolist() and ground.frame_id == 'odom'
    assert ground.variance == pytest.approx([0.04, 0.0])
    again = read_ground(write_ground(ground, ros_message))
    assert np.array_equal(again.position, ground.position)


def test_soundings_of_others():
    plain = {'x': np.array([1.0, np.nan]), 'y': np.array([2.0, 0.0]), 'z': np.array([20.0, 0.0])}

    def read(columns, world_frame='ned'):
        table = encode_table(columns, stamp_ns=SECOND, frame_id='map_ned', make=ros_message)
        return read_ground(table, world_frame=world_frame)

    ground = read(plain)
    assert ground.position.tolist() == [[2.0, 1.0, -20.0]] and ground.frame_id == 'map'
    assert ground.variance.tolist() == [0.0] and not len(read({}).position)
    with pytest.raises(Rejection):
        read(plain, 'enu')
    with pytest.raises(Rejection, match='ground'):
        read({'x': np.zeros(1)})
    with pytest.raises(Rejection, match='variances'):
        Ground(stamp_ns=1, position=np.zeros((2, 3)), variance=np.zeros(1))
