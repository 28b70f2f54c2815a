# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The verbs of `sonar_imm.estimation.set_filter` in numpy, for the same random numbers."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.set_model import Sets
from sonar_imm.estimation.set_proposals import begin, Births, gains, propose_births
from sonar_imm.estimation.set_shifts import Jump, Shift, ShiftTables

IMPOSSIBLE = -math.inf


class Proposals(NamedTuple):
    """Tables of one record, for S signs, negative ones in the second n rows: walk (S n, 2 r + 1)
    cumulative, walk_ratio (S n, 2 r + 1) of model to proposal, log_sum (S, n) log Z of the walks
    from each cell; births; share of walks that see the record; the shift that all have, or the
    jump that all make."""

    walk: FloatArray
    walk_ratio: FloatArray
    log_sum: FloatArray
    births: Births
    share: float
    shared: Shift | Jump | None


def propose(model, b):
    """The tables for the record b (n,)."""
    n, radius = model.record_cells, len(model.walk) // 2
    to = np.arange(n)[:, None] + np.arange(-radius, radius + 1)
    there = (to >= 0) & (to < n)
    gained, _ = gains(model, b, model.gram)
    signs = len(model.signs)
    g = np.where(there, gained[:, np.clip(to, 0, n - 1)], -np.inf).reshape(signs * n, -1)
    K = np.tile(np.where(there, model.walk, 0.0), (signs, 1))
    best = g.max(axis=1, keepdims=True)
    data_driven = K * np.exp(g - best)
    q = model.walk_share * data_driven / data_driven.sum(axis=1, keepdims=True)
    q += (1.0 - model.walk_share) * K / K.sum(axis=1, keepdims=True)
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.where(q > 0.0, K / q, 0.0)
    log_sum = (best[:, 0] + np.log(data_driven.sum(axis=1))).reshape(signs, n)
    births = propose_births(model, gained, model.birth_share, model.birth_cap)
    shared = model.shift or model.jump
    return Proposals(np.cumsum(q, axis=1), ratio, log_sum, births, model.walk_share, shared)


def start(model, proposals, b, uniform):
    """Sets before the first record, drawn where it will want them, and the log ratio (N,).

    uniform (N, 1 + J + K), or one more with a shift: how many members are elsewhere, one for each
    of them, the shift, and one for each of the K peaks, the last first.
    """
    N, J = len(uniform), model.order_max
    sets, log_ratio = Sets.empty(model, N), np.zeros(N)
    beginning, births = begin(model, *gains(model, b, model.gram))
    outside = births._replace(running=beginning.elsewhere)
    for i in range(N):
        if model.shift:
            start = ShiftTables.of(model.shift).start
            place = np.searchsorted(start, uniform[i, 1 + J], 'right')
            sets.shift[i] = min(int(place), model.shift.count - 1) * model.shift.step
        offset = int(sets.shift[i])
        drawn = uniform[i, ::-1][: len(beginning.sure)]
        members, sign, paid = _peaks(model, births, beginning, drawn, offset)
        apart = all(b - a >= model.separation for a, b in zip(members, members[1:]))
        log_ratio[i] = paid if apart else IMPOSSIBLE
        least = max(0, model.order_min - len(members))
        counts = np.arange(least, J - len(members) + 1)
        chance = beginning.decay ** (counts - least)
        running = np.cumsum(chance)
        chosen = int(np.searchsorted(running, uniform[i, 0] * running[-1], 'right'))
        more = int(counts[min(chosen, len(counts) - 1)])
        log_ratio[i] -= math.log(len(model.transition) * chance[more - least] / running[-1])
        for k in range(more):
            log_ratio[i] += _birth(model, outside, members, sign, uniform[i, 1 + k], offset)
        m = sets.order[i] = max(len(members), model.order_min)
        sets.cell[i, : len(members)] = members
        sets.sign[i, : len(members)] = [sign[z] for z in members]
        # Births charge 1/n each; possible sets of one size are equally likely. Those elsewhere
        # may come in any order.
        charge = math.log(math.factorial(more) * model.room(m)) - m * math.log(model.cells)
        log_ratio[i] -= charge
    return sets, log_ratio


def _peaks(model, births, beginning, drawn, offset):
    """The members that a set begins with in the peaks of the record, by the random numbers drawn
    (K,), their signs, and the log ratio."""
    members, sign, paid = [], {}, 0.0
    for k, sure in enumerate(beginning.sure):
        cells = np.arange(beginning.first[k], beginning.last[k])
        cells = cells[(cells >= offset) & (cells < offset + model.cells)]
        if not len(cells):
            continue
        if drawn[k] >= sure:
            paid -= math.log(1.0 - sure)
            continue
        running = births.running[cells[0] : cells[-1] + 2]
        point = running[0] + drawn[k] / sure * (running[-1] - running[0])
        z = int(cells[min(int(np.searchsorted(running, point, 'right')) - 1, len(cells) - 1)])
        negative = len(model.signs) > 1 and point - births.running[z] >= births.positive[z]
        members.append(z - offset)
        sign[z - offset] = -1 if negative else 1
        paid += births.ratio[int(negative), z]
        paid += math.log((running[-1] - running[0]) / sure)
    return members, sign, paid


def propagate(model, proposals, sets, uniform):
    """Steps 1 to 5 of the model, the new sets and the log ratio (N,) of model to
    proposal, -inf for impossible sets (whose members mean nothing)."""
    N, changes = len(uniform), model.most_changes
    cumulative = np.cumsum(model.transition, axis=1)
    new = Sets.empty(model, N)
    log_ratio = np.zeros(N)
    radius = len(model.walk) // 2
    for i in range(N):
        row = cumulative[sets.order[i] - model.order_min]
        m = model.order_min + min(int(np.searchsorted(row, uniform[i, 0], 'right')), len(row) - 1)
        members = [(int(z), j) for j, z in enumerate(sets.cell[i, : sets.order[i]])]
        for k in range(len(members) - m):
            del members[min(int(uniform[i, 1 + k] * len(members)), len(members) - 1)]
        offset = model.pad
        if proposals.shared:
            at = np.array([z for z, _ in members], np.int64)
            below = np.array([int(sets.sign[i, j] < 0) for _, j in members], np.int64)
            chances, paid = propose_shared(proposals, int(sets.shift[i]), at, below)
            running = np.cumsum(chances)
            place = int(np.searchsorted(running, uniform[i, -1] * running[-1], 'right'))
            log_ratio[i] = paid[place]
            if model.shift:
                offset = place * model.shift.step
            else:
                jump = place * model.jump.step - model.jump.pad
                members = [(z + jump, j) for z, j in members]
                if not all(0 <= z < model.cells for z, _ in members):
                    log_ratio[i] = IMPOSSIBLE
                members = [(min(max(z, 0), model.cells - 1), j) for z, j in members]
        new.shift[i] = offset
        survivors = []
        for k, (z, j) in enumerate(members):
            row = z + offset + (sets.sign[i, j] < 0) * model.record_cells
            table = proposals.walk[row]
            point = uniform[i, 1 + changes + k] * table[-1]
            step = min(int(np.searchsorted(table, point, 'right')), 2 * radius)
            with np.errstate(divide='ignore'):
                log_ratio[i] += np.log(proposals.walk_ratio[row, step])
            survivors.append((z + step - radius, j))
        places = sorted(z for z, _ in survivors)
        sign = {z: int(sets.sign[i, j]) for z, j in survivors}
        apart = all(b - a >= model.separation for a, b in zip(places, places[1:]))
        if not apart or (places and not 0 <= places[0] <= places[-1] < model.cells):
            log_ratio[i] = IMPOSSIBLE
        for k in range(m - len(survivors)):
            if log_ratio[i] > IMPOSSIBLE:
                drawn = uniform[i, 1 + k]
                log_ratio[i] += _birth(model, proposals.births, places, sign, drawn, offset)
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


def _birth(model, births, places, sign, uniform, offset):
    """Insert one more place into ascending `places`, as far from them as it must be, and its sign
    into `sign`; the log ratio of the model's birth to this one, -inf when there is no room.
    offset: from cells of the lattice to those of the record."""
    birth = births.running[offset:]
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
            negative = point - birth[place] >= births.positive[place + offset]
            sign[place] = -1 if negative and len(model.signs) > 1 else 1
            row = int(sign[place] < 0)
            return float(births.ratio[row, place + offset] + math.log(total))
        left -= weight
    raise AssertionError('a gap that has weight is always found')


def weigh(model, b, sets):
    """Log likelihood (N,) of the record against that of an empty one, -inf where an amplitude is
    not of its member's sign, and the amplitudes (N, J), their mean given the set, in units of the
    noise."""
    log_likelihood = np.zeros(len(sets.order))
    amplitude = np.zeros(sets.cell.shape)
    for m in np.unique(sets.order[sets.order > 0]):
        at = np.flatnonzero(sets.order == m)
        z = sets.cell[at, :m]
        A = model.gram[np.abs(z[:, :, None] - z[:, None, :])]
        precision, expected = np.full(z.shape, model.ridge), np.zeros(z.shape)
        if model.amplitude_memory:
            precision = 1.0 / sets.prior_variance[at, :m]
            expected = sets.prior_mean[at, :m]
        h = b[z + sets.shift[at, None]] + precision * expected
        A = A + precision[:, :, None] * np.eye(m)
        a = np.linalg.solve(A, h[..., None])[..., 0]
        value = 0.5 * np.einsum('im,im->i', h, a) - m * model.penalty
        if model.amplitude_prior == 'marginal':
            value -= 0.5 * np.linalg.slogdet(A)[1]
        if model.amplitude_memory:
            value -= 0.5 * np.sum(precision * np.square(expected), axis=1)
            value += m * model.penalty + 0.5 * np.sum(np.log(precision), axis=1)
        amplitude[at, :m] = a
        log_likelihood[at] = np.where((a * sets.sign[at, :m] > 0.0).all(axis=1), value, IMPOSSIBLE)
    return log_likelihood, amplitude


def propose_shared(proposals, before, cells, negative):
    """q (G,) and log of model to proposal (G,) for members at `cells` (k,), with
    `negative` (k,) 1 for negative ones; before: the shift of the record before plus pad."""
    shared, share, log_sum = proposals.shared, proposals.share, proposals.log_sum
    if isinstance(shared, Jump):
        log_prior = shared.tables().log_prior
        log_sum = np.pad(log_sum, [(0, 0), (shared.pad, shared.pad)], constant_values=-np.inf)
    else:
        log_prior = ShiftTables.of(shared).log_prior
    prior = log_prior[before // shared.step if len(log_prior) > 1 else 0]
    at = cells[:, None] + shared.step * np.arange(len(prior))
    score = prior + log_sum[negative[:, None], at].sum(axis=0)
    driven = np.exp(score - score.max())
    q = share * driven / driven.sum() + (1.0 - share) * np.exp(prior)
    with np.errstate(divide='ignore'):
        return q, prior - np.log(q)
