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

"""What is shown of recordings: order, jumps, definitions, what cannot be shown."""

import pytest

from sonar_imm.recordings.messages import ros_message
from sonar_imm.recordings.reader import BagError
from sonar_imm.recordings.writer import BagWriter
from sonar_imm.viewing.material import Material

START = 10**18


def text(value):
    return ros_message('std_msgs/msg/String', data=value)


@pytest.fixture
def bags(tmp_path):
    """Two recordings; the topic /both is in each."""
    written = {
        'one': [('/a', 'a0', 0), ('/both', 'one', 1), ('/a', 'a4', 4)],
        'two': [('/b', 'b2', 2), ('/both', 'two', 3), ('/b', 'b6', 6)],
    }
    for name, messages in written.items():
        with BagWriter(tmp_path / name) as writer:
            for topic, value, seconds in messages:
                writer.write(topic, text(value), START + seconds * 10**9)
    return [tmp_path / name for name in written]


def shown(material, seconds=None):
    from_ns = None if seconds is None else START + round(seconds * 1e9)
    return [
        (one.topic, (one.log_ns - START) // 10**9, one.raw[8:-1].decode())
        for one in material.messages(from_ns)
    ]


ALL = [('/a', 0, 'a0'), ('/both', 1, 'one'), ('/b', 2, 'b2'), ('/a', 4, 'a4'), ('/b', 6, 'b6')]


def test_recordings_are_merged_and_of_a_topic_the_first_counts(bags):
    with Material(bags) as material:
        assert shown(material) == ALL
        assert shown(material) == ALL  # again from the start
        assert (material.first_ns, material.last_ns) == (START, START + 6 * 10**9)
        assert material.problems == []


def test_a_jump_begins_with_the_newest_of_each_topic(bags):
    with Material(bags) as material:
        assert shown(material, 3.5) == [ALL[0], ALL[1], ALL[2], *ALL[3:]]
        assert shown(material, 5) == [ALL[1], ALL[2], ALL[3], ALL[4]]
        assert shown(material, 99) == [ALL[1], ALL[3], ALL[4]]


def test_channels_have_the_whole_definition(bags):
    with Material(bags, ['/b']) as material:
        (channel,) = material.channels.values()
        assert (channel.topic, channel.type_name) == ('/b', 'std_msgs/msg/String')
        assert channel.definition.split() == ['string', 'data']
        assert shown(material) == [ALL[2], ALL[4]]


@pytest.mark.parametrize('topics', [['/nowhere'], ['/a', '/nowhere']])
def test_a_topic_that_is_not_there_is_said(bags, topics):
    with pytest.raises(BagError, match="no topic '/nowhere'"), Material(bags, topics):
        pass


def test_a_recording_without_a_message_is_said(tmp_path):
    with BagWriter(tmp_path / 'empty'):
        pass
    with pytest.raises(BagError, match='nothing to show'), Material([tmp_path / 'empty']):
        pass
