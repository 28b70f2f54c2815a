"""A particle filter for a set of things of unknown size: the multiple-model particle filter.

What is tracked is a set of m places on a line, m itself unknown and changing; things may be born
at, and leave from, any place at any time. A particle is one such set, ``[m, z_1 .. z_m]``, and the
filter is one importance sampler for sets of every size at once::

    sets, log_ratio = start(model, proposals, uniform, order)     # before the first record
    sets, log_ratio = propagate(model, proposals, sets, uniform)  # order, exits, moves, births
    log_likelihood, amplitude = weigh(model, b, sets)             # each set meets the record

Places are the **cells of a lattice**, the one on which a record is sampled, so that sums over
places are exact, everything that depends on a record is a table made once, and no particle ever
looks at a whole record.

The model, in the order in which it is drawn
    1. the order m' from row m of ``transition`` (rows from, columns to, from ``order_min`` on);
    2. for m' < m, a uniformly drawn subset of m - m' leaves;
    3. each of the rest moves by ``move``; what is moved off the lattice is impossible;
    4. for m' > m, m' - m are born, each uniformly on the lattice;
    5. sets whose members come closer than ``separation`` cells are impossible.
    Before the first record, m is uniform, and so is the set among the possible ones of that size.

The record
    ``b (n,)``, in units of its noise: the correlation of what was measured with the pulse that one
    thing leaves, whose own autocorrelation is ``gram``. The things answer with amplitudes a, in
    the same units. Given the places, b at the places is all that matters: with G = gram(z_i - z_j)

        log p(record | z, a) / p(record | nothing) = a' b - a' G a / 2,

    which equals the least-squares fit to the whole record, in O(m^3) instead of O(n). Amplitudes
    are not sampled:

    ``marginal``   a ~ N(0, s^2) is integrated out:
                   b' (G + I/s^2)^-1 b / 2 - log det(I + s^2 G) / 2
    ``bic_half``   the best a, and a penalty of log(N) / 2 for each thing, N independent samples;
    ``paper``      the best a, and a penalty of log(N) for each. The prior of births already
                   charges for the place, so this charges twice: too much.

    Each member has a sign for life, drawn at its birth: negative with ``negative_probability``. A
    set that needs an amplitude of another sign is impossible.

Data-driven proposals
    A move is drawn from ``share * K(z' - z) exp(g(z')) / Z(z) + (1 - share) * K(z' - z)``, with
    ``g = max(s b, 0)^2 / 2`` (what one thing of sign s alone would be worth); of the births a
    share is drawn in proportion to the sign's probability times ``exp(min(g, cap))`` and the rest
    uniformly, at the places that those already there leave free. The cap lets a weak peak have
    births beside a strong one; the uniform rest
    bounds the weight of a birth where the record shows nothing. Each draw is weighted by the exact
    ratio of model to proposal, so proposals change how many particles are needed and nothing else.
    Shares of zero make the bootstrap filter: with eight sharp peaks in a record, all but a handful
    of its particles are lost at every step.

The random numbers, uniform in [0, 1), are given, one row per particle: ``uniform (N, 1 + c + J)``
for the order, the c things that can come or go at once, and the J things that can move. Row i is
all that particle i uses, so that particles may be worked on in any order, by any number of
threads.

This module is the readable form, one array operation for all particles; `set_particles_kernels`
is the compiled one, and `set_filter` runs it.

Sources: C. Yardim, P. Gerstoft, Z.-H. Michalopoulou, *Passive fathometer reflector identification
with multiple model particle filtering* (2012); the weights by first principles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from attrs import field, frozen
import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray, IntArray
from .markov import check_transition_matrix

PRIORS = ('marginal', 'bic_half', 'paper')
IMPOSSIBLE = -math.inf


def banded_transition(orders: int, switch: float) -> FloatArray:
    """Transition matrix (orders, orders): one more or one less with probability `switch` each; at
    the ends the probability of what cannot happen goes to staying."""
    P = np.diag(np.full(orders - 1, switch), 1) + np.diag(np.full(orders - 1, switch), -1)
    return np.asarray(P + np.diag(1.0 - P.sum(axis=1)))


def move_reach(std: float, *, reach: float = 4.0) -> float:
    """How many cells `gaussian_move` reaches to either side."""
    return max(1.0, math.floor(reach * std)) if math.isfinite(reach * std) else math.inf


def gaussian_move(std: float, *, reach: float = 4.0) -> FloatArray:
    """Probabilities (2 r + 1,) of moving by -r .. r cells: Gaussian of `std` cells, cut at `reach`
    standard deviations."""
    radius = int(move_reach(std, reach=reach))
    K = np.exp(-0.5 * np.square(np.arange(-radius, radius + 1) / std))
    return np.asarray(K / K.sum())


@frozen(eq=False, kw_only=True)
class SetModel:
    """What is assumed of the set and of the record; see the module's text.

    cells: n, of the lattice; separation: smallest distance of two members, cells; order_min: the
    smallest set; transition (orders, orders); move (2 r + 1,); gram (n,) by lag in cells, one at
    0; amplitude_prior: one of PRIORS, with amplitude_std: s, and independent_samples: N;
    move_share, birth_share and birth_cap: of the proposals; amplitude_memory: phi of a' = phi a +
    noise, with stationary standard deviation s, 0 for amplitudes drawn anew at each record;
    negative_probability: that a member is negative.
    """

    cells: int
    separation: int
    order_min: int
    transition: FloatArray = field(converter=check_transition_matrix)
    move: FloatArray
    gram: FloatArray
    amplitude_prior: str = 'marginal'
    amplitude_std: float = 7.5
    independent_samples: float = 500.0
    move_share: float = 0.95
    birth_share: float = 0.75
    birth_cap: float = 8.0
    amplitude_memory: float = 0.0
    negative_probability: float = 0.0

    def __attrs_post_init__(self) -> None:
        if self.amplitude_prior not in PRIORS:
            raise ValueError(f'amplitude_prior is one of {PRIORS}, not {self.amplitude_prior!r}')
        if self.amplitude_memory and self.amplitude_prior != 'marginal':
            raise ValueError('only marginal amplitudes can have a memory')
        if not 0.0 <= self.negative_probability < 1.0:
            raise ValueError('negative_probability lies in [0, 1)')
        if self.order_min < 0 or self.separation < 1 or len(self.gram) < self.cells:
            raise ValueError('a set model needs order_min >= 0, separation >= 1, gram (n,)')
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
    def uniforms(self) -> int:
        """Random numbers a particle needs for one record."""
        return 1 + self.most_changes + self.order_max

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
    prior_variance (N, J) of the amplitudes in units of the noise, used with a memory only; sign
    (N, J) of the amplitudes, 1 or -1."""

    order: IntArray
    cell: IntArray
    prior_mean: FloatArray
    prior_variance: FloatArray
    sign: NDArray[np.int8]

    @classmethod
    def empty(cls, model: SetModel, count: int) -> Sets:
        shape = count, model.order_max
        return cls(
            np.zeros(count, np.int64),
            np.zeros(shape, np.int64),
            np.zeros(shape),
            np.full(shape, model.amplitude_std**2),
            np.ones(shape, np.int8),
        )

    def take(self, index: IntArray) -> Sets:
        return Sets._make(column[index] for column in self)


class Proposals(NamedTuple):
    """Tables of one record, for S signs: move (S n, 2 r + 1) cumulative, move_ratio (S n, 2 r + 1)
    log of model to proposal, for cells from which something moves (others are not filled in),
    negative members in the second n rows; birth (n + 1,) running sum of the birth weights of both
    signs, birth_ratio (S, n) log of model to weight, birth_positive (n,) the weight of positive
    births."""

    move: FloatArray
    move_ratio: FloatArray
    birth: FloatArray
    birth_ratio: FloatArray
    birth_positive: FloatArray


def gain(b: FloatArray) -> FloatArray:
    """g (n,): the best log likelihood ratio of one thing alone at each cell."""
    return np.asarray(0.5 * np.square(np.maximum(b, 0.0)))


def gains(model: SetModel, b: FloatArray) -> FloatArray:
    """g (S, n) for each sign."""
    return np.stack([gain(sign * b) for sign in model.signs])


def propose(model: SetModel, b: FloatArray) -> Proposals:
    """Oracle for tests: the tables for the record b (n,)."""
    n, radius = model.cells, len(model.move) // 2
    to = np.arange(n)[:, None] + np.arange(-radius, radius + 1)
    there = (to >= 0) & (to < n)
    K = np.where(there, model.move, 0.0)
    signs = len(model.signs)
    g = np.where(there, gains(model, b)[:, np.clip(to, 0, n - 1)], -np.inf).reshape(signs * n, -1)
    K = np.tile(K, (signs, 1))
    data_driven = K * np.exp(g - g.max(axis=1, keepdims=True))
    q = model.move_share * data_driven / data_driven.sum(axis=1, keepdims=True)
    q += (1.0 - model.move_share) * K / K.sum(axis=1, keepdims=True)
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.where(q > 0.0, np.log(K / q), IMPOSSIBLE)
    return Proposals(np.cumsum(q, axis=1), ratio, *propose_births(model, b))


def propose_births(model: SetModel, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """birth (n + 1,), birth_ratio (S, n) and birth_positive (n,) of `Proposals`."""
    prior = np.array(list(model.signs.values()))[:, None]
    data_driven = prior * np.exp(np.minimum(gains(model, b), model.birth_cap))
    weight = (
        model.birth_share * data_driven / data_driven.sum()
        + (1.0 - model.birth_share) * prior / model.cells
    )
    running = np.append(0.0, np.cumsum(weight.sum(axis=0)))
    return running, -np.log(model.cells * weight / prior), weight[0]


def start(model: SetModel, proposals: Proposals, uniform: FloatArray) -> tuple[Sets, FloatArray]:
    """Oracle for tests: sets before the first record, drawn where it will want them, and the log
    ratio (N,).

    uniform (N, 1 + J): the order, and one for each member.
    """
    N = len(uniform)
    orders = len(model.transition)
    sets = Sets.empty(model, N)
    sets.order[:] = model.order_min + np.minimum((uniform[:, 0] * orders).astype(int), orders - 1)
    log_ratio = np.zeros(N)
    for i in range(N):
        m = int(sets.order[i])
        members: list[int] = []
        sign: dict[int, int] = {}
        for k in range(m):
            log_ratio[i] += _birth(model, proposals, members, sign, uniform[i, 1 + k])
        sets.cell[i, : len(members)] = members
        sets.sign[i, : len(members)] = [sign[z] for z in members]
        # Births charge 1/n each; possible sets of one size are equally likely in any order.
        charge = math.log(math.factorial(m) * model.room(m)) - m * math.log(model.cells)
        log_ratio[i] -= charge
    return sets, log_ratio


def propagate(
    model: SetModel, proposals: Proposals, sets: Sets, uniform: FloatArray
) -> tuple[Sets, FloatArray]:
    """Oracle for tests: steps 1 to 5 of the model, the new sets and the log ratio (N,) of model to
    proposal, -inf for impossible sets (whose members mean nothing)."""
    N, changes = len(uniform), model.most_changes
    cumulative = np.cumsum(model.transition, axis=1)
    new = Sets.empty(model, N)
    log_ratio = np.zeros(N)
    radius = len(model.move) // 2
    for i in range(N):
        row = cumulative[sets.order[i] - model.order_min]
        m = model.order_min + min(int(np.searchsorted(row, uniform[i, 0], 'right')), len(row) - 1)
        members = [(int(z), j) for j, z in enumerate(sets.cell[i, : sets.order[i]])]
        for k in range(len(members) - m):
            del members[min(int(uniform[i, 1 + k] * len(members)), len(members) - 1)]
        survivors = []
        for k, (z, j) in enumerate(members):
            row = z if sets.sign[i, j] > 0 else z + model.cells
            table = proposals.move[row]
            point = uniform[i, 1 + changes + k] * table[-1]
            step = min(int(np.searchsorted(table, point, 'right')), 2 * radius)
            log_ratio[i] += proposals.move_ratio[row, step]
            survivors.append((z + step - radius, j))
        places = sorted(z for z, _ in survivors)
        sign = {z: int(sets.sign[i, j]) for z, j in survivors}
        if any(b - a < model.separation for a, b in zip(places, places[1:])):
            log_ratio[i] = IMPOSSIBLE
        for k in range(m - len(survivors)):
            if log_ratio[i] > IMPOSSIBLE:
                log_ratio[i] += _birth(model, proposals, places, sign, uniform[i, 1 + k])
        new.order[i] = m
        if log_ratio[i] > IMPOSSIBLE:
            new.cell[i, :m] = places
            new.sign[i, :m] = [sign[z] for z in places]
            parents = dict(survivors)
            for k, z in enumerate(places):
                if model.amplitude_memory and z in parents:
                    new.prior_mean[i, k] = sets.prior_mean[i, parents[z]]
                    new.prior_variance[i, k] = sets.prior_variance[i, parents[z]]
    return new, log_ratio


def _birth(
    model: SetModel,
    proposals: Proposals,
    places: list[int],
    sign: dict[int, int],
    uniform: float,
) -> float:
    """Insert one more place into ascending `places`, as far from them as it must be, and its sign
    into `sign`; the log ratio of the model's birth to this one, -inf when there is no room."""
    edges = [-model.separation, *places, model.cells - 1 + model.separation]
    gaps = [
        (low + model.separation, high - model.separation + 1)
        for low, high in zip(edges, edges[1:])
    ]
    weights = [
        proposals.birth[high] - proposals.birth[low] if high > low else 0.0 for low, high in gaps
    ]
    total = math.fsum(weights)
    if not total > 0.0:
        return IMPOSSIBLE
    left = uniform * total
    for k, ((low, high), weight) in enumerate(zip(gaps, weights)):
        if weight > 0.0 and (left < weight or not any(weights[k + 1 :])):
            point = proposals.birth[low] + left
            found = int(np.searchsorted(proposals.birth, point, 'right')) - 1
            place = min(max(found, low), high - 1)
            places.insert(k, place)
            # What is left of the random number within the cell chooses the sign.
            negative = point - proposals.birth[place] >= proposals.birth_positive[place]
            sign[place] = -1 if negative and len(model.signs) > 1 else 1
            row = int(sign[place] < 0)
            return float(proposals.birth_ratio[row, place] + math.log(total))
        left -= weight
    raise AssertionError('a gap that has weight is always found')


def weigh(model: SetModel, b: FloatArray, sets: Sets) -> tuple[FloatArray, FloatArray]:
    """Oracle for tests: log likelihood (N,) of the record against that of an empty one, -inf where
    an amplitude is not of its member's sign, and the amplitudes (N, J), their mean given the set,
    in units of the noise."""
    log_likelihood = np.zeros(len(sets.order))
    amplitude = np.zeros(sets.cell.shape)
    for m in np.unique(sets.order[sets.order > 0]):
        at = np.flatnonzero(sets.order == m)
        z = sets.cell[at, :m]
        A = model.gram[np.abs(z[:, :, None] - z[:, None, :])]
        if model.amplitude_memory:
            precision = 1.0 / sets.prior_variance[at, :m]
        else:
            precision = np.full(z.shape, model.ridge)
        h = b[z] + precision * sets.prior_mean[at, :m]
        A = A + precision[:, :, None] * np.eye(m)
        a = np.linalg.solve(A, h[..., None])[..., 0]
        value = 0.5 * np.einsum('im,im->i', h, a) - m * model.penalty
        if model.amplitude_prior == 'marginal':
            value -= 0.5 * np.linalg.slogdet(A)[1]
        if model.amplitude_memory:
            value -= 0.5 * np.sum(precision * np.square(sets.prior_mean[at, :m]), axis=1)
            value += m * model.penalty + 0.5 * np.sum(np.log(precision), axis=1)
        amplitude[at, :m] = a
        log_likelihood[at] = np.where((a * sets.sign[at, :m] > 0.0).all(axis=1), value, IMPOSSIBLE)
    return log_likelihood, amplitude
