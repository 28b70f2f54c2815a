# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""exp of a row."""

import numpy as np

from sonar_imm.trackers.bathymetry.grid_kernels import exponentials, phasors


def row(values):
    values = np.array(values, float)
    out = np.empty_like(values)
    exponentials(values, np.empty_like(values), out)
    return out


def test_exponentials_are_those_of_the_library():
    values = np.concatenate([-np.logspace(-18, np.log10(699.0), 20_001), np.linspace(-2, 0, 9999)])
    exact = np.exp(values)
    assert (np.abs(row(values) - exact) <= 4e-16 * exact).all()
    assert row([0.0])[0] == 1.0


def test_what_is_impossible_is_zero():
    assert (row([-np.inf, np.nan, -701.0, -1e300]) == 0.0).all()


def test_a_row_gives_the_same_bits_however_it_is_cut():
    values = -np.random.default_rng(1).exponential(30.0, 101)
    whole = row(values)
    assert all(row([value])[0] == expected for value, expected in zip(values, whole))


def test_phasors_are_cosines_and_sines():
    values = np.concatenate([np.linspace(-60.0, 60.0, 4001), [np.nan]])
    cosine, sine = np.empty_like(values), np.empty_like(values)
    phasors(values, 0.7, cosine, sine)
    assert np.abs(cosine - np.cos(1.4 * np.pi * values))[:-1].max() < 1e-13
    assert np.abs(sine - np.sin(1.4 * np.pi * values))[:-1].max() < 1e-13
    assert np.isnan(cosine[-1]) and np.isnan(sine[-1])
