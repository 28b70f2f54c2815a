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

"""What share of the messages the tracker could not use, and why: too late, in another frame, ...

Single messages are lost at sea all the time. When a tenth of them is, something is set up wrongly:
two publishers whose clocks disagree, a sensor in another frame, a tracker without navigation.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping

REASONS = frozenset(
    {
        'doubted',
        'full',
        'navigation_gap',
        'navigation_missing',
        'no_origin',
        'other_depths',
        'other_frame',
        'too_late',
        'unknown_type',
        'vessel_pose_gap',
        'vessel_pose_missing',
    }
)
"""Counts of a tracker that say that a message was of no use."""
HINTS = {
    'too_late': 'too_late (older than the history: a long delay, or clocks that disagree)',
    'doubted': 'doubted (their stamps do not go on from those before)',
}
WINDOW = 10.0
"""Seconds over which the share is taken."""
SHARE, LEAST = 0.1, 5
"""The share, and the number of messages, from which on it is said."""


class Unused:
    """The share of the messages of the last seconds that were not used."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, int, Counter[str]]] = deque()

    def sentence(self, now: float, received: int, counts: Mapping[str, int]) -> str:
        """What to say, nothing where all is well. now: steady s; received, counts: so far."""
        unused = Counter({name: n for name, n in counts.items() if name in REASONS})
        self._past.append((now, received, unused))
        while len(self._past) > 1 and self._past[1][0] <= now - WINDOW:
            self._past.popleft()
        then, before, then_unused = self._past[0]
        fresh, lost = received - before, unused - then_unused
        if lost.total() < max(LEAST, SHARE * fresh):
            return ''
        reasons = ', '.join(HINTS.get(name, name) for name, _ in lost.most_common(3))
        share = 100.0 * min(1.0, lost.total() / max(fresh, 1))
        return f'{share:.0f} % of the messages of the last {now - then:.0f} s not used: {reasons}'
