# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Objects on the floor: what a ping sees of them."""

import math

import numpy as np
import pytest

from benchmarks.bathymetry_paper import truth_of
from sonar_imm.acoustics import sounding
from sonar_imm.parameters import ConfigError
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry.profiles import profiles_of
from sonar_imm_tools.evaluation.bathymetry.scoring import score
from sonar_imm_tools.simulation.bathymetry.objects import (
    above,
    FACE,
    facets_of,
    second_of,
    surfaces_of,
)
from sonar_imm_tools.simulation.bathymetry.ship import ship_of
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate, snr


def seen(**values):
    config = scenario('ledge', values)
    ranges = config.first_range + config.bin_width * np.arange(1200)
    ratio = snr(config, ranges)
    return ranges, ratio, *surfaces_of(facets_of(config, ranges, ratio), len(ranges))


@pytest.mark.parametrize('kind', ['ledge', 'box', 'wall', 'boulder'])
def test_the_floor_before_an_object_has_the_ratio_of_the_scene(kind):
    ranges, ratio, power, height = seen(object=kind, object_distance=50.0)
    near = (ranges > 18.0) & (ranges < 50.0)
    assert np.mean(power[near, 0] / ratio[near]) == pytest.approx(1.0, abs=0.01)
    assert np.abs(power[near, 0] / ratio[near] - 1.0).max() < 0.35  # whole facets
    assert np.abs(height[near, 0]).max() < 1e-12 and (power[near, 1:] == 0.0).all()


def test_a_ledge_has_its_face_before_the_foot_and_its_top_with_the_floor():
    ranges, _, power, height = seen(object_distance=30.0, object_size=2.0)
    foot, edge = math.hypot(30.0, 15.0), math.hypot(30.0, 13.0)
    face = np.flatnonzero(power[:, 1])
    assert ranges[face[0]] == pytest.approx(edge, abs=0.06)
    assert ranges[face[-1]] == pytest.approx(foot, abs=0.06)
    both = (ranges > edge + 0.1) & (ranges < foot - 0.1)
    assert (power[both][:, :3] > 0.0).all()
    # The face at range r is at the height where 15 - z = sqrt(r^2 - 30^2).
    expected = 15.0 - np.sqrt(ranges[both] ** 2 - 900.0)
    assert height[both, 1] == pytest.approx(expected, abs=0.08)
    number, main, second = second_of(power, height)
    assert (number[both] >= 2).mean() > 0.7 and number[ranges < 32.0].max() == 1
    beside = np.isfinite(second)
    assert (np.abs(second - main)[beside] >= 0.5).all()
    np.testing.assert_array_equal(beside, number > 1)


def test_a_level_sonar_hears_each_facet_from_its_height():
    config = scenario('ledge', {'object': 'wall', 'object_size': 3.0})
    ranges = config.first_range + config.bin_width * np.arange(1200)
    facets = facets_of(config, ranges, np.full(1200, 100.0))
    below = ranges[facets.bin] * np.sin(math.radians(config.tilt_deg) + np.arcsin(facets.sine))
    np.testing.assert_allclose(config.sonar_height - below, facets.height, atol=1e-9)
    assert facets.height.max() == 3.0


@pytest.mark.parametrize('kind', ['box', 'wall', 'boulder'])
def test_an_object_has_a_shadow(kind):
    ranges, _, power, _ = seen(object=kind, object_distance=30.0, object_size=3.0)
    dark = power.sum(axis=1) == 0.0
    begin, end = ranges[dark][[0, -1]]
    assert begin > 32.0
    if kind == 'wall':  # the ray over its far edge meets the floor there
        assert end == pytest.approx(math.hypot(30.2 * 15.0 / 12.0, 15.0), abs=0.1)
    assert (power[ranges > end + 0.1, 3] > 0.0).all()


@pytest.mark.parametrize('side, sign', [('port', 1.0), ('starboard', -1.0)])
def test_the_truth_of_an_object_has_its_range_height_and_side(side, sign):
    config = scenario('ledge', {'object': 'wall', 'object_size': 4.0, 'pings': 1, 'side': side})
    true = simulate(config, 1).truth[0]
    x, y, z = true.xyz[true.valid].T
    assert (x == 0.0).all() and (sign * y > 0.0).all() and true.height[true.valid].max() > 3.0
    np.testing.assert_allclose(np.hypot(y, z), true.range[true.valid])
    np.testing.assert_allclose(z, true.height[true.valid] - config.sonar_height)


def test_a_wall_is_gated_and_scored():
    """The range of heights is no limit: walls of 4 m."""
    config = scenario(
        'ledge', {'object': 'wall', 'object_size': 4.0, 'object_distance': 26.0, 'pings': 4}
    )
    scene = simulate(config, 5)
    values = {**config.instruments(), 'layover': 'gated'}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    estimates = [made for item in scene.measurements for made in tracker.process(item.measurement)]
    metrics = score(profiles_of(estimates, truth_of(scene)))
    assert metrics['layover']['bins'] > 80
    assert metrics['layover']['found'] > 0.75
    assert metrics['layover']['soundings'] < 0.2 and metrics['layover']['lost'] < 0.01
    assert 0.0 < metrics['two_share'] < 0.05


@pytest.mark.parametrize('side', ['port', 'starboard'])
def test_facets_below_a_ship_lie_where_the_geometry_of_soundings_puts_them(side):
    config = scenario('moving_ledge', {'object': 'wall', 'object_size': 3.0})
    ship = ship_of(config, config.sonar_depth, np.random.default_rng(1))
    ranges = config.first_range + config.bin_width * np.arange(1200)
    axes = sounding.array_axes(side, math.radians(config.tilt_deg), np.eye(3))
    received = ship.pose(3.0 + 2.0 * ranges / config.sound_speed)
    look = sounding.looks(axes, np.array([1.5, -0.4, -0.8]), ship.pose(np.array(3.0)), received)
    level = -config.sonar_depth - config.sonar_height
    over = above(look, ship.course, side, level)
    facets = facets_of(config, ranges, np.full(1200, 100.0), over)
    there = sounding.Looks(*(part[facets.bin] for part in look))
    place = there.position + ranges[facets.bin, None] * sounding.direction(there, facets.sine)
    assert np.abs(place[:, 2] - level - facets.height).max() < 0.06  # half a bin of range
    c, s = math.cos(ship.course), math.sin(ship.course)
    off = (c * place[:, 1] - s * place[:, 0]) * (1.0 if side == 'port' else -1.0)
    assert (np.abs(off - config.object_distance) < 0.2)[facets.surface == FACE].all()


def test_a_ledge_below_a_ship_becomes_soundings_of_both_surfaces():
    config = scenario('moving_ledge', {'pings': 3, 'object_size': 2.5})
    scene = simulate(config, 4)
    values = {**config.instruments(), 'navigation': 'required'}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    estimates = [made for item in scene.measurements for made in tracker.process(item.measurement)]
    off, upper = [], 0
    for estimate in estimates:
        columns = soundings_of(estimate).columns
        again = columns['surface'] == 2
        upper += int(again.sum())
        across = np.abs(columns['py'] * math.cos(math.pi / 6) - columns['px'] * 0.5)
        top = np.where(across < config.object_distance, 0.0, config.object_size)
        face = np.abs(across - config.object_distance) < 2.0
        error = np.where(face, np.nan, columns['pz'] + 20.0 - top)
        off.append(error / np.sqrt(columns['vertical_uncertainty']))
        assert (columns['existence'][again] >= 0.5).all()
    error = np.concatenate(off)
    assert len(estimates) == 3 and upper > 40
    assert np.nanmean(np.abs(error) < 2.0) > 0.9


@pytest.mark.parametrize('values', [{'multipath': True}, {'object_size': 20.0}])
def test_what_does_not_go_with_objects(values):
    with pytest.raises(ConfigError):
        scenario('ledge', values)


def test_the_second_surface_is_the_strongest_that_is_apart():
    power = np.array([[9.0, 2.0, 4.0, 8.0], [9.0, 0.0, 0.0, 8.0], [0.0, 0.0, 0.0, 0.0]])
    height = np.array([[0.0, 3.0, 2.0, 0.1]] * 3)
    number, main, second = second_of(power, height)
    assert number.tolist() == [3, 1, 0]
    assert main[:2].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(second, [2.0, np.nan, np.nan])
