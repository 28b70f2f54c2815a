# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bathymetry tracker against exact answers computed independently."""

from attrs import evolve
from helpers.bathymetry_cases import vector
import numpy as np
import pytest

from sonar_imm.trackers.bathymetry.tracker import BathymetryTracker

SCALAR = ['set_ii_0', 'set_ii_1', 'set_iii_0', 'set_iii_1']


def errors(case, estimate, mean='m', variance='v', mu='mu'):
    """abs(dm) / sd and abs(dmu), each (T,)."""
    deviation = np.abs(estimate.state[:, 0] - case[mean]) / np.sqrt(case[variance])
    return deviation, np.abs(estimate.probabilities - case[mu]).max(axis=1)


def run(config, snapshot):
    return BathymetryTracker(config).process(snapshot)[0]


@pytest.mark.parametrize('name', [*SCALAR, 'set_i_corr_0', 'set_i_corr_1'])
def test_particles_are_the_exact_filter_within_monte_carlo_error(name):
    case, config, snapshot = vector(name)
    estimate = run(config, snapshot)
    deviation, dmu = errors(case, estimate)
    assert deviation.mean() <= 0.035
    assert dmu.mean() <= 0.006
    assert np.abs(estimate.covariance[:, 0, 0] / case['v'] - 1.0).mean() < 0.06
    if 'slope' in case:
        slope_sd = np.sqrt(estimate.covariance[:, 1, 1])
        assert (np.abs(estimate.state[:, 1] - case['slope']) / slope_sd).mean() < 0.06


@pytest.mark.parametrize('name', ['set_ii_0', 'set_iii_1'])
def test_error_falls_with_the_root_of_the_number_of_particles(name):
    case, config, snapshot = vector(name)
    few, many = (
        errors(case, run(evolve(config, particles_per_model=N), snapshot))[0].mean()
        for N in (300, 4800)
    )
    assert 2.8 < few / many < 5.7


@pytest.mark.parametrize('name', ['set_ii_0', 'set_ii_1'])
def test_gaussians_in_place_of_two_walks_are_near(name):
    """A walk of 1 cm next to one of half a metre: what mixes is no Gaussian."""
    case, config, snapshot = vector(name)
    estimate = run(evolve(config, engine='gaussian'), snapshot)
    deviation, dmu = errors(case, estimate)
    assert deviation.mean() < 0.2 and dmu.mean() < 0.015


@pytest.mark.parametrize('engine, tolerance', [('gaussian', 0.08), ('particles', 0.02)])
def test_log_likelihood_of_each_bin(engine, tolerance):
    """The reference leaves out what does not depend on the direction; so do differences."""
    case, config, snapshot = vector('set_ii_0')
    estimate = run(evolve(config, engine=engine), snapshot)
    constant = np.log(2.0) - 8.0 * np.log(np.pi) - np.log1p(8.0 * case['rho'])
    error = estimate.extras['log_likelihood'] - constant - case['lev']
    assert np.abs(error).mean() < tolerance
