"""Description of one input of a tracker."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from attrs import field, frozen

Reader = Callable[..., Any]

DOUBTS = {
    'zero_covariance': 'have a covariance of zeros, which is taken as unknown',
    'no_frame': 'have no frame_id',
    'unusable_rows': 'have rows that cannot be used, which are left out',
}
"""What messages have that are used but deserve a look, by the code they are counted under."""


@frozen
class InputTopic:
    """One input of a tracker.

    name: relative topic name. measurement: the class that its readers give. readers: by message
    type; a reader takes ``(message, *, world_frame='enu')`` and raises `Rejection` for a message
    that it cannot use. write: ``(measurement, make) -> message``.
    doubt: gives a reason code to count when a message can be used but deserves a warning.
    scans: several messages with one stamp are one scan, so that equal stamps are no mistake.
    one_topic: several topics are several instruments, each for a tracker of its own.
    settings: parameters of the tracker that its readers take as keywords too: what messages do not
    say themselves.
    companion: describes another input; found by its topic name, never enough alone.
    required: whether the tracker makes nothing without it, by the parameters of the tracker. Of
    the inputs that are neither required nor companions, one is enough.
    """

    name: str
    description: str
    measurement: type = field(kw_only=True)
    readers: Mapping[str, Reader] = field(kw_only=True)
    write: Callable[..., Any] = field(kw_only=True)
    doubt: Callable[[Any], str | None] = field(default=lambda message: None, kw_only=True)
    scans: bool = field(default=False, kw_only=True)
    one_topic: bool = field(default=False, kw_only=True)
    settings: tuple[str, ...] = field(default=(), kw_only=True)
    companion: bool = field(default=False, kw_only=True)
    required: Callable[[Mapping[str, Any]], bool] = field(
        default=lambda settings: False, kw_only=True
    )

    def reader(
        self, type_name: str, world_frame: str, settings: Mapping[str, Any]
    ) -> Callable[[Any], Any]:
        """Give the reader of a message type with its settings; `settings` may hold more."""
        told = {name: settings[name] for name in self.settings if name in settings}
        return partial(self.readers[type_name], world_frame=world_frame, **told)


def needed(
    topics: Sequence[InputTopic], settings: Mapping[str, Any]
) -> tuple[list[str], list[str]]:
    """Names of the inputs that a tracker with these parameters cannot do without, and of those of
    which one is enough."""
    required = [topic for topic in topics if topic.required(settings)]
    if any(not topic.companion for topic in required):
        return [topic.name for topic in required], []
    one_of = [topic.name for topic in topics if not topic.companion]
    return [topic.name for topic in required], one_of
