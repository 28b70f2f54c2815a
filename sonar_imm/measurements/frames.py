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

"""One tracker, one frame: measurements in different frames must not be mixed without a word.

What a sensor on a vehicle says of itself is not in the frame of the tracks, but in its own, and
each such kind of measurement has to keep to one, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from .checks import Rejection


def frame_role(measurement: Any) -> str:
    """Whose frame a measurement is in, as its class says by `FRAME`: ``'world'``, that of the
    tracks, where it says nothing; ``'own'``, that of its sensor on the vehicle; ``'none'``, when
    it is the same in any frame."""
    role: str = getattr(type(measurement), 'FRAME', 'world')
    return role


class FrameGuard:
    """Lets one frame of the tracks pass: the one it is told, or else the first that a measurement
    names; and one frame for each sensor (kind of measurement, and side) that has its own.

    A measurement that is not used must not decide: `check` only compares, `settle` decides."""

    def __init__(self, frame_id: str = ''):
        """Expect `frame_id`; empty means that the measurements decide."""
        self._told = frame_id
        self.reset()

    @property
    def frame_id(self) -> str:
        """The frame of the tracks, empty until one is known."""
        return self._world

    def check(self, measurement: Any) -> None:
        """Raise `Rejection` when `measurement` is in another frame.

        One without a frame passes only until a frame is known.
        """
        role, frame_id = frame_role(measurement), measurement.frame_id
        if role == 'world':
            _compare(frame_id, self._world, 'the tracks')
        elif role == 'own':
            _compare(frame_id, self._own.get(_sensor(measurement), ''), 'earlier ones')

    def settle(self, measurement: Any) -> None:
        """Expect the frame of `measurement`, which passed `check` and is used, from now on."""
        role = frame_role(measurement)
        if role == 'world':
            self._world = measurement.frame_id
        elif role == 'own':
            self._own[_sensor(measurement)] = measurement.frame_id

    def admit(self, measurement: Any) -> None:
        """`check` and `settle`, for what is used whatever its stamp. Raises `Rejection`."""
        self.check(measurement)
        self.settle(measurement)

    def reset(self) -> None:
        """Let the measurements decide again, unless a frame was told."""
        self._world = self._told
        self._own: dict[tuple[type, str], str] = {}


class Frames(NamedTuple):
    """The frames of the measurements that a tracker used: those of the classes `kinds`, which it
    can refuse for their stamps."""

    guard: FrameGuard
    kinds: tuple[type, ...]


def _sensor(measurement: Any) -> tuple[type, str]:
    return type(measurement), getattr(measurement, 'side', '')


def _compare(frame_id: str, expected: str, whose: str) -> None:
    if expected and frame_id != expected:
        raise Rejection(
            'frame', f"the frame '{frame_id}' is not the frame '{expected}' of {whose}"
        )
