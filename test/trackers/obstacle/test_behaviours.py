# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What obstacles do, and the arithmetic of it against readable forms, brute force and sampling."""

from types import SimpleNamespace

from attrs import evolve
from helpers import obstacle_runs as runs
from helpers.estimates import same
from helpers.obstacle_runs import echoes, level, NO_NOISE, run, SECOND, still, track_scene
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr
from scipy.stats import multivariate_normal as normal

from benchmarks.false_warnings import detected
from benchmarks.obstacle_sea import truth_tables
from benchmarks.study import final_estimates, truths
from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Navigation
from sonar_imm.trackers.obstacle import filters, mixtures, unscented
from sonar_imm.trackers.obstacle.bodies import Bodies, CENTRE, with_common_errors
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker
from sonar_imm_tools.evaluation.obstacle.scoring import score
from sonar_imm_tools.evaluation.obstacle.series import series_of, truth_of
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle


def test_crossing_in_clutter_while_another_is_born():
    """Of two obstacles that cross 9 in 10 echoes come, among three false ones a ping; a third one
    that stands still comes into view."""
    rng, measurements = np.random.default_rng(3), []
    velocity = np.array([[0.0, 0.5], [0.0, -0.5], [0.0, 0.0]])
    start = np.array([[70.0, -10.0], [72.0, 10.0], [84.0, 12.0]])
    for k in range(80):
        t, stamp = 0.5 * k, SECOND + k * SECOND // 2
        off = start + t * velocity - [t, 0.0]
        z = np.column_stack([np.hypot(*off.T), np.arctan2(off[:, 1], off[:, 0])])
        z += rng.normal(size=(3, 2)) * [0.1, 0.003]
        there = rng.uniform(size=3) < np.where([True, True, k >= 30], 0.9, 0.0)
        false = rng.uniform([5.0, -0.39], [99.0, 0.39], (rng.poisson(3.0), 2))
        measurements += [still(stamp, t), echoes(stamp, [*z[there], *false])]
    estimates = runs.track(measurements)

    def confirmed(estimate):
        return set(estimate.extras['track_id'][estimate.extras['track_state'] > 0].tolist())

    two = confirmed(estimates[25])
    assert len(two) == 2 and all(two <= confirmed(each) for each in estimates[25:])
    (born,) = confirmed(estimates[50]) - two
    last = estimates[-1].extras
    assert len(confirmed(estimates[-1]) - {born, *two}) <= 1
    stated = dict(zip(last['track_id'].tolist(), np.column_stack([last['vx'], last['vy']])))
    assert np.linalg.norm(stated[born]) < 0.05
    assert sorted(stated[k][1] for k in two) == pytest.approx([-0.5, 0.5], abs=0.1)


def test_a_drifting_navigation_is_said():
    """The ground moves under a log that measures against the water: all obstacles move alike."""
    overrides = {'clutter': 0.0, 'detection_probability': 1.0}
    scene = simulate(scenario('six', overrides), 1)
    first = scene.measurements[0].measurement.stamp_ns
    for drift in ([0.3, 0.1, 0.0], [0.0, 0.0, 0.0]):
        tracker, most = ObstacleTracker(ObstacleConfig()), 0
        for item in scene.measurements:
            measurement = item.measurement
            if isinstance(measurement, Navigation):
                off = (measurement.stamp_ns - first) / SECOND * np.array(drift)
                measurement = evolve(measurement, position=measurement.position + off)
            tracker.process(measurement)
            most = max(most, tracker.health()['moving_alike'])
        pings = tracker.health()['pings_moving_alike']
        assert most == 1 and pings > 10 if any(drift) else most == pings == 0


def test_the_order_of_the_behaviours_does_not_matter():
    _, first = track_scene('swaying', 1, {'last_range': 70.0}, behaviours=('fixed', 'swaying'))
    _, other = track_scene('swaying', 1, {'last_range': 70.0}, behaviours=('swaying', 'fixed'))
    assert list(first) == list(other) and all(same(first[k], other[k]) for k in first)


def test_what_sways_farther_counts_as_swaying():
    """Seen from outside there are three behaviours; how far an obstacle sways never changes."""
    filter_ = filters.BehaviourSlices(ObstacleConfig())
    chain = filter_._transition(0.5)
    change = chain[0, 4]
    fixed, near, far, _, begun_moving = range(5)
    assert_allclose(chain.sum(axis=1), 1.0, rtol=1e-15)
    assert chain[near, far] == chain[far, near] == 0.0
    assert chain[fixed, near] + chain[fixed, far] == pytest.approx(change)
    assert chain[near, begun_moving] == chain[far, begun_moving] == change
    assert change == pytest.approx(0.5 * 0.5 / 1000.0, rel=1e-3)
    begun = filter_.begin(*SEEN, level(altitude=15.0))
    assert_allclose(filter_.behaviour(begun.mu)[0], [0.54, 0.18, 0.18, 0.1])


def test_how_far_an_obstacle_sways_need_not_be_known(monkeypatch):
    """A metre, twice what `sway_std` says: eight obstacles at 30 m."""
    values = {'obstacle_sway': 1.0, 'obstacles': 8, 'spacing': 8.0, 'last_range': -30.0}
    nees, inside = [], []
    for share in (filters.WIDE_SHARE, 1e-12):
        monkeypatch.setattr(filters, 'WIDE_SHARE', share)
        scene, final = track_scene('swaying', 77, values)
        at = [runs.offset_at(evolve(scene, truth=(each,)), final, 30.0) for each in scene.truth]
        error, variance, held, _ = np.array(at).T
        nees.append(np.mean(error**2 / variance))
        inside.append(np.mean(held))
    assert nees[0] < 1.7 and inside[0] > 0.7 and nees[1] > 1.5 * nees[0]


def test_the_depth_of_the_sea_floor_is_that_of_the_first_sight():
    """Relief: the altitude is that of the floor below the vehicle, wherever the obstacle lies."""
    filter_, first = filters.build_filter(ObstacleConfig()), level(altitude=6.0)
    begun = filter_.begin(*SEEN, first)
    after, _ = filter_.advance(begun, first, level(1.0, 4.5), 0.5)
    assert begun.x[0, -1, 2] == pytest.approx(26.0)
    assert_allclose(after.x[..., 2], begun.x[..., 2])


SEEN = np.array([[60.0, 0.1]]), np.diag([0.02, 2e-5])[None]


def test_north_and_east_become_y_and_x():
    P = np.array([[[4.0, 0.5], [0.5, 9.0]]])
    view = view_of(np.zeros(3), np.zeros(3))._replace(
        behaviour=np.array([[0.7, 0.3]]), velocity=np.array([[1.0, -2.0]]), velocity_covariance=P
    )
    columns = filters.behaviour_columns(view, ('fixed', 'moving'))
    names = 'prob_fixed prob_moving vx vy vel_cov_x_x vel_cov_x_y vel_cov_y_y'
    assert list(columns) == names.split()
    assert [float(value[0]) for value in columns.values()] == [0.7, 0.3, -2.0, 1.0, 9.0, 0.5, 4.0]


@pytest.mark.parametrize(
    'moving, other, confirmed, alike',
    [(3, 0, 5, 1), (3, 0, 6, 0), (2, 1, 3, 0), (4, 2, 7, 1), (4, 2, 8, 0), (0, 0, 9, 0)],
)
def test_it_takes_three_and_more_than_half_of_all_to_doubt_the_navigation(
    moving, other, confirmed, alike, monkeypatch
):
    """`moving` obstacles move alike, `other` elsewhere, the rest stands still."""
    count = moving + other
    mu = np.zeros((confirmed + 1, 2))
    mu[:, 0], mu[:count] = 1.0, (0.1, 0.9)
    v = np.array([(0.4, 0.0)] * moving + [(30.0 * k - 100.0,) * 2 for k in range(other)])
    variances = np.tile(1e-4 * np.eye(2), (count, 1, 1))
    monkeypatch.setattr(filters, '_velocity', lambda *_: (v.reshape(-1, 2), variances))
    filter_ = SimpleNamespace(moves=np.array([False, True]), behaviours=('fixed', 'moving'))
    known = np.arange(confirmed + 1) < confirmed  # the last one is tentative
    assert filters.moving_alike(filter_, SimpleNamespace(mu=mu), known) == alike


OWN = np.array([0.15, 0.004]) ** 2
GIVEN = np.array([True])
Z = np.array([[40.0, 0.1]])


def stated(std_range, std_across, z=Z):
    return np.square([std_range, std_across / z[0, 0]])[None, :, None] * np.eye(2)


def test_an_echo_is_as_uncertain_as_those_of_its_track_were():
    """Every other echo looks like that of a point; the size is kept while the range closes."""
    bodies, used = Bodies.unknown(1), []
    for k in range(200):
        R = stated(*((0.2, 0.4) if k % 2 else (0.02, 0.04)))
        bodies, R = bodies.with_echoes(GIVEN, Z, R, OWN)
        used.append(np.sqrt(np.diagonal(R[0])) * [1.0, Z[0, 0]])
    assert_allclose(used[0], [(0.15 + 0.02) / 2.0, (0.004 * 40.0 + 0.04) / 2.0])
    assert_allclose(np.mean(used[100:], axis=0), [0.11, 0.22], rtol=0.02)
    assert np.ptp(used[100:], axis=0)[0] < 0.02
    bodies = Bodies.unknown(1)
    for distance in np.linspace(50.0, 10.0, 60):
        z = np.array([[distance, 0.0]])
        bodies, R = bodies.with_echoes(GIVEN, z, stated(0.1, 0.3, z), OWN)
    assert_allclose(np.sqrt(R[0, 1, 1]) * 10.0, 0.3, rtol=0.05)


def test_detections_without_extent_are_as_uncertain_as_they_say():
    bodies, R = Bodies.unknown(2), np.array([0.3, 0.01])[:, None, None] * np.eye(2)
    z = np.repeat(Z, 2, axis=0)
    after, used = bodies.with_echoes(np.zeros(2, bool), z, R, OWN)
    assert after is bodies and used is R
    after, used = bodies.with_echoes(np.array([False, True]), z, R, OWN)
    assert_allclose(used[0], R[0])
    assert after.number.tolist() == [0.0, 1.0] and not after.std[0].any()


def view_of(state, place):
    none, matrix = np.zeros((1, 1)), np.zeros((1, 3, 3))
    return filters.View(
        state=state[None], covariance=matrix, low=none[0], high=none[0], above=none[0],
        place=place[None], place_covariance=matrix.copy(), behaviour=none,
        velocity=np.zeros((1, 2)), velocity_covariance=np.zeros((1, 2, 2)),
        near=(np.zeros((1, 1, 5)), np.zeros((1, 1, 5, 5))),
    )  # fmt: skip


def common(state, away, bodies, scale_std):
    """The covariances of state and place after common errors, of which the view has none."""
    view = view_of(np.array(state), level().pose.position + away)
    found = with_common_errors(view, level(), bodies, scale_std)
    assert not view.covariance.any() and not view.place_covariance.any()
    return found.covariance[0], found.place_covariance[0]


def test_an_error_of_the_scale_lies_along_the_line_of_sight():
    """Sampling: all that is seen is too far by the same unknown factor."""
    away = np.array([30.0, 12.0, 4.0])
    state = np.array([np.linalg.norm(away), np.arctan2(12.0, 30.0), 4.0])
    factor = 1.0 + 0.01 * np.random.default_rng(0).normal(size=(200_000, 1))
    seen = factor * state * [1.0, 0.0, 1.0], factor * away
    for found, sample in zip(common(state, away, Bodies.unknown(1), 0.01), seen):
        assert_allclose(found, np.cov(sample.T), atol=2e-3)


def test_the_centre_of_a_body_lies_beside_its_echoes():
    along, across = np.array([[np.cos(0.5), np.sin(0.5), 0.0], [-np.sin(0.5), np.cos(0.5), 0.0]])
    body = Bodies(np.ones(1), np.array([[0.2, 0.6]]))
    of_state, of_place = common([20.0, 0.5, 0.0], 20.0 * along, body, 0.0)
    assert_allclose(np.diagonal(of_state), CENTRE * np.array([0.04, 0.36 / 400.0, 0.0]))
    assert_allclose(along @ of_place @ along, CENTRE * 0.04)
    assert_allclose(across @ of_place @ across, CENTRE * 0.36)


def test_a_track_that_was_missed_keeps_its_size():
    tracker = ObstacleTracker(ObstacleConfig(confirm_hits=1))
    for k, (ranges, numbers) in enumerate((([40], []), ([40], [2]), ([], [2]), ([40], [3]))):
        names = 'var_range var_bearing extent_range extent_bearing'.split()
        more = {name: [value] * len(ranges) for name, value in zip(names, (0.01, 1e-5, 0.1, 3e-3))}
        stamp = (k + 1) * SECOND
        run(tracker, [still(stamp), echoes(stamp, [(r, 0.1) for r in ranges], **more)])
        assert tracker._stream.state.known.obstacles.bodies.number.tolist() == numbers


def image_run(setting, seed):
    """NEES of range, bearing and offset alone, of all together over 3, and coverage, of the track
    through the images of a scene."""
    scene = simulate(setting, seed)
    given = detected(setting, [item.measurement for item in scene.measurements])
    final = final_estimates(ObstacleTracker(ObstacleConfig(max_range=setting.max_range)), given)
    truth = [table for true in truths(scene, TrueObstacle) for table in truth_tables(true)]
    metrics, found = score(series_of(final.values()), truth_of(truth), cutoff=5.0, gap=60.0)
    variance = np.diagonal(found.series.covariance[found.row], axis1=1, axis2=2)
    consistency = metrics['consistency']
    together = consistency['nees_state']['mean'] / 3.0
    single = np.mean(found.error**2 / variance, axis=0)
    return (*single, together, consistency['band_coverage'])


@pytest.mark.statistics
def test_tracks_of_images_are_as_good_as_they_say():
    """24 scenes: how far glints are apart does not tell how far the centroid is off."""
    size = {'image_beams': 96, 'image_bins': 192, 'max_range': 32.0, 'first_range': 30.0}
    place = {'last_range': 15.0, 'passing_distance': 3.0, 'vertical_offset': 1.5}
    setting = scenario('images', size | place)
    found = np.array([image_run(setting, seed) for seed in range(24)])
    range_, bearing, offset, state, cover = found.mean(axis=0)
    assert 0.4 < state < 1.5 and range_ < 1.6 and bearing < 1.6 and offset < 1.5
    assert 0.84 < cover
    assert np.quantile(found[:, 3], 0.9) < 3.0  # none is far too sure


MODELS = {'plane': False, 'cone': True}


def poses(rng):
    """Two poses a metre and a few degrees apart."""
    angles = rng.normal(0.0, 0.1, 3)
    before = geometry.Pose(rng.normal(0.0, 20.0, 3), geometry.rotation(*angles))
    place = before.position + rng.normal(0.0, 1.0, 3)
    return before, geometry.Pose(place, geometry.rotation(*(angles + rng.normal(0.0, 0.03, 3))))


def components(rng, before, T, K, scale):
    """Weighted Gaussians x (T, K, n), P: in range, azimuth, depth, scale, ..."""
    n = len(scale)
    x = np.zeros((T, K, n))
    x[..., 0] = rng.uniform(30.0, 90.0, (T, K))
    x[..., 1] = rng.uniform(-0.3, 0.3, (T, K))
    x[..., 2] = before.position[2] + rng.uniform(-6.0, 6.0, (T, K))
    x[..., 3] = rng.normal(0.0, 0.003, (T, K))
    A = rng.normal(size=(T, K, n, n)) * scale[:, None]
    return x, A @ np.swapaxes(A, -1, -2), rng.dirichlet(np.ones(K), T)


def targets(rng, before, T=3, K=4):
    return components(rng, before, T, K, np.array([0.2, 0.004, 1.5, 0.003]))


def advanced(x, P, before, after, noise, cone=False):
    """The prediction of obstacles that are all fixed, of which no other error of the navigation
    is known than its scale."""
    weights, step = np.ones(x.shape[:2]), unscented.Step(*before, *after, noise, cone)
    whole, spread = np.zeros((*x.shape[:2], 8)), np.zeros((*x.shape[:2], 8, 8))
    whole[..., :4], spread[..., :4, :4] = x, P
    found = unscented.advance(whole, spread, weights, unscented.Motion.none(x.shape[1]), step)
    return found[0][..., :4], found[1][..., :4, :4], found[2]


@pytest.mark.parametrize('model', MODELS)
def test_prediction_equals_numpy(model):
    rng = np.random.default_rng(1)
    before, after = poses(rng)
    x, P, _ = targets(rng, before)
    P[..., 3, :] = P[..., 3] = 0.0
    noise = np.array([1e-3, 2e-7, 3e-4])
    x1, P1, _ = advanced(x, P, before, after, noise, MODELS[model])
    columns = np.swapaxes(2.0 * np.linalg.cholesky(P[..., :3, :3]), -1, -2)
    centre, weights = x[..., None, :3], np.array([0.25] + [0.125] * 6)
    points = np.concatenate([centre, centre + columns, centre - columns], axis=-2)
    d, delta, z = np.moveaxis(points, -1, 0)
    s = np.broadcast_to(x[..., 3:], d.shape)
    m = geometry.reconstruct(d, delta, z - before.position[2], before.R, model)
    stretch = np.stack([1.0 + s, 1.0 + s, np.ones_like(s)], axis=-1)
    moved = geometry.apply(before.R, m) + (before.position - after.position) * stretch
    echo = geometry.project(geometry.apply(after.R.T, moved), model)
    images = np.stack([*echo, z, s], axis=-1)
    mean = np.einsum('s,tksi->tki', weights, images)
    off = images - mean[..., None, :]
    covariance = np.einsum('s,tksi,tksj->tkij', weights, off, off)
    covariance[..., 1, 1] += noise[0] / mean[..., 0] ** 2
    covariance[..., range(3), range(3)] += noise
    assert_allclose(x1, mean, rtol=1e-12, atol=1e-13)
    assert_allclose(P1, covariance, rtol=1e-9, atol=1e-15)
    assert np.all(P1 == np.swapaxes(P1, -1, -2))


def test_a_turn_through_the_back_keeps_the_spread_of_the_azimuth():
    """Azimuths on both sides of +-180 degrees are neighbours."""
    x, P = np.array([[[50.0, 3.0, 20.0, 0.0]]]), np.diag([0.01, 1e-4, 0.01, 1e-6])[None, None]
    turned = level(turned=(0.0, 0.0, 3.0 - np.pi))
    _, P1, _ = advanced(x, P, level().pose, turned.pose, np.zeros(3))
    assert_allclose(P1[0, 0, 1, 1], 1e-4, rtol=1e-3)


@pytest.mark.parametrize('cone', [False, True])
def test_where_no_point_exists_the_nearest_is_taken(cone):
    x = np.array([[[10.0, 0.1, 12.0, 0.0]]])
    m = unscented.points(x, np.zeros(3), np.eye(3), cone)[0, 0]
    assert np.isfinite(m).all()
    assert_allclose(np.linalg.norm(m), 10.0)


def test_places_equal_sampling():
    rng = np.random.default_rng(3)
    before, _ = poses(rng)
    x, P, mu = targets(rng, before, T=1, K=2)
    near = unscented.relative(x, P, mu, np.zeros(2, np.bool_), *before, False)
    mean, covariance = mixtures.moment_match(*near, mu, 3)
    which = rng.choice(2, 200_000, p=mu[0])
    draws = np.array([rng.multivariate_normal(x[0, k], P[0, k], 200_000) for k in (0, 1)])
    d, delta, z, _ = draws[which, np.arange(200_000)].T
    m = geometry.reconstruct(d, delta, z - before.position[2], before.R)
    world = geometry.apply(before.R, m)
    assert_allclose(mean[0], world.mean(axis=0), atol=0.1)
    assert_allclose(covariance[0], np.cov(world.T), rtol=0.05, atol=0.2)


def test_an_update_and_its_hypotheses_put_together():
    """Of the first target one of two echoes, or none; of the third one or none."""
    rng = np.random.default_rng(4)
    before, _ = poses(rng)
    x, P, mu = targets(rng, before)
    target = np.array([0, 0, 2])
    z = x[target, 0, :2] + rng.normal(size=(3, 2)) * [0.3, 0.005]
    R = np.tile(np.diag([0.025, 2.5e-5]), (3, 1, 1))
    h = np.ascontiguousarray(x[target][..., :2])
    *given, log, _ = mixtures.update(x[target], P[target], mu[target], h, z, R)
    share = np.array([0.5, 0.2, 0.6])
    after, covariance, weight = mixtures.combine(x, P, mu, tuple(given), target, share)
    H = np.eye(2, 4)
    none = 1.0 - np.bincount(target, share, 3)
    cases = {t: [[(none[t] * mu[t, k], x[t, k], P[t, k])] for k in range(4)] for t in (0, 2)}
    for m, t in enumerate(target):
        S = P[t, :, :2, :2] + R[m]
        own = [w * normal.pdf(z[m], h, C) for w, h, C in zip(mu[t], x[t, :, :2], S)]
        assert_allclose(log[m], np.log(sum(own)), rtol=1e-9)
        for k in range(4):
            gain = P[t, k] @ H.T @ np.linalg.inv(S[k])
            updated = x[t, k] + gain @ (z[m] - x[t, k, :2]), (np.eye(4) - gain @ H) @ P[t, k]
            cases[t][k].append((share[m] * own[k] / sum(own), *updated))
        # The innovation is that of the mixture, of which the components' means are a part.
        r = z[m] - x[t, :, :2]
        mean, whole, nis = mixtures.innovations(mu[t][None], r[None], S[None])
        of_all, spread = moments(zip(mu[t], r, S))
        assert_allclose(mean[0], of_all)
        assert_allclose(whole[0], spread)
        assert_allclose(nis[0], of_all @ np.linalg.solve(spread, of_all), rtol=1e-9)
    for t in (0, 2):
        for k in range(4):
            mean, spread = moments(cases[t][k])
            assert_allclose(weight[t, k], sum(w for w, *_ in cases[t][k]), rtol=1e-9)
            assert_allclose(after[t, k], mean, rtol=1e-9)
            assert_allclose(covariance[t, k], spread, rtol=1e-7, atol=1e-12)
    assert_allclose(after[1], x[1])
    assert_allclose(weight[1], mu[1])


def moments(parts):
    """Of Gaussians with weights."""
    weight, mean, covariance = map(np.array, zip(*parts))
    weight = weight / weight.sum()
    off = mean - weight @ mean
    spread = covariance + off[:, :, None] * off[:, None]
    return weight @ mean, np.einsum('k,kij->ij', weight, spread)


def test_an_update_that_no_component_explains_keeps_finite_weights():
    x, P, R = np.zeros((1, 2, 4)), np.tile(np.eye(4) * 1e-6, (1, 2, 1, 1)), np.eye(2)[None] * 1e-6
    mu = np.array([[0.3, 0.7]])
    *_, weight, log, _ = mixtures.update(x, P, mu, x[..., :2].copy(), np.full((1, 2), 1e3), R)
    assert_allclose(weight, mu, rtol=1e-4)
    assert log[0] < -1e6


def test_only_echoes_near_some_component_are_in_the_gate():
    along = np.array([[0.0, 5.0], [9.0, 9.0], [3.0, 3.0]])
    h, z = along[..., None] * [1.0, 0.0], np.array([[0.5, 0.0], [7.0, 0.0], [60.0, 0.0]])
    C, mu = np.tile(np.eye(2), (3, 2, 1, 1)), np.array([[1.0, 0.5], [0.5, 0.0], [0.0, 0.0]])
    near = mixtures.gate(h, C, mu, z, C[:, 0].copy(), 3.0)
    assert near.tolist() == [[True, True, False], [False, True, False], [False] * 3]


def test_quantiles_of_mixtures():
    rng = np.random.default_rng(5)
    mean, std = rng.normal(0.0, 5.0, (6, 3)), rng.uniform(0.1, 3.0, (6, 3))
    mu = rng.dirichlet(np.ones(3), 6)
    mu[0] = [1.0, 0.0, 0.0]
    mean[1], std[1], mu[1] = [-500.0, 0.0, 500.0], 1e-3, [0.05 - 1e-9, 0.9, 0.05 + 1e-9]
    low, high, negative = mixtures.bands(mean, std, mu, 0.05)

    def beyond(value, t, probability):
        return float(mu[t] @ ndtr((value - mean[t]) / std[t])) - probability

    for t in range(6):
        assert_allclose(negative[t], beyond(0.0, t, 0.0), atol=1e-12)
        for quantile, probability in ((low[t], 0.05), (high[t], 0.95)):
            exact = brentq(beyond, -1e3, 1e3, args=(t, probability), xtol=1e-12)
            assert_allclose(quantile, exact, atol=1e-6)


def behaving(rng, before, slices=2, T=2, errors=0.0):
    """Components of each slice: fixed, swaying, swaying farther, moving, begun to; one more is
    fixed. errors: how much is unknown of the navigation."""
    C = 5 * slices + 1
    navigation = errors * np.array([0.003, 0.002, 0.01, 0.01, 0.05])
    x, P, mu = components(rng, before, T, C, np.array([0.2, 0.004, 1.5, *navigation, 0.3, 0.3]))
    x[..., 8:] = rng.normal(0.0, 0.5, (T, C, 2))
    fixed = np.arange(C) % 5 == 0
    x[:, fixed, 8:] = 0.0
    P[:, fixed, 8:, :] = P[:, fixed, :, 8:] = 0.0
    return x, P, mu


MOTION = filters.BehaviourSlices(ObstacleConfig(components=2))._motion(0.5)


CHAIN = np.full((5, 5), 0.02) + np.diag([0.9, 0.9, 0.88, 0.9, 0.82])
CHAIN[2, 3] += 0.02
CHAIN[4, 3] += 0.08
SAME = np.eye(5, dtype=bool)
SAME[1, 2] = SAME[2, 1] = SAME[3, 4] = SAME[4, 3] = True


def numpy_mix(x, P, mu, prior, slices, chain, same):
    """The mixing written out: sources as they look to each behaviour, then moments."""
    x1, P1, mu1, M = x.copy(), P.copy(), mu.copy(), len(chain)
    for t, k, a in np.ndindex(len(x), slices, M):
        own, to = slice(k * M, (k + 1) * M), k * M + a
        means, covariances = x[t, own].copy(), P[t, own].copy()
        for i in np.flatnonzero(~same[:, a]):
            means[i, 8:] = 0.0
            covariances[i, 8:, :] = covariances[i, :, 8:] = 0.0
            covariances[i, 8:, 8:] = np.eye(2) * prior[to]
        share = mu[t, own] * chain[:, a]
        mu1[t, to] = share.sum()
        x1[t, to], P1[t, to] = moments(zip(share, means, covariances))
    return x1, P1, mu1


def test_mixing_equals_numpy():
    rng = np.random.default_rng(1)
    before, _ = poses(rng)
    given = *behaving(rng, before, errors=1.0), MOTION.prior, 2, CHAIN, SAME
    got = mixtures.mix(*given, 0.0)
    for mine, plain in zip(got, numpy_mix(*given)):
        assert_allclose(mine, plain, rtol=1e-12, atol=1e-15)
    assert_allclose(got[2].sum(axis=1), 1.0)
    assert np.all(got[1] == np.swapaxes(got[1], -1, -2))


def test_what_begins_to_move_leaves_the_velocity_of_what_moves_alone():
    slices = filters.BehaviourSlices(ObstacleConfig(components=1))
    chain, prior = slices._transition(0.5), slices._motion(0.5).prior
    assert_allclose(chain.sum(axis=1), 1.0)
    fixed, _, _, moves, begun = range(5)
    assert chain[fixed, moves] == chain[moves, begun] == 0.0 < chain[fixed, begun]
    assert chain[begun, moves] == pytest.approx(-np.expm1(-0.1), rel=1e-3)
    rng = np.random.default_rng(3)
    x, P, mu = behaving(rng, poses(rng)[0], slices=1, T=1)
    both = [moves, begun]
    P[:, moves, 8:] = P[:, moves, :, 8:] = 0.0
    P[:, moves, [8, 9], [8, 9]] = 0.03**2
    x[:, both, 8:], P[:, begun] = 0.1, P[:, moves]
    mu[:] = [0.97, 0.0, 0.0, 0.01, 0.01, 0.01]
    x1, P1 = x, P
    for _ in range(100):
        x1, P1, _ = mixtures.mix(x1, P1, mu, prior, 1, chain, slices._same, 0.0)
        # What settles has the velocity that it had as what has just begun, unlike what begins.
        x1[:, begun, 8:], P1[:, begun] = 0.1, P[:, moves]
    assert_allclose(x1[0, moves, 8:], 0.1, rtol=1e-9)
    assert_allclose(np.diagonal(P1[0, moves])[8:], 0.03**2, rtol=1e-9)
    x1, *_ = mixtures.mix(x, P, mu, prior, 1, chain, slices._same, 0.0)
    old, new = mu[0, begun] * chain[begun, begun], mu[0, fixed] * chain[fixed, begun]
    assert_allclose(x1[0, begun, 8:], old / (old + new) * x[0, begun, 8:])


def test_mixing_leaves_depth_slices_alone_and_drops_the_improbable():
    rng = np.random.default_rng(2)
    before, after = poses(rng)
    x, P, mu = behaving(rng, before)
    mu[:, 5:10] *= 1e-9
    mu /= mu.sum(axis=1, keepdims=True)
    x1, P1, mu1 = mixtures.mix(x, P, mu, MOTION.prior, 2, CHAIN, SAME, 1e-6)
    assert np.all(mu1[:, 5:10] == 0.0)
    assert_allclose(mu1[:, :5].sum(axis=1) / mu1[:, 10], mu[:, :5].sum(axis=1) / mu[:, 10])
    assert np.all(x1[:, 10] == x[:, 10]) and np.all(P1[:, 10] == P[:, 10])
    # What was dropped stays finite.
    mu[:, 0], x[:, 0] = 0.0, np.nan
    step = unscented.Step(*before, *after, np.zeros(3), False)
    x1, P1, _ = unscented.advance(x, P, mu, MOTION, step)
    assert np.isfinite(x1).all() and np.isfinite(P1).all()


@pytest.mark.parametrize('kind', ['swaying', 'moving'])
def test_covariance_of_a_step_equals_sampling(kind):
    """The cross covariance of position and e, and the sign of ``step``, show here only."""
    rng, dt, draws = np.random.default_rng(5), 5.0, 400_000
    config = ObstacleConfig(components=1, behaviours=(kind,), speed_noise=0.3, **NO_NOISE)
    how = filters.BehaviourSlices(config)._motion(dt)
    # An obstacle whose place is known, level with the sonar.
    x, P = np.zeros((1, 1, 10)), np.zeros((1, 1, 10, 10))
    x[0, 0, :3] = 50.0, 0.2, 20.0
    P[0, 0, 8:, 8:] = how.prior[0] * np.eye(2)
    step = unscented.Step(*level().pose, *level().pose, np.zeros(3), False)
    x1, P1, _ = unscented.advance(x, P, np.ones((1, 1)), how, step)
    e = rng.normal(0.0, np.sqrt(how.prior[0]), (draws, 2))
    place = 50.0 * np.array([np.cos(0.2), np.sin(0.2)])
    if kind == 'swaying':
        phi = np.exp(-dt / 20.0)
        after = phi * e + rng.normal(0.0, 0.5 * np.sqrt(1.0 - phi**2), (draws, 2))
        place = place + after - e
    else:  # velocity is a random walk in small steps, place its integral over the whole step
        w = rng.normal(0.0, 0.3 * np.sqrt(dt), (draws, 2))
        place, after = place + dt * e + 0.5 * dt * w, e + w
    sample = np.column_stack([np.hypot(*place.T), np.arctan2(place[:, 1], place[:, 0]), after])
    pick = [0, 1, 8, 9]
    got = P1[0, 0][np.ix_(pick, pick)]
    scale = np.sqrt(np.outer(np.diag(got), np.diag(got)))
    assert_allclose(got / scale, np.cov(sample.T) / scale, atol=0.04)
