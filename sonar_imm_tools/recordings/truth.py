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

"""Truth as messages, below the topic ``/truth``."""

from __future__ import annotations

from msg_adapters.table import encode_table
from sonar_imm.truth import Truth

from .conversion import Record
from .messages import ros_message

TRUTH_TOPIC = '/truth/estimate'


def records_of(true: Truth, frame_id: str) -> list[Record]:
    """The messages of a truth; `frame_id` is for one without a frame of its own."""
    prefix, _, name = TRUTH_TOPIC.rpartition('/')
    return [
        (
            table.stamp_ns,
            prefix + namespaced(table.namespace, f'/{name}'),
            encode_table(
                table.columns, stamp_ns=table.stamp_ns, frame_id=table.frame_id, make=ros_message
            ),
        )
        for table in true.tables(frame_id)
    ]


def namespaced(namespace: str, topic: str) -> str:
    return f'/{namespace}{topic}' if namespace else topic
