"""A shift that all members of a set share: where the record lies against the lattice.

What is at z shows at z + shift in a record, the same shift for every member, with a new one in
each record: that of an instrument whose own place is told with an error. The shift is a state of
the particle, on a grid of whole cells, stationary N(0, std^2), either drawn anew in each record or
with a memory (an autoregression of first order on the grid). Its proposal sees the record::

    q(shift) = share * p(shift | before) exp(sum_i log Z(z_i + shift)) / sum + (1 - share) * p

where Z, by sign, is what the moves from a cell hold of the record, so that a few members that were
followed well fix the shift before any of them moves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from attrs import frozen
import numpy as np

from .arrays import FloatArray, IntArray
from .jit import kernel

_REACH = 4.0
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


def _log_normal(x: FloatArray, std: float) -> FloatArray:
    """Logarithm of a normal density at x (..., G), made to sum to one."""
    value = -0.5 * np.square(x / std)
    best = value.max(axis=-1, keepdims=True)
    return np.asarray(value - best - np.log(np.exp(value - best).sum(axis=-1, keepdims=True)))


class ShiftTables(NamedTuple):
    """Of one record: step; start (G,) running sum of p(shift) before the first record; log_prior
    (G, G); log_sum (S, n + 2 pad) log Z by sign, in the cells of the record; share of the
    data-driven proposal. Without a shift G is 1."""

    step: int
    start: FloatArray
    log_prior: FloatArray
    log_sum: FloatArray
    share: float


def shift_tables(shift: Shift | None, log_sum: FloatArray, share: float) -> ShiftTables:
    if shift is None:
        return ShiftTables(1, np.ones(1), np.zeros((1, 1)), log_sum, share)
    start = np.cumsum(np.exp(shift.log_start()))
    return ShiftTables(shift.step, start, shift.log_prior(), log_sum, share)


def propose_shift(
    tables: ShiftTables, before: int, cells: IntArray, negative: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Oracle for tests: q (G,) and log of model to proposal (G,) for members at `cells` (k,), with
    `negative` (k,) 1 for negative ones; before: the shift of the record before plus pad."""
    prior = tables.log_prior[before // tables.step]
    at = cells[:, None] + tables.step * np.arange(len(prior))
    score = prior + tables.log_sum[negative[:, None], at].sum(axis=0)
    driven = np.exp(score - score.max())
    q = tables.share * driven / driven.sum() + (1.0 - tables.share) * np.exp(prior)
    with np.errstate(divide='ignore'):
        return q, prior - np.log(q)


@kernel
def draw_shift(
    tables: ShiftTables,
    before: int,
    rows: IntArray,
    count: int,
    cells: int,
    uniform: float,
    q: FloatArray,
) -> tuple[int, float]:
    """The shift plus pad, and log of model to proposal: `propose_shift` for the members
    rows[:count], their cell plus `cells` (n + 2 pad) where they are negative. q (G,) is scratch.
    """
    step, G = tables.step, len(q)
    prior = tables.log_prior[before // step]
    for g in range(G):
        q[g] = prior[g]
    for k in range(count):
        negative = rows[k] // cells
        z = rows[k] - negative * cells
        table = tables.log_sum[negative]
        for g in range(G):
            q[g] += table[z + g * step]
    best, total = -math.inf, 0.0
    for g in range(G):
        best = max(best, q[g])
    for g in range(G):
        # What is less than e^-40 of the best is never drawn by these numbers.
        q[g] = math.exp(q[g] - best) if q[g] > best - 40.0 else 0.0
        total += q[g]
    running, mass = 0.0, 0.0
    for g in range(G):
        likely = math.exp(prior[g]) if prior[g] > -40.0 else 0.0
        q[g] = tables.share * q[g] / total + (1.0 - tables.share) * likely
        mass += q[g]
    chosen = -1
    for g in range(G):
        if q[g] > 0.0:
            chosen = g
            running += q[g]
            if running > uniform * mass:
                break
    return chosen * step, prior[chosen] - math.log(q[chosen] / mass)
