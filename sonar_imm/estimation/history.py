# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Late, shuffled, repeated and outlying stamps.

Sonar data carry the instant of transmission and may arrive seconds later, in any order. Two
objects deal with that.

`StampGate` looks at stamps only and decides whether a measurement belongs to the stream. A stamp
belongs when it is neither older than the newest one by more than the window, nor ahead of it by
more than `max_gap_ns`. One that does not belong is held, because it may be the first of a clock
that was restarted. Stamps held in a row are a *run*: each follows those before it, and none that
belongs to the stream came in between. A run is given up as soon as one does, and begins again
with a stamp that does not follow. It shows that time itself was set anew when nothing else
explains it:

1. It lies ahead, or more than `max_late_ns` behind, where no late message can be: `restart_after`
   distinct stamps are enough.
2. It repeats stamps from the beginning of the stream, as a looped recording does: `restart_after`
   such stamps are enough.
3. The stream has just begun, and all of its stamps are newer. Then those may be the outliers. The
   run has to outvote them: `restart_after` distinct stamps for each.
4. Otherwise it may be a burst of late messages. Only a long run is no burst: `PATIENCE` times
   `restart_after` distinct stamps that span more than the window.

With a restart all held items are handed out: waiting for evidence loses nothing, it only takes
longer. A clock that was set back by less than what rule 4 asks for reaches its old time again, and
the stream goes on; what came in between was too late.

`ReplayHistory` keeps what arrived inside the window together with the state after each stamp. A
late item is put in its place and everything after it is computed again. What it keeps depends on
the newest stamp alone, never on the order of arrival: the scans not older than ``newest -
window``, and one *base* state, that after the last older scan. An item that is still accepted is
never older than ``newest - window``, so no scan before the base can change any more, and **input
shuffled inside the window gives the same bits as sorted input**. Where a window holds very many
scans, only some of the older states are kept; the others are computed again when they are needed,
and the base is the newest one kept from before the window, with the scans after it.

Times are integer nanoseconds; there is no clock here.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Sequence
import operator
from typing import ClassVar, Generic, Literal, TypeVar

from attrs import define, field, frozen

State = TypeVar('State')
Item = TypeVar('Item')

Step = Callable[[State, int, Sequence[Item]], State]

PATIENCE = 20
"""A run of this many times `restart_after` stamps is longer than a burst of late messages."""

MAX_LATE_NS = 300 * 10**9
"""Five minutes: nothing that is meant to be tracked online comes later."""


@frozen
class GateDecision(Generic[Item]):
    """What `StampGate.decide` decided.

    verdict: ``use``; ``too_late`` or ``doubtful`` (both are held, in case the clock was
    restarted); ``restart``. released: the items to process now, in order of arrival: the item
    itself for ``use``, every held item for ``restart`` (before them, the caller forgets its
    state), nothing otherwise. abandoned: how many ``doubtful`` items were given up by this
    decision. reinstated: how many of `released` had been called ``too_late`` before.
    """

    verdict: Literal['use', 'too_late', 'doubtful', 'restart']
    released: tuple[Item, ...] = ()
    abandoned: int = 0
    reinstated: int = 0

    def count_in(self, counts: Counter[str]) -> None:
        """Add this decision to `doubted`, `too_late` and `restarts`."""
        counts['doubted'] += self.abandoned
        if self.verdict == 'too_late':
            counts['too_late'] += 1
        elif self.verdict == 'restart':
            counts['restarts'] += 1
            counts['too_late'] -= self.reinstated


@frozen
class Held(Generic[Item]):
    stamp_ns: int
    item: Item
    late: bool


@define(eq=False)
class Run(Generic[Item]):
    """Items in a row that do not belong to the stream. held: the newest `hold` of them; stamps:
    the distinct stamps of all, rising. STATE: see `trackers.Tracker`."""

    STATE: ClassVar = ('held', 'stamps')

    hold: int
    held: list[Held[Item]] = field(init=False, factory=list)
    stamps: list[int] = field(init=False, factory=list)

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def doubtful(self) -> int:
        return sum(not item.late for item in self.held)

    @property
    def full(self) -> bool:
        return len(self.held) == self.hold

    @property
    def span_ns(self) -> int:
        return self.stamps[-1] - self.stamps[0]

    def add(self, stamp_ns: int, item: Item, late: bool) -> int:
        """Append an item; gives how many ``doubtful`` ones had to go for it."""
        dropped = [self.held.pop(0)] if self.full else []
        self.held.append(Held(stamp_ns, item, late))
        _insert_distinct(self.stamps, stamp_ns)
        return sum(not item.late for item in dropped)


@define(eq=False)
class StampGate(Generic[Item]):
    """Decides from the stamps alone what belongs to the stream. See the module's text.

    window_ns: how much older than the newest stamp is still good; max_gap_ns: how far ahead of it
    is still believed; restart_after: distinct stamps in a row outside the stream that mean the
    clock was restarted, where nothing else explains them; max_late_ns: no message is later than
    this. A scan of many items with one outlying stamp is no restart. At most `hold` items are
    held, the latest ones. STATE: see `trackers.Tracker`.
    """

    STATE: ClassVar = ('_first', '_newest', '_run')

    window_ns: int
    max_gap_ns: int
    restart_after: int
    max_late_ns: int = field(kw_only=True, default=MAX_LATE_NS)
    hold: int = field(kw_only=True, default=1000)
    _first: list[int] = field(init=False, factory=list)
    _newest: list[int] = field(init=False, factory=list)
    _run: Run[Item] = field(init=False)

    def __attrs_post_init__(self) -> None:
        bounds = self.window_ns >= 0 and self.max_gap_ns > 0
        if not (bounds and 1 <= self.restart_after <= self.hold):
            raise ValueError(
                'a stamp gate needs window_ns >= 0, max_gap_ns > 0 and 1 <= restart_after <= hold'
            )
        self._run = Run(self.hold)

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp of the stream, None before the first."""
        return self._newest[-1] if self._newest else None

    @property
    def holding(self) -> int:
        """How many ``doubtful`` items wait for a decision."""
        return self._run.doubtful

    def decide(self, stamp_ns: int, item: Item) -> GateDecision[Item]:
        """Decide about one item, in order of arrival."""
        if not self._newest or self._follows(self._newest[-1], stamp_ns):
            self._accept(stamp_ns)
            return GateDecision('use', released=(item,), abandoned=self._abandon())
        late = stamp_ns < self._newest[-1]
        abandoned = 0
        if len(self._run) and not self._follows(self._run.stamps[-1], stamp_ns):
            abandoned = self._abandon()
        abandoned += self._run.add(stamp_ns, item, late)
        if self._restarted():
            return self._restart(abandoned)
        return GateDecision('too_late' if late else 'doubtful', abandoned=abandoned)

    def _follows(self, newest_ns: int, stamp_ns: int) -> bool:
        return newest_ns - self.window_ns <= stamp_ns <= newest_ns + self.max_gap_ns

    def _accept(self, stamp_ns: int) -> None:
        if len(self._first) < 2 * self.restart_after:  # twice, because some may get lost
            _insert_distinct(self._first, stamp_ns)
        _insert_distinct(self._newest, stamp_ns)
        del self._newest[:-PATIENCE]

    def _abandon(self) -> int:
        abandoned = self._run.doubtful
        if len(self._run):
            self._run = Run(self.hold)
        return abandoned

    def _restarted(self) -> bool:
        """Whether the run cannot be explained but by a clock that was restarted."""
        run, enough = self._run, self.restart_after
        if len(run) < enough:
            return False
        behind_ns = self._newest[-1] - run.stamps[-1]
        if behind_ns < 0 or behind_ns > self.max_late_ns:
            return True
        if len(set(run.stamps).intersection(self._first)) >= enough:
            return True
        young = len(self._newest) < PATIENCE and self._newest[0] > run.stamps[-1]
        if young and len(run) >= enough * len(self._newest):
            return True
        long = len(run) >= min(PATIENCE * enough, self.hold)
        return long and (run.span_ns > self.window_ns or run.full)

    def _restart(self, abandoned: int) -> GateDecision[Item]:
        held, self._run = self._run.held, Run(self.hold)
        self._first, self._newest = [], []
        for entry in held:
            self._accept(entry.stamp_ns)
        # The last one was never reported to anybody, so it cannot be reinstated.
        return GateDecision(
            'restart',
            released=tuple(entry.item for entry in held),
            abandoned=abandoned,
            reinstated=sum(entry.late for entry in held[:-1]),
        )


def _insert_distinct(stamps: list[int], stamp_ns: int) -> None:
    """Put a stamp in its place in a rising list, unless it is there."""
    place = bisect_left(stamps, stamp_ns)
    if place == len(stamps) or stamps[place] != stamp_ns:
        stamps.insert(place, stamp_ns)


@frozen
class Inserted(Generic[State]):
    """What `ReplayHistory.insert` did.

    verdict: ``used``; ``duplicate`` (same stamp, same key); ``too_late`` (older than the window);
    ``full`` (the scan of that stamp holds all it may). revised: (stamp_ns, state) of the item's
    scan and of every later one, oldest first; empty when the item was refused.
    """

    verdict: Literal['used', 'duplicate', 'too_late', 'full']
    revised: list[tuple[int, State]]


@define(eq=False)
class ReplayHistory(Generic[State, Item]):
    """Out-of-sequence history with replay, for any state and any step. See the module's text.

    initial: the state before the first scan. States must be values: `step` makes a new one and
    leaves the old one alone. window_ns: how late an item may be; 0 drops all late ones, and items
    of the newest stamp still join its scan. scan_limit: most items of one stamp, so that a clock
    that stands still cannot eat the memory. state_limit: most states that are kept, so that many
    scans in a window cannot either; at least 4, None for all. STATE: see `trackers.Tracker`;
    `again` makes the rest.
    """

    STATE: ClassVar = ('_base', '_stamps', '_scans')

    _base: State = field(alias='initial')
    window_ns: int
    scan_limit: int = field(kw_only=True, default=10_000)
    state_limit: int | None = field(kw_only=True, default=None)
    _stamps: list[int] = field(init=False, factory=list)
    _scans: list[list[Item]] = field(init=False, factory=list)
    _keys: list[list[bytes]] = field(init=False, factory=list)
    _states: dict[int, State] = field(init=False, factory=dict)
    """By stamp, rising: the newest half of what may be kept without a gap, and some before it."""

    def __attrs_post_init__(self) -> None:
        if self.window_ns < 0 or self.scan_limit < 1:
            raise ValueError('a history needs window_ns >= 0 and scan_limit >= 1')
        if self.state_limit is not None and self.state_limit < 4:
            raise ValueError('a history needs state_limit >= 4')

    def __len__(self) -> int:
        """How many scans are kept."""
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest scan, None before the first."""
        return self._stamps[-1] if self._stamps else None

    @property
    def state(self) -> State:
        """The state after the newest scan."""
        return self._states[self._stamps[-1]] if self._stamps else self._base

    @property
    def base(self) -> State:
        """The state before the first scan that is kept."""
        return self._base

    @property
    def states(self) -> list[State]:
        """The state after each scan for which one is kept, oldest first."""
        return list(self._states.values())

    def insert(
        self, stamp_ns: int, key: bytes, item: Item, step: Step[State, Item]
    ) -> Inserted[State]:
        """Put `item` in its place and compute everything from there on.

        key: canonical content of the item; it orders the items of one stamp and tells duplicates.
        step: ``step(state, stamp_ns, items) -> state``, pure; `items` are those of the stamp, in
        key order. When it raises, the history is as it was before.
        """
        if self._stamps and stamp_ns < self._stamps[-1] - self.window_ns:
            return Inserted('too_late', [])
        place = bisect_left(self._stamps, stamp_ns)
        merged = place < len(self._stamps) and self._stamps[place] == stamp_ns
        keys, items = (self._keys[place], self._scans[place]) if merged else ([], [])
        row = bisect_left(keys, key)
        if keys[row : row + 1] == [key]:
            return Inserted('duplicate', [])
        if len(items) >= self.scan_limit:
            return Inserted('full', [])
        scan = [*items[:row], item, *items[row:]]
        later = place + merged
        first, before = self._kept_before(place)
        stamps = [*self._stamps[first:place], stamp_ns, *self._stamps[later:]]
        scans = [*self._scans[first:place], scan, *self._scans[later:]]
        states = self._replay(before, stamps, scans, step)[place - first :]
        self._stamps[place:later], self._scans[place:later] = [stamp_ns], [scan]
        self._keys[place:later] = [[*keys[:row], key, *keys[row:]]]
        revised = list(zip(stamps[place - first :], states))
        self._keep(revised)
        self._prune()
        return Inserted('used', revised)

    def again(self, key: Callable[[Item], bytes], step: Step[State, Item]) -> None:
        """Compute the keys and the states of all scans, after a state was put in. Raises
        ValueError where no history would have these scans."""
        stamps, keys = self._stamps, [[key(item) for item in scan] for scan in self._scans]
        rising = all(map(operator.lt, stamps, stamps[1:]))
        if not rising or len(stamps) != len(keys) or any(scan != sorted(scan) for scan in keys):
            raise ValueError('scans that are in no order')
        states = self._replay(self._base, stamps, self._scans, step)
        self._keys, self._states = keys, {}
        self._keep(list(zip(stamps, states)))

    @staticmethod
    def _replay(
        state: State, stamps: list[int], scans: list[list[Item]], step: Step[State, Item]
    ) -> list[State]:
        states = []
        for stamp_ns, scan in zip(stamps, scans):
            state = step(state, stamp_ns, tuple(scan))
            states.append(state)
        return states

    def _kept_before(self, place: int) -> tuple[int, State]:
        """The newest state that is kept before scan `place`, and the scan after it."""
        for row in range(place - 1, -1, -1):
            if (state := self._states.get(self._stamps[row])) is not None:
                return row + 1, state
        return 0, self._base

    def _keep(self, revised: list[tuple[int, State]]) -> None:
        """Take over the newest states; of those before, every second one goes while there are too
        many."""
        for stamp_ns, state in revised:
            self._states.pop(stamp_ns, None)  # so that they stand in the order of their stamps
            self._states[stamp_ns] = state
        limit = self.state_limit
        while limit is not None and len(self._states) > limit:
            older = list(self._states)[: -(limit // 2)]
            for stamp_ns in older[::2]:
                del self._states[stamp_ns]

    def _prune(self) -> None:
        """Forget scans older than the window; the state after the last of them becomes the base,
        or the last one that is kept.

        The edge itself stays: an item with exactly that stamp may still come."""
        old = bisect_left(self._stamps, self._stamps[-1] - self.window_ns)
        old, self._base = self._kept_before(old)
        for stamp_ns in self._stamps[:old]:
            self._states.pop(stamp_ns, None)
        del self._stamps[:old], self._keys[:old], self._scans[:old]
