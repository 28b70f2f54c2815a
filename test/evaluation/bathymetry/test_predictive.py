# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What tuning runs the bathymetry tracker with."""

import math

from helpers.bathymetry_cases import floor
import numpy as np
from oracles.array_likelihood import log_likelihood
from oracles.grid import filtered
import pytest

from sonar_imm.acoustics import array
from sonar_imm.acoustics.laplace import log_constant
from sonar_imm.estimation.markov import persistent
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig, MODEL_SETS
from sonar_imm.trackers.bathymetry.tracker import BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry.predictive import for_tuning, Scored, tunables


def test_of_a_long_recording_sixteen_pings_from_begin_to_end_are_scored():
    pings = [
        Snapshot(stamp_ns=k, range=[20.0, 21.0], iq=np.ones((2, 2), complex))
        for k in range(1, 101)
    ]
    used = Scored(BathymetryConfig(), pings).used
    assert len(used) == 16 and {1, 100} <= used
    assert Scored(BathymetryConfig(), pings[:16]).used == set(range(1, 17))


@pytest.mark.parametrize('model_set', MODEL_SETS)
def test_tuning_is_without_monte_carlo_noise_where_the_models_allow_it(model_set):
    config = for_tuning(BathymetryConfig(model_set=model_set))
    assert config.is_gaussian == (model_set in ('terrain', 'height_two_rw'))
    assert config.smoothing == 'none'
    BathymetryTracker(config)  # it can be run


@pytest.mark.parametrize('model_set', MODEL_SETS)
def test_the_noise_of_its_own_models_is_tuned(model_set):
    config = BathymetryConfig(model_set=model_set)
    names = {found.name for found in tunables(config, [])}
    noise = 'sigmas_deg' if model_set == 'angle_two_rw' else 'sigmas'
    assert names == (set() if config.is_terrain else {noise, 'stay_probability'})


def test_two_walks_are_scored_as_on_a_grid():
    """Noise of the walks and probability to stay, about what a patch of .5 m was made with."""
    T, cells = 160, np.arange(-3.0, 3.0, 0.01)
    ranges, patch = 20.0 + 0.05 * np.arange(T), np.zeros(T)
    patch[60:120] = 0.5 * np.random.default_rng(2).normal(size=60)
    made = floor(patch, ranges=ranges)
    ones, signal = np.ones(T), np.full(T, 10.0**2.5)
    snapshot = Snapshot(
        stamp_ns=1, range=ranges, iq=made.iq, noise_variance=ones, signal_variance=signal
    )
    logs = np.array([
        log_likelihood(
            array.direction_sine(15.0 - cells, r, math.radians(30.0)), y, s, 1.0, math.pi
        )
        for r, y, s in zip(ranges, snapshot.iq, signal)
    ])  # fmt: skip
    found, exact = [], []
    cases = [((0.01, rough), 0.995) for rough in (0.1, 0.3, 0.6, 1.2)]
    for sigmas, stay in [*cases, ((0.03, 0.6), 0.995), ((0.01, 0.6), 0.97)]:
        config = for_tuning(
            BathymetryConfig(
                model_set='height_two_rw', sigmas=sigmas, stay_probability=stay,
                gate_false_alarm=1.0, calibrate_array=False,
            )
        )  # fmt: skip
        scored = Scored(config, [snapshot])
        scored.process(snapshot)
        found.append(scored.scores[1][0])
        grid = filtered(
            cells, (0.0, 1.0), np.array(sigmas), persistent(2, stay), np.full(2, 0.5), logs
        )
        exact.append(grid.log_likelihood.sum())
    constant = T * log_constant(8, math.log1p(8.0 * signal[0]))
    off = np.array(found) - constant - exact
    assert np.abs(off[1:]).max() < 1.0 and np.argsort(found).tolist() == np.argsort(exact).tolist()
    assert exact[0] < exact[2] - 400.0 and abs(off[0]) < 60.0  # walks that cannot follow
