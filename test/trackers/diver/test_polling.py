# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sensors that look at several targets in turn, and what the tracker says of them."""

from attrs import evolve
from helpers.diver_runs import fix, run
import numpy as np
import pytest

from sonar_imm.trackers.diver.polling import BEFORE, MOST_FIXES, turn_of
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SETTINGS = {'directions': 4, 'covariance_scales': (1.0,)}


def in_turn(paths, rate, missing=0.1, std=0.3, count=120, seed=0):
    """Fixes of targets one after the other; paths: (place at a time) of each."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        when = 5.0 + k / rate
        place = paths[k % len(paths)](when) + std * rng.normal(size=2)
        if rng.uniform() > missing:
            yield fix(when, *place, std**2 * np.eye(2))


def circle(t, phase, x=0.0):
    return np.array([x + 8.0 * np.cos(t / 12 + phase), 8.0 * np.sin(t / 12 + phase)])


def said(items, **settings):
    tracker = DiverTracker(DiverConfig(**SETTINGS, **settings))
    run(tracker, list(items))
    return tracker, tracker.warnings()


@pytest.mark.parametrize('targets, rate', [(4, 4.0), (3, 1.0), (2, 0.5)])
def test_the_advice_once_followed_ends_the_sentence(targets, rate):
    paths = [lambda t, k=k: circle(t, 1.6 * k, 30.0 * k) for k in range(targets)]
    items = list(in_turn(paths, rate))
    tracker, sentences = said(items)
    (sentence,) = sentences  # of tracks that starve, the fixes tell nothing else
    period = targets / rate
    assert f'Set scan_period to {period:.3g}' in sentence and 'covariance' not in sentence
    assert len(tracker._stream.state.memory['single'].stamps) <= MOST_FIXES
    assert not any('scan_period' in text for text in said(items, scan_period=period)[1])
    assert not any('scan_period' in text for text in said(items, scan_period=-1.0)[1])


def test_names_scans_and_single_targets_are_not_polled():
    one = list(in_turn([lambda t: circle(t, 0.0)], 1.0))
    paths = [lambda t, k=k: circle(t, 1.6 * k, 12.0 * k) for k in range(3)]
    named = [evolve(item, target_id=k % 3) for k, item in enumerate(in_turn(paths, 3.0, 0.0))]
    together = [fix(5.0 + k, *circle(k, 2.0 * d)) for k in range(100) for d in range(2)]
    for items in (one, named, together):
        assert not any('scan_period' in text for text in said(items)[1])


@pytest.mark.parametrize('missing', [0.0, 0.1])
@pytest.mark.parametrize('offset', [6.0, 30.0])
def test_two_at_a_constant_offset_are_two_targets_or_two_sensors(offset, missing):
    """They take turns as two targets would: which it is cannot be known, so both are said."""
    paths = [lambda t: circle(t, 0.0), lambda t: circle(t, 0.0) + (offset, 1.0)]
    (sentence,) = said(in_turn(paths, 1.0, missing))[1]
    assert 'two groups of fixes' in sentence and 'offset' in sentence
    assert 'set scan_period to 2' in sentence and 'covariance' not in sentence
    far = float(sentence.partition(' m apart')[0].split()[-1])
    assert far == pytest.approx(np.hypot(offset, 1.0), abs=0.5)


@pytest.mark.parametrize('offset, std', [(3.0, 1.0), (6.0, 0.5)])
def test_a_constant_offset_is_no_second_target_in_any_stretch(offset, std):
    t, rng = np.arange(300.0), np.random.default_rng(4)
    way = np.column_stack([25.0 * np.sin(t / 50.0) + 0.1 * t, 15.0 * np.cos(t / 35.0)])
    places = way + np.outer(t % 2, (offset, 0.0)) + std * rng.normal(size=way.shape)
    stamps = (t * 1e9).astype(np.int64)
    for end in range(2 * BEFORE, 300, 10):
        last = slice(max(0, end - MOST_FIXES), end)
        turn = turn_of(stamps[last], places[last])
        assert turn is None or turn.offset == pytest.approx(offset, abs=1.0)
    # A second target goes his own way.
    other = places + np.outer(t % 2, (8.0, 0.15)) * np.column_stack([np.ones(300), t])
    turn = turn_of(stamps[:MOST_FIXES], other[:MOST_FIXES])
    assert turn.seconds == pytest.approx(2.0) and turn.offset is None
