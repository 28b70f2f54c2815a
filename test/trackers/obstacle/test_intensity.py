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

"""Elevation by intensity: the likelihood of a whole sequence, and what must not change."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.obstacle.intensity import (
    DRIFT_DB,
    FAINTEST_DB,
    level_db,
    pattern_db,
    Strengths,
    weighed,
)
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig

WIDTH = np.radians(15.0)


def follow(levels, elevations, times, weight=1.0, fading=6.0):
    """Weights of K components after levels (n,), elevations (n, K)."""
    K = elevations.shape[1]
    mu, strengths, before = np.full((1, K), 1.0 / K), Strengths.unknown(1, K), times[0]
    for level, elevation, t in zip(levels, elevations, times):
        mu, strengths = weighed(
            mu,
            strengths,
            elevation[None],
            np.array([level]),
            dt=t - before,
            width=WIDTH,
            fading_db=fading,
            weight=weight,
        )
        before = t
    return mu[0]


def test_half_the_width_off_the_axis_a_beam_is_6_db_fainter_out_and_back():
    assert pattern_db(np.array([0.5 * WIDTH]), WIDTH) == pytest.approx(-6.02, abs=0.01)
    assert pattern_db(np.array([0.0, 3.0 * WIDTH]), WIDTH).tolist() == [0.0, -FAINTEST_DB]


def test_weights_are_those_of_the_joint_density_of_all_levels():
    rng = np.random.default_rng(1)
    n, K = 12, 4
    times = np.cumsum(rng.uniform(0.3, 0.8, n))
    elevations = rng.uniform(-0.15, 0.15, (n, K))
    levels = 40.0 + rng.normal(scale=6.0, size=n) + pattern_db(elevations[:, 2], WIDTH)
    # S is a random walk that starts unknown; levels - G are S and white fading.
    since = times - times[0]
    covariance = 1e4 + DRIFT_DB**2 * np.minimum.outer(since, since) + 36.0 * np.eye(n)
    log = np.array(
        [
            multivariate_normal.logpdf(
                levels - pattern_db(elevations[:, k], WIDTH), np.zeros(n), covariance
            )
            for k in range(K)
        ]
    )
    wanted = np.exp(log - log.max())
    assert follow(levels, elevations, times) == pytest.approx(wanted / wanted.sum(), rel=1e-9)
    tempered = np.sqrt(wanted)
    assert follow(levels, elevations, times, weight=0.5) == pytest.approx(
        tempered / tempered.sum(), rel=1e-9
    )


def test_a_sonar_that_does_not_tilt_learns_next_to_nothing():
    rng = np.random.default_rng(2)
    times = 0.5 * np.arange(60.0)
    slices = np.radians([-6.0, -3.0, 0.0, 3.0, 6.0])
    level = 30.0 + pattern_db(slices[1], WIDTH) + rng.normal(scale=5.6, size=60)
    still = follow(level, np.tile(slices, (60, 1)), times, weight=0.5)
    assert still == pytest.approx(np.full(5, 0.2), abs=2e-3)
    nod = np.radians(5.0) * np.sin(2.0 * np.pi * times / 10.0)
    level = 30.0 + pattern_db(slices[1] + nod, WIDTH) + rng.normal(scale=5.6, size=60)
    tilted = follow(level, slices + nod[:, None], times, weight=0.5)
    assert np.argmax(tilted) == 1 and tilted[3:].sum() < 0.05


def test_a_detection_without_intensity_changes_nothing():
    levels = level_db(np.array([np.nan, 0.0, -1.0, np.inf, 10.0]))
    assert np.isnan(levels[:4]).all() and levels[4] == pytest.approx(20.0)
    mu = np.array([[0.3, 0.7], [0.5, 0.5]])
    values = {'dt': 1.0, 'width': WIDTH, 'fading_db': 6.0, 'weight': 0.5}
    elevation = np.array([[0.1, np.nan], [0.1, -0.1]])
    new, strengths = weighed(mu, Strengths.unknown(2, 2), elevation, np.full(2, np.nan), **values)
    np.testing.assert_allclose(new, mu)
    assert np.isfinite(strengths.variance).all()
    new, _ = weighed(mu, Strengths.unknown(2, 2), elevation, np.array([1e6, -1e6]), **values)
    assert np.isfinite(new).all() and new.sum(axis=1) == pytest.approx([1.0, 1.0])


def test_it_is_off_by_default_and_for_the_gaussian_sum_only():
    assert ObstacleConfig().vertical_beam_width_deg == 0.0
    with pytest.raises(ConfigError, match='gaussian_sum'):
        ObstacleConfig(method='seafloor', vertical_beam_width_deg=15.0)


@pytest.mark.statistics
def test_a_nodding_sonar_knows_the_height_sooner_in_the_whole_tracker():
    from benchmarks.obstacle_intensity import CALM, NODDING, run

    scene = {**CALM, **NODDING, 'last_range': 48.0}
    errors = {}
    for width in (0.0, 15.0):
        config = ObstacleConfig(behaviours=('fixed',), vertical_beam_width_deg=width)
        found = np.array([run(scene, seed, 1.0, config) for seed in range(5)])
        errors[width] = np.sqrt(np.nanmean(np.square(found[:, 0, 0])))
    assert errors[15.0] < 0.8 * errors[0.0]
