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

"""What once wrote outside of its arrays; NUMBA_BOUNDSCHECK=1 shows where."""

import math

from helpers.bathymetry_cases import floor
import numpy as np
import pytest

from sonar_imm.trackers.bathymetry.kernels import sines_of
from sonar_imm.trackers.bathymetry.likelihood import level_geometry
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker


def track(snapshot, **values):
    return BathymetryTracker(BathymetryConfig(**values)).process(snapshot)[0]


@pytest.mark.parametrize('smoothing', ['none', 'states'])
@pytest.mark.parametrize(
    'values',
    [
        {'sigmas': (0.03, 20.0), 'grid_extent': 0.1},
        {'sigmas': (0.03, 20.0), 'grid_extent': 0.1, 'sigma_reference_bin': 1e-300},
        {'sigmas': (0.0, 20.0), 'sigma_reference_bin': 1e-320},
        {'grid_step': 1e-320, 'grid_extent': 0.1},
    ],
)
def test_a_walk_wider_than_the_grid_is_no_harm(values, smoothing):
    snapshot = floor(0.0, ranges=20.0 + 0.05 * np.arange(30))
    table = track(snapshot, engine='grid', smoothing=smoothing, **values).columns()
    assert (np.abs(table['height']) <= 20.0).all()
    assert table['prob_rw_smooth'] + table['prob_rw_rough'] == pytest.approx(1.0)


def test_a_chain_that_never_switches_is_no_harm():
    """The probability of the wrong model falls below the smallest number with a reciprocal."""
    snapshot = floor(0.0, ranges=20.0 + 0.05 * np.arange(1500))
    table = track(snapshot, stay_probability=1.0, sigmas=(0.01, 5.0)).columns()
    probability = table['prob_rw_rough']
    assert ((probability > 0.0) & (probability < 1e-307)).any()
    assert np.sqrt(np.mean(np.square(table['height']))) < 0.1


def test_direction_sines_write_only_those_asked_for():
    state = np.linspace(-1.0, 1.0, 5)
    for of_heights in (True, False):
        geometry = level_geometry(
            np.full(3, 20.0), 15.0, math.asin(0.6), 0.5, of_heights=of_heights
        )
        work, out = np.zeros((2, 9)), np.full(9, -7.0)
        sines_of(state, 1, geometry, work, out[:5])
        assert (out[5:] == -7.0).all() and np.isfinite(out[:5]).all()
