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

"""The IMM particle filter: closed forms, an enumerated system, and the bits of the kernels."""

from pathlib import Path

import numpy as np
from oracles import imm_particles as oracle
from oracles.markov import stationary_law
import pytest

from sonar_imm.estimation import imm_particles, particles

VECTORS = Path(__file__).parents[1] / 'vectors' / 'bathymetry'
ASYMMETRIC = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])


def normalised(w):
    return w / w.sum(axis=1, keepdims=True)


def random_set(rng, M=3, n=2, N=50):
    return rng.normal(size=(M, n, N)), normalised(rng.random((M, N)) ** 4), rng.dirichlet([1] * M)


class Kernels:
    """The kernels with the signatures of the oracle."""

    @staticmethod
    def resample(x, w, mu, transition, uniform):
        M, n, N = x.shape
        mixed, c = np.empty_like(x), np.empty(M)
        scratch = imm_particles.ResampleScratch(
            np.empty((M, N)), np.empty(N), np.empty(N + 1, np.int64)
        )
        imm_particles.resample(x, w, mu, transition, uniform, scratch, mixed, c)
        return mixed, c

    @staticmethod
    def propagate(x, F, G, noise):
        moved = np.empty_like(x)
        for j in range(len(x)):
            imm_particles.propagate(x[j], F[j], G[j], noise[j], moved[j])
        return moved

    @staticmethod
    def weigh(log_likelihood, c, w=None):
        M, N = log_likelihood.shape
        w = np.full((M, N), 1.0 / N) if w is None else w.copy()
        mu, work = np.empty(M), np.empty((2, N))
        log_sum = imm_particles.weigh(log_likelihood.copy(), c, w, mu, work)
        return oracle.WeightUpdate(w, mu, log_sum, log_sum > -np.inf)

    @staticmethod
    def summarise(x, w, mu):
        n = x.shape[1]
        mean, covariance = np.empty(n), np.empty((n, n))
        imm_particles.summarise(x, w, mu, mean, covariance)
        return mean, covariance


engines = pytest.mark.parametrize('engine', [oracle, Kernels], ids=['numpy', 'kernels'])


@pytest.mark.parametrize('seed', range(20))
def test_kernels_give_the_bits_of_numpy(seed):
    rng = np.random.default_rng(seed)
    x, w, mu = random_set(rng)
    F, G = rng.normal(size=(3, 2, 2)), rng.normal(size=(3, 2, 2))
    uniform, noise = rng.random(3), rng.normal(size=(3, 2, 50))
    log_likelihood = -rng.exponential(20.0, (3, 50))
    log_likelihood[0, :3] = np.nan, -np.inf, -5000.0
    results = []
    for engine in (oracle, Kernels):
        mixed, c = engine.resample(x, w, mu, ASYMMETRIC, uniform)
        moved = engine.propagate(mixed, F, G, noise)
        step = engine.weigh(log_likelihood, c, w)
        results.append([mixed, c, moved, *step, *engine.summarise(moved, step.w, step.mu)])
    for expected, found in zip(*results):
        assert np.array_equal(expected, found)


@engines
def test_resampling_draws_from_the_exact_mixture(engine):
    rng = np.random.default_rng(3)
    x, w, mu = random_set(rng, n=1)
    runs = np.stack(
        [engine.resample(x, w, mu, ASYMMETRIC, rng.random(3))[0].mean(axis=2) for _ in range(4000)]
    )
    own = (w[:, None] * x).sum(axis=2)
    c = mu @ ASYMMETRIC
    expected = (ASYMMETRIC * mu[:, None]).T @ own / c[:, None]
    error = runs.std(axis=0) / np.sqrt(len(runs))
    assert (np.abs(runs.mean(axis=0) - expected) < 4.5 * error).all()
    assert engine.resample(x, w, mu, ASYMMETRIC, rng.random(3))[1] == pytest.approx(c)


@engines
def test_a_model_that_nothing_can_become_stays_finite(engine):
    rng = np.random.default_rng(4)
    x, w, mu = random_set(rng)
    closed = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])
    mixed, c = engine.resample(x, w, mu, closed, rng.random(3))
    assert c[2] == 0.0 and np.isfinite(mixed).all()


@pytest.mark.parametrize('tiny', [5e-324, 1e-310, 1e-300, 1e-280])
def test_a_model_that_hardly_anything_can_become_stays_finite(tiny):
    """The reciprocal of its probability overflows, and numbers particles outside of the set."""
    rng = np.random.default_rng(4)
    x, w, _ = random_set(rng)
    mu, uniform = np.array([0.4, 0.6, tiny]), rng.random(3)
    results = [engine.resample(x, w, mu, np.eye(3), uniform) for engine in (oracle, Kernels)]
    for mixed, c in results:
        assert c[2] == tiny
        # Copies of particles that were there: of the model's own, or of any model's.
        assert np.isin(mixed[2, 0], x[2 if tiny > 1e-290 else slice(None), 0]).all()
    assert np.array_equal(results[0][0], results[1][0])


@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_resampling_weights_that_are_not_finite_stays_in_its_arrays(value):
    rng = np.random.default_rng(5)
    x, w, mu = random_set(rng)
    w[1, 7] = value
    guarded = np.full(50 + 1 + 8, -7)
    scratch = imm_particles.ResampleScratch(np.empty((3, 50)), np.empty(50), guarded[:51])
    mixed, c = np.empty_like(x), np.empty(3)
    imm_particles.resample(x, w, mu, ASYMMETRIC, rng.random(3), scratch, mixed, c)
    assert (guarded[51:] == -7).all() and np.isin(mixed, x).all()


@engines
def test_without_likelihood_the_chain_finds_its_stationary_law(engine):
    rng = np.random.default_rng(5)
    x, w, mu = random_set(rng)
    for _ in range(300):
        x, c = engine.resample(x, w, mu, ASYMMETRIC, rng.random(3))
        step = engine.weigh(np.zeros((3, 50)), c)
        w, mu = step.w, step.mu
    assert mu == pytest.approx(stationary_law(ASYMMETRIC), abs=1e-9)


@engines
def test_likelihood_of_a_model_is_the_weighted_mean(engine):
    w = np.array([[0.9, 0.1], [0.5, 0.5]])
    q = np.array([[1.0, 3.0], [2.0, 6.0]])
    step = engine.weigh(np.log(q), np.array([0.25, 0.75]), w)
    L = (w * q).sum(axis=1)
    assert step.mu == pytest.approx(np.array([0.25, 0.75]) * L / (0.25 * L[0] + 0.75 * L[1]))
    assert step.w == pytest.approx(w * q / L[:, None])
    assert step.log_likelihood == pytest.approx(np.log(0.25 * L[0] + 0.75 * L[1]))


@engines
@pytest.mark.parametrize('value', [-np.inf, np.nan])
def test_the_prediction_is_kept_when_nothing_is_possible(engine, value):
    rng = np.random.default_rng(6)
    _, w, mu = random_set(rng)
    step = engine.weigh(np.full((3, 50), value), mu, w)
    assert not step.ok and np.array_equal(step.w, w) and np.array_equal(step.mu, mu)


@engines
def test_a_model_whose_particles_are_impossible_loses_all_probability(engine):
    log_likelihood = np.zeros((2, 4))
    log_likelihood[1] = -np.inf
    step = engine.weigh(log_likelihood, np.array([0.1, 0.9]))
    assert step.mu.tolist() == [1.0, 0.0] and (step.w == 0.25).all()


@engines
def test_the_summary_is_the_moments_of_the_union(engine):
    rng = np.random.default_rng(7)
    x, w, mu = random_set(rng)
    union, weight = np.moveaxis(x, 1, 0).reshape(2, -1), (mu[:, None] * w).ravel()
    mean, covariance = engine.summarise(x, w, mu)
    assert mean == pytest.approx(np.average(union, axis=1, weights=weight))
    assert covariance == pytest.approx(np.cov(union, aweights=weight, ddof=0))


def test_effective_sample_size_is_the_mean_over_models():
    rng = np.random.default_rng(8)
    _, w, mu = random_set(rng)
    expected = mu @ particles.effective_sample_size(w)
    assert imm_particles.effective_sample_size(w, mu) == pytest.approx(expected)


@pytest.fixture(scope='module')
def enumerated():
    """Runs of the filter on the linear Gaussian system, and its exact answer over all 2^12
    sequences of models."""
    with np.load(VECTORS / 'jmls_enum.npz') as archive:
        case = dict(archive)
    width, N, runs = float(case['dS']), 10_000, 16
    F = np.array([[[1.0, 0.0], [0.0, 0.0]], [[1.0, width], [0.0, 1.0]]])
    G = np.array([[[1.0, 0.0], [0.0, 0.0]], [[width**2 / 2, 0.0], [width, 0.0]]])
    answers = np.empty((runs, len(case['z']), 4))
    for run in range(runs):
        rng = np.random.default_rng(run)
        x = np.stack([rng.normal(size=(2, N)), 0.1 * rng.normal(size=(2, N))], axis=1)
        w, mu = np.full((2, N), 1.0 / N), case['mu0']
        for k, z in enumerate(case['z']):
            x, c = Kernels.resample(x, w, mu, case['Pi'], rng.random(2))
            x = Kernels.propagate(x, F, G, rng.normal(size=(2, 2, N)))
            w, mu, *_ = Kernels.weigh(-0.5 * ((z - x[:, 0]) / case['so']) ** 2, c)
            mean, covariance = Kernels.summarise(x, w, mu)
            answers[run, k] = *mean, mu[1], covariance[0, 0]
    exact = np.column_stack([case[key] for key in ('mean', 'slope', 'p_ncs', 'var')])
    return answers, exact


def test_all_sequences_of_models_are_summed_over(enumerated):
    answers, exact = enumerated
    error = answers.std(axis=0, ddof=1) / np.sqrt(len(answers))
    deviation = np.abs(answers.mean(axis=0) - exact)
    assert (deviation < 5.0 * error + 1e-4).all()
    # Tight where it can be: the ninth and later steps rest on few particles.
    assert deviation[:9, 2].max() < 0.02 and deviation[:, 0].max() < 0.01
