# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What an obstacle does, as an interacting multiple model filter inside each depth slice.

fixed     nothing
swaying   moored, it swings about its place: e is the displacement, m, which forgets itself over
          `sway_time` and has the standard deviation `sway_std`; or `WIDER` times as much
moving    e is the velocity, m/s, a random walk of `speed_noise`; horizontal only
others    of other packages, see `own_models`
seabed    fixed, and as deep as the sea floor below the vehicle when it was seen first: a slice of
          its own

The depth of an obstacle never changes, so slices do not interact. What it does may: within a slice
the behaviours are mixed (`mixtures.mix`) before each step. The cycle is mix, predict,
update, combine. The probability of a behaviour is its weight summed over the slices.

Source: docs/obstacle.md, section Behaviours.
"""

from __future__ import annotations

import math

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ..own_models import obstacle_behaviour
from . import mixtures
from .config import BEHAVIOURS, ObstacleConfig
from .filters import depth_slices, depth_span, DepthSlices, Hints, Mixture, Sonar, View
from .unscented import COMMON, Motion, STATES

PRIOR = {'fixed': 0.54, 'swaying': 0.18, 'moving': 0.18, 'seabed': 0.10}
"""Probability of each behaviour of a new obstacle, among those asked for."""
WIDER, WIDE_SHARE = 2.0, 0.1
"""How much farther some of what sways does so, and their share. Nobody knows beforehand how far a
mooring lets go: one that swings twice as far as believed is outside of the 90 % band in a third of
all cases. Echoes soon tell the two apart, so the share hardly matters."""
DROPPED = 1e-5
"""A slice that weighs less takes no further part, and a behaviour in one not in this ping."""
OUTLIER_DENSITY = 1.0 / (2.0 * 8.0 * 2.0 * np.radians(6.0))
"""1/(m rad) of an echo that is not the obstacle's: anywhere within 8 m and 6 degrees of it. A
density as high as inside the gate of a fixed obstacle would make an outlier of the echo by which
one that starts to move shows that it does."""
SWITCHING = BEHAVIOURS[:3]
ALIKE_AT_LEAST = 3
ALIKE = 0.05
"""m/s by which velocities that are alike may differ, beside three times their standard
deviation."""


class BehaviourSlices(DepthSlices):
    """A Gaussian sum over depth slices and behaviours, states (d, delta, z, s, e_N, e_E)."""

    n = STATES

    def __init__(self, config: ObstacleConfig):
        super().__init__(config)
        self.own = {name: obstacle_behaviour(name, config) for name in config.own_behaviours()}
        known = (*SWITCHING, *self.own, 'seabed')
        self.behaviours = tuple(name for name in known if name in config.behaviours)
        switching = [name for name in self.behaviours if name != 'seabed']
        if 'swaying' in switching:
            switching.insert(switching.index('swaying') + 1, 'swaying')
        self.outlier_density = OUTLIER_DENSITY
        self.slices, self.M = config.components, len(switching)
        seabed = ['seabed'] * ('seabed' in self.behaviours)
        behaviour = np.array(switching * self.slices + seabed)
        self.K = len(behaviour)
        self._same = behaviour[: self.M, None] == behaviour[: self.M]
        wide = np.zeros(self.K, np.bool_)
        for a in np.flatnonzero(np.diagonal(self._same, offset=1)) + 1:
            wide[a : self.slices * self.M : self.M] = True
        sways = behaviour == 'swaying'
        self._sway = config.sway_std * np.where(wide, WIDER, 1.0) * sways
        self._share = np.where(sways, np.where(wide, WIDE_SHARE, 1.0 - WIDE_SHARE), 1.0)
        self._count, self._identity = round(self._share[: self.M].sum()), np.eye(self.M)
        self._is = {name: behaviour == name for name in known}
        self._of = np.stack([self._is[name] for name in self.behaviours], axis=-1).astype(float)
        self.moves = self._is['moving']
        self._swaying, self._moving = (self._is[name] * 1.0 for name in ('swaying', 'moving'))
        self._prior = self._sway**2
        self._prior += self._moving * (0.5 * config.max_speed) ** 2
        for name, own in self.own.items():
            self._prior += self._is[name] * own.std**2
            if own.velocity:
                self.moves = self.moves | self._is[name]

    def begin(
        self, z: FloatArray, R: FloatArray, sonar: Sonar, hints: Hints | None = None
    ) -> Mixture:
        B, M, last = len(z), self.M, self.slices * self.M
        floor, floor_std = np.full(B, sonar.seabed_below()), np.full(B, self.config.seabed_std)
        if hints is not None:
            sounded = np.isfinite(hints.floor)
            floor = np.where(sounded, hints.floor, floor)
            std = np.hypot(hints.floor_std, self.config.ground_std)
            floor_std = np.where(sounded, std, floor_std)
        known = np.isfinite(floor) & ('seabed' in self.behaviours)
        lowest, highest = depth_span(z, sonar, self.config, hints)
        # What lies deeper than the sea floor is left to its own slice.
        above_floor = np.maximum(floor, lowest + 0.5 * (highest - lowest))
        highest = np.where(known, np.minimum(highest, above_floor), highest)
        centre, sigma = _cut_slices(lowest, highest, self.slices)
        x, P = np.zeros((B, self.K, self.n)), np.zeros((B, self.K, self.n, self.n))
        x[..., :2] = z[:, None]
        P[..., :2, :2] = R[:, None]
        P[..., 3, 3] = self.scale**2
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

    def advance(
        self, mixture: Mixture, before: Sonar, after: Sonar, dt: float
    ) -> tuple[Mixture, int]:
        mixed = mixtures.mix(*mixture, self._prior, self.slices, self._transition(dt), DROPPED)
        return self.carried(Mixture(*mixed), before.pose, after.pose, dt)

    def behaviour(self, mu: FloatArray) -> FloatArray:
        return np.asarray(mu @ self._of)

    def _transition(self, dt: float) -> FloatArray:
        """P[i, j], (M, M): probability that an obstacle of which i holds is one of j `dt` seconds
        later. As long as it sways it does so equally far."""
        share, N = self._share[: self.M], self._count
        rate = N / ((N - 1) * self.config.behaviour_time) if N > 1 else 0.0
        change = (1.0 - 1.0 / N) * -math.expm1(-rate * dt)
        other = share * change / max(N - 1, 1)
        return np.where(self._same, self._identity * (1.0 - change), other)

    def _motion(self, dt: float) -> Motion:
        config, swaying, moving = self.config, self._swaying, self._moving
        phi = math.exp(-dt / config.sway_time)
        swung = self._sway**2 * -math.expm1(-2.0 * dt / config.sway_time)
        built_in = Motion(
            keep=swaying * phi + moving,
            step=swaying * (phi - 1.0) + moving * dt,
            push=swaying + moving * (0.5 * dt),
            noise=swung + moving * (config.speed_noise**2 * dt),
            prior=self._prior,
        )
        steps = built_in[:4]
        for name, own in self.own.items():
            steps = tuple(a + self._is[name] * b for a, b in zip(steps, own.step(dt)))
        return Motion(*steps, self._prior)


def _cut_slices(lowest: FloatArray, highest: FloatArray, K: int) -> tuple[FloatArray, FloatArray]:
    """`depth_slices` with the outermost ones ending where the span does: centres and half widths,
    (B, K). The others keep their place, in pairs about the sonar."""
    centre, half = depth_slices(lowest, highest, K)
    ends = np.concatenate([centre - half[:, None], centre[:, -1:] + half[:, None]], axis=1)
    ends[:, 0], ends[:, -1] = lowest, highest
    width = np.diff(ends, axis=1)
    return 0.5 * (ends[:, 1:] + ends[:, :-1]), 0.5 * width


def build_filter(config: ObstacleConfig) -> DepthSlices:
    """The filter `config.method` names, for the behaviours it asks for."""
    alone = config.method == 'seafloor' or set(config.behaviours) == {'fixed'}
    return DepthSlices(config) if alone else BehaviourSlices(config)


def moving_alike(filter_: DepthSlices, mixture: Mixture, confirmed: np.ndarray) -> bool:
    """Whether most of the confirmed obstacles, three at least, move, and in the same way. Then it
    is more probably the navigation that drifts: an error of its velocity moves all alike."""
    if np.count_nonzero(confirmed) < ALIKE_AT_LEAST or not filter_.moves.any():
        return False
    which = np.flatnonzero(confirmed)
    which = which[mixture.mu[which][:, filter_.moves].sum(axis=1) > 0.5]
    if len(which) < ALIKE_AT_LEAST:
        return False
    v, covariance = _velocity(mixture.rows(which), filter_.moves)
    off = v - np.median(v, axis=0)
    variance = np.trace(covariance, axis1=-2, axis2=-1)
    alike = np.einsum('ti,ti->t', off, off) <= 9.0 * variance + ALIKE**2
    return bool(alike.sum() >= ALIKE_AT_LEAST and alike.sum() > 0.5 * confirmed.sum())


def _velocity(mixture: Mixture, moves: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Mean (T, 2) and covariance (T, 2, 2) of the velocity; what does not move has 0, without
    spread."""
    x, P = mixture.x[..., COMMON:].copy(), mixture.P[..., COMMON:, COMMON:].copy()
    x[:, ~moves], P[:, ~moves] = 0.0, 0.0
    return mixtures.moment_match(x, P, mixture.mu, 2)


def behaviour_columns(view: View, behaviours: tuple[str, ...]) -> dict[str, FloatArray]:
    """``prob_<behaviour>``, and the velocity with its covariance, east then north (ENU)."""
    covariance = view.velocity_covariance
    return {
        **{f'prob_{name}': view.behaviour[:, i] for i, name in enumerate(behaviours)},
        'vx': view.velocity[:, 1],
        'vy': view.velocity[:, 0],
        'vel_cov_x_x': covariance[:, 1, 1],
        'vel_cov_x_y': covariance[:, 0, 1],
        'vel_cov_y_y': covariance[:, 0, 0],
    }
