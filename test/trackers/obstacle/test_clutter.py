# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles in clutter: density, existence, seeds, scales; and what misses say of the height."""

from attrs import evolve
from helpers.obstacle_runs import echoes, EXACT, followed, level, NO_NOISE, SECOND, tracked
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import lfilter
from scipy.stats import multivariate_normal, norm

from sonar_imm.trackers.obstacle import births, existence
from sonar_imm.trackers.obstacle.beam import MissEvidence
from sonar_imm.trackers.obstacle.clutter import Clutter
from sonar_imm.trackers.obstacle.existence import Existence, PRIOR
from sonar_imm.trackers.obstacle.filters import DepthSlices, DOUBT, EDGE, Mixture, SOFT
from sonar_imm.trackers.obstacle.ground import GroundMap
from sonar_imm.trackers.obstacle.mixtures import Beam, PARTS, visible
from sonar_imm.trackers.obstacle.pings import Echoes, Ping
from sonar_imm.trackers.obstacle.scales import Scales
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig
from sonar_imm_tools.simulation.obstacle.simulator import TrueObstacle

CONFIG = ObstacleConfig()
LEVER = (2.0, 0.0, -0.3)


def after_pings(z, ping, false):
    clutter = Clutter.none()
    for k in range(int(ping.max()) + 1):
        own = z[ping == k]
        clutter = clutter.after(own, np.full(len(own), false), 0.5)
    return clutter


def test_the_density_is_that_of_the_nearest_false_echoes_and_before_them_a_prior():
    v, quiet, one = load_vectors('obstacle_in_clutter/clutter'), Clutter.none(), np.ones((1, 2))
    clutter = after_pings(v['rows'], v['ping'], float(v['weight']))
    assert_allclose(clutter.density(v['query'], CONFIG), v['density'], rtol=1e-9)
    assert clutter.interval == 0.5
    assert clutter.density(one, evolve(CONFIG, clutter_density=0.3)).tolist() == [0.3]
    assert_allclose(quiet.density(one * [50.0, 0.1], CONFIG), 0.02)
    for _ in range(60):
        quiet = quiet.after(np.empty((0, 2)), np.empty(0), 0.5)
    assert_allclose(quiet.density(one * [50.0, 0.1], CONFIG), 0.02 * 5.0 / 65.0)
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
    rng, ping = np.random.default_rng(1), np.repeat(np.arange(60), 12)
    z = rng.uniform([near, np.radians(left)], [far, np.radians(right)], (len(ping), 2))
    clutter = after_pings(z, ping, 1.0)
    said = [f'12 false detections a ping, most of them {where}: learnt']
    assert clutter.warnings(CONFIG) == said and not after_pings(z, ping, 0.3).warnings(CONFIG)
    assert not clutter.warnings(evolve(CONFIG, clutter_density=0.1))


def test_detections_from_where_the_sonar_is_said_not_to_look_are_said():
    clutter = after_pings(np.full((60, 2), [40.0, np.radians(30.0)]), np.arange(60), 0.0)
    (sentence,) = clutter.warnings(CONFIG)
    assert 'from beyond horizontal_fov_deg (45 deg): set it to 60 deg or more' in sentence
    assert clutter.widest(np.array([[70.0, -0.6]])) == (0.6, 70.0)
    wide = evolve(CONFIG, horizontal_fov_deg=60.0)
    assert not clutter.warnings(wide)
    (sentence,) = clutter.warnings(evolve(wide, max_range=30.0))
    assert 'beyond max_range (30 m): set it to 40 m or more' in sentence


def of_all_parts(*V):
    """V (1, K) as that of all parts."""
    return np.repeat(np.array([V])[..., None], PARTS, axis=2)


def test_existence_by_class():
    falling = evolve(CONFIG, detection_profile=(20.0, 1.0, 40.0, 0.5))
    p = existence.detection(np.array([10.0, 30.0, 60.0]), falling)
    assert_allclose(p, np.outer([1.0, 0.75, 0.5], [0.9, 0.5, 0.2]))
    share = np.array([0.1, 0.2, 0.6])
    q = Existence.of(np.array([share, 0.9999999 * PRIOR]), 2)
    assert_allclose(q.probability(), [0.9, 0.9999999])
    assert_allclose(q.detectability(CONFIG)[0], (0.09 + 0.1 + 0.12) / 0.9)
    later = q.later(100.0)
    assert_allclose(later.probability(), q.probability())
    assert_allclose(later.classes[0], share / np.e + 0.9 * (1.0 - 1.0 / np.e) * PRIOR)
    V = np.repeat(of_all_parts(0.9, 0.2), 2, axis=0)
    hits, p = np.array([0.5, 1.0]), np.full((2, 3), 0.5)
    bounded = q.with_ping(q.classes, hits, np.array([[0.4, 0.6]] * 2), V, p)
    assert bounded.probability()[1] == pytest.approx(existence.SUREST)
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
    mu, V, p = np.ones((1, 1)), np.array([[[0.99, 0.99, 0.5, 0.0, 0.0]]]), np.full((1, 3), 0.9)
    found = Existence.of(0.9 * PRIOR[None], 1)
    for _ in range(40):
        q = found.classes * (1.0 - p * found.visible(mu, V))
        q /= 1.0 - found.classes.sum() + q.sum()
        found = found.with_ping(q, np.zeros(1), mu, V, p)
    assert_allclose(found.probability(), 0.4 * 0.9 / (0.4 * 0.9 + 0.1), rtol=1e-6)


def test_misses_count_component_by_component_since_the_last_echo():
    """Of a component that the beam always held, and one that has left it since the last echo."""
    mu, p = np.array([[0.5, 0.5]]), np.array([[0.9, 0.5, 0.2]])
    held, left = of_all_parts(0.9, 0.8), of_all_parts(0.9, 0.01)
    q, V = Existence.of(PRIOR[None], 2), left[0, :, :1]
    q = q.with_ping(PRIOR[None], np.ones(1), mu, held, p)
    assert_allclose(q.silence[0, :, 2, 0], [0.9 / 0.85, 0.8 / 0.85])
    for n in range(3):
        weight = np.array([[0.45], [0.4]]) / 0.85 * (1.0 - p * V) ** n
        assert_allclose(q.visible(mu, left)[0], (weight * V).sum(axis=0) / weight.sum(axis=0))
        q = q.with_ping(PRIOR[None], np.zeros(1), mu, left, p)


def test_tracks_are_confirmed_for_good_by_existence_and_hits_and_end():
    q = np.array([0.96, 0.96, 0.9, 0.04, 0.04, 0.0005])[:, None] * PRIOR
    found = Existence.of(q, 1)._replace(hits=np.array([2.6, 2.4, 9.0, 9.0, 2.0, 1.0]))
    before, hit = np.array([0, 0, 0, 1, 0, 0], np.uint8), np.array([1, 1, 1, 0, 0, 0], bool)
    assert found.status(before, hit, CONFIG).tolist() == [1, 0, 0, 2, 0, 0]
    assert found.ended(before > 0).tolist() == [False, False, False, True, False, True]


def test_of_two_tracks_in_one_place_the_younger_ends():
    mean = np.array([[50.0, 0.1], [50.4, 0.1], [50.4, 0.13], [90.0, 0.1]])
    tracks = mean, np.tile(np.diag([0.1, 1e-5]), (4, 1, 1)), np.array([7, 9, 12, 13])
    confirmed = np.ones(4, bool)
    near = existence.older_nearby(*tracks, confirmed, np.array([True, False, False, False]))
    assert near.tolist() == [0, 7, 0, 0]
    found = Existence.of(np.tile(PRIOR, (4, 1)), 1)
    for _ in range(existence.MERGED):
        assert not found.ended(confirmed).any()
        found = found.near(near)
    assert found.ended(confirmed).tolist() == [False, True, False, False]
    both = np.array([True, True, False, False])
    assert not existence.older_nearby(*tracks, confirmed, both).any()


SONAR = level(3.0, turned=(0.0, 0.0, 0.7))


def ping_of(z, seconds=1.0):
    detections = echoes(round(seconds * SECOND), np.multiply(z, [1.0, -1.0]))
    ping = Ping(detections.stamp_ns, SONAR, Echoes.of(detections, CONFIG), GroundMap())
    ping.dt = 0.5
    return ping


def test_a_seed_is_as_probable_as_births_beside_clutter():
    ping = ping_of([[60.0, 0.1], [30.0, 0.0]])
    (seeds,) = births.add_seeds((), ping, np.array([1.0, 0.25]), 0.02, CONFIG)
    born = 0.02 * 0.5 / (100.0 * np.radians(45.0))
    assert_allclose(seeds.classes.sum(axis=1), [1.0, 0.25] * np.array(born / (born + 0.02)))
    q = seeds.classes[0]
    assert_allclose(q / q.sum(), PRIOR)
    missed = q * (1.0 - np.array([0.9, 0.5, 0.2]))
    missed /= 1.0 - q.sum() + missed.sum()
    assert_allclose(births.with_miss(seeds, CONFIG).classes[0], missed)
    for seconds, left in ((4.0, 1), (3.0, 2)):  # after 2.5 s it goes
        later = ping_of([[60.0, 0.1]], seconds)
        assert len(births.add_seeds((seeds,), later, np.ones(1), 0.02, CONFIG)) == left


def test_a_seed_is_met_as_the_closed_mixture_around_its_place_says():
    (seeds,) = births.add_seeds((), ping_of([[60.0, 0.1]]), np.ones(1), 0.02, CONFIG)
    dt, d, expected = 1.0, 60.0, np.array([0.5, 0.02])
    z = np.array([[60.9, 0.105], [95.0, -0.2]])
    place, _ = births.level_places(z, SONAR)
    found = births.association_ratios(seeds, ping_of(z, 1.0 + dt), place, expected, CONFIG)
    # In the axes of the seed: the sonar has not moved.
    off = [60.9 * np.cos(0.005) - d, 60.9 * np.sin(0.005)]
    along = 2.0 * CONFIG.range_std**2 + 0.05**2
    across = 2.0 * np.radians(CONFIG.bearing_std_deg) ** 2 * d * d
    across += (0.004 * d) ** 2 + (0.03 * dt) ** 2
    swung = 2.0 * 0.5**2 * (1.0 - np.exp(-dt / 20.0))
    L = sum(
        share * multivariate_normal.pdf(off, cov=np.diag([along + more, across + more]))
        for share, more in zip(births.BEHAVIOURS, (0.0, swung, (0.75 * dt) ** 2))
    )
    pd = seeds.classes[0] @ [0.9, 0.5, 0.2]
    assert_allclose(found, pd * L * d / 0.5, rtol=1e-9)


def learned(error, config=CONFIG):
    """Scales after normalised innovations (N, 2) as the stated variances make them."""
    scales, last = Scales.none(), np.full((1, 2), np.nan)
    for e in error:
        used = e[None] / np.sqrt(scales.factor(config))  # the sonar's own error is all there is
        scales = scales.after(used, last, np.ones((1, 2), bool), config)
        last = used
    return scales


def test_the_scale_of_stated_variances_is_found():
    """Echoes that err alike are not narrowed."""
    white, keep = np.random.default_rng(2).normal(size=(600, 2)), np.exp(-0.1)
    right, wide, broad = learned(white), learned(white * [3.0, 1.0 / 3.0]), learned(white * 3.0)
    assert_allclose(right.factor(CONFIG), 1.0, atol=0.2)
    assert not right.warnings(CONFIG)
    assert 7.0 < wide.factor(CONFIG)[0] < 10.0 and 0.1 <= wide.factor(CONFIG)[1] < 0.25
    ranges, bearings = wide.warnings(CONFIG)
    assert ranges.startswith('ranges scatter') and ranges.endswith('than stated: allowed for')
    assert 'bearings scatter' in bearings and 'less than stated' in bearings
    assert wide.warnings(CONFIG, True)[1] == bearings
    assert 'check the stamps of nav' in broad.warnings(CONFIG, True)[1]
    as_stated = evolve(CONFIG, variance_scale_min=1.0, variance_scale_max=1.0)
    assert learned(white * 3.0, as_stated).factor(as_stated).tolist() == [1.0, 1.0]
    alike = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)
    assert (learned(alike).factor(CONFIG) > 1.0).all()
    assert (learned(alike / 3.0).factor(CONFIG) > 0.5).all()


def test_an_obstacle_among_thirty_false_echoes_is_the_only_one():
    overrides = {'sonar_lever': LEVER, 'clutter': 30.0, 'last_range': 50.0}
    scene, final, tracker = tracked('approach', 3, overrides)
    confirmed = [(e.extras['track_state'] > 0).sum() for e in final.values()]
    assert sum(confirmed[10:]) == len(confirmed[10:])
    for ping, stamp in enumerate(scene.truth[0].stamp_ns.tolist()[10:], 10):
        assert followed(final[stamp], scene.truth[0], ping, near=2.0) is not None
    assert 25.0 < tracker.health()['clutter_a_ping'] < 35.0
    last = list(final.values())[-1].extras
    assert last['existence'][last['track_state'] > 0] > 0.99
    assert last['detection_probability'].max() < 0.95


def test_an_obstacle_that_is_seldom_seen_is_confirmed_and_said_to_be():
    overrides = {'sonar_lever': LEVER, 'detection_probability': 0.2, 'last_range': 40.0}
    scene, final, tracker = tracked('approach', 1, overrides)
    last = final[int(scene.truth[0].stamp_ns[-1])]
    row = followed(last, scene.truth[0], -1)
    assert last.extras['detection_probability'][row] < 0.4
    (sentence,) = (each for each in tracker.warnings() if 'pings' in each)
    assert sentence.startswith('obstacles are seen in ') and 's to confirm' in sentence


FIXED = {'behaviours': ('fixed',), **EXACT, **NO_NOISE}
ONE = DepthSlices(ObstacleConfig(behaviours=('fixed',), components=1))
P_D, DEPTH, HALF = 0.9, 20.0, np.radians(7.5)
R = np.diag([0.15**2, np.radians(0.25) ** 2])


class Grid:
    """The exact posterior of where a fixed obstacle straight ahead lies: density (n, m) over the
    way to it, m, and how far it lies below the sonar, m."""

    def __init__(self, d, prior):
        way, z = np.linspace(d - 9.0, d + 1.5, 700), np.linspace(-14.0, 14.0, 281)
        self.x, self.z = np.meshgrid(way, z, indexing='ij')
        # Of the range with the way, where the offset is given.
        self.p = prior(self.z) * self.x / np.hypot(self.x, self.z)
        self.echo(0.0, d)

    def echo(self, went, d):
        self.p *= norm.pdf(np.hypot(self.x - went, self.z), d, np.sqrt(R[0, 0]))

    def inside(self, went, pitch, edge):
        up, edge, soft = np.arctan2(self.z, self.x - went) + pitch, edge * HALF, SOFT * HALF
        return norm.cdf((edge - up) / soft) - norm.cdf((-edge - up) / soft)

    def miss(self, went, pitch):
        self.p *= 1.0 - P_D * self.inside(went, pitch, 1.0 - EDGE)

    def seen(self, went, pitch):
        self.p *= DOUBT + (1.0 - DOUBT) * self.inside(went, pitch, 1.0 + EDGE)

    def moments(self):
        p, z = self.p.sum(axis=0) / self.p.sum(), self.z[0]
        mean, (low, high) = p @ z, np.interp([0.05, 0.95], np.cumsum(p), z)
        return mean, np.sqrt(p @ (z - mean) ** 2), low, high, p[z < 0.0].sum()


@pytest.mark.statistics
@pytest.mark.parametrize('offset, echoes', [(-2.5, 18), (-1.5, 35), (4.0, 32)])
def test_an_obstacle_is_believed_where_an_exact_grid_filter_believes_it(offset, echoes):
    """Looking down by 3 degrees: where it is no longer seen tells the side."""
    pitch, step, way, rng = np.radians(-3.0), 0.75, 45.0, np.random.default_rng(5)
    filter_ = DepthSlices(ObstacleConfig(components=41, **FIXED))

    def sonar(k):
        return level(step * k, turned=(0.0, pitch, 0.0))

    def measured(k):
        return np.array([[np.hypot(way - step * k, offset) + 0.15 * rng.normal(), 0.0]])

    first = measured(0)
    mixture = filter_.begin(first, R[None], sonar(0))
    parts = mixture.x[0, :, 2] - DEPTH, np.sqrt(mixture.P[0, :, 2, 2]), mixture.mu[0]
    grid = Grid(first[0, 0], lambda z: norm.pdf(z[..., None], *parts[:2]) @ parts[2])
    for k in range(1, echoes + 8):
        mixture, _ = filter_.advance(mixture, sonar(k - 1), sonar(k), 0.5)
        if k < echoes:
            z = measured(k)
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
            assert_allclose(ours, exact, atol=0.1)
            assert view.above[0] == pytest.approx(above, abs=0.02)
    # Ranges alone leave it at one half.
    assert view.above[0] > 0.65 if offset < 0.0 else view.above[0] < 0.45


def mixture_at(distance, depth, tracks):
    """Obstacles straight ahead, known to a metre."""
    x, P = np.zeros((tracks, 1, 4)), np.tile(np.eye(4), (tracks, 1, 1, 1))
    x[..., 0], x[..., 2] = distance, depth
    return Mixture(x, P, np.ones((tracks, 1)))


def test_misses_are_forgotten_with_the_next_echo_but_for_how_often_it_gives_none():
    mixture = mixture_at(30.0, DEPTH + 1.0, 2)
    looks = MissEvidence.first(mixture)
    for _ in range(3):
        looks = looks.with_ping(np.array([True, False]), mixture, ONE, level(), level())
    # It may be above the beam or below.
    assert looks.shown.P[1, 0, 2, 2] > 1.5 * mixture.P[1, 0, 2, 2]
    np.testing.assert_array_equal(mixture.P[1], np.eye(4)[None])
    looks = looks.with_ping(np.array([True, True]), mixture, ONE, level(), level())
    np.testing.assert_array_equal(looks.shown.P[1], looks.shown.P[0])
    assert looks.seen.tolist() == [5.0, 2.0] and looks.due[0] == 5.0 and looks.due[1] > 2.5


def test_an_echo_says_that_the_beam_holds_it_and_leaving_sideways_takes_nothing_back():
    mixture, aside = mixture_at(10.0, DEPTH, 1), level(turned=(0.0, 0.0, 1.0))
    looks = MissEvidence.first(mixture)
    looks = looks.with_ping(np.array([True]), mixture, ONE, level(), level())
    # The beam is 2.6 m high there: of a normal distribution, within 1.1 times that, .52.
    seen = looks.shown.P[0, 0, 2, 2]
    assert seen == pytest.approx(0.52, abs=0.03)
    mixture.x[..., 1] = -1.0
    for last in (level(), aside):
        looks = looks._replace(shown=mixture._replace(P=looks.shown.P))
        looks = looks.with_ping(np.array([False]), mixture, ONE, aside, last)
    assert looks.missed[0] == 0.0
    assert looks.shown.P[0, 0, 2, 2] == pytest.approx(seen, rel=0.01)


def test_what_has_left_the_beam_is_no_longer_believed_in_it():
    """An obstacle 6 m above leaves the beam at 46 m."""
    scene, final, _ = tracked('above', 2, {'last_range': 15.0}, misses='evidence')
    (truth,) = (each for each in scene.truth if isinstance(each, TrueObstacle))
    near = np.flatnonzero(truth.range < 25.0)
    assert len(near) > 5
    for ping in near:
        estimate = final[int(truth.stamp_ns[ping])]
        assert len(estimate) == 1 and estimate.extras['track_state'][0] > 0
        assert abs(estimate.state[0, 2] - truth.vertical_offset[ping]) < 1.5
        assert estimate.extras['collision_probability'][0] < 0.01
