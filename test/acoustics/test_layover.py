# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two surfaces in a range bin: the residuals, what they say, and how often they are right."""

from itertools import product
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from benchmarks.layover_tables import levels, pooled, snapshots
from sonar_imm.acoustics import layover
from sonar_imm.acoustics.variances import mean_power, signal_variance

VECTORS = Path(__file__).parents[1] / 'vectors' / 'layover'


@pytest.fixture(scope='module')
def pings():
    with np.load(VECTORS / 'pings.npz') as archive:
        known = dict(archive)
    parts = known['iq'].astype(np.float32)
    known['iq'] = parts[..., 0] + 1j * parts[..., 1]
    return known


def found(iq, noise=1.0, spacing=0.5):
    noise = np.full(len(iq), noise)
    signal = signal_variance(mean_power(iq), noise)
    return layover.layover(iq, signal, noise, np.ones(len(iq), bool), spacing)


@pytest.mark.parametrize('staves', [2, 3, 4, 8])
def test_residuals_are_those_of_the_prototype_or_smaller(staves):
    with np.load(VECTORS / 'residuals.npz') as known:
        y, R, L = (known[f'{name}{staves}'] for name in 'yRL')
    power, single, two = layover.residuals(y, 0.5)
    assert power == pytest.approx(R[:, 0], rel=1e-6)
    assert single == pytest.approx(R[:, 1], abs=1e-3)
    assert (two - R[:, 2]).max() < 1e-3
    same = np.abs(two - R[:, 2]) < 1e-3  # elsewhere the prototype stayed on a lower maximum
    assert same.mean() > 0.85
    assert (2.0 * (np.sqrt(single) - np.sqrt(two)) - L)[same] == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize('staves, spacing', [(4, 0.5), (8, 0.5), (8, 0.3), (5, 3.66)])
def test_two_exact_waves_leave_nothing(staves, spacing):
    rng = np.random.default_rng(3)
    a, b = rng.uniform(-0.9, 0.9, (2, 200))
    p = 2.0 * math.pi * spacing * np.arange(staves)
    waves = np.exp(1j * a[:, None] * p) + 0.1 * np.exp(1j * (b[:, None] * p + 1.0))
    power, single, two = layover.residuals(waves, spacing)
    assert np.quantile(two / power, 0.95) < 1e-4
    # What is left beside one wave is at most all of the second.
    assert (single <= 0.01 * staves * 1.001).all()


def test_a_search_over_all_pairs_finds_hardly_more():
    y = snapshots(150, 8, 25.0, 2, np.random.default_rng(1))
    power, _, two = layover.residuals(y, 0.5)
    q = np.arange(8)[:, None]

    def left(phases, row):
        """What the waves of these phase steps leave of a row, by an orthonormal basis."""
        basis, _ = np.linalg.qr(np.exp(1j * q * phases))
        return float(np.square(np.abs(row)).sum() - np.square(np.abs(basis.conj().T @ row)).sum())

    grid = np.linspace(-math.pi, math.pi, 64, endpoint=False)
    pairs = np.array([(a, b) for a, b in product(grid, grid) if 0.05 < b - a < 6.2])
    bases = np.linalg.qr(np.exp(1j * q * pairs[:, None]))[0]
    explained = np.square(np.abs(np.einsum('kpi,np->nki', bases.conj(), y))).sum(axis=2)
    starts = pairs[np.argsort(explained, axis=1)[:, -4:]]
    best = [
        min(minimize(left, pair, row, 'Nelder-Mead').fun for pair in near)
        for row, near in zip(y, starts)
    ]
    assert (two - best > 0.05).mean() < 0.03


def test_silent_bins_and_scale():
    y = snapshots(40, 8, 20.0, 2, np.random.default_rng(1))
    y[7] = 0.0
    usual, loud = layover.residuals(y, 0.5), layover.residuals(1e6 * y, 0.5)
    for a, b in zip(usual, loud):
        assert a[7] == b[7] == 0.0
        assert 1e12 * a == pytest.approx(b, rel=1e-6, abs=1e-5 * 1e12)
    iq = snapshots(200, 8, 20.0, 1, np.random.default_rng(1))
    assert found(1e3 * iq, 1e6).existence == pytest.approx(found(iq).existence, abs=1e-6)


def test_the_table_is_normalised_so_that_its_mean_under_one_surface_is_one():
    for staves, fades in product((8, 4, 2), (False, True)):
        for decibels in (0.0, 5.0, 20.0, 30.0):
            rng = np.random.default_rng((9, staves, int(decibels)))
            L = levels(snapshots(6000, staves, decibels, 1, rng, fades))
            snr = np.full(6000, 10.0 ** (0.1 * decibels))
            ratio = np.exp(layover.log_ratio(L, snr, staves, float(fades)))
            # At high ratios rare bins say much: the mean of a sample is uncertain, and so is what
            # the sample says of its error.
            assert ratio.mean() == pytest.approx(1.0, abs=0.01 if decibels < 10.0 else 0.7)


@pytest.mark.parametrize('staves, least', [(2, 0.7), (4, 0.9), (8, 0.9), (32, 0.9)])
def test_a_ping_says_whether_its_noise_fades_with_the_echo_whatever_its_power(staves, least):
    usable = np.ones(1000, bool)
    for fades in (False, True):
        iq = snapshots(1000, staves, 15.0, 1, np.random.default_rng((4, staves)), fades)
        rest = layover.residuals(iq, 0.5)[1]
        share = layover.fading(rest, staves, usable)
        assert share > least if fades else share < 1.0 - least
        assert layover.fading(1e-6 * rest, staves, usable) == pytest.approx(share)
    assert layover.fading(rest, staves, np.arange(1000) < layover.FEWEST_BINS - 1) == 1.0


def test_steady_noise_lets_faint_second_surfaces_be_seen_and_fading_noise_costs_no_bins():
    flat = snapshots(1200, 8, 15.0, 1, np.random.default_rng(6), True)
    assert (found(flat).existence > layover.GATE).mean() < 0.002
    double = np.arange(1200) // 60 % 5 == 2
    seen = {}
    for fades in (False, True):
        iq = snapshots(1200, 8, 12.0, 1, np.random.default_rng(7), fades)
        two = snapshots(1200, 8, 12.0, 2, np.random.default_rng(8), fades)
        existence = found(np.where(double[:, None], two, iq)).existence
        seen[fades] = (existence > layover.GATE)[double].mean()
    assert seen[False] > seen[True] + 0.1


def test_pooling_keeps_the_mean_and_makes_an_increasing_ratio():
    two, single = np.array([0.2, 0.1, 0.3, 0.1, 0.3]), np.array([0.5, 0.1, 0.3, 0.1, 0.0])
    ratio = np.exp(pooled(two, single))
    assert (np.diff(ratio) >= -1e-12).all() and np.isfinite(ratio).all()
    assert (single * ratio).sum() == pytest.approx(1.0)


def test_other_numbers_of_staves_take_the_next_smaller_table():
    assert layover.table_of(9).value is not layover.table_of(8).value
    np.testing.assert_array_equal(layover.table_of(9).value, layover.table_of(8).value)
    assert (np.diff(layover.table_of(8).value, axis=2) >= -1e-6).all()
    assert layover.table_of(64).value.shape == layover.table_of(2).value.shape


def test_the_chain_is_forward_backward():
    evidence = np.random.default_rng(5).normal(0.0, 2.0, 12)
    b, e = layover.BIRTH, layover.END
    step = np.array([[1.0 - b, b], [e, 1.0 - e]])
    joint = {(): 1.0}
    for value in evidence:
        likelihood = 1.0, math.exp(value)
        joint = {
            (*path, j): weight
            * (step[path[-1], j] if path else (e, b)[j] / (b + e))
            * likelihood[j]
            for path, weight in joint.items()
            for j in (0, 1)
        }
    total = sum(joint.values())
    expected = [
        sum(weight for path, weight in joint.items() if path[t]) / total
        for t in range(len(evidence))
    ]
    assert layover.existence(evidence) == pytest.approx(expected, abs=1e-12)


def test_existence_of_the_prototype(pings):
    for iq, chain in zip(pings['iq'], pings['existence_chain']):
        assert (np.abs(found(iq).existence - chain) < 0.1).mean() >= 0.98


def test_objects_are_caught_and_a_flat_floor_is_kept(pings):
    caught = single = lost = seen = 0
    for iq, power, h, kind in zip(pings['iq'], pings['power'], pings['h'], pings['kind']):
        gated = found(iq).existence > layover.GATE
        order = np.sort(power, axis=1)[:, ::-1]
        there = power > 0.0
        highest = np.where(there, h, -np.inf).max(axis=1)
        apart = highest - np.where(there, h, np.inf).min(axis=1) > 0.5
        two = (order[:, 1] >= 1.0) & (order[:, 1] > order[:, 0] * 10**-1.5) & apart
        if kind == 'flat':
            assert not gated.any()
            continue
        caught, seen = caught + (gated & two).sum(), seen + two.sum()
        alone = (order[:, 1] == 0.0) & (order[:, 0] > 0.0)
        lost, single = lost + (gated & alone).sum(), single + alone.sum()
    assert caught / seen > 0.85
    assert lost / single < 0.005


@pytest.mark.parametrize('share, least', [(0.0, layover.LEAST_ERROR), (0.005, 0.005)])
def test_the_error_of_the_array_is_measured(share, least):
    rng = np.random.default_rng(2)
    n, P = 1200, 8
    sine = np.linspace(0.5, -0.3, n)[:, None]
    wave = np.exp(1j * math.pi * sine * np.arange(P)) * circular(rng, n, 1)
    own = circular(rng, n, P)
    echo = np.sqrt(1.0 - share) * wave + math.sqrt(share) * own
    iq = 10.0 * np.sqrt(10.0 * rng.exponential(size=(n, 1))) * echo + circular(rng, n, P)
    answer = found(iq)
    assert least <= answer.array_error < 3.0 * max(least, 0.007)
    assert (answer.existence > layover.GATE).mean() < 0.01


def circular(rng, *shape):
    return rng.normal(size=(*shape, 2)).view(np.complex128)[..., 0] * math.sqrt(0.5)


def test_of_staves_close_to_each_other_only_directions_that_are_there_are_fitted():
    rng = np.random.default_rng(6)
    iq = np.exp(1j * np.outer(rng.uniform(1.7, np.pi, 20), np.arange(8)))  # beyond end fire
    iq += 0.1 * rng.normal(size=(20, 8))
    power, single, _ = layover.residuals(iq, 0.25)
    phase = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 4001)
    beams = np.abs(iq @ np.exp(-1j * np.outer(np.arange(8), phase))) ** 2 / 8.0
    np.testing.assert_allclose(single, power - beams.max(axis=1), rtol=1e-4)
