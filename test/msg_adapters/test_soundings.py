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

import numpy as np
import pytest

from msg_adapters.soundings import read_soundings, write_soundings
from msg_adapters.table import encode_table
from sonar_imm.estimates import PLACES
from sonar_imm.measurements import Rejection
from sonar_imm.soundings import COLUMNS, LATER, Soundings
from sonar_imm_tools.recordings.messages import ros_message


def soundings(n=4):
    rng = np.random.default_rng(1)
    columns = {name: (10 * rng.random(n)).astype(kind) for name, kind in COLUMNS.items()}
    return Soundings(1_700_000_000_000_000_001, 'map', columns)


def test_what_is_written_reads_back_bit_for_bit():
    points = soundings()
    again = read_soundings(write_soundings(points, ros_message))
    assert (again.stamp_ns, again.frame_id) == (points.stamp_ns, points.frame_id)
    for name, column in points.columns.items():
        assert (again.columns[name] == column).all() and again.columns[name].dtype == column.dtype


def test_the_layout_is_what_cube_expects():
    """The CUBE node walks through the fields as four-byte floats, x y z first, nothing NaN."""
    message = write_soundings(soundings(), ros_message)
    names = [field.name for field in message.fields]
    assert names[:7] == [
        'x',
        'y',
        'z',
        'vertical_uncertainty',
        'horizontal_uncertainty',
        'intensity',
        'beam_angle',
    ]
    assert all(field.datatype == 7 and field.count == 1 for field in message.fields[:7])
    assert [field.offset for field in message.fields[:7]] == [0, 4, 8, 12, 16, 20, 24]
    assert message.is_dense and message.height == 1


def test_the_topic_reads_back_with_the_reader_of_ros():
    point_cloud2 = pytest.importorskip('sensor_msgs_py.point_cloud2')
    messages = pytest.importorskip('sonar_imm.nodes.messages')
    points = soundings()
    table = point_cloud2.read_points(write_soundings(points, messages.make), skip_nans=True)
    for name, column in points.columns.items():
        assert (table[name] == column).all()


def test_older_soundings_without_exact_places_and_surfaces_are_read():
    points = soundings()
    later = (*PLACES, *LATER)
    older = {name: column for name, column in points.columns.items() if name not in later}
    again = read_soundings(encode_table(older, stamp_ns=1, frame_id='map', make=ros_message))
    assert list(again.columns) == list(COLUMNS) and again.columns['py'].dtype == np.float64
    assert (again.columns['py'] == points.columns['y']).all()
    assert (again.columns['surface'] == 1).all() and (again.columns['existence'] == 0.0).all()


def test_no_soundings_are_a_message_too():
    assert len(read_soundings(write_soundings(soundings(0), ros_message))) == 0


@pytest.mark.parametrize('broken', ['missing', 'double'])
def test_other_tables_are_refused_by_one_sentence(broken):
    columns = dict(soundings().columns)
    if broken == 'missing':
        del columns['vertical_uncertainty']
    else:
        columns['z'] = columns['z'].astype(np.float64)
    message = encode_table(columns, stamp_ns=1, frame_id='map', make=ros_message)
    with pytest.raises(Rejection):
        read_soundings(message)
