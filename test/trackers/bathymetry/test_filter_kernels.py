# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The particle filter of a ping: bits of its verbs in numpy, which meet closed forms. The whole:
exact answers, computed independently."""

from types import SimpleNamespace

from attrs import evolve
from helpers.bathymetry_cases import vector
from helpers.vector_files import load_vectors
import numpy as np
from oracles import bin_likelihood
from oracles import imm_particles as oracle
from oracles.bin_likelihood import exponentials, phasors
import pytest

from sonar_imm.acoustics import interference, laplace, rays
from sonar_imm.acoustics.laplace import likelihood_table
from sonar_imm.trackers.bathymetry import bins, ping
from sonar_imm.trackers.bathymetry.filter_kernels import normals
from sonar_imm.trackers.bathymetry.likelihood import level_geometry
from sonar_imm.trackers.bathymetry.tracker import BathymetryTracker

ASYMMETRIC = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])
M, N, P = 3, 50, 5


def normalised(w):
    return w / w.sum(axis=1, keepdims=True)


def random_set(rng, M=3, n=2, N=50):
    return rng.normal(size=(M, n, N)), normalised(rng.random((M, N)) ** 4), rng.dirichlet([1] * M)


def make_case(
    echo, *, mu=None, heights=True, bent=False, beside=False, favours=False, again=False, seed=0
):
    """Bins of a ping with random everything: models of two states, snapshots, poses."""
    rng, T = np.random.default_rng(seed), len(echo)
    x, w, probability = random_set(rng)
    x *= 1.0 if heights else 0.3
    ranges = 20.0 + 0.4 * np.arange(T)
    iq, ones = rng.normal(size=(T, P, 2)).view(complex)[..., 0], np.ones(T)
    signal = rng.uniform(2.0, 30.0, T)
    base, form, spread = np.zeros(T), laplace.form_coefficients(iq, signal, ones), iq[:, :0]
    if beside:
        sines = rng.uniform(-0.5, 0.5, (T, 2))
        R = interference.noise_covariance(sines, np.ones((T, 2)), ones, P, np.pi)
        parts = interference.interference_form(iq, R)
        base, form, spread = parts.base, -signal[:, None] * parts.beam, parts.spread
    tilt = rng.uniform(0.3, 0.6, T)
    turned = {'tilt': tilt, 'cos_tilt': np.cos(tilt), 'sin_tilt': np.sin(tilt)}
    geometry = level_geometry(ranges, 15.0, 0.5, 0.5, of_heights=heights)
    geometry = geometry._replace(height=rng.normal(15.0, 0.3, T), drift_from=1, **turned)
    if bent:
        profile = rays.profile_of([0.0, 1520.0, 8.0, 1500.0, 20.0, 1490.0])
        table = rays.launch_table(profile, 5.0, ranges[-1], 1500.0)
        depths = {'first_depth': table.first_depth, 'depth_step': table.depth_step}
        row = ranges / table.range_step
        geometry = geometry._replace(launch=table.value, row=row, **depths)
    arrays = (np.ascontiguousarray(part) for part in (form, base, spread, signal))
    likelihood = bins.PingLikelihood(
        ranges, np.array(echo), *arrays, ones, np.zeros(T), likelihood_table(P), geometry
    )
    models = SimpleNamespace(
        F=np.eye(2) + 0.1 * rng.normal(size=(M, 2, 2)), coast=1,
        G=0.1 * rng.normal(size=(M, 2, 2)) * np.array([[1.0, 0.0], [1.0, 1.0]]),
        scale=rng.uniform(0.5, 2.0, (T, M)),
        favour=rng.uniform(0.2, 2.0, (T, M)) if favours else np.empty((0, M)),
    )  # fmt: skip
    return SimpleNamespace(
        start=bins.Particles(x, w, probability if mu is None else mu), models=models,
        chains=np.stack([ASYMMETRIC if mu is None else np.eye(M), np.eye(M)][: 1 + again]),
        uniform=rng.random((T, 2, M)), noise=rng.normal(size=(T, M, 2, N)), ping=likelihood,
    )  # fmt: skip


def compiled(case):
    """Mean, covariance, probability, log likelihood and sample size of each bin; the particles."""
    state, T = bins.Particles(*(part.copy() for part in case.start)), len(case.noise)
    track = bins.Track(*(np.empty((T, *shape)) for shape in ((2,), (2, 2), (M,), (), ())))
    for part in (slice(0, T // 2), slice(T // 2, T)):  # a ping is filtered block by block
        drawn = case.uniform[part], case.noise[part]
        ping.filter_bins(part.start, state, case.models, case.chains, *drawn, case.ping, track)
    return [*track, state.x, state.w]


def in_numpy(case):
    told, g = case.ping, case.ping.geometry

    def look(state, t):
        return bin_likelihood.state_log_likelihoods(state, told, t)

    def drift(state, t):
        moves = not g.of_heights and t >= g.drift_from
        return bin_likelihood.drift(state, t, g) if moves else state.copy()

    answers, x, w = oracle.filter_bins(
        *case.start, case.models, case.chains, case.uniform, case.noise, told.echo, look, drift
    )
    return [*(np.array(column) for column in zip(*answers)), x, w]


def same_bits(case):
    found = compiled(case)
    for a, b in zip(found, in_numpy(case)):
        assert np.array_equal(a, b)
    return found


@pytest.mark.parametrize(
    'options',
    ['', 'bent again', 'bent beside', 'favours', 'angles', 'angles beside favours again'],
)
def test_the_kernel_gives_the_bits_of_the_verbs_in_numpy(options):
    values = dict.fromkeys(options.split(), True)
    echo = np.random.default_rng(1).random(9) < 0.8
    echo[1:3] = False, True
    heights = not values.pop('angles', False)
    for found in same_bits(make_case(echo, seed=1, heights=heights, **values)):
        assert np.isfinite(found).all()


def test_bins_that_cannot_be_explained_leave_the_prediction():
    case = make_case([True] * 6)
    case.ping.geometry.height[2] = 1e3  # nothing is that far
    case.ping.form[4] *= np.nan
    case.start.x[0, 0, :7] = 1e3  # nor are these particles
    assert np.isneginf(same_bits(case)[3][2])


@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_resampling_weights_that_are_not_finite_stays_in_its_arrays(value, monkeypatch):
    case = make_case([True])
    case.start.w[1, 7] = value
    case.models.F[:], case.models.G[:] = np.eye(2), 0.0
    guarded, kernel = np.full(N + 1 + 8, -7), ping.filter_block

    def filter_block(*given):
        numbers = [getattr(each, 'dtype', None) == np.int64 and each.ndim == 1 for each in given]
        assert sum(numbers) == 1
        k = numbers.index(True)
        kernel(*given[:k], guarded[: N + 1], *given[k + 1 :])

    monkeypatch.setattr(ping, 'filter_block', filter_block)
    x = compiled(case)[-2]
    assert (guarded[N + 1 :] == -7).all() and (guarded[: N + 1] >= 0).all()
    assert np.isin(x, case.start.x).all()


def test_resampling_draws_from_the_exact_mixture():
    rng = np.random.default_rng(3)
    x, w, mu = random_set(rng, n=1)
    drawn = [oracle.resample(x, w, mu, ASYMMETRIC, rng.random(3)) for _ in range(4000)]
    runs = np.stack([mixed.mean(axis=2) for mixed, _ in drawn])
    c = mu @ ASYMMETRIC
    expected = (ASYMMETRIC * mu[:, None]).T @ (w[:, None] * x).sum(axis=2) / c[:, None]
    error = runs.std(axis=0) / np.sqrt(len(runs))
    assert (np.abs(runs.mean(axis=0) - expected) < 4.5 * error).all()
    assert drawn[0][1] == pytest.approx(c)


@pytest.mark.parametrize('tiny', [5e-324, 1e-310, 1e-300, 1e-280])
def test_a_model_that_hardly_anything_can_become_stays_finite(tiny):
    """The reciprocal of its probability overflows, and numbers particles outside of the set."""
    rng = np.random.default_rng(4)
    x, w, _ = random_set(rng)
    mu = np.array([0.4, 0.6, tiny])
    mixed, c = oracle.resample(x, w, mu, np.eye(3), rng.random(3))
    assert c[2] == tiny
    # Copies of particles that were there: of the model's own, or of any model's.
    assert np.isin(mixed[2, 0], x[2 if tiny > 1e-290 else slice(None), 0]).all()
    same_bits(make_case([True], mu=mu))


def test_exponentials_phasors_and_normals_are_those_of_the_library():
    values = np.concatenate([-np.logspace(-18, np.log10(699.0), 20_001), np.linspace(-2, 0, 9999)])
    exact = np.exp(values)
    assert (np.abs(exponentials(values) - exact) <= 4e-16 * exact).all()
    nothing = np.array([-np.inf, np.nan, -701.0, -1e300])
    assert (exponentials(nothing) == 0.0).all() and exponentials(np.zeros(1)) == 1.0

    values = np.append(np.linspace(-60.0, 60.0, 4001), np.nan)
    for found, exact in zip(phasors(values, 0.7), (np.cos, np.sin)):
        assert np.abs(found - exact(1.4 * np.pi * values))[:-1].max() < 1e-13
        assert np.isnan(found[-1])

    uniform, out = np.random.default_rng(1).random(10_000), np.empty(10_000)
    uniform[:3] = 0.0, 1.0 - 2.0**-53, 0.5
    radius, angle = np.sqrt(-2.0 * np.log1p(-uniform[:5000])), 2.0 * np.pi * uniform[5000:]
    normals(uniform, uniform.view(np.int64), out, out.view(np.int64))
    assert np.abs(out[:5000] - radius * np.cos(angle)).max() < 1e-13
    assert np.abs(out[5000:] - radius * np.sin(angle)).max() < 1e-13


def test_all_sequences_of_models_are_summed_over():
    """Runs of the filter on a linear Gaussian system: the exact answer is over 2^12 of them."""
    case = load_vectors('bathymetry/jmls_enum')
    width, N, runs = float(case['dS']), 10_000, 16
    F = np.array([[[1.0, 0.0], [0.0, 0.0]], [[1.0, width], [0.0, 1.0]]])
    G = np.array([[[1.0, 0.0], [0.0, 0.0]], [[width**2 / 2, 0.0], [width, 0.0]]])
    answers = np.empty((runs, len(case['z']), 4))
    for run in range(runs):
        rng = np.random.default_rng(run)
        x = np.stack([rng.normal(size=(2, N)), 0.1 * rng.normal(size=(2, N))], axis=1)
        w, mu = np.full((2, N), 1.0 / N), case['mu0']
        for k, z in enumerate(case['z']):
            x, c = oracle.resample(x, w, mu, case['Pi'], rng.random(2))
            x = oracle.propagate(x, F, G, rng.normal(size=(2, 2, N)))
            w, mu, *_ = oracle.weigh(-0.5 * ((z - x[:, 0]) / case['so']) ** 2, c)
            mean, covariance = oracle.summarise(x, w, mu)
            answers[run, k] = *mean, mu[1], covariance[0, 0]
    exact = np.column_stack([case[key] for key in ('mean', 'slope', 'p_ncs', 'var')])
    error = answers.std(axis=0, ddof=1) / np.sqrt(len(answers))
    deviation = np.abs(answers.mean(axis=0) - exact)
    assert (deviation < 5.0 * error + 1e-4).all()
    # Tight where it can be: the ninth and later steps rest on few particles.
    assert deviation[:9, 2].max() < 0.02 and deviation[:, 0].max() < 0.01


def errors(name, **values):
    """An exact case and the estimate of it; abs(dm) / sd and abs(dmu), each (T,)."""
    case, config, snapshot = vector(name)
    (found,) = BathymetryTracker(evolve(config, **values)).process(snapshot)
    deviation = np.abs(found.state[:, 0] - case['m']) / np.sqrt(case['v'])
    return case, found, deviation, np.abs(found.probabilities - case['mu']).max(axis=1)


@pytest.mark.parametrize('name', ['ii_0', 'ii_1', 'iii_0', 'iii_1', 'i_corr_0', 'i_corr_1'])
def test_particles_are_the_exact_filter_within_monte_carlo_error(name):
    case, found, deviation, dmu = errors(f'set_{name}')
    assert deviation.mean() <= 0.035 and dmu.mean() <= 0.006
    assert np.abs(found.covariance[:, 0, 0] / case['v'] - 1.0).mean() < 0.06
    if 'slope' in case:
        slope_sd = np.sqrt(found.covariance[:, 1, 1])
        assert (np.abs(found.state[:, 1] - case['slope']) / slope_sd).mean() < 0.06


@pytest.mark.parametrize('name', ['set_ii_0', 'set_iii_1'])
def test_error_falls_with_the_root_of_the_number_of_particles(name):
    few, many = (errors(name, particles_per_model=N)[2].mean() for N in (300, 4800))
    assert 2.8 < few / many < 5.7


@pytest.mark.parametrize('name', ['set_ii_0', 'set_ii_1'])
def test_gaussians_in_place_of_two_walks_are_near(name):
    """A walk of 1 cm next to one of half a metre: what mixes is no Gaussian."""
    *_, deviation, dmu = errors(name, engine='gaussian')
    assert deviation.mean() < 0.2 and dmu.mean() < 0.015


@pytest.mark.parametrize('engine, tolerance', [('gaussian', 0.08), ('particles', 0.02)])
def test_log_likelihood_of_each_bin(engine, tolerance):
    """The reference leaves out what does not depend on the direction; so do differences."""
    case, found, *_ = errors('set_ii_0', engine=engine)
    constant = np.log(2.0) - 8.0 * np.log(np.pi) - np.log1p(8.0 * case['rho'])
    error = found.extras['log_likelihood'] - constant - case['lev']
    assert np.abs(error).mean() < tolerance
