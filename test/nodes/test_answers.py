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

"""The row on ~/processed."""

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from msg_adapters.table import decode_table
from sonar_imm.nodes.outputs import ProcessedPublisher


class Sent:
    """A publisher that keeps what it is given."""

    def __init__(self):
        self.messages = []
        self.msg_type = PointCloud2

    def publish(self, message):
        if isinstance(message, bytes):
            message = deserialize_message(message, PointCloud2)
        self.messages.append(decode_table(message))


def test_counts_beyond_32_bits_do_not_wrap():
    sent = Sent()
    answers = ProcessedPublisher(sent)
    for messages in (1, 2**32 + 7, 2**53 - 1):
        answers.publish({'messages': messages, 'refused': 0, 'estimates': messages - 1})
        assert int(sent.messages[-1]['messages'][0]) == messages
        assert int(sent.messages[-1]['estimates'][0]) == messages - 1
