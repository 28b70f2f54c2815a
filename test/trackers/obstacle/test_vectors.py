# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle tracker on approaches computed elsewhere, with the exact posterior beside them, and
on encounters beside an independent filter; errors of the navigation: their motion, what obstacles
tell each other of them, two assumptions."""

from attrs import evolve
from helpers import obstacle_runs as runs
from helpers.obstacle_runs import column, EXACT, KINDS, met, run, SECOND, track_approach
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

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

SETTLED = 30  # pings after which answers are compared
SHARP = {**runs.FAITHFUL, 'range_std': 0.01, 'bearing_std_deg': 0.01}


@pytest.mark.parametrize('name', ['approach_dst+3_noisy', 'approach_level_mirror_noisy'])
def test_posterior_is_the_exact_one(name):
    estimates = track_approach(name, **runs.FAITHFUL)
    coarse = track_approach(name, **{**runs.FAITHFUL, 'components': 9})
    for exact in runs.meta(name)['oracle_posterior_flat_prior_pm12']:
        estimate = estimates[exact['ping']]
        assert len(estimate) == 1
        assert estimate.state[0, 2] == pytest.approx(exact['mean_dst'], abs=0.05)
        assert np.sqrt(estimate.covariance[0, 2, 2]) == pytest.approx(exact['sd'], abs=0.05)
        assert estimate.probabilities[0, 0] == pytest.approx(exact['p_above'], abs=0.02)
        nine = coarse[exact['ping']].state[0, 2]  # slices do as well
        assert nine == pytest.approx(exact['mean_dst'], abs=0.1)


@pytest.mark.parametrize('name', ['approach_dst+0.5_noisefree', 'approach_dst+3_noisefree'])
def test_without_noise_the_obstacle_is_found(name):
    """Offset, range, bearing to port and place in ENU."""
    final, truth = track_approach(name, **{**SHARP, 'components': 61}), runs.rows(name)
    north, east, down = runs.meta(name)['obstacle_ned']
    for ping, close in ((60, 0.1), (-1, 0.03)):
        d, bearing, offset = final[ping].state[0]
        assert offset == pytest.approx(truth['true_dst'][ping], abs=close)
        assert d == pytest.approx(truth['true_range'][ping], abs=0.01)
        assert bearing == pytest.approx(-truth['true_delta'][ping], abs=2e-4)
        off = np.abs(final[ping].xyz[0] - [east, north, -down])
        spread = [np.sqrt(final[ping].extras[f'place_cov_{a}_{a}'][0]) for a in 'xyz']
        assert off.max() < 0.15 and np.all(off < 4.0 * np.array(spread) + 0.01)


@pytest.mark.parametrize(
    'kind, values', [('noisy', {'components': 5}), ('noisefree', {'components': 6}), ('noisy', {})]
)
def test_a_level_path_cannot_tell_above_from_below(kind, values):
    """From the first ping on, although the prior reaches further up than down."""
    estimates = track_approach(
        f'approach_level_mirror_{kind}', max_tracks=1, **runs.FIXED, **values
    )
    assert_allclose([item.probabilities[0, 0] for item in estimates[1:]], 0.5, atol=0.005)
    for end, sign in (('lo', -1.0), ('hi', 1.0)):
        ends = [sign * item.extras[f'vertical_offset_{end}'][0] for item in estimates[42:]]
        assert min(ends) > 3.0


def test_nor_can_it_with_all_behaviours():
    """The sea floor lies on one side only; it is ruled out soon, and does not last."""
    name = 'approach_level_mirror_noisy'
    moving = track_approach(name, max_tracks=1, behaviours=KINDS[:3])
    assert_allclose([item.probabilities[0, 0] for item in moving[1:]], 0.5, atol=0.005)
    everything = track_approach(name, max_tracks=1, **EXACT)
    assert_allclose([item.probabilities[0, 0] for item in everything[28:]], 0.5, atol=0.01)


@pytest.mark.parametrize('seed', [0, 1])
def test_outliers_are_taken_for_what_they_are(seed):
    """One echo in eight is off by up to 8 m and 6 degrees."""
    name = 'approach_dst+3_noisy'
    given = with_outliers(runs.approach(name), seed)
    last = runs.oldest(runs.track(given, sonar_lever=runs.lever(name), **runs.FIXED)[-1])
    error = last['vertical_offset'] - runs.rows(name)['true_dst'][-1]
    assert error**2 < 2.0 * last['cov_vertical_offset_vertical_offset'] < 2.0


def with_outliers(measurements, seed):
    rng = np.random.default_rng(seed)
    for i, item in enumerate(measurements):
        if isinstance(item, Detections) and i > 9 and rng.uniform() < 0.125:
            off, turned = rng.uniform(-8.0, 8.0), np.radians(rng.uniform(-6.0, 6.0))
            item = evolve(item, range=item.range + off, bearing=item.bearing + turned)
        yield item


@pytest.mark.parametrize('name, number', runs.ENCOUNTERS)
def test_answers_are_those_of_an_independent_filter(name, number):
    """It knows how far obstacles sway: while one begins to move they differ more."""
    data, estimates = met(name, number, **EXACT)
    sure = [item.extras['track_id'][item.extras['track_state'] > 0] for item in estimates]
    assert set(np.concatenate(sure)) == {1}
    pings = np.arange(SETTLED, len(estimates))

    def told(*names):
        return np.stack([column(estimates, each, pings) for each in names], -1)

    probability = told(*(f'prob_{kind}' for kind in KINDS))
    assert_allclose(probability.sum(axis=-1), 1.0, atol=1e-9)
    begins = name == 'starts_moving'
    for found, key, most in (
        (probability, 'ref_prob', 0.1 if begins else 0.05),
        (told('vx', 'vy'), 'ref_v', 0.05 if begins else 0.01),
    ):
        off = np.abs(found - data[key][pings]).max(axis=1) > most
        # That filter takes the first echo of a mover for an outlier.
        assert off.sum() <= (2 if begins else 0)
    for each, key, close in (
        ('vertical_offset', 'offset', 0.1), ('prob_above', 'above', 0.05),
        ('vertical_offset_lo', 'lo', 0.2), ('vertical_offset_hi', 'hi', 0.2),
    ):  # fmt: skip
        assert_allclose(told(each)[:, 0], data[f'ref_{key}'][pings], atol=close)


@pytest.mark.parametrize('number', [0, 1])
def test_a_new_obstacle_is_believed_to_be_where_the_study_believes_it(number):
    """The slices end at the sea floor, which is one: without, the offset is 0.7 m another."""
    data, estimates = met('seabed_and_fixed', number, **EXACT)
    pings = np.arange(4, SETTLED)
    offset = column(estimates, 'vertical_offset', pings)
    assert_allclose(offset, data['ref_offset'][pings], atol=0.35)
    seabed = column(estimates, 'prob_seabed', pings)
    assert_allclose(seabed, data['ref_prob'][pings, KINDS.index('seabed')], atol=0.06)


@pytest.mark.parametrize('name, number', runs.ENCOUNTERS)
def test_the_true_behaviour_is_found(name, number):
    kind = {'sway': 'swaying', 'move': 'moving', 'go': 'moving'}
    data, estimates = met(name, number)
    true = kind.get(str(data['kind']), str(data['kind']))
    assert estimates[-1].extras[f'prob_{true}'][0] > (0.5 if true == 'seabed' else 0.9)


@pytest.mark.parametrize('asked', [('moving', 'fixed'), ('swaying',), ('fixed',)])
def test_only_the_behaviours_asked_for_are_published(asked):
    data, _ = met('starts_moving')
    extras = runs.track_encounter(data | {'t': data['t'][:11]}, behaviours=asked)[10].extras
    found = {name: float(extras[name][0]) for name in extras if name.startswith('prob_')}
    assert found.keys() == {f'prob_{name}' for name in asked}
    assert sum(found.values()) == pytest.approx(1.0)


def test_without_altitude_there_is_no_sea_floor():
    _, estimates = met('seabed_and_fixed', altitude=False)
    assert_allclose(column(estimates, 'prob_seabed', range(1, 40)), 0.0)


def test_the_place_is_as_deep_as_the_offset_says():
    """Also where a hypothesis lies deeper than the echo is far, as those of a near echo do."""
    data, estimates = met('seabed_and_fixed', 1)
    for estimate in estimates[1::5]:
        row = runs.oldest(estimate)
        variance = row['cov_vertical_offset_vertical_offset']
        assert_allclose(row['place_cov_z_z'], variance, rtol=1e-9)
        k = int(np.argmin(np.abs(runs.SECOND + data['t'] * runs.SECOND - estimate.stamp_ns)))
        sonar = Rotation.from_quat(data['odom_q'][k]).apply(data['sonar_lever_flu'])
        sonar += data['odom_p'][k]
        assert_allclose(row['z'], sonar[2] - row['vertical_offset'], atol=1e-4)


CONFIG = ObstacleConfig()
ORDER = [0, 1, 2, 5, 6, 7, 8, 9, 3, 4]
"""Of our states in those of the vectors, (d, delta, z, e_N, e_E, s, psi, b_N, b_E, tau)."""


def vectors(name):
    return load_vectors(f'obstacle_in_clutter/{name}')


def of_case(case):
    """Of `ins_good.npz`: the mixture of a case, its other arrays, those of all cases."""
    data = vectors('ins_good')
    own = {name.split('/')[1]: value for name, value in data.items() if f'{case}/' in name}
    order = np.array(ORDER)
    return Mixture(own['x'][..., order], own['P'][..., order[:, None], order], own['w']), own, data


SURE = np.ones(1, np.bool_)


def moved(data, i, x, P):
    """Case i of `motion.npz` from the states x (n, 10), P (n, 10, 10)."""
    behaviour, dt, n = int(data['behaviour'][i]), float(data['dt'][i]), len(x)
    phi = np.exp(-dt / float(data['sway_time']))
    keep, step = [(0.0, 0.0), (phi, phi - 1.0), (1.0, dt)][behaviour]
    prior = np.full(n, float(behaviour > 0))
    motion = Motion(np.full(n, keep), np.full(n, step), *np.zeros((3, n)), prior)
    places, rates = (
        [data[name][i] for name in names.split()] for names in ('p0 R0 p1 R1', 'v0 w0 v1 w1')
    )
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
    data, rng = vectors('motion'), np.random.default_rng(i)
    x, small = data['x'][i, ORDER], 1e-5
    scale = np.array([0.05, 1e-3, 0.05, 1e-3, 3e-3, 0.01, 0.01, 0.05, 0.05, 0.05])
    A = rng.normal(size=(10, 10)) * scale[:, None]
    P = A @ A.T
    states = 8 if data['behaviour'][i] == 0 else 10
    P[states:] = P[:, states:] = 0.0
    ends = np.concatenate([x + small * np.eye(10), x - small * np.eye(10)])
    ahead, behind = np.split(moved(data, i, ends, np.zeros((20, 10, 10)))[0][0], 2)
    F = ((ahead - behind) / (2.0 * small)).T
    got = moved(data, i, x[None], P[None])[1][0, 0, :states, :states]
    exact = (F @ P @ F.T)[:states, :states]
    width = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert_allclose(got / width, exact / width, atol=0.02)


def linear_tracks(data):
    """The three obstacles of the vectors, their private two states in place of range and azimuth;
    alone before and after their own measurement."""
    tracks = [
        Mixture(np.zeros((3, 1, 10)), np.zeros((3, 1, 10, 10)), np.ones((3, 1))) for _ in range(2)
    ]
    states = np.array([0, 1, 3, 4, 5, 6, 7])
    for t in range(3):
        m, C, H = np.append(np.zeros(2), data['common_mean']), np.zeros((7, 7)), data['H'][t]
        C[:2, :2], C[2:, 2:] = data['private_covariance'][t], data['common_covariance']
        R = data['R'][t] if data['R'].ndim == 3 else data['R']
        gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + R)
        after = m + gain @ (data['y'][t] - H @ m), C - gain @ H @ C
        for mixture, (mean, covariance) in zip(tracks, ((m, C), after)):
            mixture.x[t, 0, states] = mean
            mixture.P[t, 0, states[:, None], states] = covariance
    return *tracks, states


def messages(before, after):
    marginals = navigation_errors.marginals
    return navigation_errors.messages(marginals(before), marginals(after), np.ones(3))


def test_messages_and_what_they_tell_equal_the_joint_gaussian():
    data = vectors('messages')
    before, after, states = linear_tracks(data)
    L, eta = messages(before, after)
    assert_allclose(L, data['message_information'], rtol=1e-8, atol=1e-8)
    assert_allclose(eta, data['message_vector'], rtol=1e-8, atol=1e-8)
    got = navigation_errors.apply_messages(after, L.sum(axis=0) - L, eta.sum(axis=0) - eta)
    assert_allclose(got.x[:, 0][:, states], data['together_mean'], rtol=1e-9, atol=1e-9)
    block = got.P[:, 0][:, states[:, None], states]
    assert_allclose(block, data['together_cov'], rtol=1e-9, atol=1e-10)
    common = NavigationErrors(data['common_mean'], data['common_covariance']).with_messages(L, eta)
    assert_allclose(common.mean, data['together_mean'][0, 2:], rtol=1e-9, atol=1e-9)
    assert_allclose(common.covariance, data['together_cov'][0, 2:, 2:], rtol=1e-8, atol=1e-10)
    # An error that is switched off is told by nobody.
    for mixture in (before, after):
        mixture.P[..., 7, :] = mixture.P[..., 7] = 0.0
    L, eta = messages(before, after)
    assert not L[:, 4].any() and not L[..., 4].any() and not eta[:, 4].any()
    assert L[:, :4, :4].any(axis=(1, 2)).all()


def test_weights_of_components_that_are_told_are_their_evidence():
    """Against the density of what is told, as a measurement of the five."""
    rng = np.random.default_rng(4)
    x = rng.normal(size=(1, 3, 10)) * 0.3
    A, B = rng.normal(size=(1, 3, 10, 10)) * 0.2, rng.normal(size=(5, 5))
    P, R, z = A @ np.swapaxes(A, -1, -2), B @ B.T + np.eye(5), rng.normal(size=5)
    mu, L = np.array([[0.2, 0.5, 0.3]]), np.linalg.inv(R)
    got = navigation_errors.apply_messages(Mixture(x, P, mu), L[None], (L @ z)[None])
    weight = np.empty(3)
    for k in range(3):
        S, h = P[0, k][NAV, NAV] + R, x[0, k, NAV]
        gain = P[0, k][:, NAV] @ np.linalg.inv(S)
        assert_allclose(got.x[0, k], x[0, k] + gain @ (z - h), rtol=1e-9, atol=1e-12)
        exact = P[0, k] - gain @ P[0, k][NAV]
        assert_allclose(got.P[0, k], exact, rtol=1e-8, atol=1e-12)
        weight[k] = mu[0, k] * multivariate_normal.pdf(z, h, S)
    assert_allclose(got.mu[0], weight / weight.sum(), rtol=1e-9)


@pytest.mark.parametrize('case', [0, 1, 2])
def test_both_assumptions_equal_the_vectors(case):
    """Means, variances; and, of what is published, behaviours, velocity and the band."""
    alone, own, data = of_case(case)
    std = data['stdB']
    config = ObstacleConfig(
        scale_std=std[0], yaw_error_std_deg=np.degrees(std[1]), drift_std=std[2],
        navigation_delay_std=std[4], navigation_good_probability=float(data['priorA']),
    )  # fmt: skip
    assert_allclose(config.navigation_errors()[1], data['walkB'], rtol=1e-9)
    assert_allclose(navigation_errors.GOOD, data['stdA'], rtol=1e-9)
    mixture, good = navigation_errors.under_two_assumptions(alone, SURE, float(own['t']), config)
    assert_allclose(good, own['pA'], rtol=1e-9)
    x, P, mu = (part[0] for part in mixture)
    mean = mu @ x
    assert_allclose(mean, np.atleast_2d(own['m'])[0][ORDER], rtol=1e-8)
    variance = mu @ (np.diagonal(P, axis1=1, axis2=2) + np.square(x - mean))
    assert_allclose(variance, np.diag(np.squeeze(own['var']))[ORDER], rtol=1e-7)

    kind = np.tile(own['beh'], 2)
    behaviour = [mu[kind == k].sum() for k in range(3)]
    floor = mu[[27, 55]].sum()  # the last component is the sea floor
    behaviour[0] -= floor
    assert_allclose([*behaviour, floor], own['behaviour'][0], rtol=1e-9, atol=1e-12)
    std = np.sqrt(np.where(mixture.mu > 0.0, mixture.P[..., 2, 2], 1.0))
    low, high, _ = mixtures.bands(mixture.x[..., 2], std, mixture.mu, 0.05)
    assert_allclose([low[0], high[0]], [own['lo'][0], own['hi'][0]], atol=3e-4)
    assert_allclose(mu[kind == 2] @ x[kind == 2, 8:], own['v'][0], rtol=1e-9, atol=1e-12)


def test_nothing_is_split_where_nothing_is_in_doubt():
    mixture, *_ = of_case(0)

    def split(**values):
        return navigation_errors.under_two_assumptions(
            mixture, SURE, 9.0, ObstacleConfig(**values)
        )

    good = {'drift_std': 0.003, 'yaw_error_std_deg': 0.1, 'navigation_delay_std': 0.01}
    for values in (good, {'navigation_good_probability': 0.0}):
        same, probability = split(**values)
        assert same is mixture and np.isnan(probability).all()
    found, probability = split(navigation_good_probability=1.0)
    assert_allclose(probability, 1.0)
    assert np.isfinite(found.x).all() and np.isfinite(found.mu).all()


def dived(drift=(0.0, 0.0), yaw_deg=0.0, late=0.0, **values):
    """The tracker and P(fixed) after an approach with navigation that drifts (east, north m/s), a
    sonar turned to starboard by `yaw_deg`, or poses that come late."""
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
    *_, last = run(tracker, sorted(given, key=lambda each: each.stamp_ns)).values()
    return tracker, last.extras['prob_fixed'][np.argmax(last.extras['track_state'])]


def test_a_drift_is_no_motion_of_the_obstacle_and_is_said():
    """Good navigation is believed, and nothing is said."""
    tracker, fixed = dived()
    assert tracker.health()['navigation_good'] > 0.7 and fixed > 0.95
    assert tracker.warnings() == []
    drift = 0.06 * np.array([np.sin(np.radians(30.0)), np.cos(np.radians(30.0))])
    tracker, fixed = dived(drift=drift)
    health = tracker.health()
    assert fixed > 0.9 and health['navigation_good'] < 0.05
    assert np.hypot(health['nav_drift_x'] - drift[0], health['nav_drift_y'] - drift[1]) < 0.03
    (sentence,) = tracker.warnings()
    assert 'navigation drifts by 0.0' in sentence and 'what 1 obstacle shows' in sentence
    tracker, fixed = dived(drift=drift, **EXACT)
    assert tracker.health()['nav_drift_x'] == 0.0 and fixed < 0.1


def of_encounter(name, seed):
    """The tracker after an encounter of the study, its estimates, the obstacles."""
    given, obstacles = encounter(name, seed)
    tracker = ObstacleTracker(ObstacleConfig(sonar_lever=LEVER['sonar_lever']))
    return tracker, list(run(tracker, given).values()), obstacles


@pytest.mark.parametrize('name, seed', [('', 400), (', 3 fixed', 403)])
def test_what_moves_slowly_is_no_drift(name, seed):
    """At 0.16 m/s alone and at 0.12 m/s beside three that stay; halfway and at the end."""
    tracker, final, obstacles = of_encounter(f'moving .1-.3 m/s{name}', seed)
    for ping in (60, 100):
        extras, place = final[ping].extras, final[ping].xyz[:, :2]
        for does, truth in obstacles:
            row = np.linalg.norm(place - truth.position[ping, :2], axis=1).argmin()
            assert extras['track_state'][row] > 0 and extras[f'prob_{does}'][row] > 0.9
    assert tracker.warnings() == []


@pytest.mark.parametrize('side, yaw_deg', [('starboard', 2.5), ('port', -2.5)])
def test_a_sonar_that_is_turned_is_said_with_its_side(side, yaw_deg):
    """What it sees ahead lies to the other side of where it says."""
    tracker, fixed = dived(yaw_deg=yaw_deg)
    (sentence,) = tracker.warnings()
    assert fixed > 0.9 and sentence.startswith('the sonar seems to be turned by 2.')
    assert f'deg to {side} against sonar_mount_rpy_deg' in sentence


@pytest.mark.parametrize('late, word', [(0.4, 'late'), (-0.4, 'early')])
def test_poses_that_are_late_are_said(late, word):
    tracker, _ = dived(late=late)
    assert tracker.health()['nav_delay'] == pytest.approx(late, abs=0.15)
    (sentence,) = tracker.warnings()
    assert sentence.startswith('poses arrive 0.') and f's {word}: allowed for' in sentence


@pytest.mark.parametrize('seed', [3000, 3003])
def test_poses_far_too_late_are_not_said_to_be_allowed_for(seed):
    """Whether the offset is wrong, as in the first encounter, or not: nothing tells."""
    first, *others = of_encounter('1.5 s late', seed)[0].warnings()
    assert not any('allowed for' in each for each in others)
    assert first.startswith('bearings scatter') and first.endswith(
        'as if poses came later than navigation_delay_std holds, so heights and behaviours may be '
        'wrong by more than stated; check the stamps of nav'
    )


def test_an_error_is_said_where_it_is_sure_and_matters():
    """Along the course and across it, east and north, with their signs."""
    small = np.diag([1e-3, 1e-3, 3e-3, 3e-3, 0.01]) ** 2

    def said(turn=0.0, north=0.0, east=0.0, seen=3, spread=1.0, course=(1.0, 0.0, 0.0), **values):
        errors = NavigationErrors(np.array([0.0, turn, north, east, 0.0]), spread * small)
        return errors.warnings(np.array(course), seen, evolve(CONFIG, **values))

    assert said(north=-0.05) == [
        'navigation drifts by 0.05 m/s against what 3 obstacles show (0.00 m/s east, 0.05 m/s '
        'north): allowed for; check the log or the current'
    ]
    (beyond,) = said(north=-0.05, drift_std=0.016)
    assert beyond.endswith(
        'north): drift_std does not hold it, so heights and behaviours may be wrong by more than '
        'stated; check the log or the current'
    )
    (alone,) = said(north=-0.05, seen=1)
    assert 'against what 1 obstacle shows (' in alone and alone.endswith(', or whether it moves')
    assert said(north=-0.05, spread=100.0) == said(north=-0.025) == []
    assert said(turn=0.02, east=0.01, seen=1) == [
        'the sonar seems to be turned by 1.7 deg to port against sonar_mount_rpy_deg, or '
        'navigation drifts sideways by 0.03 m/s'
    ]
    # Drift to port that hides a turn is neither.
    assert said(turn=0.02, east=-0.02, seen=1) == []
    for course in (np.zeros(3), np.full(3, np.nan)):
        assert said(turn=0.02, east=0.01, seen=1, course=course) == []
