# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What /tf_static says: the place of a sonar on its vehicle, and measurements in another frame."""

from collections import deque

import attrs
from attrs import evolve
from helpers.diver_runs import arrivals
import numpy as np
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.intake import Intake
from sonar_imm.measurements import (
    Altitude,
    Fix,
    Fixes,
    Navigation,
    NOBODY,
    Rejection,
    Snapshot,
    StaticTransforms,
)
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.trackers.state_values import frozen_state
from sonar_imm_tools.simulation.bathymetry import simulator as swath
from sonar_imm_tools.simulation.obstacle import simulator as obstacle

LEVER, RPY = (1.5, -0.3, 0.4), (2.0, -15.0, 8.0)
MOUNT = Pose(np.array(LEVER), geometry.rotation(*np.radians(RPY)))
FRAMES = {'vehicle_frame': 'base_link', 'sonar_frame': 'sonar'}
TRANSFORMS = StaticTransforms(
    poses={
        'sonar': ('bracket', Pose(np.zeros(3), MOUNT.R)),
        'bracket': ('base_link', Pose(MOUNT.position, np.eye(3))),
    }
)


def scene_of(system):
    if system == 'obstacle':
        scene = obstacle.scenario('approach', {})
        return scene, obstacle.simulate(scene, 1).measurements[:200]
    scene = swath.scenario('moving', {'pings': 3})
    return scene, swath.simulate(scene, 1).measurements


def run(system, transforms=None, **parameters):
    """The last estimate, the reasons of refusals, and the tracker."""
    scene, received = scene_of(system)
    config = SYSTEMS[system].config_type()(**{**scene.instruments(), **parameters})
    tracker = SYSTEMS[system].build(config)
    intake, made, refused = Intake(tracker), [], []
    for item in [*([transforms] if transforms else []), *(item.measurement for item in received)]:
        try:
            measurement = intake.admit(item)
        except Rejection as rejection:
            refused.append(rejection)
            continue
        if measurement is not None:
            made += tracker.process(measurement)
    return made[-1] if made else None, refused, tracker


@pytest.mark.parametrize('system', ['obstacle', 'bathymetry'])
def test_a_mounting_that_transforms_say_is_that_of_the_parameters(system):
    by_hand, _, _ = run(system, sonar_lever=LEVER, sonar_mount_rpy_deg=RPY)
    plain, _, _ = run(system)
    mounted, refused, tracker = run(system, TRANSFORMS, **FRAMES)
    assert not refused and tracker.config.sonar_lever == LEVER
    assert tracker.config.sonar_mount_rpy_deg == pytest.approx(RPY)
    assert mounted.state == pytest.approx(by_hand.state, rel=1e-9, abs=1e-9, nan_ok=True)
    assert mounted.xyz == pytest.approx(by_hand.xyz, rel=1e-5, abs=1e-5, nan_ok=True)
    assert plain.state.shape != mounted.state.shape or not np.allclose(
        plain.state, mounted.state, equal_nan=True
    )


@pytest.mark.parametrize('system', ['obstacle', 'bathymetry'])
def test_pings_before_the_mounting_is_known_are_refused_by_name(system):
    last, refused, _ = run(system, **FRAMES)
    assert last is None and {item.reason for item in refused} == {'no_mounting'}
    assert "'sonar' is on 'base_link'" in refused[0].sentence


def test_a_change_of_parameters_keeps_the_mounting():
    config = SYSTEMS['obstacle'].config_type()(**FRAMES)
    tracker = SYSTEMS['obstacle'].build(config)
    intake = Intake(tracker)
    intake.admit(TRANSFORMS)
    intake.reconfigure(evolve(config, detection_probability=0.5))
    assert tracker.config.detection_probability == 0.5 and tracker.config.sonar_lever == LEVER


@pytest.mark.parametrize('system', ['obstacle', 'bathymetry'])
def test_one_frame_alone_is_a_mistake(system):
    with pytest.raises(ConfigError, match='need each other'):
        SYSTEMS[system].config_type()(sonar_frame='sonar')


def fix(frame_id, x):
    return Fix(stamp_ns=10**9, position=[x, 0.0, 0.0], covariance=np.eye(2), frame_id=frame_id)


def test_a_position_in_another_frame_is_turned_where_the_transform_is_known():
    intake = Intake(SYSTEMS['diver'].build(SYSTEMS['diver'].config_type()()), 'map')
    with pytest.raises(Rejection, match="'pier' is not the frame 'map'"):
        intake.admit(fix('pier', 1.0))
    quarter = Pose(np.array([100.0, 0.0, 0.0]), geometry.rotation(0.0, 0.0, np.pi / 2.0))
    intake.admit(StaticTransforms(poses={'pier': ('map', quarter)}))
    made = intake.admit(fix('pier', 1.0))
    assert made.frame_id == 'map' and made.position == pytest.approx([100.0, 1.0, 0.0])
    assert intake.admit(fix('map', 1.0)).position.tolist() == [1.0, 0.0, 0.0]
    with pytest.raises(Rejection, match="'odom' is not the frame 'map'"):
        intake.admit(fix('odom', 1.0))


def test_an_altimeter_in_another_frame_is_turned_where_the_transform_is_known():
    intake = Intake(SYSTEMS['bathymetry'].build(SYSTEMS['bathymetry'].config_type()()))

    def take(frame_id):
        made = intake.admit(Altitude(stamp_ns=10**9, altitude=9.0, frame_id=frame_id))
        intake.tracker.process(made)
        return made

    assert take('dvl').altitude == 9.0
    with pytest.raises(Rejection, match="'altimeter' is not .* and no fixed transform joins"):
        take('altimeter')
    above = Pose(np.array([0.0, 0.0, 1.5]), np.eye(3))
    intake.admit(StaticTransforms(poses={'altimeter': ('dvl', above)}))
    made = take('altimeter')
    assert made.altitude == 7.5 and made.frame_id == 'dvl'


def test_a_late_altitude_does_not_shut_out_the_later_ones():
    tracker = SYSTEMS['obstacle'].build(SYSTEMS['obstacle'].config_type()())
    intake = Intake(tracker)

    def take(second, frame_id):
        altitude = Altitude(stamp_ns=second * 10**9, altitude=9.0, frame_id=frame_id)
        tracker.process(intake.admit(altitude))

    for second in range(5000, 5005):
        pose = Navigation(
            stamp_ns=second * 10**9,
            position=[0.0, 0.0, 0.0],
            orientation=[0.0, 0.0, 0.0, 1.0],
            frame_id='map',
        )
        tracker.process(intake.admit(pose))
    take(4000, 'another')
    assert tracker.counts['too_late'] == 1
    take(5005, 'altimeter')
    assert tracker.counts['used'] == 6
    with pytest.raises(Rejection, match="'another' is not the frame 'altimeter'"):
        take(5006, 'another')


def test_a_required_frame_survives_a_reset_and_a_first_one_does_not():
    tracker = SYSTEMS['diver'].build(SYSTEMS['diver'].config_type()())
    for required in ('', 'map'):
        intake = Intake(tracker, required)
        tracker.process(intake.admit(fix('map', 1.0)))
        with pytest.raises(Rejection, match="'odom' is not the frame 'map' of the tracks"):
            intake.admit(fix('odom', 2.0))
        intake.reset()
        if required:
            with pytest.raises(Rejection, match="'odom' is not the frame 'map' of the tracks"):
                intake.admit(fix('odom', 2.0))
        else:
            assert intake.admit(fix('odom', 2.0)).frame_id == 'odom'


def test_an_array_keeps_to_its_first_frame():
    scene, received = scene_of('bathymetry')
    snapshot = next(
        item.measurement for item in received if isinstance(item.measurement, Snapshot)
    )
    config = SYSTEMS['bathymetry'].config_type()(**scene.instruments())
    intake = Intake(SYSTEMS['bathymetry'].build(config))
    first = evolve(snapshot, frame_id='array')
    assert intake.admit(first) is first
    with pytest.raises(Rejection, match="'hull' is not the frame 'array'"):
        intake.admit(evolve(snapshot, frame_id='hull'))


def wandering(k, rng):
    """What comes in a second when every sensor has another name, and all it sees too."""
    stamp_ns, place = k * 10**9, np.append(rng.normal(scale=50.0, size=2), -5.0)
    rx = np.column_stack([rng.normal(scale=80.0, size=(4, 2)), np.full(4, -3.0)])
    pose = Pose(np.zeros(3), np.eye(3))
    yield StaticTransforms(poses={f'sonar_{k}': ('map', pose)})
    yield evolve(fix('map', place[0]), stamp_ns=stamp_ns, target_id=k, sensor=f'usbl_{k}')
    yield evolve(fix(f'sonar_{k}', place[1]), stamp_ns=stamp_ns)
    yield Fixes(
        stamp_ns=stamp_ns,
        frame_id=f'sonar_{k}',
        sensor=f'sonar_{k}',
        position=place + rng.normal(size=(3, 3)),
        target_id=[k, 10**6 + k, NOBODY],
    )
    for passive in (False, True):
        yield arrivals(
            stamp_ns,
            rx,
            (1.0 + (not passive)) * np.linalg.norm(rx - place, axis=1) / 1500.0,
            tx_id=np.full(4, k),
            rx_id=4 * k + np.arange(4),
            tx=np.full((4, 3), np.nan) if passive else rx[[0, 0, 0, 0]],
            var_toa=1e-07,
        )


def entries(value):
    """How many values a frozen state has, an array being one."""
    if attrs.has(type(value)):
        value = attrs.asdict(value, recurse=False)
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, (list, tuple, deque)):
        return 1
    return sum(map(entries, value))


def test_a_tracker_does_not_grow_with_names_that_wander():
    parameters = {'fix_bias_std': 0.5, 'max_coast': 2.0, 'history': 0.0}
    intake = Intake(DiverTracker(DiverConfig(model_set='heading_speed', **parameters)))
    rng, sizes = np.random.default_rng(1), []
    for k in range(1, 61):
        for item in wandering(k, rng):
            admitted = intake.admit(item)
            if admitted is not None:
                intake.tracker.process(admitted)
        sizes.append(entries(frozen_state(intake.tracker)))
    assert max(sizes[30:]) <= max(sizes[:30])
