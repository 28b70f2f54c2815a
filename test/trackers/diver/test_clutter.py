# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The density of false fixes, learnt from scans when nobody states it."""

from pathlib import Path

from attrs import evolve
from helpers.diver_runs import scan_of, SECOND
from helpers.estimates import same
import numpy as np
import pytest

from sonar_imm.trackers.diver.clutter import (
    Clutter,
    Clutters,
    IN_DISC,
    LEAST,
    MOST,
    MOST_REMEMBERED,
    RADII,
)
from sonar_imm.trackers.diver.config import CLUTTER
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

VECTORS = Path(__file__).parents[2] / 'vectors' / 'diver_in_the_field'


def scans(count, false, half, seed=11, divers=((0.0, 0.0), (0.0, 2.0)), aspect=1.0):
    """Divers who swim along x, seen with .9 to .5 m, and false fixes in a rectangle."""
    rng = np.random.default_rng(seed)
    found = []
    for second in range(1, count + 1):
        there = np.array(divers) + (0.7 * second - 0.35 * count, 0.0)
        there = there[rng.uniform(size=len(there)) < 0.9]
        wild = rng.uniform(-half, half, (rng.poisson(false), 2)) * (1.0, aspect)
        both = np.concatenate([there + rng.normal(scale=0.5, size=there.shape), wild])
        found.append(scan_of(second, both))
    return found


def learnt(items, **settings):
    tracker = DiverTracker(DiverConfig(model_set='heading_speed', **settings))
    made = [tracker.process(item)[-1] for item in items]
    ((_, found),) = tracker._stream.state.memory['clutter'].by_sensor
    return found.density, made


@pytest.mark.parametrize(
    'false, half, aspect', [(2.0, 60.0, 1.0), (12.0, 80.0, 0.4), (5.0, 400.0, 1.0)]
)
def test_the_density_is_found(false, half, aspect):
    items = scans(60, false, half, aspect=aspect)
    density, made = learnt(items, association='jipda')
    truth = max(false / (4.0 * half**2 * aspect), CLUTTER)
    assert 0.6 * truth < density < 1.6 * truth
    assert (made[-1].extras['track_state'] > 0).sum() == 2


def test_divers_are_no_clutter():
    density, made = learnt(scans(20, 0.0, 1.0), association='jipda')
    assert LEAST <= density < CLUTTER
    assert all((each.extras['track_state'] > 0).sum() == 2 for each in made[5:])


def test_what_is_stated_stays_and_gnn_learns_nothing():
    items = scans(20, 4.0, 40.0)
    config = DiverConfig(model_set='heading_speed', association='jipda', clutter_density=1e-4)
    tracker = DiverTracker(config)
    for item in items:
        tracker.process(item)
    assert tracker._stream.state.memory['clutter'].by_sensor == ()
    usual, stated = (
        DiverTracker(DiverConfig(association='gnn', clutter_density=value))
        for value in (0.0, CLUTTER)
    )
    assert all(same(usual.process(item)[-1], stated.process(item)[-1]) for item in items)


def test_each_sensor_has_its_own():
    known = {'association': 'jipda', 'model_set': 'heading_speed', 'directions': 4}
    known |= {'sensors': ['left', 'right'], 'right.clutter_density': 3e-5}
    tracker = DiverTracker(DiverConfig.from_mapping(known))
    for item in scans(10, 4.0, 40.0):
        for sensor, late in (('left', 0), ('right', 1), ('', 2)):
            tracker.process(evolve(item, stamp_ns=item.stamp_ns + late, sensor=sensor))
    found = dict(tracker._stream.state.memory['clutter'].by_sensor)
    assert sorted(found) == ['', 'left']


def test_the_covariance_is_that_of_the_false_fixes():
    rng, known, all_of_them = np.random.default_rng(5), Clutter(), []
    for _ in range(8):
        z = rng.uniform(-300.0, 300.0, (40, 2)) * (1.0, 0.3) @ [[0.8, 0.6], [-0.6, 0.8]]
        z += (5e5, 6e6)  # far from the origin of the frame
        known, weight = known.with_scan(z, np.full(40, 1.0)), np.exp(-1.0 / 100.0)
        all_of_them = [(w * weight, p) for w, p in all_of_them] + [(1.0, p) for p in z]
    weights = np.array([w for w, _ in all_of_them])
    C = np.cov(np.array([p for _, p in all_of_them]).T, aweights=weights, ddof=0)
    scatter = np.array([[known.xx, known.xy], [known.xy, known.yy]])
    assert scatter == pytest.approx(C * weights.sum(), rel=1e-6)
    assert known.area == pytest.approx(600.0 * 180.0, rel=0.1)


def test_densities_are_bounded():
    rng, known = np.random.default_rng(2), Clutter()
    assert known.density == pytest.approx(CLUTTER, rel=1e-4)
    for _ in range(300):
        known = known.with_scan(rng.normal(scale=0.01, size=(50, 2)), np.ones(50))
    assert known.density == MOST
    for _ in range(3000):
        known = known.with_scan(np.empty((0, 2)), np.empty(0))
    assert known.density == LEAST


@pytest.mark.parametrize(
    'false, half, settings, warns',
    [
        (6.0, 60.0, {}, True),
        (6.0, 60.0, {'clutter_density': 4e-4}, False),
        (6.0, 60.0, {'association': 'jipda'}, False),
        (0.1, 60.0, {}, False),
        (1.0, 900.0, {}, False),
    ],
)
def test_gnn_says_that_there_is_clutter(false, half, settings, warns):
    known = {'model_set': 'heading_speed', 'directions': 4, 'association': 'gnn'}
    tracker = DiverTracker(DiverConfig(**{**known, **settings}))
    for item in scans(40, false, half):
        tracker.process(item)
    (about,) = [text for text in tracker.warnings() if 'clutter_density' in text] or ['']
    assert bool(about) == warns
    # Its own false tracks take a part of them.
    assert not warns or 0.5 * false < float(about.split()[0]) < 1.2 * false


def remembered(points, weight, scans, whole):
    """Statistics that remember false fixes, with `whole` as the density of the sensor."""

    class Known(Clutter):
        density = whole

    return Known(scans=scans, points=points, weight=weight)


def test_the_density_at_a_fix_is_that_of_an_independent_program():
    v = np.load(VECTORS / 'density.npz')
    known = remembered(v['points'], v['weight'], float(v['scans']) - 5.0, float(v['whole']))
    found = known.density_at(v['z'], v['R'])
    assert found == pytest.approx(v['density'], rel=1e-12)
    assert len(np.unique(found)) > 5
    assert known.density_at(np.empty((0, 2)), np.empty((0, 2, 2))).shape == (0,)


def test_a_disc_is_as_wide_as_a_fix_is_uncertain():
    points = np.random.default_rng(3).normal(scale=1.0, size=(40, 2))
    known = remembered(points, np.ones(40), 95.0, 1e-9)
    for std in (1.0, 10.0, 100.0, 190.0, 500.0):
        (found,) = known.density_at(np.zeros((1, 2)), std**2 * np.eye(2)[None])
        (radius,) = RADII[RADII >= std][:1] if std <= RADII[-1] else [np.inf]
        assert found == pytest.approx(max(min(40.0 / (100.0 * np.pi * radius**2), MOST), 1e-9))


def test_what_is_remembered_is_bounded_and_keeps_its_weight():
    rng, known, total = np.random.default_rng(7), Clutter(), 0.0
    for _ in range(30):
        z = rng.uniform(-500.0, 500.0, (700, 2))
        known, total = known.with_scan(z, np.full(700, 0.9), 0.1), total * np.exp(-0.01) + 560.0
    assert len(known.points) == len(known.weight) == MOST_REMEMBERED
    assert known.weight.sum() == pytest.approx(total, rel=1e-9)
    # Each stands for several, so a disc needs more than `IN_DISC` alone.
    assert known.weight.max() > 1.5
    places = rng.uniform(-300.0, 300.0, (200, 2))
    found = known.density_at(places, np.tile(np.eye(2), (200, 1, 1)))
    assert np.median(found) == pytest.approx(560e-6 * 30 / 35, rel=0.25)
    for _ in range(1000):
        known = known.with_scan(np.empty((0, 2)), np.empty(0))
    assert not len(known.points)


def test_false_fixes_in_a_clump_begin_no_track_for_long():
    """A pier returns two fixes a scan; a diver passes by, and another is in the open."""
    rng = np.random.default_rng(1)
    tracker, shown = DiverTracker(DiverConfig()), []
    for second in range(1, 121):
        z = rng.normal(scale=3.0, size=(rng.poisson(0.8), 2))
        divers = np.array([[0.6 * second - 36.0, 9.0], [0.6 * second - 36.0, 50.0]])
        z = np.concatenate([z, divers + rng.normal(scale=0.5, size=(2, 2))])
        (estimate,) = tracker.process(scan_of(second, z))
        firm = estimate.state[estimate.extras['track_state'] > 0, :2]
        own = [np.hypot(*(firm - diver).T).min(initial=9.0) < 2.0 for diver in divers]
        shown.append((*own, len(firm) - sum(own)))
    first, second, false = np.mean(shown[30:], axis=0)
    assert first > 0.95 and second > 0.95 and false < 0.1
    ((_, known),) = tracker._stream.state.memory['clutter'].by_sensor
    at = np.array([[0.0, 0.0], [0.0, 50.0], [40.0, -40.0]])
    density = known.density_at(at, np.tile(0.25 * np.eye(2), (3, 1, 1)))
    assert density[0] > 5.0 * density[1] == 5.0 * density[2] == 5.0 * known.density
    assert known.points.shape[0] < 400 and known.weight.sum() > IN_DISC


def test_new_targets_arrive_in_time():
    """Twice the time, twice the new targets; instruments and messages take nothing from others."""
    steady, looks = Clutters(), []
    for scan in range(1, 6):
        steady, elapsed = steady.with_look('a', scan * SECOND // 2)
        looks.append(elapsed)
    assert looks == [10.0, *[0.5] * 4]
    assert steady.with_look('a', 3 * SECOND)[1] == pytest.approx(0.5)
    assert steady.with_look('a', 90 * SECOND)[1] == 10.0
    assert steady.with_look('b', 90 * SECOND)[1] == 10.0
    same_stamp, elapsed = steady.with_look('a', 5 * SECOND // 2)
    assert elapsed == 0.5 and same_stamp == steady
    pairs, looks = Clutters(), []
    for scan in range(1, 60):
        for late in (0, 1_000_000):
            pairs, elapsed = pairs.with_look('a', scan * SECOND + late)
            looks.append(elapsed)
    assert min(looks[40:]) > 0.4 and 1.0 > looks[-2] > 0.99
    for name in range(50):
        pairs, _ = pairs.with_look(str(name), 70 * SECOND)
    assert len(pairs.looks) == 20
