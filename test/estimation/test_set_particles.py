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

"""The filter for sets against an exact one, its two forms against each other, and what each
ingredient is good for."""

import math
from pathlib import Path

from attrs import evolve
from helpers.set_cycle import cycle
import numpy as np
from oracles.set_particles import propagate, propose, start, weigh
import pytest

from benchmarks.fathometer_vectors import exact_hmm_model, EXACT_LOG_EVIDENCE
from sonar_imm.estimation.set_filter import LagSmoother, SetFilter, Weighted
from sonar_imm.estimation.set_model import banded_transition, gaussian_walk, SetModel, Sets
from sonar_imm.estimation.set_shifts import Shift

VECTORS = Path(__file__).parents[1] / 'vectors' / 'fathometer'


@pytest.fixture(scope='module')
def exact():
    with np.load(VECTORS / 'exact_hmm.npz') as file:
        return {name: file[name] for name in file}


@pytest.fixture(scope='module')
def model():
    return exact_hmm_model()


def run(model, records, particles, seed, threads=1):
    """PMFs (T, orders), intensities (T, n), log evidence."""
    tracker, before = SetFilter(model, particles, threads), None
    pmfs, intensities, evidence = [], [], 0.0
    for name, b in enumerate(records):
        step = cycle(tracker, before, b, (seed, name))
        before = step.after
        pmf, sums, _ = tracker.summarise(step)
        pmfs.append(pmf)
        intensities.append(sums[0])
        evidence += step.log_evidence
    return np.array(pmfs), np.array(intensities), evidence


def variation(pmf, exact):
    return 0.5 * np.abs(pmf - exact['exP']).sum(axis=1).mean()


def test_the_pmf_and_the_evidence_are_the_exact_ones(model, exact):
    pmf, intensity, evidence = run(model, exact['B'], 20_000, seed=1)
    assert variation(pmf, exact) <= 0.008
    assert abs(evidence - EXACT_LOG_EVIDENCE) < 0.5
    assert np.abs(intensity - exact['exI']).sum(axis=1).mean() < 0.06


def test_the_error_falls_with_the_root_of_the_number_of_particles(model, exact):
    few, many = (
        np.mean([variation(run(model, exact['B'], N, seed)[0], exact) for seed in range(6)])
        for N in (500, 8000)
    )
    assert 2.5 < few / many < 6.5  # sqrt(16) = 4


def test_proposals_change_how_many_particles_count_and_nothing_else(model, exact):
    for shares in ({'birth_share': 0.0}, {'walk_share': 0.5, 'birth_share': 0.5}):
        pmf, _, evidence = run(evolve(model, **shares), exact['B'], 20_000, seed=2)
        assert variation(pmf, exact) <= 0.012
        assert abs(evidence - EXACT_LOG_EVIDENCE) < 0.7


@pytest.mark.parametrize('table', ['walk_ratio', 'birth_ratio'])
def test_without_its_ratio_a_proposal_is_wrong(model, exact, table, monkeypatch):
    from sonar_imm.estimation import set_filter

    if table == 'walk_ratio':
        fill = set_filter.kernels.fill_walks

        def unpaid(*arguments):
            fill(*arguments)
            ratio = arguments[-1].walk_ratio
            ratio[ratio > 0.0] = 1.0

        monkeypatch.setattr(set_filter.kernels, 'fill_walks', unpaid)
    else:
        births = set_filter.propose_births
        monkeypatch.setattr(
            set_filter,
            'propose_births',
            lambda *a: (births(*a)[0], np.zeros((1, model.cells)), births(*a)[2]),
        )
    assert variation(run(model, exact['B'], 5000, seed=1)[0], exact) > 0.03


def test_amplitudes_that_are_not_drawn_anew_at_random_are_paid_for(model, exact):
    """Best amplitudes without a penalty make too many members; with the paper's, too few."""
    orders = np.arange(1, 4)
    mean = {
        name: (run(changed, exact['B'], 3000, seed=1)[0] @ orders).mean()
        for name, changed in {
            'exact': model,
            'free': evolve(model, amplitude_prior='bic_half', independent_samples=1.0),
            'paper': evolve(model, amplitude_prior='paper', independent_samples=500.0),
        }.items()
    }
    assert mean['free'] > mean['exact'] + 0.3
    assert mean['paper'] < mean['exact'] - 0.1


def test_threads_do_not_change_a_byte(model, exact):
    single, four = (run(model, exact['B'][:10], 3001, seed=5, threads=n) for n in (1, 4))
    assert single[0].tobytes() == four[0].tobytes()
    assert single[1].tobytes() == four[1].tobytes()


def test_a_record_has_random_numbers_of_its_own(model, exact):
    tracker = SetFilter(model, 500)
    before = cycle(tracker, None, exact['B'][0], (3, 7)).after
    again = [cycle(tracker, before, exact['B'][1], (3, 8)) for _ in range(2)]
    other = cycle(tracker, before, exact['B'][1], (3, 9))
    assert again[0].w.tobytes() == again[1].w.tobytes() != other.w.tobytes()


@pytest.mark.parametrize(
    'change',
    [
        {},
        {'walk_share': 0.0, 'birth_share': 0.0},
        {'amplitude_prior': 'bic_half'},
        {'amplitude_prior': 'paper'},
        {'amplitude_memory': 0.9},
        {'negative_probability': 0.3},
        {'shift': Shift(std=2.0, step=2), 'negative_probability': 0.3},
        {'shift': Shift(std=1.5, memory=0.9)},
        {'transition': banded_transition(3, 0.3), 'order_min': 0},
        {'transition': np.array([[0.6, 0.3, 0.1], [0.15, 0.5, 0.35], [0.05, 0.15, 0.8]])},
    ],
)
def test_the_compiled_form_does_what_the_readable_one_says(model, exact, change):
    changed = evolve(model, **change)
    tracker, N = SetFilter(changed, 400), 400
    rng = np.random.default_rng(1)
    b = np.pad(exact['B'][3], changed.pad)
    record = tracker.record(b, (1, 2))
    before, peaks = tracker.start(record), len(record.found[1].first)
    uniform = np.random.Generator(
        np.random.Philox(
            key=np.array([1, 2], np.uint64), counter=np.array([0, 0, 0, 1], np.uint64)
        )
    ).random((N, 1 + changed.order_max + (changed.shift is not None) + peaks))
    sets, ratio = start(changed, propose(changed, b), b, uniform)
    assert np.allclose(before.log_weight, ratio)
    possible = np.isfinite(ratio)
    assert np.array_equal(before.sets.cell[possible], sets.cell[possible])
    assert np.array_equal(before.sets.sign[possible], sets.sign[possible])
    assert np.array_equal(before.sets.shift, sets.shift)
    assert (len(np.unique(sets.shift)) > 3) == (changed.shift is not None)
    assert (len(np.unique(sets.sign)) == 2) == (changed.negative_probability > 0.0)

    sets = before.sets._replace(
        prior_mean=rng.uniform(-1.0, 3.0, before.sets.cell.shape),
        prior_variance=rng.uniform(0.5, 4.0, before.sets.cell.shape),
    )
    uniform = np.random.Generator(np.random.Philox(key=np.array([1, 2], np.uint64))).random(
        (N, changed.uniforms)
    )
    propagated = tracker.propagate(Weighted(sets, np.zeros(N)), record)
    moved, ratio = propagated.sets, propagated.log_weight
    expected, wanted = propagate(changed, propose(changed, b), sets, uniform)
    assert np.array_equal(moved.order, expected.order)
    assert np.allclose(ratio, wanted)
    assert len(set(moved.order)) == 3
    possible = np.isfinite(ratio)
    for i in np.flatnonzero(possible):
        m = moved.order[i]
        assert np.array_equal(moved.cell[i, :m], expected.cell[i, :m])
        assert np.array_equal(moved.sign[i, :m], expected.sign[i, :m])
        assert moved.shift[i] == expected.shift[i]
        if changed.amplitude_memory:
            assert np.array_equal(moved.prior_mean[i, :m], expected.prior_mean[i, :m])

    step = tracker.weigh(Weighted(moved, np.where(possible, 0.0, -np.inf)), record)
    weight, amplitude = step.after.log_weight, step.amplitude
    log_likelihood, mean = weigh(changed, b, moved.take(np.flatnonzero(possible)))
    assert np.allclose(weight[possible], log_likelihood)
    alive = np.isfinite(log_likelihood)
    assert 50 < np.count_nonzero(alive) < N
    assert np.allclose(amplitude[possible][alive], mean[alive])


@pytest.mark.parametrize('change', [{}, {'shift': Shift(std=1.5, memory=0.9)}])
def test_what_is_kept_of_equal_sets_changes_no_bit(model, exact, change):
    """Sets that come again, and those that compete for a slot, are moved and weighed as if each
    came alone."""
    changed = evolve(model, negative_probability=0.3, **change)
    tracker, N = SetFilter(changed, 600), 600
    b = np.pad(exact['B'][3], changed.pad)
    record = tracker.record(b, (1, 2))
    sets = tracker.start(record).sets.take(np.random.default_rng(0).integers(0, 90, N))
    uniform = np.random.default_rng(3).random((N, changed.uniforms))
    moved, ratio = tracker._drawn(sets, record, uniform)
    step = tracker.weigh(Weighted(moved, np.zeros(N)), record)
    alone = SetFilter(changed, 1)
    for i in range(0, N, 7):
        own = alone.record(b, (1, 2))
        single, paid = alone._drawn(sets.take(np.array([i])), own, uniform[i : i + 1])
        assert paid[0] == ratio[i] and single.shift[0] == moved.shift[i]
        assert single.cell[0].tobytes() == moved.cell[i].tobytes()
        found = alone.weigh(Weighted(moved.take(np.array([i])), np.zeros(1)), own)
        value = found.after.log_weight[0]
        assert value == step.after.log_weight[i]
        if np.isfinite(value):
            assert found.amplitude[0].tobytes() == step.amplitude[i].tobytes()


def test_the_likelihood_is_that_of_the_whole_record():
    """Least squares on every sample, noise as correlated as the pulse, is b' G^-1 b / 2."""
    n, places, sigma = 40, np.array([8, 15, 22]), 0.3
    lag = np.arange(n)
    gram = np.exp(-0.5 * (lag / 1.2) ** 2)
    G = gram[np.abs(lag[:, None] - lag[None, :])] + 1e-9 * np.eye(n)
    y = G[:, places] @ [2.0, 1.0, 1.5] + np.linalg.cholesky(G) @ (
        sigma * np.random.default_rng(0).standard_normal(n)
    )
    A = G[:, places]
    a = np.linalg.solve(A.T @ np.linalg.solve(G, A), A.T @ np.linalg.solve(G, y))
    residual = y - A @ a
    full = 0.5 * (y @ np.linalg.solve(G, y) - residual @ np.linalg.solve(G, residual)) / sigma**2
    model = SetModel(
        cells=n,
        separation=2,
        order_min=3,
        transition=[[1.0]],
        walk=gaussian_walk(1.0),
        gram=gram,
        amplitude_prior='bic_half',
        independent_samples=1.0,
    )
    sets = Sets.empty(model, 1)
    sets.order[:], sets.cell[0] = 3, places
    log_likelihood, amplitude = weigh(model, y / sigma, sets)
    assert log_likelihood[0] == pytest.approx(full, rel=1e-6)
    assert sigma * amplitude[0] == pytest.approx(a, rel=1e-6)


def test_marginal_amplitudes_are_integrated_out():
    model = SetModel(
        cells=5,
        separation=1,
        order_min=1,
        transition=[[1.0]],
        walk=gaussian_walk(0.5),
        gram=np.eye(1, 5)[0],
        amplitude_std=2.0,
    )
    b = np.array([0.0, 0.0, 1.7, 0.0, 0.0])
    sets = Sets.empty(model, 1)
    sets.order[:], sets.cell[0] = 1, 2
    a = np.linspace(-30.0, 30.0, 200_001)
    prior = np.exp(-0.5 * (a / 2.0) ** 2) / (2.0 * math.sqrt(2.0 * math.pi))
    integral = np.sum(prior * np.exp(a * 1.7 - 0.5 * a * a)) * (a[1] - a[0])
    assert weigh(model, b, sets)[0][0] == pytest.approx(math.log(integral))


def test_what_came_later_corrects_what_was_known(model, exact):
    tracker, smoother, before = SetFilter(model, 5000), LagSmoother(3), None
    right_then, right_later = [], []
    pmfs = []
    for name, b in enumerate(exact['B']):
        step = cycle(tracker, before, b, (4, name))
        before = step.after
        pmfs.append(tracker.summarise(step)[0])
        earlier = smoother.push(step)
        if earlier:
            assert earlier.w.sum() == pytest.approx(1.0)
            true = exact['true_m'][name - 3] - 1
            right_later.append(tracker.summarise(earlier)[0][true])
            right_then.append(pmfs[name - 3][true])
    assert np.mean(right_later) > np.mean(right_then) + 0.01


def test_nothing_is_corrected_across_a_record_that_nothing_explains(model, exact):
    """The filter begins anew there: what comes after it has no ancestors before it."""
    tracker, smoother, before = SetFilter(model, 20), LagSmoother(2), None
    found = []
    for name, b in enumerate([*exact['B'][:3], np.full(60, -5.0), *exact['B'][3:6]]):
        step = cycle(tracker, before, b, (4, name))
        before = step.after if step.ok else None
        found.append(smoother.push(step) is not None)
    assert found == [False, False, True, False, False, False, True]


def test_sets_are_resampled_when_few_of_them_count_and_only_then(model, exact):
    """Resampling costs variety: below half of the sample it is worth it, above it is not, and the
    weights are carried on instead."""
    tracker, N = SetFilter(model, 400), 400
    known, kept, drawn = None, 0, 0
    for name, b in enumerate(np.concatenate([0.3 * exact['B'], exact['B']])):
        step = cycle(tracker, known, b, (6, name))
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
        known = step.after
    assert kept >= 5 and drawn >= 5


def test_a_record_nothing_explains_is_said_so(model):
    step = cycle(SetFilter(model, 100), None, np.full(60, -5.0), (0, 1))
    assert not step.ok
    assert step.log_evidence == -math.inf
    assert step.w.sum() == pytest.approx(1.0)


@pytest.mark.parametrize('value', [1e200, np.inf, np.nan])
def test_a_record_beyond_numbers_keeps_members_on_the_lattice(model, exact, value):
    tracker, before = SetFilter(model, 50), None
    for name, b in enumerate(exact['B'][:6]):
        b = b.copy()
        b[[0, 17, 59]] = value if name % 2 else b[[0, 17, 59]]
        step = cycle(tracker, before, b, (1, name))
        before = step.after
        assert ((step.sets.cell >= 0) & (step.sets.cell < model.cells)).all()


def test_models_that_cannot_be_are_refused(model):
    for change in (
        {'amplitude_prior': 'flat'},
        {'separation': 40},
        {'negative_probability': 1.0},
        {'amplitude_prior': 'paper', 'amplitude_memory': 0.5},
        {'transition': np.ones((3, 3))},
    ):
        with pytest.raises(ValueError):
            evolve(model, **change)


def test_room_counts_the_possible_sets(model):
    pairs = sum(1 for i in range(60) for j in range(i) if i - j >= 3)
    assert [model.room(m) for m in (0, 1, 2)] == [1, 60, pairs]
