# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""The sea floor ahead, from soundings."""

from attrs import evolve
from helpers.estimates import same
from helpers.obstacle_runs import run, SECOND
import numpy as np
import pytest

from msg_adapters.soundings import read_ground, write_ground, write_soundings
from msg_adapters.table import encode_table
from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Altitude, Detections, Ground, Rejection
from sonar_imm.soundings import COLUMNS, Soundings
from sonar_imm.trackers.obstacle import ground as ground_module
from sonar_imm.trackers.obstacle.filters import Sonar
from sonar_imm.trackers.obstacle.ground import Cells, GroundMap
from sonar_imm.trackers.obstacle.pings import Echoes
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate


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
