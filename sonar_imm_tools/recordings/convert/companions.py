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

"""Inputs that a tracker needs beside what is converted, such as navigation: copied over."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msg_adapters.inputs import InputTopic

from ..messages import ros_message
from ..reader import BagReader


def companion_topics(bag: BagReader, wanted: Mapping[str, InputTopic]) -> dict[str, str]:
    """Input name by topic: the first topic of `bag` of each kind in `wanted`."""
    chosen = {}
    for name, entry in wanted.items():
        fitting = [topic.name for topic in bag.topics if topic.type_name in entry.readers]
        if fitting:
            chosen[fitting[0]] = name
    return chosen


def copied(entry: InputTopic, type_name: str, message: Any) -> Any:
    """The message of a bag as our own. Raises `Rejection`."""
    # A frame that calls itself NED is turned into ENU; others stay as they are, and whoever tracks
    # the new bag states their convention.
    ned = str(message.header.frame_id).endswith('_ned')
    measurement = entry.readers[type_name](message, world_frame='ned' if ned else 'enu')
    return entry.write(measurement, ros_message)
