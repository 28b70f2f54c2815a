# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What all members of a set share: a shift of the record against the lattice, or a jump.

What is at z shows at z + shift in a record, the same shift for every member, with a new one in
each record: that of an instrument whose own place is told with an error. The shift is a state of
the particle, on a grid of whole cells, stationary N(0, std^2), either drawn anew in each record or
with a memory (an autoregression of first order on the grid). Its proposal sees the record::

    q(shift) = share * p(shift | before) exp(sum_i log Z(z_i + shift)) / sum + (1 - share) * p

where Z, by sign, is what the walks from a cell hold of the record, so that a few members that were
followed well fix the shift before any of them walks.

Records tell where members lie plus the shift, and never one of both alone. All members lower and
all shifts since the first record higher by the same offset d explain every record as well; only
the path of shifts has to be likely. Sets that survive a record which few of them explain, such as
the first, share the shift of one or two, so that the particles would be far too sure of it. The
offset is therefore drawn again for each particle, given its own path (a Gibbs move, which leaves
the posterior as it is)::

    p(d) ~ exp(-d^2 precision / 2 - d pull),  precision = 1 / std^2 + T (1 - phi)^2 / q
    pull = s_0 / std^2 + sum_t (1 - phi) (s_t - phi s_(t-1)) / q,     q = std^2 (1 - phi^2)

for shifts s_0 .. s_T of memory phi (`ShiftPath`). What is reported of shift and places has the
mean of that offset and its variance in place of one draw.

A jump is drawn as a shift is, from what it is beforehand and what the walks after it hold of the
record, but it is no state: all members are then elsewhere, and stay there. With `Jump` a set stays
where it is with the probability ``1 - probability``; else it jumps by N(0, std^2), which is cut at
`reach`. What jumps off the lattice is impossible.

W. R. Gilks and C. Berzuini, *Following a moving target: Monte Carlo inference for dynamic Bayesian
models*, J. R. Statist. Soc. B 63 (2001).
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from attrs import frozen
import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri

from .arrays import FloatArray, IntArray

_REACH = 4.0
_TINY = 1e-280
"""A probability that is less is had by its logarithm."""
MAX_SHIFTS = 401


@frozen(kw_only=True)
class Shift:
    """std: stationary standard deviation in cells; memory: share of the shift that stays from
    record to record, 0 for one that is drawn anew; step: of the grid, cells."""

    std: float
    memory: float = 0.0
    step: int = 1

    def __attrs_post_init__(self) -> None:
        if not (self.std > 0.0 and 0.0 <= self.memory < 1.0 and self.step >= 1):
            raise ValueError('a shift needs std > 0, memory in [0, 1), step >= 1')
        if self.count > MAX_SHIFTS:
            raise ValueError(f'{self.count} shifts; at most {MAX_SHIFTS} are tried')

    @property
    def pad(self) -> int:
        """Largest shift, cells."""
        return self.step * max(1, math.ceil(_REACH * self.std / self.step))

    @property
    def count(self) -> int:
        return 2 * self.pad // self.step + 1

    @property
    def places(self) -> FloatArray:
        """Shifts (G,) in cells."""
        return np.arange(-self.pad, self.pad + 1, self.step, dtype=np.float64)

    def log_start(self) -> FloatArray:
        """log p(shift) (G,) before the first record."""
        return _log_normal(self.places, self.std)

    def log_prior(self) -> FloatArray:
        """log p(shift | before) (G, G), rows from."""
        std = self.std * math.sqrt(1.0 - self.memory**2)
        return _log_normal(self.places - self.memory * self.places[:, None], std)


class ShiftPath(NamedTuple):
    """What the shifts of each particle so far say of an offset that all of them share: pull (N,)
    in 1 / cells and precision in 1 / cells^2, see the module's text."""

    pull: Annotated[FloatArray, 'N']
    precision: float

    @classmethod
    def begin(cls, shift: Shift, place: IntArray) -> ShiftPath:
        """Of the shifts plus pad (N,) of the first record. Those before it, which members were
        born with, are integrated out: it may have members anywhere."""
        return cls((place - shift.pad) / shift.std**2, shift.std**-2)

    def then(self, shift: Shift, before: IntArray, place: IntArray) -> ShiftPath:
        """With the shifts plus pad of one more record, `before` those of the record before."""
        phi = shift.memory
        slope = (1.0 - phi) / (shift.std**2 * (1.0 - phi**2))
        innovation = (place - shift.pad) - phi * (before - shift.pad)
        return ShiftPath(self.pull + slope * innovation, self.precision + slope * (1.0 - phi))

    def take(self, index: IntArray) -> ShiftPath:
        return self._replace(pull=self.pull[index])

    def moved(self, d: FloatArray) -> ShiftPath:
        """The same offset for shifts that are less by d (N,) cells."""
        return self._replace(pull=self.pull - self.precision * d)

    @property
    def mean(self) -> FloatArray:
        """Of the offset (N,), cells."""
        return -self.pull / self.precision

    def draw(
        self, shift: Shift, place: IntArray, room: tuple[IntArray, IntArray], u: FloatArray
    ) -> tuple[IntArray, ShiftPath]:
        """Offsets (N,) in cells, multiples of the step, and the path with them. place (N,): the
        newest shifts plus pad; room: the least and the greatest offset (N,) that leave all members
        on the lattice; u (N, 2) uniform. Drawn from a rounded Gaussian and, by Metropolis and
        Hastings, exact on the grid; what leads off the lattice or beyond the greatest shift
        stays."""
        std, middle = 1.0 / math.sqrt(self.precision), self.mean
        drawn = middle + std * ndtri(np.clip(u[:, 0], 1e-16, 1.0 - 1e-16))
        d = shift.step * np.rint(drawn / shift.step)
        # log of target over proposal, there and where it is.
        gain = _log_share(d, middle, std, shift.step) - _log_share(0.0, middle, std, shift.step)
        inside = (place + d >= 0) & (place + d <= 2 * shift.pad) & (d >= room[0]) & (d <= room[1])
        d = np.where(inside & (np.log1p(-u[:, 1]) < gain), d, 0.0)
        return d.astype(np.int64), self._replace(pull=self.pull + self.precision * d)


def _log_share(d: FloatArray | float, middle: FloatArray, std: float, step: int) -> FloatArray:
    """log of the normal density at d over the share of it that is rounded to d."""
    x, half = np.abs(d - middle) / std, 0.5 * step / std
    share = ndtr(half - x) - ndtr(-half - x)
    with np.errstate(divide='ignore', invalid='ignore'):
        log_share = np.log(share)
    far = np.flatnonzero(~(share > _TINY))
    above, below = log_ndtr(half - x[far]), log_ndtr(-half - x[far])
    log_share[far] = above + np.log1p(-np.exp(below - above))
    return np.asarray(-0.5 * x * x - log_share)


def _log_normal(x: FloatArray, std: float) -> FloatArray:
    """Logarithm of a normal density at x (..., G), made to sum to one."""
    value = -0.5 * np.square(x / std)
    best = value.max(axis=-1, keepdims=True)
    return np.asarray(value - best - np.log(np.exp(value - best).sum(axis=-1, keepdims=True)))


class ShiftTables(NamedTuple):
    """start (G,) running sum of p(shift) before the first record, empty for a jump; log_prior (G,
    G), a single row where nothing is remembered, and prior, the running sums of its rows."""

    start: FloatArray
    log_prior: FloatArray
    prior: FloatArray

    @classmethod
    def of(cls, shift: Shift) -> ShiftTables:
        start, log_prior = shift.log_start(), shift.log_start()[None]
        if shift.memory:
            log_prior = shift.log_prior()
        return cls(np.cumsum(np.exp(start)), log_prior, np.cumsum(np.exp(log_prior), axis=1))


@frozen(kw_only=True)
class Jump:
    """probability: of a jump until the next record, whenever that comes; std: standard deviation,
    cells; step: of the grid of jumps, cells; reach: the farthest, steps."""

    probability: float
    std: float
    step: int
    reach: int

    def __attrs_post_init__(self) -> None:
        if not (0.0 < self.probability < 1.0 and self.std > 0.0 and self.step >= 1):
            raise ValueError('a jump needs a probability in (0, 1), std > 0, step >= 1')
        if not 1 <= self.reach <= MAX_SHIFTS // 2:
            raise ValueError(f'a jump reaches 1 to {MAX_SHIFTS // 2} steps')

    @property
    def pad(self) -> int:
        """Farthest jump, cells."""
        return self.step * self.reach

    def tables(self) -> ShiftTables:
        """Of the jump plus pad."""
        places = np.arange(-self.pad, self.pad + 1, self.step, dtype=np.float64)
        prior = self.probability * np.exp(_log_normal(places, self.std))
        prior[self.reach] += 1.0 - self.probability
        return ShiftTables(
            np.empty(0), np.log(np.maximum(prior, _TINY))[None], np.cumsum(prior)[None]
        )
