# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracks that begin where somebody says that a diver is."""

import itertools

from attrs import evolve
from helpers import diver_runs
import numpy as np
import pytest

from sonar_imm.measurements import NOBODY, Start
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SECOND = 10**9
CONFIRMED, COASTING = 1, 2


def start(second, x, y=0.0, sigma=1.0):
    return Start(
        stamp_ns=round(second * SECOND),
        position=[x, y, 0.0],
        covariance=np.eye(2) * sigma**2,
        frame_id='map',
    )


def fix(second, x, y=0.0, name=NOBODY):
    return evolve(diver_runs.fix(second, x, y, 0.04 * np.eye(2)), target_id=name)


def run(measurements, **options):
    tracker = DiverTracker(DiverConfig(**options))
    newest = [tracker.process(item)[-1] for item in measurements][-1]
    return tracker, newest


@pytest.mark.parametrize(
    'options',
    [{}, {'association': 'jipda'}, {'association': 'gnn'}, {'dimensions': 3}, {'max_tracks': 1}],
)
def test_a_track_begins_confirmed_at_the_place_and_follows_the_fixes_after_it(options):
    tracker, first = run([start(1, 5.0, 7.0, sigma=2.0)], **options)
    assert first.extras['track_state'].tolist() == [CONFIRMED]
    assert first.xyz[0, :2] == pytest.approx([5.0, 7.0])
    assert first.covariance[0, :2, :2] == pytest.approx(np.eye(2) * 4.0)
    for second in range(2, 12):
        last = tracker.process(fix(second, 5.0 + 0.5 * second, 7.0))[-1]
    assert last.extras['track_id'].tolist() == [1]  # the start's own: no fix began another
    assert last.xyz[0, :2] == pytest.approx([10.5, 7.0], abs=0.5)


def test_without_a_start_the_same_fix_makes_a_tentative_track():
    _, first = run([fix(1, 5.0, 7.0)])
    assert first.extras['track_state'].tolist() == [0]


def test_the_track_that_is_there_gives_way_and_others_stay():
    walk = [fix(k, x) for k in range(1, 8) for x in (0.0, 50.0)]
    _, before = run(walk)
    _, after = run([*walk, start(7.5, 0.3)])
    assert before.extras['track_id'].tolist() == [1, 2]
    assert after.extras['track_id'].tolist() == [2, 3]
    assert after.xyz[:, 0] == pytest.approx([50.0, 0.3], abs=0.1)


def test_with_one_diver_the_start_is_where_it_is_however_far():
    walk = [fix(k, 0.0) for k in range(1, 8)]
    _, after = run([*walk, start(7.5, 300.0)], max_tracks=1)
    assert after.extras['track_id'].tolist() == [2]
    assert after.xyz[0, 0] == pytest.approx(300.0, abs=1e-9)
    _, several = run([*walk, start(7.5, 300.0)])
    assert several.extras['track_id'].tolist() == [1, 2]


def test_a_diver_that_has_a_name_keeps_its_track():
    walk = [fix(k, 0.0, name=4) for k in range(1, 8)]
    _, after = run([*walk, start(7.5, 0.1)])
    assert after.extras['target_id'].tolist() == [4, NOBODY]


def test_too_many_are_counted_and_said():
    tracker, last = run([start(1 + 0.1 * k, 100.0 * k) for k in range(5)], max_tracks=3)
    assert last.extras['track_id'].tolist() == [1, 2, 3]
    assert tracker.health()['not_started'] == 2
    assert tracker.warnings() == [
        '2 starts ignored: max_tracks (3) tracks are confirmed. Increase max_tracks'
    ]


def test_names_without_end_are_counted_and_said():
    """Each fix has a name of its own: a driver that numbers its fixes, not its targets."""
    tracker, last = run(
        [fix(1 + 0.01 * k, 100.0 * k, name=k + 1) for k in range(30)], max_tracks=3
    )
    assert len(last) == 25
    assert tracker.health()['names_without_track'] == 5
    (sentence,) = tracker.warnings()
    assert sentence.startswith('5 positions with a name of their own started no track')


def test_a_start_is_no_missed_detection():
    walk = [fix(k, 0.0) for k in range(1, 8)]
    _, after = run([*walk, *(start(7.5 + 0.01 * k, 500.0 + 50.0 * k) for k in range(12))])
    assert after.extras['track_state'][0] == CONFIRMED


def test_the_order_of_arrival_changes_nothing():
    items = [fix(1, 0.0), fix(2, 0.2), start(2, 30.0), start(2.5, 0.5), fix(3, 0.4), fix(3, 30.1)]
    _, expected = run(items)
    for order in itertools.islice(itertools.permutations(items), 0, 720, 79):
        tracker = DiverTracker(DiverConfig())
        for item in order:
            last = tracker.process(item)[-1]
        newest = [item for item in [last] if item.stamp_ns == 3 * SECOND]
        for item in newest:
            assert (item.state == expected.state).all()
            assert item.extras['track_id'].tolist() == expected.extras['track_id'].tolist()


def test_a_start_may_stand_in_a_smoothed_run():
    from sonar_imm.trackers import SYSTEMS

    smoother = SYSTEMS['diver'].build_smoother(DiverConfig())
    for item in [start(1, 0.0), *(fix(k, 0.5 * k) for k in range(2, 9)), start(9, 60.0)]:
        smoother.process(item)
    made = list(smoother.smoothed())
    assert [len(item) for item in made] == [1] * 8 + [2]
    assert all(np.isfinite(item.state).all() for item in made)
