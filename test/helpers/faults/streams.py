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

"""Faults of what is sent: messages lost, repeated, moved in time or spoilt."""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import Any

import numpy as np

from msg_adapters.table import decode_table, encode_table
from sonar_imm.nodes.messages import make

from .cases import Message, SECOND, Step

Parts = tuple[list[Step], list[Step]]
Disturbance = Callable[[list[Message], list[Message], list[Message]], Parts]


def middle(change: Callable[..., list[Step]]) -> Callable[..., Disturbance]:
    """Make a disturbance of a function of the messages during it; what it was given else stays."""

    def told(*arguments: Any) -> Disturbance:
        def disturb(before: list[Message], during: list[Message], after: list[Message]) -> Parts:
            return [*before, *change(during, *arguments)], list(after)

        return disturb

    return functools.wraps(change)(told)


@middle
def each(during: list[Message], change: Callable[[Message], Message]) -> list[Step]:
    """Every message on the primary input changed."""
    return [change(one) if one.primary else one for one in during]


@middle
def dropped(during: list[Message], topic: str) -> list[Step]:
    """An input that is silent for a while."""
    return [one for one in during if one.topic != topic]


@middle
def twice(during: list[Message]) -> list[Step]:
    """Every message comes two times."""
    return [one for one in during for _ in range(2)]


@middle
def late(during: list[Message], places: int = 3) -> list[Step]:
    """Every fourth message on the primary input comes `places` of them later."""
    held: list[tuple[int, Message]] = []
    sent: list[Step] = []
    count = 0
    for one in during:
        count += one.primary
        if one.primary and count % 4 == 0:
            held.append((count + places, one))
        else:
            sent.append(one)
        sent += [message for due, message in held if due <= count]
        held = [(due, message) for due, message in held if due > count]
    return sent + [message for _, message in held]


@middle
def shuffled(during: list[Message], size: int = 4) -> list[Step]:
    """Messages in any order inside of blocks with `size` of the primary input each."""
    rng = np.random.default_rng(5)
    blocks: list[list[Message]] = [[]]
    for one in during:
        if sum(message.primary for message in blocks[-1]) == size:
            blocks.append([])
        blocks[-1].append(one)
    return [block[k] for block in blocks for k in rng.permutation(len(block))]


def clock_set(seconds: float) -> Disturbance:
    """The clock of the sensors is set anew after the first third."""

    def disturb(before: list[Message], during: list[Message], after: list[Message]) -> Parts:
        return list(before), [one.moved(seconds) for one in [*during, *after]]

    return disturb


def looped(before: list[Message], during: list[Message], after: list[Message]) -> Parts:
    """The recording is played again from its beginning."""
    whole = [*before, *during, *after]
    return list(whole), list(whole)


@middle
def second_publisher(during: list[Message], seconds: float) -> list[Step]:
    """Every message comes again from a sender whose clock is late."""
    return [step for one in during for step in (one, one.moved(-seconds))]


def frame(name: str) -> Callable[[Message], Message]:
    """Another frame_id."""
    return lambda one: one.changed(lambda content: setattr(content.header, 'frame_id', name))


def columns(**factors: float) -> Callable[[Message], Message]:
    """Columns of a table in another unit."""

    def change(content: Any) -> None:
        table = dict(decode_table(content))
        for name, factor in factors.items():
            table[name] = (table[name] * factor).astype(table[name].dtype)
        stamp = content.header.stamp
        stamp_ns = stamp.sec * SECOND + stamp.nanosec
        made = encode_table(table, stamp_ns=stamp_ns, frame_id=content.header.frame_id, make=make)
        content.fields, content.data = made.fields, made.data
        content.point_step, content.row_step = made.point_step, made.row_step

    return lambda one: one.changed(change)
