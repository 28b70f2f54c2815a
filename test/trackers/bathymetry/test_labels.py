# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Labels that say when they cannot tell."""

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor, VECTORS
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.ping import look, Ping, verdict
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

TERRAIN = BathymetryConfig(**EXACT)


def made(config, name='paper', seed=3, **changes):
    scene = simulate(scenario(name, changes), seed)
    tracker = BathymetryTracker(config)
    estimates = [tracker.process(item.measurement)[0] for item in scene.measurements]
    return estimates, scene.truth


# -- labels ---------------------------------------------------------------------------------------


def test_smooth_is_said_only_where_rough_would_be_seen():
    rough = np.array([0.0, 0.0, 0.0, 0.05, 0.5, 0.95, 0.95])
    detectable = np.array([0.1, 0.4, np.nan, 0.3, 0.1, 0.1, np.nan])
    assert verdict(rough, rough, detectable, 0.3).tolist() == [0, 2, 2, 0, 2, 1, 1]
    assert verdict(rough, rough, detectable, 0.5).tolist() == [0, 0, 2, 0, 2, 1, 1]


def test_floor_that_may_be_either_is_neither():
    rough, either = np.array([0.0, 0.0, 0.95]), np.array([0.05, 0.95, 1.0])
    assert verdict(rough, either, np.full(3, 0.1), 0.3).tolist() == [0, 2, 1]


def test_the_error_of_one_snapshot_is_that_of_the_reference_ping():
    with np.load(VECTORS.parent / 'layover' / 'labels.npz') as archive:
        case = dict(archive)
    y = case['iq'].astype(np.float64)
    r = case['r']
    decibels = 30.0 - 20.0 * np.log(r / 17.0) / np.log(77.0 / 17.0)
    snapshot = Snapshot(
        stamp_ns=1, range=r, iq=(y[..., 0] + 1j * y[..., 1]).astype(np.complex64),
        noise_variance=np.ones(len(r)), signal_variance=10.0 ** (0.1 * decibels),
    )  # fmt: skip
    seen = look(Ping(TERRAIN, snapshot, None))
    std = seen.swath.snapshot_std(
        seen.swath.floor(np.zeros(len(r)), np.ones(len(r))).angle,
        seen.likelihood.signal / seen.likelihood.noise,
        8,
    )
    assert std == pytest.approx(case['sd_h'], rel=1e-6)
    (estimate,) = BathymetryTracker(TERRAIN).process(snapshot)
    there = estimate.extras['rough'] > 0.5
    assert (there == (case['rough'] > 0.5)).mean() > 0.97  # those of a bank of six models


@pytest.mark.parametrize('model_set', ['height_two_rw', 'terrain'])
def test_told_is_never_smooth_beyond_what_is_detectable(model_set):
    (estimate,), _ = made(BathymetryConfig(model_set=model_set), pings=1)
    table = estimate.columns()
    given, detectable, confidence = (
        table[name] for name in ('told', 'detectable_std', 'label_confidence')
    )
    assert given.dtype == np.uint8 and detectable.dtype == confidence.dtype == np.float32
    assert (detectable[given == 0] <= 0.3).all() and (confidence[given < 2] > 0.9).all()
    assert (given == 0).sum() > 200 and (given[table['range'] > 60.0] != 0).all()
    assert (given[table['valid'] == 0] == 2).all() and (table['valid'] == 0).any()
    assert detectable[table['range'] < 20.0].max() < 0.06
    assert detectable[table['range'] > 70.0].min() > 0.7


@pytest.mark.statistics
@pytest.mark.parametrize(
    'changes, least',
    [
        ({'patch_std': 0.3}, 0.7),
        ({'slope': 0.1}, 0.9),
        ({'undulation_height': 0.5, 'undulation_length': 15.0}, 0.6),
        ({'roughness_law': 'exponential', 'correlation_length': 1.0, 'patch_std': 0.3}, 0.5),
    ],
)
def test_roughness_is_found_on_slopes_and_undulations(changes, least):
    estimates, truth = made(TERRAIN, pings=3, seed=21, **changes)
    rough = np.concatenate([each.extras['rough'] > 0.5 for each in estimates])
    given = np.concatenate([each.extras['told'] for each in estimates])
    patch = np.concatenate([each.patch for each in truth])
    assert (rough & patch).sum() / (rough | patch).sum() > least
    assert (given[~patch] == 1).mean() < 0.03 and patch[given == 1].mean() > 0.9


def test_a_slope_is_smooth_floor_and_scatter_is_rough():
    rng = np.random.default_rng(2)
    ranges = 20.0 + 0.05 * np.arange(300)
    slope = 0.15 * (ranges - 20.0)
    (smooth,) = BathymetryTracker(TERRAIN).process(floor(slope, ranges=ranges, snr_db=30.0))
    assert (smooth.extras['told'] == 0).mean() > 0.9
    stones = slope + rng.normal(0.0, 0.3, 300)
    (rough,) = BathymetryTracker(TERRAIN).process(floor(stones, ranges=ranges, snr_db=30.0))
    assert (rough.extras['told'] == 1).mean() > 0.9
    error = rough.state[:, 0] - stones
    assert np.sqrt(np.mean(error**2)) < 0.1  # of the bins, not of the base
    held = np.abs(error) < 2.0 * np.sqrt(rough.covariance[:, 0, 0])
    assert held.mean() > 0.9


def test_neighbours_lean_on_each_other_in_terrain_too():
    config = evolve(TERRAIN, ping_coupling=0.3)
    scene = simulate(scenario('paper', {'pings': 2, 'last_range': 45.0}), 3)
    tracker = BathymetryTracker(config)
    estimates = [e for item in scene.measurements for e in tracker.process(item.measurement)]
    estimates += tracker.finish()
    assert len(estimates) == 2
    assert estimates[0].probabilities.sum(axis=1) == pytest.approx(1.0)


def told_of(height, ranges):
    (made,) = BathymetryTracker(TERRAIN).process(floor(height, ranges=ranges, snr_db=25.0))
    table = made.columns()
    return table['told'], table['rough'] + table['prob_winding'] > 0.5


def test_roughness_over_metres_and_short_waves_are_told_neither_smooth_nor_rough():
    """The slopes and bends of both are alike: only floor that bends less is smooth."""
    ranges = 20.0 + 0.05 * np.arange(600)
    wave, _ = told_of(np.sin(2.0 * np.pi * ranges / 13.0), ranges)
    swell, _ = told_of(0.7 * np.sin(2.0 * np.pi * ranges / 20.0), ranges)
    assert (wave == 2).mean() > 0.9 and (swell == 0).mean() > 0.9
    told, either = [], []
    for seed in range(8):
        stones = gaussian_filter1d(np.random.default_rng(seed).normal(size=600), 1.5 / 0.05)
        for found, each in zip((told, either), told_of(0.5 * stones / stones.std(), ranges)):
            found.append(each)
    assert (np.array(told) == 2).mean() > 0.9 and np.mean(either) > 0.75
