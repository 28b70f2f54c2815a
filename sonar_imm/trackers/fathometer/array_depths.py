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

"""How deep the array was, as a companion instrument tells it, and whether it kept still."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Mapping

import numpy as np

from ...measurements import ArrayDepth
from .config import FathometerConfig

MOST_HEAVE = 0.05
"""Standard deviation of the depth within a record, m, above which it is said: a sinusoid of so
much leaves 0.62 of an echo in 50 Hz to 4 kHz (the mean of J0(2 k A), A its amplitude)."""
_DEPTHS_KEPT = 10_000


class ToldDepths:
    """The newest words of the companion, by stamp."""

    def __init__(self) -> None:
        self._told: list[tuple[int, float]] = []

    def hear(self, depth: ArrayDepth) -> None:
        insort(self._told, (depth.stamp_ns, depth.depth))
        del self._told[:-_DEPTHS_KEPT]

    def over(self, stamp_ns: int, span_ns: int, config: FathometerConfig) -> float | None:
        """The mean of what was said over `span_ns` before the stamp; else `nearest`."""
        within = self._within(stamp_ns, span_ns)
        return float(np.mean(within)) if within else self.nearest(stamp_ns, config)

    def nearest(self, stamp_ns: int, config: FathometerConfig) -> float | None:
        """The nearest word; None when there is none that is recent enough."""
        place = bisect_right(self._told, (stamp_ns, np.inf))
        near = self._told[max(0, place - 1) : place + 1]
        if near:
            stamp, depth = min(near, key=lambda one: abs(one[0] - stamp_ns))
            if abs(stamp - stamp_ns) <= config.array_depth_age * 1e9:
                return depth
        return None

    def spread(self, stamp_ns: int, span_ns: int) -> float:
        """Standard deviation of what was said over `span_ns` before the stamp, m; 0 of nothing."""
        within = self._within(stamp_ns, span_ns)
        return float(np.std(within)) if within else 0.0

    def _within(self, stamp_ns: int, span_ns: int) -> list[float]:
        low = bisect_left(self._told, (stamp_ns - span_ns, -np.inf))
        high = bisect_right(self._told, (stamp_ns, np.inf))
        return [depth for _, depth in self._told[low:high]]


def array_warnings(counts: Mapping[str, int]) -> list[str]:
    """Sentences for what was counted of arrays."""
    found = []
    if few := counts.get('few_snapshots'):
        found.append(
            f'{few} records average fewer independent snapshots than the array has hydrophones: '
            'make them longer (record_seconds), or track less deep (depth_max)'
        )
    if moved := counts.get('heave_within_record'):
        found.append(
            f'in {moved} records the array heaves by more than {MOST_HEAVE:g} m: their echoes '
            'are weaker than they should be'
        )
    return found
