"""Late, shuffled, repeated and wild stamps, and how to get the right answer in spite of them.

Sonar data carry the instant of transmission and may arrive seconds later, in any order. Two
objects deal with that.

`StampGate` looks at stamps only and decides whether a measurement belongs to the stream. A stamp
belongs when it is neither older than the newest one by more than the window, nor ahead of it by
more than `max_gap_ns`. One that does not belong is held, because it is either wild (then the next
good stamp abandons it) or the first of a clock that was restarted (then the following ones agree
with it, and after `restart_after` of them all are handed out again: nothing good is lost).

`ReplayHistory` keeps what arrived inside the window together with the state after each stamp. A
late item is put in its place and everything after it is computed again. What it keeps depends on
the newest stamp alone, never on the order of arrival: the scans not older than ``newest -
window``, and one *base* state, that after the last older scan. An item that is still accepted is
never older than ``newest - window``, so no scan before the base can change any more, and **input
shuffled inside the window gives the same bits as sorted input**.

Times are integer nanoseconds; there is no clock here.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Generic, Literal, TypeVar

from attrs import frozen

State = TypeVar('State')
Item = TypeVar('Item')

Step = Callable[[State, int, Sequence[Item]], State]


@frozen
class Judgement(Generic[Item]):
    """What `StampGate.judge` decided.

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
class _Held(Generic[Item]):
    stamp_ns: int
    item: Item
    late: bool


class StampGate(Generic[Item]):
    """Decides from the stamps alone what belongs to the stream. See the module's text.

    window_ns: how much older than the newest stamp is still good; max_gap_ns: how far ahead of it
    is still believed; restart_after: distinct off-stream stamps in a row, in one stream of their
    own, that mean the clock was restarted. A scan of many items with one wild stamp is therefore
    no restart. At most `hold` items are held, the latest ones.
    """

    def __init__(self, window_ns: int, max_gap_ns: int, restart_after: int, *, hold: int = 1000):
        if window_ns < 0 or max_gap_ns <= 0 or restart_after < 1 or hold < restart_after:
            raise ValueError(
                'a stamp gate needs window_ns >= 0, max_gap_ns > 0 and 1 <= restart_after <= hold'
            )
        self.window_ns = window_ns
        self.max_gap_ns = max_gap_ns
        self.restart_after = restart_after
        self.hold = hold
        self.newest_ns: int | None = None
        self._held: list[_Held[Item]] = []

    @property
    def holding(self) -> int:
        """How many ``doubtful`` items wait for a decision."""
        return sum(not held.late for held in self._held)

    def judge(self, stamp_ns: int, item: Item) -> Judgement[Item]:
        """Decide about one item, in order of arrival."""
        if self.newest_ns is None or self._follows(self.newest_ns, stamp_ns):
            self.newest_ns = stamp_ns if self.newest_ns is None else max(self.newest_ns, stamp_ns)
            return Judgement('use', released=(item,), abandoned=self._abandon())
        late = stamp_ns < self.newest_ns
        abandoned = 0
        if self._held and not self._follows(max(held.stamp_ns for held in self._held), stamp_ns):
            abandoned = self._abandon()
        elif len(self._held) == self.hold:
            abandoned = int(not self._held.pop(0).late)
        self._held.append(_Held(stamp_ns, item, late))
        if len({held.stamp_ns for held in self._held}) < self.restart_after:
            return Judgement('too_late' if late else 'doubtful', abandoned=abandoned)
        return self._restart(abandoned)

    def _follows(self, newest_ns: int, stamp_ns: int) -> bool:
        return newest_ns - self.window_ns <= stamp_ns <= newest_ns + self.max_gap_ns

    def _abandon(self) -> int:
        abandoned = self.holding
        self._held = []
        return abandoned

    def _restart(self, abandoned: int) -> Judgement[Item]:
        held, self._held = self._held, []
        self.newest_ns = max(one.stamp_ns for one in held)
        # The last one was never reported to anybody, so it cannot be reinstated.
        return Judgement(
            'restart',
            released=tuple(one.item for one in held),
            abandoned=abandoned,
            reinstated=sum(one.late for one in held[:-1]),
        )


@frozen
class Inserted(Generic[State]):
    """What `ReplayHistory.insert` did.

    verdict: ``used``; ``duplicate`` (same stamp, same key); ``too_late`` (older than the window);
    ``full`` (the scan of that stamp holds all it may). revised: (stamp_ns, state) of the item's
    scan and of every later one, oldest first; empty when the item was refused.
    """

    verdict: Literal['used', 'duplicate', 'too_late', 'full']
    revised: list[tuple[int, State]]


@frozen
class _Scan(Generic[Item]):
    keys: list[bytes]
    items: list[Item]

    def holds(self, key: bytes) -> bool:
        place = bisect_left(self.keys, key)
        return place < len(self.keys) and self.keys[place] == key

    def with_item(self, key: bytes, item: Item) -> _Scan[Item]:
        place = bisect_left(self.keys, key)
        return _Scan(
            [*self.keys[:place], key, *self.keys[place:]],
            [*self.items[:place], item, *self.items[place:]],
        )


class ReplayHistory(Generic[State, Item]):
    """Out-of-sequence history with replay, for any state and any step. See the module's text.

    initial: the state before the first scan. States must be values: `step` makes a new one and
    leaves the old one alone. window_ns: how late an item may be; 0 drops all late ones, and items
    of the newest stamp still join its scan. scan_limit: most items of one stamp, so that a clock
    that stands still cannot eat the memory.
    """

    def __init__(self, initial: State, window_ns: int, *, scan_limit: int = 10_000):
        if window_ns < 0 or scan_limit < 1:
            raise ValueError('a history needs window_ns >= 0 and scan_limit >= 1')
        self.window_ns = window_ns
        self.scan_limit = scan_limit
        self._base = initial
        self._stamps: list[int] = []
        self._scans: list[_Scan[Item]] = []
        self._states: list[State] = []

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
        return self._states[-1] if self._states else self._base

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
        known = place < len(self._stamps) and self._stamps[place] == stamp_ns
        scan = self._scans[place] if known else _Scan[Item]([], [])
        if scan.holds(key):
            return Inserted('duplicate', [])
        if len(scan.items) >= self.scan_limit:
            return Inserted('full', [])
        later = place + 1 if known else place
        scans = [scan.with_item(key, item), *self._scans[later:]]
        stamps = [stamp_ns, *self._stamps[later:]]
        states = self._replay(
            self._states[place - 1] if place else self._base, stamps, scans, step
        )
        self._stamps[place:], self._scans[place:], self._states[place:] = stamps, scans, states
        self._prune()
        return Inserted('used', list(zip(stamps, states)))

    @staticmethod
    def _replay(
        state: State, stamps: list[int], scans: list[_Scan[Item]], step: Step[State, Item]
    ) -> list[State]:
        states = []
        for stamp_ns, scan in zip(stamps, scans):
            state = step(state, stamp_ns, tuple(scan.items))
            states.append(state)
        return states

    def _prune(self) -> None:
        """Forget scans older than the window; the state after the last of them becomes the base.

        The edge itself stays: an item with exactly that stamp may still come."""
        old = bisect_left(self._stamps, self._stamps[-1] - self.window_ns)
        if old:
            self._base = self._states[old - 1]
            del self._stamps[:old], self._scans[:old], self._states[:old]
