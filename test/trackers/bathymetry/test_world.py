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

"""A world turned or lifted gives the same floor turned or lifted: headings through south, and
profiles counted from the surface."""

from attrs import evolve
from helpers.sea import motion_case, navigation, sea_config, snapshots
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.measurements import Navigation, Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

CASE = motion_case()
EXACT = {
    f'nav_{what}': 0.0
    for what in ('attitude_error_deg', 'heading_error_deg', 'heave_error', 'position_error')
}


def tracked(config, measurements):
    tracker = BathymetryTracker(config)
    return [each for measurement in measurements for each in tracker.process(measurement)]


def test_a_heading_that_passes_through_180_degrees_is_no_jump():
    """The heading of the case, about 30 degrees, put to south; and quaternions that change their
    sign, which says nothing."""
    config = sea_config(CASE, engine='grid')
    poses, pings = navigation(CASE), list(snapshots(CASE))[:3]
    plain = tracked(config, [*poses, *pings])
    heading = np.array(
        [Rotation.from_quat(np.array(each.orientation)).as_euler('ZYX')[0] for each in poses]
    )
    turn = Rotation.from_euler('z', np.pi - np.median(heading))
    turned = []
    for k, each in enumerate(poses):
        q = (turn * Rotation.from_quat(np.array(each.orientation))).as_quat()
        turned.append(
            evolve(
                each, position=turn.apply(np.array(each.position)), orientation=q if k % 2 else -q
            )
        )
    south = np.array(
        [Rotation.from_quat(np.array(each.orientation)).as_euler('ZYX')[0] for each in turned]
    )
    assert (south > 3.0).any() and (south < -3.0).any()
    found = tracked(config, [*turned, *pings])
    for a, b in zip(plain, found, strict=True):
        assert b.state == pytest.approx(a.state, abs=1e-6)
        assert b.xyz == pytest.approx(turn.apply(np.array(a.xyz, float)), abs=2e-5)


def in_summer(**changes):
    scene = scenario('moving_profile', {'pings': 2, 'ping_rate': 0.3, **EXACT, **changes})
    made = simulate(scene, 3)
    config = BathymetryConfig.from_mapping({**scene.instruments(), 'engine': 'grid'})
    config = config.for_inputs(frozenset({'snapshot', 'nav'}))
    return made, config, [each.measurement for each in made.measurements]


def height_error(estimates, truth):
    error = np.array([each.state[:, 0] for each in estimates]) - [each.height for each in truth]
    return float(np.sqrt(np.mean(np.square(error))))


def test_depth_in_the_profile_is_counted_from_the_surface():
    """The same sea 40 m higher: the floor is 40 m higher, and bends as before."""
    made, config, measurements = in_summer()
    lifted = [
        evolve(each, position=each.position + [0.0, 0.0, 40.0])
        if isinstance(each, Navigation)
        else each
        for each in measurements
    ]
    plain = tracked(config, measurements)
    higher = tracked(evolve(config, water_level=config.water_level + 40.0), lifted)
    for a, b in zip(plain, higher, strict=True):
        assert b.state[:, 0] - 40.0 == pytest.approx(a.state[:, 0], abs=1e-6)
    assert height_error(plain, made.truth) < 0.17


@pytest.mark.parametrize('mistake', ['from the sonar', 'from the zero of the world'])
def test_a_profile_counted_from_elsewhere_is_seen(mistake):
    level = 0.0 if mistake == 'from the sonar' else 10.0
    made, config, measurements = in_summer(water_level=level)
    array = level - 5.0  # the array is 5 m deep
    wrong = evolve(config, water_level=array if mistake == 'from the sonar' else 0.0)
    pings = sum(isinstance(each, Snapshot) for each in measurements)
    found, right = (tracked(each, measurements) for each in (wrong, config))
    assert len(found) == pings
    assert height_error(found, made.truth) > 0.4 > 0.2 > height_error(right, made.truth)
