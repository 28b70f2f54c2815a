# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the vertical pattern of the sonar says of the height of an obstacle.

**Elevations.** Imaging sonars in three dimensions, and multibeam sonars that look ahead, measure
the elevation of an echo as well: a third measurement of each component,

    eps(d, delta, z) = asin(m_z / d),    positive down, m the point seen from the sonar,

linearised at the mean: within a depth slice it is nearly straight. A new obstacle has its slices
over `REACH` standard deviations of the measured elevation, not over the whole beam.
Range and azimuth go into the update first, the elevation after them; clutter is spread evenly over
the height of the beam. Rows without elevation update by range and azimuth alone.

**Misses** (`misses: evidence`). Where an obstacle lies at the elevation eps, a ping shows it with
the probability p B(eps): p is how often this obstacle gives an echo inside the beam, B the pattern
of the beam, 1 inside and 0 outside. So with the depth z of a component N(m, S), and eps = eps(m) +
(z - m) / d, a ping multiplies the density of z by

    f(z) = 1 - p B(z)                        without an echo,
    f(z) = doubt + (1 - doubt) B(z)          with one, which may not be the obstacle's.

B is the difference of two normal distribution functions, so that Z = E f is known in closed form;
Z weighs the component, and its derivatives give mean and covariance of what is left of it,

    x + P[:, z] (log Z)',    P + P[:, z] P[z, :] (log Z)''.

Used is the last echo and the misses since: where it was seen then, and is not now. The next echo
shows that it was in the beam all the time, and only faint; so the filter goes on without all this,
and what is published is a copy. A beam that is higher than stated therefore harms no track. Nor
does the life of a track depend on it: misses that put an obstacle out of the beam would excuse
themselves.

p is learned when an echo comes, from how many misses it ends. So misses of what always gave an
echo say a lot, and those of what flickers little. Where exactly a beam ends is not known: its
pattern falls off, and how far out an obstacle is still seen depends on its strength. That error is
the same in every ping, so a tenth to both sides of the edge (`filters.EDGE`) an echo is believed
as inside and a miss as outside.

Source: docs/obstacle.md, sections Elevation and Misses; Minka 2001, 'A family of algorithms for
approximate Bayesian inference', for the moments.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from ...acoustics.geometry import Pose
from ...estimation.arrays import BoolArray, FloatArray, replace_rows, take
from .config import ObstacleConfig
from .filters import DepthSlices, Mixture, Sonar
from .mixtures import weights
from .unscented import points, upright

REACH = 4.0
"""Standard deviations of an elevation over which a new obstacle has its slices."""
STEEPEST = 0.1
"""Cosine of 84 degrees: no sonar sees obstacles so steeply above or below."""
_LEAST = 1e-8
"""rad^2; no sonar measures an elevation to less than 0.006 degrees."""
PINGS = 10.0
"""As many pings in the beam the stated probability of a detection counts for."""
SUREST = 0.95
"""Largest p: an echo may also be given to a neighbour."""


class Elevations(NamedTuple):
    """Of D detections: angle (D,) rad below the axis of the sonar, NaN where it is not measured;
    variance (D,) rad^2."""

    angle: FloatArray
    variance: FloatArray

    def ends(self) -> FloatArray:
        """Return the angles (D, 2) between which the detections lie."""
        reach = REACH * np.sqrt(self.variance)
        return np.column_stack([self.angle - reach, self.angle + reach])

    @classmethod
    def of(cls, up: FloatArray, variance: FloatArray, config: ObstacleConfig) -> Elevations | None:
        """Return those of elevations `up` (D,) rad, as they are stated; None where none is
        measured."""
        known = np.isfinite(up) & (np.abs(up) < 0.5 * np.pi)
        if not np.count_nonzero(known):
            return None
        own = np.radians(config.elevation_std_deg) ** 2
        stated = np.isfinite(variance) & (variance > 0.0)
        return cls(
            np.where(known, -up, np.nan), np.maximum(np.where(stated, variance, own), _LEAST)
        )


def expected_elevations(mixture: Mixture, pose: Pose, cone: bool) -> tuple[FloatArray, FloatArray]:
    """The elevation (T, K) of each component, rad below the axis of the sonar, and its derivatives
    (T, K, 3) by range, azimuth and depth.

    They follow from what fixes the elevation, with n = (a, b, c) the vertical seen from the sonar
    and s the vertical offset: ``k cos eps + c sin eps = s / d``, where ``k = a cos delta + b sin
    delta``; on the cone the same for the angle eta in the x-z plane, ``sin eps = cos delta sin
    eta``.
    """
    x = mixture.x
    d, cosine, sine = x[..., 0], np.cos(x[..., 1]), np.sin(x[..., 1])
    a, b, c = upright(*pose)[1]
    m = points(x, *pose, cone)
    level = np.sqrt(m[..., 0] * m[..., 0] + m[..., 1] * m[..., 1])
    H = np.empty((*d.shape, 3))
    if not cone:
        up, along = m[..., 2] / d, level / d
        k, across = a * cosine + b * sine, b * cosine - a * sine
        turn = _at_least(c * along - k * up)
        H[..., 0] = -(k * along + c * up) / (d * turn)
        H[..., 1] = -along * across / turn
        H[..., 2] = 1.0 / (d * turn)
        return np.arctan2(m[..., 2], level), H
    r = d * cosine
    out, down = m[..., 0] / r, m[..., 2] / r
    turn = _at_least(c * out - a * down)
    ahead = a * out + c * down
    scale = cosine * out / np.maximum(level / d, STEEPEST)
    H[..., 0] = -scale * (cosine * ahead + b * sine) / (r * turn)
    H[..., 1] = -scale * (b * cosine - sine * ahead) / (cosine * turn)
    H[..., 1] -= sine * down / np.maximum(level / d, STEEPEST)
    H[..., 2] = scale / (r * turn)
    return np.arctan2(m[..., 2], level), H


def _at_least(turn: FloatArray) -> FloatArray:
    """Away from 0, where an obstacle would lie straight above or below."""
    return np.copysign(np.maximum(np.abs(turn), STEEPEST), turn)


def apply_elevations(
    mixture: Mixture, seen: Elevations, pose: Pose, config: ObstacleConfig
) -> tuple[Mixture, FloatArray]:
    """Return the obstacles after one elevation of each obstacle (T,), and the log (T,) of its
    density beside that of clutter, which is as dense at any elevation in the beam. NaN changes
    nothing. pose: of the sonar, or of one for each obstacle, see `unscented.points`."""
    known = np.flatnonzero(np.isfinite(seen.angle))
    if len(known) < len(seen.angle):
        log = np.zeros(len(seen.angle))
        if not len(known):
            return mixture, log
        theirs = take(pose, known) if pose.position.ndim > 1 else pose
        some, log[known] = apply_elevations(
            take(mixture, known), take(seen, known), theirs, config
        )
        return replace_rows(mixture, known, some), log
    x, P, mu = mixture
    angle, H = expected_elevations(mixture, pose, config.azimuth_model == 'cone')
    # Only range, azimuth and depth show.
    g = P[..., 0] * H[..., :1] + P[..., 1] * H[..., 1:2] + P[..., 2] * H[..., 2:3]
    S = g[..., 0] * H[..., 0] + g[..., 1] * H[..., 1] + g[..., 2] * H[..., 2]
    S += seen.variance[:, None]
    v = seen.angle[:, None] - angle
    with np.errstate(divide='ignore'):
        log = np.log(mu) - 0.5 * (v * v / S + np.log(2.0 * np.pi * S))
    gain = g / S[..., None]
    x1 = x + v[..., None] * gain
    P1 = P - S[..., None, None] * (gain[..., :, None] * gain[..., None, :])
    mu1, sums = weights(log, mu)
    return Mixture(x1, P1, mu1), sums + np.log(np.radians(config.vertical_fov_deg))


# -- misses ---------------------------------------------------------------------------------------


class MissEvidence(NamedTuple):
    """Of T tracks: `seen` (T,), pings with an echo; `due` (T,), pings up to the last echo in which
    the beam held the obstacle; `missed` (T,), expected number of pings since, in which it did;
    `silent` (T,), whether the newest ping had none; `shown`: the mixture with what the last echo
    and the misses since say."""

    seen: Annotated[FloatArray, 'T']
    due: Annotated[FloatArray, 'T']
    missed: Annotated[FloatArray, 'T']
    silent: Annotated[BoolArray, 'T']
    shown: Mixture

    @staticmethod
    def first(mixture: Mixture, silent: bool = False) -> MissEvidence:
        """Return that of tracks that begin, with an echo or, out of memory, without."""
        T = len(mixture.mu)
        return MissEvidence(np.ones(T), np.ones(T), np.zeros(T), np.full(T, silent), mixture)

    def predicted(
        self, filter_: DepthSlices, before: Sonar, after: Sonar, dt: float
    ) -> MissEvidence:
        """Return it as the sonar will see the obstacles `dt` seconds later."""
        silent = np.flatnonzero(self.silent)
        if not len(silent):
            return self
        later, _ = filter_.advance(take(self.shown, silent), before, after, dt)
        return self._replace(shown=replace_rows(self.shown, silent, later))

    def with_ping(
        self, hit: BoolArray, mixture: Mixture, filter_: DepthSlices, sonar: Sonar, last: Sonar
    ) -> MissEvidence:
        """Return it with one more ping, which had an echo of the tracks where `hit` (T,); last:
        the sonar in the ping before."""
        silent, fresh = np.flatnonzero(~hit), np.flatnonzero(~hit & ~self.silent)
        shown = filter_.apply_echo(mixture, sonar, sonar)
        if len(silent):
            shown = replace_rows(shown, silent, take(self.shown, silent))
        if len(fresh):
            once = filter_.apply_echo(take(mixture, fresh), sonar, last)
            shown = replace_rows(shown, fresh, once)
        due = np.where(hit, self.due + 1.0 + self.missed, self.due)
        missed = np.where(hit, 0.0, self.missed)
        if len(silent):
            mean = np.einsum('tk,tk->t', mixture.mu[silent], mixture.x[silent, :, 0])
            stated = filter_.config.detection_at(mean)
            p = (PINGS * stated + self.seen[silent]) / (PINGS + self.due[silent])
            later, inside = filter_.apply_miss(take(shown, silent), np.minimum(p, SUREST), sonar)
            shown = replace_rows(shown, silent, later)
            missed[silent] += inside
        return MissEvidence(self.seen + hit, due, missed, ~hit, shown)
