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

"""Whose a measurement is, and which sensor has made it, by the name of its topic or its frame.

A user lists the names (parameters `tags` and `sensors`). A name counts where it is a whole part of
the topic, ``/divers/bob/fix``, or the frame of the message. Tags become numbers, as `target_id`
has them: their own where all of them are whole numbers, else their place in the list from 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from attrs import evolve, fields_dict, frozen


def tag_numbers(names: Sequence[str]) -> dict[str, int]:
    """The number of each name."""
    distinct = list(dict.fromkeys(names))
    if distinct and all(name.isdecimal() and int(name) < 2**31 for name in distinct):
        return {name: int(name) for name in distinct}
    return {name: number for number, name in enumerate(distinct, start=1)}


@frozen
class Labels:
    """Labels measurements of one topic. parts: of its name; tags: numbers by name; sensors: names;
    map_frame: the frame of a measurement whose own frame was the name of its tag or sensor."""

    parts: frozenset[str]
    tags: Mapping[str, int]
    sensors: tuple[str, ...]
    map_frame: str

    @classmethod
    def of(
        cls, topic: str, settings: Mapping[str, Any], named_by: Sequence[str]
    ) -> Callable[[Any], Any] | None:
        """The labels of a topic, None where the settings list no names."""
        tags = tag_numbers(settings.get('tags', ())) if 'tags' in named_by else {}
        sensors = tuple(settings.get('sensors', ())) if 'sensors' in named_by else ()
        if not tags and not sensors:
            return None
        return cls(frozenset(topic.split('/')), tags, sensors, settings.get('map_frame', 'map'))

    def __call__(self, measurement: Any) -> Any:
        """The measurement with what its topic and its frame say; what it says itself stays."""
        known, frame_id = fields_dict(type(measurement)), measurement.frame_id
        changes: dict[str, Any] = {}
        for name, number in self.tags.items():
            if (name in self.parts or name == frame_id) and measurement.target_id < 0:
                changes['target_id'] = number
        for name in self.sensors:
            if 'sensor' in known and (name in self.parts or name == frame_id):
                changes['sensor'] = name
        if changes and (frame_id in self.tags or frame_id in self.sensors):
            changes['frame_id'] = self.map_frame
        return evolve(measurement, **changes) if changes else measurement
