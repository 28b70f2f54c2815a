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

"""Simulated divers: reproducible, as accurate as stated, as late as stated."""

from collections import Counter

import numpy as np
import pytest

from sonar_imm.measurements import Fix
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.georeferencing import Georeferencer
from sonar_imm_tools.simulation.diver.afloat import ORIGIN
from sonar_imm_tools.simulation.diver.simulator import (
    RECEIVERS,
    scenario,
    SCENARIOS,
    simulate,
    TRANSMITTER,
)


def content(scene):
    """Stamps of reception and measurement, and the numbers measured."""
    return [
        (one.received_ns, one.measurement.stamp_ns, one.measurement.key())
        for one in scene.measurements
    ]


@pytest.mark.parametrize('name', SCENARIOS)
def test_the_same_seed_gives_the_same_scene_and_another_seed_another(name):
    config = scenario(name, {'duration': 20.0})
    first, again, other = (content(simulate(config, seed)) for seed in (3, 3, 4))
    assert len(first) == len(again) > 5
    for one, two in zip(first, again):
        assert one == two
    assert any(one[2] != two[2] for one, two in zip(first, other))


def test_table_1_starts_where_the_paper_says_at_its_speed():
    scene = simulate(scenario('table1'), 1)
    track = scene.truth[0]
    np.testing.assert_array_equal(track.position[0], [-40.0, 40.0, 0.0])
    np.testing.assert_allclose(np.hypot(*track.velocity.T), 1.0)
    assert len(track.stamp_ns) == len(scene.measurements) == 101
    steps = np.diff(track.position[:, :2], axis=0)
    np.testing.assert_allclose(steps, track.velocity[1:], atol=1e-9)
    assert np.abs(np.arctan2(*track.velocity.T[::-1])).max() <= np.pi / 2 + 1e-9


def test_fixes_are_as_accurate_as_they_say():
    squared = []
    for seed in range(20):
        scene = simulate(scenario('table1'), seed)
        for one, place in zip(scene.measurements, scene.truth[0].position):
            error = one.measurement.position[:2] - place[:2]
            squared.append(error @ np.linalg.solve(one.measurement.covariance[:2, :2], error))
    assert np.mean(squared) == pytest.approx(2.0, abs=0.15)


def test_arrivals_are_transmitter_diver_receiver():
    config = scenario(
        'multistatic',
        {
            'detection_probability': 1.0,
            'outlier_probability': 0.0,
            'toa_std': 1e-9,
            'duration': 5.0,
        },
    )
    scene = simulate(config, 2)
    for one, place in zip(scene.measurements, scene.truth[0].position):
        path = np.linalg.norm(place - TRANSMITTER) + np.linalg.norm(place - RECEIVERS, axis=1)
        np.testing.assert_allclose(one.measurement.toa * 1500.0, path, atol=1e-4)
        np.testing.assert_array_equal(one.measurement.rx, RECEIVERS)


@pytest.mark.statistics
def test_misses_clutter_and_outliers_come_as_often_as_asked():
    missed = simulate(scenario('table1', {'detection_probability': 0.7, 'duration': 2000.0}), 5)
    assert len(missed.measurements) == pytest.approx(0.7 * 2001, abs=80)
    cluttered = simulate(scenario('table1', {'clutter': 3.0, 'duration': 400.0}), 6)
    assert len(cluttered.measurements) == pytest.approx(4.0 * 401, abs=150)
    scene = simulate(scenario('table1', {'outlier_probability': 0.1, 'duration': 2000.0}), 7)
    error = [
        np.hypot(*(one.measurement.position - place)[:2])
        for one, place in zip(scene.measurements, scene.truth[0].position)
    ]
    # A bearing error of 2 degrees is never 8 times its size; most outliers are far off.
    far = np.linalg.norm(scene.truth[0].position[:, :2], axis=1) * np.deg2rad(16.0)
    assert np.mean(np.array(error) > far) == pytest.approx(0.1, abs=0.03)


def test_late_scans_are_received_late_and_out_of_order():
    scene = simulate(scenario('irregular'), 8)
    received = [one.received_ns for one in scene.measurements]
    delay = np.array([one.received_ns - one.measurement.stamp_ns for one in scene.measurements])
    assert received == sorted(received)
    assert (delay >= 0).all() and delay.max() <= 3e9
    assert np.mean(delay > 0) == pytest.approx(0.25, abs=0.12)
    assert (np.diff([one.measurement.stamp_ns for one in scene.measurements]) < 0).any()


def test_a_turned_scene_keeps_its_distances():
    plain, turned = (
        simulate(scenario('table1', {'random_rotation': rotation}), 9)
        for rotation in (False, True)
    )
    start, other = plain.truth[0].position[0], turned.truth[0].position[0]
    assert np.hypot(*start[:2]) == pytest.approx(np.hypot(*other[:2]))
    assert not np.allclose(start, other)


def test_several_divers_are_several():
    scene = simulate(scenario('several'), 10)
    assert [track.track_id for track in scene.truth] == [1, 2, 3, 4]
    starts = np.array([track.position[0, :2] for track in scene.truth])
    gaps = np.linalg.norm(starts[:, None] - starts, axis=-1) + 1e9 * np.eye(4)
    assert gaps.min() > 10.0
    assert all(isinstance(one.measurement, Fix) for one in scene.measurements)


@pytest.mark.parametrize(
    ('name', 'values', 'says'),
    [
        ('tabel1', {}, "did you mean 'table1'"),
        ('table1', {'sped': 1.0}, "did you mean 'speed'"),
        ('table1', {'leg_min': 20.0}, 'leg_min cannot exceed'),
        ('table1', {'start': (1.0,)}, 'two values'),
        ('table1', {'motion': 'swim'}, 'one of'),
    ],
)
def test_mistakes_get_a_sentence(name, values, says):
    with pytest.raises(ConfigError, match=says):
        scenario(name, values)


def test_positions_on_earth_lie_where_the_truth_does():
    scene = simulate(scenario('geodetic', {'fix_std': 0.5}), 2)
    truth = dict(zip(scene.truth[0].stamp_ns.tolist(), scene.truth[0].position))
    error = np.array(
        [
            ORIGIN.local(one.latitude, one.longitude, one.height)[:2] - truth[one.stamp_ns][:2]
            for one in (item.measurement for item in scene.measurements)
        ]
    )
    np.testing.assert_allclose(error.std(axis=0), 0.5, rtol=0.25)


def test_what_a_vessel_sees_is_consistent_where_it_is_placed():
    config = scenario('usbl')
    nees = []
    for seed in range(4):
        scene = simulate(config, seed)
        truth = {
            one.track_id: dict(zip(one.stamp_ns.tolist(), one.position)) for one in scene.truth
        }
        georeferencer = Georeferencer(DiverConfig(**config.instruments()), Counter())
        for item in scene.measurements:
            for fix in georeferencer.georeference(item.measurement):
                error = (fix.position - truth[fix.target_id][fix.stamp_ns])[:2]
                nees.append(error @ np.linalg.solve(fix.covariance[:2, :2], error))
    # 2 is due; a pose between two messages is the mean of both, and better than each.
    assert len(nees) > 700 and 1.4 < np.mean(nees) < 2.2
