# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Errors of the navigation, which all obstacles share.

Every component carries five states behind the obstacle's own:

s         scale of the horizontal distances, against sonar ranges
psi       rad by which the heading of nav lies to starboard of the sonar's
b_N, b_E  m/s, minus the drift of the navigation to north and east
tau       s by which poses come late

**Exchange.** What the update of a ping says of them in one track holds for all others too. Of the
mixture's marginal N(m0, C0) before and N(m1, C1) after it, the message is the information that
came, ``L = [C1^-1 - C0^-1]+`` and ``eta = C1^-1 m1 - C0^-1 m0``, in the directions in which C1 is
smaller. A track takes the sum of the others' in as a measurement of the five in each component, so
that a fixed obstacle whose drift others confirm gains weight and one that moves stands out. All
messages together, on the prior, are the common estimate: what is published, and what a new
obstacle begins with. Exact for Gaussians that share nothing but the five, while these stand still.

**Published under two assumptions**: that the navigation is as good as an inertial system's
(`GOOD`), or as doubtful as the parameters say. What the filter knows under its own, wider prior is
turned into what it would know under the narrow one, component by component, and both count by
their evidence. The filter itself goes on as it was.

Source: docs/obstacle.md, section Navigation; Schmidt 1966, 'Application of state space methods to
navigation problems'.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.covariance import solve, symmetrise, transpose
from . import mixtures
from .config import ObstacleConfig
from .filters import Mixture
from .unscented import NAV, NEGLIGIBLE

GOOD = np.array([0.003, np.radians(0.1), 0.003, 0.003, 0.01])
"""Standard deviations of the five of a good inertial system."""
SURE = 0.9
"""Probability of its existence from which a track sends messages."""
SIGNIFICANT = 3.0
"""Standard deviations from zero from which an error is reported."""
DRIFTS, TURNED, LATE = 0.03, np.radians(1.0), 0.1
"""m/s, rad and s from which an error matters."""
SLOWEST = 0.2
"""m/s below which a course tells nothing of the heading."""
BEYOND = 3.0
"""Standard deviations beforehand, beyond which an error is larger than a filter that believes them
can allow for."""
UNSAFE = 'heights and behaviours may be wrong by more than stated'


class NavigationErrors(NamedTuple):
    """The common estimate: mean (5,) and covariance (5, 5); first_ns: stamp of the first ping."""

    mean: Annotated[FloatArray, '5']
    covariance: Annotated[FloatArray, '55']
    first_ns: int = 0

    @classmethod
    def of(cls, config: ObstacleConfig) -> NavigationErrors:
        """Return what is known before the first ping."""
        return cls(np.zeros(5), np.diag(np.square(config.navigation_errors()[0])))

    def predicted(self, stamp_ns: int, dt: float, config: ObstacleConfig) -> NavigationErrors:
        """Return the same `dt` s later."""
        walk = np.square(config.navigation_errors()[1])
        first = self.first_ns or stamp_ns
        return NavigationErrors(self.mean, self.covariance + np.diag(walk * dt), first)

    def with_messages(self, L: FloatArray, eta: FloatArray) -> NavigationErrors:
        """Return the estimate with messages L (T, 5, 5), eta (T, 5)."""
        information, vector = L.sum(axis=0), eta.sum(axis=0)
        known = np.eye(5) + self.covariance @ information
        mean = np.linalg.solve(known, self.mean + self.covariance @ vector)
        covariance = symmetrise(np.linalg.solve(known, self.covariance))
        return NavigationErrors(mean, covariance, self.first_ns)

    def given_to(self, mixture: Mixture) -> Mixture:
        """Return obstacles that know this of the navigation and nothing else; those of a filter
        without these states as they are."""
        if mixture.x.shape[-1] < NAV.stop:
            return mixture
        x, P = mixture.x.copy(), mixture.P.copy()
        x[..., NAV] = self.mean
        P[..., NAV, :] = P[..., NAV] = 0.0
        P[..., NAV, NAV] = self.covariance
        return Mixture(x, P, mixture.mu)

    def health(self) -> dict[str, float]:
        """Return what is shown among the diagnostics."""
        _, psi, north, east, tau = self.mean.tolist()
        return {
            'nav_drift_x': -east,
            'nav_drift_y': -north,
            'nav_yaw_deg': float(np.degrees(psi)),
            'nav_delay': tau,
        }

    def warnings(
        self, course: FloatArray, obstacles: int, config: ObstacleConfig, late: bool = False
    ) -> list[str]:
        """Return a sentence for each error that is sure and matters; course (3,): velocity of the
        vehicle, NED; obstacles: number of those that show it; late: whether poses seem to come
        later than the filter can find."""
        sentences = []

        def verdict(error: float, parameter: str, std: float) -> str:
            held = abs(error) <= BEYOND * std
            return 'allowed for' if held else f'{parameter} does not hold it, so {UNSAFE}'

        speed = float(np.hypot(*course[:2]))
        if speed >= SLOWEST:
            along = np.array([0.0, 0.0, *course[:2] / speed, 0.0])
            across = np.array([0.0, speed, -course[1] / speed, course[0] / speed, 0.0])
            drift = self._significant(along)
            if abs(drift) > DRIFTS:
                north, east = np.round(-drift * along[2:4], 2) + 0.0  # no -0.00
                alone = '' if obstacles > 1 else ', or whether it moves'
                sentences.append(
                    f'navigation drifts by {abs(drift):.2f} m/s against what {obstacles} '
                    f'{"obstacles show" if obstacles > 1 else "obstacle shows"} ({east:.2f} m/s '
                    f'east, {north:.2f} m/s north): '
                    f'{verdict(drift, "drift_std", config.drift_std)}; check the log or the '
                    f'current{alone}'
                )
            aside = self._significant(across)
            if abs(aside) > TURNED * speed:
                side = 'port' if aside > 0.0 else 'starboard'
                sentences.append(
                    f'the sonar seems to be turned by {np.degrees(abs(aside) / speed):.1f} deg to '
                    f'{side} against sonar_mount_rpy_deg, or navigation drifts sideways by '
                    f'{abs(aside):.2f} m/s'
                )
        tau = self._significant(np.array([0.0, 0.0, 0.0, 0.0, 1.0]))
        if abs(tau) > LATE:
            std = 0.0 if late else config.navigation_delay_std
            sentences.append(
                f'poses arrive {abs(tau):.2f} s {"late" if tau > 0.0 else "early"}: '
                f'{verdict(tau, "navigation_delay_std", std)}; check the stamps of nav'
            )
        return sentences

    def _significant(self, direction: FloatArray) -> float:
        """Return the estimate along a direction (5,), 0 where it may be nothing."""
        value, variance = float(direction @ self.mean), direction @ self.covariance @ direction
        return value if value * value > SIGNIFICANT**2 * float(variance) else 0.0


def marginals(mixture: Mixture) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, 5) and covariance (T, 5, 5) of the errors of the navigation."""
    x, P, mu = mixture
    return mixtures.moment_match(x[..., NAV], P[..., NAV, NAV], mu, 5)


def messages(
    before: tuple[FloatArray, FloatArray], after: tuple[FloatArray, FloatArray], trust: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the information L (T, 5, 5) and eta (T, 5), about 0, that came between two
    `marginals`, times `trust` (T,)."""
    (m0, C0), (m1, C1) = before, after
    L, eta = np.zeros(C0.shape), np.zeros(m0.shape)
    on = np.flatnonzero(np.all(np.diagonal(C0, axis1=1, axis2=2) > 0.0, axis=0))
    changed = np.any(C0 != C1, axis=(1, 2)) | np.any(m0 != m1, axis=1)
    which = np.flatnonzero((trust > 0.0) & changed)
    if not len(on) or not len(which):
        return L, eta
    block = which[:, None, None], on[:, None], on
    m0, m1 = (m[which[:, None], on, None] for m in (m0, m1))
    root = np.asarray(np.linalg.cholesky(C0[block]), np.float64)
    white = symmetrise(solve(root, transpose(solve(root, C1[block]))))
    found, axes = (np.asarray(part, np.float64) for part in np.linalg.eigh(white))
    values = np.maximum(found, 1e-9)[..., None]
    smaller = values < 1.0
    y0, y1 = (transpose(axes) @ solve(root, m) for m in (m0, m1))
    back = solve(transpose(root), axes)
    share = trust[which, None, None]
    gained = np.where(smaller, 1.0 / values - 1.0, 0.0)
    L[block] = share * (back @ (gained * transpose(back)))
    eta[which[:, None], on] = (share * (back @ np.where(smaller, y1 / values - y0, 0.0)))[..., 0]
    return L, eta


def apply_messages(mixture: Mixture, L: FloatArray, eta: FloatArray) -> Mixture:
    """Return obstacles after messages L (T, 5, 5), eta (T, 5) of others."""
    given = np.asarray(L.any(axis=(1, 2)))[:, None]
    live = np.nonzero((mixture.mu > 0.0) & given)
    if not len(live[0]):
        return mixture
    x, P, mu = (part[live] for part in mixture)
    x1, P1, log = mixture.x.copy(), mixture.P.copy(), np.full(mixture.mu.shape, -np.inf)
    x1[live], P1[live], evidence = _with_information(x, P, L[live[0]], eta[live[0]])
    log[live] = np.log(mu) + evidence
    return Mixture(x1, P1, mixtures.weights(log, mixture.mu)[0])


def _with_information(
    x: FloatArray, P: FloatArray, L: FloatArray, eta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return means (M, n) and covariances (M, n, n) of components given information L (M, 5, 5)
    and eta (M, 5), about 0, on the errors e of the navigation, and the log (M,) of its evidence,
    the mean of exp(e' eta - e' L e / 2)."""
    mean, eta = x[:, NAV, None], eta[..., None]
    known = np.eye(5) + L @ P[:, NAV, NAV]
    solved = solve(known, np.concatenate([eta - L @ mean, L @ P[:, NAV]], axis=2))
    gain = P[..., NAV] @ solved
    after = x + gain[..., 0]
    fit = transpose(mean) @ solved[..., :1] + transpose(eta) @ after[:, NAV, None]
    evidence = 0.5 * (fit[:, 0, 0] - np.linalg.slogdet(known)[1])
    return after, symmetrise(P - gain[..., 1:]), evidence


def under_two_assumptions(
    mixture: Mixture, sure: BoolArray, age: float, config: ObstacleConfig
) -> tuple[Mixture, FloatArray]:
    """Return the obstacles (T, 2 K) as they are where the navigation is good, then where it is in
    doubt, those that are `sure` (T,) under both; and the probability (T,) that it is good. age: s
    since the first ping."""
    x, P, mu = mixture
    T, K, _ = x.shape
    prior = config.navigation_good_probability
    std, walk = config.navigation_errors()
    good = np.minimum(GOOD, std)
    doubtful = good < std
    if not (doubtful.any() and prior > 0.0 and sure.any()):
        return mixture, np.full(T, np.nan)
    grown = 1.0 + age * np.square(walk / np.where(std > 0.0, std, 1.0))
    wide, narrow = np.square(std) * grown, np.square(good) * grown
    Lam = np.where(doubtful, 1.0 / np.where(narrow > 0.0, narrow, 1.0), 0.0)
    Lam = Lam - np.where(doubtful, 1.0 / np.where(wide > 0.0, wide, 1.0), 0.0)
    live = np.nonzero((mu > NEGLIGIBLE) & sure[:, None])
    L = np.broadcast_to(np.diag(Lam), (len(live[0]), 5, 5))
    odds = np.log(prior / (1.0 - prior)) if prior < 1.0 else np.inf
    odds += 0.5 * np.log(wide[doubtful] / narrow[doubtful]).sum()
    both = Mixture(*(np.concatenate([part, part], axis=1) for part in mixture))
    both.x[live], both.P[live], evidence = _with_information(
        x[live], P[live], L, np.zeros((len(L), 5))
    )
    log = np.full((T, 2 * K), -np.inf)
    with np.errstate(divide='ignore'):
        log[:, K:] = np.log(mu)
    log[live] = np.log(mu[live]) + min(odds, 700.0) + evidence
    weight, _ = mixtures.weights(log, both.mu)
    return both._replace(mu=weight), np.where(sure, weight[:, :K].sum(axis=1), np.nan)
