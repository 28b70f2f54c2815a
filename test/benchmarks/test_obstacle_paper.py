# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The estimates of the paper: on approaches computed elsewhere, and on whole recordings."""

from pathlib import Path

from helpers.obstacle_runs import approach, lever, meta
import numpy as np
import pytest

from benchmarks import obstacle_paper
from benchmarks.obstacle_paper import deferred, moored, sonar_poses
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig
from sonar_imm_tools.simulation.obstacle.simulator import scenario

SECTION5 = Path(__file__).parents[1] / 'vectors' / 'obstacle_sea' / 'paper_section5.npz'
GRID = np.arange(-12.0, 12.025, 0.05)
NOISE_FREE = ('approach_dst+0.5_noisefree', 'approach_dst+3_noisefree')


def echoes(name):
    config = ObstacleConfig(sonar_lever=lever(name))
    measurements = approach(name)
    pings = [item for item in measurements if isinstance(item, Detections) and len(item)]
    navigation = [item for item in measurements if isinstance(item, Navigation)]
    poses, known = sonar_poses(navigation, np.array([ping.stamp_ns for ping in pings]), config)
    assert known.all()
    return np.array([[ping.range[0], -ping.bearing[0]] for ping in pings]), poses, config


@pytest.mark.parametrize('name', NOISE_FREE)
def test_without_noise_the_offset_is_exact_and_the_mirrored_one_is_not(name):
    true = meta(name)['dst_first_ping']
    for refit in (False, True):
        found = deferred(*echoes(name), refit=refit)
        assert found.best == pytest.approx(true, abs=1e-6) and found.least < 1e-6
    curve = deferred(*echoes(name), offsets=np.array([-true, true])).rmsd
    assert curve[0] == pytest.approx(meta(name)['rmsd_px_at_minus'], abs=1e-9)


@pytest.mark.parametrize('name', ['approach_dst+3_noisy', 'approach_level_mirror_noisy'])
def test_with_noise_the_curve_is_that_of_the_paper(name):
    found = deferred(*echoes(name), offsets=GRID)
    lowest = int(np.nanargmin(found.rmsd))
    assert GRID[lowest] == pytest.approx(meta(name)['rmsd_px_argmin_signed'], abs=1e-9)
    assert found.rmsd[lowest] == pytest.approx(meta(name)['rmsd_px_min'], abs=1e-9)
    assert found.least <= found.rmsd[lowest]
    assert abs(found.best - GRID[lowest]) <= 0.05


def test_poses_are_not_invented():
    name = NOISE_FREE[0]
    navigation = [item for item in approach(name) if isinstance(item, Navigation)]
    config = ObstacleConfig(max_navigation_gap=0.6)
    first, last = navigation[0].stamp_ns, navigation[-1].stamp_ns
    stamps = np.array([first - 1, first, first + 10**8, last, last + 1])
    poses, known = sonar_poses(navigation, stamps, config)
    assert known.tolist() == [False, True, True, True, False]
    assert np.isfinite(poses.position).all(axis=1).tolist() == known.tolist()
    # A tenth of the way from the first pose to the second, half a second later: a fifth.
    expected = 0.8 * navigation[0].position + 0.2 * navigation[1].position
    np.testing.assert_allclose(poses.position[2, [1, 0, 2]] * [1, 1, -1], expected, atol=1e-9)
    wide = navigation[:1] + navigation[5:]
    assert not sonar_poses(wide, stamps[2:3], config)[1][0]


@pytest.mark.parametrize('body', ['large', 'sphere'])
@pytest.mark.parametrize('echo', ['hand', 'noisy'])
def test_curves_of_the_papers_encounters(body, echo):
    """The same pings read by eye and by a noisy detector: curves computed elsewhere."""
    with np.load(SECTION5) as file:
        values = {key.removeprefix(f'{body}/'): file[key] for key in file.files if body in key}
    z = np.column_stack([values[f'{echo}_range'], values[f'{echo}_azimuth']])
    seen = np.isfinite(z).all(axis=1)
    poses = Pose(values['sonar_p_ned'][seen], values['sonar_R_ned'][seen])
    found = deferred(z[seen], poses, ObstacleConfig(), offsets=values['d_st'])
    np.testing.assert_allclose(found.rmsd, values[f'{echo}_rmsd'], rtol=1e-9)
    assert found.best == pytest.approx(float(values[f'{echo}_estimate']), abs=0.05)


def test_all_estimates_of_a_moored_sphere_hold_at_the_first_echo():
    found = moored(scenario('tethers', obstacle_paper.TETHERS), 1)
    assert abs(found['refitted']) < 2.0 and abs(found['online']) < 2.0
    assert abs(found['tether_m'] - 15.0) < 2.0 * found['tether_std_m'] < 3.0
    # Where the tracker has the obstacle is how long it has the tether.
    assert found['tether_m'] == pytest.approx(15.0 - found['online'], abs=0.5)


def test_the_study_has_all_its_tables():
    parts = {}
    for part in obstacle_paper.main(runs=2, seeds=1):
        parts |= part
    methods = {f'approach, {method}' for method in ('seafloor', 'deferred', 'refit')}
    assert set(parts['approach']) == methods
    assert set(parts['large']['distribution']) == set(obstacle_paper.READINGS)
    assert len(parts['sphere']['estimates']['by eye']) == 2
    assert list(parts['tether']['errors']) == ['seed 1']
    assert parts['tether']['size of the errors']['online']['runs'] == 1
