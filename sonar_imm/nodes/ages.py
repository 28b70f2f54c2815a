# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How old estimates are when they are published, and how long their messages waited in the node.

The age is the node's clock minus the stamp of the newest estimate; the wait is the time from the
reception of a message by the middleware to the publication. So three causes are told apart: the
node is too slow (the wait is long), messages arrive late (the age is long, the wait is not), and a
clock is off (the age is longer than any delay, or negative).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from attrs import define, field
import numpy as np

WINDOW, LEAST = 10.0, 5
"""Seconds over which ages are judged, and the least number of estimates."""
LEAST_LIMIT, PERIODS = 1.0, 3.0
"""Seconds, and periods of the estimates, of which the greater one is the limit of the age."""
LONGEST_DELAY, LONGEST_OFFSET = 60.0, 86_400.0
"""Seconds: an older stamp is of a clock that is off, and one older than that of a recording."""


class _Published(NamedTuple):
    now: float
    age: float
    wait: float


class AgeReport(NamedTuple):
    """Ages of the last estimates."""

    values: dict[str, float]
    """Numbers for /diagnostics."""
    slow: str = ''
    """Sentence about a node that is too slow, or messages that arrive late; empty if neither."""
    clock: str = ''
    """Sentence about a clock that is off; empty if none is."""


@define
class Ages:
    """Ages and waits of the estimates of the last seconds."""

    _last: deque[_Published] = field(factory=lambda: deque(maxlen=1000))

    def published(self, now: float, age: float, wait: float) -> None:
        """Note an estimate.

        :param now: steady time, s.
        :param age: time since its stamp, s.
        :param wait: time since its message was received, s; NaN if not known.
        """
        self._last.append(_Published(now, age, wait))

    def report(self, now: float, limit: float = 0.0) -> AgeReport:
        """Judge the ages.

        :param now: steady time, s.
        :param limit: longest age without a sentence, s; 0 for the greater of `LEAST_LIMIT` and
            `PERIODS` periods of the estimates.
        """
        while len(self._last) > LEAST and self._last[0].now < now - WINDOW:
            self._last.popleft()
        if not self._last:
            return AgeReport({})
        when, age, wait = (np.array(column) for column in zip(*self._last))
        p50, p99 = (float(value) for value in np.percentile(age, (50, 99)))
        values = {'age of estimates p50 [s]': p50, 'age of estimates p99 [s]': p99}
        waited = 0.0
        if (known := wait[np.isfinite(wait)]).size:
            waited = float(np.median(known))
            values['waited in the queue p50 [s]'] = waited
        if len(age) < LEAST:
            return AgeReport(values)
        period = float(when[-1] - when[0]) / (len(when) - 1)
        if now - when[-1] > max(WINDOW, PERIODS * period):
            return AgeReport({})  # silence is told as such
        limit = limit or max(LEAST_LIMIT, PERIODS * period)
        off, clock = p50 - waited, ''
        if LONGEST_DELAY < off < LONGEST_OFFSET or -LONGEST_OFFSET < off < -LEAST_LIMIT:
            way = 'behind' if off > 0.0 else 'ahead of'
            clock = f'stamps are {abs(off):.0f} s {way} the clock of this computer: one is off'
        if waited > limit:
            slow = f'estimates are {waited:.1f} s old: input comes faster than it can be processed'
            return AgeReport(values, slow, clock)
        if clock:
            return AgeReport(values, clock=clock)
        if limit < p50 <= LONGEST_DELAY:
            slow = f'estimates are {p50:.1f} s old, because their messages arrive that late'
            return AgeReport(values, slow)
        return AgeReport(values)
