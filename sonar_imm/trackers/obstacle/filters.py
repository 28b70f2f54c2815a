# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The filter of an obstacle: a Gaussian sum over depth and behaviour.

**Depth.** The vertical offset of an obstacle shows in two ways: while the vehicle rolls, an
obstacle above and one below the sonar swing to opposite sides; and on the approach the range
closes more slowly the further off the course in the vertical it lies, whether above or below. Both
are so weak at first, and the second so ambiguous, that no single Gaussian holds what is known. So
the vertical reach of the beam is cut into slices, each an unscented Kalman filter over (d, delta,
z) and the errors of the navigation (`navigation_errors`), and their likelihoods say in which of
them the obstacle is. What stays constant is the obstacle's own depth z; its offset follows from it
and the vehicle's depth.

**Behaviour.** Inside each slice runs an interacting multiple model filter over what the obstacle
does; two more states e say how:

fixed     nothing
swaying   moored, it swings about its place: e is the displacement, m, which forgets itself over
          `sway_time` and has the standard deviation `sway_std`; or `WIDER` times as much
moving    e is the velocity, m/s, a random walk of `speed_noise`, or of less below `SLOW`;
          horizontal only; what has just begun to move is apart for `BEGUN_TIME`
others    of other packages, see `own_models`
seabed    fixed, and as deep as the sea floor below the vehicle when it was seen first: a slice of
          its own

The depth never changes, so slices do not interact; behaviours are mixed (`mixtures.mix`) before
each step. The cycle is mix, predict, update, combine. The probability of a behaviour is its weight
summed over the slices.

Everything is in NED and FRD; T obstacles, K components of weights mu (T, K).

Source: docs/obstacle.md, sections Methods and Behaviours.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Annotated, NamedTuple

import numpy as np

from ...acoustics import geometry
from ...acoustics.geometry import Pose
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, take
from ..own_models import BehaviourStep, obstacle_behaviour
from . import mixtures, unscented
from .config import BEHAVIOURS, ObstacleConfig
from .unscented import COMMON, Motion, NAV, RELATIVE, STATES, Step

BAND = 0.9
"""Probability of the interval `low` to `high`."""

BEAM_MARGIN = 1.6
"""A new obstacle lies within this many half beams of the axis: an edge is not sharp."""

EDGE = 0.1
"""Of the half height of the beam, to both sides of its edge: there neither an echo nor a miss is
surprising."""
SOFT = 0.05
"""Of the half height of the beam: standard deviation of the edges that are left."""

PRIOR = {'fixed': 0.54, 'swaying': 0.18, 'moving': 0.18, 'seabed': 0.10}
"""Probability of each behaviour of a new obstacle, among those asked for."""
WIDER, WIDE_SHARE = 2.0, 0.1
"""How much farther some of what sways does so, and their share. Nobody knows beforehand how far a
mooring lets go: one that swings twice as far as believed is outside of the 90 % band in a third of
all cases. Echoes soon tell the two apart, so the share hardly matters."""
BEGUN_TIME = 5.0
"""s for which what begins to move has just begun, as a component of its own: else the little that
begins in every step, of a velocity as unknown as that of a new obstacle, would keep what moves
slowly from ever knowing its velocity."""
SLOW = 0.3
"""Share of `max_speed` below which velocities change less, in proportion to the speed. Else what
moves slowly and steadily would fit worse than a drift of the navigation, which hardly changes."""
DROPPED = 1e-5
"""A slice that weighs less takes no further part, and a behaviour in one not in this ping."""
DOUBT = 0.02
"""Probability that an echo that is given to an obstacle is not its own, where that says something
of its height."""
SWITCHING = BEHAVIOURS[:3]
ALIKE_AT_LEAST = 3
ALIKE = 0.05
"""m/s by which velocities that are alike may differ, beside three times their standard
deviation."""

NOWHERE = np.full(3, np.nan)


class Sonar(NamedTuple):
    """The sonar during a ping."""

    pose: Pose
    """At the transmission."""
    altitude: float = np.nan
    """m above the sea floor, of the navigation reference; NaN when unknown."""
    late: Pose | None = None
    """For two-way timing, `late_by` seconds later; None otherwise."""
    late_by: float = 0.0
    reference: float = 0.0
    """m by which the sonar lies below the navigation reference."""
    course: Annotated[FloatArray, '3'] = NOWHERE
    """(3,) m/s of the vehicle along its course, NED; NaN when unknown."""
    velocity: Annotated[FloatArray, '3'] = np.zeros(3)
    """(3,) m/s of the sonar now, NED."""
    turn: Annotated[FloatArray, '3'] = np.zeros(3)
    """(3,) rad/s at which it turns, in its own axes."""

    def seabed_below(self) -> float:
        """Return the depth of the sea floor below the sonar, m, NaN when unknown."""
        return self.altitude - self.reference


class HeightPrior(NamedTuple):
    """What is known of the height of B new obstacles besides the beam, NaN where nothing is:
    elevations (B, 2) between which each lies, rad below the axis of the sonar; floor (B,): how far
    below the sonar the sea floor is at each, m, with its standard deviation (B,)."""

    elevations: FloatArray
    floor: FloatArray
    floor_std: FloatArray


class Mixture(NamedTuple):
    """x (T, K, n), P (T, K, n, n), mu (T, K)."""

    x: Annotated[FloatArray, 'TKS']
    P: Annotated[FloatArray, 'TKSS']
    mu: Annotated[FloatArray, 'TK']

    def is_finite(self) -> BoolArray:
        """Return which targets (T,) have finite numbers throughout."""
        means, covariances = np.isfinite(self.x), np.isfinite(self.P)
        return np.asarray(means.all(axis=(1, 2)) & covariances.all(axis=(1, 2, 3)))


def joined(mixtures: Sequence[Mixture]) -> Mixture:
    """Return the targets of several mixtures as one."""
    return Mixture(*(np.concatenate(parts) for parts in zip(*mixtures)))


class View(NamedTuple):
    """A mixture in words a user knows, all (T, ...): range, azimuth and vertical offset with their
    covariance; the interval of the offset; probability that the obstacle is above; its place in
    the world with covariance; the probability of each behaviour (T, B) of the filter's; north and
    east velocity (T, 2), m/s, with covariance; near: mean (T, K, 5) and covariance (T, K, 5, 5) of
    each component's place and velocity, see `unscented.relative`."""

    state: FloatArray
    covariance: FloatArray
    low: FloatArray
    high: FloatArray
    above: FloatArray
    place: FloatArray
    place_covariance: FloatArray
    behaviour: FloatArray
    velocity: FloatArray
    velocity_covariance: FloatArray
    near: tuple[FloatArray, FloatArray]


class DepthSlices:
    """A Gaussian sum over depth slices, states (d, delta, z, s, psi, b_N, b_E, tau)."""

    n = COMMON
    behaviours: tuple[str, ...] = ('fixed',)

    def __init__(self, config: ObstacleConfig):
        self.config = config
        self.K = config.components
        self.moves = np.zeros(self.K, np.bool_)
        self._still = Motion.none(self.K)
        self.cone = config.azimuth_model == 'cone'
        self._beam = beam_of(config)
        self._noise = tuple(walk**2 for walk in config.drift())
        std, walk = config.navigation_errors()
        self._errors, self._walk = np.diag(np.square(std)), np.square(walk)

    def begin(
        self, z: FloatArray, R: FloatArray, sonar: Sonar, height: HeightPrior | None = None
    ) -> Mixture:
        """Return new targets from detections z (B, 2), R (B, 2, 2)."""
        B, K = len(z), self.K
        x, P = np.zeros((B, K, self.n)), np.zeros((B, K, self.n, self.n))
        x[..., :2] = z[:, None]
        P[..., :2, :2] = R[:, None]
        P[..., NAV, NAV] = self._errors
        span = depth_span(z, sonar, self.config, height)
        centre, sigma = depth_slices(*span, K)
        x[..., 2] = sonar.pose.position[2] + centre
        P[..., 2, 2] = np.square(sigma)[:, None]
        return self._unshift(Mixture(x, P, np.full((B, K), 1.0 / K)), z, sonar)

    def _unshift(self, fresh: Mixture, z: FloatArray, sonar: Sonar) -> Mixture:
        """Two-way timing: the state at the transmission of which z would be measured."""
        for _ in range(2 if sonar.late else 0):  # the shift hardly depends on where it starts
            fresh.x[..., :2] += z[:, None] - self._echo(fresh, sonar)
        return fresh

    def advance(
        self, mixture: Mixture, before: Sonar, after: Sonar, dt: float
    ) -> tuple[Mixture, int]:
        """Return the targets as the sonar will see them `dt` seconds later, and how many
        covariances had to be repaired."""
        switched = self.switch_behaviours(mixture, dt)
        return self.predict_unchanged(switched, before, after, dt)

    def advance_each(
        self,
        mixture: Mixture,
        before: Sequence[Sonar],
        after: Sequence[Sonar],
        dt: FloatArray,
        silent: BoolArray | None = None,
    ) -> tuple[Mixture, int]:
        """`advance` of each target by itself, from one sonar of its own to another; silent (T,):
        targets that go on with what they do."""
        if not len(before):
            return mixture, 0
        quiet = np.zeros(len(dt), np.bool_) if silent is None else silent
        steps = zip(quiet.tolist(), before, after, dt.tolist())
        done = [
            (self.predict_unchanged if unchanged else self.advance)(
                take(mixture, np.array([t])), *step
            )
            for t, (unchanged, *step) in enumerate(steps)
        ]
        return joined([each for each, _ in done]), sum(repairs for _, repairs in done)

    def switch_behaviours(self, mixture: Mixture, dt: float) -> Mixture:
        """Return the targets with what they may begin to do within `dt` seconds."""
        return mixture

    def whereabouts(self, mixture: Mixture, sonar: Sonar) -> tuple[FloatArray, FloatArray]:
        """Return the mean place (T, 3) in the world and velocity (T, 3) of the targets, NED."""
        m = unscented.points(mixture.x, *sonar.pose, self.cone)
        place = geometry.to_world(sonar.pose, np.einsum('tk,tka->ta', mixture.mu, m))
        velocity = np.zeros(place.shape)
        if self.moves.any():
            weight = np.where(self.moves, mixture.mu, 0.0)
            velocity[:, :2] = np.einsum('tk,tka->ta', weight, mixture.x[..., COMMON:])
        return place, velocity

    def predict_unchanged(
        self, mixture: Mixture, before: Sonar, after: Sonar, dt: float
    ) -> tuple[Mixture, int]:
        """`advance` of targets that go on with what they do."""
        poses = (*before.pose, *after.pose, np.array(self._noise) * dt, self.cone)
        rates = (before.velocity, before.turn, after.velocity, after.turn, self._walk * dt, dt)
        step = Step(*poses, *rates)
        x, P, repaired = unscented.advance(*mixture, self._motion(dt), step)
        return Mixture(x, P, mixture.mu), int(np.count_nonzero(repaired))

    def _motion(self, dt: float) -> Motion:
        """What the components do in `dt` seconds."""
        return self._still

    def expected(
        self, mixture: Mixture, sonar: Sonar, met: Sequence[Sonar] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return range and azimuth (T, K, 2) a detection would show, and their covariance (T, K,
        2, 2) without the sonar's own error; met: sonars that see one target each."""
        if met and sonar.late is not None:
            seen = [self._echo(take(mixture, np.array([t])), own) for t, own in enumerate(met)]
            h = np.concatenate(seen)
        else:
            h = self._echo(mixture, sonar)
        return h, np.ascontiguousarray(mixture.P[..., :2, :2])

    def update(
        self, mixture: Mixture, h: FloatArray, z: FloatArray, R: FloatArray, sonar: Sonar
    ) -> tuple[Mixture, FloatArray, int]:
        """Return the targets after detections z (T, 2), R (T, 2, 2) of the targets, of which `h`
        was expected; their log density (T,), and how many covariances had to be repaired."""
        *after, log, repaired = mixtures.update(*mixture, h, z, R)
        return Mixture(*after), log, int(np.count_nonzero(repaired))

    def apply_echo(self, mixture: Mixture, sonar: Sonar, last: Sonar) -> Mixture:
        """Return the targets with what an echo in this ping says of the height, or one in the ping
        before, of the sonar `last` (`beam`)."""
        m = unscented.points(mixture.x, *sonar.pose, self.cone)
        if last is not sonar:
            m = geometry.predict(m, sonar.pose, last.pose)
        other = np.full(len(m), DOUBT)
        return Mixture(*self._weighed(mixture, m, other, 1.0 - other, 1.0 + EDGE)[:3])

    def apply_miss(
        self, mixture: Mixture, p: FloatArray, sonar: Sonar
    ) -> tuple[Mixture, FloatArray]:
        """Return the targets after a ping without an echo of the targets, which each give one with
        the probability p (T,) inside the beam; and the probability (T,) beforehand that the beam
        held them."""
        m = unscented.points(mixture.x, *sonar.pose, self.cone)
        *after, inside = self._weighed(mixture, m, np.ones(len(p)), -p, 1.0 - EDGE)
        return Mixture(*after), inside

    def _weighed(
        self, mixture: Mixture, m: FloatArray, floor: FloatArray, slope: FloatArray, edge: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """See `mixtures.weight_by_beam`, with a beam `edge` times as high."""
        vertical = self._beam.vertical
        beam = self._beam._replace(vertical=edge * vertical)
        return mixtures.weight_by_beam(*mixture, m, floor, slope, beam, SOFT * vertical)

    def view(self, mixture: Mixture, sonar: Sonar) -> View:
        """See `View`."""
        x, P, mu = mixture
        position, depth = sonar.pose.position, sonar.pose.position[2]
        state, own = mixtures.moment_match(x, P, mu, 3)
        state[:, 2] -= depth
        band = mixtures.bands(x[:, :, 2] - depth, np.sqrt(P[:, :, 2, 2]), mu, 0.5 * (1.0 - BAND))
        moves = np.tile(self.moves, mu.shape[1] // self.K)
        near = unscented.relative(x, P, mu, moves, *sonar.pose, self.cone)
        together, both = mixtures.moment_match(*near, mu, RELATIVE)
        return View(
            state,
            own,
            *band,
            position + together[:, :3],
            both[:, :3, :3],
            self.behaviour(mu),
            together[:, 3:],
            both[:, 3:, 3:],
            near,
        )

    def behaviour(self, mu: FloatArray) -> FloatArray:
        """Return the probability of each behaviour, (T, B)."""
        return np.ones((len(mu), 1))

    def visible(
        self, mixture: Mixture, pose: Pose, widest: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[FloatArray, BoolArray]:
        """Return the probability (T, K, E) that the beam holds each component, by parts of its
        height, and which targets (T,) lie ahead; pose: of the sonar, or of one for each target,
        see `unscented.points`. widest: azimuth and range from which there were echoes, where these
        are more than the parameters say."""
        x, P, mu = mixture
        m = unscented.points(x, *pose, self.cone)
        sides = map(max, self._beam[1:], widest)
        return mixtures.visible(m, P, mu, mixtures.Beam(self._beam.vertical, *sides))

    def _echo(self, mixture: Mixture, sonar: Sonar) -> FloatArray:
        """Range and azimuth (T, K, 2) of the means; with two-way timing the azimuth when the echo
        arrives, and the mean of the ranges out and back."""
        if sonar.late is None:
            return np.ascontiguousarray(mixture.x[..., :2])
        out = unscented.points(mixture.x, *sonar.pose, self.cone)
        return two_way_echo(out, sonar, self.config)


class BehaviourSlices(DepthSlices):
    """A Gaussian sum over depth slices and behaviours, states (d, delta, z, s, psi, b_N, b_E, tau,
    e_N, e_E)."""

    n = STATES

    def __init__(self, config: ObstacleConfig):
        super().__init__(config)
        self.own = {name: obstacle_behaviour(name, config) for name in config.own_behaviours()}
        known = (*SWITCHING, *self.own, 'seabed')
        self.behaviours = tuple(name for name in known if name in config.behaviours)
        switching = [name for name in self.behaviours if name != 'seabed']
        moving = ('moving', *(name for name, own in self.own.items() if own.velocity))
        for name in ('swaying', *moving):
            if name in switching:
                switching.insert(switching.index(name) + 1, name)
        self.slices, self.M = config.components, len(switching)
        seabed = ['seabed'] * ('seabed' in self.behaviours)
        behaviour = np.array(switching * self.slices + seabed)
        self.K = len(behaviour)
        self._same = behaviour[: self.M, None] == behaviour[: self.M]
        second = np.zeros(self.K, np.bool_)
        for a in np.flatnonzero(np.diagonal(self._same, offset=1)) + 1:
            second[a : self.slices * self.M : self.M] = True
        sways = behaviour == 'swaying'
        self._sway = config.sway_std * np.where(second, WIDER, 1.0) * sways
        self._begun = second & np.isin(behaviour, moving)
        self._share = np.where(sways, np.where(second, WIDE_SHARE, 1.0 - WIDE_SHARE), 1.0)
        self._share[self._begun] = 0.0
        self._count, self._identity = round(self._share[: self.M].sum()), np.eye(self.M)
        self._is = {name: behaviour == name for name in known}
        self._of = np.stack([self._is[name] for name in self.behaviours], axis=-1).astype(float)
        self.moves = self._is['moving']
        self._swaying, self._moving = (self._is[name] * 1.0 for name in ('swaying', 'moving'))
        self._slow = self._moving * ~self._begun * (SLOW * config.max_speed) ** 2
        self._prior = self._sway**2
        self._prior += self._moving * (0.5 * config.max_speed) ** 2
        for name, own in self.own.items():
            self._prior += self._is[name] * own.std**2
            if own.velocity:
                self.moves = self.moves | self._is[name]

    def begin(
        self, z: FloatArray, R: FloatArray, sonar: Sonar, height: HeightPrior | None = None
    ) -> Mixture:
        B, M, last = len(z), self.M, self.slices * self.M
        floor, floor_std = np.full(B, sonar.seabed_below()), np.full(B, self.config.seabed_std)
        if height is not None:
            sounded = np.isfinite(height.floor)
            floor = np.where(sounded, height.floor, floor)
            std = np.hypot(height.floor_std, self.config.ground_std)
            floor_std = np.where(sounded, std, floor_std)
        known = np.isfinite(floor) & ('seabed' in self.behaviours)
        lowest, highest = depth_span(z, sonar, self.config, height)
        # What lies deeper than the sea floor is left to its own slice.
        above_floor = np.maximum(floor, lowest + 0.5 * (highest - lowest))
        highest = np.where(known, np.minimum(highest, above_floor), highest)
        centre, sigma = _cut_slices(lowest, highest, self.slices)
        x, P = np.zeros((B, self.K, self.n)), np.zeros((B, self.K, self.n, self.n))
        x[..., :2] = z[:, None]
        P[..., :2, :2] = R[:, None]
        P[..., NAV, NAV] = self._errors
        x[:, :last, 2] = sonar.pose.position[2] + np.repeat(centre, M, axis=1)
        P[:, :last, 2, 2] = np.square(np.repeat(sigma, M, axis=1))
        mu = np.zeros((B, self.K))
        for some in (known, ~known):
            shares = PRIOR | {name: own.share for name, own in self.own.items()}
            prior = {name: shares[name] for name in self.behaviours}
            if some is not known:
                prior.pop('seabed', None)
            total = sum(prior.values())
            for name in prior:
                share = prior[name] / total / self._share[self._is[name]].sum()
                mu[np.ix_(some, self._is[name])] = share * self._share[self._is[name]]
        if 'seabed' in self.behaviours:
            x[:, last, 2] = sonar.pose.position[2] + np.where(known, floor, 0.0)
            P[:, last, 2, 2] = floor_std**2
        # e is unknown and uncorrelated with the rest.
        for i in (COMMON, COMMON + 1):
            P[:, :, i, i] = self._prior
        return self._unshift(Mixture(x, P, mu), z, sonar)

    def switch_behaviours(self, mixture: Mixture, dt: float) -> Mixture:
        if not len(mixture.mu):
            return mixture
        chain = self._transition(dt)
        return Mixture(
            *mixtures.mix(*mixture, self._prior, self.slices, chain, self._same, DROPPED)
        )

    def behaviour(self, mu: FloatArray) -> FloatArray:
        parts = mu.reshape(len(mu), mu.shape[1] // self.K, self.K)
        return np.asarray(parts.sum(axis=1) @ self._of)

    def _transition(self, dt: float) -> FloatArray:
        """P[i, j], (M, M): probability that an obstacle of which i holds is one of j `dt` seconds
        later. As long as it sways it does so equally far; what begins to move has just begun."""
        share, N, begun = self._share[: self.M], self._count, self._begun[: self.M]
        rate = N / ((N - 1) * self.config.behaviour_time) if N > 1 else 0.0
        change = (1.0 - 1.0 / N) * -math.expm1(-rate * dt)
        enters = np.where(self.moves[: self.M], begun, share)
        chain = np.where(
            self._same, self._identity * (1.0 - change), enters * change / max(N - 1, 1)
        )
        settles = -math.expm1(-dt / BEGUN_TIME)
        for a in np.flatnonzero(begun):
            chain[a, a - 1], chain[a, a] = chain[a, a] * settles, chain[a, a] * (1.0 - settles)
        return chain

    def _motion(self, dt: float) -> Motion:
        config, swaying, moving = self.config, self._swaying, self._moving
        phi = math.exp(-dt / config.sway_time)
        swung = self._sway**2 * -math.expm1(-2.0 * dt / config.sway_time)
        motion = Motion(
            keep=swaying * phi + moving,
            step=swaying * (phi - 1.0) + moving * dt,
            push=swaying + moving * (0.5 * dt),
            noise=swung + moving * (config.speed_noise**2 * dt),
            slow=self._slow,
            prior=self._prior,
        )
        for name, own in self.own.items():
            step = BehaviourStep(*own.step(dt))
            motion = Motion(*(a + self._is[name] * b for a, b in zip(motion, (*step, 0.0))))
        return motion


def depth_span(
    z: FloatArray, sonar: Sonar, config: ObstacleConfig, height: HeightPrior | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest vertical offset (B,) that detections z (B, 2) can have:
    inside the beam, or where `height` says, below the surface, above the sea floor."""
    a, b, c = sonar.pose.R[2]
    d, delta = z.T
    k = a * np.cos(delta) + b * np.sin(delta)
    edge = np.radians(min(0.5 * BEAM_MARGIN * config.vertical_fov_deg, 85.0))
    ends = d * (k * np.cos(edge) + c * np.array([[-1.0], [1.0]]) * np.sin(edge))
    lowest, highest, least = ends.min(axis=0), ends.max(axis=0), 0.02 * d
    if height is not None:
        ends = height.elevations
        seen = d[:, None] * (k[:, None] * np.cos(ends) + c * np.sin(ends))
        known = np.isfinite(seen).all(axis=1)
        lowest = np.where(known, seen.min(axis=1), lowest)
        highest = np.where(known, seen.max(axis=1), highest)
        least = np.where(known, 0.001 * d, least)
    if config.max_offset > 0.0:
        lowest, highest = (
            np.maximum(lowest, -config.max_offset),
            np.minimum(highest, config.max_offset),
        )
    if np.isfinite(sonar.altitude):
        bottom = np.full(len(d), max(sonar.altitude, 0.0))
    else:
        bottom = np.full(len(d), np.inf)
    if height is not None:
        bottom = np.where(np.isfinite(height.floor), height.floor + 2.0 * height.floor_std, bottom)
    highest = np.minimum(highest, bottom + least)
    if config.depth_is_absolute:
        lowest = np.maximum(lowest, np.minimum(-sonar.pose.position[2], 0.0) - least)
    # A beam that looks at nothing but rock or air shows an echo all the same: keep some reach.
    middle = 0.5 * (lowest + highest)
    half = np.maximum(0.5 * (highest - lowest), least)
    return middle - half, middle + half


def depth_slices(lowest: FloatArray, highest: FloatArray, K: int) -> tuple[FloatArray, FloatArray]:
    """Return the centres (B, K) of K equal slices of the spans (B,), and half their width (B,).
    Slices above and below the sonar are in pairs: on a level path they stay equally probable. For
    that they reach out of the span by up to a quarter of a slice."""
    width = (highest - lowest) / K
    first = np.round((2.0 * lowest + width) / width) * 0.5 * width
    return first[:, None] + np.arange(K) * width[:, None], 0.5 * width


def two_way_echo(out: FloatArray, sonar: Sonar, config: ObstacleConfig) -> FloatArray:
    """Range and azimuth (..., 2) of points seen at `out` (..., 3) when the ping left."""
    d_out = np.linalg.norm(out, axis=-1)
    fraction = np.clip(2.0 * d_out / config.sound_speed / sonar.late_by, 0.0, 1.0)
    late = out if sonar.late is None else geometry.predict(out, sonar.pose, sonar.late)
    back = out + fraction[..., None] * (late - out)
    d_back, azimuth = geometry.project(back, config.azimuth_model)
    return np.stack([0.5 * (d_out + d_back), azimuth], axis=-1)


def beam_of(config: ObstacleConfig) -> mixtures.Beam:
    """Return the beam of the parameters."""
    fov = config.vertical_fov_deg, config.horizontal_fov_deg
    vertical, horizontal = (math.radians(0.5 * angle) for angle in fov)
    return mixtures.Beam(vertical, horizontal, config.max_range)


def _cut_slices(lowest: FloatArray, highest: FloatArray, K: int) -> tuple[FloatArray, FloatArray]:
    """`depth_slices` with the outermost ones ending where the span does: centres and half widths,
    (B, K). The others keep their place, in pairs about the sonar."""
    centre, half = depth_slices(lowest, highest, K)
    ends = np.concatenate([centre - half[:, None], centre[:, -1:] + half[:, None]], axis=1)
    ends[:, 0], ends[:, -1] = lowest, highest
    width = np.diff(ends, axis=1)
    return 0.5 * (ends[:, 1:] + ends[:, :-1]), 0.5 * width


def build_filter(config: ObstacleConfig) -> DepthSlices:
    """The filter for the behaviours that are asked for."""
    return (DepthSlices if set(config.behaviours) == {'fixed'} else BehaviourSlices)(config)


def moving_alike(filter_: DepthSlices, mixture: Mixture, confirmed: np.ndarray) -> bool:
    """Return whether most of the confirmed obstacles, three at least, move, and in the same
    way. Then it is more probably the navigation that drifts: an error of its velocity moves all
    alike."""
    if np.count_nonzero(confirmed) < ALIKE_AT_LEAST or not filter_.moves.any():
        return False
    which = np.flatnonzero(confirmed)
    which = which[mixture.mu[which][:, filter_.moves].sum(axis=1) > 0.5]
    if len(which) < ALIKE_AT_LEAST:
        return False
    v, covariance = _velocity(mixture, which, filter_.moves)
    off = v - np.median(v, axis=0)
    variance = np.trace(covariance, axis1=-2, axis2=-1)
    alike = np.einsum('ti,ti->t', off, off) <= 9.0 * variance + ALIKE**2
    return bool(alike.sum() >= ALIKE_AT_LEAST and alike.sum() > 0.5 * confirmed.sum())


def _velocity(
    mixture: Mixture, which: IndexArray, moves: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (q, 2) and covariance (q, 2, 2) of the velocity of some obstacles; what does not move
    has 0, without spread."""
    x, P = mixture.x[which, :, COMMON:], mixture.P[which, :, COMMON:, COMMON:]
    x[:, ~moves], P[:, ~moves] = 0.0, 0.0
    return mixtures.moment_match(x, P, mixture.mu[which], 2)


def behaviour_columns(view: View, behaviours: tuple[str, ...]) -> dict[str, FloatArray]:
    """Return ``prob_<behaviour>``, and the velocity with its covariance, east then north (ENU)."""
    covariance = view.velocity_covariance
    return {
        **{f'prob_{name}': view.behaviour[:, i] for i, name in enumerate(behaviours)},
        'vx': view.velocity[:, 1],
        'vy': view.velocity[:, 0],
        'vel_cov_x_x': covariance[:, 1, 1],
        'vel_cov_x_y': covariance[:, 0, 1],
        'vel_cov_y_y': covariance[:, 0, 0],
    }
