# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sensors that stamp each fix by itself and look at several targets in turn.

Each fix without a name is then a scan in which all others were missed: tracks starve. The fixes
show it: between two of the same target lie fixes of others, and the time is always the same. What
is to be done is `scan_period`, which joins the fixes of a turn.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, TYPE_CHECKING

import numpy as np

from ...estimation.arrays import FloatArray, IntArray

if TYPE_CHECKING:  # `sonar-imm info` needs little of this, and begins sooner
    from .config import DiverConfig
    from .known import Known
    from .scan import Group

BEFORE = 30
"""Fixes before one among which the last one of the same target is looked for."""

MOST_FIXES = 3 * BEFORE
"""Maximum number of remembered fixes; two thirds of them are enough for a warning."""

IN_TURN = 0.6
"""Minimum share of fixes that come in turn."""

APART = 14.0
"""Change of the median difference of two targets, in the usual step of the difference over the
root of the number of fixes, that two sensors with a constant offset do not have: six sigma."""


class Turn(NamedTuple):
    """How a sensor looks at its targets in turn."""

    seconds: float
    """Time after which it comes back to the same target, s."""
    offset: float | None
    """Constant distance of the two that take turns, m: these may be two sensors of one target.
    None if there are more, or if it changes."""


class SingleFixes(NamedTuple):
    """The last fixes with a stamp of their own and no name, of one sensor."""

    sensor: str = ''
    stamps: Annotated[IntArray, 'f'] = np.empty(0, np.int64)
    """Rising, ns."""
    places: Annotated[FloatArray, 'f2'] = np.empty((0, 2))
    """m."""

    def turn(self) -> Turn | None:
        """Return the turn of the sensor; None if it does not turn, or if fixes are few."""
        if len(self.stamps) < 2 * BEFORE:
            return None
        return turn_of(self.stamps, self.places)


def remember_single_fixes(known: Known, group: Group) -> Known:
    """Remember the fix of a group of one; forget all if the sensor gives scans. A stage."""
    if group.target_id is not None or group.config.scan_period != 0.0 or not len(group.z):
        return known
    before: SingleFixes = known.memory['single']
    if before.sensor != group.sensor or len(group.z) > 1:
        before = SingleFixes(group.sensor)
    if len(group.z) == 1:
        stamps = np.append(before.stamps, known.stamp_ns)[-MOST_FIXES:]
        places = np.concatenate([before.places, group.z])[-MOST_FIXES:]
        before = SingleFixes(group.sensor, stamps, places)
    return known.with_memory(single=before)


def turn_of(stamps_ns: IntArray, places: FloatArray) -> Turn | None:
    """Return the turn of a sensor that stamps each fix by itself; None if it does not turn.

    Of the fixes before one, the last that is as near as those of one target are is its own.

    :param stamps_ns: (n,) rising, of more than `BEFORE` fixes.
    :param places: (n, 2).
    """
    if 10 * len(np.unique(stamps_ns)) < 9 * len(stamps_ns):
        return None
    rows = range(BEFORE, len(stamps_ns))
    apart = [np.hypot(*(places[k - BEFORE : k] - places[k]).T) for k in rows]
    near = 4.0 * float(np.median([distance.min() for distance in apart]))
    back = [(k, np.flatnonzero(distance <= near)) for k, distance in zip(rows, apart)]
    last = np.array([(k, k - BEFORE + before[-1]) for k, before in back if len(before)])
    seconds = (stamps_ns[last[:, 0]] - stamps_ns[last[:, 1]]) * 1e-9
    period, between = float(np.median(seconds)), last[:, 0] - last[:, 1]
    in_turn = (np.abs(seconds - period) <= 0.25 * period) & (between > 1)
    if np.mean(in_turn) <= IN_TURN:
        return None
    offset = _constant_offset(stamps_ns, places, period, near) if np.median(between) == 2 else None
    return Turn(period, offset)


def _constant_offset(
    stamps_ns: IntArray, places: FloatArray, period: float, near: float
) -> float | None:
    """Return the length of the difference of two that take turns, m; None if it changes.

    near: distance, m, of two successive fixes of one.
    """
    halves = np.rint(np.diff(stamps_ns) * 2e-9 / period).astype(np.int64)
    sign = np.where(np.cumsum(halves) % 2, 1.0, -1.0)[:-1]
    two = places[2:] - places[:-2]
    used = (halves[1:] == 1) & (halves[:-1] == 1) & (np.hypot(*two.T) <= near)
    if used.sum() < 8:
        return None
    # The middle of two of the one, less the other: motion cancels.
    difference = (sign[:, None] * (places[1:-1] - 0.5 * (places[2:] + places[:-2])))[used]
    step = float(np.median(np.hypot(*np.diff(difference, axis=0).T)))
    parts = np.array([np.median(part, axis=0) for part in np.array_split(difference, 4)])
    if np.ptp(parts, axis=0).max() > APART * step / np.sqrt(len(difference) // 4) + 1e-9:
        return None
    return float(np.hypot(*np.median(difference, axis=0)))


def warnings(known: SingleFixes, config: DiverConfig) -> list[str]:
    """Return a warning about fixes that have to be joined to scans, or whose sensors differ."""
    turn = known.turn() if config.scan_period == 0.0 else None
    if turn is None:
        return []
    period = turn.seconds
    if turn.offset is not None:
        return [
            f'two groups of fixes take turns of {period:.3g} s and lie {turn.offset:.2g} m apart, '
            'always the same way. If they are two sensors of one target with an offset between '
            'them, give each its own frame; if they are two targets, set scan_period to '
            f'{period:.3g}'
        ]
    return [
        f'every fix has a stamp of its own, and each target comes again after {period:.3g} s: a '
        f'scan of one fix misses all others. Set scan_period to {period:.3g}, which joins them; '
        '-1 if fixes are no scans'
    ]
