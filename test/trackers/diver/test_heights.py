# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""z of fixes, against linear Kalman filters, in its statistics and where it is wrong; rows of
a track that are spread over depth, or over the two sides of a line."""

import math

from attrs import evolve
from helpers.diver_runs import arrivals, both_sides, followed, miss, numbers_of, SECOND
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.estimation.gauss_markov import gauss_markov
from sonar_imm.estimation.rows import LEAST_LOG
from sonar_imm.measurements import Fix, Fixes, GeodeticFix, RelativeFix, Start
from sonar_imm.trackers.diver import sides
from sonar_imm.trackers.diver.births import restart_track
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.depth import ambiguous_depths, respread_depths
from sonar_imm.trackers.diver.estimate import published_state
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.known import track_outputs
from sonar_imm.trackers.diver.models import build_models, START_DEPTHS
from sonar_imm.trackers.diver.scales import protected_rows
from sonar_imm.trackers.diver.scan import Scan
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate

CV = {'model_set': 'linear', 'association': 'gnn', 'gate_probability': 0.999999}
ONE = {'dimensions': 3, 'max_tracks': 1}
Z, W = 2, 5
"""Of z and its rate in the published state."""
WHOLE, GAP = ([-3.3, -10.0, -16.7], [4.8] * 3), ([-2.0, -2.1, -8.0], [0.2] * 3)
"""Means and variances that fill the column, and of two depths."""
PAST = {
    'receiver_depths': (2.0, 5.0, 8.0, 12.0), 'depth': (1.0, 19.0), 'swell_height': 1.0,
    'random_rotation': False, 'start': (-40.0, 40.0),
}  # fmt: skip
ASKING = np.array([[-40.0, 0.0, 0.0], [40.0, 0.0, 0.0], [10.0, 70.0, 0.0]])
TURNED = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
"""By an angle between two headings of the models."""


def spatial(variance, *across):
    """(3, 3) with unit variances of x and y."""
    covariance = np.diag([1.0, 1.0, variance])
    for axis, value in enumerate(across):
        covariance[2, axis] = covariance[axis, 2] = value
    return covariance


def fix(second, z, covariance, x=0.0, y=0.0, **more):
    return Fix(stamp_ns=round(second * SECOND), position=(x, y, z), covariance=covariance, **more)


def scan(second, places, covariance):
    P = np.tile(covariance, (len(places), 1, 1))
    return Fixes(stamp_ns=second * SECOND, position=places, covariance=P)


def last(fixes, tracker=None, **settings):
    return followed(tracker or DiverTracker(DiverConfig(**settings)), fixes)[-1]


def test_alone_z_is_a_linear_kalman_filter():
    rng, config = np.random.default_rng(0), DiverConfig(**ONE, **CV)
    tracker, variance = DiverTracker(config), 0.3
    seconds = np.cumsum(rng.uniform(0.3, 1.9, 40))
    z = -25.0 + rng.normal(size=40)
    mean, P = np.array([z[0], 0.0]), np.diag([variance, config.vertical_speed_std**2])
    for k, second in enumerate(seconds):
        estimate = last([fix(second, z[k], spatial(variance))], tracker)
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
    rng, config = np.random.default_rng(1), DiverConfig(**ONE, **CV, fix_bias_std=0.5)
    tracker, models = DiverTracker(config), build_models(config)
    R, h, E = spatial(0.5, 0.6, -0.3), models.height, models.E[0]
    H = np.vstack([models.fix_matrix[0], np.eye(models.n)[h]])
    for second in range(1, 30):
        z = rng.multivariate_normal([0.2 * second, 0.0, -10.0], R)
        estimate = last([fix(second, z[2], R, *z[:2])], tracker)
        if second == 1:
            x0, P0, _ = models.initial_states(z[None, :2], R[None, :2, :2])
            mean, P = x0[0, 0, 0], P0[0, 0, 0]
            mean[h], P[h, h], P[h, :2], P[:2, h] = z[2], R[2, 2], R[2, :2], R[2, :2]
        else:
            F, Q = (part[0] for part in models.motion(1.0)[:2])
            mean, P = F @ mean, F @ P @ F.T + Q
            gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            mean, P = mean + gain @ (z - H @ mean), P - gain @ H @ P
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
        places = dive(rng)
        scans = (scan(k, rng.multivariate_normal(p, R)[None], R) for k, p in enumerate(places, 1))
        made = followed(DiverTracker(DiverConfig(**ONE, association=association)), scans)
        for estimate, place in zip(made[10:], places[10:]):
            if len(estimate):
                nees.append(miss(estimate, place)[1])
                depth.append(estimate.state[0, 2] - place[2])
    assert len(nees) > 380 and 2.0 < np.mean(nees) < 4.0
    assert np.sqrt(np.mean(np.square(depth))) < 0.5


@pytest.mark.parametrize('settings', [{'association': 'gnn'}, {'depth_max': 40.0}])
def test_a_fix_says_how_deep_a_diver_is_below_the_stated_column_too(settings):
    rng = np.random.default_rng(3)
    tracker = DiverTracker(DiverConfig(dimensions=3, **settings))
    places = np.array([0.0, 0.0, -25.0]) + rng.normal(size=(40, 3)) * [1.0, 1.0, 0.5]
    estimate = last([scan(k, [p], spatial(0.25)) for k, p in enumerate(places, 1)], tracker)
    sd = math.sqrt(estimate.covariance[0, Z, Z])
    assert abs(estimate.state[0, Z] + 25.0) < 3.0 * sd and sd < 0.3
    warned = any('outside depth_min' in sentence for sentence in tracker.warnings())
    assert warned == ('depth_max' not in settings)


def test_what_is_less_than_the_water_column_says_does_not_replace_it():
    estimate = last([fix(1.0, -9.0, spatial(1e4))], dimensions=3)
    assert estimate.state[0, Z] == pytest.approx(-10.0)
    assert estimate.covariance[0, Z, Z] < 40.0


@pytest.mark.parametrize('covariance', [
    np.eye(2), *map(spatial, (math.nan, 0.0, -1.0, 1e6)), spatial(0.25, 0.6),
    spatial(0.25, 0.4, 0.4), spatial(0.25, math.nan),
])  # fmt: skip
def test_what_states_no_height_that_can_be_true_changes_no_bit(covariance):
    def run(stated, dimensions=3):
        fixes = [fix(k, -5.0, stated, 0.5 * k) for k in range(1, 8)]
        return last(fixes, dimensions=dimensions)

    # Two dimensions take no notice of any.
    assert run(spatial(0.25, 0.3), 2).state.tobytes() == run(covariance, 2).state.tobytes()
    plain, found = run(np.eye(2)), run(covariance)
    assert found.state.tobytes() == plain.state.tobytes()
    assert found.covariance.tobytes() == plain.covariance.tobytes()
    assert found.covariance[0, Z, Z] > 25.0


def test_a_wild_height_is_refused_and_one_that_is_said_again_believed():
    tracker, R = DiverTracker(DiverConfig(**ONE)), spatial(0.09)
    noise = np.random.default_rng(5).normal(size=(21, 3)) * 0.3
    fixes = [fix(k, -10.0 + noise[k, 2], R, *noise[k, :2]) for k in range(1, 21)]
    fixes += [fix(21 + k, z, R) for k, z in enumerate((-40.0, -10.0, -30.0, -30.2))]
    *before, again = (made.state[0, Z] for made in followed(tracker, fixes)[20:])
    assert before == pytest.approx([-10.0] * 3, abs=1.0) and again == pytest.approx(-30.2, abs=0.1)
    assert tracker._stream.state.memory['heights'][:2] == (23, 2)
    tracker.reset()
    assert tracker._stream.state.memory['heights'] == (0, 0, 0)


def test_heights_that_are_wild_all_the_time_are_said():
    tracker = DiverTracker(DiverConfig(**ONE, depth_max=100.0))
    fixes = [fix(k, -10.0 - 30.0 * (k % 3 == 0), spatial(0.09)) for k in range(1, 40)]
    assert last(fixes, tracker).state[0, Z] == pytest.approx(-10.0, abs=1.0)
    assert [text for text in tracker.warnings() if 'were rejected' in text]


@pytest.mark.parametrize('association', ['gnn', 'jipda'])
def test_two_divers_have_two_depths(association):
    rng, scans = np.random.default_rng(7), []
    for k in range(1, 25):
        places = np.array([[0.5 * k, 0.0, -4.0], [0.5 * k, 8.0, -16.0]])
        scans.append(scan(k, places + rng.normal(size=(2, 3)) * [1.0, 1.0, 0.5], spatial(0.25)))
    estimate = last(scans, dimensions=3, association=association)
    assert np.sort(estimate.state[:, Z]) == pytest.approx([-16.0, -4.0], abs=0.8)


def test_a_start_may_state_how_deep():
    start = Start(stamp_ns=SECOND, position=[0.0, 0.0, -7.0], covariance=spatial(0.04))
    estimate = last([start], dimensions=3)
    assert estimate.state[0, Z] == pytest.approx(-7.0)
    assert estimate.covariance[0, Z, Z] == pytest.approx(0.04)


def test_latitude_and_longitude_and_what_a_transceiver_sees_bring_their_heights():
    spot = np.array([30.0, 40.0, -12.0])
    origin, stamps = (54.0, 10.0, 40.0), [k * SECOND for k in range(1, 9)]
    place = dict(zip(('latitude', 'longitude', 'height'), Origin(*origin).geodetic(spot).tolist()))
    place['covariance'] = spatial(0.25)
    geodetic = [GeodeticFix(stamp_ns=stamp, **place) for stamp in stamps]
    assert last(geodetic, **ONE, origin=origin).state[0, Z] == pytest.approx(-12.0, abs=1e-3)
    flat = [evolve(each, height=math.nan) for each in geodetic]
    assert last(flat, **ONE, origin=origin).covariance[0, Z, Z] > 25.0
    seen = [RelativeFix(stamp_ns=stamp, offset=spot) for stamp in stamps]
    relative = last(seen, **ONE, origin=(0.0, 0.0, 40.0), vessel='fixed')
    assert relative.state[0, Z] == pytest.approx(-12.0, abs=0.1)
    assert relative.covariance[0, Z, Z] < 2.0


def banked(means, variances, weights, **settings):
    """One diver whose rows have these z, and its models."""
    tracker = DiverTracker(DiverConfig(dimensions=3, model_set='heading_speed', **settings))
    tracker.process(fix(1.0, 0.0, np.eye(2), 20.0, 5.0))
    known, h = tracker._stream.state, tracker.models.height
    (block,), mu = known.rows.blocks, np.full_like(known.rows.mu, 1.0 / known.rows.mu.shape[1])
    x, P = block.x.copy(), block.P.copy()
    x[:, h], P[:, h, h] = np.array(means)[:, None], np.array(variances)[:, None]
    P[:, 0, h] = P[:, h, 0] = 0.3 * np.sqrt(P[:, 0, 0] * P[:, h, h])
    logw = np.log(np.maximum(weights, np.exp(LEAST_LOG)))
    rows = known.rows.replace(blocks=(Gaussians(x, P),), mu=mu, logw=logw)
    return known.replace(rows=rows), tracker


def after_spread(state, tracker, path_std=0.3):
    """The state after a ping heard on one receiver beside the transmitter."""
    known = {'tx': [18.0, 0.0, -3.0], 'var_toa': (path_std / 1500.0) ** 2}
    ping = arrivals(2 * SECOND, [[24.0, 0.0, -3.0]], [0.02], **known)
    layout, models = tracker._layouts(state), tracker.models
    seen = numbers_of(ping, tracker.config, models, layout)
    return respread_depths(state, seen, layout, models)


def test_copies_that_agree_are_spread_with_the_same_mean_and_covariance():
    state, tracker = banked([-9.5, -9.6, -2.0], [4.0, 3.5, 0.1], [0.6, 0.4, 0.0])
    after, models = after_spread(state, tracker), tracker.models
    maps = tuple(part.outputs for part in models.parts)
    for before, now in zip(track_outputs(state.rows, maps), track_outputs(after.rows, maps)):
        assert now == pytest.approx(before, abs=1e-9)
    x, P = models.to_common(after.rows.blocks)
    assert np.diff(x[:, 0, models.height]) == pytest.approx([2.0, 2.0], abs=0.1)
    assert after.rows.weight == pytest.approx(np.full(3, 1 / 3))
    assert after.rows.model_probabilities() == pytest.approx(state.rows.model_probabilities())
    assert (np.linalg.eigvalsh(P) > 0.0).all() and after['respreads'].tolist() == [1]


@pytest.mark.parametrize('means, variance, path_std', [
    ([-3.0, -10.0, -17.0], 4.8, 0.3),  # they do not agree
    ([-9.5, -9.6, -9.4], 0.1, 0.3),  # nothing bends within what they believe
    ([-9.5, -9.6, -9.4], 4.0, 10.0),  # it does, but not to see
])  # fmt: skip
def test_other_copies_stay(means, variance, path_std):
    state, tracker = banked(means, [variance] * 3, [0.4, 0.3, 0.3])
    after = after_spread(state, tracker, path_std)
    assert after.rows is state.rows and not after['respreads'].any()


@pytest.mark.parametrize('means, variances, weights, two', [
    (*WHOLE, [0.34, 0.33, 0.33], False), (*WHOLE, [0.5, 0.0, 0.5], True),
    (*GAP, [0.4, 0.4, 0.2], True), (*GAP, [0.5, 0.49, 0.01], False),
    ([-8.0, -2.0, -5.0], [0.2, 0.2, 2.0], [0.3, 0.3, 0.4], False),
])  # fmt: skip
def test_two_depths_are_said_where_there_is_a_gap_between_them(means, variances, weights, two):
    state, tracker = banked(means, variances, weights)
    assert ambiguous_depths(state, tracker.models).tolist() == [two]


def past_the_transmitter(seed):
    """Pings of a diver who comes near the transmitter from afar, and his places by stamp."""
    scene = simulate(scenario('multistatic', PAST), seed)
    (track,) = scene.truth[:1]
    places = dict(zip(track.stamp_ns.tolist(), track.position))
    return [item.measurement for item in scene.measurements], places


@pytest.mark.parametrize('settings, two', [
    ({'dimensions': 3}, [True]), ({'dimensions': 2}, None),
    ({'dimensions': 3, 'depth_min': 4.0, 'depth_max': 4.0}, None),
])  # fmt: skip
def test_paths_alone_tell_no_depth_above_from_one_below_the_receivers(settings, two):
    rx, place = RECEIVERS - [0.0, 0.0, 10.0], np.array([30.0, 40.0, -4.0])
    path = np.linalg.norm(rx - place, axis=1) + np.linalg.norm(rx[0] - place)
    pings = [arrivals(k * SECOND, rx, path / 1500.0, tx=rx[0]) for k in range(1, 9)]
    said = last(pings, max_tracks=1, **settings).extras.get('depth_ambiguous')
    assert (said if said is None else said.tolist()) == two


def test_depth_hypotheses_neither_exchange_weight_nor_borrow():
    """They are states: one that has become improbable stays, and time alone moves no weight."""
    tracker = DiverTracker(DiverConfig(dimensions=3))
    for item in simulate(scenario('at_depth'), 3).measurements:
        tracker.process(item.measurement)
        known = tracker._stream.state
        assert len(known.rows) == START_DEPTHS * len(known) and not len(known.borrowed)
    improbable = known.rows.replace(logw=np.log([1e-6, 0.5, 0.5 - 1e-6]))
    assert protected_rows(improbable).all()
    scan = Scan.from_items([], tracker.config)
    after = tracker._predict(known, scan, known.stamp_ns + SECOND)
    np.testing.assert_array_equal(after.rows.logw, known.rows.logw)


@pytest.mark.parametrize('seed', [1017, 1018])
def test_a_dive_past_the_transmitter_does_not_end_on_the_wrong_side(seed):
    # Rows that had met went to the wrong side here: NEES 621 and 44.
    pings, places = past_the_transmitter(seed)
    tracker = SmoothingDiverTracker(DiverConfig(**ONE, model_set='heading_speed'))
    found = [each for each in followed(tracker, pings) if len(each)][10:]
    depths = []
    for made in (found, [each for each in tracker.smoothed() if len(each)][10:]):
        depths.append(np.array([each.state[0, 2] - places[each.stamp_ns][2] for each in made]))
        nees = np.array([miss(each, places[each.stamp_ns])[1] for each in made])
        assert np.isfinite(nees).all() and (made is not found or nees.mean() < 6.0)
    filtered, smoothed = depths
    assert np.abs(filtered[-20:]).max() < 3.0
    assert np.square(smoothed).mean() < 1.1 * np.square(filtered).mean()


def test_a_track_that_was_somewhere_else_begins_anew_with_all_its_rows():
    """An update that is all but impossible tells nothing of the depth: the ping alone does."""
    pings, places = past_the_transmitter(1043)
    config = DiverConfig(**ONE, model_set='heading_speed')
    tracker = DiverTracker(config)
    followed(tracker, pings[:20])
    known, ping = tracker._stream.state, pings[19]
    free, layout = np.zeros(len(ping), bool), Instruments().layout(config, tracker.models)
    for nis, again in ((10.0, 0), (1e3, 1)):
        known = known.with_columns(nis=np.array([nis]), nis_dof=np.array([4], np.uint16))
        after = restart_track(known, ping, free, tracker.models, layout, config)
        assert after['respreads'][0] - known['respreads'][0] == again
    assert len(after.rows) == START_DEPTHS and (after.rows.parent == -1).all()
    mean, covariance = published_state(after, tracker.models, 0.05)
    error = mean[0, :3] - places[ping.stamp_ns][:3]
    assert error @ np.linalg.solve(covariance[0, :3, :3], error) < 12.0


def transponders(second, position, rng, count, std=0.5):
    """Two-way transponders of transponders that the first `count` receivers ask."""
    rx = ASKING[:count].copy()
    rx[:, :2] = rx[:, :2] @ TURNED.T
    path = 2.0 * np.linalg.norm(np.append(position, 0.0) - rx, axis=1)
    return arrivals(
        round(second * SECOND), rx, (path + 2.0 * std * rng.normal(size=count)) / 1500.0,
        tx_id=np.arange(count) + 1, tx=rx, var_toa=(2.0 * std / 1500.0) ** 2, var_bearing=0.01,
    )  # fmt: skip


def positions(steps, start=(-25.0, 30.0), velocity=(0.6, 0.2)):
    at = np.array(start) + np.arange(steps)[:, None] * np.array(velocity)
    return at @ TURNED.T


def layout_of(config):
    return Instruments().layout(config, build_models(config))


def test_the_image_is_that_of_an_independent_prototype():
    config = DiverConfig(covariance_scales=(1.0,))
    models, layout = build_models(config), layout_of(config)
    found = load_vectors('diver_in_the_field/mirror')
    x, P, a, b = (found[name] for name in ('x', 'P', 'a', 'b'))
    line = sides.line_through(np.array([a, b]), 0.5)
    quiet = np.eye(len(models.names))[-1]
    each = np.tile(x, (len(quiet), 1)), np.tile(P, (len(quiet), 1, 1))
    parts = (part[None, None] for part in (*each, quiet))
    rows = models.make_rows(*parts, np.zeros((1, 1)))
    rows = sides.with_images(rows, 0, models, layout, line)
    parts = rows.blocks[1].x[..., -1], rows.blocks[1].P[..., -1]
    mean, covariance = rows.combine(*parts, rows.weight)
    np.testing.assert_allclose(parts[0][1], found['mirrored_x'], atol=1e-12)
    np.testing.assert_allclose(parts[1][1], found['mirrored_P'], atol=1e-12)
    np.testing.assert_allclose(mean[0], found['mean'], atol=1e-12)
    np.testing.assert_allclose(covariance[0], found['cov'], atol=1e-10)
    np.testing.assert_allclose(rows.weight, 0.5)


@pytest.mark.parametrize('model_set', ['families', 'heading_speed'])
@pytest.mark.parametrize('angle', [0.0, 2.0])
def test_the_image_of_an_image_of_a_line_along_a_heading_is_the_row_itself(model_set, angle):
    """Else it lies between two models: position, mean speed and weights of families stay."""
    config = DiverConfig(model_set=model_set, covariance_scales=(1.0,), dimensions=3)
    models, layout = build_models(config), layout_of(evolve(config, receiver_position_std=1.0))
    rng, M, n = np.random.default_rng(3), len(models.names), models.n
    x, _, _ = models.initial_states(np.array([[3.0, 7.0]]), np.eye(2)[None])
    x = x[0, 0] + 0.1 * rng.normal(size=(M, n))
    root = rng.normal(size=(M, n, n))
    P, mu = root @ np.swapaxes(root, 1, 2) + np.eye(n), rng.dirichlet(np.ones(M))
    table = models.make_rows(*(part[:1] for part in _full(models)))
    blocks = models.to_blocks(x[None], P[None])
    rows = evolve(table.select(np.arange(1)), blocks=blocks, mu=mu[None])
    line = sides.Line(np.array([1.0, 2.0]), np.array([np.cos(angle), np.sin(angle)]))
    image = sides.mirror_rows(rows, models, layout, line)
    again = sides.mirror_rows(image, models, layout, line)
    maps = tuple(part.outputs for part in models.parts)
    before, once, twice = (sides.row_outputs(each, maps)[0][0] for each in (rows, image, again))
    np.testing.assert_allclose(line.image(before[:2]), once[:2], atol=1e-9)
    np.testing.assert_allclose(before[:3], twice[:3], atol=1e-9)
    assert image.mu.sum() == pytest.approx(1.0)
    for block in image.blocks:
        assert (np.linalg.eigvalsh(np.moveaxis(block.P, -1, 1)) > 0.0).all()
    if angle == 0.0:
        np.testing.assert_allclose(again.mu, rows.mu, atol=1e-12)
        for ours, theirs in zip(again.blocks, rows.blocks):
            np.testing.assert_allclose(ours.x, theirs.x, atol=1e-9)
            np.testing.assert_allclose(ours.P, theirs.P, atol=1e-9)


def _full(models):
    x, P, mu = models.initial_states(np.zeros((1, 2)), np.eye(2)[None])
    return x, P, mu, np.zeros(x.shape[:2])


def test_two_receivers_leave_the_side_open_and_say_so():
    rng, tracker = np.random.default_rng(1), DiverTracker(DiverConfig())
    path = positions(40)
    estimates = followed(tracker, [transponders(k + 1, p, rng, 2) for k, p in enumerate(path)])
    line = sides.Line(np.zeros(2), TURNED[:, 0])
    for place, estimate in list(zip(path, estimates))[5:]:
        assert len(estimate) == 1
        assert estimate.extras['side_probability'][0] == pytest.approx(0.5, abs=1e-9)
        image, other = both_sides(estimate)
        assert min(np.hypot(*(side - place)) for side in (image, other)) < 3.0
        np.testing.assert_allclose(line.image(image), other, atol=1.0)
        assert miss(estimate, place)[1] < 9.0
    assert sides.NOT_TOLD in tracker.warnings()


def bearing_of(second, place, rng):
    bearing = np.arctan2(*(place - TURNED @ ASKING[0, :2])[::-1])
    return evolve(transponders(second, place, rng, 2), bearing=np.array([bearing, np.nan]))


DECIDING = {
    'receiver': lambda *at: transponders(*at, 3), 'bearing': bearing_of,
    'fix': lambda second, place, _: fix(second, 0.0, np.eye(2), *place, frame_id='map'),
}  # fmt: skip


@pytest.mark.parametrize('what', DECIDING)
def test_a_third_receiver_or_a_bearing_or_a_fix_decides(what):
    path, rng = positions(14), np.random.default_rng(2)
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    *_, before = followed(tracker, [transponders(k + 1, path[k], rng, 2) for k in range(10)])
    assert np.isfinite(before.extras['side_probability'][0])
    # One arrival alone may be wild.
    *_, after = followed(tracker, [DECIDING[what](k + 1, path[k], rng) for k in range(10, 13)])
    assert np.isnan(after.extras['side_probability'][0])
    assert np.isnan(after.extras['mirror_x'][0])
    assert miss(after, path[12])[0] < 3.0
    assert after.extras['track_id'].tolist() == before.extras['track_id'].tolist()
    assert sides.NOT_TOLD not in tracker.warnings()


def test_who_crosses_the_line_is_in_doubt_again():
    rng, tracker = np.random.default_rng(5), DiverTracker(DiverConfig(max_tracks=1))
    path = positions(60, start=(-20.0, 15.0), velocity=(0.3, -0.6))
    pings = [transponders(k + 1, p, rng, 3 if k < 10 else 2) for k, p in enumerate(path)]
    made = followed(tracker, pings)
    known = [bool(np.isnan(each.extras['side_probability'][0])) for each in made]
    assert max(miss(*pair)[1] for pair in zip(made[6:], path[6:])) < 14.0
    assert all(known[3:18]) and not any(known[35:])
    assert made[-1].extras['side_probability'][0] < 0.99


def test_what_is_a_line():
    def line_of(places, error):
        return sides.line_through(np.array(places), error)

    line = line_of([[0.0, 0.0], [10.0, 10.0], [20.0, 20.1]], 0.3)
    assert line.tells_nothing and abs(line.across @ [1.0, 1.0]) < 0.01
    assert not line_of([[0.0, 0.0], [50.0, 0.8], [100.0, 0.0]], 0.1).tells_nothing
    none = [[0.0, 0.0], [50.0, 20.0], [100.0, 0.0]], [[5.0, 5.0], [5.0, 5.0]], [[5.0, 5.0]]
    assert all(line_of(places, 0.3) is None for places in none)


def test_a_block_of_one_model_keeps_its_covariance():
    """The spread of a share is added where two headings share one image."""
    config = DiverConfig(model_set='heading_speed')
    models = build_models(config)
    x, P, mu, logw = _full(models)
    rows = models.make_rows(x, P, np.broadcast_to(np.eye(mu.shape[-1])[0], mu.shape), logw)
    turned = 0.5 * np.radians(7.0)
    line = sides.Line(np.zeros(2), np.array([np.cos(turned), np.sin(turned)]))
    image = sides.mirror_rows(rows, models, layout_of(config), line)
    assert image.mu[0, :2] == pytest.approx([1.0 - 7.0 / 22.5, 7.0 / 22.5])
    assert isinstance(image.blocks[0], Gaussians)
