# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Sonars that measure elevation, and the sea floor ahead, from soundings."""

from attrs import evolve
from helpers.estimates import same
from helpers.obstacle_runs import FIXED, run, SECOND, track_scene
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
from sonar_imm.trackers.obstacle.filters import depth_span, HeightPrior, Mixture, Sonar
from sonar_imm.trackers.obstacle.ground import Cells, GroundMap
from sonar_imm.trackers.obstacle.pings import Echoes
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

STD = np.array([0.15, np.radians(0.25), np.radians(1.0)])
IDEAL = {
    'ideal_navigation': True, 'sound_speed_error': 0.0, 'range_step': 0.0, 'bearing_step_deg': 0.0,
}  # fmt: skip
FAITHFUL = {
    'scale_std': 0.0, 'navigation_noise': (0.0, 0.0, 0.0), 'range_scale_std': 0.0,
    'range_std': 0.15, 'bearing_std_deg': 0.25,
}  # fmt: skip
POSE = geometry.Pose(np.array([3.0, -2.0, 20.0]), geometry.rotation(0.05, -0.08, 0.7))


def bounds(scene, ranges):
    """Cramer-Rao bounds of the height of a fixed obstacle when it is first nearer than `ranges`,
    given range, azimuth and elevation of all pings before and the poses."""
    truth = scene.truth[0]
    poses = {
        item.measurement.stamp_ns: item.measurement
        for item in scene.measurements
        if isinstance(item.measurement, Navigation)
    }
    information, out = np.zeros((3, 3)), []
    for k, stamp in enumerate(truth.stamp_ns.tolist()):
        at = poses[stamp]
        R = geometry.flip_rotation(geometry.rotation_of_quaternion(at.orientation))
        pose = geometry.Pose(geometry.flip_world(at.position), R)
        place = geometry.flip_world(truth.position[k])

        def echo(x, pose=pose):
            m = geometry.to_body(pose, x)
            return np.array([*geometry.project(m), np.arcsin(m[2] / np.linalg.norm(m))])

        steps = 1e-4 * np.eye(3)
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
        scene, final = track_scene('elevation', seed, IDEAL, **FAITHFUL, **FIXED)
        truth = scene.truth[0]
        for k, bound in bounds(scene, (60.0, 40.0, 25.0)):
            estimate = final[int(truth.stamp_ns[k])]
            (row,) = np.flatnonzero(estimate.extras['track_id'] == 1)
            error = estimate.state[row, 2] - truth.vertical_offset[k]
            errors.append(error / bound)
            nees.append(error**2 / estimate.covariance[row, 2, 2])
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.2
    assert 0.6 < np.mean(nees) < 1.5


def some_mixture(T=3, K=4, seed=0):
    rng = np.random.default_rng(seed)
    x = np.zeros((T, K, 6))
    x[..., 0] = rng.uniform(20.0, 60.0, (T, K))
    x[..., 1] = rng.uniform(-0.3, 0.3, (T, K))
    x[..., 2] = 20.0 + rng.uniform(-4.0, 4.0, (T, K))
    root = rng.normal(size=(T, K, 6, 6)) * np.array([0.3, 0.01, 1.0, 0.003, 0.3, 0.3])[:, None]
    return Mixture(x, root @ np.swapaxes(root, -1, -2), rng.dirichlet(np.ones(K), T))


@pytest.mark.parametrize('cone', [False, True])
def test_an_elevation_is_expected_where_geometry_has_it(cone):
    mixture = some_mixture()
    angle, H = expected_elevations(mixture, POSE, cone)
    model = 'cone' if cone else 'plane'

    def of(x):
        m = geometry.reconstruct(x[..., 0], x[..., 1], x[..., 2] - 20.0, POSE.R, model)
        return np.arcsin(m[..., 2] / x[..., 0])

    np.testing.assert_allclose(angle, of(mixture.x), atol=1e-12)
    for i, step in enumerate((1e-4, 1e-6, 1e-4, 1e-4)):
        moved = np.zeros(6)
        moved[i] = step
        slope = (of(mixture.x + moved) - of(mixture.x - moved)) / (2.0 * step)
        if i < 3:
            np.testing.assert_allclose(H[..., i], slope, rtol=1e-5, atol=1e-7)
        else:
            assert not slope.any()


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
    level = Sonar(geometry.Pose(np.array([0.0, 0.0, 20.0]), np.eye(3)), altitude=10.0)
    z = np.array([[40.0, 0.1], [40.0, 0.1]])
    ends = np.array([[-0.02, 0.06], [np.nan, np.nan]])
    hints = HeightPrior(ends, *np.full((2, 2), np.nan))
    low, high = depth_span(z, level, ObstacleConfig(), hints)
    plain = depth_span(z, level, ObstacleConfig())
    assert (low[0], high[0]) == pytest.approx((-0.8, 2.4), abs=0.01)
    assert (low[1], high[1]) == (plain[0][1], plain[1][1])


def still(stamp, echoes):
    """Navigation of a vehicle that stands, and a ping of echoes: range, bearing, elevation."""
    rows = np.reshape(echoes, (-1, 3)).T
    yield Navigation(stamp_ns=stamp, position=[0.0, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0])
    yield Detections(stamp_ns=stamp, range=rows[0], bearing=rows[1], elevation=rows[2])


def test_two_obstacles_one_above_the_other_are_two():
    """At the same range and bearing, six degrees apart; their echoes come in turns of order."""
    rng = np.random.default_rng(3)
    tracker = ObstacleTracker(ObstacleConfig())
    for k in range(20):
        echoes = np.array([[40.0, 0.1, 0.05], [40.0, 0.1, -0.055]])
        echoes += rng.normal(size=(2, 3)) * STD * [1, 1, 0.5]
        for measurement in still((k + 2) * SECOND // 2, echoes[:: 1 if k % 2 else -1]):
            made = tracker.process(measurement)
    assert sorted(made[-1].state[:, 2].round().tolist()) == [-2.0, 2.0]
    assert made[-1].extras['track_state'].tolist() == [1, 1]


def test_rows_without_an_elevation_are_as_ever():
    scene = simulate(scenario('approach', {'last_range': 60.0}), 2)
    plain = [item.measurement for item in scene.measurements]
    unknown = [
        evolve(each, elevation=np.full(len(each), np.nan), var_elevation=np.full(len(each), 1e-4))
        if isinstance(each, Detections)
        else each
        for each in plain
    ]
    ours, theirs = (
        run(ObstacleTracker(ObstacleConfig()), measurements) for measurements in (plain, unknown)
    )
    assert list(ours) == list(theirs) and all(same(ours[k], theirs[k]) for k in ours)


def test_an_obstacle_is_followed_when_only_some_echoes_have_an_elevation():
    scene = simulate(scenario('elevation', {'last_range': 40.0}), 6)
    measurements = []
    for number, item in enumerate(scene.measurements):
        each = item.measurement
        if isinstance(each, Detections) and number % 3:
            each = evolve(each, elevation=np.full(len(each), np.nan))
        measurements.append(each)
    final = run(ObstacleTracker(ObstacleConfig()), measurements)
    (last,) = [list(final.values())[-1]]
    assert set(last.extras['track_id'].tolist()) == {1}
    assert abs(last.state[0, 2] - scene.truth[0].vertical_offset[-1]) < 0.6
    assert last.covariance[0, 2, 2] < 0.3**2


def soundings(place, stamp_ns=SECOND, variance=0.01):
    return Ground(
        stamp_ns=stamp_ns, position=place, variance=np.full(len(place), variance), frame_id='odom'
    )


def sloping(rng, count=3000, noise=0.0, extent=30.0):
    """A floor 26 m deep at the origin that rises to the east and falls to the north."""
    x, y = rng.uniform(-extent, extent, (2, count))
    return np.column_stack([x, y, -26.0 + 0.1 * x - 0.05 * y + noise * rng.normal(size=count)])


def test_the_floor_between_soundings_is_the_plane_through_them():
    rng = np.random.default_rng(0)
    ground = GroundMap().added(soundings(sloping(rng, noise=0.1), variance=0.04))
    errors, stated = [], []
    for x, y in rng.uniform(-20.0, 20.0, (30, 2)):
        height, std = ground.floor(x, y, 5.0)
        errors.append(height - (-26.0 + 0.1 * x - 0.05 * y))
        stated.append(std)
    assert np.abs(errors).max() < 0.1
    # Common errors of the soundings do not average out; noise of a cell does.
    assert all(0.2 < std < 0.3 for std in stated)


def test_beyond_what_was_sounded_the_floor_is_uncertain_and_then_unknown():
    ground = GroundMap().added(soundings(sloping(np.random.default_rng(1), extent=20.0)))
    _, inside = ground.floor(0.0, 0.0, 5.0)
    height, edge = ground.floor(23.0, 0.0, 5.0)
    assert edge > 1.3 * inside and abs(height - (-26.0 + 2.3)) < 3.0 * edge
    assert np.isnan(ground.floor(26.0, 0.0, 5.0)).all()
    assert not GroundMap() and ground
    assert np.isnan(GroundMap().floor(0.0, 0.0, 5.0)).all()


def test_soundings_can_come_in_any_portions_and_the_oldest_go(monkeypatch):
    rng = np.random.default_rng(2)
    place = sloping(rng, 8000, 0.1)
    at_once = GroundMap().added(soundings(place))
    bit_by_bit = GroundMap()
    for k in range(80):
        bit_by_bit = bit_by_bit.added(soundings(place[100 * k : 100 * k + 100], SECOND + k))
    ours, theirs = at_once.floor(3.0, 4.0, 5.0), bit_by_bit.floor(3.0, 4.0, 5.0)
    assert ours == pytest.approx(theirs, abs=0.02)  # a cell may be there twice, old and new
    assert len(bit_by_bit.old.key) > 2048
    monkeypatch.setattr(ground_module, 'MOST_CELLS', 3000)
    ground = GroundMap()
    for k in range(8):
        east = np.array([100.0 * k, 0.0, 0.0])
        ground = ground.added(soundings(place + east, SECOND + k))
    assert len(ground.old.key) <= 3000 and not np.isfinite(ground.floor(0.0, 0.0, 5.0)[0])
    assert np.isfinite(ground.floor(700.0, 0.0, 5.0)[0])


def test_cells_west_and_south_of_the_origin_are_where_they_are():
    place = np.array([[-700.2, -3.4, -20.0], [-1e7 - 0.5, 8e6 + 0.25, -30.0]])
    ground = GroundMap().added(soundings(place))
    assert ground.floor(-700.5, -3.5, 1.0)[0] == pytest.approx(-20.0)
    assert ground.floor(-1e7 - 0.5, 8e6 + 0.5, 1.0)[0] == pytest.approx(-30.0)
    assert len(Cells.none().joined(ground.recent).newest(1).key) == 1


def test_an_echo_meets_the_floor_where_it_is():
    """On a slope the floor 40 m ahead is not that below the sonar."""
    ground = GroundMap().added(soundings(sloping(np.random.default_rng(3), 20_000, extent=60.0)))
    east = geometry.rotation(0.02, -0.03, np.pi / 2)  # NED: the bow to the east
    sonar = Sonar(geometry.Pose(np.array([0.0, 0.0, 20.0]), east), altitude=6.0)
    true = []
    for way in (20.0, 40.0):
        place = np.array([way * 0.1, way, 26.0 - 0.1 * way + 0.05 * 0.1 * way])
        m = geometry.to_body(sonar.pose, place)
        true.append((*map(float, geometry.project(m)), place[2] - 20.0))
    z, below = np.array(true)[:, :2], np.array(true)[:, 2]
    found, std = ground.below(z, sonar, ObstacleConfig())
    assert found == pytest.approx(below, abs=0.1) and (std < 0.3).all()
    away, _ = ground.below(np.array([[95.0, 0.0]]), sonar, ObstacleConfig())
    assert np.isnan(away).all()


@pytest.mark.parametrize('sounded', [False, True])
@pytest.mark.parametrize('elevation', [np.nan, 0.02])
def test_new_obstacles_have_the_elevation_and_the_floor_that_are_known(sounded, elevation):
    ping = Detections(
        stamp_ns=SECOND, range=[20.0], bearing=[0.1], elevation=[elevation], var_elevation=[1e-4]
    )
    ground, config = GroundMap(), ObstacleConfig()
    if sounded:
        ground = ground.added(soundings(sloping(np.random.default_rng(3))))
    sonar = Sonar(geometry.Pose(np.array([0.0, 0.0, 20.0]), np.eye(3)), altitude=6.0)
    prior = Echoes.of(ping, config).height_prior(sonar, ground, config)
    if prior is None:
        assert not sounded and np.isnan(elevation)
    else:
        assert np.isfinite(prior.elevations).all() == np.isfinite(elevation)
        assert np.isfinite(prior.floor).all() == np.isfinite(prior.floor_std).all() == sounded


RISE = 0.05


def sloping_scene(seed, sounded):
    """An obstacle on a floor that rises towards it by 4.5 m; the altimeter looks down."""
    config = scenario('approach', {'vertical_offset': 1.0, 'altitude': 6.0, 'last_range': 25.0})
    scene = simulate(config, seed)
    course, first = np.radians(config.course_deg), scene.measurements[0].measurement.stamp_ns
    ahead = np.array([np.sin(course), np.cos(course)])
    measurements = []
    for item in scene.measurements:
        each = item.measurement
        if isinstance(each, Altitude):
            way = config.speed * ((each.stamp_ns - first) * 1e-9 - 1.0)
            each = evolve(each, altitude=each.altitude - RISE * way)
        measurements.append(each)
    if sounded:
        rng = np.random.default_rng(seed)
        along, across = rng.uniform(-20.0, 120.0, 4000), rng.uniform(-20.0, 20.0, 4000)
        height = -26.0 + RISE * along + 0.1 * rng.normal(size=4000)
        level = np.outer(along, ahead) + np.outer(across, ahead[::-1] * [1.0, -1.0])
        place = np.column_stack([level, height])
        measurements.insert(0, soundings(place, measurements[0].stamp_ns))
    return scene.truth[0], measurements


@pytest.mark.statistics
def test_what_stands_on_a_slope_is_found_by_soundings():
    error, probable = {}, {}
    for sounded in (False, True):
        errors, on_the_floor = [], []
        for seed in range(6):
            truth, measurements = sloping_scene(seed, sounded)
            final = run(ObstacleTracker(ObstacleConfig()), measurements)
            k = int(np.flatnonzero(truth.range < 50.0)[0])
            estimate = final[int(truth.stamp_ns[k])]
            errors.append(estimate.state[0, 2] - truth.vertical_offset[k])
            on_the_floor.append(estimate.extras['prob_seabed'][0])
        error[sounded] = np.sqrt(np.mean(np.square(errors)))
        probable[sounded] = np.mean(on_the_floor)
    assert error[True] < 0.8 * error[False]
    assert probable[False] < 0.15 and probable[True] > 0.35


def test_soundings_that_come_late_count_as_if_they_had_come_in_time():
    _, measurements = sloping_scene(1, True)
    late = [*measurements[1:14], measurements[0], *measurements[14:]]
    ours, theirs = (run(ObstacleTracker(ObstacleConfig()), each) for each in (measurements, late))
    assert all(same(ours[stamp], theirs[stamp]) for stamp in ours)
    other = [evolve(measurements[0], frame_id='map'), *measurements[1:]]
    tracker = ObstacleTracker(ObstacleConfig())
    run(tracker, other)
    assert tracker.counts['other_frame'] > 0


def test_soundings_of_the_bathymetry_node_are_ground():
    columns = {name: np.zeros(2, kind) for name, kind in COLUMNS.items()}
    columns['px'], columns['py'] = np.array([500_000.25, 1.0]), np.array([6e6 + 0.125, 2.0])
    columns['pz'] = np.array([-20.5, -21.0])
    columns['vertical_uncertainty'] = np.array([0.04, np.nan], np.float32)
    for coarse, exact in zip('xyz', ('px', 'py', 'pz')):
        columns[coarse] = columns[exact].astype(np.float32)
    message = write_soundings(Soundings(SECOND, 'odom', columns), ros_message)
    ground = read_ground(message)
    assert ground.position.tolist() == [[500_000.25, 6e6 + 0.125, -20.5], [1.0, 2.0, -21.0]]
    assert ground.variance == pytest.approx([0.04, 0.0]) and ground.frame_id == 'odom'
    again = read_ground(write_ground(ground, ros_message))
    assert np.array_equal(again.position, ground.position)


def test_soundings_of_others():
    plain = {'x': np.array([1.0, np.nan]), 'y': np.array([2.0, 0.0]), 'z': np.array([20.0, 0.0])}
    options = {'stamp_ns': SECOND, 'frame_id': 'map_ned', 'make': ros_message}
    message = encode_table(plain, **options)
    ground = read_ground(message, world_frame='ned')
    assert ground.position.tolist() == [[2.0, 1.0, -20.0]] and ground.frame_id == 'map'
    assert ground.variance.tolist() == [0.0]
    with pytest.raises(Rejection):
        read_ground(message)
    with pytest.raises(Rejection, match='ground'):
        read_ground(encode_table({'x': np.zeros(1)}, **options), world_frame='ned')
    nothing = read_ground(encode_table({}, **options), world_frame='ned')
    assert not len(nothing.position)
    with pytest.raises(Rejection, match='variances'):
        Ground(stamp_ns=1, position=np.zeros((2, 3)), variance=np.zeros(1))
