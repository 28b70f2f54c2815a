# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A vessel that is said to be where it cannot have come to.

A receiver that loses its satellites may jump by thousands of kilometres for a moment, and all that
is placed from the vessel jumps along. Such a position is refused. A vessel that stays there was
moved in the books, by another origin for instance, or was never where it was said to be first:
after `STAYS` seconds and `LEAST` positions that agree it is believed again.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

from attrs import define, field

from ..measurements import Navigation, Rejection, VesselFix

FASTEST, NEAR = 100.0, 1000.0
"""m/s, m: no ship is faster, or jumps further."""
STAYS, LEAST = 2.0, 3
"""Seconds and positions after which a vessel is believed to be where it jumped."""
DEGREE = 111e3
"""Metres of a degree of latitude."""
MOST_FRAMES = 100
"""Frames whose vessel is remembered; the oldest are forgotten for more."""


class Place(NamedTuple):
    """Where a vessel was."""

    stamp_ns: int
    x: float
    """East or first axis, m; of a position on Earth, degrees east."""
    y: float
    """North or second axis, m; of a position on Earth, degrees north."""
    since_ns: int
    """Stamp of the first position of those that agree."""
    times: int = 1
    """How many agree."""


@define(eq=False)
class LeapFilter:
    """Refuses positions of a vessel that leap. STATE: see `trackers.Tracker`."""

    STATE: ClassVar = ('_known', '_tried')

    _known: dict[str, Place] = field(init=False, factory=dict)
    """The last position that was believed, by kind and frame."""
    _tried: dict[str, Place] = field(init=False, factory=dict)
    """The last position that was refused since."""

    def reset(self) -> None:
        """Forget all vessels."""
        self._known, self._tried = {}, {}

    def check(self, measurement: Any) -> None:
        """Raise `Rejection` for the position of a vessel that cannot have come there."""
        if isinstance(measurement, Navigation):
            x, y = measurement.position[:2].tolist()
            on_earth = False
        elif isinstance(measurement, VesselFix):
            x, y, on_earth = measurement.longitude, measurement.latitude, True
        else:
            return
        name = f'{"earth" if on_earth else "metres"}\0{measurement.frame_id}'
        place = Place(measurement.stamp_ns, x, y, measurement.stamp_ns)
        known = self._known.get(name)
        if known is not None and (way := _leap(known, place, on_earth)):
            tried = self._tried.get(name)
            if tried is not None and not _leap(tried, place, on_earth):
                place = place._replace(since_ns=tried.since_ns, times=tried.times + 1)
            if place.times < LEAST or abs(place.stamp_ns - place.since_ns) < STAYS * 1e9:
                self._tried[name] = place
                seconds = abs(place.stamp_ns - known.stamp_ns) * 1e-9
                raise Rejection(
                    'leap',
                    f'the vessel is {way:.3g} m from where it was {seconds:.3g} s before; it is '
                    f'believed again when it stays there for {STAYS:g} s',
                )
        self._tried.pop(name, None)
        if known is None and len(self._known) >= MOST_FRAMES:
            self._known.pop(next(iter(self._known)))
        self._known[name] = place


def _leap(before: Place, after: Place, on_earth: bool) -> float:
    """How far a vessel is from where it was, m, where it cannot have gone so far; else 0."""
    x, y = after.x - before.x, after.y - before.y
    if on_earth:
        x = (x + 180.0) % 360.0 - 180.0
        x, y = DEGREE * math.cos(math.radians(after.y)) * x, DEGREE * y
    way = math.hypot(x, y)
    seconds = abs(after.stamp_ns - before.stamp_ns) * 1e-9
    return way if way > NEAR + FASTEST * seconds else 0.0
