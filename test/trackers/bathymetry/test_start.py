# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where the filter starts, and near nadir."""

from attrs import evolve
from helpers.bathymetry_cases import floor
import numpy as np
import pytest
from scipy.stats import kstest, truncnorm

from sonar_imm.acoustics import coherence
from sonar_imm.trackers.bathymetry.models import UnknownHeight
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

WATER = 5.0 + 0.05 * np.arange(900)


def run(name, values, **config):
    made = scenario(name, values)
    scene = simulate(made, 1)
    stated = BathymetryConfig.from_mapping(made.instruments())
    tracker = BathymetryTracker(evolve(stated, **config))
    pings = [tracker.process(each.measurement) for each in scene.measurements]
    return [each for ping in pings for each in ping], scene.truth


def rmse(estimate, truth):
    error = (estimate.columns()['height'] - truth.height)[truth.valid]
    return float(np.sqrt(np.mean(np.square(error))))


@pytest.mark.parametrize('staves', [2, 8])
def test_the_first_return_is_found_in_the_water_column(staves):
    shadow = slice(0, 200)  # up to 15 m there is water
    snapshot = floor(0.0, ranges=WATER, P=staves, shadow=shadow, snr_db=30.0)
    snapshot.iq.flags.writeable = True
    rng = np.random.default_rng(1)
    snapshot.iq[shadow] = rng.normal(size=(200, staves)) + 1j * rng.normal(size=(200, staves))
    gamma = coherence.coherence(snapshot.iq, 0.5)[0]
    first = coherence.first_return(gamma, staves)
    assert abs(WATER[first] - 15.0) <= (0.3 if staves == 2 else 0.15)


def test_without_any_echo_the_first_bin_stands_for_the_return():
    assert coherence.first_return(np.full(50, 0.2), 8) == 0
    assert coherence.first_return(np.ones(3), 8) == 0
    assert coherence.first_return(np.full(50, np.nan), 8) == 0


def test_an_unknown_height_is_a_normal_law_cut_at_the_first_return():
    start = UnknownHeight(mean=-20.0, std=5.0, lowest=-17.0, view=None)
    levels = (np.arange(4000) + 0.5) / 4000
    law = truncnorm((-17.0 + 20.0) / 5.0, np.inf, loc=-20.0, scale=5.0)
    assert kstest(start.quantile(levels), law.cdf).statistic < 1e-3
    # The same as angles, from 5 m below the surface to 25 m beside and below.
    angles = UnknownHeight(-20.0, 5.0, -17.0, (-5.0, 25.0, 0.5)).quantile(levels)
    assert kstest(-5.0 - 25.0 * np.sin(angles + 0.5), law.cdf).statistic < 1e-3


@pytest.mark.parametrize('model_set', ['height_two_rw', 'angle_two_rw'])
@pytest.mark.parametrize('height', [10.0, 20.0])
def test_a_wrong_height_of_the_sonar_is_survived(model_set, height):
    values = {'pings': 2, 'ping_rate': 0.3, 'patch_along': [], 'moving': True}
    made = scenario('moving', {**values, 'sonar_height': height, 'first_range': 5.0})
    scene = simulate(made, 2)
    stated = {
        **made.instruments(),
        'sonar_height': 15.0,
        'sonar_height_std': 5.0,
        'model_set': model_set,
    }
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(stated))
    made = [each for item in scene.measurements for each in tracker.process(item.measurement)]
    assert len(made) == 2
    assert max(rmse(a, b) for a, b in zip(made, scene.truth)) < 0.3


def test_without_navigation_the_unknown_height_is_in_the_variance():
    snapshot = floor(0.0)
    sure = BathymetryTracker(BathymetryConfig()).process(snapshot)[0]
    config = BathymetryConfig(sonar_height_std=2.0)
    unsure = BathymetryTracker(config).process(snapshot)[0]
    assert (unsure.covariance[:, 0, 0] > 4.0).all() and (sure.covariance[20:, 0, 0] < 0.1).all()


@pytest.mark.statistics
def test_angles_hold_the_floor_near_nadir():
    values = {'model_set': 'angle_two_rw'}
    made, truth = run('paper', {'pings': 5, 'first_range': 15.1}, **values)
    assert max(rmse(a, b) for a, b in zip(made, truth)) < 0.3
    near = truth[0].range < 20.0
    flat = np.mean([each.probabilities[near, 1] > 0.5 for each in made])
    assert flat < 0.15
    made, truth = run('paper', {'pings': 5, 'first_range': 15.1}, **values, angle_drift=False)
    rough = np.mean([each.probabilities[near, 1] > 0.5 for each in made])
    assert rough > 0.6  # the paper's walk cannot follow: a flat floor is called rough
