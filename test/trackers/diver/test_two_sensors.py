# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two sensors that disagree, by name or as one."""

from helpers.diver_runs import fix
import numpy as np
import pytest

from benchmarks.diver_field import fixes_of, SINGLE
from sonar_imm.trackers.diver.disagreement import two_places
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker


def way(t):
    return np.array([20.0 * np.cos(0.03 * t), 20.0 * np.sin(0.03 * t)])


def fixes(count, offset, std, second=lambda k: k % 2 == 1, seed=0):
    """Fixes of a diver, one a second; `second` tells which are `offset` off."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        place = way(float(k)) + std * rng.normal(size=2)
        if second(k):
            place = place + offset
        yield fix(1.0 + k, *place, std**2 * np.eye(2))


def followed(items, **settings):
    """NEES (n,) of the position from the thirtieth fix on, the estimates and the tracker."""
    tracker = DiverTracker(DiverConfig(max_tracks=1, **settings))
    made = [tracker.process(item)[-1] for item in items]
    nees = []
    for k, each in enumerate(made[30:], start=30):
        error = each.state[0, :2] - way(float(k))
        nees.append(error @ np.linalg.solve(each.covariance[0, :2, :2], error))
    return np.array(nees), made, tracker


@pytest.mark.parametrize(
    'offset, std, settings',
    [
        ((6.0, 8.0), 0.3, {}),
        ((1.8, 2.4), 0.3, {}),
        ((-6.0, 0.0), 1.0, {'association': 'gnn'}),
        ((60.0, 80.0), 1.0, {}),
    ],
    ids=['10 m', '3 m', '6 m', '100 m'],
)
def test_both_places_are_held_and_said(offset, std, settings):
    nees, made, tracker = followed(fixes(90, offset, std), **settings)
    assert nees.mean() < 3.0 and np.mean(nees < 5.99) > 0.85
    # The ellipse is long along the offset only.
    far, P = np.hypot(*offset), made[-1].covariance[0, :2, :2]
    along = np.array(offset) / far
    across = np.array([-along[1], along[0]])
    assert np.sqrt(along @ P @ along) == pytest.approx(0.5 * far, rel=0.2)
    assert across @ P @ across < std**2
    (sentence,) = tracker.warnings()
    assert sentence.startswith('fixes fall in two groups') and 'two sensors' in sentence
    said = [float(word) for word in sentence.replace('(', ' ').split() if _is_number(word)]
    assert said[0] == pytest.approx(far, rel=0.1)
    assert {tuple(each.extras['track_id']) for each in made[30:]} == {(1,)}


def _is_number(word):
    return word.replace('.', '').replace('-', '').replace('e+', '').isdigit()


def test_a_place_without_fixes_is_given_up():
    stops = 50
    items = fixes(100, (0.0, 8.0), 0.5, lambda k: k % 2 == 1 and k < stops)
    _, made, tracker = followed(items)
    assert made[stops - 1].covariance[0, 1, 1] > 9.0
    assert made[-1].covariance[0, 1, 1] < 1.0
    assert np.hypot(*(made[-1].state[0, :2] - way(99.0))) < 1.5
    assert not tracker.warnings()


@pytest.mark.parametrize(
    'scene, seed, due',
    [
        # A row with an offset and hardly any weight is there first.
        ('diver, unnamed, 10 m', 701, 'two groups'),
        ('diver, b 3 m off', 602, '3 m apart'),
        ('rov, b 3 m off', 600, '3 m apart'),
        ('boat, b 2 s late', 600, '2 s late'),
        ('boat, two sensors', 600, ''),
    ],
)
def test_an_offset_or_a_delay_is_said_and_nothing_else(scene, seed, due):
    items, truth = fixes_of(SINGLE[scene], seed)
    tracker, nees = DiverTracker(DiverConfig(target=SINGLE[scene].target, max_tracks=1)), []
    for item, place in zip(items[:140], truth):
        last = tracker.process(item)[-1]
        if len(last.state):
            error = last.state[0, :2] - place
            nees.append(error @ np.linalg.solve(last.covariance[0, :2, :2], error))
    assert np.mean(nees[50:]) < 4.0
    said = tracker.warnings()
    assert len(said) == bool(due) and all(due in text for text in said)
    # Scales that stood for the offset at first are left.
    rows = tracker._stream.state.rows
    assert (rows.key['scale'][rows.logw.argmax(), :2] <= 1.0).all()


def test_one_place_is_not_two():
    rng = np.random.default_rng(0)
    v = rng.normal(size=(4, 16, 2))
    v[1, ::2] += [8.0, 6.0]  # in turns
    v[2, 8:] += [8.0, 6.0]  # it moved
    v[3, ::5] += 30.0 * rng.normal(size=(4, 2))  # outliers
    distance, std = two_places(v)
    assert distance[1] == pytest.approx(10.0, abs=1.0) and std[1] < 2.0
    assert (distance[[0, 2, 3]] < 4.5 * std[[0, 2, 3]]).all()
    v[1, 0] = np.nan
    assert two_places(v)[0][1] == 0.0
