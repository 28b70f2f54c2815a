# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""z of fixes, against linear Kalman filters, in its statistics and where it is wrong; rows of
a track that are spread over depth."""

import math

from helpers.diver_runs import arrivals
import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.estimation.gauss_markov import gauss_markov
from sonar_imm.estimation.rows import LEAST_LOG
from sonar_imm.measurements import Fix, Fixes, GeodeticFix, RelativeFix, Start
from sonar_imm.trackers.diver.births import restart_track
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.depth import ambiguous_depths, respread_depths
from sonar_imm.trackers.diver.estimate import published_state
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.known import track_outputs
from sonar_imm.trackers.diver.models import build_models, START_DEPTHS
from sonar_imm.trackers.diver.scales import protected_rows
from sonar_imm.trackers.diver.scan import ping_measurements, Scan
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate

CV = {
    'model_set': 'linear', 'association': 'gnn', 'max_tracks': 1, 'dimensions': 3,
    'gate_probability': 0.999999,
}  # fmt: skip
Z, W = 2, 5
"""Of z and its rate in the published state."""


def spatial(variance, *across):
    """(3, 3) with unit variances of x and y."""
    covariance = np.eye(3)
    covariance[2, 2] = variance
    for axis, value in enumerate(across):
        covariance[2, axis] = covariance[axis, 2] = value
    return covariance


def fix(second, z, covariance, x=0.0, y=0.0):
    return Fix(stamp_ns=round(second * 1e9), position=(x, y, z), covariance=covariance)


def last(tracker, fixes):
    """The newest estimate after `fixes`."""
    return [estimate for each in fixes for estimate in tracker.process(each)][-1]


def test_alone_z_is_a_linear_kalman_filter():
    rng, config = np.random.default_rng(0), DiverConfig(**CV)
    tracker, variance = DiverTracker(config), 0.3
    seconds = np.cumsum(rng.uniform(0.3, 1.9, 40))
    z = -25.0 + rng.normal(size=40)
    mean, P = np.array([z[0], 0.0]), np.diag([variance, config.vertical_speed_std**2])
    for k, second in enumerate(seconds):
        estimate = last(tracker, [fix(second, z[k], spatial(variance))])
        if k:
            dt = (round(seconds[k] * 1e9) - round(seconds[k - 1] * 1e9)) * 1e-9
            fade, added = gauss_markov(config.vertical_speed_std, config.vertical_speed_time, dt)
            F = np.array([[1.0, config.vertical_speed_time * (1.0 - fade)], [0.0, fade]])
            mean, P = F @ mean, F @ P @ F.T + np.diag([0.0, added])
            gain = P[:, 0] / (P[0, 0] + variance)
            mean, P = mean + gain * (z[k] - mean[0]), P - np.outer(gain, P[0])
        assert estimate.state[0, [Z, W]] == pytest.approx(mean, abs=1e-9)
        assert estimate.covariance[0][np.ix_([Z, W], [Z, W])] == pytest.approx(P, abs=1e-9)
        assert estimate.extras['nis_dof'][0] == (3 if k else 0)


def test_correlated_with_x_and_y_it_is_the_kalman_filter_of_all_three():
    rng, config = np.random.default_rng(1), DiverConfig(**CV, fix_bias_std=0.5)
    tracker, models = DiverTracker(config), build_models(config)
    R, n = spatial(0.5, 0.6, -0.3), models.n
    H = np.zeros((3, n))
    H[:2], H[2, models.height] = models.fix_matrix[0], 1.0
    mean, P = None, None
    for second in range(1, 30):
        z = rng.multivariate_normal([0.2 * second, 0.0, -10.0], R)
        estimate = last(tracker, [Fix(stamp_ns=second * 10**9, position=z, covariance=R)])
        if mean is None:
            x0, P0, _ = models.initial_states(z[None, :2], R[None, :2, :2])
            mean, P = x0[0, 0, 0], P0[0, 0, 0]
            h = models.height
            mean[h], P[h, h], P[h, :2], P[:2, h] = z[2], R[2, 2], R[2, :2], R[2, :2]
        else:
            F, Q = (part[0] for part in models.motion(1.0)[:2])
            mean, P = F @ mean, F @ P @ F.T + Q
            gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            mean, P = mean + gain @ (z - H @ mean), P - gain @ H @ P
        E = models.E[0]
        assert estimate.state[0] == pytest.approx(E @ mean, abs=1e-9)
        assert estimate.covariance[0] == pytest.approx(E @ P @ E.T, abs=1e-9)


def dive(rng, n=60):
    """Positions (n, 3) of a diver who turns and goes up and down, once a second."""
    heading = np.cumsum(rng.normal(scale=0.3, size=n))
    fade, added = gauss_markov(0.1, 10.0, 1.0)
    rate = np.empty(n)
    rate[0] = 0.1 * rng.normal()
    for k in range(1, n):
        rate[k] = fade * rate[k - 1] + math.sqrt(added) * rng.normal()
    flat = np.cumsum(0.7 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return np.column_stack([flat, rng.uniform(-18.0, -2.0) + np.cumsum(rate)])


@pytest.mark.statistics
@pytest.mark.parametrize('association', ['gnn', 'jipda'])
def test_the_covariance_of_all_three_is_true(association):
    R, nees, depth = spatial(0.5, 0.3, -0.4), [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        tracker = DiverTracker(DiverConfig(dimensions=3, max_tracks=1, association=association))
        for k, place in enumerate(dive(rng), start=1):
            position = rng.multivariate_normal(place, R)
            scan = Fixes(stamp_ns=k * 10**9, position=position[None], covariance=R[None])
            (estimate,) = tracker.process(scan)
            if k > 10 and len(estimate.state):
                error, P = estimate.state[0, :3] - place, estimate.covariance[0, :3, :3]
                nees.append(error @ np.linalg.solve(P, error))
                depth.append(error[2])
    assert len(nees) > 380 and 2.0 < np.mean(nees) < 4.0
    assert np.sqrt(np.mean(np.square(depth))) < 0.5


@pytest.mark.parametrize('settings', [{}, {'depth_max': 40.0}, {'association': 'jipda'}])
def test_a_fix_says_how_deep_a_diver_is_below_the_stated_column_too(settings):
    rng = np.random.default_rng(3)
    tracker = DiverTracker(DiverConfig(dimensions=3, **settings))
    places = np.array([0.0, 0.0, -25.0]) + rng.normal(size=(40, 3)) * [1.0, 1.0, 0.5]
    scans = [
        Fixes(stamp_ns=k * 10**9, position=place[None], covariance=spatial(0.25)[None])
        for k, place in enumerate(places, start=1)
    ]
    estimate = last(tracker, scans)
    sd = math.sqrt(estimate.covariance[0, Z, Z])
    assert abs(estimate.state[0, Z] + 25.0) < 3.0 * sd and sd < 0.3
    warned = any('outside depth_min' in sentence for sentence in tracker.warnings())
    assert warned == ('depth_max' not in settings)


def test_what_is_less_than_the_water_column_says_does_not_replace_it():
    tracker = DiverTracker(DiverConfig(dimensions=3))
    estimate = last(tracker, [fix(1.0, -9.0, spatial(1e4))])
    assert estimate.state[0, Z] == pytest.approx(-10.0)
    assert estimate.covariance[0, Z, Z] < 40.0


@pytest.mark.parametrize(
    'covariance',
    [
        np.eye(2),
        spatial(math.nan),
        spatial(0.0),
        spatial(-1.0),
        spatial(1e6),
        spatial(0.25, 0.6),
        spatial(0.25, 0.4, 0.4),
        spatial(0.25, math.nan),
    ],
)
def test_what_states_no_height_that_can_be_true_changes_no_bit(covariance):
    def run(stated, dimensions=3):
        tracker = DiverTracker(DiverConfig(dimensions=dimensions))
        return last(tracker, [fix(k, -5.0, stated, 0.5 * k) for k in range(1, 8)])

    # Two dimensions take no notice of any.
    assert run(spatial(0.25, 0.3), 2).state.tobytes() == run(covariance, 2).state.tobytes()
    plain, found = run(np.eye(2)), run(covariance)
    assert found.state.tobytes() == plain.state.tobytes()
    assert found.covariance.tobytes() == plain.covariance.tobytes()
    assert found.covariance[0, Z, Z] > 25.0


def at_ten(tracker, more, seconds=range(1, 21)):
    noise = np.random.default_rng(5).normal(size=(100, 3)) * 0.3
    fixes = [fix(k, -10.0 + noise[k, 2], spatial(0.09), *noise[k, :2]) for k in seconds]
    last(tracker, fixes)
    return [last(tracker, [each]).state[0, Z] for each in more]


def test_a_wild_height_is_refused_and_one_that_is_said_again_believed():
    tracker = DiverTracker(DiverConfig(dimensions=3, max_tracks=1))
    wild, back, first, again = at_ten(
        tracker,
        [
            fix(21, -40.0, spatial(0.09)),
            fix(22, -10.0, spatial(0.09)),
            fix(23, -30.0, spatial(0.09)),
            fix(24, -30.2, spatial(0.09)),
        ],
    )
    assert wild == pytest.approx(-10.0, abs=1.0) and back == pytest.approx(-10.0, abs=1.0)
    assert first == pytest.approx(-10.0, abs=1.0) and again == pytest.approx(-30.2, abs=0.1)
    assert tracker._stream.state.memory['heights'][:2] == (23, 2)
    tracker.reset()
    assert tracker._stream.state.memory['heights'] == (0, 0, 0)


def test_heights_that_are_wild_all_the_time_are_said():
    tracker = DiverTracker(DiverConfig(dimensions=3, max_tracks=1, depth_max=100.0))
    fixes = [fix(k, -10.0 - 30.0 * (k % 3 == 0), spatial(0.09)) for k in range(1, 40)]
    assert last(tracker, fixes).state[0, Z] == pytest.approx(-10.0, abs=1.0)
    assert [text for text in tracker.warnings() if 'were rejected' in text]


@pytest.mark.parametrize('association', ['gnn', 'jipda'])
def test_two_divers_have_two_depths(association):
    tracker = DiverTracker(DiverConfig(dimensions=3, association=association))
    rng = np.random.default_rng(7)
    for k in range(1, 25):
        places = np.array([[0.5 * k, 0.0, -4.0], [0.5 * k, 8.0, -16.0]])
        covariance = np.tile(spatial(0.25), (2, 1, 1))
        places = places + rng.normal(size=(2, 3)) * [1.0, 1.0, 0.5]
        (estimate,) = tracker.process(
            Fixes(stamp_ns=k * 10**9, position=places, covariance=covariance)
        )
    assert np.sort(estimate.state[:, Z]) == pytest.approx([-16.0, -4.0], abs=0.8)


def test_a_start_may_state_how_deep():
    tracker = DiverTracker(DiverConfig(dimensions=3))
    start = Start(stamp_ns=10**9, position=[0.0, 0.0, -7.0], covariance=spatial(0.04))
    (estimate,) = tracker.process(start)
    assert estimate.state[0, Z] == pytest.approx(-7.0)
    assert estimate.covariance[0, Z, Z] == pytest.approx(0.04)


def test_latitude_and_longitude_and_what_a_transceiver_sees_bring_their_heights():
    origin = Origin(54.0, 10.0, 40.0)
    latitude, longitude, height = origin.geodetic(np.array([30.0, 40.0, -12.0])).tolist()
    settings = {
        'origin': (54.0, 10.0, 40.0), 'dimensions': 3, 'max_tracks': 1, 'vessel': 'fixed',
    }  # fmt: skip
    place = {'latitude': latitude, 'longitude': longitude, 'covariance': spatial(0.25)}
    geodetic = [GeodeticFix(stamp_ns=k * 10**9, height=height, **place) for k in range(1, 9)]
    estimate = last(DiverTracker(DiverConfig(**settings)), geodetic)
    assert estimate.state[0, Z] == pytest.approx(-12.0, abs=1e-3)
    flat = [GeodeticFix(stamp_ns=k * 10**9, **place) for k in range(1, 9)]
    assert last(DiverTracker(DiverConfig(**settings)), flat).covariance[0, Z, Z] > 25.0
    settings |= {'origin': (0.0, 0.0, 40.0)}
    seen = [RelativeFix(stamp_ns=k * 10**9, offset=[30.0, 40.0, -12.0]) for k in range(1, 9)]
    relative = last(DiverTracker(DiverConfig(**settings)), seen)
    assert relative.state[0, Z] == pytest.approx(-12.0, abs=0.1)
    assert relative.covariance[0, Z, Z] < 2.0


def banked(means, variances, weights, **settings):
    """One diver whose rows have these z, and its models."""
    config = DiverConfig(dimensions=3, model_set='heading_speed', **settings)
    tracker = DiverTracker(config)
    last(tracker, [fix(1.0, 0.0, np.eye(2), 20.0, 5.0)])
    known, h = tracker._stream.state, tracker.models.height
    (block,), mu = known.rows.blocks, np.full_like(known.rows.mu, 1.0 / known.rows.mu.shape[1])
    x, P = block.x.copy(), block.P.copy()
    x[:, h], P[:, h, h] = np.array(means)[:, None], np.array(variances)[:, None]
    P[:, 0, h] = P[:, h, 0] = 0.3 * np.sqrt(P[:, 0, 0] * P[:, h, h])
    logw = np.log(np.maximum(weights, np.exp(LEAST_LOG)))
    rows = known.rows.replace(blocks=(Gaussians(x, P),), mu=mu, logw=logw)
    return known.replace(rows=rows), tracker.models, tracker


def pings(path_std=0.3):
    """A ping heard on one receiver beside the transmitter."""
    at, variance = [18.0, 0.0, -3.0], (path_std / 1500.0) ** 2
    return arrivals(2 * 10**9, [[24.0, 0.0, -3.0]], [0.02], tx=at, var_toa=variance)


def after_spread(state, models, tracker, path_std=0.3):
    layout = tracker._layouts(state)
    seen = ping_measurements(pings(path_std), np.arange(1), tracker.config, models, layout)
    return respread_depths(state, seen, layout, models)


def test_copies_that_agree_are_spread_with_the_same_mean_and_covariance():
    state, models, tracker = banked([-9.5, -9.6, -2.0], [4.0, 3.5, 0.1], [0.6, 0.4, 0.0])
    after = after_spread(state, models, tracker)
    maps = tuple(part.outputs for part in models.parts)
    for before, now in zip(track_outputs(state.rows, maps), track_outputs(after.rows, maps)):
        assert now == pytest.approx(before, abs=1e-9)
    x, P = models.to_common(after.rows.blocks)
    assert np.diff(x[:, 0, models.height]) == pytest.approx([2.0, 2.0], abs=0.1)
    assert after.rows.weight == pytest.approx(np.full(3, 1 / 3))
    assert after.rows.model_probabilities() == pytest.approx(state.rows.model_probabilities())
    assert (np.linalg.eigvalsh(P) > 0.0).all() and after['respreads'].tolist() == [1]


@pytest.mark.parametrize(
    'means, variances, path_std',
    [
        ([-3.0, -10.0, -17.0], [4.8, 4.8, 4.8], 0.3),  # they do not agree
        ([-9.5, -9.6, -9.4], [0.1, 0.1, 0.1], 0.3),  # nothing bends within what they believe
        ([-9.5, -9.6, -9.4], [4.0, 4.0, 4.0], 10.0),  # it does, but not to see
    ],
)
def test_other_copies_stay(means, variances, path_std):
    state, models, tracker = banked(means, variances, [0.4, 0.3, 0.3])
    after = after_spread(state, models, tracker, path_std)
    assert after.rows is state.rows and not after['respreads'].any()


@pytest.mark.parametrize(
    'means, variances, weights, two',
    [
        ([-3.3, -10.0, -16.7], [4.8, 4.8, 4.8], [0.34, 0.33, 0.33], False),  # the whole column
        ([-3.3, -10.0, -16.7], [4.8, 4.8, 4.8], [0.5, 0.0, 0.5], True),
        ([-2.0, -2.1, -8.0], [0.2, 0.2, 0.2], [0.4, 0.4, 0.2], True),
        ([-2.0, -2.1, -8.0], [0.2, 0.2, 0.2], [0.5, 0.49, 0.01], False),
        ([-8.0, -2.0, -5.0], [0.2, 0.2, 2.0], [0.3, 0.3, 0.4], False),
    ],
)
def test_two_depths_are_said_where_there_is_a_gap_between_them(means, variances, weights, two):
    state, models, _ = banked(means, variances, weights)
    assert ambiguous_depths(state, models).tolist() == [two]


def past_the_transmitter(seed):
    """A scene whose diver comes near the transmitter from afar, and its places by stamp."""
    changes = {
        'receiver_depths': (2.0, 5.0, 8.0, 12.0),
        'depth': (1.0, 19.0),
        'swell_height': 1.0,
        'random_rotation': False,
        'start': (-40.0, 40.0),
    }
    scene = simulate(scenario('multistatic', changes), seed)
    (track,) = scene.truth[:1]
    return scene, dict(zip(track.stamp_ns.tolist(), track.position))


def errors(estimates, places, settled):
    """Errors in z and NEES of three coordinates, from `settled` stamps on."""
    rows = []
    for estimate in [each for each in estimates if len(each.state)][settled:]:
        error = estimate.state[0, :3] - places[estimate.stamp_ns][:3]
        rows.append([error[2], error @ np.linalg.solve(estimate.covariance[0, :3, :3], error)])
    return np.array(rows)


@pytest.mark.parametrize(
    'settings, two',
    [
        ({'dimensions': 3}, True),
        ({'dimensions': 3, 'depth_min': 4.0, 'depth_max': 4.0}, None),
        ({'dimensions': 2}, None),
    ],
)
def test_paths_alone_tell_no_depth_above_from_one_below_the_receivers(settings, two):
    rx, place = RECEIVERS - [0.0, 0.0, 10.0], np.array([30.0, 40.0, -4.0])
    path = np.linalg.norm(rx - place, axis=1) + np.linalg.norm(rx[0] - place)
    tracker = DiverTracker(DiverConfig(max_tracks=1, **settings))
    for second in range(1, 9):
        ping = arrivals(second * 10**9, rx, path / 1500.0, tx=rx[0])
        (estimate,) = tracker.process(ping)
    said = estimate.extras.get('depth_ambiguous')
    assert (said is None) if two is None else said.tolist() == [two]


def test_depth_hypotheses_neither_exchange_weight_nor_borrow():
    """They are states: one that has become improbable stays, and time alone moves no weight."""
    scene = simulate(scenario('at_depth'), 3)
    tracker = DiverTracker(DiverConfig(dimensions=3))
    for item in scene.measurements:
        tracker.process(item.measurement)
        known = tracker._stream.state
        assert len(known.rows) == START_DEPTHS * len(known) and not len(known.borrowed)
    improbable = known.rows.replace(logw=np.log([1e-6, 0.5, 0.5 - 1e-6]))
    assert protected_rows(improbable).all()
    scan = Scan.from_items([], tracker.config)
    after = tracker._predict(known, scan, known.stamp_ns + 10**9)
    np.testing.assert_array_equal(after.rows.logw, known.rows.logw)


@pytest.mark.parametrize('seed', [1017, 1018])
def test_a_dive_past_the_transmitter_does_not_end_on_the_wrong_side(seed):
    # Rows that had met went to the wrong side here: NEES 621 and 44.
    scene, places = past_the_transmitter(seed)
    settings = {'model_set': 'heading_speed', 'max_tracks': 1, 'dimensions': 3}
    tracker = SmoothingDiverTracker(DiverConfig(**settings))
    pings = [item.measurement for item in scene.measurements]
    found = [estimate for ping in pings for estimate in tracker.process(ping)]
    filtered, smoothed = (errors(each, places, 10) for each in (found, tracker.smoothed()))
    assert filtered[:, 1].mean() < 6.0 and np.abs(filtered[-20:, 0]).max() < 3.0
    assert np.isfinite(smoothed).all()
    assert np.square(smoothed[:, 0]).mean() < 1.1 * np.square(filtered[:, 0]).mean()


def test_a_track_that_was_somewhere_else_begins_anew_with_all_its_rows():
    """An update that is all but impossible tells nothing of the depth: the ping alone does."""
    scene, places = past_the_transmitter(1043)
    config = DiverConfig(model_set='heading_speed', max_tracks=1, dimensions=3)
    tracker = DiverTracker(config)
    pings = [item.measurement for item in scene.measurements][:20]
    for ping in pings:
        tracker.process(ping)
    known, ping = tracker._stream.state, pings[-1]
    free, layout = np.zeros(len(ping), bool), Instruments().layout(config, tracker.models)
    for nis, again in ((10.0, 0), (1e3, 1)):
        known = known.with_columns(nis=np.array([nis]), nis_dof=np.array([4], np.uint16))
        after = restart_track(known, ping, free, tracker.models, layout, config)
        assert after['respreads'][0] - known['respreads'][0] == again
    assert len(after.rows) == START_DEPTHS and (after.rows.parent == -1).all()
    mean, covariance = published_state(after, tracker.models, 0.05)
    error = mean[0, :3] - places[ping.stamp_ns][:3]
    assert error @ np.linalg.solve(covariance[0, :3, :3], error) < 12.0
