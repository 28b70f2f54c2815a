# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What tuning runs the bathymetry tracker with."""

import numpy as np
import pytest

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
def test_tuning_is_without_monte_carlo_noise_where_the_models_have_a_grid(model_set):
    config = for_tuning(BathymetryConfig(model_set=model_set))
    engines = {'height_rw_ncs': 'particles', 'terrain': 'auto'}  # both have two states
    assert config.engine == engines.get(model_set, 'grid')
    assert config.smoothing == 'none'
    BathymetryTracker(config)  # it can be run


@pytest.mark.parametrize('model_set', MODEL_SETS)
def test_the_noise_of_its_own_models_is_tuned(model_set):
    config = BathymetryConfig(model_set=model_set)
    names = {found.name for found in tunables(config, [])}
    noise = 'sigmas_deg' if model_set == 'angle_two_rw' else 'sigmas'
    assert names == (set() if config.is_terrain else {noise, 'stay_probability'})
