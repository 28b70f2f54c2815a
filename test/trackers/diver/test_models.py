# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Model sets and their parameters; pings against definitions and quadrature; families against an
independent prototype, and what they promise their users."""

import math

from attrs import evolve
from helpers.diver_runs import fix, followed, miss, run, scan_of
from helpers.estimates import same
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.arrivals_3d import BEARING, CLOCK, EMISSION, observe, ONE_WAY, PATH
from sonar_imm.estimation import bank, imm, rows
from sonar_imm.measurements import NOBODY
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver import explanations
from sonar_imm.trackers.diver import models as sets
from sonar_imm.trackers.diver.config import MODEL_SETS, TARGETS
from sonar_imm.trackers.diver.explanations import PingMeasurements
from sonar_imm.trackers.diver.heavy_tails import student_t_maxima, student_t_ping
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

TWO = {'model_set': 'linear', 'acceleration_noise': (0.1, 0.2)}
CENTRE, SPREAD = np.array([3.0, -2.0]), np.array([[2.0, 0.5], [0.5, 1.0]])


@pytest.mark.parametrize('model_set', MODEL_SETS)
def test_every_set_is_consistent(model_set):
    config = DiverConfig(model_set=model_set)
    models = build_models(config)
    M, n = len(models.names), models.n
    assert M == config.model_count() and len(set(models.names)) == M
    assert models.E.shape == (M, 4, n) and models.initial.shape == (M,)
    np.testing.assert_allclose(models.initial.sum(), 1.0)
    for dt in (0.0, 1e-3, 0.3, 1.0, 29.0, 600.0):
        F, Q, B = models.motion(dt)
        assert F.shape == Q.shape == (M, n, n) and B.shape == (M, n)
        np.testing.assert_array_equal(Q, np.swapaxes(Q, -1, -2))
        assert np.linalg.eigvalsh(Q).min() > -1e-9 * max(Q.max(), 1e-9)
        np.testing.assert_allclose(models.chain.transition(dt).sum(axis=1), 1.0)
    x, P, mu = (item[0] for item in models.initial_states(CENTRE[None], SPREAD[None]))
    mean, covariance = imm.combine(x, P, mu, models.E)
    assert len(mean) == models.rows_per_track
    np.testing.assert_allclose(mean[:, :2], np.tile(CENTRE, (models.rows_per_track, 1)))
    for row, scale in zip(covariance, models.row_scales):
        np.testing.assert_allclose(row[:2, :2], scale * SPREAD)


@pytest.mark.parametrize('model_set', MODEL_SETS)
def test_ten_short_steps_are_one_long_step(model_set):
    settings = {'speed_noise': 0.2, 'covariance_scales': (1.0,)}
    models = build_models(DiverConfig(model_set=model_set, **settings))
    x, P, _ = (item[0] for item in models.initial_states(CENTRE[None], SPREAD[None]))
    long_x, long_P, _ = imm.predict(x, P, *models.motion(1.0))
    for _ in range(10):
        x, P, _ = imm.predict(x, P, *models.motion(0.1))
    np.testing.assert_allclose(x, long_x, atol=1e-12)
    np.testing.assert_allclose(P, long_P, atol=1e-12)
    ten = np.linalg.matrix_power(models.chain.transition(0.1), 10)
    np.testing.assert_allclose(ten, models.chain.transition(1.0), atol=1e-12)


def test_the_set_is_that_of_the_reference():
    config = DiverConfig(
        model_set='heading_speed', stay_probability=0.88, heading_concentration=2.0,
        speed_noise=0.03, lateral_noise=0.2, hover_noise=0.05,
    )  # fmt: skip
    models = build_models(config)
    assert models.names[:3] == ('heading_000', 'heading_022', 'heading_045')
    assert models.names[-2:] == ('heading_337', 'hover')
    F, Q, B = models.motion(1.0)
    reference = load_vectors('diver/imm_reference')
    for key, value in {'F': F, 'B': B, 'E': models.E, 'Pi': models.chain.matrix}.items():
        wanted = reference[f'A12_speedstate16_hover/{key}']
        np.testing.assert_allclose(value, wanted, atol=1e-12)
    # The speed's random walk is integrated over the step, exactly: a third, not all, of its
    # square reaches the position.
    wanted = reference['A12_speedstate16_hover/Q']
    np.testing.assert_allclose(Q, wanted, atol=config.speed_noise**2)


CONTRADICT = [
    ({'systematic_errors': 'exact', 'receiver_clock_std': 1e-4}, 'receiver_clock_std'),
    ({'confirm_hits': 8, 'confirm_window': 7}, 'cannot exceed confirm_window'),
]


@pytest.mark.parametrize(
    ('values', 'says'),
    [
        ({'model_set': 'heading_sped'}, 'did you mean'),
        ({'depth_min': 30.0}, 'cannot exceed'),
        ({'covariance_scales': (0.001, 1.0)}, 'covariance_scales'),
        ({'covariance_scales': ()}, 'one value at least'),
        ({'transition_matrix': (0.5, 0.5)}, '37 x 37'),
        ({'model_set': 'heading_speed', 'transition_matrix': (0.5, 0.5)}, '17 x 17'),
        ({**TWO, 'transition_matrix': (0.9, 0.2, 0.5, 0.5)}, 'row 0 .* 1.1'),
        ({'acceleration_noise': (0.1,)}, 'three values, of lively_calm'),
        ({'initial_probabilities': (1.0,)}, '37 values'),
        ({'model_set': 'heading_speed', 'initial_probabilities': (1.0,)}, '17 values'),
        ({**TWO, 'initial_probabilities': (0.5, 0.6)}, 'sum to 1.1'),
        ({'history': float('nan')}, 'finite'),
        ({'directions': 3}, 'between 4 and 64'),
        ({'sped_mean': 1.0}, "did you mean 'speed_mean'"),
        ({'target': 'bot'}, 'did you mean|must be one of'),
        ({'coverage_sector': [0.0, 0.0]}, 'coverage_sector needs 6 values, got 2'),
        ({'coverage_sector': [0, 0, 0, 0, 0, 9]}, 'a width of 0 is not between 0 and 360'),
        ({'coverage_sector': [0, 0, 0, 90, 9, 9]}, 'a range from 9 to 9 holds nothing'),
        ({'sensors': ['a', 'b'], 'b.coverage_sector': [0.0] * 5}, 'b.coverage_sector needs 6'),
        ({'sensors': ['a'], 'a.fix_std': -1.0}, "'a.fix_std' must be between"),
        ({'sensors': ['a'], 'b.fix_std': 1.0}, "unknown parameter 'b.fix_std'"),
        ({'sensors': ['a'], 'a.max_tracks': 1}, "unknown parameter 'a.max_tracks'"),
        ({'sensors': 5, 'a.fix_std': 1.0}, "'sensors' must be a list"),
        ({'tags': ['a/b']}, "'a/b' cannot be part of a topic"),
        ({'transceiver_lever': [1.0]}, 'needs three values'),
    ],
)
def test_bad_parameters_get_a_sentence(values, says):
    with pytest.raises(ConfigError, match=says):
        DiverConfig.from_mapping(values)


@pytest.mark.parametrize('values, says', CONTRADICT)
def test_constants_that_contradict_parameters_get_one_too(values, says):
    with pytest.raises(ConfigError, match=says):
        DiverConfig(**values)


def test_a_given_matrix_is_used_in_its_orientation():
    asymmetric = (0.9, 0.1, 0.4, 0.6)
    models = build_models(DiverConfig(**TWO, transition_matrix=asymmetric))
    np.testing.assert_allclose(models.chain.matrix, np.reshape(asymmetric, (2, 2)))


def test_the_cache_of_steps_is_bounded():
    models = build_models(DiverConfig())
    for k in range(1000):
        models.motion(1.0 + 1e-4 * k)
    assert len(models._cache) < 100


MOTION, L = 4, 9


def hypotheses(seed, receivers, tag=False, instruments=False):
    """x (L, n), P (L, n, n) of hypotheses about one diver, and the ping that he causes: each
    receiver may have an offset and a clock, and every third one a bearing."""
    rng = np.random.default_rng(seed)
    n = MOTION + 3 * receivers * instruments + tag
    own = [0.5, 0.5, 0.2] * receivers * instruments
    scale = np.array([4.0, 4.0, 0.5, 0.5, *own, *[90.0] * tag])
    truth = np.zeros(n)
    truth[:2] = rng.uniform(-40.0, 40.0, 2)
    A = scale[:, None] * (np.eye(n) + 0.1 * rng.normal(size=(L, n, n)))
    x = truth + 0.5 * scale * rng.normal(size=(L, n))
    P = A @ np.swapaxes(A, 1, 2)
    angle = 2.0 * np.pi * np.arange(receivers) / receivers
    rx = np.column_stack([70.0 * np.cos(angle), 60.0 * np.sin(angle), -2.0 + 0.0 * angle])
    parent = np.arange(0, receivers, 3)
    row = np.append(np.arange(receivers), parent)
    kind = np.append(np.full(receivers, ONE_WAY if tag else PATH), np.full(len(parent), BEARING))
    columns = np.full((len(row), 7), -1)
    columns[:, :2] = 0, 1
    if instruments:
        columns[:, 3], columns[:, CLOCK] = MOTION + 3 * row, MOTION + 3 * row + 2
        columns[kind == BEARING, CLOCK] = -1
    if tag:
        columns[:, EMISSION] = n - 1
    variance = np.where(kind == BEARING, 1e-3, 0.09)
    value = observe(truth[:, None], -5.0, kind, columns, 0.0 * rx[row], rx[row])[0][:, 0]
    value = value + np.sqrt(variance) * rng.normal(size=len(row))
    value[1] += 7.0
    # Bearings stand behind the echoes that they came with.
    order = np.argsort(row, kind='stable')
    whose = np.append(np.full(receivers, -1), np.argsort(order)[parent])[order]
    parts = kind[order], value[order], variance[order], np.full(len(row), 0.02)
    geometry = 0.0 * rx[row[order]], rx[row[order]], columns[order]
    return x, P, PingMeasurements(np.arange(len(row)), whose, *parts, *geometry), truth


def updates(measured, x, P, estimated, positions):
    subsets = explanations.subset_ping(x, P, estimated, -5.0, measured, 0.05, 128)
    return *subsets, *student_t_ping(x, P, estimated, -5.0, measured, positions, 4.0, 0.02)


@pytest.mark.parametrize('tag', [False, True])
@pytest.mark.parametrize('instruments', [False, True])
def test_a_list_of_hypotheses_is_each_of_them_with_its_own_variances(tag, instruments):
    """Also where the errors of the instruments are only considered, and are more than arrivals."""
    x, P, measured, truth = hypotheses(1, 5, tag, instruments)
    estimated = (np.arange(x.shape[1]) < MOTION) | (np.arange(x.shape[1]) == x.shape[1] - tag)
    positions = truth[:2] + [[3.0, -8.0], [-6.0, 2.0]]
    scale = np.random.default_rng(2).choice([0.15, 1.0, 3.0, 10.0], L)
    scaled = measured._replace(variance=scale[:, None] * measured.variance)
    together = updates(scaled, x, P, estimated, positions)
    for k in range(L):
        own = measured._replace(variance=scale[k] * measured.variance)
        alone = updates(own, x[[k]], P[[k]], estimated, positions)
        for part, one in zip(together, alone):
            np.testing.assert_allclose(part[k], one[0], rtol=1e-9, atol=1e-9)
    if instruments:
        considered = np.flatnonzero(~estimated)
        np.testing.assert_allclose(together[0][:, considered], x[:, considered], atol=1e-12)
        inside = np.ix_(range(L), considered, considered)
        np.testing.assert_allclose(together[5][inside], P[inside], atol=1e-12)


def test_a_mixture_is_what_its_definition_says():
    x, P, measured, _ = hypotheses(3, 4)
    mu = np.random.default_rng(4).dirichlet(np.ones(L))
    mu[2] = 0.0
    mu /= mu.sum()
    one = measured.kind, measured.columns, measured.tx, measured.rx
    expected, gradient = observe(x.T, -5.0, *one)
    nu = measured.value[:, None] - expected
    inside = np.einsum('cal,lab,dbl->lcd', gradient, P, gradient)
    residual, covariance = explanations.expect_measurements(x, P, mu, -5.0, measured)
    np.testing.assert_allclose(residual, nu @ mu)
    np.testing.assert_allclose(explanations.expect_residuals(x, mu, -5.0, measured), nu @ mu)
    second = inside + np.einsum('cl,dl->lcd', nu, nu)
    np.testing.assert_allclose(
        covariance, np.tensordot(mu, second, 1) - np.outer(nu @ mu, nu @ mu), atol=1e-8
    )
    S = np.einsum('lcc->lc', inside) + measured.variance
    density = np.exp(-0.5 * nu.T**2 / S) / np.sqrt(2.0 * np.pi * S)
    log_likelihood, nis = explanations.fit_measurements(x, P, mu, -5.0, measured)
    np.testing.assert_allclose(log_likelihood, np.log(mu @ density))
    np.testing.assert_allclose(nis, (nu.T**2 / S).min(axis=0))


def test_a_hypothesis_whose_covariance_has_no_root_stays_as_it_is():
    x, P, measured, truth = hypotheses(5, 8)
    P[4, 1, 1] = -1.0
    P[6] = np.nan
    estimated, positions = np.ones(MOTION, bool), truth[None, :2]
    heavy = estimated, -5.0, measured, positions, 4.0, 0.02
    after = student_t_ping(x, P, *heavy)
    lost = np.isin(np.arange(L), [4, 6])
    np.testing.assert_array_equal(np.isfinite(after[2]), ~lost)
    np.testing.assert_array_equal(after[0][lost], x[lost])
    np.testing.assert_array_equal(after[1][lost], P[lost])
    for part, other in zip(after, student_t_ping(x[~lost], P[~lost], *heavy)):
        np.testing.assert_array_equal(part[~lost], other)
    nobody = student_t_ping(x[lost], P[lost], *heavy)
    np.testing.assert_array_equal(nobody[2], -np.inf)
    assert (student_t_maxima(x[4], P[4], positions, measured, -5.0, 4.0)[1] == -np.inf).all()


def test_many_arrivals_lead_all_hypotheses_to_one_place():
    """From wherever they start: the ping by itself says where the diver is."""
    x, P, measured, truth = hypotheses(6, 12)
    heavy = np.ones(MOTION, bool), -5.0, measured, truth[None, :2] + 5.0, 4.0, 0.02
    mean, covariance, _, good = student_t_ping(x, P, *heavy)
    assert np.hypot(*(mean[:, :2] - truth[:2]).T).max() < 1.0
    assert (good[:, 2] < 0.1).all()  # the echo that is late
    np.testing.assert_array_equal(covariance, np.swapaxes(covariance, 1, 2))


RECEIVERS = np.array([[10, 85, 0], [-40, -60, 0], [80, -50, 0], [-90, -10, 0]], float)
"""Four receivers, one of which may hear the tag late: three of them leave two places."""

TAG_CASES = [(28.0, 0.02), (28.0, 1e-6), (14.0, 0.02), (-28.0, 0.02), (60.0, 0.05), (0.0, 0.02)]


@pytest.mark.parametrize('late, wild', TAG_CASES)
def test_a_tag_that_four_receivers_hear_is_where_the_integral_says(late, wild):
    """Mean, spread and evidence of the posterior of the position, summed over a fine grid."""
    std, spread, density = 2.0, 20.0, 1.0 / 50.0
    truth, mean = np.array([-33.0, -17.0, 0.0]), np.array([-21.0, -26.0])
    columns = np.full((4, 7), -1)
    columns[:, :2], columns[:, EMISSION] = (0, 1), 2
    kind, geometry = np.full(4, ONE_WAY), (np.zeros((4, 3)), RECEIVERS)
    value = observe(truth[:, None], 0.0, kind, columns, *geometry)[0][:, 0]
    value += [late, 0.9, -0.7, 0.4]
    parts = np.full(4, -1), kind, value, np.full(4, std**2), np.full(4, density)
    measured = PingMeasurements(np.arange(4), *parts, *geometry, columns)
    P = np.diag([spread**2, spread**2, 40.0**2])
    starts = np.array([truth[:2], [-59.0, -38.0], [10.0, -60.0]])
    law = np.ones(3, bool), 0.0, measured, starts, 4.0, wild
    got = student_t_ping(np.append(mean, 5.0)[None], P[None], *law)

    side, emission = np.arange(-80.0, 80.0, 1.0), np.arange(-120.0, 130.0, 1.0)
    place = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) + mean
    square = ((place - mean) ** 2).sum(axis=1) / spread**2
    apart = value - np.linalg.norm(place[:, None] - RECEIVERS[:, :2], axis=2)
    weight = np.zeros(len(place))
    for sent in emission:
        misfit = ((apart - sent) / std) ** 2
        fit = (1.0 - wild) * 0.375 / std * (1.0 + misfit / 4.0) ** -2.5 + wild * density
        weight += np.exp(-0.5 * (square + ((sent - 5.0) / 40.0) ** 2)) * fit.prod(axis=1)
    share = weight / weight.sum()
    centre = share @ place
    sd = np.sqrt(share @ (place - centre) ** 2)
    assert (np.abs(got[0][0, :2] - centre) < 0.1 * sd).all()
    ratio = np.sqrt(np.diag(got[1][0])[:2]) / sd
    assert (ratio > 0.8).all() and (ratio < 1.2).all()
    volume = np.log(2.0 * np.pi) * 1.5 + np.log(spread**2 * 40.0)
    constants = 4.0 * np.log((1.0 - wild) * 0.375 / std)
    # The weights of the residuals hold a place a little narrower than the density.
    assert -1.2 < got[2][0] - (np.log(weight.sum()) - volume - constants) < 0.0


def config(**values):
    # The prototype's velocities at the start, those of swimmers; what is at its default gives way.
    return DiverConfig(**{'max_tracks': 1, 'velocity_std': np.nextafter(0.7, 1.0), **values})


@pytest.fixture(scope='module')
def mixing():
    return load_vectors('regret_free/mixing')


@pytest.fixture(scope='module')
def models():
    return build_models(config())


def test_chain_and_models_are_those_of_the_prototype(models, mixing):
    np.testing.assert_allclose(models.chain.generator, mixing['generator'], atol=1e-12)
    for name, dt in (('transition_1s', 1.0), ('transition_07s', 0.7)):
        np.testing.assert_allclose(models.chain.transition(dt), mixing[name], atol=1e-12)
    np.testing.assert_array_equal(models.families.kind, mixing['kind'])
    assert models.families.sector == pytest.approx(mixing['sector_variance'])


def assert_model(kind, x, P, due_x, due_P):
    """A model has three components, or four."""
    own = slice(0, 4 if kind == 1 else 3)
    np.testing.assert_allclose(x[own], due_x[own], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(P[own, own], due_P[own, own], rtol=1e-12, atol=1e-12)


def only(model):
    return np.eye(37)[int(model)]


def mixed(models, x, P, mu, transition):
    law = evolve(models.bank, speed=0.75, speed_variance=0.16)
    blocks, c = bank.mix(law, models.to_blocks(x[None], P[None]), mu[None], transition)
    return (part[0] for part in (*models.to_common(tuple(blocks)), c))


def test_mixing_is_that_of_the_prototype(models, mixing):
    assert mixing['speed_mean'] == 0.75 and mixing['speed_variance'] == pytest.approx(0.16)
    parts = (mixing[name] for name in ('x', 'P', 'mu'))
    x, P, c = mixed(models, *parts, mixing['transition_1s'][None])
    np.testing.assert_allclose(c, mixing['out_c'], rtol=1e-12)
    for model in zip(mixing['kind'], x, P, mixing['out_x'], mixing['out_P']):
        assert_model(*model)


PAIRS = ['heading_to_cv', 'cv_to_heading', 'cv_to_hover', 'hover_to_cv', 'heading_to_heading']


@pytest.mark.parametrize('pair', PAIRS)
def test_image_of_one_model_in_the_components_of_another(models, mixing, pair):
    source, target = mixing[f'{pair}/in_model'], int(mixing[f'{pair}/out_model'])
    everywhere = np.full((1, 37, 37), 1.0 / 37.0)
    x, P, _ = mixed(models, mixing['x'], mixing['P'], only(source), everywhere)
    due = mixing[f'{pair}/x'], mixing[f'{pair}/P']
    assert_model(models.families.kind[target], x[target], P[target], *due)


def test_a_velocity_goes_to_the_headings_it_may_have(models, mixing):
    """The probability is shared by the direction of the velocity, not by the chain."""
    source, transition = int(mixing['cv_to_heading/in_model']), mixing['transition_1s'][None]
    _, _, c = mixed(models, mixing['x'], 0.01 * mixing['P'], only(source), transition)
    velocity, headings = mixing['x'][source, 2:], models.families.kind == 0
    likeliest = models.families.units[headings][c[headings].argmax()]
    assert likeliest @ velocity > 0.9 * np.hypot(*velocity)
    np.testing.assert_allclose(c[headings].sum(), transition[0, source, headings].sum())
    np.testing.assert_allclose(c[~headings], transition[0, source, ~headings], atol=1e-15)


def test_a_run_is_that_of_the_prototype(monkeypatch):
    """Its steps are rounded and not learnt; who stands keeps his pace, each scale its row."""
    monkeypatch.setattr(sets, 'SPEED_MEMORY', 1e12)
    monkeypatch.setattr(rows, 'ROW_LOST', 1e-300)
    fixed = {'association': 'gnn', 'adaptation': 'fixed', 'confirm_hits': 1}
    tracker = DiverTracker(config(**fixed, covariance_scales=(1.0, 3.0, 10.0)))
    exact = tracker.models.chain.transition
    tracker._chain.transition = lambda learnt, dt: np.array(exact(round(dt, 6))[None])
    run = load_vectors('regret_free/run')
    np.testing.assert_allclose(tracker.models.initial, run['start_mu'], atol=1e-15)
    assert tuple(run['scales']) == tracker.config.covariance_scales
    for k, t in enumerate(run['t']):
        estimate = tracker.process(fix(1.0 + t, *run['z'][k], run['R'][k]))[-1]
        known = tracker._stream.state.rows
        for found, name in (
            (estimate.state[0], 'out_x'),
            (estimate.covariance[0], 'out_P'),
            (known.weight, 'out_scale_probability'),
            *((known.mu[copy], f'copy{copy}/mu') for copy in range(3)),
        ):
            np.testing.assert_allclose(found, run[name][k], atol=1e-9)


def test_who_stood_for_minutes_goes_on_at_a_pace_of_his_own(monkeypatch):
    """Fixes half a minute apart, as of a towed tag: who keeps the crawl stays behind."""

    def worst():
        rng, tracker, out = np.random.default_rng(4), DiverTracker(config(association='gnn')), []
        for k in range(27):
            swum = np.array([20.0 * (min(k, 8) + max(k - 24, 0)), 0.0])
            std = 9.0 if k > 24 else 4.0 if k > 8 else 1.5
            z = swum + 3.0 * rng.normal(size=2) / math.sqrt(2.0)
            (estimate,) = tracker.process(fix(100 + 30 * k, *z, std**2 * np.eye(2)))
            out.append(miss(estimate, swum)[0])
        return max(out[25:])

    found = worst()
    monkeypatch.setattr(sets, 'SPEED_MEMORY', 1e12)
    assert found < 0.75 * worst()


def path(count, std=0.5, scale=1.0, **more):
    """Fixes of a diver who swims east, their covariances `scale` times what is true."""
    z = east(count) + std * np.random.default_rng(1).normal(size=(count, 2))
    made = (fix(100.0 + k, *each, np.eye(2) * std**2 * scale) for k, each in enumerate(z))
    return [evolve(each, **more) for each in made]


def east(count):
    return 0.7 * np.arange(count)[:, None] * [1.0, 0.0]


def moved(item, x, y):
    return evolve(item, position=item.position + [x, y, 0.0])


def test_what_is_stated_and_how_far_the_rows_are_apart(monkeypatch):
    """A row below 1 adds the square of how far the means are apart; NIS and scale stay."""
    monkeypatch.setattr(rows, 'ROW_LOST', 1e-300)
    settings, apart = {'association': 'gnn', 'adaptation': 'fixed'}, 0.0
    with_it, without = (
        run(DiverTracker(config(covariance_scales=scales, **settings)), path(60, 0.4, 6.0))
        for scales in ((0.15, 1.0, 3.0, 10.0), (1.0, 3.0, 10.0))
    )
    for one, other in zip(with_it[5:], without[5:]):
        off = one.state[0] - other.state[0]
        due = other.covariance[0] + np.outer(off, off)
        np.testing.assert_allclose(one.covariance[0], due, atol=1e-9)
        for name in ('nis', 'covariance_scale'):
            np.testing.assert_allclose(one.extras[name], other.extras[name], rtol=1e-9)
        apart = max(apart, np.hypot(*off[:2]))
    assert apart > 0.1


def test_a_name_does_not_make_a_fix_good():
    """Wild fixes with a name, which the rows take for outliers, spoil no more than without."""
    plain, rng, error = path(200, std=0.9), np.random.default_rng(3), []
    for k in np.flatnonzero(rng.uniform(size=200) < 0.05)[1:]:
        plain[k] = moved(plain[k], *(40.0 * rng.normal(size=2)))
    for items in (plain, [evolve(item, target_id=7) for item in plain]):
        estimates = run(DiverTracker(config(association='gnn', max_tracks=20)), items)
        rows = [np.flatnonzero(e.extras['track_id'] == 1)[0] for e in estimates]
        error.append(np.array([e.state[row, :2] for e, row in zip(estimates, rows)]) - east(200))
    plain_rmse, named_rmse = (np.sqrt(np.mean(np.sum(e[10:] ** 2, axis=1))) for e in error)
    # At an outlier, the place of the fix is published with its weight.
    assert plain_rmse < 0.9 and np.median(np.hypot(*(error[1] - error[0]).T)) < 0.01
    assert named_rmse < 1.2


def test_two_false_fixes_in_clutter_do_not_move_a_track():
    """Where so many are false that two may well agree, tracks begin by their hits."""
    items = path(40)
    items[30:32] = [moved(item, 50.0, 50.0) for item in items[30:32]]
    made = run(DiverTracker(config(max_tracks=5, clutter_density=1e-2)), items)[31]
    assert miss(made, east(32)[-1], np.flatnonzero(made.extras['track_id'] == 1)[0])[0] < 5.0


def test_nobody_coasts_while_his_fixes_are_refused():
    """Fixes of a name that agree with nothing are outliers: its track grows wide, and ends."""
    rng = np.random.default_rng(0)
    items = path(60, target_id=7)
    wild = [moved(item, *(3000.0 * rng.normal(size=2))) for item in items[30:50]]
    tracker = DiverTracker(config(max_tracks=5, max_coast=15.0))
    before = run(tracker, items[:30])[-1]
    after = run(tracker, wild)
    assert before.extras['target_id'].tolist() == [7]
    assert after[10].covariance[0, 0, 0] > 10.0 * before.covariance[0, 0, 0]
    assert any(1 not in e.extras['track_id'] for e in after)


def test_transitions_are_learnt_inside_families_only():
    tracker = DiverTracker(config())
    run(tracker, path(200))
    family, nominal = tracker.models.families.family, tracker.models.chain.transition(1.0)
    learnt = tracker._chain.transition(tracker._stream.state['learnt'], 1.0)[0]
    inside = family[:, None] == family[None]
    np.testing.assert_allclose(learnt[~inside], nominal[~inside], atol=1e-15)
    np.testing.assert_allclose(learnt.sum(axis=1), 1.0)
    assert np.abs(learnt - nominal)[inside].max() > 0.01


def smoothed(truth, std, rng):
    """The estimates of a smoother of fixes of `truth` (n, 2), and those by looking back."""
    tracker = SmoothingDiverTracker(config(confirm_hits=1))
    z = truth + std * rng.normal(size=truth.shape)
    made = [fix(k, *each, std**2 * np.eye(2)) for k, each in enumerate(z, start=1)]
    return followed(tracker, made), tracker.smoothed()


def test_smoothing_is_better_than_the_filter():
    rng = np.random.default_rng(2)
    heading = np.cumsum(np.where(rng.uniform(size=80) < 0.06, rng.normal(size=80), 0.0))
    truth = np.cumsum(0.7 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    filtered, back = smoothed(truth, 1.0, rng)
    plain, smooth = (
        np.sqrt(np.mean([miss(*pair)[0] ** 2 for pair in zip(each, truth)]))
        for each in (filtered, back)
    )
    assert smooth < 0.85 * plain
    assert [item.stamp_ns for item in back] == [item.stamp_ns for item in filtered]
    assert same(back[-1], filtered[-1])
    for estimate in back:
        assert np.linalg.eigvalsh(estimate.covariance[0]).min() > 0.0
        assert estimate.probabilities.sum() == pytest.approx(1.0)


def test_smoothing_knows_when_behaviour_changed():
    x = np.concatenate([2.0 * np.arange(40), np.full(40, 78.0)])
    _, back = smoothed(x[:, None] * [1.0, 0.0], 0.3, np.random.default_rng(4))
    assert np.mean([e.extras['hover'][0] for e in back[52:]]) > 0.7
    speed = [np.hypot(*e.state[0, 2:]) for e in back]
    np.testing.assert_allclose(speed[10:34], 2.0, atol=0.4)


def test_one_row_and_no_hover():
    tracker = DiverTracker(config(covariance_scales=(1.0,), hover=False, directions=8))
    assert len(tracker.models.names) == 19
    estimate = run(tracker, path(30))[-1]
    assert estimate.extras['covariance_scale'].tolist() == [1.0]
    assert estimate.extras['hover'].tolist() == [0.0]
    assert miss(estimate, east(30)[-1])[0] < 1.0


def boat(speed, count, std, name=NOBODY):
    """Fixes of a boat that turns slowly, and its true path (count, 2)."""
    turn = 0.01 * np.arange(count)
    truth = speed / 0.01 * np.column_stack([np.sin(turn), 1.0 - np.cos(turn)])
    at = truth + std * np.random.default_rng(3).normal(size=truth.shape)
    ids = None if name == NOBODY else [name]
    return [scan_of(1 + k, [z], std, target_id=ids) for k, z in enumerate(at)], truth


@pytest.mark.parametrize('association, name', [('gnn', 7), ('jipda', NOBODY)])
def test_what_is_faster_than_any_diver_is_tracked_from_its_third_fix(association, name):
    tracker = DiverTracker(DiverConfig(association=association))
    fixes, truth = boat(12.0, 20, 1.0, name)
    made = followed(tracker, fixes)
    assert {tuple(each.extras['track_id'].tolist()) for each in made} == {(1,)}
    assert all(each.extras['track_state'][0] > 0 for each in made[2:])
    off, nees = np.array([miss(*pair) for pair in zip(made, truth)])[4:].T
    assert np.sqrt(np.square(off).mean()) < 2.0 and nees.mean() < 4.0
    assert not tracker.warnings()


def test_fixes_that_nothing_that_swims_can_cause_are_no_track_and_warn():
    """In millimetres, as it may be."""
    tracker = DiverTracker(DiverConfig())
    made = followed(tracker, boat(800.0, 30, 0.3)[0])
    assert not any((each.extras['track_state'] > 0).any() for each in made)
    (sentence,) = tracker.warnings()
    assert sentence.startswith('no track takes the fixes') and 'target' in sentence


def test_the_second_of_two_divers_is_not_taken_for_the_first():
    tracker = DiverTracker(DiverConfig())
    for k in range(8):
        seen = [[0.5 * k, 0.0], [0.5 * k, 12.0]][: 1 if k == 0 else 2]
        made = tracker.process(scan_of(k + 1, seen, 0.2))[-1]
    assert (made.extras['track_state'] > 0).sum() == 2


@pytest.mark.parametrize('target', TARGETS)
def test_each_kind_is_what_its_parameters_say(target):
    named, spelt = DiverConfig(target=target), DiverConfig(**TARGETS[target])
    assert named.for_target() == evolve(spelt, target=target)
    assert DiverTracker(named).config == named.for_target()


def test_what_is_stated_is_kept():
    config = DiverConfig(target='ship', speed_mean=9.0)
    assert config.for_target().speed_mean == 9.0
    assert config.for_target().speed_std == TARGETS['ship']['speed_std']
    tracker = DiverTracker(config)
    tracker.reconfigure(evolve(config, fix_std=2.0))
    assert tracker.config.speed_mean == 9.0
    with pytest.raises(ValueError, match='target'):
        tracker.reconfigure(evolve(config, target='fish'))


def test_another_set_is_not_changed_by_the_kind():
    config = DiverConfig(model_set='heading_speed', target='boat')
    assert config.for_target() == config
