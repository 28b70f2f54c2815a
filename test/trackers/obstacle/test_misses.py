# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What misses say of the height: against an exact grid filter, and in the whole tracker."""

import numpy as np
import pytest
from scipy.stats import norm

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.trackers.obstacle.beam import MissEvidence
from sonar_imm.trackers.obstacle.filters import (
    DepthSlices,
    EDGE,
    Mixture,
    SOFT,
    Sonar,
)
from sonar_imm.trackers.obstacle.filters import (
    DOUBT as OTHER,
)
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

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
        self.p *= OTHER + (1.0 - OTHER) * inside

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
