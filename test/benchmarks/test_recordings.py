# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The recordings of others that only the studies read."""

import numpy as np
import pytest

from benchmarks.recordings import autoferry, scans_of, truth_of
from benchmarks.study import DATA


def record(time, measurement, sensor=2):
    return {
        'sensorID': sensor,
        'time': time,
        'measurement': measurement,
        'ownshipPosition': [100.0, 200.0],
    }


def test_detections_become_scans_east_first():
    records = [
        record(9.0, [5.0, -6.0]),
        record(3.0, [[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]]),
        record(4.0, []),
        record(5.0, [0.1, 0.2, 0.3], sensor=4),
    ]
    scans = scans_of(records, 'radar', -1_500_000_000)
    assert [(scan.stamp_ns, len(scan)) for scan in scans] == [
        (1_500_000_000, 3),
        (2_500_000_000, 0),
        (7_500_000_000, 1),
    ]
    assert np.concatenate([scan.position for scan in scans]).tolist() == [
        [210.0, 101.0, 0.0],
        [220.0, 102.0, 0.0],
        [230.0, 103.0, 0.0],
        [194.0, 105.0, 0.0],
    ]
    assert not scans_of(records, 'lidar')


def test_truth_is_sorted_and_told_once():
    groups = [
        [
            {'targetID': 2, 'position': [7.0, 8.0, 0.0], 'time': 3.5},
            {'targetID': 1, 'position': [1.0, 2.0, 5.0], 'time': 3.0},
        ],
        [{'targetID': 1, 'position': [1.0, 2.0, 5.0], 'time': 3.0}],
    ]
    assert truth_of(groups) == pytest.approx(
        np.array([[3.0, 1.0, 2.0, 1.0], [3.5, 2.0, 8.0, 7.0]])
    )


@pytest.mark.skipif(
    not DATA.is_dir(), reason='no real recordings here; SONAR_IMM_DATA names their folder'
)
def test_the_real_scenario_lies_around_its_truth():
    scans, truth = autoferry('radar')
    assert len(truth) == 1152 + 575
    filled = sum(len(scan) > 0 for scan in scans)
    assert filled == 68 and len(scans) > filled  # some scans saw nothing
    assert sum(map(len, scans)) > 2 * filled  # clutter besides the boats
    for number in (1, 2):
        path = truth[truth[:, 1] == number]
        near = [
            np.hypot(*(place[:2] - [np.interp(stamp, path[:, 0], path[:, c]) for c in (2, 3)]))
            for scan in scans
            for stamp, place in ((scan.stamp_ns * 1e-9, place) for place in scan.position)
        ]
        assert np.sum(np.array(near) < 15.0) > 0.6 * filled
