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
