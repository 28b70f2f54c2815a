# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scenes become bags: each class by its own writer, in the order of reception."""

from attrs import frozen
import numpy as np

from msg_adapters.estimates import read_estimate
from sonar_imm.measurements import Fix
from sonar_imm.truth import Received, Scene, TrueReflectors, TrueTrack, TruthTable
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.truth import records_of, write_scene

START_NS = 1_700_000_000_000_000_000


def fix(offset_ns):
    return Fix(stamp_ns=START_NS + offset_ns, position=(1.0, 2.0, 0.0), frame_id='map')


def logged(path):
    with BagReader(path) as bag:
        return [(item.topic, item.log_ns - START_NS) for item in bag.messages()]


def test_late_measurements_are_recorded_when_they_were_received(tmp_path):
    scene = Scene(
        (Received(START_NS + 9, fix(1)), Received(START_NS + 4, fix(3))),
        (TrueTrack(7, START_NS + np.array([2, 6]), np.zeros((2, 3)), np.ones((2, 2))),),
    )
    report = write_scene(scene, tmp_path / 'bag', provenance={})
    assert report.messages == {'/fix': 2, '/truth/estimate': 2}
    assert logged(tmp_path / 'bag') == [
        ('/truth/estimate', 2),
        ('/fix', 4),
        ('/truth/estimate', 6),
        ('/fix', 9),
    ]


def test_a_scene_may_know_other_truth_of_its_own(tmp_path):
    @frozen
    class Buoy:
        stamp_ns: int

        def tables(self, frame_id):
            yield TruthTable(self.stamp_ns, frame_id, {'x': np.zeros(1, np.float32)}, 'north')

    scene = Scene((Received(START_NS + 1, fix(0), 'south'),), (Buoy(START_NS + 2),))
    write_scene(scene, tmp_path / 'bag', provenance={})
    assert logged(tmp_path / 'bag') == [('/south/fix', 1), ('/truth/north/estimate', 2)]


def test_a_true_track_is_a_table_at_each_stamp():
    true = TrueTrack(
        9,
        np.array([5, 8]),
        np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
        np.array([[0.1, 0.2], [np.nan, np.nan]]),
    )
    first, second = records_of(true, 'map')
    assert [(stamp, topic) for stamp, topic, _ in (first, second)] == [
        (5, '/truth/estimate'),
        (8, '/truth/estimate'),
    ]
    names = 'x y z px py vx vy track_id'.split()
    assert [field.name for field in first[2].fields] == names
    truth = read_estimate(second[2])
    assert truth.frame_id == 'map' and truth.stamp_ns == 8
    assert truth.xyz.tolist() == [[4.0, 5.0, 6.0]]
    assert truth.extras['py'].tolist() == [5.0] and truth.extras['track_id'].tolist() == [9]
    assert read_estimate(first[2]).extras['vx'].tolist() == [0.1]
    assert np.isnan(truth.extras['vx']).all()


def test_true_reflectors_lie_below_and_may_be_none():
    true = TrueReflectors(5, 'array', np.array([3, 4]), np.array([10.0, 20.5]), np.ones(2))
    (record,) = records_of(true, 'elsewhere')
    truth = read_estimate(record[2])
    assert truth.frame_id == 'array' and truth.xyz[:, 2].tolist() == [-10.0, -20.5]
    assert truth.extras['depth'].tolist() == [10.0, 20.5]
    nothing = TrueReflectors(5, 'array', np.empty(0, int), np.empty(0), np.empty(0))
    assert len(read_estimate(records_of(nothing, '')[0][2])) == 0
