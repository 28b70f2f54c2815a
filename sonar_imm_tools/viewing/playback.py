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

"""Playing a recording under the control of a viewer: play, pause, jump, faster and slower.

One thread plays (`Playback.run`), another one asks for changes (`Playback.change`). The clock of
the recording runs `rate` times as fast as the steady clock while it plays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import enum
import threading
import time

from attrs import frozen

from .material import Shown

_NANO = 10**9
TICK = 0.05
"""Seconds between two announcements of the time."""


class Status(enum.Enum):
    """What a playback does."""

    PLAYING = 'playing'
    PAUSED = 'paused'
    ENDED = 'ended'


@frozen
class State:
    """A playback at one moment. `jumped`: the time did not get here by playing."""

    status: Status
    now_ns: int
    rate: float
    jumped: bool


class Playback:
    """Where a playing recording stands.

    first_ns, last_ns: its span; `loop` starts over at the end instead of ending there.
    """

    def __init__(self, first_ns: int, last_ns: int, *, rate: float = 1.0, loop: bool = False):
        self.span = first_ns, last_ns
        self._loop = loop
        self._rate = rate
        self._status = Status.PAUSED
        self._anchor = first_ns  # the time of the recording at `_since`
        self._since = time.monotonic()
        self._start: int | None = first_ns  # where to begin anew, None to go on
        self._stopped = False
        self._changed = threading.Condition()

    def change(
        self, *, play: bool, rate: float | None = None, seek_ns: int | None = None
    ) -> State:
        """Play or pause, at another rate, from another time; gives the state after it.

        A rate that is not positive is not taken. Playing on from the end begins at the start.
        """
        with self._changed:
            now = self._now_ns()
            jump = seek_ns
            if self._status is Status.ENDED and play and jump is None:
                jump = self.span[0]
            if jump is not None:
                now = min(max(jump, self.span[0]), self.span[1])
                self._start = now
            self._anchor, self._since = now, time.monotonic()
            if rate is not None and 0.0 < rate < float('inf'):
                self._rate = rate
            if self._status is not Status.ENDED or jump is not None:
                self._status = Status.PLAYING if play else Status.PAUSED
            self._changed.notify_all()
            return State(self._status, now, self._rate, jump is not None)

    def stop(self) -> None:
        """Let `run` return."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def run(
        self,
        messages: Callable[[int], Iterable[Shown]],
        publish: Callable[[Shown], None],
        tell_time: Callable[[int], None],
        tell_state: Callable[[State], None],
    ) -> None:
        """Play until `stop`. `messages` gives the stream from a time on.

        `tell_time` hears the time of the recording while it plays, `tell_state` of changes that
        nobody asked for: the end, and the start after a loop.
        """
        while (start := self._next_start()) is not None:
            for shown in messages(start):
                if not self._wait_until(shown.log_ns, tell_time):
                    break  # a jump, or the end of it all
                publish(shown)
            else:
                self._finish(tell_state)

    def _next_start(self) -> int | None:
        """Wait for a place to begin at; None when stopped."""
        with self._changed:
            while self._start is None and not self._stopped:
                self._changed.wait()
            start, self._start = self._start, None
            return None if self._stopped else start

    def _wait_until(self, log_ns: int, tell_time: Callable[[int], None]) -> bool:
        """Wait until `log_ns` is due. False when something else is to be done instead.

        What lies before the start is due at once, also while paused: the picture after a jump.
        """
        while True:
            with self._changed:
                if self._stopped or self._start is not None:
                    return False
                now = self._now_ns()
                wait = (log_ns - now) / _NANO / self._rate
                if wait <= 0.0 and (self._status is Status.PLAYING or log_ns < self._anchor):
                    return True
                if self._status is not Status.PLAYING:
                    self._changed.wait()
                    continue
                self._changed.wait(min(wait, TICK))
                now = self._now_ns()
            tell_time(min(now, log_ns))

    def _finish(self, tell_state: Callable[[State], None]) -> None:
        with self._changed:
            if self._stopped or self._start is not None:
                return
            first, last = self.span
            self._status = Status.PLAYING if self._loop else Status.ENDED
            now = first if self._loop else last
            self._start = first if self._loop else None
            self._anchor, self._since = now, time.monotonic()
            state = State(self._status, now, self._rate, self._loop)
        tell_state(state)

    def _now_ns(self) -> int:
        """The time of the recording; the lock is held."""
        if self._status is not Status.PLAYING:
            return self._anchor
        elapsed = (time.monotonic() - self._since) * self._rate
        return min(self._anchor + round(elapsed * _NANO), self.span[1])
