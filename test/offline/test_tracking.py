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

"""Offline runs: the last word on each stamp, refusals, order, smoothing."""

from helpers.dive_bags import write_dive
from helpers.dive_scenes import estimate_at, SECOND, START_NS
import numpy as np
import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.offline.tracking import final_estimates, InputOptions, OfflineRun, Revisions
from sonar_imm_tools.recordings.reader import BagError, BagReader

DIVER = SYSTEMS['diver']
CONFIG = DIVER.config_type()()


def made(seconds, x=0.0):
    return estimate_at(START_NS + round(seconds * SECOND), [[x, 0.0, 0.0, 0.0]], [1])


def seconds_and_px(estimates):
    return [
        ((estimate.stamp_ns - START_NS) / SECOND, estimate.state[0, 0]) for estimate in estimates
    ]


def test_the_last_word_on_a_stamp_wins_and_stamps_come_in_order():
    revisions = Revisions(10 * SECOND)
    final = revisions.add([made(1, 1.0)]) + revisions.add([made(3, 1.0)])
    final += revisions.add([made(2, 5.0), made(3, 2.0)])
    assert final == []
    assert seconds_and_px(revisions.finish()) == [(1, 1.0), (2, 5.0), (3, 2.0)]


def test_what_can_no_longer_change_is_let_go():
    revisions = Revisions(2 * SECOND)
    final = [seconds_and_px(revisions.add([made(k)])) for k in range(5)]
    assert final == [[], [], [], [(0, 0.0)], [(1, 0.0)]]


def test_memory_does_not_grow_with_the_recording():
    revisions = Revisions(2 * SECOND)
    for k in range(1000):
        revisions.add([made(k)])
    assert len(revisions.finish()) == 3


def test_a_restarted_clock_begins_anew_and_loses_nothing():
    revisions = Revisions(2 * SECOND)
    final = [item for k in (100, 101, 5, 6) for item in revisions.add([made(k)])]
    assert seconds_and_px([*final, *revisions.finish()]) == [
        (100, 0.0),
        (101, 0.0),
        (5, 0.0),
        (6, 0.0),
    ]


def test_order_by_stamp_makes_late_input_punctual(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', shuffle=True)) as bag:
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(order='stamp'))
        list(run.estimates())
    assert 'late' not in run.outcomes()


def test_refused_messages_are_counted_with_their_reason(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', spoilt=(3, 4))) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        advanced = []
        assert len(list(run.estimates(advanced.append))) == 118
    assert run.refused['nan'].count == 2
    assert run.refused['nan'].example.startswith('/fix: ')
    assert run.outcomes() == {'used': 118, 'refused': 2}
    assert not run.failure()
    assert sum(advanced) == run.total == run.messages == 120


def test_repaired_covariances_are_told_with_the_counts(tmp_path, monkeypatch):
    with BagReader(write_dive(tmp_path / 'dive')) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        list(run.estimates())
        assert 'covariance_repairs' not in run.outcomes()
        monkeypatch.setattr(run.tracker, 'health', lambda: {'covariance_repairs': 3})
        assert run.outcomes() == {'covariance_repairs': 3, 'used': 120}


def test_the_expected_frame_refuses_the_others(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive')) as bag:
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(frame_id='odom'))
        assert list(run.estimates()) == []
    assert run.refused['frame'].count == 120
    assert 'refused: 120 (frame: ' in run.failure()


def test_topics_can_be_named(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', topic='/usbl/pose')) as bag:
        with pytest.raises(BagError, match='no topic for the diver tracker'):
            OfflineRun(bag, DIVER, CONFIG)
        run = OfflineRun(bag, DIVER, CONFIG, InputOptions(topics={'/usbl/pose': 'fix'}))
        assert len(list(run.estimates())) == 120


def test_the_smoother_is_nearer_to_the_truth(tmp_path):
    from helpers.dive_scenes import legs

    errors = {}
    for smooth in (False, True):
        with BagReader(write_dive(tmp_path / f'dive{smooth}')) as bag:
            estimates = list(
                OfflineRun(bag, DIVER, CONFIG, InputOptions(smooth=smooth)).estimates()
            )
        rows = [estimate for estimate in estimates if len(estimate)]
        times = np.array([(row.stamp_ns - START_NS) / SECOND for row in rows])
        place = np.array([row.state[0, :2] for row in rows])
        truth = legs(np.arange(120) * 1.0)[np.rint(times).astype(int), :2]
        errors[smooth] = np.sqrt(np.mean(np.sum((place - truth) ** 2, axis=1)))
    assert errors[True] < 0.9 * errors[False]


def test_what_a_live_tracker_published_ends_as_the_offline_run(tmp_path):
    with BagReader(write_dive(tmp_path / 'dive', shuffle=True)) as bag:
        run = OfflineRun(bag, DIVER, CONFIG)
        offline = list(run.estimates())
        tracker, published = DIVER.build(CONFIG), []
        for measurement in OfflineRun(bag, DIVER, CONFIG)._measurements(lambda count: None):
            published += tracker.process(measurement)
    assert len(published) > len(offline)
    live = final_estimates(published, CONFIG)
    assert [item.stamp_ns for item in live] == [item.stamp_ns for item in offline]
    assert all((a.state == b.state).all() for a, b in zip(live, offline))
