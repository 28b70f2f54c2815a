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

    With ``scatter`` the things stand in a background that begins at the first of them: see
    `set_scatter`.

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
(with `set_amplitudes`) is the compiled one, and `set_filter` runs it.

Sources: C. Yardim, P. Gerstoft, Z.-H. Michalopoulou, *Passive fathometer reflector identification
with multiple model particle filtering* (2012); the weights by first principles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .arrays import FloatArray
from .set_model import SetModel, Sets
from .set_scatter import fit_scatter, guide, ScatterFit
from .set_shifts import propose_shift, shift_tables, ShiftTables

IMPOSSIBLE = -math.inf


class Proposals(NamedTuple):
    """Tables of one record, for S signs: move (S n, 2 r + 1) cumulative, move_ratio (S n, 2 r + 1)
    log of model to proposal, for cells from which something moves (others are not filled in),
    negative members in the second n rows; birth (n + 1,) running sum of the birth weights of both
    signs, birth_ratio (S, n) log of model to weight, birth_positive (n,) the weight of positive
    births; shifts."""

    move: FloatArray
    move_ratio: FloatArray
    birth: FloatArray
    birth_ratio: FloatArray
    birth_positive: FloatArray
    shifts: ShiftTables


def gain(b: FloatArray) -> FloatArray:
    """g (n,): the best log likelihood ratio of one thing alone at each cell."""
    return np.asarray(0.5 * np.square(np.maximum(b, 0.0)))


def gains(model: SetModel, b: FloatArray, fit: ScatterFit) -> FloatArray:
    """g (S, n) for each sign."""
    if model.scatter:
        b = guide(fit, b)
    return np.stack([gain(sign * b) for sign in model.signs])


def propose(model: SetModel, b: FloatArray) -> Proposals:
    """Oracle for tests: the tables for the record b (n,)."""
    n, radius = model.record_cells, len(model.move) // 2
    to = np.arange(n)[:, None] + np.arange(-radius, radius + 1)
    there = (to >= 0) & (to < n)
    gained = gains(model, b, fit_scatter(model.scatter, b))
    K = np.where(there, model.move, 0.0)
    signs = len(model.signs)
    g = np.where(there, gained[:, np.clip(to, 0, n - 1)], -np.inf).reshape(signs * n, -1)
    K = np.tile(K, (signs, 1))
    best = g.max(axis=1, keepdims=True)
    data_driven = K * np.exp(g - best)
    q = model.move_share * data_driven / data_driven.sum(axis=1, keepdims=True)
    q += (1.0 - model.move_share) * K / K.sum(axis=1, keepdims=True)
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.where(q > 0.0, np.log(K / q), IMPOSSIBLE)
    log_sum = (best[:, 0] + np.log(data_driven.sum(axis=1))).reshape(signs, n)
    shifts = shift_tables(model.shift, log_sum, model.move_share)
    return Proposals(np.cumsum(q, axis=1), ratio, *propose_births(model, gained), shifts)


def propose_births(model: SetModel, g: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """birth (n + 1,), birth_ratio (S, n) and birth_positive (n,) of `Proposals`, from the gains
    g (S, n)."""
    prior = np.array(list(model.signs.values()))[:, None]
    data_driven = prior * np.exp(np.minimum(g, model.birth_cap))
    weight = (
        model.birth_share * data_driven / data_driven.sum()
        + (1.0 - model.birth_share) * prior / model.cells
    )
    running = np.append(0.0, np.cumsum(weight.sum(axis=0)))
    return running, -np.log(model.cells * weight / prior), weight[0]


def start(model: SetModel, proposals: Proposals, uniform: FloatArray) -> tuple[Sets, FloatArray]:
    """Oracle for tests: sets before the first record, drawn where it will want them, and the log
    ratio (N,).

    uniform (N, 1 + J), or one more with a shift: the order, one for each member, and the shift.
    """
    N = len(uniform)
    orders = len(model.transition)
    sets = Sets.empty(model, N)
    sets.order[:] = model.order_min + np.minimum((uniform[:, 0] * orders).astype(int), orders - 1)
    log_ratio = np.zeros(N)
    for i in range(N):
        m = int(sets.order[i])
        if model.shift:
            place = np.searchsorted(proposals.shifts.start, uniform[i, -1], 'right')
            sets.shift[i] = min(int(place), model.shift.count - 1) * model.shift.step
        members: list[int] = []
        sign: dict[int, int] = {}
        for k in range(m):
            born = _birth(model, proposals, members, sign, uniform[i, 1 + k], int(sets.shift[i]))
            log_ratio[i] += born
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
        offset = model.pad
        if model.shift:
            at = np.array([z for z, _ in members], np.int64)
            below = np.array([int(sets.sign[i, j] < 0) for _, j in members], np.int64)
            chances, paid = propose_shift(proposals.shifts, int(sets.shift[i]), at, below)
            running = np.cumsum(chances)
            place = int(np.searchsorted(running, uniform[i, -1] * running[-1], 'right'))
            offset, log_ratio[i] = place * model.shift.step, paid[place]
        new.shift[i] = offset
        survivors = []
        for k, (z, j) in enumerate(members):
            row = z + offset + (sets.sign[i, j] < 0) * model.record_cells
            table = proposals.move[row]
            point = uniform[i, 1 + changes + k] * table[-1]
            step = min(int(np.searchsorted(table, point, 'right')), 2 * radius)
            log_ratio[i] += proposals.move_ratio[row, step]
            survivors.append((z + step - radius, j))
        places = sorted(z for z, _ in survivors)
        sign = {z: int(sets.sign[i, j]) for z, j in survivors}
        apart = all(b - a >= model.separation for a, b in zip(places, places[1:]))
        if not apart or (places and not 0 <= places[0] <= places[-1] < model.cells):
            log_ratio[i] = IMPOSSIBLE
        for k in range(m - len(survivors)):
            if log_ratio[i] > IMPOSSIBLE:
                log_ratio[i] += _birth(model, proposals, places, sign, uniform[i, 1 + k], offset)
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
    offset: int,
) -> float:
    """Insert one more place into ascending `places`, as far from them as it must be, and its sign
    into `sign`; the log ratio of the model's birth to this one, -inf when there is no room.
    offset: from cells of the lattice to those of the record."""
    birth = proposals.birth[offset:]
    edges = [-model.separation, *places, model.cells - 1 + model.separation]
    gaps = [
        (low + model.separation, high - model.separation + 1)
        for low, high in zip(edges, edges[1:])
    ]
    weights = [birth[high] - birth[low] if high > low else 0.0 for low, high in gaps]
    total = math.fsum(weights)
    if not total > 0.0:
        return IMPOSSIBLE
    left = uniform * total
    for k, ((low, high), weight) in enumerate(zip(gaps, weights)):
        if weight > 0.0 and (left < weight or not any(weights[k + 1 :])):
            point = birth[low] + left
            found = int(np.searchsorted(birth, point, 'right')) - 1
            place = min(max(found, low), high - 1)
            places.insert(k, place)
            # What is left of the random number within the cell chooses the sign.
            negative = point - birth[place] >= proposals.birth_positive[place + offset]
            sign[place] = -1 if negative and len(model.signs) > 1 else 1
            row = int(sign[place] < 0)
            return float(proposals.birth_ratio[row, place + offset] + math.log(total))
        left -= weight
    raise AssertionError('a gap that has weight is always found')


def weigh(model: SetModel, b: FloatArray, sets: Sets) -> tuple[FloatArray, FloatArray]:
    """Oracle for tests: log likelihood (N,) of the record against that of an empty one, -inf where
    an amplitude is not of its member's sign, and the amplitudes (N, J), their mean given the set,
    in units of the noise."""
    log_likelihood = np.zeros(len(sets.order))
    amplitude = np.zeros(sets.cell.shape)
    fit = fit_scatter(model.scatter, b)
    for m in np.unique(sets.order[sets.order > 0]):
        at = np.flatnonzero(sets.order == m)
        z = sets.cell[at, :m]
        A = model.gram[np.abs(z[:, :, None] - z[:, None, :])]
        precision, expected = np.full(z.shape, model.ridge), np.zeros(z.shape)
        if model.amplitude_memory:
            precision = 1.0 / sets.prior_variance[at, :m]
            expected = sets.prior_mean[at, :m]
        place = z + sets.shift[at, None]
        seen, scale = b[place], np.ones(z.shape)
        if model.scatter:
            k = place[:, :1]
            mean = fit.level[k] * fit.profile[fit.row[k], len(b) - 1 + place - k]
            scale = np.sqrt(1.0 + np.square(fit.spread * mean))
            seen = (seen - mean) / scale
        h = seen + precision * expected
        A = A + precision[:, :, None] * np.eye(m)
        a = np.linalg.solve(A, h[..., None])[..., 0]
        value = 0.5 * np.einsum('im,im->i', h, a) - m * model.penalty
        if model.amplitude_prior == 'marginal':
            value -= 0.5 * np.linalg.slogdet(A)[1]
        if model.amplitude_memory:
            value -= 0.5 * np.sum(precision * np.square(expected), axis=1)
            value += m * model.penalty + 0.5 * np.sum(np.log(precision), axis=1)
        if model.scatter:
            value += fit.evidence[place[:, 0]]
        amplitude[at, :m] = scale * a
        log_likelihood[at] = np.where((a * sets.sign[at, :m] > 0.0).all(axis=1), value, IMPOSSIBLE)
    return log_likelihood, amplitude
