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

"""The density of false fixes, learnt from scans when nobody states it."""

from helpers.diver_runs import SECOND
from helpers.estimates import same
import numpy as np
import pytest

from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.clutter import Clutter, LEAST, MOST
from sonar_imm.trackers.diver.config import CLUTTER
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker


def scans(count, false, half, seed=11, divers=((0.0, 0.0), (0.0, 2.0)), aspect=1.0):
    """Divers who swim along x, seen with .9 to .5 m, and false fixes in a rectangle."""
    rng = np.random.default_rng(seed)
    found = []
    for second in range(1, count + 1):
        there = np.array(divers) + (0.7 * second - 0.35 * count, 0.0)
        there = there[rng.uniform(size=len(there)) < 0.9]
        wild = rng.uniform(-half, half, (rng.poisson(false), 2)) * (1.0, aspect)
        both = np.concatenate([there + rng.normal(scale=0.5, size=there.shape), wild])
        found.append(
            Fixes(
                stamp_ns=second * SECOND,
                position=np.column_stack([both, np.zeros(len(both))]),
                covariance=np.tile(0.25 * np.eye(2), (len(both), 1, 1)),
            )
        )
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
    tracker = DiverTracker(
        DiverConfig.from_mapping(
            {
                'association': 'jipda',
                'model_set': 'heading_speed',
                'directions': 4,
                'sensors': ['left', 'right'],
                'right.clutter_density': 3e-5,
            }
        )
    )
    for item in scans(10, 4.0, 40.0):
        for sensor, late in (('left', 0), ('right', 1), ('', 2)):
            tracker.process(
                Fixes(
                    stamp_ns=item.stamp_ns + late,
                    position=item.position,
                    covariance=item.covariance,
                    sensor=sensor,
                )
            )
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
