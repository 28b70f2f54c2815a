# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the particle filter for sets of unknown size (`set_filter`) assumes of them and of records.

What is tracked is a set of m members, each a place on a line, m itself, the **order**, unknown and
changing; **births** and **deaths** may happen at any place and time. Places are the **cells of a
lattice**, the one on which a record is sampled, so that sums over places are exact, everything
that depends on a record is a table made once, and no particle ever looks at a whole record.

The set, in the order in which it is drawn
    1. the order m' from row m of ``transition`` (rows from, columns to, from ``order_min`` on);
    2. deaths: for m' < m, a uniformly drawn subset of m - m' leaves; with ``jump`` all that are
       left may move by the same distance, see `set_shifts`;
    3. each survivor walks by ``walk``, or by what is known of it beforehand (`Walks`); what leaves
       the lattice is impossible;
    4. births: for m' > m, m' - m are born, each uniformly on the lattice;
    5. sets whose members come closer than ``separation`` cells are impossible.
    Where the time of k records passed since the last one, 1 is drawn as k such changes of the
    order make it, together with how many members left and were replaced on the way (`turnover`),
    and 3 is the sum of k walks (`repeated_walk`). Where they were in between is of no interest, so
    that 5 is asked at the end only.
    Before the first record, m is drawn from ``start``, and the set uniformly among the possible
    ones of that size. If m is uniform, members say something of each other: beside eight that
    were seen, one more anywhere is nine times as probable as the first. With a Poisson m they say
    nothing (`independent_orders`).

The record
    ``b (n,)``, in units of its noise: the correlation of what was measured with the pulse that a
    single member leaves, whose own autocorrelation is ``gram``. The members answer with amplitudes
    a, in the same units. Given the places, b at the places is all that matters: with G =
    gram(z_i - z_j)

        log p(record | z, a) / p(record | nothing) = a' b - a' G a / 2,

    which equals the least-squares fit to the whole record, in O(m^3) instead of O(n). Amplitudes
    are not sampled:

    ``marginal``   a ~ N(0, s^2) is integrated out:
                   b' (G + I/s^2)^-1 b / 2 - log det(I + s^2 G) / 2
    ``bic_half``   the best a, and a penalty of log(N) / 2 for each member, N independent samples;
    ``paper``      the best a, and a penalty of log(N) for each. The prior of births already
                   charges for the place, so this charges twice: too much.

    With ``shift`` all of them show elsewhere by the same distance: see
    `set_shifts`.

Each member has a sign for life, drawn at its birth: negative with ``negative_probability``. A set
that needs an amplitude of another sign is impossible.

Sources: C. Yardim, P. Gerstoft, Z.-H. Michalopoulou, *Passive fathometer reflector identification
with multiple model particle filtering* (2012); the weights by first principles.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from attrs import Factory, field, frozen
import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray, IntArray
from .markov import check_transition_matrix
from .set_shifts import Jump, Shift

PRIORS = ('marginal', 'bic_half', 'paper')


def banded_transition(orders: int, switch: float) -> FloatArray:
    """Transition matrix (orders, orders): one more or one less with probability `switch` each; at
    the ends the probability of what cannot happen goes to staying."""
    P = np.diag(np.full(orders - 1, switch), 1) + np.diag(np.full(orders - 1, switch), -1)
    return np.asarray(P + np.diag(1.0 - P.sum(axis=1)))


def independent_orders(order_min: int, orders: int) -> FloatArray:
    """Probabilities (orders,) of the order of a set whose members lie independently of each other:
    Poisson. Its mean is one, so that each member is charged for its place, as a birth is, and for
    nothing else."""
    m = np.arange(order_min, order_min + orders, dtype=np.float64)
    chance = np.exp([math.lgamma(order_min + 1.0) - math.lgamma(k + 1.0) for k in m])
    return np.asarray(chance / chance.sum())


def walk_reach(std: float, *, reach: float = 4.0) -> float:
    """How many cells `gaussian_walk` reaches to either side."""
    return max(1.0, math.floor(reach * std)) if math.isfinite(reach * std) else math.inf


def gaussian_walk(std: float, *, reach: float = 4.0) -> FloatArray:
    """Probabilities (2 r + 1,) of a walk by -r .. r cells: Gaussian of `std` cells, cut at `reach`
    standard deviations."""
    radius = int(walk_reach(std, reach=reach))
    K = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / std))
    return np.asarray(K / K.sum())


def repeated_walk(walk: FloatArray, times: int, *, reach: float = 4.0) -> FloatArray:
    """Probabilities (2 r + 1,) of the sum of so many walks (2 r' + 1,), cut at `reach` standard
    deviations of it."""
    radius = len(walk) // 2
    size = 1 << (2 * radius * times).bit_length()
    padded = np.roll(np.append(walk, np.zeros(size - len(walk))), -radius)
    total = np.maximum(np.fft.irfft(np.fft.rfft(padded) ** times, size), 0.0)
    std = math.sqrt(times * float(walk @ np.square(np.arange(-radius, radius + 1.0))))
    cut = int(min(walk_reach(std, reach=reach), radius * times))
    K = total[np.arange(-cut, cut + 1)]
    return np.asarray(K / K.sum())


class Walks(NamedTuple):
    """How members walk by the time of a record, by the cell where each was: kind (n,) of a cell of
    the record; for each of T kinds centre (T,), cells, and probability (T, 2 r + 1) around it;
    wide: some reach further than a member is from the next, so that the peaks of the record are
    lowered to one mass."""

    kind: IntArray
    centre: IntArray
    probability: FloatArray
    wide: bool

    @classmethod
    def alike(cls, walk: FloatArray, cells: int, *, wide: bool = False) -> Walks:
        """All of them by `walk` (2 r + 1,)."""
        return cls(np.zeros(cells, np.int64), np.zeros(1, np.int64), walk[None], wide)


def turnover(transition: FloatArray, order_min: int, records: int) -> FloatArray:
    """How sets change while the time of so many records passes: probabilities
    (orders, (order_max + 1) orders), rows from. Column ``e * orders + j``: the order becomes
    order_min + j, and e members more have left, and come, than that takes.

    A Markov chain of the order and of the number of first members that are left: of the d that
    leave at once, those of the first are hypergeometric."""
    from scipy import sparse

    orders = len(transition)
    most = order_min + orders - 1
    rows, columns, values = [], [], []
    for i, j in zip(*np.nonzero(transition > 0.0)):
        m, deaths = order_min + int(i), max(int(i) - int(j), 0)
        for left in range(m + 1):
            for gone in range(max(0, deaths - (m - left)), min(deaths, left) + 1):
                ways = math.comb(left, gone) * math.comb(m - left, deaths - gone)
                rows.append(left * orders + i)
                columns.append((left - gone) * orders + j)
                values.append(transition[i, j] * ways / math.comb(m, deaths))
    shape = ((most + 1) * orders,) * 2
    step = sparse.csr_matrix((values, (rows, columns)), shape)
    chance = np.zeros((shape[0], orders))
    first = np.arange(orders)
    chance[(order_min + first) * orders + first, first] = 1.0
    for _ in range(records):
        chance = step.T @ chance
    kept, to, start = np.meshgrid(np.arange(most + 1), first, first, indexing='ij')
    extra = order_min + np.minimum(start, to) - kept
    found = np.zeros((orders, (most + 1) * orders))
    use = extra >= 0
    found[start[use], (extra * orders + to)[use]] = chance.reshape(kept.shape)[use]
    return found


@frozen(eq=False, kw_only=True)
class SetModel:
    """What is assumed of the set and of the record; see the module's text.

    cells: n, of the lattice; separation: smallest distance of two members, cells; order_min: the
    smallest set; transition (orders, orders); start (orders,), probabilities of the order before
    the first record, by default uniform; walk (2 r + 1,); gram (n,) by lag in cells, one at
    0; amplitude_prior: of PRIORS, with amplitude_std: s, and independent_samples: N;
    walk_share, birth_share and birth_cap: of the proposals; amplitude_memory: phi of a' = phi a +
    noise, with stationary standard deviation s, 0 for amplitudes drawn anew at each record;
    negative_probability: that a member is negative; shift: that all members share, jump: that all
    members make, None for none of it; only one of both.
    With a shift, records b have ``record_cells`` cells, the lattice with the largest shift before
    and after it.
    """

    cells: int
    separation: int
    order_min: int
    transition: FloatArray = field(converter=check_transition_matrix)
    walk: FloatArray
    gram: FloatArray
    amplitude_prior: str = 'marginal'
    amplitude_std: float = 7.5
    independent_samples: float = 500.0
    walk_share: float = 0.95
    birth_share: float = 0.75
    birth_cap: float = 8.0
    amplitude_memory: float = 0.0
    negative_probability: float = 0.0
    shift: Shift | None = None
    jump: Jump | None = None
    start: FloatArray = Factory(
        lambda self: np.full(len(self.transition), 1.0 / len(self.transition)), takes_self=True
    )

    def __attrs_post_init__(self) -> None:
        if self.amplitude_prior not in PRIORS:
            raise ValueError(f'amplitude_prior is one of {PRIORS}, not {self.amplitude_prior!r}')
        if self.amplitude_memory and self.amplitude_prior != 'marginal':
            raise ValueError('only marginal amplitudes can have a memory')
        if not 0.0 <= self.negative_probability < 1.0:
            raise ValueError('negative_probability lies in [0, 1)')
        if self.shift and self.jump:
            raise ValueError('members that share a shift do not jump as well')
        if self.order_min < 0 or self.separation < 1 or len(self.gram) < self.cells:
            raise ValueError('a set model needs order_min >= 0, separation >= 1, gram (n,)')
        if np.shape(self.start) != self.transition.shape[:1] or not np.all(self.start > 0.0):
            raise ValueError('start has a probability above zero for each order')
        if self.room(self.order_max) == 0:
            raise ValueError(
                f'{self.order_max} members {self.separation} cells apart do not fit into '
                f'{self.cells} cells'
            )

    @property
    def order_max(self) -> int:
        return self.order_min + len(self.transition) - 1

    @property
    def most_changes(self) -> int:
        """How many members can come or go at once."""
        rows, columns = np.nonzero(self.transition > 0.0)
        return int(np.abs(rows - columns).max())

    @property
    def mean_changes(self) -> float:
        """By how many members the order changes from record to record, on average over orders."""
        orders = np.arange(len(self.transition))
        return float((self.transition * np.abs(orders[:, None] - orders)).sum(axis=1).mean())

    @property
    def uniforms(self) -> int:
        """Random numbers a particle needs for one record."""
        shared = self.shift is not None or self.jump is not None
        return 1 + self.most_changes + self.order_max + shared

    @property
    def pad(self) -> int:
        """Largest shift, cells."""
        return self.shift.pad if self.shift else 0

    @property
    def record_cells(self) -> int:
        return self.cells + 2 * self.pad

    @property
    def signs(self) -> dict[int, float]:
        """The signs that members can have, and how probable each is at a birth."""
        negative = self.negative_probability
        return {1: 1.0 - negative, -1: negative} if negative else {1: 1.0}

    @property
    def ridge(self) -> float:
        """What is added to the diagonal of G: 1 / s^2, or nothing."""
        return self.amplitude_std**-2 if self.amplitude_prior == 'marginal' else 0.0

    @property
    def penalty(self) -> float:
        """What each member costs in log likelihood besides the determinant."""
        if self.amplitude_prior == 'marginal':
            return math.log(self.amplitude_std)
        half = 0.5 * math.log(self.independent_samples)
        return half if self.amplitude_prior == 'bic_half' else 2.0 * half

    def room(self, order: int) -> int:
        """The number of possible sets of that size."""
        free = self.cells - max(order - 1, 0) * (self.separation - 1)
        return math.comb(free, order) if free >= 0 else 0


class Sets(NamedTuple):
    """N sets: order (N,), cell (N, J) of which the first `order` count, ascending; prior_mean and
    prior_variance (N, J) of the amplitudes in units of the noise, (N, 0) without a memory; sign
    (N, J) of the amplitudes, 1 or -1; shift (N,) plus pad: what is in cell z shows in the record's
    cell z + shift."""

    order: Annotated[IntArray, 'N']
    cell: Annotated[IntArray, 'NJ']
    prior_mean: Annotated[FloatArray, 'Na']
    prior_variance: Annotated[FloatArray, 'Na']
    sign: Annotated[NDArray[np.int8], 'NJ']
    shift: Annotated[IntArray, 'N']

    @classmethod
    def empty(cls, model: SetModel, count: int) -> Sets:
        shape = count, model.order_max
        remembered = count, model.order_max if model.amplitude_memory else 0
        return cls(
            np.zeros(count, np.int64),
            np.zeros(shape, np.int64),
            np.zeros(remembered),
            np.full(remembered, model.amplitude_std**2),
            np.ones(shape, np.int8),
            np.full(count, model.pad, np.int64),
        )

    def take(self, index: IntArray) -> Sets:
        return Sets._make(column[index] for column in self)


class Left(NamedTuple):
    """Who is left of sets: order (N,), cell and sign (N, J) as they were; deaths (N,), how many
    members are not left, and parent (N, J), the members that are."""

    order: IntArray
    deaths: IntArray
    cell: IntArray
    sign: NDArray[np.int8]
    parent: IntArray

    @classmethod
    def all_of(cls, sets: Sets) -> Left:
        N, J = sets.cell.shape
        parent = np.tile(np.arange(J, dtype=np.int64), (N, 1))
        return cls(sets.order, np.zeros(N, np.int64), sets.cell, sets.sign, parent)


def leave(
    order_min: int, cumulative: FloatArray, sets: Sets, uniform: FloatArray
) -> tuple[Left, IntArray]:
    """Steps 1 and 2: who is left, and the order (N,) that the sets come to. cumulative (orders,
    columns): running sums of the rows of the transition matrix, or of `turnover`; uniform
    (N, U): a column for the order, then one for each death."""
    left, column = Left.all_of(sets), np.empty_like(sets.order)
    for row, chances in enumerate(cumulative):
        i = np.flatnonzero(sets.order == order_min + row)
        column[i] = np.searchsorted(chances, uniform[i, 0], 'right')
    column = np.minimum(column, cumulative.shape[1] - 1)
    replaced, order = np.divmod(column, len(cumulative))
    order += order_min
    left.deaths[:] = np.maximum(sets.order - order, 0) + replaced
    for k in range(int(left.deaths.max())):
        i = np.flatnonzero(left.deaths > k)
        members, parent = sets.order[i] - k, left.parent[i]
        death = np.minimum((uniform[i, 1 + k] * members).astype(np.int64), members - 1)
        behind = np.arange(parent.shape[1] - 1) >= death[:, None]
        parent[:, :-1] = np.where(behind, parent[:, 1:], parent[:, :-1])
        left.parent[i] = parent
    return left, order


def inherited(model: SetModel, old: Sets, parent: IntArray, new: Sets) -> Sets:
    """`new` with what its members know of their amplitudes by their parent (N, J), -1 for those
    that were born."""
    born, source = parent < 0, np.maximum(parent, 0)
    mean = np.take_along_axis(old.prior_mean, source, axis=1)
    variance = np.take_along_axis(old.prior_variance, source, axis=1)
    return new._replace(
        prior_mean=np.where(born, 0.0, mean),
        prior_variance=np.where(born, model.amplitude_std**2, variance),
    )


def aged(model: SetModel, sets: Sets, records: int) -> Sets:
    """Sets whose amplitudes, expected for the next record, are those for so many after it."""
    if records < 1 or not model.amplitude_memory:
        return sets
    phi = model.amplitude_memory**records
    fresh = (1.0 - phi**2) * model.amplitude_std**2
    return sets._replace(
        prior_mean=phi * sets.prior_mean, prior_variance=phi**2 * sets.prior_variance + fresh
    )


def remembered(model: SetModel, gram: FloatArray, sets: Sets, amplitude: FloatArray) -> Sets:
    """Sets whose amplitudes (N, J) after a record become those expected before the next, a' =
    phi a + noise. Each is kept for itself, given the others: in place of their full covariance
    that costs less than 0.1 % of accuracy while neighbouring pulses overlap by less than 0.3 (band
    pulses at the default separation: 0.06), and 2 to 6 % at 0.7."""
    phi, stationary = model.amplitude_memory, model.amplitude_std**2
    after = 1.0 / (gram[0] + 1.0 / sets.prior_variance)
    variance = phi * phi * after + (1.0 - phi * phi) * stationary
    return sets._replace(prior_mean=phi * amplitude, prior_variance=variance)
