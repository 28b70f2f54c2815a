# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The motion models: steps compose, outputs agree, scenes may be turned."""

from pathlib import Path

import numpy as np
import pytest

from sonar_imm.estimation import imm
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.config import DiverConfig, MODEL_SETS
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
    with np.load(Path(__file__).parents[2] / 'vectors/diver/imm_reference.npz') as reference:
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
    ],
)
def test_bad_parameters_get_a_sentence(values, says):
    with pytest.raises(ConfigError, match=says):
        DiverConfig.from_mapping(values)


def test_a_given_matrix_is_used_in_its_orientation():
    asymmetric = (0.9, 0.1, 0.4, 0.6)
    models = build_models(DiverConfig(**TWO, transition_matrix=asymmetric))
    np.testing.assert_allclose(models.chain.matrix, np.reshape(asymmetric, (2, 2)))


def test_the_cache_of_steps_is_bounded():
    models = build_models(DiverConfig())
    for k in range(1000):
        models.motion(1.0 + 1e-4 * k)
    assert len(models._cache) < 100
