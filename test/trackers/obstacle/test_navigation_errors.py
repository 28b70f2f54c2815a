# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Errors of the navigation: their motion, what obstacles tell each other of them, two
assumptions."""

from attrs import evolve
from helpers.obstacle_runs import run, SECOND
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest

from benchmarks.obstacle_accuracy import LEVER
from benchmarks.obstacle_clutter import encounter
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle import mixtures, navigation_errors, unscented
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import Mixture
from sonar_imm.trackers.obstacle.navigation_errors import NavigationErrors
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker
from sonar_imm.trackers.obstacle.unscented import Motion, NAV, Step
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

CONFIG = ObstacleConfig()
ORDER = [0, 1, 2, 5, 6, 7, 8, 9, 3, 4]
"""Of our states in those of the vectors, (d, delta, z, e_N, e_E, s, psi, b_N, b_E, tau)."""


def vectors(name):
    return load_vectors(f'obstacle_in_clutter/{name}')


def moved(data, i, x, P):
    """Case i of `motion.npz` from the states x (n, 10), P (n, 10, 10)."""
    behaviour, dt = int(data['behaviour'][i]), float(data['dt'][i])
    phi = np.exp(-dt / float(data['sway_time']))
    keep, step = [(0.0, 0.0), (phi, phi - 1.0), (1.0, dt)][behaviour]
    n = len(x)
    prior = np.full(n, float(behaviour > 0))
    motion = Motion(np.full(n, keep), np.full(n, step), *np.zeros((3, n)), prior)
    names = ('v0', 'w0', 'v1', 'w1')
    places = [data[name][i] for name in ('p0', 'R0', 'p1', 'R1')]
    rates = [data[name][i] for name in names]
    step = Step(*places, np.zeros(3), False, *rates, np.zeros(5), dt)
    return unscented.advance(x[None], P[None], np.ones((1, n)), motion, step)[:2]


def test_motion_equals_the_vectors():
    data = vectors('motion')
    for i, (x, y) in enumerate(zip(data['x'][:, ORDER], data['y'][:, ORDER])):
        got = moved(data, i, x[None], np.zeros((1, 10, 10)))[0][0, 0]
        states = 8 if data['behaviour'][i] == 0 else 10
        assert_allclose(got[:states], y[:states], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('i', [0, 7, 21, 40])
def test_the_covariance_of_a_step_is_that_of_its_derivatives(i):
    """Where all is nearly straight; the vectors check the step of the means."""
    data = vectors('motion')
    x, small = data['x'][i, ORDER], 1e-5
    rng = np.random.default_rng(i)
    scale = np.array([0.05, 1e-3, 0.05, 1e-3, 3e-3, 0.01, 0.01, 0.05, 0.05, 0.05])
    A = rng.normal(size=(10, 10)) * scale[:, None]
    P = A @ A.T
    if data['behaviour'][i] == 0:
        P[8:] = P[:, 8:] = 0.0
    ends = np.concatenate([x + small * np.eye(10), x - small * np.eye(10)])
    ahead, behind = np.split(moved(data, i, ends, np.zeros((20, 10, 10)))[0][0], 2)
    F = ((ahead - behind) / (2.0 * small)).T
    got = moved(data, i, x[None], P[None])[1][0, 0]
    exact = F @ P @ F.T
    width = np.sqrt(np.maximum(np.diag(exact), 1e-300))
    if data['behaviour'][i] == 0:
        got, exact, width = got[:8, :8], exact[:8, :8], width[:8]
    assert_allclose(got / np.outer(width, width), exact / np.outer(width, width), atol=0.02)


def linear_tracks(data):
    """The three obstacles of the vectors, their private two states in place of range and azimuth;
    alone before and after their own measurement."""
    before, after = (Mixture(np.zeros((3, 1, 10)), np.zeros((3, 1, 10, 10)), np.ones((3, 1)))
                     for _ in range(2))  # fmt: skip
    states = np.array([0, 1, 3, 4, 5, 6, 7])
    for t in range(3):
        m = np.concatenate([np.zeros(2), data['common_mean']])
        C = np.zeros((7, 7))
        C[:2, :2], C[2:, 2:] = data['private_covariance'][t], data['common_covariance']
        R = data['R'][t] if data['R'].ndim == 3 else data['R']
        H = data['H'][t]
        gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + R)
        for mixture, mean, cov in (
            (before, m, C),
            (after, m + gain @ (data['y'][t] - H @ m), C - gain @ H @ C),
        ):
            mixture.x[t, 0, states] = mean
            mixture.P[t, 0, states[:, None], states] = cov
    return before, after, states


def test_messages_and_what_they_tell_equal_the_joint_gaussian():
    data = vectors('messages')
    before, after, states = linear_tracks(data)
    marginals = navigation_errors.marginals
    L, eta = navigation_errors.messages(marginals(before), marginals(after), np.ones(3))
    assert_allclose(L, data['message_information'], rtol=1e-8, atol=1e-8)
    assert_allclose(eta, data['message_vector'], rtol=1e-8, atol=1e-8)
    got = navigation_errors.apply_messages(after, L.sum(axis=0) - L, eta.sum(axis=0) - eta)
    assert_allclose(got.x[:, 0][:, states], data['together_mean'], rtol=1e-9, atol=1e-9)
    block = got.P[:, 0][:, states[:, None], states]
    assert_allclose(block, data['together_cov'], rtol=1e-9, atol=1e-10)
    common = NavigationErrors(data['common_mean'], data['common_covariance']).with_messages(L, eta)
    assert_allclose(common.mean, data['together_mean'][0, 2:], rtol=1e-9, atol=1e-9)
    assert_allclose(common.covariance, data['together_cov'][0, 2:, 2:], rtol=1e-8, atol=1e-10)


def test_weights_of_components_that_are_told_are_their_evidence():
    """Against the density of what is told, as a measurement of the five."""
    rng = np.random.default_rng(4)
    x = rng.normal(size=(1, 3, 10)) * 0.3
    A = rng.normal(size=(1, 3, 10, 10)) * 0.2
    P = A @ np.swapaxes(A, -1, -2)
    mu = np.array([[0.2, 0.5, 0.3]])
    B = rng.normal(size=(5, 5))
    R, z = B @ B.T + np.eye(5), rng.normal(size=5)
    L = np.linalg.inv(R)
    got = navigation_errors.apply_messages(Mixture(x, P, mu), L[None], (L @ z)[None])
    weight = np.empty(3)
    for k in range(3):
        S = P[0, k][NAV, NAV] + R
        v = z - x[0, k, NAV]
        gain = P[0, k][:, NAV] @ np.linalg.inv(S)
        assert_allclose(got.x[0, k], x[0, k] + gain @ v, rtol=1e-9, atol=1e-12)
        exact = P[0, k] - gain @ P[0, k][NAV]
        assert_allclose(got.P[0, k], exact, rtol=1e-8, atol=1e-12)
        weight[k] = mu[0, k] * np.exp(-0.5 * v @ np.linalg.solve(S, v)) / np.sqrt(np.linalg.det(S))
    assert_allclose(got.mu[0], weight / weight.sum(), rtol=1e-9)


def test_an_error_that_is_switched_off_is_told_by_nobody():
    data = vectors('messages')
    before, after, _ = linear_tracks(data)
    for mixture in (before, after):
        mixture.P[..., 7, :] = mixture.P[..., 7] = 0.0
    marginals = navigation_errors.marginals
    L, eta = navigation_errors.messages(marginals(before), marginals(after), np.ones(3))
    assert not L[:, 4].any() and not L[..., 4].any() and not eta[:, 4].any()
    assert L[:, :4, :4].any(axis=(1, 2)).all()


@pytest.mark.parametrize('case', [0, 1, 2])
def test_both_assumptions_equal_the_vectors(case):
    data = vectors('ins_good')
    std, walk = data['stdB'], data['walkB']
    own = {name.split('/')[1]: value for name, value in data.items() if f'{case}/' in name}
    config = ObstacleConfig(
        scale_std=std[0], yaw_error_std_deg=np.degrees(std[1]), drift_std=std[2],
        navigation_delay_std=std[4], navigation_good_probability=float(data['priorA']),
    )  # fmt: skip
    assert_allclose(config.navigation_errors()[1], walk, rtol=1e-9)
    assert_allclose(navigation_errors.GOOD, data['stdA'], rtol=1e-9)
    order = np.array(ORDER)
    x = own['x'][..., order]
    P = own['P'][..., order[:, None], order]
    mixture, good = navigation_errors.under_two_assumptions(
        Mixture(x, P, own['w']), np.ones(1, np.bool_), float(own['t']), config
    )
    assert_allclose(good, own['pA'], rtol=1e-9)
    mean, covariance = unscented_moments(mixture)
    assert_allclose(mean, own['m'][0][order] if own['m'].ndim > 1 else own['m'][order], rtol=1e-8)
    assert_allclose(np.diag(covariance), np.diag(np.squeeze(own['var']))[order], rtol=1e-7)


def unscented_moments(mixture):
    x, P, mu = (part[0] for part in mixture)
    mean = mu @ x
    off = x - mean
    return mean, np.einsum('k,kab->ab', mu, P + off[:, :, None] * off[:, None])


@pytest.mark.parametrize('case', [0, 1, 2])
def test_what_is_published_counts_both_assumptions(case):
    """Behaviours, velocity and the band of the depth, of the vectors."""
    data = vectors('ins_good')
    own = {name.split('/')[1]: value for name, value in data.items() if f'{case}/' in name}
    order = np.array(ORDER)
    mixture, _ = navigation_errors.under_two_assumptions(
        Mixture(own['x'][..., order], own['P'][..., order[:, None], order], own['w']),
        np.ones(1, np.bool_),
        float(own['t']),
        ObstacleConfig(),
    )
    kind = np.tile(own['beh'], 2)
    behaviour = [mixture.mu[0, kind == k].sum() for k in range(3)]
    # The last component is the sea floor.
    floor = mixture.mu[0, [27, 55]].sum()
    behaviour[0] -= floor
    assert_allclose([*behaviour, floor], own['behaviour'][0], rtol=1e-9, atol=1e-12)
    std = np.sqrt(np.where(mixture.mu > 0.0, mixture.P[..., 2, 2], 1.0))
    low, high, _ = mixtures.bands(mixture.x[..., 2], std, mixture.mu, 0.05)
    assert_allclose([low[0], high[0]], [own['lo'][0], own['hi'][0]], atol=3e-4)
    moves = kind == 2
    velocity = mixture.mu[0, moves] @ mixture.x[0, moves, 8:]
    assert_allclose(velocity, own['v'][0], rtol=1e-9, atol=1e-12)


def test_nothing_is_split_where_nothing_is_in_doubt():
    good = ObstacleConfig(drift_std=0.003, yaw_error_std_deg=0.1, navigation_delay_std=0.01)
    own = {name[2:]: value for name, value in vectors('ins_good').items() if name.startswith('0/')}
    order = np.array(ORDER)
    mixture = Mixture(own['x'][..., order], own['P'][..., order[:, None], order], own['w'])
    sure = np.ones(1, np.bool_)
    for config in (good, ObstacleConfig(navigation_good_probability=0.0)):
        same, probability = navigation_errors.under_two_assumptions(mixture, sure, 9.0, config)
        assert same is mixture and np.isnan(probability).all()
    certain = ObstacleConfig(navigation_good_probability=1.0)
    found, probability = navigation_errors.under_two_assumptions(mixture, sure, 9.0, certain)
    assert_allclose(probability, 1.0)
    assert np.isfinite(found.x).all() and np.isfinite(found.mu).all()


def dived(drift=(0.0, 0.0), yaw_deg=0.0, late=0.0, **values):
    """The tracker and its last estimate after an approach with navigation that drifts (east, north
    m/s), a sonar turned to starboard by `yaw_deg`, or poses that come late."""
    scene = simulate(scenario('approach', {'detection_probability': 0.95}), 3)
    given, start = [], scene.measurements[0].measurement.stamp_ns
    for item in scene.measurements:
        each = item.measurement
        if isinstance(each, Navigation):
            off = (each.stamp_ns - start) / SECOND * np.array([*drift, 0.0])
            stamp_ns = each.stamp_ns + round(late * SECOND)
            each = evolve(each, position=each.position + off, stamp_ns=stamp_ns)
        if isinstance(each, Detections):
            each = evolve(each, bearing=each.bearing + np.radians(yaw_deg))
        given.append(each)
    tracker = ObstacleTracker(ObstacleConfig(**values))
    final = run(tracker, sorted(given, key=lambda each: each.stamp_ns))
    return tracker, list(final.values())[-1]


def fixed(estimate):
    row = int(np.argmax(estimate.extras['track_state']))
    return float(estimate.extras['prob_fixed'][row])


def test_good_navigation_is_believed_and_nothing_is_said():
    tracker, estimate = dived()
    assert tracker.health()['navigation_good'] > 0.7
    assert tracker.warnings() == []
    assert fixed(estimate) > 0.95


def test_a_drift_is_no_motion_of_the_obstacle_and_is_said():
    course = np.radians(30.0)
    drift = 0.06 * np.array([np.sin(course), np.cos(course)])
    tracker, estimate = dived(drift=drift)
    health = tracker.health()
    assert fixed(estimate) > 0.9
    assert health['navigation_good'] < 0.05
    assert np.hypot(health['nav_drift_x'] - drift[0], health['nav_drift_y'] - drift[1]) < 0.03
    (sentence,) = tracker.warnings()
    assert 'navigation drifts by 0.0' in sentence and 'what 1 obstacle shows' in sentence
    off = dived(drift=drift, drift_std=0.0, yaw_error_std_deg=0.0, navigation_delay_std=0.0)
    assert off[0].health()['nav_drift_x'] == 0.0
    assert fixed(off[1]) < 0.1


@pytest.mark.parametrize(
    'name, seed', [('moving .1-.3 m/s', 400), ('moving .1-.3 m/s, 3 fixed', 403)]
)
def test_what_moves_slowly_is_no_drift(name, seed):
    """At 0.16 m/s alone and at 0.12 m/s beside three that stay; halfway and at the end."""
    given, obstacles = encounter(name, seed)
    tracker = ObstacleTracker(ObstacleConfig(sonar_lever=LEVER['sonar_lever']))
    final = list(run(tracker, given).values())
    for ping in (60, 100):
        extras, place = final[ping].extras, final[ping].xyz[:, :2]
        for does, truth in obstacles:
            row = np.linalg.norm(place - truth.position[ping, :2], axis=1).argmin()
            assert extras['track_state'][row] > 0 and extras[f'prob_{does}'][row] > 0.9
    assert tracker.warnings() == []


@pytest.mark.parametrize('side, yaw_deg', [('starboard', 2.5), ('port', -2.5)])
def test_a_sonar_that_is_turned_is_said_with_its_side(side, yaw_deg):
    """What it sees ahead lies to the other side of where it says."""
    tracker, estimate = dived(yaw_deg=yaw_deg)
    assert fixed(estimate) > 0.9
    (sentence,) = tracker.warnings()
    assert sentence.startswith('the sonar seems to be turned by 2.')
    assert f'deg to {side} against sonar_mount_rpy_deg' in sentence


@pytest.mark.parametrize('late, word', [(0.4, 'late'), (-0.4, 'early')])
def test_poses_that_are_late_are_said(late, word):
    tracker, _ = dived(late=late)
    assert tracker.health()['nav_delay'] == pytest.approx(late, abs=0.15)
    (sentence,) = tracker.warnings()
    assert sentence.startswith('poses arrive 0.') and f's {word}: allowed for' in sentence


@pytest.mark.parametrize('name, seed', [('1.5 s late', 3000), ('1.5 s late', 3003)])
def test_poses_far_too_late_are_not_said_to_be_allowed_for(name, seed):
    """Whether the offset is wrong, as in the first encounter, or not: nothing tells."""
    given, _ = encounter(name, seed)
    tracker = ObstacleTracker(ObstacleConfig(sonar_lever=LEVER['sonar_lever']))
    run(tracker, given)
    first, *others = tracker.warnings()
    assert not any('allowed for' in each for each in others)
    assert first.startswith('bearings scatter') and first.endswith(
        'as if poses came later than navigation_delay_std holds, so heights and behaviours may be '
        'wrong by more than stated; check the stamps of nav'
    )


def test_an_error_is_said_where_it_is_sure_and_matters():
    """Along the course and across it, east and north, with their signs."""
    small = np.diag([1e-3, 1e-3, 3e-3, 3e-3, 0.01]) ** 2
    north = np.array([1.0, 0.0, 0.0])
    drifts = NavigationErrors(np.array([0.0, 0.0, -0.05, 0.0, 0.0]), small)
    assert drifts.warnings(north, 3, CONFIG) == [
        'navigation drifts by 0.05 m/s against what 3 obstacles show (0.00 m/s east, 0.05 m/s '
        'north): allowed for; check the log or the current'
    ]
    config = evolve(CONFIG, drift_std=0.016)
    (beyond,) = drifts.warnings(north, 3, config)
    assert beyond.endswith(
        'north): drift_std does not hold it, so heights and behaviours may be wrong by more than '
        'stated; check the log or the current'
    )
    (alone,) = drifts.warnings(north, 1, CONFIG)
    assert 'against what 1 obstacle shows (' in alone and alone.endswith(', or whether it moves')
    unsure = drifts._replace(covariance=100.0 * small)
    assert unsure.warnings(north, 3, CONFIG) == []
    assert drifts._replace(mean=0.5 * drifts.mean).warnings(north, 3, CONFIG) == []
    aside = NavigationErrors(np.array([0.0, 0.02, 0.0, 0.01, 0.0]), small)
    assert aside.warnings(north, 1, CONFIG) == [
        'the sonar seems to be turned by 1.7 deg to port against sonar_mount_rpy_deg, or '
        'navigation drifts sideways by 0.03 m/s'
    ]
    # Drift to port that hides a turn is neither.
    assert (
        aside._replace(mean=np.array([0.0, 0.02, 0.0, -0.02, 0.0])).warnings(north, 1, CONFIG)
        == []
    )
    still = np.zeros(3)
    assert aside.warnings(still, 1, CONFIG) == aside.warnings(np.full(3, np.nan), 1, CONFIG) == []
