# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles in clutter: density, existence, seeds, scales; and what misses say of the height."""

from attrs import evolve
from helpers.obstacle_runs import followed, SECOND, tracked
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import multivariate_normal, norm

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Detections
from sonar_imm.trackers.obstacle.beam import MissEvidence
from sonar_imm.trackers.obstacle.births import (
    add_seeds,
    association_ratios,
    BEHAVIOURS,
    level_places,
    Seeds,
    with_miss,
)
from sonar_imm.trackers.obstacle.clutter import Clutter
from sonar_imm.trackers.obstacle.existence import (
    detection,
    Existence,
    MERGED,
    older_nearby,
    PRIOR,
    SUREST,
)
from sonar_imm.trackers.obstacle.filters import DepthSlices, DOUBT, EDGE, Mixture, SOFT, Sonar
from sonar_imm.trackers.obstacle.ground import GroundMap
from sonar_imm.trackers.obstacle.mixtures import Beam, PARTS, visible
from sonar_imm.trackers.obstacle.pings import Echoes, Ping
from sonar_imm.trackers.obstacle.scales import Scales
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

CONFIG = ObstacleConfig()
LEVER = (2.0, 0.0, -0.3)


def after_pings(z, ping, false):
    clutter = Clutter.none()
    for k in range(int(ping.max()) + 1):
        which = ping == k
        clutter = clutter.after(z[which], np.full(which.sum(), false), 0.5)
    return clutter


def test_the_density_is_that_of_the_nearest_false_echoes():
    v = load_vectors('obstacle_in_clutter/clutter')
    clutter = after_pings(v['rows'], v['ping'], float(v['weight']))
    assert_allclose(clutter.density(v['query'], CONFIG), v['density'], rtol=1e-9)
    assert clutter.interval == 0.5
    believed = evolve(CONFIG, clutter_density=0.3)
    assert clutter.density(np.ones((2, 2)), believed).tolist() == [0.3, 0.3]


def test_before_there_are_false_echoes_the_density_is_a_prior():
    z = np.array([[50.0, 0.1]])
    assert_allclose(Clutter.none().density(z, CONFIG), 0.02)
    quiet = Clutter.none()
    for _ in range(60):
        quiet = quiet.after(np.empty((0, 2)), np.empty(0), 0.5)
    assert_allclose(quiet.density(z, CONFIG), 0.02 * 5.0 / 65.0)
    assert quiet.a_ping() == 0.0


@pytest.mark.parametrize(
    'near, far, left, right, where',
    [
        (1.0, 100.0, -22.5, 22.5, 'all over'),
        (55.0, 59.0, -22.5, 22.5, 'at 57 m'),
        (1.0, 100.0, 10.0, 16.0, 'to starboard 13 deg'),
        (1.0, 100.0, -16.0, -10.0, 'to port 13 deg'),
    ],
)
def test_users_are_told_where_false_echoes_are(near, far, left, right, where):
    rng = np.random.default_rng(1)
    ping = np.repeat(np.arange(60), 12)
    z = np.column_stack(
        [rng.uniform(near, far, len(ping)), np.radians(rng.uniform(left, right, len(ping)))]
    )
    (sentence,) = after_pings(z, ping, 1.0).warnings(CONFIG)
    assert sentence == f'12 false detections a ping, most of them {where}: learnt'
    assert not after_pings(z, ping, 0.3).warnings(CONFIG)
    assert not after_pings(z, ping, 1.0).warnings(evolve(CONFIG, clutter_density=0.1))


def test_detections_from_where_the_sonar_is_said_not_to_look_are_said():
    z = np.column_stack([np.full(60, 40.0), np.radians(30.0) * np.ones(60)])
    clutter = after_pings(z, np.arange(60), 0.0)
    (sentence,) = clutter.warnings(CONFIG)
    assert 'from beyond horizontal_fov_deg (45 deg): set it to 60 deg or more' in sentence
    assert clutter.widest(np.array([[70.0, -0.6]])) == (0.6, 70.0)
    assert not clutter.warnings(evolve(CONFIG, horizontal_fov_deg=60.0))
    (sentence,) = clutter.warnings(evolve(CONFIG, horizontal_fov_deg=60.0, max_range=30.0))
    assert 'beyond max_range (30 m): set it to 40 m or more' in sentence


def of_all_parts(*V):
    """V (1, K) as that of all parts."""
    return np.repeat(np.array([V])[..., None], PARTS, axis=2)


def test_existence_by_class():
    p = detection(np.array([10.0, 60.0]), evolve(CONFIG, detection_profile=(20.0, 1.0, 40.0, 0.5)))
    assert_allclose(p, [[0.9, 0.5, 0.2], [0.45, 0.25, 0.1]])
    q = Existence.of(np.array([[0.1, 0.2, 0.6], 0.9999999 * PRIOR]), 2)
    assert_allclose(q.probability(), [0.9, 0.9999999])
    assert_allclose(q.detectability(CONFIG)[0], (0.09 + 0.1 + 0.12) / 0.9)
    later = q.later(100.0)
    assert_allclose(later.probability(), q.probability())
    assert_allclose(
        later.classes[0], np.array([0.1, 0.2, 0.6]) / np.e + 0.9 * (1.0 - 1.0 / np.e) * PRIOR
    )
    mu, p = np.array([[0.4, 0.6]] * 2), np.full((2, 3), 0.5)
    V = np.repeat(of_all_parts(0.9, 0.2), 2, axis=0)
    bounded = q.with_ping(q.classes, np.array([0.5, 1.0]), mu, V, p)
    assert bounded.probability()[1] == pytest.approx(SUREST)
    assert bounded.hits.tolist() == [1.5, 2.0]


def test_the_parts_of_a_component_are_those_of_a_normal_distribution():
    """The beam ends 7.5 degrees up; components 50 m ahead are up to 9 m high, give or take 2 m."""
    z = np.linspace(-9.0, 9.0, 37)
    m = np.column_stack([np.full(37, 50.0), np.zeros(37), z])[None]
    P = np.tile(np.diag([0.01, 1e-6, 4.0]), (1, 37, 1, 1))
    edge = np.radians(7.5)
    V, _ = visible(m, P, np.full((1, 37), 1.0 / 37.0), Beam(edge, 1.0, 1000.0))
    d = np.hypot(50.0, z)
    std, up = np.hypot(np.radians(1.2), 2.0 / d), np.arcsin(z / d)
    whole = norm.cdf((edge - up) / std) - norm.cdf((-edge - up) / std)
    assert_allclose(V[0].mean(axis=1), 0.01 + 0.99 * whole, atol=0.025)
    assert (np.diff(V[0, z > 2.0], axis=1) < 0.0).all()  # the lowest part is in it the surest


def test_misses_leave_what_may_lie_outside_the_beam():
    """Half of a component has left the beam: it is still there after any number of misses."""
    mu, V = np.ones((1, 1)), np.array([[[0.99, 0.99, 0.5, 0.0, 0.0]]])
    existence = Existence.of(0.9 * PRIOR[None], 1)
    for _ in range(40):
        p = np.full((1, 3), 0.9)
        left = 1.0 - p * existence.visible(mu, V)
        r = existence.classes.sum()
        q = existence.classes * left / (1.0 - r + (existence.classes * left).sum())
        existence = existence.with_ping(q, np.zeros(1), mu, V, p)
    assert_allclose(existence.probability(), 0.4 * 0.9 / (0.4 * 0.9 + 0.1), rtol=1e-6)


def test_misses_count_component_by_component_since_the_last_echo():
    """Of a component that the beam always held, and one that has left it since the last echo."""
    mu, p = np.array([[0.5, 0.5]]), np.array([[0.9, 0.5, 0.2]])
    held, left = of_all_parts(0.9, 0.8), of_all_parts(0.9, 0.01)
    q = Existence.of(PRIOR[None], 2).with_ping(PRIOR[None], np.ones(1), mu, held, p)
    assert_allclose(q.silence[0, :, 2, 0], [0.9 / 0.85, 0.8 / 0.85])
    for n in range(1, 4):
        visible_now = q.visible(mu, left)
        weight = np.array([[0.45], [0.4]]) / 0.85
        V = left[0, :, :1]
        weight = weight * (1.0 - p * V) ** (n - 1)
        assert_allclose(visible_now[0], (weight * V).sum(axis=0) / weight.sum(axis=0))
        q = q.with_ping(PRIOR[None], np.zeros(1), mu, left, p)


def test_tracks_are_confirmed_for_good_by_existence_and_hits_and_end():
    q = np.array([0.96, 0.96, 0.9, 0.04, 0.04, 0.0005])[:, None] * PRIOR
    existence = Existence.of(q, 1)._replace(hits=np.array([2.6, 2.4, 9.0, 9.0, 2.0, 1.0]))
    before, hit = np.array([0, 0, 0, 1, 0, 0], np.uint8), np.array([1, 1, 1, 0, 0, 0], bool)
    assert existence.status(before, hit, CONFIG).tolist() == [1, 0, 0, 2, 0, 0]
    assert existence.ended(before > 0).tolist() == [False, False, False, True, False, True]


def test_of_two_tracks_in_one_place_the_younger_ends():
    mean = np.array([[50.0, 0.1], [50.4, 0.1], [50.4, 0.13], [90.0, 0.1]])
    covariance = np.tile(np.diag([0.1, 1e-5]), (4, 1, 1))
    ids, confirmed = np.array([7, 9, 12, 13]), np.ones(4, bool)
    hit = np.array([True, False, False, False])
    near = older_nearby(mean, covariance, ids, confirmed, hit)
    assert near.tolist() == [0, 7, 0, 0]
    existence = Existence.of(np.tile(PRIOR, (4, 1)), 1)
    for _ in range(MERGED):
        assert not existence.ended(confirmed).any()
        existence = existence.near(near)
    assert existence.ended(confirmed).tolist() == [False, True, False, False]
    both = np.array([True, True, False, False])
    assert not older_nearby(mean, covariance, ids, confirmed, both).any()


SONAR = Sonar(geometry.Pose(np.array([3.0, -2.0, 20.0]), geometry.rotation(0.0, 0.0, 0.7)))


def ping_of(z, stamp_ns=SECOND, dt=0.5):
    z = np.reshape(np.asarray(z, float), (-1, 2))
    detections = Detections(stamp_ns=stamp_ns, range=z[:, 0], bearing=-z[:, 1])
    ping = Ping(stamp_ns, SONAR, Echoes.of(detections, CONFIG), GroundMap())
    ping.dt = dt
    return ping


def test_a_seed_is_as_probable_as_births_beside_clutter():
    (seeds,) = add_seeds(
        (), ping_of([[60.0, 0.1], [30.0, 0.0]]), np.array([1.0, 0.25]), 0.02, CONFIG
    )
    born = 0.02 * 0.5 / (100.0 * np.radians(45.0))
    assert_allclose(seeds.classes.sum(axis=1), [1.0, 0.25] * np.array(born / (born + 0.02)))
    assert_allclose(seeds.classes[0] / seeds.classes[0].sum(), PRIOR)
    pd = np.array([0.9, 0.5, 0.2])
    q = seeds.classes[0]
    left = with_miss(seeds, CONFIG).classes[0]
    assert_allclose(left, q * (1.0 - pd) / (1.0 - q.sum() + (q * (1.0 - pd)).sum()))
    late = ping_of([[60.0, 0.1]], stamp_ns=4 * SECOND)
    assert len(add_seeds((seeds,), late, np.ones(1), 0.02, CONFIG)) == 1  # after 2.5 s it goes
    soon = ping_of([[60.0, 0.1]], stamp_ns=3 * SECOND)
    assert len(add_seeds((seeds,), soon, np.ones(1), 0.02, CONFIG)) == 2


def test_a_seed_is_met_as_the_closed_mixture_around_its_place_says():
    (seeds,) = add_seeds((), ping_of([[60.0, 0.1]]), np.ones(1), 0.02, CONFIG)
    assert isinstance(seeds, Seeds)
    dt, d = 1.0, 60.0
    z = np.array([[60.9, 0.105], [95.0, -0.2]])
    expected = np.array([0.5, 0.02])
    place, _ = level_places(z, SONAR)
    found = association_ratios(
        seeds, ping_of(z, SECOND + round(dt * SECOND)), place, expected, CONFIG
    )
    # In the axes of the seed: the sonar has not moved.
    off = [60.9 * np.cos(0.005) - d, 60.9 * np.sin(0.005)]
    R_r, R_b = CONFIG.range_std**2, np.radians(CONFIG.bearing_std_deg) ** 2
    along = 2.0 * R_r + 0.05**2
    across = 2.0 * R_b * d * d + (0.004 * d) ** 2 + (0.03 * dt) ** 2
    swung = 2.0 * 0.5**2 * (1.0 - np.exp(-dt / 20.0))
    L = sum(
        share * multivariate_normal.pdf(off, cov=np.diag([along + more, across + more]))
        for share, more in zip(BEHAVIOURS, (0.0, swung, (0.75 * dt) ** 2))
    )
    pd = seeds.classes[0] @ [0.9, 0.5, 0.2]
    assert_allclose(found, pd * L * d / 0.5, rtol=1e-9)


def learned(error, config=CONFIG, tracks=1):
    """Scales after normalised innovations (N, 2) as the stated variances make them."""
    scales, last = Scales.none(), np.full((1, 2), np.nan)
    for e in error:
        used = e[None] / np.sqrt(scales.factor(config))  # the sonar's own error is all there is
        scales = scales.after(used, last, np.ones((1, 2), bool), config)
        last = used
    return scales


def test_the_scale_of_stated_variances_is_found():
    rng = np.random.default_rng(2)
    white = rng.normal(size=(600, 2))
    assert_allclose(learned(white).factor(CONFIG), 1.0, atol=0.2)
    assert not learned(white).warnings(CONFIG)
    wide = learned(white * [3.0, 1.0 / 3.0])
    assert 7.0 < wide.factor(CONFIG)[0] < 10.0 and 0.1 <= wide.factor(CONFIG)[1] < 0.25
    ranges, bearings = wide.warnings(CONFIG)
    assert ranges.startswith('ranges scatter') and ranges.endswith(
        'times more than stated: allowed for'
    )
    assert 'bearings scatter' in bearings and 'less than stated' in bearings
    _, narrow = wide.warnings(CONFIG, True)
    _, broad = learned(white * 3.0).warnings(CONFIG, True)
    assert narrow == bearings and 'check the stamps of nav' in broad
    as_stated = evolve(CONFIG, variance_scale_min=1.0, variance_scale_max=1.0)
    assert learned(white * 3.0, as_stated).factor(as_stated).tolist() == [1.0, 1.0]


def test_echoes_that_err_alike_are_not_narrowed():
    rng = np.random.default_rng(3)
    keep, e = np.exp(-0.1), np.zeros((600, 2))
    for k in range(1, 600):
        e[k] = keep * e[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal(size=2)
    assert (learned(e).factor(CONFIG) > 1.0).all()
    assert (learned(e / 3.0).factor(CONFIG) > 0.5).all()


def test_an_obstacle_among_thirty_false_echoes_is_the_only_one():
    scene, final, tracker = tracked(
        'approach', 3, {'sonar_lever': LEVER, 'clutter': 30.0, 'last_range': 50.0}
    )
    truth, confirmed = scene.truth[0], [e.extras['track_state'] > 0 for e in final.values()]
    assert sum(int(each.sum()) for each in confirmed[10:]) == len(confirmed[10:])
    for ping in range(10, len(truth.stamp_ns)):
        assert followed(final[int(truth.stamp_ns[ping])], truth, ping, near=2.0) is not None
    assert 25.0 < tracker.health()['clutter_a_ping'] < 35.0
    last = list(final.values())[-1].extras
    assert last['existence'][last['track_state'] > 0] > 0.99
    assert last['detection_probability'].max() < 0.95


def test_an_obstacle_that_is_seldom_seen_is_confirmed_and_said_to_be():
    scene, final, tracker = tracked(
        'approach', 1, {'sonar_lever': LEVER, 'detection_probability': 0.2, 'last_range': 40.0}
    )
    truth = scene.truth[0]
    ping = len(truth.stamp_ns) - 1
    row = followed(final[int(truth.stamp_ns[ping])], truth, ping)
    assert final[int(truth.stamp_ns[ping])].extras['detection_probability'][row] < 0.4
    (sentence,) = (each for each in tracker.warnings() if 'pings' in each)
    assert sentence.startswith('obstacles are seen in ') and 's to confirm' in sentence


P_D = 0.9
STILL = {
    'scale_std': 0.0, 'navigation_noise': (0.0, 0.0, 0.0), 'drift_std': 0.0,
    'yaw_error_std_deg': 0.0, 'navigation_delay_std': 0.0,
}  # fmt: skip
DEPTH = 20.0
HALF = np.radians(7.5)
R = np.diag([0.15**2, np.radians(0.25) ** 2])


def pattern(elevation, edge):
    edge, soft = edge * HALF, SOFT * HALF
    return norm.cdf((edge - elevation) / soft) - norm.cdf((-edge - elevation) / soft)


class Grid:
    """The exact posterior of where a fixed obstacle straight ahead lies: density (n, m) over the
    way to it, m, and how far it lies below the sonar, m."""

    def __init__(self, d, prior):
        self.x, self.z = np.meshgrid(
            np.linspace(d - 9.0, d + 1.5, 700), np.linspace(-14.0, 14.0, 281), indexing='ij'
        )
        away = np.hypot(self.x, self.z)
        ahead = self.x / away  # of the range with the way, where the offset is given
        self.p = prior(self.z) * norm.pdf(away, d, np.sqrt(R[0, 0])) * ahead

    def echo(self, went, d):
        self.p *= norm.pdf(np.hypot(self.x - went, self.z), d, np.sqrt(R[0, 0]))

    def miss(self, went, pitch):
        self.p *= 1.0 - P_D * pattern(self.elevation(went, pitch), 1.0 - EDGE)

    def seen(self, went, pitch):
        inside = pattern(self.elevation(went, pitch), 1.0 + EDGE)
        self.p *= DOUBT + (1.0 - DOUBT) * inside

    def elevation(self, went, pitch):
        return np.arctan2(self.z, self.x - went) + pitch

    def moments(self):
        p = self.p.sum(axis=0) / self.p.sum()
        z = self.z[0]
        mean = p @ z
        low, high = np.interp([0.05, 0.95], np.cumsum(p), z)
        return mean, np.sqrt(p @ (z - mean) ** 2), low, high, p[z < 0.0].sum()


@pytest.mark.statistics
@pytest.mark.parametrize('offset, echoes', [(-2.5, 18), (-1.5, 35), (4.0, 32)])
def test_an_obstacle_is_believed_where_an_exact_grid_filter_believes_it(offset, echoes):
    """Looking down by 3 degrees: where it is no longer seen tells the side."""
    pitch, step = np.radians(-3.0), 0.75
    turned = geometry.rotation(0.0, pitch, 0.0)
    config = ObstacleConfig(behaviours=('fixed',), components=41, **STILL)
    filter_ = DepthSlices(config)
    rng = np.random.default_rng(5)
    way = 45.0

    def sonar(k):
        return Sonar(Pose(np.array([step * k, 0.0, DEPTH]), turned))

    def measured(k):
        return np.hypot(way - step * k, offset) + 0.15 * rng.normal()

    first = np.array([[measured(0), 0.0]])
    mixture = filter_.begin(first, R[None], sonar(0))
    parts = mixture.x[0, :, 2] - DEPTH, np.sqrt(mixture.P[0, :, 2, 2]), mixture.mu[0]
    grid = Grid(first[0, 0], lambda z: norm.pdf(z[..., None], *parts[:2]) @ parts[2])
    for k in range(1, echoes + 8):
        mixture, _ = filter_.advance(mixture, sonar(k - 1), sonar(k), 0.5)
        if k < echoes:
            z = np.array([[measured(k), 0.0]])
            h, _ = filter_.expected(mixture, sonar(k))
            mixture, *_ = filter_.update(mixture, h, z, R[None], sonar(k))
            grid.echo(step * k, z[0, 0])
        else:
            if k == echoes:
                mixture = filter_.apply_echo(mixture, sonar(k), sonar(k - 1))
                grid.seen(step * (k - 1), pitch)
            mixture, _ = filter_.apply_miss(mixture, np.array([P_D]), sonar(k))
            grid.miss(step * k, pitch)
        if k in (echoes - 1, echoes, echoes + 3, echoes + 7):
            view = filter_.view(mixture, sonar(k))
            ours = [view.state[0, 2], np.sqrt(view.covariance[0, 2, 2]), view.low[0], view.high[0]]
            *exact, above = grid.moments()
            np.testing.assert_allclose(ours, exact, atol=0.1)
            assert view.above[0] == pytest.approx(above, abs=0.02)
    # Ranges alone leave it at one half.
    assert view.above[0] > 0.65 if offset < 0.0 else view.above[0] < 0.45


def test_misses_are_forgotten_with_the_next_echo_but_for_how_often_it_gives_none():
    mixture = Mixture(np.zeros((2, 1, 4)), np.tile(np.eye(4), (2, 1, 1, 1)), np.ones((2, 1)))
    mixture.x[..., 0], mixture.x[..., 2] = 30.0, DEPTH + 1.0
    filter_ = DepthSlices(ObstacleConfig(behaviours=('fixed',), components=1))
    sonar = Sonar(Pose(np.array([0.0, 0.0, DEPTH]), np.eye(3)))
    looks = MissEvidence.first(mixture)
    for _ in range(3):
        looks = looks.with_ping(np.array([True, False]), mixture, filter_, sonar, sonar)
    # It may be above the beam or below.
    assert looks.shown.P[1, 0, 2, 2] > 1.5 * mixture.P[1, 0, 2, 2]
    np.testing.assert_array_equal(mixture.P[1], np.eye(4)[None])
    looks = looks.with_ping(np.array([True, True]), mixture, filter_, sonar, sonar)
    np.testing.assert_array_equal(looks.shown.P[1], looks.shown.P[0])
    assert looks.seen.tolist() == [5.0, 2.0] and looks.due[0] == 5.0 and looks.due[1] > 2.5


def test_an_echo_says_that_the_beam_holds_it_and_leaving_sideways_takes_nothing_back():
    mixture = Mixture(np.zeros((1, 1, 4)), np.eye(4)[None, None], np.ones((1, 1)))
    mixture.x[..., 0], mixture.x[..., 2] = 10.0, DEPTH
    filter_ = DepthSlices(ObstacleConfig(behaviours=('fixed',), components=1))
    sonar = Sonar(Pose(np.array([0.0, 0.0, DEPTH]), np.eye(3)))
    aside = Sonar(Pose(np.array([0.0, 0.0, DEPTH]), geometry.rotation(0.0, 0.0, 1.0)))
    looks = MissEvidence.first(mixture).with_ping(np.array([True]), mixture, filter_, sonar, sonar)
    # The beam is 2.6 m high there: of a normal distribution, within 1.1 times that, .52.
    seen = looks.shown.P[0, 0, 2, 2]
    assert seen == pytest.approx(0.52, abs=0.03)
    mixture.x[..., 1] = -1.0
    for last in (sonar, aside):
        looks = looks._replace(shown=mixture._replace(P=looks.shown.P))
        looks = looks.with_ping(np.array([False]), mixture, filter_, aside, last)
    assert looks.missed[0] == 0.0
    assert looks.shown.P[0, 0, 2, 2] == pytest.approx(seen, rel=0.01)


def test_what_has_left_the_beam_is_no_longer_believed_in_it():
    """An obstacle 6 m above leaves the beam at 46 m."""
    setting = scenario('above', {'last_range': 15.0})
    scene = simulate(setting, 2)
    truth = next(each for each in scene.truth if isinstance(each, TrueObstacle))
    tracker, errors, risks = ObstacleTracker(ObstacleConfig(misses='evidence')), [], []
    for item in scene.measurements:
        for estimate in tracker.process(item.measurement):
            ping = int(np.searchsorted(truth.stamp_ns, estimate.stamp_ns))
            if truth.range[ping] < 25.0:
                assert len(estimate) == 1 and estimate.extras['track_state'][0] > 0
                errors.append(estimate.state[0, 2] - truth.vertical_offset[ping])
                risks.append(estimate.extras['collision_probability'][0])
    assert len(errors) > 5
    assert np.abs(errors).max() < 1.5 and max(risks) < 0.01
