# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Point masses: Kalman filter and smoother, the dense form, kernels on windows, exp of a row."""

import numpy as np
from oracles.grid import filter_densities, walk_matrix
import pytest

from sonar_imm.trackers.bathymetry import grid_kernels as grid
from sonar_imm.trackers.bathymetry.grid_kernels import exponentials, phasors

CELLS = np.arange(-400, 401) * 0.05
ASYMMETRIC = np.array([[0.95, 0.05], [0.3, 0.7]])


def normal(x, mean, std):
    return np.exp(-0.5 * np.square((x - mean) / std))


def start(weights, std=1.0):
    shape = normal(CELLS, 0.0, std)
    return np.array(weights)[:, None] * shape / shape.sum()


def measurements(rng, T=25, std=0.3):
    z = np.cumsum(rng.normal(size=T) * 0.2) + rng.normal(size=T) * std
    return z, -0.5 * np.square((z[:, None] - CELLS) / std)


@pytest.mark.parametrize('sigma', [0.0, 0.7, 3.0, 11.9, 12.0, 20.0, 75.5])
@pytest.mark.parametrize('low, high', [(0, 801), (395, 396), (380, 430), (3, 40), (780, 801)])
def test_the_walk_on_windows_is_the_walk_on_all_cells(sigma, low, high):
    p = np.zeros(801)
    p[low:high] = np.random.default_rng(3).random(high - low)
    exact = p @ walk_matrix(801, sigma)
    out, scratch = np.full(801, np.nan), np.full((7, 900), np.nan)
    out_low, out_high = 1, 797
    source = np.where((np.arange(801) >= low) & (np.arange(801) < high), p, np.nan)
    grid.walk(source, low, high, sigma, scratch, out, out_low, out_high)
    assert np.abs(out[out_low:out_high] - exact[out_low:out_high]).max() < 1e-4 * exact.max()
    assert np.isnan(out[:out_low]).all() and np.isnan(out[out_high:]).all()


@pytest.mark.parametrize('sigma', [150.0, 2000.0, 1e6, 1e15, 1e300, np.inf, np.nan])
@pytest.mark.parametrize('cells, low, high', [(21, 0, 21), (21, 5, 6), (400, 100, 110)])
def test_a_walk_wider_than_the_grid_stays_in_its_arrays(sigma, cells, low, high):
    p = np.zeros(cells)
    p[low:high] = np.random.default_rng(3).random(high - low)
    guarded, out = np.full((8, max(cells, 128) + 16), np.nan), np.empty(cells)
    grid.walk(p, low, high, sigma, guarded[:7], out, 0, cells)
    assert np.isnan(guarded[7]).all()
    assert grid.reach_of(sigma) > cells
    widest = min(sigma, grid.WIDEST) if sigma > 0.0 else grid.WIDEST
    exact = p.sum() / (np.sqrt(2.0 * np.pi) * widest)
    if sigma > 100 * cells:
        assert out == pytest.approx(exact, rel=1e-3)
    else:
        lag = np.abs(np.arange(cells)[:, None] - np.arange(cells))
        exact = p @ np.exp(-0.5 * np.square(lag / widest)) / (np.sqrt(2.0 * np.pi) * widest)
        assert np.abs(out - exact).max() < 1e-4 * exact.max()


def test_mix_weigh_and_summarise_are_the_dense_ones():
    rng = np.random.default_rng(4)
    z, log_likelihood = measurements(rng, T=1)
    p = start([0.8, 0.2])
    dense = filter_densities(p, ASYMMETRIC, np.array([[2.0, 9.0]]), log_likelihood)
    mixed, work, probability = np.empty_like(p), np.empty((2, 801)), np.empty(2)
    grid.mix(p, 0, 801, ASYMMETRIC, mixed)
    for j, sigma in enumerate((2.0, 9.0)):
        grid.walk(mixed[j], 0, 801, sigma, np.empty((7, 900)), p[j], 0, 801)
    log_sum = grid.weigh(p, 0, 801, log_likelihood[0].copy(), work)
    assert p == pytest.approx(dense.density[0], abs=1e-9)
    assert log_sum == pytest.approx(dense.log_likelihood[0], abs=1e-6)
    mean, variance = grid.summarise(p, 0, 801, CELLS, probability)
    assert probability == pytest.approx(dense.density[0].sum(axis=1))
    assert mean == pytest.approx(dense.density[0].sum(axis=0) @ CELLS)
    low, high = grid.trim(p, 0, 801)
    assert 0 < low < high < 801 and p[:, low:high].sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize('value', [-np.inf, np.nan])
def test_an_impossible_measurement_keeps_the_prediction(value):
    p = start([0.8, 0.2])
    before = p.copy()
    assert grid.weigh(p, 0, 801, np.full(801, value), np.empty((2, 801))) == -np.inf
    assert p == pytest.approx(before)


@pytest.mark.parametrize('sigma', [0.05, 0.3, 0.49])
def test_a_walk_narrower_than_a_cell_keeps_its_variance(sigma):
    W = walk_matrix(9, sigma)
    place = np.arange(9) - 4
    assert W[4] @ np.square(place) == pytest.approx(sigma**2) and W[4].sum() == pytest.approx(1.0)
    out, scratch = np.empty(9), np.empty((7, 144))
    grid.walk(np.eye(9)[4], 0, 9, sigma, scratch, out, 0, 9)
    assert out == pytest.approx(W[4], abs=1e-15)


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
