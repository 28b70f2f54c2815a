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

import json

import numpy as np
import pytest

from msg_adapters.estimates import read_estimate
from sonar_imm_tools.recordings.convert import convert_autoferry
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError


def record(time, measurement, sensor=2, own_ship=(100.0, 200.0)):
    return {
        'sensorID': sensor,
        'time': time,
        'measurement': measurement,
        'ownshipPosition': list(own_ship),
        'measurements': [],
    }


@pytest.fixture
def convert(tmp_path):
    def run(records, truth=None, **options):
        (tmp_path / 'in.json').write_text(json.dumps(records))
        if truth is not None:
            (tmp_path / 'truth.json').write_text(json.dumps(truth))
            options['truth'] = tmp_path / 'truth.json'
        return convert_autoferry(tmp_path / 'in.json', tmp_path / 'out', **options)

    return run


def fixes_of(path):
    with BagReader(path) as bag:
        return [item.measurement for item in measurements_of(bag, 'diver')]


def test_detections_become_fixes_in_the_world_east_first(convert):
    report = convert(
        [
            record(9.0, [5.0, -6.0]),
            record(3.0, [[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]]),
            record(4.0, []),
            record(5.0, [0.1, 0.2, 0.3], sensor=4),
        ],
        std=2.0,
    )
    scans = fixes_of(report.path)
    assert [(scan.stamp_ns // 10**9, len(scan)) for scan in scans] == [(3, 3), (4, 0), (9, 1)]
    assert np.concatenate([scan.position for scan in scans]).tolist() == [
        [210.0, 101.0, 0.0],
        [220.0, 102.0, 0.0],
        [230.0, 103.0, 0.0],
        [194.0, 105.0, 0.0],
    ]
    assert scans[0].covariance[0, :2, :2].tolist() == [[4.0, 0.0], [0.0, 4.0]]
    assert 'boats' in report.notes['targets'] and not report.bad_rows


def test_sensors_are_chosen(convert):
    records = [record(3.0, [1.0, 2.0], sensor=1), record(4.0, [1.0, 2.0], sensor=2)]
    assert [fix.stamp_ns for fix in fixes_of(convert(records, sensors=('lidar',)).path)] == [
        3 * 10**9
    ]
    with pytest.raises(BagError, match="no sensor 'sonar'"):
        convert(records, sensors=('sonar',))


def test_two_sensors_have_a_topic_each_with_their_empty_scans(convert):
    records = [record(1.0, [[1.0], [2.0]]), record(1.5, [], sensor=1), record(2.0, [], sensor=2)]
    report = convert(records, sensors=('radar', 'lidar'), time_offset_ns=-500_000_000)
    assert report.messages == {'/radar/fixes': 2, '/lidar/fixes': 1}
    scans = fixes_of(report.path)
    assert [scan.stamp_ns for scan in scans] == [500_000_000, 1_000_000_000, 1_500_000_000]
    assert [len(scan) for scan in scans] == [1, 0, 0]


def test_each_sensor_may_be_late_by_itself(convert):
    records = [record(2.0, [[1.0], [2.0]]), record(2.0, [[1.0], [2.0]], sensor=1)]
    report = convert(records, sensors=('radar', 'lidar'), time_offset_ns={'radar': -1_500_000_000})
    stamps = sorted(fix.stamp_ns for fix in fixes_of(report.path))
    assert stamps == [500_000_000, 2_000_000_000]


def test_late_stamps_are_moved_and_truth_is_not(convert):
    truth = [[{'targetID': 1, 'position': [0.0, 0.0, 0.0], 'time': 3.0}]]
    report = convert([record(3.0, [1.0, 2.0])], truth, time_offset_ns=-1_500_000_000)
    assert [scan.stamp_ns for scan in fixes_of(report.path)] == [1_500_000_000]
    with BagReader(report.path) as bag:
        (table,) = (read_estimate(item.message) for item in bag.messages(['/truth/estimate']))
    assert table.stamp_ns == 3 * 10**9


@pytest.mark.parametrize(
    'bad',
    [
        {},
        [],
        5,
        None,
        record('x', [1.0, 2.0]),
        record(float('nan'), [1.0, 2.0]),
        record(1e12, [1.0, 2.0]),
        record(3.0, [1.0, 2.0, 3.0]),
        record(3.0, [[1.0], [2.0], [3.0]]),
        record(3.0, [[1.0, 2.0], [3.0]]),
        record(3.0, 'text'),
        record(3.0, [1.0, float('nan')]),
        record(3.0, [1.0, 2.0], own_ship=(1.0,)),
        record(3.0, {'a': 1}),
    ],
)
def test_bad_records_are_named(convert, bad):
    report = convert([record(3.0, [1.0, 2.0]), bad])
    assert report.messages == {'/fixes': 1} and report.bad_rows == 1
    assert report.problems[0].startswith('in.json, record 1: ')


def test_truth_has_one_track_a_target_each_with_its_own_times(convert):
    truth = [
        [
            {'targetID': 1, 'position': [0.0, 0.0, 5.0], 'time': 3.0},
            {'targetID': 2, 'position': [7.0, 8.0, 0.0], 'time': 3.5},
        ],
        [{'targetID': 1, 'position': [0.0, 0.0, 5.0], 'time': 3.0}],
        [{'targetID': 1, 'position': [4.0, 2.0, 5.0], 'time': 5.0}],
        [{'targetID': 1}],
    ]
    report = convert([record(3.0, [1.0, 2.0])], truth)
    with BagReader(report.path) as bag:
        tables = [read_estimate(item.message) for item in bag.messages(['/truth/estimate'])]
    assert [(table.stamp_ns, table.extras['track_id'][0]) for table in tables] == [
        (3 * 10**9, 1),
        (3_500_000_000, 2),
        (5 * 10**9, 1),
    ]
    assert tables[2].xyz[0].tolist() == [2.0, 4.0, -5.0]
    assert [tables[0].extras[name][0] for name in ('vx', 'vy')] == [1.0, 2.0]
    assert report.bad_rows == 1 and 'truth.json, record 3' in report.problems[0]


@pytest.mark.parametrize('content', [b'', b'{"a": 1}', b'[', b'\xff\xfe', b'[' * 100_000])
def test_files_of_another_kind_are_one_sentence(tmp_path, content):
    (tmp_path / 'in.json').write_bytes(content)
    with pytest.raises(BagError) as caught:
        convert_autoferry(tmp_path / 'in.json', tmp_path / 'out')
    assert '\n' not in caught.value.sentence
    with pytest.raises(BagError, match='cannot be read'):
        convert_autoferry(tmp_path / 'no.json', tmp_path / 'out')


def test_the_real_scenario_lies_around_its_truth(real_data, tmp_path):
    folder = real_data / 'autoferry'
    report = convert_autoferry(
        folder / 'scenario13_detections.json',
        tmp_path / 'bag',
        truth=folder / 'scenario13_groundTruth.json',
    )
    assert report.bad_rows == 0 and report.messages['/truth/estimate'] == 1152 + 575
    scans = fixes_of(report.path)
    with BagReader(report.path) as bag:
        tables = [read_estimate(item.message) for item in bag.messages(['/truth/estimate'])]
    near = {}
    for track_id in (1, 2):
        track = [table for table in tables if table.extras['track_id'][0] == track_id]
        stamp = [table.stamp_ns for table in track]
        place = np.array([[table.extras['px'][0], table.extras['py'][0]] for table in track])
        distance = [
            np.hypot(
                *(
                    position[:2]
                    - [np.interp(scan.stamp_ns, stamp, place[:, axis]) for axis in (0, 1)]
                )
            )
            for scan in scans
            for position in scan.position
        ]
        near[track_id] = np.sum(np.array(distance) < 15.0)
    filled = sum(len(scan) > 0 for scan in scans)
    assert filled == 68 and len(distance) > 2 * filled  # clutter besides the boats
    assert len(scans) > filled  # some scans saw nothing
    assert min(near.values()) > 0.6 * filled
