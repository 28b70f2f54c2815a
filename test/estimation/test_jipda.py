# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Joint integrated probabilistic data association against an independent prototype, brute force
and closed forms."""

from itertools import product
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from oracles import jipda as oracle
import pytest

from sonar_imm.estimation import bank, jipda, marginals
from sonar_imm.estimation.bank import Gaussians

VECTORS = np.load(
    Path(__file__).parents[1] / 'vectors' / 'diver_sea' / 'association.npz', allow_pickle=False
)
CLUTTER = Path(__file__).parents[1] / 'vectors' / 'obstacle_in_clutter' / 'joint_events.npz'
CASES = ('jipda_2x2', 'jipda_3x3', 'jipda_1x2', 'jipda_2x0')
FORMS = (oracle.associate, jipda.associate)


def brute_force(ratio, existence, pd):
    """beta, existence by enumeration of everything: who exists, who takes which detection."""
    T, D = ratio.shape
    beta, exists, total = np.zeros((T, D)), np.zeros(T), 0.0
    for there in product((False, True), repeat=T):
        for taken in product(range(-1, D), repeat=T):
            used = [d for d in taken if d >= 0]
            if len(set(used)) < len(used) or any(
                d >= 0 and not alive for d, alive in zip(taken, there)
            ):
                continue
            weight = 1.0
            for t, (d, alive) in enumerate(zip(taken, there)):
                weight *= existence[t] if alive else 1.0 - existence[t]
                if alive:
                    weight *= 1.0 - pd[t] if d < 0 else pd[t] * ratio[t, d]
            total += weight
            for t, (d, alive) in enumerate(zip(taken, there)):
                exists[t] += weight * alive
                if d >= 0:
                    beta[t, d] += weight
    return beta / total, exists / total


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize('form', FORMS)
def test_the_sums_over_events_are_those_of_the_prototype(case, form):
    ratio, existence, pd = (VECTORS[f'{case}/{name}'] for name in ('ratio', 'existence', 'pd'))
    beta, missed, after = form(ratio, ratio > 0.0, existence, pd)
    np.testing.assert_allclose(beta, VECTORS[f'{case}/out_beta'], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(missed, VECTORS[f'{case}/out_missed_exists'], rtol=1e-10)
    np.testing.assert_allclose(after, VECTORS[f'{case}/out_existence'], rtol=1e-10)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_both_forms_agree_with_brute_force_over_existence_and_pairings(seed):
    rng = np.random.default_rng(seed)
    T, D = rng.integers(1, 4), rng.integers(0, 4)
    ratio = rng.gamma(1.0, 4.0, (T, D)) * (rng.uniform(size=(T, D)) < 0.7)
    existence, pd = rng.uniform(0.01, 0.999, T), rng.uniform(0.1, 0.99, T)
    beta, exists = brute_force(ratio, existence, pd)
    for form in FORMS:
        ours = form(ratio, ratio > 0.0, existence, pd)
        np.testing.assert_allclose(ours[0], beta, rtol=1e-9, atol=1e-14)
        np.testing.assert_allclose(ours[2], exists, rtol=1e-9)


def test_one_track_in_a_scan_with_nothing_is_the_bayes_rule_of_a_miss():
    none = np.empty((1, 0))
    _, _, after = jipda.associate(none, none > 0.0, np.array([0.5]), np.array([0.7]))
    np.testing.assert_allclose(after, 0.5 * 0.3 / (0.5 * 0.3 + 0.5))


def problem(seed, T=3, D=4, M=3, n=3, m=2):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(T, M, n, n))
    P = root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(n)
    noise = rng.normal(size=(D, m, m))
    R = noise @ np.swapaxes(noise, -1, -2) + 0.1 * np.eye(m)
    return rng.normal(size=(T, M, n)), P, rng.dirichlet(np.ones(M), T), rng.normal(size=(D, m)), R


def updated(x, P, c, z, R, beta, missed):
    """x, P and mu of tracks by the detections that are theirs with `beta` (T, D), by the bank."""
    block = Gaussians(np.moveaxis(x, 1, -1), np.moveaxis(P, 1, -1))
    row, d = (each.ravel() for each in np.indices(beta.shape))
    pairs = bank.weigh(block, row, z[d], R[d])
    density = np.exp(pairs.log)
    f = (c[row] * density).sum(axis=1, keepdims=True)
    after, weight = bank.update(block, pairs, row, beta.ravel()[:, None] * density / f, missed)
    return np.moveaxis(after.x, -1, 1), np.moveaxis(after.P, -1, 1), c * weight, density


def test_the_update_is_that_of_the_prototype():
    names = ('X', 'P', 'mu', 'Z', 'R', 'beta', 'beta0', 'H')
    X, P, mu, Z, R, beta, beta0, H = (VECTORS[f'imm_pda/{name}'] for name in names)
    many = np.tile(R, (len(Z), 1, 1))
    innovation, H = Z[:, None] - X @ H.T, np.tile(H, (3, 1, 1))
    plain = oracle.update(X, P, mu, innovation, H, many, beta, float(beta0))
    ours = updated(X[None], P[None], mu[None], Z, many, beta[None], np.reshape(beta0, 1))
    for found, single, name in zip(ours, plain, ('out_X', 'out_P', 'out_mu')):
        np.testing.assert_allclose(single, VECTORS[f'imm_pda/{name}'], rtol=1e-10)
        np.testing.assert_allclose(found[0], VECTORS[f'imm_pda/{name}'], rtol=1e-10)


@pytest.mark.parametrize('seed', range(5))
def test_a_scan_is_the_plain_one(seed):
    """Densities, sums over events and update of three tracks, in numpy and by their definition."""
    x, P, c, z, R = problem(seed)
    H = np.broadcast_to(np.eye(2, 3), (1, 3, 2, 3))
    density = oracle.densities(x[..., :2], H, P, z, R)
    ratio = np.einsum('tj,tdj->td', c, density) / 1e-3
    part = np.full(ratio.shape, True), np.full(3, 0.7), np.full(3, 0.9)
    beta, missed, after = jipda.associate(ratio, *part)
    beta, missed = beta / after[:, None], missed / after
    *found, log = updated(x, P, c, z, R, beta, missed)
    np.testing.assert_allclose(log, density.reshape(log.shape), rtol=1e-10)
    for ours, due in zip((beta, missed), oracle.associate(ratio, *part)[:2]):
        np.testing.assert_allclose(ours.T * after, due.T, rtol=1e-10)
    for t in range(3):
        single = oracle.update(
            x[t], P[t], c[t], z[:, None] - x[t, :, :2], H[0], R, beta[t], float(missed[t])
        )
        for ours, other in zip(found, single):
            np.testing.assert_allclose(ours[t], other, rtol=1e-9, atol=1e-12)


def test_the_nearest_older_track():
    rng = np.random.default_rng(4)
    T = 7
    mean = rng.normal(size=(T, 2))
    root = rng.normal(size=(T, 2, 2))
    covariance = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(2)
    ids, free, firm = rng.permutation(T), rng.uniform(size=T) < 0.8, rng.uniform(size=T) < 0.5
    partner, distance = jipda.nearest_older(mean, covariance, ids, free, firm)
    for t in range(T):
        best = (np.inf, -1)
        for u in range(T):
            if free[t] and free[u] and ids[u] < ids[t] and (firm[u] or not firm[t]):
                gap = mean[t] - mean[u]
                now = gap @ np.linalg.solve(covariance[t] + covariance[u], gap)
                best = min(best, (now, u))
        assert partner[t] == best[1]
        assert distance[t] == pytest.approx(best[0])


def test_log_odds():
    found = jipda.log_odds(np.array([0.0, 0.2, 0.9, 1.0]))
    assert found[0] == -np.inf and np.isfinite(found[3])
    np.testing.assert_allclose(found[1:3], np.log([0.25, 9.0]))


def test_existence_by_class_of_detectability_against_enumeration(monkeypatch):
    with np.load(CLUTTER) as v:
        cases = [
            {key.split('/')[1]: v[key] for key in v if key.startswith(f'{k:02d}/')}
            for k in range(int(v['count']))
        ]
        probability = v['detection_probability']
    for largest, answer in ((marginals.LARGEST, 'beta'), (0, 'beta_bp')):
        monkeypatch.setattr(marginals, 'LARGEST', largest)
        for case in cases:
            T = len(case['q'])
            beta, none, after = jipda.associate_classes(
                case['ratio'], np.ones(case['ratio'].shape, bool), case['q'],
                np.tile(probability, (T, 1)), case['visible'][:, None],
            )  # fmt: skip
            np.testing.assert_allclose(beta, case[answer], atol=1e-9)
            if largest:
                np.testing.assert_allclose(none, case['missed'], atol=1e-9)
                np.testing.assert_allclose(after, case['q_after'], atol=1e-9)
