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
from helpers.set_cycle import cycle
import numpy as np
from oracles.set_particles import weigh
import pytest

from sonar_imm.estimation import set_proposals
from sonar_imm.estimation.set_filter import LagSmoother, SetFilter
from sonar_imm.estimation.set_model import (
    banded_transition,
    gaussian_walk,
    independent_orders,
    SetModel,
    Sets,
    Walks,
)
from sonar_imm.estimation.set_shifts import Jump, Shift

N = 400
GRAM = np.sinc(np.arange(N) / 5.0)
MODEL = SetModel(
    cells=N, separation=20, order_min=1, transition=banded_transition(12, 0.05),
    walk=gaussian_walk(4.0), gram=GRAM,
)  # fmt: skip
PLACES = np.array([40, 85, 112, 160, 203, 251, 300, 352])
SIGMAS = np.array([34.0, 6.0, 28.0, 7.0, 22.0, 9.0, 30.0, 8.0])


def record(places, sigmas, n=N, seed=None):
    """Echoes in the n cells of a record; with the noise of `seed`, as wide as the echoes."""
    b = np.sinc((np.arange(n)[:, None] - places) / 5.0) @ sigmas
    if seed is not None:
        noise = np.fft.irfft(
            np.fft.rfft(np.random.default_rng(seed).standard_normal(n))[: n // 10], n
        )
        b += noise / noise.std()
    return b


@pytest.mark.parametrize('more', [0, 30])
def test_what_stands_out_is_each_member_without_the_others(more):
    """Also in a record that is longer than the lattice, as with a shift."""
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


@pytest.mark.parametrize('seed', range(2))
def test_the_first_record_leaves_many_sets(seed):
    """Of sets that are drawn one member after the other it leaves one, with what is in it."""
    tracker, right = SetFilter(MODEL, 4000), 0.0
    step, effective = None, []
    for k in range(4):
        step = cycle(
            tracker, step and step.after, record(PLACES, SIGMAS, seed=9 * seed + k), (seed, k)
        )
        effective.append(step.effective)
        right = tracker.summarise(step).pmf[7]
    assert effective[0] > 20.0 and min(effective[1:]) > 80.0
    assert right > 0.5


def test_independent_members_pay_for_their_places_alone():
    factorials = np.array([math.factorial(m) for m in range(5)])
    assert independent_orders(0, 5) == pytest.approx(1.0 / factorials / (1.0 / factorials).sum())
    among = independent_orders(7, 3)
    assert among.sum() == pytest.approx(1.0)
    assert among[1:] / among[:-1] == pytest.approx([1 / 8, 1 / 9])
    assert independent_orders(64, 1) == pytest.approx([1.0])
    with pytest.raises(ValueError, match='start'):
        evolve(MODEL, start=independent_orders(1, 11))


@pytest.mark.parametrize('start', [np.full(3, 1 / 3), independent_orders(0, 3)])
def test_before_the_first_record_members_neither_come_nor_go(start):
    """The orders of a first record by the sum over all sets and all that they walk."""
    n, walk = 10, np.array([0.25, 0.5, 0.25])
    model = SetModel(
        cells=n, separation=2, order_min=0, transition=banded_transition(3, 0.2), walk=walk,
        gram=np.exp(-0.5 * np.arange(n) ** 2.0), amplitude_std=3.0, start=start,
    )  # fmt: skip
    b = np.random.default_rng(8).standard_normal(n)
    b[[2, 3, 7]] += 2.0, 3.0, 1.5
    exact = np.zeros(3)
    for m in range(3):
        for places in combinations(range(n), m):
            for steps in product((-1, 0, 1), repeat=m):
                z = np.sort(np.array(places, int) + np.array(steps, int))
                apart = np.append(np.diff(places), np.diff(z)).min(initial=2)
                if apart < 2 or z.min(initial=0) < 0 or z.max(initial=0) >= n:
                    continue
                sets = Sets.empty(model, 1)
                sets.order[:], sets.cell[0, :m] = m, z
                chance = np.prod(walk[np.array(steps, int) + 1]) / model.room(m)
                exact[m] += start[m] * chance * np.exp(weigh(model, b, sets)[0][0])
    tracker = SetFilter(model, 100_000)
    record = tracker.record(b, (3, 1), records=0)
    step = tracker.weigh(tracker.propagate(tracker.start(record), record), record)
    assert tracker.summarise(step).pmf == pytest.approx(exact / exact.sum(), abs=0.01)


@pytest.mark.parametrize('wide', [False, True])
@pytest.mark.parametrize('all_sums', [False, True])
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
    walks = Walks(kind, centre, probability, wide)
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


@pytest.mark.parametrize('shift', [None, Shift(std=1.5, step=2)])
def test_every_row_from_which_a_member_walks_is_known_to_be_wanted(shift):
    its = evolve(MODEL, negative_probability=0.2, shift=shift)
    sets = Sets.empty(its, 3)
    sets.order[:] = 2, 1, 0
    sets.cell[0, :2], sets.cell[1, 0], sets.sign[0, 1] = (5, 399), 30, -1
    offsets = range(0, 2 * its.pad + 1, 2) if shift else [0]
    expected = np.zeros((2, its.record_cells), bool)
    for offset in offsets:
        expected[0, [5 + offset, 30 + offset]] = expected[1, 399 + offset] = True
    found = set_proposals.walked_from(its, sets).reshape(expected.shape)
    assert (found >= expected).all()
    # What is no member counts as one in the first cell.
    assert found.sum() <= expected.sum() + len(offsets)


# -- jumps that all members make together: against sums over all sets, jumps and walks ------------

CELLS, JUMP_AT = 11, 3


@pytest.fixture(scope='module')
def model():
    return SetModel(
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
            for steps in product(range(len(model.walk)), repeat=stay):
                walked = [(z + d + w - radius, s) for (z, s), w in zip(left, steps)]
                paid = p / math.comb(len(state), stay) * q * math.prod(model.walk[list(steps)])
                for born in product(births, repeat=order - stay):
                    k = number.get(tuple(sorted([*walked, *(each[:2] for each in born)])))
                    if k is not None:
                        found[d][i, k] += paid * math.prod(each[2] for each in born)
    return found


def exact(model, records):
    """pmf (T, orders), intensity (T, n), log_evidence (T,); jump (T, 2): probability that members
    jumped, and mean jump. By sums over all sets of a small lattice."""
    states = list(every_set(model))
    orders = np.array([len(state) - model.order_min for state in states])
    sets = Sets.empty(model, len(states))
    there = np.zeros((len(states), model.cells))
    p = np.array([model.start[m] / model.room(m + model.order_min) for m in orders])
    for k, state in enumerate(states):
        sets.order[k] = len(state)
        for j, (z, sign) in enumerate(state):
            sets.cell[k, j], sets.sign[k, j] = z, sign
            there[k, z] = 1.0
            p[k] *= model.signs[sign]
    ways, rows = transitions(model, states), []
    for b in records:
        likelihood = np.exp(weigh(model, b, sets)[0])
        by_jump = {d: (p @ way) * likelihood for d, way in ways.items()}
        p = np.sum(list(by_jump.values()), axis=0)
        total = float(p.sum())
        p /= total
        mass = {d: float(each.sum()) / total for d, each in by_jump.items()}
        jump = 1.0 - mass[0], sum(d * each for d, each in mass.items())
        pmf = np.bincount(orders, p, len(model.transition))
        rows.append((pmf, p @ there, math.log(total), jump))
    return [np.array(column) for column in zip(*rows)]


def run(model, records, particles, seed):
    """PMFs (T, orders), intensities (T, n), log evidence (T,), probability that members jumped and
    mean jump (T, 2)."""
    tracker, before, found = SetFilter(model, particles), None, []
    for name, b in enumerate(records):
        step = cycle(tracker, before, b, (seed, name))
        before = step.after
        pmf, sums, _, jump = tracker.summarise(step)
        found.append((pmf, sums[0], step.log_evidence, (jump[0], jump[0] * jump[1])))
    return tuple(np.array(column) for column in zip(*found))


@pytest.mark.parametrize(
    'change',
    [
        {},
        {'walk_share': 0.0, 'birth_share': 0.0},
        {'jump': Jump(probability=0.4, std=1.0, step=1, reach=5), 'negative_probability': 0.0},
    ],
)
def test_sets_that_jump_are_the_exact_ones(model, records, change):
    changed = evolve(model, **change)
    pmf, intensity, log_evidence, jump = exact(changed, records)
    found = run(changed, records, 60_000, seed=1)
    assert 0.5 * np.abs(found[0] - pmf).sum(axis=1).max() < 0.015
    assert np.abs(found[1] - intensity).sum(axis=1).max() < 0.06
    assert found[2] == pytest.approx(log_evidence, abs=0.05)
    assert found[3][:, 0] == pytest.approx(jump[:, 0], abs=0.02)
    assert found[3][:, 1] == pytest.approx(jump[:, 1], abs=0.06)
    if not change:
        assert jump[JUMP_AT, 0] > 0.5 > jump[[1, 2, 4, 5, 6], 0].max()


def test_what_a_jump_is_beforehand():
    jump = Jump(probability=0.1, std=3.0, step=2, reach=6)
    tables, places = jump.tables(), np.arange(-12, 13, 2)
    density = 0.1 * np.exp(-0.5 * np.square(places / 3.0))
    density /= density.sum() / 0.1
    assert np.exp(tables.log_prior[0]) == pytest.approx(density + 0.9 * (places == 0))
    assert tables.prior[0] == pytest.approx(np.cumsum(density + 0.9 * (places == 0)))
    assert jump.pad == 12


def test_jumps_do_not_go_with_a_shift_and_have_bounds(model):
    with pytest.raises(ValueError, match='shift'):
        evolve(model, shift=Shift(std=1.0))
    for change in ({'probability': 1.0}, {'std': 0.0}, {'step': 0}, {'reach': 0}, {'reach': 900}):
        with pytest.raises(ValueError, match='jump'):
            evolve(model.jump, **change)


def test_what_is_smoothed_jumped_when_it_did(model, records):
    tracker, smoother, before, found = SetFilter(model, 4000), LagSmoother(2), None, []
    for name, b in enumerate(records):
        step = cycle(tracker, before, b, (2, name))
        before = step.after
        if earlier := smoother.push(step):
            found.append(tracker.summarise(earlier).jump[0])
            places = tracker.summarise(earlier).sums[0]
            assert places.sum() <= 2.0 + 1e-9
    # The first that comes out is record 0.
    assert int(np.argmax(found)) == JUMP_AT


@pytest.mark.parametrize('centre', [CELLS, -3 * CELLS, 8])
def test_walks_that_lead_off_the_lattice_leave_numbers(model, records, centre):
    """As of a slope that is steep at the end of the lattice, wherever a jump leads before."""
    tracker, probability = SetFilter(model, 300), np.array([[0.2, 0.6, 0.2]])
    walks = Walks(np.zeros(CELLS, np.int64), np.array([centre]), probability, True)
    before = cycle(tracker, None, records[0], (1, 0)).after
    sets = tracker.propagate(before, tracker.record(records[1], (1, 1), walks=walks))
    assert not np.isnan(sets.log_weight).any()
    # Of nothing and of those that all died the births are left.
    assert np.isfinite(sets.log_weight).any()
    assert ((sets.sets.cell >= 0) & (sets.sets.cell < CELLS)).all()
