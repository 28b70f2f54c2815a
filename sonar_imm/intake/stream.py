# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The stream of measurements, as every tracker has it: in which frame, in which order, how often.

A measurement passes three gates before a tracker's own mathematics sees it. Each refusal is
counted, none is raised:

    type accepted? -> frame the same as before? -> stamp in the stream? (`estimation.history`)

What was held before a restart of the clock passes the first two once more. Two streams differ in
what happens then. `OnceStream` hands each measurement out once and for good, in rising order of
stamps. `ReplayStream` puts each in its place in time and computes the states after it again, so
that the order of arrival changes nothing:

    def process(self, measurement):
        return [self._estimate(state) for _, state in self._stream.revise(measurement)]

Both hear of a restarted clock. Counts: ``unknown_type``, ``other_frame``, ``doubted``,
``too_late``, ``restarts``, ``duplicate``; of a `ReplayStream` also ``used``, ``late``, ``full``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from operator import itemgetter
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from attrs import define, field, frozen

from ..estimation.history import Held, MAX_LATE_NS, ReplayHistory, StampGate, Step
from ..measurements import nanoseconds, Rejection, VesselPose

State = TypeVar('State')
TRACKS = 'tracks'
_MOST_STATES = 64
"""States that a stream keeps: with many tracks one of the divers has 2 MB."""


def frame_key(measurement: Any) -> str | None:
    """What has the frame of `measurement`: `TRACKS`; a sensor on board (the name of its kind of
    measurement, and its side); or None, when it is the same in any frame. The class says so by
    `FRAME`: ``'own'``, ``'none'``, or nothing."""
    role = getattr(type(measurement), 'FRAME', 'world')
    if role == 'own':
        return f'{type(measurement).__name__} {getattr(measurement, "side", "")}'
    return TRACKS if role == 'world' else None


@define(eq=False)
class KnownFrames:
    """The frame of the tracks, and that of each sensor on board: each is that of the first
    measurement that was used.

    A measurement that is not used must not decide: `check` only compares, `settle` decides.
    kinds: the classes of which the tracker decides what is used, since it can refuse them for
    their stamps; what is of another class is used whenever it comes. STATE: see
    `trackers.Tracker`.
    """

    STATE: ClassVar = ('_frames',)

    kinds: tuple[type, ...] = ()
    _frames: dict[str, str] = field(init=False, factory=lambda: {TRACKS: ''})

    @property
    def frame_id(self) -> str:
        """The frame of the tracks, empty until one is known."""
        return self._frames[TRACKS]

    def of(self, measurement: Any, required: str = '') -> str:
        """The frame in which `measurement` has to be, `required` where it is that of the tracks;
        empty when any will do. The pose of a vessel places what is in the frame of the tracks."""
        key = TRACKS if isinstance(measurement, VesselPose) else frame_key(measurement)
        return (required if key == TRACKS else '') or self._frames.get(key or '', '')

    def check(self, measurement: Any, required: str = '') -> None:
        """Raise `Rejection` when `measurement` is in another frame, or, where it is in that of the
        tracks, not in `required`. One without a frame passes only until a frame is known."""
        key = frame_key(measurement)
        for expected in (required if key == TRACKS else '', self._frames.get(key or '', '')):
            if expected and measurement.frame_id != expected:
                whose = 'the tracks' if key == TRACKS else 'earlier ones'
                raise Rejection(
                    'frame',
                    f"the frame '{measurement.frame_id}' is not the frame '{expected}' of {whose}",
                )

    def settle(self, measurement: Any) -> None:
        """Expect the frame of `measurement`, which passed `check` and is used, from now on."""
        key = frame_key(measurement)
        if key is not None:
            self._frames[key] = measurement.frame_id

    def admit(self, measurement: Any) -> None:
        """`check` and `settle`, for what is used whatever its stamp. Raises `Rejection`."""
        self.check(measurement)
        self.settle(measurement)


@frozen
class StreamRules:
    """What belongs to a stream: see `StampGate`. window_ns: 0 where nothing late is used."""

    window_ns: int
    max_gap_ns: int
    restart_after: int
    max_late_ns: int = MAX_LATE_NS

    @classmethod
    def of(cls, config: Any) -> StreamRules:
        """The rules that `config`, the `StampParameters` of a tracker, states; without `history`
        nothing late is used."""
        history = getattr(config, 'history', 0.0)
        return cls(nanoseconds(history), nanoseconds(config.max_gap), config.restart_after)


class Admitted(NamedTuple):
    """The measurements to process now, and whether the clock was restarted before them."""

    items: tuple[Any, ...] = ()
    restarted: bool = False


@define(eq=False)
class Stream:
    """The gates that both streams share. accepts: the measurement classes a tracker takes; frames:
    those of what was used.

    counts: what happened to the measurements, by reason; a tracker adds its own. STATE: see
    `trackers.Tracker`.
    """

    STATE: ClassVar[tuple[str, ...]] = ('counts', 'frames', '_gate')

    accepts: tuple[type, ...]
    _rules: StreamRules
    counts: Counter[str] = field(init=False, factory=Counter)
    frames: KnownFrames = field(init=False)
    _gate: StampGate[Any] = field(init=False)

    def __attrs_post_init__(self) -> None:
        rules = self._rules
        self.frames = KnownFrames(self.accepts)
        self._gate = StampGate(
            rules.window_ns, rules.max_gap_ns, rules.restart_after, max_late_ns=rules.max_late_ns
        )

    @property
    def frame_id(self) -> str:
        """The frame of the tracks, empty until a measurement names one."""
        return self.frames.frame_id

    def admit(self, measurement: Any) -> Admitted:
        """The measurements to process now, in order of arrival."""
        return self._in_time(measurement) if self._recognised(measurement) else Admitted()

    def _recognised(self, measurement: Any) -> bool:
        """Whether type and frame are those of the stream; counts a refusal."""
        if not isinstance(measurement, self.accepts):
            self.counts['unknown_type'] += 1
            return False
        try:
            self.frames.check(measurement)
        except Rejection:
            self.counts['other_frame'] += 1
            return False
        return True

    def _in_time(self, measurement: Any) -> Admitted:
        """Ask the gate of stamps about a measurement that is `_recognised`."""
        decision = self._gate.decide(measurement.stamp_ns, measurement)
        decision.count_in(self.counts)
        # Only what is used decides on a frame.
        if decision.verdict == 'use':
            self.frames.settle(measurement)
            return Admitted(decision.released)
        used = []
        for item in decision.released:  # held: they came before anything had decided
            if self._recognised(item):
                self.frames.settle(item)
                used.append(item)
        return Admitted(tuple(used), decision.verdict == 'restart')


@define(eq=False)
class OnceStream(Stream):
    """A stream that hands out each measurement once, in rising order of stamps."""

    def admit(self, measurement: Any) -> Admitted:
        """The measurements to process now. One with the newest stamp is a duplicate."""
        if not self._recognised(measurement):
            return Admitted()
        if measurement.stamp_ns == self._gate.newest_ns:
            self.counts['duplicate'] += 1
            return Admitted()
        admitted = self._in_time(measurement)
        by_stamp: dict[int, Any] = {}
        for item in admitted.items:
            self.counts['duplicate'] += item.stamp_ns in by_stamp
            by_stamp.setdefault(item.stamp_ns, item)
        return Admitted(tuple(by_stamp[stamp] for stamp in sorted(by_stamp)), admitted.restarted)


@define(eq=False, kw_only=True)
class ReplayStream(Stream, Generic[State]):
    """A stream with history: what is late, but inside the window, gets its place in time.

    step: ``step(state, stamp_ns, measurements) -> state``, pure, for all measurements of a stamp.
    initial: the state before the first measurement. survivor: what is left of a state when the
    clock was restarted, such as the identities that are used up. Measurements have a ``key()``.
    """

    STATE: ClassVar[tuple[str, ...]] = (*Stream.STATE, '_history')

    _step: Step[State, Any]
    initial: State
    _survivor: Callable[[State], State]
    _history: ReplayHistory[State, Any] = field(init=False)

    def __attrs_post_init__(self) -> None:
        Stream.__attrs_post_init__(self)
        self._history = self._begun(self.initial)

    def restored(self) -> None:
        """Compute the states anew, after the scans were put in. Raises ValueError."""
        self._history.again(lambda item: item.key(), self._step)

    @property
    def state(self) -> State:
        """The newest state."""
        return self._history.state

    @property
    def base(self) -> State:
        """The state before the oldest scan that is kept."""
        return self._history.base

    def forget(self) -> None:
        """Forget all measurements, but for what survives of the state."""
        self._history = self._begun(self._survivor(self.state))

    def _begun(self, state: State) -> ReplayHistory[State, Any]:
        return ReplayHistory(state, self._rules.window_ns, state_limit=_MOST_STATES)

    def revise(self, measurement: Any) -> list[tuple[int, State]]:
        """Take a measurement in: every stamp with a new or a changed state, and that state, oldest
        first."""
        admitted = self.admit(measurement)
        if admitted.restarted:
            self.forget()
        revised: dict[int, State] = {}
        for item in admitted.items:
            newest_ns = self._history.newest_ns
            inserted = self._history.insert(item.stamp_ns, item.key(), item, self._step)
            self.counts[inserted.verdict] += 1
            if inserted.revised and newest_ns is not None and item.stamp_ns < newest_ns:
                self.counts['late'] += 1
            revised.update(inserted.revised)
        return sorted(revised.items(), key=itemgetter(0))


STREAM_TYPES = (Held,)
"""The classes of values that the state of a stream may hold, see `trackers.state_file`;
measurements besides."""
