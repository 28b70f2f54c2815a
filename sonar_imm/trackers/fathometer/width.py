# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How wide the echoes of traces are, where nobody has told it.

A pulse that is too narrow makes several reflectors of one. The width of the loudest echoes at half
of their height, the narrowest of them in each trace, since layers near each other look like a
wider one, and the median of that over traces, shows whether the pulse of the band fits. Where it
does not, echoes are taken for Gaussian, and as wide as they are.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

from attrs import define, evolve, field
import numpy as np

from ...acoustics.fathometer import noise_sigma
from ...acoustics.pulse import Pulse
from ...estimation.arrays import FloatArray
from ...measurements import Trace
from .config import FathometerConfig, PULSE_WIDTHS
from .noise import stated_sigma

LOOKS = 1, 5, 15, 60
"""Traces with a loud echo after which the pulse may be another one, the last for good."""
ECHOES, LOUD, LEAST_SAMPLES = 3, 10.0, 1.2
"""Echoes of each trace that count; how loud they are, in sigma, and how wide, in samples."""
TIMES, CLOSE, APART = 1.5, 0.1, 3.0
"""By how much the pulse of the band is too wide or too narrow, and one that is used may be; in
standard deviations, how near two echoes make one hump."""
HALF = math.sqrt(2.0 * math.log(2.0))


@define(eq=False)
class EchoWidth:
    """STATE: see `trackers.Tracker`. _seen (n,): half widths of echoes at half of their height, m;
    followed: standard deviation of the pulse that is used, 0 for that of the band, and separation:
    least distance of two reflectors with it, m."""

    STATE: ClassVar = ('_seen', 'followed', 'separation')

    _seen: Annotated[FloatArray, 'n'] = field(init=False, factory=lambda: np.empty(0))
    followed: float = field(init=False, default=0.0)
    separation: float = field(init=False, default=0.0)

    def take(self, trace: Trace, config: FathometerConfig, band: Pulse) -> bool:
        """Take a trace; whether another pulse is to be used from it on."""
        if config.pulse != 'auto' or len(self._seen) >= LOOKS[-1]:
            return False
        amplitude = np.nan_to_num(trace.amplitude)
        sigma = stated_sigma(trace, trace.depth, config.noise_sigma)
        with np.errstate(all='ignore'):
            if sigma is None:
                sigma = np.full(len(amplitude), noise_sigma(amplitude))
            found = trace.step * half_width(np.nan_to_num(amplitude / sigma))
        if not math.isfinite(found):
            return False
        self._seen = np.append(self._seen, found)
        if len(self._seen) not in LOOKS:
            return False
        half, least = float(np.median(self._seen)), LEAST_SAMPLES * trace.step
        lag = 0.01 * least * np.arange(100.0 * max(1.0, 10.0 * half / least))
        below = np.flatnonzero(band(lag) < 0.5)
        due = float(lag[below[0]]) if len(below) else math.inf
        fits = due / TIMES < half < due * TIMES or max(half, due) < least
        width = 0.0 if fits else max(half, least) / HALF
        if width and not _can_be(width):
            return False
        if abs(width - self.followed) <= CLOSE * self.followed:
            return False
        self.followed = width
        span = float(trace.depth[-1] - trace.depth[0])
        if config.depth_max:
            span = min(span, config.depth_max - config.depth_min)
        self.separation = min(APART * width, 0.8 * span / config.order_max)
        return True

    def effective(self, config: FathometerConfig) -> FathometerConfig:
        """`config` with the pulse that is used, and as much room for it."""
        if not self.followed or config.pulse != 'auto':
            return config
        separation = max(config.min_separation, self.separation)
        return evolve(
            config, pulse='gaussian', pulse_width=self.followed, min_separation=separation
        )

    def require(self) -> None:
        """Raise ValueError where the state, which may come from a file, is impossible."""
        good = np.isfinite(self._seen).all() and len(self._seen) <= LOOKS[-1]
        known = self.followed == 0.0 or _can_be(self.followed)
        if not (good and known and 0.0 <= self.separation <= APART * PULSE_WIDTHS[1]):
            raise ValueError('no echo is as wide as that')


def _can_be(width: float) -> bool:
    """Whether a pulse can be as wide as that, m."""
    return PULSE_WIDTHS[0] <= width <= PULSE_WIDTHS[1]


def half_width(b: FloatArray) -> float:
    """From the top to half of the height, in samples, of the narrowest of the loudest echoes in
    `b` (n,), in units of the noise; NaN where none is loud."""
    inner = b[1:-1]
    top = np.flatnonzero((inner > LOUD) & (inner >= b[:-2]) & (inner > b[2:])) + 1
    found = math.nan
    for k in top[np.argsort(-b[top])][:ECHOES].tolist():
        half, low = 0.5 * b[k], np.flatnonzero(b < 0.5 * b[k])
        place = int(np.searchsorted(low, k))
        if 0 < place < len(low):
            left, right = low[place - 1], low[place]
            first = left + (half - b[left]) / (b[left + 1] - b[left])
            last = right - (half - b[right]) / (b[right - 1] - b[right])
            found = float(np.fmin(found, 0.5 * (last - first)))
    return found
