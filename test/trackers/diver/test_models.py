# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The motion models, and lists of hypotheses: each of them alone, mixtures by their definition."""

from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.arrivals_3d import BEARING, CLOCK, EMISSION, observe, ONE_WAY, PATH
from sonar_imm.estimation import imm
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.config import DiverConfig, MODEL_SETS
from sonar_imm.trackers.diver.explanations import (
    expect_measurements,
    expect_residuals,
    fit_measurements,
    PingMeasurements,
    subset_ping,
)
from sonar_imm.trackers.diver.heavy_tails import student_t_maxima, student_t_ping
from sonar_imm.trackers.diver.models import build_models

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
    models = build_models(
        DiverConfig(model_set=model_set, speed_noise=0.2, covariance_scales=(1.0,))
    )
    x, P, _ = (item[0] for item in models.initial_states(CENTRE[None], SPREAD[None]))
    long_x, long_P, _ = imm.predict(x, P, *models.motion(1.0))
    short_x, short_P = x, P
    for _ in range(10):
        short_x, short_P, _ = imm.predict(short_x, short_P, *models.motion(0.1))
    np.testing.assert_allclose(short_x, long_x, atol=1e-12)
    np.testing.assert_allclose(short_P, long_P, atol=1e-12)
    ten = np.linalg.matrix_power(models.chain.transition(0.1), 10)
    np.testing.assert_allclose(ten, models.chain.transition(1.0), atol=1e-12)


def test_the_set_is_that_of_the_reference():
    config = DiverConfig(
        model_set='heading_speed', stay_probability=0.88, heading_concentration=2.0,
        speed_noise=0.03, lateral_noise=0.2, hover_noise=0.05,
    )  # fmt: skip
    models = build_models(config)
    F, Q, B = models.motion(1.0)
    ours = {'F': F, 'B': B, 'E': models.E, 'Pi': models.chain.matrix}
    reference = load_vectors('diver/imm_reference')
    for key, value in ours.items():
        wanted = reference[f'A12_speedstate16_hover/{key}']
        np.testing.assert_allclose(value, wanted, atol=1e-12)
    # The speed's random walk is integrated over the step, exactly: a third, not all, of its
    # square reaches the position.
    wanted = reference['A12_speedstate16_hover/Q']
    np.testing.assert_allclose(Q, wanted, atol=config.speed_noise**2)


def test_headings_and_the_velocity_they_put_out():
    models = build_models(DiverConfig(model_set='heading_speed', hover=True))
    assert models.names[:3] == ('heading_000', 'heading_022', 'heading_045')
    assert models.names[-2:] == ('heading_337', 'hover')
    x = np.tile([0.0, 0.0, 0.5], (17, 1))
    velocity = np.einsum('jqa,ja->jq', models.E, x)[:, 2:]
    np.testing.assert_allclose(velocity[4], [0.0, 0.5], atol=1e-12)
    np.testing.assert_array_equal(velocity[16], [0.0, 0.0])


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


@pytest.mark.parametrize(
    ('values', 'says'),
    [
        ({'systematic_errors': 'exact', 'receiver_clock_std': 1e-4}, 'receiver_clock_std'),
        ({'confirm_hits': 8, 'confirm_window': 7}, 'cannot exceed confirm_window'),
    ],
)
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
    scale = np.array(
        [4.0, 4.0, 0.5, 0.5] + [0.5, 0.5, 0.2] * receivers * instruments + [90.0] * tag
    )
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
    place = np.argsort(order)
    whose = np.append(np.full(receivers, -1), place[parent])[order]
    parts = kind[order], value[order], variance[order], np.full(len(row), 0.02)
    geometry = 0.0 * rx[row[order]], rx[row[order]], columns[order]
    return x, P, PingMeasurements(np.arange(len(row)), whose, *parts, *geometry), truth


def updates(measured, x, P, estimated, positions):
    subsets = subset_ping(x, P, estimated, -5.0, measured, 0.05, 128)
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
    residual, covariance = expect_measurements(x, P, mu, -5.0, measured)
    np.testing.assert_allclose(residual, nu @ mu)
    np.testing.assert_allclose(expect_residuals(x, mu, -5.0, measured), nu @ mu)
    second = inside + np.einsum('cl,dl->lcd', nu, nu)
    np.testing.assert_allclose(
        covariance, np.tensordot(mu, second, 1) - np.outer(nu @ mu, nu @ mu), atol=1e-8
    )
    S = np.einsum('lcc->lc', inside) + measured.variance
    density = np.exp(-0.5 * nu.T**2 / S) / np.sqrt(2.0 * np.pi * S)
    log_likelihood, nis = fit_measurements(x, P, mu, -5.0, measured)
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
