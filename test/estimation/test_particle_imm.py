# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The particle filter of several models against exact filters: a hidden Markov model, Kalman's,
and a tree of all mode sequences. And its parts: log weights, effective sample size, resampling."""

import math
import subprocess
import sys

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.special import logsumexp

from sonar_imm import ParticleIMM
from sonar_imm.estimation import kalman, particles
from sonar_imm.estimation.markov import RateChain
from sonar_imm.estimation.particles import invert, systematic

T = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])
TWO = np.array([[0.95, 0.05], [0.3, 0.7]])
"""Asymmetric: a transposed matrix would show."""
SIGMAS = 4.5
MODES = ((0.01, 0.0), (0.5, 1.0))
"""Variance and drift of the two scalar walks."""
Z = np.array([0.1, -0.3, 0.4, 1.7, 2.2, 2.5, 3.9, 4.0])


def still(x, rng, dt):
    return x


def normal(variance):
    """ln N(z; x, variance) of scalar states."""
    return lambda x, z: -0.5 * ((z - x[:, 0]) ** 2 / variance + math.log(2 * math.pi * variance))


def walk(variance, drift=0.0):
    return lambda x, rng, dt: x + drift * dt + rng.normal(0.0, math.sqrt(variance * dt), x.shape)


def forward(transition, likelihood, mu):
    """The hidden Markov model: probabilities (K, M) and log-likelihoods (K,) of likelihoods (K,
    M); a row of ones for a missed scan."""
    found = []
    for row in likelihood:
        joint = (mu @ transition) * row
        mu = joint / joint.sum()
        found.append((mu, math.log(joint.sum())))
    return tuple(np.array(part) for part in zip(*found))


def close(samples, exact, bias):
    """Runs (R, ...) of independent seeds have the exact mean, but for a bias of order 1 / N."""
    error = np.std(samples, axis=0, ddof=1) / math.sqrt(len(samples))
    return bool((np.abs(np.mean(samples, axis=0) - exact) <= SIGMAS * error + bias).all())


def test_where_the_state_says_nothing_it_is_the_forward_algorithm():
    rng, names, order = np.random.default_rng(3), np.array(['a', 'b', 'c']), [2, 0, 1]
    likelihood = rng.random((30, 3))
    likelihood[7] = likelihood[8] = 1.0
    mu, log = forward(T, likelihood, np.array([0.2, 0.5, 0.3]))

    def sensor(j):
        return lambda x, k: np.full(len(x), math.log(likelihood[k, j]))

    tracker = ParticleIMM(
        {names[j]: still for j in order}, T[np.ix_(order, order)], rng.normal(size=(50, 2)),
        {names[j]: sensor(j) for j in reversed(order)}, rng,
        initial=np.array([0.2, 0.5, 0.3])[order],
    )  # fmt: skip
    assert tracker.names == tuple(names[order])
    for k in range(30):
        tracker.step(None if k in (7, 8) else k)
        np.testing.assert_allclose(tracker.model_probabilities, mu[k, order], atol=1e-13)
        due = math.nan if k in (7, 8) else log[k]
        assert tracker.log_likelihood == pytest.approx(due, abs=1e-12, nan_ok=True)


def test_one_linear_model_is_the_kalman_filter():
    rng, count = np.random.default_rng(7), 60
    F, Q, H, R = np.array([[1.0, 1.0], [0.0, 1.0]]), np.diag([0.1, 0.05]), np.eye(1, 2), np.eye(1)
    root, inside, off, spread, total = np.sqrt(Q), 0, [], [], []
    for _ in range(count):
        truth, P = rng.normal(size=2), np.eye(2)
        tracker = ParticleIMM(
            {'cv': lambda x, rng, dt: x @ F.T + rng.normal(size=x.shape) @ root.T}, [[1.0]],
            rng.normal(size=(3000, 2)), normal(1.0), rng,
        )  # fmt: skip
        x, log = np.zeros(2), 0.0
        for _ in range(10):
            truth = F @ truth + root @ rng.normal(size=2)
            z = truth[:1] + rng.normal(size=1)
            tracker.step(z[0])
            x, P, _ = kalman.predict(x, P, F, Q)
            after = kalman.update(x, P, z - H @ x, H, R)
            x, P, log = after.x, after.P, log + float(after.log_likelihood)
            log -= tracker.log_likelihood
        found = tracker.estimate
        off.append((found.mean - x) / np.sqrt(np.diag(P)))
        spread.append(found.covariance / P)
        total.append(log)
        d = truth - found.mean
        inside += d @ np.linalg.solve(found.covariance, d) < 5.991
    assert close(off, 0.0, bias=0.005) and np.std(off) < 0.1
    assert close(spread, 1.0, bias=0.01)
    assert close(total, 0.0, bias=0.01)
    assert 0.95 * count - 3 * math.sqrt(0.0475 * count) <= inside


def tree(transition, z, variance=0.25):
    """Probabilities (2,) of the models, mean and variance after 8 steps, and the log-likelihood:
    one Kalman filter for each of the 512 sequences of models."""
    x, P, log, mode = np.zeros(2), np.ones(2), np.full(2, math.log(0.5)), np.arange(2)
    for each in z:
        x, P, log = (np.repeat(part, 2) for part in (x, P, log))
        before, mode = np.repeat(mode, 2), np.tile(np.arange(2), len(mode))
        q, drift = np.array(MODES)[mode].T
        x, P, S = x + drift, P + q, P + q + variance
        log = log + np.log(transition[before, mode])
        log -= 0.5 * ((each - x) ** 2 / S + np.log(2.0 * math.pi * S))
        x, P = x + P / S * (each - x), P * variance / S
    weight = np.exp(log - log.max())
    total, weight = log.max() + math.log(weight.sum()), weight / weight.sum()
    mean = weight @ x
    return [*np.bincount(mode, weight), mean, weight @ (P + (x - mean) ** 2), total]


def particle_run(seed, order):
    rng = np.random.default_rng(seed)
    tracker = ParticleIMM(
        {f'm{j}': walk(*MODES[j]) for j in order}, TWO[np.ix_(order, order)],
        rng.normal(size=(2000, 1)), normal(0.25), rng,
    )  # fmt: skip
    total = 0.0
    for z in Z:
        tracker.step(z)
        total += tracker.log_likelihood
    mu, found = tracker.model_probabilities[np.argsort(order)], tracker.estimate
    return [*mu, found.mean[0], found.covariance[0, 0], total]


def test_two_models_are_the_tree_of_all_sequences():
    runs = [particle_run(seed, order=(1, 0)) for seed in range(40)]
    assert np.std(runs, axis=0)[0] < 0.02
    assert close(runs, tree(TWO, Z), bias=0.002)
    assert not close(runs, tree(TWO.T, Z), bias=0.002)
    assert particle_run(1, order=(1, 0)) == runs[1] != runs[2]


def alone(**options):
    rng = np.random.default_rng(0)
    return ParticleIMM({'m': still}, [[1.0]], np.arange(8.0)[:, None], normal(1e4), rng, **options)


def test_a_model_alone_is_resampled_by_its_effective_number():
    tracker = alone()
    for _ in range(3):
        tracker.step(3.0)
    assert tracker.weights.std() > 0.0 and tracker.particles[0, :, 0].tolist() == [*range(8)]
    assert 7.0 < tracker.effective_sample_size[0] < 8.0
    always = alone(resample_below=1.0)
    always.step(3.0)
    always.step(None)
    assert (always.weights == 0.125).all()
    tracker._sensors = (normal(0.01),)
    tracker.step(3.0)
    tracker.step(None)
    assert set(tracker.particles[0, :, 0]) == {3.0}
    assert (tracker.weights == 0.125).all()
    # A measurement that nothing explains changes nothing.
    tracker = alone()
    tracker._sensors = (lambda x, z: np.full(len(x), -np.inf),)
    tracker.step(1.0)
    assert tracker.log_likelihood == -math.inf
    assert tracker.model_probabilities.tolist() == [1.0] and tracker.estimate.mean == [3.5]


def test_a_model_that_cannot_be_comes_back_when_the_chain_allows():
    rng = np.random.default_rng(2)
    tracker = ParticleIMM(
        {'a': walk(0.1), 'b': walk(0.1)}, [[0.9, 0.1], [0.2, 0.8]], rng.normal(size=(100, 1)),
        {'a': lambda x, z: np.full(len(x), -np.inf), 'b': normal(1.0)}, rng,
    )  # fmt: skip
    for z in (0.0, 0.1, -0.1):
        tracker.step(z)
        assert tracker.model_probabilities.tolist() == [0.0, 1.0]
    tracker.step(None)
    assert tracker.model_probabilities == pytest.approx([0.2, 0.8])
    models = {'a': walk(0.1), 'b': walk(0.1)}
    absorbed = ParticleIMM(models, [[1, 0], [1, 0]], np.ones((9, 1)), normal(1.0), rng)
    for z in (1.0, 1.1):
        absorbed.step(z)
        assert absorbed.model_probabilities.tolist() == [1.0, 0.0]
    assert np.isfinite(absorbed.particles).all()


def test_steps_of_any_length_follow_the_generator():
    rng, models = np.random.default_rng(4), {'a': still, 'b': still}
    for transition in (TWO, RateChain(TWO, 1.0)):
        long, short = (
            ParticleIMM(models, transition, np.ones((5, 1)), normal(1.0), rng) for _ in range(2)
        )
        long.step(None)
        for _ in range(4):
            short.step(None, dt=0.25)
        assert short.model_probabilities == pytest.approx(long.model_probabilities, abs=1e-12)
        assert long.model_probabilities == pytest.approx([0.625, 0.375])
    swapped = ParticleIMM(models, np.eye(2)[::-1], np.ones((5, 1)), normal(1.0), rng)
    with pytest.raises(ValueError, match='no generator'):
        swapped.step(None, dt=0.5)


GOOD = {'models': {'a': still, 'b': still}, 'transition': TWO, 'particles': np.ones((10, 3)),
        'log_likelihood': normal(1.0)}  # fmt: skip


@pytest.mark.parametrize('values, problem', [
    ({'models': {}}, 'at least one'),
    ({'transition': np.eye(3)}, '2 x 2 and 2 probabilities'),
    ({'particles': np.ones(10)}, r'\(N, n\) or \(2, N, n\), got shape \(10,\)'),
    ({'particles': np.full((10, 2), np.nan)}, 'finite'),
    ({'log_likelihood': {'a': normal(1.0)}}, 'one for each of a, b, got a'),
    ({'rng': 3}, 'has to be a numpy.random.Generator, got 3'),
    ({'resample_below': 2.0}, 'between 0 and 1'),
])  # fmt: skip
def test_what_does_not_fit_is_refused(values, problem):
    with pytest.raises(ValueError, match=problem):
        ParticleIMM(**{'rng': np.random.default_rng(0), **GOOD, **values})


@pytest.mark.parametrize('values, problem', [
    ({'models': {'a': still, 'b': lambda x, rng, dt: x[:5]}}, r"'b' .* got shape \(5, 3\)"),
    ({'models': {'a': lambda x, rng, dt: x / 0.0, 'b': still}}, "'a' has to give finite"),
    ({'log_likelihood': lambda x, z: x}, r"'a' has to give 10 numbers.* got shape \(10, 3\)"),
    ({'log_likelihood': lambda x, z: x[:, 0] * np.nan}, 'none of them NaN'),
])  # fmt: skip
def test_functions_that_give_something_else_are_refused_and_nothing_changes(values, problem):
    tracker = ParticleIMM(**{'rng': np.random.default_rng(0), **GOOD, **values})
    before = tracker.particles.copy()
    with np.errstate(all='ignore'), pytest.raises(ValueError, match=problem):
        tracker.step(1.0)
    np.testing.assert_array_equal(tracker.particles, before)
    with pytest.raises(ValueError, match='cannot be negative'):
        tracker.step(None, dt=-1.0)


def test_a_function_may_write_into_the_particles_it_is_given():
    def shift(x, rng, dt):
        x += dt
        return x

    rng = np.random.default_rng(0)
    tracker = ParticleIMM(**{**GOOD, 'models': {'a': shift, 'b': still}}, rng=rng)
    first = tracker.particles
    tracker.step(None)
    assert (first == 1.0).all() and set(tracker.particles[0].ravel()) == {2.0}


def test_steps_to_stamps_are_steps_of_their_differences():
    models = {'a': walk(0.3), 'b': walk(2.0, drift=1.0)}

    def filter_(**start):
        particles, rng = np.random.default_rng(1).normal(size=(200, 1)), np.random.default_rng(2)
        return ParticleIMM(models, TWO, particles, normal(0.5), rng, **start)

    by_stamp, by_dt = filter_(stamp=100.0), filter_()
    for z, dt in ((0.2, 0.5), (None, 2.0), (1.0, 0.0), (1.4, 1.25)):
        assert by_stamp.step(z, stamp=by_stamp.stamp + dt) == by_dt.step(z, dt) == 'used'
    assert (by_stamp.stamp, by_dt.stamp) == (103.75, 3.75)
    assert by_stamp.step(9.0, stamp=103.0) == 'too_late'
    assert by_stamp.particles.tobytes() == by_dt.particles.tobytes()
    for stamp, dt, why in ((5.0, 1.0, 'not both'), (math.nan, None, 'finite')):
        with pytest.raises(ValueError, match=why):
            by_dt.step(0.0, dt, stamp=stamp)
    first, none = filter_(), filter_(stamp=50.0)
    first.step(0.2, stamp=50.0)  # the first stamp is that of the start
    none.step(0.2, 0.0)
    assert first.particles.tobytes() == none.particles.tobytes() and first.stamp == 50.0


def test_the_package_shows_its_names_before_they_are_imported():
    program = 'import sys, sonar_imm; print(dir(sonar_imm)); print("numpy" in sys.modules)'
    shown = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    names, loaded = shown.stdout.splitlines()
    assert "'IMM'" in names and "'ParticleIMM'" in names and 'import_module' not in names
    assert loaded == 'False'


def test_normalise_survives_what_underflows_and_nothing_is_uniform():
    log_w = np.array([-1e5, -1e5 + np.log(3.0), -np.inf])
    w, log_sum = particles.normalise(log_w)
    assert w == pytest.approx([0.25, 0.75, 0.0]) and log_sum == pytest.approx(logsumexp(log_w))
    assert particles.effective_sample_size(np.full(50, 0.02)) == pytest.approx(50.0)
    assert particles.effective_sample_size(np.eye(1, 50)[0]) == pytest.approx(1.0)
    w, log_sum = particles.normalise(np.array([[-np.inf, -1.0, 800.0, -np.inf]] * 2))
    assert (w == [0.0, 0.0, 1.0, 0.0]).all() and (log_sum == 800.0).all()
    for row in ([np.nan, -1.0, 800.0, 0.0], [np.inf, -1.0, 800.0, 0.0], [-np.inf] * 4):
        w, log_sum = particles.normalise(np.array([row] * 2))
        assert (w == 0.25).all() and np.isneginf(log_sum).all()


def test_each_particle_is_drawn_as_often_as_its_weight_says():
    w = np.array([0.05, 0.0, 0.4, 0.15, 0.3, 0.1])
    rng, runs, count = np.random.default_rng(1), 5000, 7
    copies = [np.bincount(systematic(w, count, rng), minlength=len(w)) for _ in range(runs)]
    error = np.std(copies, axis=0) / np.sqrt(runs)
    assert (np.abs(np.mean(copies, axis=0) - count * w) <= 4.5 * error + 1e-12).all()
    assert not np.any(copies, axis=0)[1]


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-9),
    st.integers(0, 60),
    st.integers(0, 2**32),
)
def test_systematic_copies_differ_from_the_expectation_by_less_than_one(weights, count, seed):
    w = np.array(weights)
    expected = count * w / w.sum()
    drawn = systematic(w, count, np.random.default_rng(seed))
    assert (drawn == systematic(2.0**-600 * w, count, np.random.default_rng(seed))).all()
    copies = np.bincount(drawn, minlength=len(w))
    assert (copies >= np.floor(expected - 1e-9)).all()
    assert (copies <= np.ceil(expected + 1e-9)).all()
    assert drawn.shape == (count,) and (np.diff(drawn) >= 0).all()


def test_what_are_no_weights_is_refused():
    for weights in ([], [0.0, 0.0], [1.0, -0.1], [1.0, np.nan], [1.0, np.inf], [[1.0, 2.0]]):
        with pytest.raises(ValueError, match='weights'):
            systematic(weights, 3, np.random.default_rng(0))


def test_a_point_on_a_boundary_belongs_to_what_begins_there():
    """Zero is not of a first particle without weight, the very end is of the last one with it."""
    cumulative = np.cumsum([0.0, 0.25, 0.0, 0.25, 0.5])
    assert invert(cumulative, np.array([0.0, 0.25, 0.375, 0.5])).tolist() == [1, 3, 3, 4]
    cumulative = np.cumsum([0.3, 0.7, 0.0])
    assert invert(cumulative, np.array([0.0, 1.0 - 2.0**-53, 1.0])).tolist() == [0, 1, 1]
