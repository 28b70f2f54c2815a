# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Writing recordings, and the messages of rosbags."""

import filecmp

import numpy as np
import pytest

from sonar_imm_tools.recordings.messages import decode_cdr, ros_message, typestore
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.writer import BagWriter


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_same_input_gives_the_same_bytes_of_every_file(tmp_path, write_fixes, storage):
    first = write_fixes(name='one/bag', storage=storage, custom_data={'b': '2', 'a': '1'})
    second = write_fixes(name='two/bag', storage=storage, custom_data={'a': '1', 'b': '2'})
    names = sorted(file.name for file in first.iterdir())
    assert 'metadata.yaml' in names and len(names) == 2
    assert filecmp.cmpfiles(first, second, names, shallow=False) == (names, [], [])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_what_is_written_is_read(write_fixes, storage):
    with BagReader(write_fixes(7, storage=storage, custom_data={'source': 'x.csv'})) as bag:
        assert [(topic.name, topic.count) for topic in bag.topics] == [('/fix', 7)]
        assert bag.custom_data == {'source': 'x.csv'} and not bag.problems
        assert [item.message.pose.pose.position.x for item in bag.messages()] == list(range(7))


def test_a_compressed_bag_is_smaller_and_says_the_same(write_fixes):
    plain, packed = (
        write_fixes(200, name='plain'),
        write_fixes(200, name='packed', compressed=True),
    )

    def content(path):
        with BagReader(path) as bag:
            assert not bag.problems
            return [
                (message.topic, message.log_ns, bytes(message.raw)) for message in bag.messages()
            ]

    assert content(plain) == content(packed) and len(content(plain)) == 200
    sizes = [(path / f'{path.name}.mcap').stat().st_size for path in (plain, packed)]
    assert sizes[1] < 0.6 * sizes[0]


def test_the_metadata_are_of_version_8_with_the_offered_qos(write_fixes):
    path = write_fixes(1)
    text = (path / 'metadata.yaml').read_text()
    assert 'version: 8' in text
    with BagReader(path) as bag:
        (profile,) = bag.topics[0].offered_qos
        assert profile.reliability.name == 'RELIABLE' and profile.depth == 10


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_bag_is_there_as_a_whole_or_not_at_all(tmp_path, fix_message, storage):
    values = {'diver': {'detection_probability': 0.8}}
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / 'bag', storage=storage) as bag:
        bag.write('/fix', fix_message(0), 5)
        raise KeyboardInterrupt
    assert not any(tmp_path.iterdir())
    with BagWriter(tmp_path / 'bag', storage=storage, parameters=values) as bag:
        bag.write('/fix', fix_message(0), 5)
        assert not (tmp_path / 'bag').exists()
    assert (tmp_path / 'bag' / 'parameters.yaml').is_file()
    assert [path.name for path in tmp_path.iterdir()] == ['bag']
    with BagReader(tmp_path / 'bag') as bag:
        assert len(list(bag.messages())) == 1 and not bag.problems


def test_an_existing_target_is_left_alone(write_fixes, tmp_path):
    path = write_fixes(3)
    with pytest.raises(BagError, match='exists already'):
        BagWriter(path)
    with BagReader(path) as bag:
        assert bag.topics[0].count == 3
    (tmp_path / 'file').write_text('x')
    with pytest.raises(BagError, match='cannot be written|exists'):
        BagWriter(tmp_path / 'file' / 'bag')


def test_an_empty_bag_is_a_bag(tmp_path):
    with BagWriter(tmp_path / 'bag'):
        pass
    with BagReader(tmp_path / 'bag') as bag:
        assert bag.topics == [] and list(bag.messages()) == [] and not bag.problems


def test_programming_errors_are_told(tmp_path, fix_message):
    with pytest.raises(ValueError, match='mcap, sqlite3'):
        BagWriter(tmp_path / 'bag', storage='zip')
    with BagWriter(tmp_path / 'bag') as bag, pytest.raises(ValueError, match='log time'):
        bag.write('/fix', fix_message(0), -1)


def test_every_common_message_can_be_made_empty_and_survives_cdr():
    for name in typestore().types:
        if '/msg/' not in name:
            continue
        message = ros_message(name)
        raw = bytes(typestore().serialize_cdr(message, name))
        again = decode_cdr(typestore(), name, raw)
        assert bytes(typestore().serialize_cdr(again, name)) == raw, name


def test_fields_are_cast_strictly():
    message = ros_message(
        'sensor_msgs/msg/JointState', name=('a',), position=[1, 2], velocity=np.float32([0.5])
    )
    assert message.position.dtype == np.float64 and message.velocity.dtype == np.float64
    cloud = ros_message('sensor_msgs/msg/PointCloud2', data=b'\x01\x02', height=np.int64(3))
    assert cloud.data.tolist() == [1, 2] and type(cloud.height) is int
    pose = ros_message('geometry_msgs/msg/PoseWithCovariance', covariance=np.eye(6))
    assert pose.covariance.shape == (36,)


def test_an_unknown_field_is_named():
    with pytest.raises(TypeError, match='sek'):
        ros_message('builtin_interfaces/msg/Time', sek=1)


def test_spare_alignment_bytes_are_no_damage_but_damage_is():
    name = 'sensor_msgs/msg/JointState'
    raw = bytes(typestore().serialize_cdr(ros_message(name, position=[2.5]), name))
    for spare in (0, 4, 8, 12):
        assert decode_cdr(typestore(), name, raw + bytes(spare)).position.tolist() == [2.5]
    with pytest.raises(Exception, match='size mismatch'):
        decode_cdr(typestore(), name, raw + bytes(100))
    with pytest.raises(Exception, match='JointState'):
        decode_cdr(typestore(), name, raw[:20])
