# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Labels that say when they cannot tell, and the bank whose bins scatter about a base."""

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor, VECTORS
import numpy as np
import pytest
from scipy.stats import norm

from sonar_imm.measurements import Snapshot
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.bathymetry import grid_kernels as kernels
from sonar_imm.trackers.bathymetry import scatter
from sonar_imm.trackers.bathymetry.ping import look, Ping, run, verdict
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

BANK = BathymetryConfig(model_set='scatter_bank', **EXACT)


def made(config, name='paper', seed=3, **changes):
    scene = simulate(scenario(name, changes), seed)
    tracker = BathymetryTracker(config)
    estimates = [tracker.process(item.measurement)[0] for item in scene.measurements]
    return estimates, scene.truth


# -- the filter and smoother ----------------------------------------------------------------------


def dense(seen, cells, motion):
    """Forward-backward with a matrix for every step: mean, variance (T,), probability (T, M)."""
    g, ping = motion.grid, seen.likelihood
    K, G, T = len(motion.kind), len(cells), len(ping.ranges)
    far = np.arange(G)[:, None] - np.arange(G)[None, :]
    walks = [
        [norm.pdf(far - motion.lean[j], scale=g.sigma[t, j]) for j in range(K)] for t in range(T)
    ]
    blur = [
        norm.pdf(far, scale=s) / norm.pdf(np.arange(-G, G), scale=s).sum() if s > 0 else np.eye(G)
        for s in motion.spread
    ]
    level = np.empty((T, G))
    for t in range(T):
        sines, work = np.empty(G), np.empty((4, G))
        kernels.state_log_likelihoods(cells, ping, t, sines, work, level[t])
    level = np.exp(level - level.max(axis=1, keepdims=True))
    base = np.stack([[blur[j] @ level[t] for j in range(K)] for t in range(T)])
    shape = seen.models.density(cells)
    p = seen.models.initial[:, None] * shape / shape.sum()
    predicted = np.empty((T, K, G))
    for t in range(T):
        mixed = g.transition.T @ p
        predicted[t] = [walks[t][j] @ mixed[j] for j in range(K)]
        p = predicted[t] * base[t]
        p /= p.sum()
    beta, means, variances, probabilities = np.ones((K, G)), [], [], []
    for t in range(T - 1, -1, -1):
        q = predicted[t] * beta
        of_height = np.stack([(blur[j] @ q[j]) * level[t] for j in range(K)])
        of_height /= of_height.sum()
        mean = (of_height * cells).sum()
        means.append(mean)
        variances.append((of_height * (cells - mean) ** 2).sum())
        kinds = np.bincount(motion.kind, of_height.sum(axis=1))
        probabilities.append(kinds)
        back = np.stack([walks[t][j].T @ (beta[j] * base[t, j]) for j in range(K)])
        beta = g.transition @ back
        beta /= beta.max()
    return np.array(means[::-1]), np.array(variances[::-1]), np.array(probabilities[::-1])


def test_the_smoother_is_that_of_dense_matrices():
    ranges = 20.0 + 0.05 * np.arange(12)
    height = np.concatenate([np.zeros(6), np.random.default_rng(4).normal(0.0, 0.3, 6)])
    snapshot = floor(height, ranges=ranges, snr_db=20.0)
    seen = look(Ping(evolve(BANK, initial_std=0.2, shadow_gate=False), snapshot, None))
    cells = 0.02 * np.arange(-75, 76)
    transition = np.array([[0.9, 0.06, 0.04], [0.1, 0.85, 0.05], [0.02, 0.08, 0.9]])
    sigma = np.tile([1.5, 2.0, 3.0], (12, 1))
    motion = kernels.ScatterMotion(
        kernels.GridMotion(cells, transition, sigma, 0, np.empty((0, 3))),
        np.array([0, 0, 1]),
        np.array([0.0, 0.0, 10.0]),
        np.array([0.0, 2.4, 0.0]),
    )
    seen = evolve(seen, models=evolve(seen.models, initial=np.array([0.5, 0.3, 0.2])))
    shape = seen.models.density(cells)
    p = seen.models.initial[:, None] * shape / shape.sum()
    track = kernels.Track(
        np.empty((12, 1)), np.empty((12, 1, 1)), np.empty((12, 2)), np.empty(12), np.empty(12)
    )
    window = np.empty((12, 2), np.int64)
    kept = kernels.filter_scatter(p, motion, seen.likelihood, window, track, True)
    kernels.smooth_scatter(kept, window, motion, seen.likelihood, track)
    mean, variance, probability = dense(seen, cells, motion)
    assert seen.likelihood.echo.all()
    assert track.mean[:, 0] == pytest.approx(mean, abs=1e-5)
    assert track.covariance[:, 0, 0] == pytest.approx(variance, rel=5e-4)
    assert track.probability == pytest.approx(probability, abs=1e-4)
    assert 0.02 < probability[:, 1].min() and probability[:, 1].max() > 0.5


def test_the_reference_ping():
    """A bank of six models as the vectors have it: rough within .1 in 95 % of the bins."""
    with np.load(VECTORS.parent / 'layover' / 'labels.npz') as archive:
        case = dict(archive)
    y = case['iq'].astype(np.float64)
    r = case['r']
    decibels = 30.0 - 20.0 * np.log(r / 17.0) / np.log(77.0 / 17.0)
    snapshot = Snapshot(
        stamp_ns=1,
        range=r,
        iq=(y[..., 0] + 1j * y[..., 1]).astype(np.complex64),
        noise_variance=np.ones(len(r)),
        signal_variance=10.0 ** (0.1 * decibels),
    )
    sigma = np.array([0.003, 0.03, 0.01, 0.01, 0.07, 0.5])
    weight = np.array([0.25, 0.25, 0.125, 0.125, 0.125, 0.125])
    transition = 0.002 * weight / (1.0 - weight)[:, None]
    np.fill_diagonal(transition, 0.998)
    bank = scatter.Scatter(
        np.array([0, 0, 1, 1, 1, 1]), np.array([0.0, 0.0, 0.2, 0.5, 0.0, 0.0]), np.zeros(6)
    )
    seen = look(Ping(BANK, snapshot, None))
    models = evolve(
        seen.models,
        names=('smooth', 'rough'),
        rough=np.array([False, True]),
        scale=np.tile(sigma, (len(r), 1)),
        transition=transition,
        initial=weight,
        coast=0,
        scatter=bank,
    )
    track = run(evolve(seen, models=models))
    assert np.mean(np.abs(track.probability[:, 1] - case['rough']) < 0.1) > 0.95
    std = seen.swath.snapshot_std(
        seen.swath.floor(np.zeros(len(r)), np.ones(len(r))).angle,
        seen.likelihood.signal / seen.likelihood.noise,
        8,
    )
    assert std == pytest.approx(case['sd_h'], rel=1e-6)


def test_the_chain_is_one_whatever_is_asked():
    for stay in (0.998, 0.98, 0.3):
        for sigmas, scatters in (((0.01, 0.05), (0.3, 0.0)), ((0.1,), (0.0,))):
            bank = scatter.bank_of(sigmas, scatters, stay)
            assert bank.transition.sum(axis=1) == pytest.approx(1.0)
            assert (bank.transition >= 0.0).all() and bank.initial.sum() == pytest.approx(1.0)
            assert bank.lean[bank.coast] == 0.0 and not bank.rough[bank.kind[bank.coast]]
    assert scatter.bank_of((0.01, 0.05), (0.3, 0.0), 0.998).names[2:] == ('scatter_1', 'rw_1')


# -- labels ---------------------------------------------------------------------------------------


def test_smooth_is_said_only_where_rough_would_be_seen():
    rough = np.array([0.0, 0.0, 0.0, 0.05, 0.5, 0.95, 0.95])
    detectable = np.array([0.1, 0.4, np.nan, 0.3, 0.1, 0.1, np.nan])
    assert verdict(rough, detectable, 0.3).tolist() == [0, 2, 2, 0, 2, 1, 1]
    assert verdict(rough, detectable, 0.5).tolist() == [0, 0, 2, 0, 2, 1, 1]


@pytest.mark.parametrize('model_set', ['height_two_rw', 'height_bank', 'scatter_bank'])
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
    estimates, truth = made(BANK, pings=3, seed=21, **changes)
    rough = np.concatenate([each.extras['rough'] > 0.5 for each in estimates])
    given = np.concatenate([each.extras['told'] for each in estimates])
    patch = np.concatenate([each.patch for each in truth])
    assert (rough & patch).sum() / (rough | patch).sum() > least
    assert (given[~patch] == 1).mean() < 0.03 and patch[given == 1].mean() > 0.9


def test_a_slope_is_smooth_floor_and_scatter_is_rough():
    rng = np.random.default_rng(2)
    ranges = 20.0 + 0.05 * np.arange(300)
    slope = 0.15 * (ranges - 20.0)
    (smooth,) = BathymetryTracker(BANK).process(floor(slope, ranges=ranges, snr_db=30.0))
    assert (smooth.extras['told'] == 0).mean() > 0.9
    stones = slope + rng.normal(0.0, 0.3, 300)
    (rough,) = BathymetryTracker(BANK).process(floor(stones, ranges=ranges, snr_db=30.0))
    assert (rough.extras['told'] == 1).mean() > 0.9
    error = rough.state[:, 0] - stones
    assert np.sqrt(np.mean(error**2)) < 0.1  # of the bins, not of the base
    held = np.abs(error) < 2.0 * np.sqrt(rough.covariance[:, 0, 0])
    assert held.mean() > 0.9


def test_bins_without_an_echo_cannot_be_told_and_the_ping_goes_on():
    snapshot = floor(0.0, shadow=slice(100, 160))
    (estimate,) = BathymetryTracker(BANK).process(snapshot)
    silent = estimate.extras['valid'] == 0
    assert silent[105:155].all() and (estimate.extras['told'][silent] == 2).all()
    assert np.isfinite(estimate.state).all() and (estimate.covariance[:, 0, 0] > 0.0).all()
    assert np.abs(estimate.state[170:, 0]).max() < 0.3
    inside, before = estimate.covariance[130, 0, 0], estimate.covariance[90, 0, 0]
    assert inside > before


def test_neighbours_lean_on_each_other_in_this_bank_too():
    config = evolve(BANK, ping_coupling=0.3)
    scene = simulate(scenario('paper', {'pings': 2, 'last_range': 45.0}), 3)
    tracker = BathymetryTracker(config)
    estimates = [e for item in scene.measurements for e in tracker.process(item.measurement)]
    estimates += tracker.finish()
    assert len(estimates) == 2
    assert estimates[0].probabilities.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize(
    'values, words',
    [
        ({'scatters': [0.2]}, 'a scatter for each'),
        ({'engine': 'particles'}, 'engine grid'),
        ({'smoothing': 'modes'}, 'smooths states'),
        ({'transition_matrix': [0.5] * 4}, 'chain of its own'),
        ({'model_set': 'height_bank', 'scatters': [0.2]}, 'scatter_bank only'),
    ],
)
def test_what_does_not_fit_is_refused(values, words):
    with pytest.raises(ConfigError, match=words):
        BathymetryConfig(**{'model_set': 'scatter_bank', **values})
