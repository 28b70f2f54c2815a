# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Description of one input of a tracker, and labels by the names of topics and frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import re
from typing import Any

from attrs import evolve, field, fields_dict, frozen


def tag_numbers(names: Sequence[str]) -> dict[str, int]:
    """The number of each name, as `target_id` has it: its own where all are whole numbers, else
    its place in the list from 1."""
    distinct = list(dict.fromkeys(names))
    if distinct and all(name.isdecimal() and int(name) < 2**31 for name in distinct):
        return {name: int(name) for name in distinct}
    return {name: number for number, name in enumerate(distinct, start=1)}


@frozen
class Labels:
    """Labels measurements of one topic: whose they are, and which sensor has made them.

    A user lists the names (parameters `tags` and `sensors`). A name counts where it is a whole
    part of the topic, ``/divers/bob/fix``, or the frame of the message. parts: of the topic's
    name; tags: numbers by name; sensors: names; map_frame: the frame of a measurement whose own
    frame was the name of its tag or sensor.
    """

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
        return cls(frozenset(topic.split('/')), tags, sensors, settings.get('frame_id') or 'map')

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


Reader = Callable[..., Any]
Doubt = Callable[[Any, Any], str | None]

DOUBTS = {
    'zero_covariance': 'have a covariance of zeros, which is taken as unknown',
    'bad_height': 'state a covariance of z that cannot be true; x and y are used without z',
    'no_frame': 'have no frame_id',
    'flagged_invalid': 'have rows flagged as invalid, which are left out',
    'unusable_rows': 'have rows that cannot be used, which are left out',
}
"""What messages have that are used but deserve a look, by the code they are counted under."""


def words_of(name: str) -> list[str]:
    """The words of a name in small letters, and what stands between them."""
    return re.split(r'([\W_]+)', name.lower())


@frozen
class InputTopic:
    """One input of a tracker.

    name: relative topic name. measurement: the class that its readers give. readers: by message
    type; a reader takes ``(message, *, world_frame='enu')`` and raises `Rejection` for a message
    that it cannot use. write: ``(measurement, make) -> message``.
    doubt: ``(message, measurement)`` -> a reason code to count when a message can be used but
    deserves a warning, given what its reader made of it.
    scans: several messages with one stamp are one scan, so that equal stamps are no mistake.
    one_topic: several topics are several instruments, each for a tracker of its own.
    settings: parameters of the tracker that its readers take as keywords too: what messages do not
    say themselves.
    companion: describes another input; found by its topic name, never enough alone.
    beside: the inputs that a companion is of use to; without them it is left out. Empty: any.
    also: further classes that its readers give and `write` takes.
    by_name: types that mean this input only on a topic of its name, because they mean other things
    elsewhere.
    second: types that are this input by their topic's name only where no other input is there,
    because the instrument may be another's.
    named_by: parameters of the tracker that list names, of tags or of sensors: below each name
    there is an input of its own (``<name>/fix``), and a measurement is labelled by the name in its
    topic or its frame.
    required: whether the tracker makes nothing without it, by the parameters of the tracker. Of
    the inputs that are neither required nor companions, one is enough.
    prefix: ``'~/'`` for a topic below the name of the node, ``'/'`` for one that no namespace
    changes; '' for a relative topic.
    latched: whether messages wait for listeners that come later, and none may be lost.
    wanted: whether it is heard at all, by the parameters of the tracker.
    words: words in a topic's name, any of which says that it is this input rather than the one of
    the same last name: ``/sidescan_port/snapshot`` is a ``port/snapshot``.
    makes: the input of a tracker that a node before it makes of this one; '' for an input of the
    tracker itself.
    """

    name: str
    description: str
    measurement: type = field(kw_only=True)
    readers: Mapping[str, Reader] = field(kw_only=True)
    write: Callable[..., Any] = field(kw_only=True)
    doubt: Doubt = field(default=lambda message, measurement: None, kw_only=True)
    scans: bool = field(default=False, kw_only=True)
    one_topic: bool = field(default=False, kw_only=True)
    settings: tuple[str, ...] = field(default=(), kw_only=True)
    companion: bool = field(default=False, kw_only=True)
    beside: tuple[str, ...] = field(default=(), kw_only=True)
    also: tuple[type, ...] = field(default=(), kw_only=True)
    by_name: frozenset[str] = field(default=frozenset(), kw_only=True)
    second: frozenset[str] = field(default=frozenset(), kw_only=True)
    named_by: tuple[str, ...] = field(default=(), kw_only=True)
    required: Callable[[Mapping[str, Any]], bool] = field(
        default=lambda settings: False, kw_only=True
    )
    prefix: str = field(default='', kw_only=True)
    latched: bool = field(default=False, kw_only=True)
    wanted: Callable[[Mapping[str, Any]], bool] = field(
        default=lambda settings: True, kw_only=True
    )
    words: frozenset[str] = field(default=frozenset(), kw_only=True)
    makes: str = field(default='', kw_only=True)

    @property
    def measurements(self) -> tuple[type, ...]:
        """All classes that its readers give."""
        return (self.measurement, *self.also)

    def is_named(self, topic: str) -> bool:
        """Whether the name of `topic` says that it is this input."""
        if f'/{topic}'.endswith(f'/{self.name}'):
            return True
        place, _, own = topic.rpartition('/')
        same = own == self.name.rpartition('/')[2]
        return same and not self.words.isdisjoint(words_of(place))

    def namespace(self, topic: str) -> str:
        """What stands before the name of the input in that of a topic: ``/fore`` of
        ``/fore/port/snapshot``, ``/fore_`` of ``/fore_port/snapshot``."""
        if f'/{topic}'.endswith(f'/{self.name}'):
            return topic[: -len(self.name)].rstrip('/')
        parts = words_of(topic.rpartition('/')[0])
        return ''.join(part for part in parts if part not in self.words)

    def may_be(self, topic: str, type_name: str) -> bool:
        """Whether a topic of that name and type could be this input, if a user says so."""
        if type_name not in self.readers:
            return False
        own = topic.split('/')[-1] == self.name
        return own or not (self.companion or type_name in self.by_name)

    def instances(self, settings: Mapping[str, Any]) -> tuple[str, ...]:
        """The relative names of its topics: its own, and one for each tag or sensor named."""
        names = dict.fromkeys(name for key in self.named_by for name in settings.get(key, ()))
        return (self.name, *(f'{name}/{self.name}' for name in names))

    def instance(self, topic: str, settings: Mapping[str, Any]) -> str:
        """The relative name under which a node hears what was recorded on `topic`."""
        parts = topic.split('/')
        names = [name for key in self.named_by for name in settings.get(key, ()) if name in parts]
        return f'{names[0]}/{self.name}' if names else self.name

    def full_name(self, node: str) -> str:
        """Where the node called `node` hears it when it is in no namespace."""
        return f'/{node}/{self.name}' if self.prefix == '~/' else f'/{self.name}'

    def reader(
        self, type_name: str, world_frame: str, settings: Mapping[str, Any], topic: str = ''
    ) -> Callable[[Any], Any]:
        """Give the reader of a message type with its settings; `settings` may hold more.

        topic: the name of the topic, by which measurements may be labelled.
        """
        own = {name: settings[name] for name in self.settings if name in settings}
        read = partial(self.readers[type_name], world_frame=world_frame, **own)
        label = Labels.of(topic, settings, self.named_by)
        return read if label is None else lambda message: label(read(message))


def needed(
    topics: Sequence[InputTopic], settings: Mapping[str, Any]
) -> tuple[list[str], list[str]]:
    """Names of the inputs that a tracker with these parameters cannot do without, and of those of
    which one is enough."""
    required = [topic for topic in topics if topic.required(settings)]
    if any(not topic.companion for topic in required):
        return [topic.name for topic in required], []
    one_of = [
        name for topic in topics if not topic.companion for name in topic.instances(settings)
    ]
    return [topic.name for topic in required], one_of
