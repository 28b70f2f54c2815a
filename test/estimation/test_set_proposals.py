# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where the filter for sets looks for members: peaks without the side lobes of the others. And
jumps that all members of a set make together."""

from itertools import combinations, product
import math

from attrs import evolve
from helpers.set_cycle import cycle, steps, weigh
import numpy as np
import pytest

from sonar_imm.estimation import set_model, set_proposals
from sonar_imm.estimation.set_filter import LagSmoother, SetFilter
from sonar_imm.estimation.set_shifts import Jump, Shift

N = 400
GRAM = np.sinc(np.arange(N) / 5.0)
MODEL = set_model.SetModel(
    cells=N, separation=20, order_min=1, transition=set_model.banded_transition(12, 0.05),
    walk=set_model.gaussian_walk(4.0), gram=GRAM,
)  # fmt: skip
PLACES = np.array([40, 85, 112, 160, 203, 251, 300, 352])
SIGMAS = np.array([34.0, 6.0, 28.0, 7.0, 22.0, 9.0, 30.0, 8.0])
CELLS, JUMP_AT = 11, 3


def record(places, sigmas, n=N, seed=None):
    """Echoes in the n cells of a record; with the noise of `seed`, as wide as the echoes."""
    b = np.sinc((np.arange(n)[:, None] - places) / 5.0) @ sigmas
    if seed is not None:
        white = np.random.default_rng(seed).standard_normal(n)
        noise = np.fft.irfft(np.fft.rfft(white)[: n // 10], n)
        b += noise / noise.std()
    return b


@pytest.mark.parametrize('more', [0, 30])
def test_what_stands_out_is_each_member_without_the_others(more):
    b = record(PLACES, SIGMAS, N + more)
    alone, peaks = set_proposals.standing_out(MODEL, b, GRAM)
    assert len(peaks.first) == len(PLACES)
    for place, sigma, low, high in zip(PLACES, SIGMAS, *peaks):
        assert low <= place < high and low + np.argmax(alone[low:high]) == place
        assert alone[place] == pytest.approx(sigma, rel=0.03)
    away = np.abs(np.arange(N + more)[:, None] - PLACES).min(axis=1) > MODEL.separation // 2
    assert np.abs(alone[away]).max() < 0.7 < 4.0 < np.abs(b[away]).max()


def test_negative_members_stand_out_where_there_can_be_some():
    signed = SIGMAS * np.where(np.arange(8) % 3 == 1, -1.0, 1.0)
    b = record(PLACES, signed)
    both = evolve(MODEL, negative_probability=0.05)
    g, peaks = set_proposals.gains(both, b, GRAM)
    assert len(peaks.first) == 8 and g.shape == (2, N)
    for sign, low, high in zip(np.sign(signed), *peaks):
        place = low + np.argmax(g[:, low:high].max(axis=0))
        assert g[int(sign < 0), place] > 10.0 and g[int(sign > 0), place] == 0.0
    assert len(set_proposals.standing_out(MODEL, b, GRAM)[1].first) < 8


def test_nothing_stands_out_of_noise_and_blind_proposals_see_nothing():
    assert not len(set_proposals.gains(MODEL, record(PLACES, 0.0 * SIGMAS), GRAM)[1].first)
    b, blind = record(PLACES, SIGMAS), evolve(MODEL, walk_share=0.0, birth_share=0.0)
    g, peaks = set_proposals.gains(blind, b, GRAM)
    assert not len(peaks.first) and np.array_equal(g[0], 0.5 * np.square(np.maximum(b, 0.0)))
    beginning, births = set_proposals.begin(blind, g, peaks)
    assert beginning.decay == 1.0 and np.array_equal(beginning.elsewhere, births.running)
    assert np.diff(births.running) == pytest.approx(1.0 / N)


def test_the_first_record_leaves_many_sets():
    """Of sets that are drawn one member after the other it leaves one, with what is in it."""
    tracker = SetFilter(MODEL, 4000)
    found = list(steps(tracker, [record(PLACES, SIGMAS, seed=k) for k in range(4)], 0))
    assert found[0].effective > 20.0 and min(step.effective for step in found[1:]) > 80.0
    assert tracker.summarise(found[-1]).pmf[7] > 0.5


def test_independent_members_pay_for_their_places_alone():
    factorials = np.array([math.factorial(m) for m in range(5)])
    assert set_model.independent_orders(0, 5) == pytest.approx(
        1.0 / factorials / (1.0 / factorials).sum()
    )
    among = set_model.independent_orders(7, 3)
    assert among.sum() == pytest.approx(1.0)
    assert among[1:] / among[:-1] == pytest.approx([1 / 8, 1 / 9])
    assert set_model.independent_orders(64, 1) == pytest.approx([1.0])
    with pytest.raises(ValueError, match='start'):
        evolve(MODEL, start=set_model.independent_orders(1, 11))


def test_before_the_first_record_members_neither_come_nor_go():
    """The orders of a first record by the sum over all sets and all that they walk."""
    n, walk, start = 10, np.array([0.25, 0.5, 0.25]), set_model.independent_orders(0, 3)
    model = set_model.SetModel(
        cells=n, separation=2, order_min=0, transition=set_model.banded_transition(3, 0.2),
        walk=walk, gram=np.exp(-0.5 * np.arange(n) ** 2.0), amplitude_std=3.0, start=start,
    )  # fmt: skip
    b = np.random.default_rng(8).standard_normal(n)
    b[[2, 3, 7]] += 2.0, 3.0, 1.5
    exact = np.zeros(3)
    for m in range(3):
        for places in combinations(range(n), m):
            for moves in product((-1, 0, 1), repeat=m):
                z = np.sort(np.array(places, int) + np.array(moves, int))
                apart = np.append(np.diff(places), np.diff(z)).min(initial=2)
                if apart < 2 or z.min(initial=0) < 0 or z.max(initial=0) >= n:
                    continue
                sets = set_model.Sets.empty(model, 1)
                sets.order[:], sets.cell[0, :m] = m, z
                chance = np.prod(walk[np.array(moves, int) + 1]) / model.room(m)
                exact[m] += start[m] * chance * np.exp(weigh(model, b, sets)[0][0])
    tracker = SetFilter(model, 100_000)
    record = tracker.record(b, (3, 1), records=0)
    step = tracker.weigh(tracker.propagate(tracker.start(record), record), record)
    assert tracker.summarise(step).pmf == pytest.approx(exact / exact.sum(), abs=0.01)


@pytest.mark.parametrize('wide, all_sums', [(False, True), (True, False)])
def test_walks_are_drawn_by_what_they_come_to(wide, all_sums):
    """Walks of two kinds, one with a gap and aside; also beside a peak that is out of reach."""
    n, share, rng = 30, 0.8, np.random.default_rng(2)
    g = 8.0 * rng.random((2, n))
    if not wide:
        g[0, [4, 17]] = 2000.0, 900.0
    probability = np.array([[0.0, 0.25, 0.5, 0.25, 0.0], [0.3, 0.0, 0.2, 0.1, 0.4]])
    kind, centre = (np.arange(n) % 3 == 1).astype(np.int64), np.array([0, 3])
    wanted = rng.random(2 * n) < 0.6
    tables = set_proposals.WalkTables(*np.full((2, 2 * n, 5), 7.0), np.full(2 * n, 7.0))
    walks = set_model.Walks(kind, centre, probability, wide)
    set_proposals.fill_walks(walks, g, share, wanted, tables, all_sums=all_sums)
    for row in range(2 * n):
        sign, z = divmod(row, n)
        to = z + centre[kind[z]] + np.arange(-2, 3)
        K = np.where((to >= 0) & (to < n), probability[kind[z]], 0.0)
        if wanted[row] or all_sums:
            scores = [math.log(p) + g[sign, k] for p, k in zip(K, to) if p > 0.0]
            log_sum = np.logaddexp.reduce(scores) if scores else -math.inf
            assert tables.log_sum[row] == pytest.approx(log_sum, rel=1e-12)
        if not wanted[row]:
            assert (tables.running[row] == 7.0).all() and (tables.ratio[row] == 7.0).all()
        elif not K.any():
            assert (tables.ratio[row] == 0.0).all()
        else:
            worth = [math.exp(g[sign, k] - log_sum) if p > 0.0 else 0.0 for p, k in zip(K, to)]
            q = share * K * worth + (1.0 - share) * K / K.sum()
            assert tables.running[row] == pytest.approx(np.cumsum(q), rel=1e-12)
            ratio = np.divide(K, q, out=np.zeros(5), where=q > 0.0)
            assert tables.ratio[row] == pytest.approx(ratio, rel=1e-12)


@pytest.fixture(scope='module')
def model():
    return set_model.SetModel(
        cells=CELLS, separation=2, order_min=0,
        transition=np.array([[0.6, 0.3, 0.1], [0.15, 0.5, 0.35], [0.05, 0.15, 0.8]]),
        start=np.array([0.2, 0.3, 0.5]), walk=np.array([0.25, 0.6, 0.15]),
        gram=np.exp(-0.5 * np.square(np.arange(CELLS) / 1.2)), amplitude_std=3.0,
        negative_probability=0.3, jump=Jump(probability=0.15, std=3.0, step=2, reach=3),
    )  # fmt: skip


@pytest.fixture(scope='module')
def records():
    """Two echoes, one of them negative, that are four cells deeper from a record on."""
    rng, cell, made = np.random.default_rng(4), np.arange(CELLS), []
    for k in range(7):
        places = np.array([1.0, 5.0]) + 4.0 * (k >= JUMP_AT)
        echoes = np.exp(-0.5 * np.square((cell[:, None] - places) / 1.2)) @ [2.6, -2.2]
        made.append(echoes + 0.7 * rng.standard_normal(CELLS))
    return np.array(made)


def every_set(model):
    """Cells and signs of the members of each set, ascending."""
    for order in range(model.order_min, model.order_max + 1):
        for cells in combinations(range(model.cells), order):
            if all(b - a >= model.separation for a, b in zip(cells, cells[1:])):
                yield from (tuple(zip(cells, s)) for s in product(model.signs, repeat=order))


def transitions(model, states):
    """For each jump in cells, the probabilities (K, K) of the ways from set to set with it. Those
    that lead to no possible set are missing."""
    places, jumps = np.zeros(1), np.ones(1)
    if model.jump:
        places = model.jump.step * np.arange(-model.jump.reach, model.jump.reach + 1)
        density = np.exp(-0.5 * np.square(places / model.jump.std))
        jumps = model.jump.probability * density / density.sum()
        jumps[model.jump.reach] += 1.0 - model.jump.probability
    number = {state: k for k, state in enumerate(states)}
    found = {int(d): np.zeros((len(states), len(states))) for d in places}
    radius = len(model.walk) // 2
    births = [(z, s, p / model.cells) for z in range(model.cells) for s, p in model.signs.items()]
    for (i, state), order in product(enumerate(states), range(len(model.transition))):
        p, order = model.transition[len(state) - model.order_min][order], order + model.order_min
        stay = min(order, len(state))
        for left, (d, q) in product(combinations(state, stay), zip(found, jumps)):
            if not all(0 <= z + d < model.cells for z, _ in left):
                continue
            for moves in product(range(len(model.walk)), repeat=stay):
                walked = [(z + d + w - radius, s) for (z, s), w in zip(left, moves)]
                paid = p / math.comb(len(state), stay) * q * math.prod(model.walk[list(moves)])
                for born in product(births, repeat=order - stay):
                    k = number.get(tuple(sorted([*walked, *(each[:2] for each in born)])))
                    if k is not None:
                        found[d][i, k] += paid * math.prod(each[2] for each in born)
    return found


def exact(model, records):
    """pmf (T, orders), intensity (T, n), log_evidence (T,); jump (T, 2): probability that members
    jumped, and mean jump; mean shift (T,). By sums over all sets of a small lattice, and all
    shifts."""
    states = list(every_set(model))
    orders = np.array([len(state) - model.order_min for state in states])
    sets = set_model.Sets.empty(model, len(states))
    there = np.zeros((len(states), model.cells))
    p = np.array([model.start[m] / model.room(m + model.order_min) for m in orders])
    for k, state in enumerate(states):
        sets.order[k] = len(state)
        for j, (z, sign) in enumerate(state):
            sets.cell[k, j], sets.sign[k, j] = z, sign
            there[k, z] = 1.0
            p[k] *= model.signs[sign]
    shifts, move, p = np.zeros(1), np.ones((1, 1)), p[None]
    if model.shift:
        shifts, move = model.shift.places, np.exp(model.shift.log_prior())
        p = p * np.exp(model.shift.log_start())[:, None]
    ways, rows = transitions(model, states), []
    for b in records:
        likelihood = np.empty((len(shifts), len(states)))
        for row, shift in zip(likelihood, shifts + model.pad):
            sets.shift[:] = shift
            row[:] = np.exp(weigh(model, b, sets)[0])
        by_jump = {d: move.T @ p @ way * likelihood for d, way in ways.items()}
        p = np.sum(list(by_jump.values()), axis=0)
        total = float(p.sum())
        p /= total
        mass = {d: float(each.sum()) / total for d, each in by_jump.items()}
        jump = 1.0 - mass[0], sum(d * each for d, each in mass.items())
        of_sets, shift = p.sum(axis=0), float(shifts @ p.sum(axis=1))
        pmf = np.bincount(orders, of_sets, len(model.transition))
        rows.append((pmf, of_sets @ there, math.log(total), jump, shift))
    return [np.array(column) for column in zip(*rows)]


def run(model, records, particles, seed):
    """The same by particles."""
    tracker, found = SetFilter(model, particles), []
    for step in steps(tracker, records, seed):
        pmf, *_, jump = tracker.summarise(step)
        there = np.arange(step.sets.cell.shape[1]) < step.sets.order[:, None]
        w = np.broadcast_to(step.w[:, None], there.shape)
        intensity = np.bincount(step.sets.cell[there], w[there], model.cells)
        jump, shift = (jump[0], jump[0] * jump[1]), step.w @ step.sets.shift - model.pad
        found.append((pmf, intensity, step.log_evidence, jump, shift))
    return tuple(np.array(column) for column in zip(*found))


@pytest.mark.parametrize('change', [
    {}, {'walk_share': 0.0, 'birth_share': 0.0},
    {'jump': Jump(probability=0.4, std=1.0, step=1, reach=5), 'negative_probability': 0.0},
    {'jump': None, 'shift': Shift(std=1.5, memory=0.6)},
    {'jump': None, 'shift': Shift(std=2.0, step=2), 'negative_probability': 0.0},
])  # fmt: skip
def test_sets_that_jump_or_share_a_shift_are_the_exact_ones(model, records, change):
    changed = evolve(model, **change)
    heard = np.pad(records, [(0, 0), (changed.pad, changed.pad)])
    pmf, intensity, log_evidence, jump, shift = exact(changed, heard)
    found = run(changed, heard, 60_000, seed=1)
    assert 0.5 * np.abs(found[0] - pmf).sum(axis=1).max() < 0.015
    assert np.abs(found[1] - intensity).sum(axis=1).max() < (0.1 if changed.shift else 0.06)
    assert found[2] == pytest.approx(log_evidence, abs=0.05)
    assert (np.abs(found[3] - jump).max(axis=0) < [0.02, 0.06]).all()
    assert found[4] == pytest.approx(shift, abs=0.1)
    if not change:
        assert jump[JUMP_AT, 0] > 0.5 > jump[[1, 2, 4, 5, 6], 0].max()


def test_what_a_jump_is_beforehand(model):
    jump, places = Jump(probability=0.1, std=3.0, step=2, reach=6), np.arange(-12, 13, 2)
    density = np.exp(-0.5 * np.square(places / 3.0))
    prior = 0.1 * density / density.sum() + 0.9 * (places == 0)
    assert np.exp(jump.tables().log_prior[0]) == pytest.approx(prior)
    assert jump.tables().prior[0] == pytest.approx(np.cumsum(prior)) and jump.pad == 12
    with pytest.raises(ValueError, match='shift'):
        evolve(model, shift=Shift(std=1.0))
    for change in ({'probability': 1.0}, {'std': 0.0}, {'step': 0}, {'reach': 0}, {'reach': 900}):
        with pytest.raises(ValueError, match='jump'):
            evolve(jump, **change)


def test_what_is_smoothed_jumped_when_it_did(model, records):
    tracker, smoother, found = SetFilter(model, 4000), LagSmoother(2), []
    for step in steps(tracker, records, 2):
        if earlier := smoother.push(step):
            summary = tracker.summarise(earlier)
            found.append(summary.jump[0])
            assert summary.sums[0].sum() <= 2.0 + 1e-9
    # The first that comes out is record 0.
    assert int(np.argmax(found)) == JUMP_AT


@pytest.mark.parametrize('centre', [CELLS, -3 * CELLS, 8])
def test_walks_that_lead_off_the_lattice_leave_numbers(model, records, centre):
    """As of a slope that is steep at the end of the lattice, wherever a jump leads before."""
    tracker, probability = SetFilter(model, 300), np.array([[0.2, 0.6, 0.2]])
    walks = set_model.Walks(np.zeros(CELLS, np.int64), np.array([centre]), probability, True)
    before = cycle(tracker, None, records[0], (1, 0)).after
    sets = tracker.propagate(before, tracker.record(records[1], (1, 1), walks=walks))
    assert not np.isnan(sets.log_weight).any()
    # Of nothing and of those that all died the births are left.
    assert np.isfinite(sets.log_weight).any()
    assert ((sets.sets.cell >= 0) & (sets.sets.cell < CELLS)).all()
