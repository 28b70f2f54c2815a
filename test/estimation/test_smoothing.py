# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The smoothers against joint Gaussians, hidden Markov chains, and the enumeration of every
sequence of models."""

import itertools

import numpy as np
import pytest

from sonar_imm.estimation import imm, kalman, smoothing
from sonar_imm.estimation.smoothing import imm_smooth, IMMPredicted, smooth_modes


def covariance(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1] + 1))
    return root @ np.swapaxes(root, -1, -2)


def chain(rng, models, stay=2.0):
    """An asymmetric transition matrix."""
    P = rng.dirichlet(np.ones(models), size=models) + np.diag(rng.uniform(0.2, stay, models))
    return P / P.sum(axis=1, keepdims=True)


def repeat(array, steps):
    return np.broadcast_to(array, (steps, *array.shape))


def kalman_pass(F, Q, B, H, R, x, P, Z):
    xs, Ps = [], []
    for k, z in enumerate(Z):
        if k:
            x, P, _ = kalman.predict(x, P, F[k], Q[k], B[k])
        x, P = kalman.update(x, P, z - kalman.apply(H, x), H, R)[:2]
        xs.append(x)
        Ps.append(P)
    return np.array(xs), np.array(Ps)


def imm_pass(transition, F, Q, B, H, R, x, P, mu, Z, moves_first=False):
    """Forward pass of one target; transition, F, Q and B (K, ...) are those into each step;
    moves_first: whether there is a move into the first step."""
    x, P, mu, steps = x[None], P[None], mu[None], []
    H = np.broadcast_to(H, (x.shape[1], *H.shape))
    for k, z in enumerate(Z):
        if k or moves_first:
            mixed = imm.mix(x, P, mu, transition[k][None])
            (x, P, _), mu = imm.predict(mixed.x, mixed.P, F[k], Q[k], B[k]), mixed.c
        updated = imm.update(x, P, mu, z - np.einsum('jmn,tjn->tjm', H, x), H[None], R[None])
        x, P, mu = updated.x, updated.P, updated.mu
        steps.append((x[0], P[0], mu[0]))
    return tuple(np.array(part) for part in zip(*steps))


def rts_smooth(x, P, F, Q, B):
    """The Rauch-Tung-Striebel smoother of a forward pass x (K, ..., n), P of one model."""
    x, P = x.copy(), P.copy()
    for k in range(len(x) - 2, -1, -1):
        F1 = F[k + 1]
        S = F1 @ P[k] @ np.swapaxes(F1, -1, -2) + Q[k + 1]
        gain = P[k] @ np.swapaxes(F1, -1, -2) @ np.linalg.pinv(S, hermitian=True)
        x[k] += kalman.apply(gain, x[k + 1] - kalman.apply(F1, x[k]) - B[k + 1])
        P[k] += gain @ (P[k + 1] - S) @ np.swapaxes(gain, -1, -2)
    return x, P


def joint_by_covariance(F, Q, B, H, R, x0, P0, Z):
    """All states at once: the joint covariance, which may be singular, conditioned on all data."""
    K, n = len(Z), len(x0)
    mean, C = np.zeros((K, n)), np.zeros((K, n, K, n))
    mean[0], C[0, :, 0] = x0, P0
    for k in range(1, K):
        mean[k] = F[k] @ mean[k - 1] + B[k]
        C[k, :, :k] = np.einsum('ab,bkc->akc', F[k], C[k - 1, :, :k])
        C[:k, :, k] = C[k, :, :k].transpose(1, 2, 0)
        C[k, :, k] = F[k] @ C[k - 1, :, k - 1] @ F[k].T + Q[k]
    C, big_H = C.reshape(K * n, K * n), np.kron(np.eye(K), H)
    gain = np.linalg.solve(big_H @ C @ big_H.T + np.kron(np.eye(K), R), big_H @ C).T
    after = C - gain @ big_H @ C
    x = mean.ravel() + gain @ (Z.ravel() - big_H @ mean.ravel())
    return x.reshape(K, n), np.einsum('kakb->kab', after.reshape(K, n, K, n))


@pytest.mark.parametrize('models, moves_at_all', [(1, True), (3, False)])
def test_models_that_are_all_the_same_give_the_joint_gaussian_and_the_chain(models, moves_at_all):
    """The data say nothing about the model: smoothed probabilities are those of the chain. The
    second number may be known exactly after each step: F P F' + Q is singular."""
    rng = np.random.default_rng(3)
    K, H, R = 9, np.array([[1.0, 0.0]]), np.eye(1)
    F, Q, B = rng.normal(size=(K, 2, 2)), covariance(rng, K, 2), rng.normal(size=(K, 2))
    Z, mu0 = rng.normal(size=(K, 1)), rng.dirichlet(np.ones(models))
    if not moves_at_all:
        F[:, 1] = Q[:, 1] = Q[:, :, 1] = 0.0
    transition = np.stack([chain(rng, models) for _ in range(K)])
    moves = [transition, *(np.repeat(part[:, None], models, axis=1) for part in (F, Q, B))]
    x0, P0 = np.zeros((models, 2)), repeat(np.eye(2), models)
    smoothed = imm_smooth(*imm_pass(*moves, H, R, x0, P0, mu0, Z), *moves)
    known = F, Q, B, H, R, x0[0], P0[0], Z
    due, mu = joint_by_covariance(*known), [mu0]
    for k in range(1, K):
        mu.append(mu[-1] @ transition[k])
    np.testing.assert_allclose(smoothed.mu, mu, atol=1e-9)
    alone = rts_smooth(*kalman_pass(*known), F, Q, B)
    each = [(smoothed.x[:, model], smoothed.P[:, model]) for model in range(models)]
    for found in (alone, *each, smoothed.combine(repeat(np.eye(2), models))):
        for part, right in zip(found, due):
            np.testing.assert_allclose(part, right, atol=1e-9)


def test_states_drawn_anew_give_the_forward_backward_algorithm():
    """With F = 0 the models are a hidden Markov chain: filter and smoother are both exact."""
    rng = np.random.default_rng(4)
    K, M = 12, 3
    F, Q, B = np.zeros((K, M, 2, 2)), covariance(rng, K, M, 2), 1.5 * rng.normal(size=(K, M, 2))
    H, R, Z = np.array([[1.0, 0.5]]), np.eye(1) * 0.3, rng.normal(size=(K, 1)) * 2
    mu0, transition = rng.dirichlet(np.ones(M)), np.stack([chain(rng, M) for _ in range(K)])
    filtered = imm_pass(transition, F, Q, B, H, R, B[0], Q[0], mu0, Z)
    smoothed = imm_smooth(*filtered, transition, F, Q, B)
    S = H @ Q @ H.T + R
    emission = np.exp(kalman.log_density(Z[:, None] - B @ H.T, np.sqrt(S))[1])
    forward, backward = np.empty((K, M)), np.ones((K, M))
    forward[0] = mu0 * emission[0]
    for k in range(1, K):
        forward[k] = (forward[k - 1] @ transition[k]) * emission[k]
    for k in range(K - 2, -1, -1):
        backward[k] = transition[k + 1] @ (emission[k + 1] * backward[k + 1])
    expected = forward * backward / (forward * backward).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(smoothed.mu, expected, atol=1e-10)
    np.testing.assert_allclose(smoothed.x, filtered[0], atol=1e-10)
    np.testing.assert_allclose(smoothed.P, filtered[1], atol=1e-10)


def test_a_model_nothing_leads_to_stays_finite():
    K, M = 5, 3
    transition = np.array([[0.7, 0.3, 0.0], [0.4, 0.6, 0.0], [0.0, 1.0, 0.0]])
    F, B = repeat(np.eye(2), M), np.zeros((M, 2))
    Q = np.stack([np.eye(2), 2 * np.eye(2), np.eye(2)])
    moves = [repeat(part, K) for part in (transition, F, Q, B)]
    x0, P0, mu0 = np.zeros((M, 2)), repeat(np.eye(2), M), np.array([0.5, 0.5, 0.0])
    Z = np.random.default_rng(0).normal(size=(K, 2))
    filtered = imm_pass(*moves, np.eye(2), np.eye(2), x0, P0, mu0, Z)
    smoothed = imm_smooth(*filtered, *moves)
    assert all(np.isfinite(part).all() for part in smoothed)
    np.testing.assert_allclose(smoothed.mu.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(smoothed.mu[:, 2], 0.0)


def test_nothing_to_smooth():
    for K in (0, 1):
        x, P, mu = np.ones((K, 2, 3)), repeat(repeat(np.eye(3), 2), K), np.full((K, 2), 0.5)
        smoothed = imm_smooth(x, P, mu, np.ones((K, 2, 2)) / 2, P, P)
        np.testing.assert_array_equal(smoothed.x, x)
        np.testing.assert_array_equal(smoothed.mu, mu)
    # A forward pass that contradicts itself is refused.
    x, P = np.zeros((2, 2, 1)), np.ones((2, 2, 1, 1))
    mu, transition = np.array([[1.0, 0.0], [0.0, 1.0]]), repeat(np.eye(2), 2)
    with pytest.raises(ValueError, match='no probable model leads'):
        imm_smooth(x, P, mu, transition, P, P)


# -- IMM: short sequences, every sequence of models enumerated ------------------------------------


def enumerate_sequences(F, Q, B, H, R, x, P, mu, transition, Z):
    """Exact smoothed mean, covariance and model probabilities."""
    K, M = len(Z), len(mu)
    sequences = np.array(list(itertools.product(range(M), repeat=K)))
    log_weight, x, P = (part[sequences[:, 0]] for part in (np.log(mu), x, P))
    xs, Ps = [], []
    for k in range(K):
        now = sequences[:, k]
        if k:
            log_weight = log_weight + np.log(transition[sequences[:, k - 1], now])
            x, P, _ = kalman.predict(x, P, F[now], Q[now], B[now])
        updated = kalman.update(x, P, Z[k] - x @ H.T, H, R)
        x, P, log_weight = updated.x, updated.P, log_weight + updated.log_likelihood
        xs.append(x)
        Ps.append(P)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    steps = sequences.T
    sx, sP = rts_smooth(np.array(xs), np.array(Ps), F[steps], Q[steps], B[steps])
    mean = np.einsum('s,ksa->ka', weight, sx)
    off = sx - mean[:, None]
    C = np.einsum('s,ksab->kab', weight, sP + off[..., :, None] * off[..., None, :])
    return mean, C, np.stack([weight @ (sequences == i) for i in range(M)], axis=1)


def draw(rng, F, Q, B, H, R, x0, P0, mu, transition, K):
    """Measurements (K, m) of the jumping system."""
    model = rng.choice(len(mu), p=mu)
    x, Z = rng.multivariate_normal(x0[model], P0[model]), []
    for k in range(K):
        if k:
            model = rng.choice(len(mu), p=transition[model])
            x = rng.multivariate_normal(F[model] @ x + B[model], Q[model])
        Z.append(rng.multivariate_normal(H @ x, R))
    return np.array(Z)


def random_models(rng, M):
    F = np.stack([[[1.0, 1.0], [0.0, rng.uniform(0, 1)]] for _ in range(M)])
    Q, B = 0.1 * covariance(rng, M, 2), rng.normal(size=(M, 2))
    return F, Q, B, np.array([[1.0, 0.0]]), 0.5 * np.eye(1)


def headings(rng, M):
    """Fixed speed along M headings, no memory: F has rows of zeros, Q has rank two of four."""
    angle = 2 * np.pi * np.arange(M) / M
    u, G = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.vstack([np.eye(2), np.eye(2)])
    F, Q = repeat(np.diag([1.0, 1.0, 0.0, 0.0]), M), repeat(0.19**2 * G @ G.T, M)
    return F, Q, np.hstack([u, u]), np.eye(2, 4), np.eye(2)


def quiet_and_agile(rng, M):
    G, F = np.array([0.5, 1.0]), repeat(np.array([[1.0, 1.0], [0.0, 1.0]]), M)
    Q = np.geomspace(0.01, 2.0, M)[:, None, None] * np.outer(G, G)
    return F, Q, np.zeros((M, 2)), np.array([[1.0, 0.0]]), 0.3 * np.eye(1)


def enumerated(models, M, K, seed):
    """Moves of a random scene, its forward pass, and what `enumerate_sequences` says of it."""
    rng, moves, (F, Q, B, H, R, x0, P0, mu), transition = random_scene(models, M, K, seed)
    Z = draw(rng, F, Q, B, H, R, x0, P0, mu, transition, K)
    exact = enumerate_sequences(F, Q, B, H, R, x0, P0, mu, transition, Z)
    return moves, imm_pass(*moves, H, R, x0, P0, mu, Z), exact


def random_scene(models, M, K, seed):
    """A generator of random numbers, the moves of a scene, its parts, and the chain."""
    rng = np.random.default_rng(seed)
    F, Q, B, H, R = models(rng, M)
    n = F.shape[-1]
    mu, transition = rng.dirichlet(3 * np.ones(M)), chain(rng, M)
    moves = [repeat(part, K) for part in (transition, F, Q, B)]
    start = np.zeros((M, n)), repeat(np.eye(n), M), mu
    return rng, moves, (F, Q, B, H, R, *start), transition


def distances(states, exact):
    """From what is exact, step by step: of probabilities, of the mean in sigmas, of variance."""
    mean, C, probability = exact
    x, P = imm.combine(*states, repeat(np.eye(mean.shape[-1]), probability.shape[-1]))
    squared = np.einsum('ka,kab,kb->k', x - mean, np.linalg.pinv(C), x - mean)
    spread = np.trace(P, axis1=1, axis2=2) / np.trace(C, axis1=1, axis2=2) - 1.0
    of_models = np.abs(states[2] - probability).mean(axis=1)
    return np.stack([of_models, np.sqrt(squared), np.abs(spread)])[:, :-1]


@pytest.mark.parametrize(
    'models, M, K, mean_errors, worst_errors',
    [
        (random_models, 3, 5, (0.0012, 0.005, 0.003), (0.035, 0.025)),
        (headings, 4, 4, (0.0005, 0.003, 0.002), (0.010, 0.010)),
        (quiet_and_agile, 2, 9, (0.003, 0.008, 0.015), (0.05, 0.12)),
    ],
)
def test_close_to_the_enumeration_of_all_sequences(models, M, K, mean_errors, worst_errors):
    """Mean and worst errors of twelve scenes; the filter is twenty times as far off, or more."""
    smoothed, filtered = [], []
    for seed in range(12):
        moves, states, exact = enumerated(models, M, K, seed)
        smoothed.append(distances(imm_smooth(*states, *moves)[:3], exact))
        filtered.append(distances(states, exact))
    mean = np.mean(smoothed, axis=(0, 2))
    assert (mean < mean_errors).all()
    assert (np.max(smoothed, axis=(0, 2))[1:] < worst_errors).all()
    assert (np.mean(filtered, axis=(0, 2)) > 20.0 * mean).all()


def test_more_gaussians_end_at_the_exact_answer(monkeypatch):
    """With 64 per model hardly any two of the 512 sequences are merged."""
    moves, states, exact = enumerated(quiet_and_agile, 2, 9, 2)
    errors = []
    for halvings in (1, 2, 6):
        monkeypatch.setattr(smoothing, 'HALVINGS', halvings)
        monkeypatch.setattr(smoothing, 'GAUSSIANS', 2**halvings)
        errors.append(distances(imm_smooth(*states, *moves)[:3], exact).max(axis=1))
    assert (errors[0] > 2.0 * errors[1]).all() and (errors[1] > 10.0 * errors[2]).all()


def test_the_prediction_is_that_of_an_imm_filter_unless_it_is_given():
    K, M = 6, 3
    rng, moves, (F, Q, B, *known), transition = random_scene(random_models, M, K, 6)
    filtered = imm_pass(*moves, *known, rng.normal(size=(K, 1)))
    parts = [[np.zeros((M, 2))], [np.zeros((M, 2, 2))], [np.zeros(M)]]
    for x, P, mu in zip(*(part[:-1] for part in filtered)):
        mixed = imm.mix(x[None], P[None], mu[None], transition[None])
        x, P, _ = imm.predict(mixed.x, mixed.P, F, Q, B)
        for part, value in zip(parts, (x, P, mixed.c)):
            part.append(value[0])
    given = imm_smooth(*filtered, *moves, IMMPredicted(*map(np.array, parts)))
    for one, other in zip(given, imm_smooth(*filtered, *moves)):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_after_a_step_that_no_measurement_explains_the_filtered_states_count():
    """An update that widens: it and what follows are smoothed as if the pass began there."""
    K, M = 5, 3
    rng, moves, (_, _, _, H, R, *start), _ = random_scene(quiet_and_agile, M, K, 7)
    Z = rng.normal(size=(K, 1))
    before = imm_pass(*moves, H, R, *start, Z[:3])
    before[1][2] *= 30.0
    begin = [part[2] for part in before]
    after = imm_pass(*moves, H, R, *begin, Z[3:], moves_first=True)
    wide = [np.concatenate(parts) for parts in zip(before, after)]
    whole = imm_smooth(*wide, *moves)
    end = imm_smooth(*(part[2:] for part in wide), *(part[2:] for part in moves))
    for one, other in zip(whole, end):
        np.testing.assert_allclose(one[2:], other, atol=1e-9)


# -- Kim's pass over model probabilities ----------------------------------------------------------


P = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])


def filtered(likelihood, mu):
    out = []
    for row in likelihood:
        mu = (mu @ P) * row
        mu = mu / mu.sum()
        out.append(mu)
    return np.array(out)


def test_a_hidden_markov_chain_is_smoothed_exactly():
    rng = np.random.default_rng(1)
    likelihood, mu0 = rng.random((6, 3)), np.array([0.2, 0.5, 0.3])
    paths = np.array(list(np.ndindex(*(3,) * 7)))
    weight = mu0[paths[:, 0]] * P[paths[:, :-1], paths[:, 1:]].prod(axis=1)
    weight *= likelihood[np.arange(6), paths[:, 1:]].prod(axis=1)
    exact = np.array([np.bincount(column, weight) for column in paths[:, 1:].T]) / weight.sum()
    assert smooth_modes(filtered(likelihood, mu0), P) == pytest.approx(exact)


def test_a_chain_at_rest_knows_what_it_will_know():
    mu = filtered(np.random.default_rng(2).random((5, 3)), np.full(3, 1 / 3))
    mu[2] = mu[1]
    smoothed = smooth_modes(mu, P, np.array([True, True, False, True, True]))
    assert smoothed[1] == pytest.approx(smoothed[2])
    assert smoothed == pytest.approx(smooth_modes(np.delete(mu, 2, 0), P)[[0, 1, 1, 2, 3]])


def test_impossible_models_and_short_rows_are_no_trouble():
    mu = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert np.isfinite(smooth_modes(mu, np.eye(2))).all()
    assert smooth_modes(mu[:1], np.eye(2)) == pytest.approx(mu[:1])
    assert smooth_modes(mu[:0], np.eye(2)).shape == (0, 2)
