# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The filter for sets against an exact one, and what each ingredient is good for."""

import math

from attrs import evolve
from helpers.set_cycle import cycle, steps, weigh
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.estimation import set_model
from sonar_imm.estimation.set_filter import LagSmoother, levelled, SetFilter, Weighted
from sonar_imm.estimation.set_members import find_members
from sonar_imm.estimation.set_shifts import Jump, Shift, ShiftPath

KEY = np.array([1, 2], np.uint64)
JUMP = Jump(probability=0.2, std=4.0, step=2, reach=5)
BANDED = set_model.banded_transition(3, 0.3)
ASYMMETRIC = np.array([[0.6, 0.3, 0.1], [0.15, 0.5, 0.35], [0.05, 0.15, 0.8]])
EXACT_LOG_EVIDENCE = 298.6663117
"""Of the records of exact_hmm.npz, by enumeration of all sets of up to three members on the 60
cells, in a program of its own."""
CELLS, SETS = 400, 20_000


@pytest.fixture(scope='module')
def exact():
    return load_vectors('fathometer/exact_hmm')


@pytest.fixture(scope='module')
def model():
    """That which the records of exact_hmm.npz are drawn from."""
    lag = np.arange(60)
    return set_model.SetModel(
        cells=60, separation=3, order_min=1, transition=np.full((3, 3), 0.2) + 0.4 * np.eye(3),
        walk=set_model.gaussian_walk(0.8), gram=np.sinc(lag / 2.2) * np.exp(-((lag / 12.0) ** 2)),
        amplitude_std=3.0,
    )  # fmt: skip


def run(model, records, particles, seed):
    """PMFs (T, orders), intensities (T, n), log evidence."""
    tracker, rows = SetFilter(model, particles), []
    for step in steps(tracker, records, seed):
        pmf, sums, *_ = tracker.summarise(step)
        rows.append((pmf, sums[0], step.log_evidence))
    pmfs, intensities, evidence = zip(*rows)
    return np.array(pmfs), np.array(intensities), sum(evidence)


def test_the_pmf_and_the_evidence_are_the_exact_ones(model, exact):
    pmf, intensity, evidence = run(model, exact['B'], 20_000, seed=1)
    assert 0.5 * np.abs(pmf - exact['exP']).sum(axis=1).mean() <= 0.008
    assert abs(evidence - EXACT_LOG_EVIDENCE) < 0.5
    assert np.abs(intensity - exact['exI']).sum(axis=1).mean() < 0.06


@pytest.mark.parametrize('change', [
    {'amplitude_prior': 'bic_half'},
    {'amplitude_prior': 'paper', 'transition': ASYMMETRIC},
    {'shift': Shift(std=2.0, step=2), 'negative_probability': 0.3, 'amplitude_memory': 0.9},
    {'jump': JUMP, 'negative_probability': 0.3, 'amplitude_memory': 0.9},
])  # fmt: skip
def test_likelihoods_are_those_of_the_definition_and_amplitudes_go_with_members(
    model, exact, change
):
    changed, N, rng = evolve(model, **change), 400, np.random.default_rng(1)
    tracker, b = SetFilter(changed, N), np.pad(exact['B'][3], changed.pad)
    record = tracker.record(b, (1, 2))
    sets = tracker.start(record).sets
    mean, variance = (rng.uniform(0.5, most, sets.cell.shape) for most in (3.0, 4.0))
    sets = sets._replace(prior_mean=mean, prior_variance=variance)
    propagated = tracker.propagate(Weighted(sets, np.zeros(N)), record)
    moved, possible = propagated.sets, np.isfinite(propagated.log_weight)
    assert len(set(moved.order)) == 3
    step = tracker.weigh(Weighted(moved, np.where(possible, 0.0, -np.inf)), record)
    log_likelihood, mean = weigh(changed, b, moved.take(np.flatnonzero(possible)))
    assert np.allclose(step.after.log_weight[possible], log_likelihood)
    alive = np.isfinite(log_likelihood)
    assert 50 < np.count_nonzero(alive) < N
    assert np.allclose(step.amplitude[possible][alive], mean[alive])
    for i in np.flatnonzero(possible) if changed.amplitude_memory else ():
        old, new = sets.order[i], moved.order[i]
        known = dict(zip(sets.prior_mean[i, :old], zip(sets.sign[i], sets.prior_variance[i])))
        rows = list(zip(moved.prior_mean[i, :new], moved.sign[i], moved.prior_variance[i]))
        kept = {m: (sign, variance) for m, sign, variance in rows if m in known}
        fresh = [variance for m, _, variance in rows if m not in known]
        assert all(known[m] == each for m, each in kept.items()) and len(kept) == min(old, new)
        assert fresh == [changed.amplitude_std**2] * (new - len(kept))


@pytest.mark.parametrize('change', [{}, {'shift': Shift(std=1.5, memory=0.9)}, {'jump': JUMP}])
def test_what_is_kept_of_equal_sets_changes_no_bit(model, exact, change):
    """Equal sets, and those that compete for a slot, are as if each came alone."""
    changed = evolve(model, negative_probability=0.3, **change)
    tracker, N = SetFilter(changed, 600), 600
    b = np.pad(exact['B'][3], changed.pad)
    record = tracker.record(b, (1, 2))
    sets = tracker.start(record).sets.take(np.random.default_rng(0).integers(0, 500, N))
    uniform = np.random.default_rng(3).random((N, changed.uniforms))
    moved, ratio, jump = tracker._drawn(sets, record, uniform)
    step = tracker.weigh(Weighted(moved, np.zeros(N)), record)
    alone = SetFilter(changed, 1)
    for i in range(0, N, 7):
        own = alone.record(b, (1, 2))
        single, paid, own_jump = alone._drawn(sets.take(np.array([i])), own, uniform[i : i + 1])
        assert jump is None or own_jump[0] == jump[i]
        assert paid[0] == ratio[i] and single.shift[0] == moved.shift[i]
        assert single.cell[0].tobytes() == moved.cell[i].tobytes()
        found = alone.weigh(Weighted(moved.take(np.array([i])), np.zeros(1)), own)
        value = found.after.log_weight[0]
        assert value == step.after.log_weight[i]
        if np.isfinite(value):
            assert found.amplitude[0].tobytes() == step.amplitude[i].tobytes()


def test_sums_over_members_are_those_of_a_loop(model, exact):
    tracker = SetFilter(model, 300)
    step, again, other = (cycle(tracker, None, exact['B'][3], (1, k)) for k in (2, 2, 3))
    # A record has random numbers of its own.
    assert step.w.tobytes() == again.w.tobytes() != other.w.tobytes()
    wanted = np.zeros((5, model.cells))
    for w, order, cell, a in zip(step.w, step.sets.order, step.sets.cell, step.amplitude):
        for k in range(order):
            wanted[:4, cell[k]] += w * np.array([1.0, a[k], a[k] ** 2, model.amplitude_std**2])
        wanted[4, cell[:order][:1]] += w
    np.testing.assert_allclose(tracker.summarise(step).sums, wanted, atol=1e-12)


def test_the_likelihood_is_that_of_the_whole_record():
    """Least squares on every sample, noise as correlated as the pulse, is b' G^-1 b / 2."""
    n, places, sigma = 40, np.array([8, 15, 22]), 0.3
    lag = np.arange(n)
    gram = np.exp(-0.5 * (lag / 1.2) ** 2)
    G = gram[np.abs(lag[:, None] - lag[None, :])] + 1e-9 * np.eye(n)
    A, noise = G[:, places], sigma * np.random.default_rng(0).standard_normal(n)
    y = A @ [2.0, 1.0, 1.5] + np.linalg.cholesky(G) @ noise
    a = np.linalg.solve(A.T @ np.linalg.solve(G, A), A.T @ np.linalg.solve(G, y))
    rest = y - A @ a
    full = 0.5 * (y @ np.linalg.solve(G, y) - rest @ np.linalg.solve(G, rest)) / sigma**2
    model = set_model.SetModel(
        cells=n, separation=2, order_min=3, transition=[[1.0]], walk=set_model.gaussian_walk(1.0),
        gram=gram, amplitude_prior='bic_half', independent_samples=1.0,
    )  # fmt: skip
    sets = set_model.Sets.empty(model, 1)
    sets.order[:], sets.cell[0] = 3, places
    log_likelihood, amplitude = weigh(model, y / sigma, sets)
    assert log_likelihood[0] == pytest.approx(full, rel=1e-6)
    assert sigma * amplitude[0] == pytest.approx(a, rel=1e-6)
    # Marginal amplitudes are integrated out.
    model = set_model.SetModel(
        cells=5, separation=1, order_min=1, transition=[[1.0]], walk=set_model.gaussian_walk(0.5),
        gram=np.eye(1, 5)[0], amplitude_std=2.0,
    )  # fmt: skip
    b = np.array([0.0, 0.0, 1.7, 0.0, 0.0])
    sets = set_model.Sets.empty(model, 1)
    sets.order[:], sets.cell[0] = 1, 2
    a = np.linspace(-30.0, 30.0, 200_001)
    prior = np.exp(-0.5 * (a / 2.0) ** 2) / (2.0 * math.sqrt(2.0 * math.pi))
    integral = np.sum(prior * np.exp(a * 1.7 - 0.5 * a * a)) * (a[1] - a[0])
    assert weigh(model, b, sets)[0][0] == pytest.approx(math.log(integral))


def test_what_came_later_corrects_what_was_known(model, exact):
    tracker, smoother = SetFilter(model, 5000), LagSmoother(3)
    then, later, pmfs = [], [], []
    for name, step in enumerate(steps(tracker, exact['B'], 4)):
        pmfs.append(tracker.summarise(step)[0])
        if earlier := smoother.push(step):
            assert earlier.w.sum() == pytest.approx(1.0)
            true = exact['true_m'][name - 3] - 1
            later.append(tracker.summarise(earlier)[0][true])
            then.append(pmfs[name - 3][true])
    assert np.mean(later) > np.mean(then) + 0.01


def test_nothing_is_corrected_across_a_record_that_nothing_explains(model, exact):
    """The filter begins anew there: what comes after it has no ancestors before it."""
    smoother, found = LagSmoother(2), []
    records = [*exact['B'][:3], np.full(60, -5.0), *exact['B'][3:6]]
    for name, step in enumerate(steps(SetFilter(model, 20), records, 4)):
        assert step.ok == (name != 3) == (step.log_evidence > -math.inf)
        assert step.w.sum() == pytest.approx(1.0)
        found.append(smoother.push(step) is not None)
    assert found == [False, False, True, False, False, False, True]


def test_sets_are_resampled_when_few_of_them_count_and_only_then(model, exact):
    """Above half of the sample the weights are carried on instead, which keeps variety."""
    N, kept, drawn = 400, 0, 0
    for step in steps(SetFilter(model, N), np.concatenate([0.3 * exact['B'], exact['B']]), 6):
        assert step.effective == pytest.approx(1.0 / np.sum(step.w**2))
        if step.effective >= 0.5 * N:
            kept += 1
            assert np.array_equal(step.source, np.arange(N))
            carried = np.exp(step.after.log_weight - step.after.log_weight.max())
            assert carried / carried.sum() == pytest.approx(step.w)
            assert np.ptp(step.after.log_weight) > 0.0
        else:
            drawn += 1
            assert (step.after.log_weight == 0.0).all()
            counts = np.bincount(step.source, minlength=N)
            # Systematic: each set as often as its weight says, to the next whole number.
            assert (np.abs(counts - N * step.w) < 1.0 + 1e-9).all()
            assert np.array_equal(step.after.sets.cell, step.sets.cell[step.source])
    assert kept >= 5 and drawn >= 5


@pytest.mark.parametrize('value', [1e200, np.inf, np.nan])
def test_a_record_beyond_numbers_keeps_members_on_the_lattice(model, exact, value):
    tracker, before, records = SetFilter(model, 50), None, exact['B'][:6].copy()
    records[1::2, [0, 17, 59]] = value
    for name, b in enumerate(records):
        step = cycle(tracker, before, b, (1, name))
        before = step.after
        assert ((step.sets.cell >= 0) & (step.sets.cell < model.cells)).all()


def test_models_that_cannot_be_are_refused(model):
    for change in (
        {'amplitude_prior': 'flat'}, {'separation': 40}, {'negative_probability': 1.0},
        {'amplitude_prior': 'paper', 'amplitude_memory': 0.5}, {'transition': np.ones((3, 3))},
    ):  # fmt: skip
        with pytest.raises(ValueError):
            evolve(model, **change)
    # The room that is left is counted in possible sets.
    pairs = sum(1 for i in range(60) for j in range(i) if i - j >= 3)
    assert [model.room(m) for m in (0, 1, 2)] == [1, 60, pairs]


def hills(*places):
    sums = np.zeros((5, 100))
    for place, mass, amplitude in places:
        shape = mass * np.exp(-0.5 * (np.arange(100) - place) ** 2)
        shape *= mass / shape.sum()
        sums += shape * np.array([[1.0], [amplitude], [amplitude**2 + 0.25], [place], [0.5]])
    return sums


def test_each_hill_is_a_member():
    found = find_members(hills((20, 0.9, 5.0), (70, 0.6, 2.0)), 10, 5, 0.01)
    assert found.place[:2] == pytest.approx([20.0, 70.0], abs=0.01)
    assert found.amplitude[:2] == pytest.approx([5.0, 2.0])
    assert found.existence[:2] == pytest.approx([0.9, 0.6], abs=1e-3)
    assert found.prior_variance[:2] == pytest.approx([20.0, 70.0])
    assert found.foremost[:2] == pytest.approx([0.45, 0.3], abs=1e-3)
    assert found.covariance[0] == pytest.approx(np.array([[1.0, 0.0], [0.0, 0.25]]), abs=0.01)


def test_no_more_than_asked_none_that_is_not_believed_and_one_at_the_edge():
    sums = hills((20, 0.9, 5.0), (50, 0.3, 1.0), (70, 0.6, 2.0))
    assert len(find_members(sums, 10, 2, 0.0).place) == 2
    assert find_members(sums, 10, 9, 0.5).place == pytest.approx([20.0, 70.0], abs=0.01)
    assert len(find_members(np.zeros((5, 100)), 10, 9, 0.0).place) == 0
    sums = np.zeros((5, 4))
    sums[:, 0] = 0.8, 0.8, 0.9, 1.6, 0.4
    found = find_members(sums, 1, 3, 0.1)
    assert found.place == pytest.approx([0.0])
    assert found.existence == pytest.approx([0.8])
    assert found.prior_variance == pytest.approx([2.0])


def test_of_two_humps_the_greater_is_reported_with_its_own_spread():
    sums = hills((40, 0.55, 5.0), (52, 0.4, 3.0))
    mean = find_members(sums, 16, 1, 0.5)
    assert mean.place == pytest.approx([45.05], abs=0.1) and mean.covariance[0, 0, 0] > 30.0
    mode = find_members(sums, 16, 1, 0.5, modes=True)
    assert mode.place == pytest.approx([40.0], abs=0.1)
    assert mode.amplitude == pytest.approx([5.0], abs=0.01)
    assert mode.covariance[0] == pytest.approx(np.array([[1.0, 0.0], [0.0, 0.25]]), abs=0.15)
    # That there is a member is as sure as before, wherever it is.
    assert mode.existence == pytest.approx(mean.existence) and mode.existence > 0.9
    assert mode.foremost == pytest.approx(mean.foremost)
    # One hump and what is rare beside it stay whole.
    sums = hills((40, 0.9, 5.0), (52, 0.05, 3.0))
    with_modes = find_members(sums, 16, 1, 0.5, modes=True)
    for found, expected in zip(with_modes, find_members(sums, 16, 1, 0.5)):
        assert np.array_equal(found, expected)


@pytest.fixture
def wide():
    return set_model.SetModel(
        cells=CELLS, separation=2, order_min=1, transition=set_model.banded_transition(4, 0.1),
        walk=set_model.gaussian_walk(2.0), gram=np.exp(-0.5 * (np.arange(CELLS) / 1.5) ** 2),
    )  # fmt: skip


def test_the_sum_of_walks_is_their_convolution():
    walk = np.array([0.2, 0.5, 0.3])
    assert set_model.repeated_walk(walk, 2) == pytest.approx(np.convolve(walk, walk), abs=1e-15)
    long = set_model.repeated_walk(set_model.gaussian_walk(2.0), 50)
    place = np.arange(len(long)) - len(long) // 2
    assert long @ place == pytest.approx(0.0, abs=1e-9)
    assert np.sqrt(long @ np.square(place)) == pytest.approx(2.0 * np.sqrt(50.0), rel=0.01)


@pytest.mark.parametrize(('least', 'records'), [(0, 1), (3, 7)])
def test_who_left_and_was_replaced(least, records):
    P = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.3, 0.1, 0.6]])
    found = set_model.turnover(P, least, records)
    orders = found.reshape(3, -1, 3).sum(axis=1)
    assert orders == pytest.approx(np.linalg.matrix_power(P, records), abs=1e-12)
    rng, drawn = np.random.default_rng(0), np.zeros_like(found)
    for first in range(3):
        for _ in range(2000):
            old, members, j = set(range(least + first)), list(range(least + first)), first
            for _ in range(records):
                j = rng.choice(3, p=P[j])
                rng.shuffle(members)
                members = members[: least + j]
                members += [-1] * (least + j - len(members))
            extra = least + min(first, j) - len(old & set(members))
            drawn[first, 3 * extra + j] += 1.0 / 2000
    assert np.abs(found - drawn).max() < 0.04


def two(tracker, b, count):
    """So many sets of two positive members, at 100 and 250."""
    sets = tracker.start(tracker.record(b, (0, 0))).sets
    sets.order[:], sets.cell[:, :2], sets.sign[:] = 2, (100, 250), 1
    return Weighted(sets, np.zeros(count))


def prior(wide, steps, records):
    """Sets of two members after so many steps without any record."""
    tracker, b = SetFilter(wide, SETS), np.zeros(wide.record_cells)
    state = two(tracker, b, SETS)
    for step in range(steps):
        state = tracker.propagate(state, tracker.record(b, (1, step), records=records))
    w = np.exp(state.log_weight - state.log_weight.max())
    w /= w.sum()
    sets = state.sets
    member = np.arange(sets.cell.shape[1]) < sets.order[:, None]
    near = (np.abs(sets.cell - 100) < 20) & member
    pmf = [w @ (sets.order == m) for m in range(1, 5)]
    place = np.where(near, sets.cell - 100.0, 0.0)
    spread = np.sqrt((w @ np.square(place)).sum() / (w @ near).sum())
    return np.array(pmf), float(w @ near.any(axis=1)), float(spread)


def test_one_long_step_is_as_several_short_ones(wide):
    at_once, by_steps = prior(wide, 1, 5), prior(wide, 5, 1)
    assert at_once[0] == pytest.approx(by_steps[0], abs=0.02)
    assert at_once[1] == pytest.approx(by_steps[1], abs=0.02) and at_once[1] < 0.95
    assert at_once[2] == pytest.approx(by_steps[2], rel=0.05)


@pytest.mark.parametrize('shift', [None, Shift(std=1.5, memory=0.9)])
def test_proposals_after_a_gap_change_no_result(wide, shift):
    changed = evolve(wide, negative_probability=0.3, shift=shift)
    rng = np.random.default_rng(1)
    b = rng.standard_normal(changed.record_cells)
    b[95:108] += 4.0 * np.exp(-0.5 * (np.arange(-5, 8) / 1.5) ** 2)
    found = []
    for shares in ({}, {'walk_share': 0.0, 'birth_share': 0.0}):
        tracker = SetFilter(evolve(changed, **shares), 60_000)
        record = tracker.record(b, (1, 1), records=6)
        step = tracker.weigh(tracker.propagate(two(tracker, b, 60_000), record), record)
        summary = tracker.summarise(step)
        found.append((step.log_evidence, summary.pmf, summary.sums[0, 90:115].sum()))
    for one, other, within in zip(*found, (0.05, 0.02, 0.02)):
        assert one == pytest.approx(other, abs=within)


def test_peaks_are_lowered_and_keep_their_shape(wide):
    g = np.zeros((1, CELLS))
    g[0, 100], g[0, 101], g[0, 200] = 300.0, 290.0, 5.0
    low = levelled(evolve(wide, separation=8), g)[0]
    assert low[100] - low[101] == pytest.approx(10.0)
    # Nine cells at the cap are worth what the peak is.
    assert low[100] == pytest.approx(wide.birth_cap + np.log(9.0), abs=1e-3)
    assert low[200] == 5.0 and (low[110:190] == 0.0).all()


def test_amplitudes_and_shifts_are_forgotten_by_the_time(wide):
    tracker = SetFilter(evolve(wide, amplitude_memory=0.9, shift=Shift(std=1.5, memory=0.8)), 10)
    record = tracker.record(np.zeros(tracker.model.record_cells), (0, 0), records=4)
    assert record.passage.shift.memory == pytest.approx(0.8**4)
    sets = tracker.start(record).sets
    sets.prior_mean[:], sets.prior_variance[:] = 2.0, 0.5
    later = set_model.aged(tracker.model, sets, 3)
    assert later.prior_mean[0, 0] == pytest.approx(2.0 * 0.9**3)
    fresh = (1.0 - 0.9**6) * wide.amplitude_std**2
    assert later.prior_variance[0, 0] == pytest.approx(0.9**6 * 0.5 + fresh)


@pytest.mark.parametrize('step', [1, 4])
def test_an_offset_drawn_anew_leaves_its_distribution(step):
    """By the sum over the grid, also where offsets are less than a step."""
    shift, N, rng = Shift(std=3.0, memory=0.6, step=step), 40_000, np.random.default_rng(3)
    innovation = math.sqrt(1.0 - 0.6**2) * 3.0
    grid = shift.places
    for records in (1, 4, 60):
        shape = rng.integers(-1, 2, records).cumsum()
        paths = shape[None] + grid[:, None]
        log_p = -0.5 * np.square(paths[:, 0] / 3.0)
        log_p -= 0.5 * np.square((paths[:, 1:] - 0.6 * paths[:, :-1]) / innovation).sum(axis=1)
        p = np.exp(log_p - log_p.max())
        p[(paths[:, -1] < grid[0]) | (paths[:, -1] > grid[-1])] = 0.0
        p /= p.sum()
        which = rng.choice(len(grid), N, p=p)
        place = (paths[which] + shift.pad).astype(np.int64)
        path = ShiftPath.begin(shift, place[:, 0])
        for k in range(1, records):
            path = path.then(shift, place[:, k - 1], place[:, k])
        free = np.full(N, -1000), np.full(N, 1000)
        d, after = path.draw(shift, place[:, -1], free, rng.random((N, 2)))
        assert (d % step == 0).all()
        now = which + d // step
        # The first shift may lie beyond the grid, which costs four standard deviations.
        assert ((now < 0) | (now >= len(grid))).mean() < 1e-3
        drawn = np.bincount(now.clip(0, len(grid) - 1), minlength=len(grid)) / N
        assert 0.5 * np.abs(drawn - p).sum() < 0.02
        assert records > 30 or (d != 0).mean() > 0.3
        # The path is that of the shifts it has come to.
        moved = ShiftPath.begin(shift, place[:, 0] + d)
        for k in range(1, records):
            moved = moved.then(shift, place[:, k - 1] + d, place[:, k] + d)
        assert after.pull == pytest.approx(moved.pull)
        assert after.precision == pytest.approx(moved.precision)
        few = np.full(N, 0), np.full(N, step)
        held, _ = path.draw(shift, place[:, -1], few, rng.random((N, 2)))
        assert set(np.unique(held)) <= {0, step}
