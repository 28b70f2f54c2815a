# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A baseline of the obstacle tracker: one Gaussian per obstacle in world coordinates.

Its filter is the unscented one, here first. Sigma points go through a function, and their weighted
mean and covariance are those of the result: exact for linear functions; for quadratic ones the
mean is exact. Components marked as angles are compared with the image of the centre point, wrapped
once, averaged and added back. Functions are vectorised: they take points (..., s, n) and give
(..., s, m).

Reference: Julier, Uhlmann, *Unscented Filtering and Nonlinear Estimation*, Proc. IEEE 92(3), 2004.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from attrs import evolve
import numpy as np

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation import kalman
from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.estimation.covariance import (
    add_jitter,
    CovarianceError,
    solve,
    symmetrise,
    transpose,
)
from sonar_imm.estimation.kalman import apply, factorise, log_density, Updated
from sonar_imm.estimation.smoothing import sigma_offsets
from sonar_imm.trackers.obstacle import mixtures, unscented
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import (
    BAND,
    beam_of,
    depth_span,
    DepthSlices,
    HeightPrior,
    Mixture,
    Sonar,
    two_way_echo,
    View,
)
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker

Function = Callable[[FloatArray], FloatArray]


class Transformed(NamedTuple):
    """A Gaussian after a function: mean (..., m), covariance (..., m, m), and its cross covariance
    (..., n, m) with the argument."""

    mean: FloatArray
    covariance: FloatArray
    cross_covariance: FloatArray


class _Cloud(NamedTuple):
    """Sigma points: offsets from the mean before (..., s, n) and after (..., s, m) the function,
    weights (s,), mean after (..., m)."""

    before: FloatArray
    after: FloatArray
    weights: FloatArray
    mean: FloatArray


def unscented_transform(
    function: Function, x: FloatArray, P: FloatArray, *, angles: BoolArray | None = None
) -> Transformed:
    """Mean and covariance of ``function(X)``, ``X ~ N(x, P)``.

    function: (..., s, n) to (..., s, m); x: (..., n); P: (..., n, n); angles: (m,), True for
    components of the result that are angles in radians (the mean of those is in [-pi, pi]).

    Raises CovarianceError when P or the result is not finite.
    """
    cloud = _transform(function, x, P, angles)
    weighted = cloud.after * cloud.weights[:, None]
    return Transformed(
        cloud.mean,
        symmetrise(transpose(weighted) @ cloud.after),
        transpose(cloud.before) @ weighted,
    )


def update(
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    h: Function,
    R: FloatArray,
    *,
    angles: BoolArray | None = None,
) -> Updated:
    """Measurement update with ``z = h(x) + v``, ``v ~ N(0, R)``.

    z: (..., m); h: (..., s, n) to (..., s, m); R: (..., m, m); angles: (m,), angles of the
    measurement.

    The covariance is ``sum w (dx - K dz)(.)' + K R K'``: squares only, equal to ``P - K S K'`` in
    exact arithmetic. Raises CovarianceError when P or ``h`` is not finite or a component of the
    innovation has no variance.
    """
    cloud = _transform(h, x, P, angles)
    weighted = cloud.after * cloud.weights[:, None]
    S, singular = add_jitter(symmetrise(transpose(weighted) @ cloud.after + R))
    factor = factorise(S, 'innovation covariance')
    cross = transpose(weighted) @ cloud.before
    gain = transpose(solve(transpose(factor), solve(factor, cross)))
    innovation = _wrap(z - cloud.mean, angles)
    rest = cloud.before - cloud.after @ transpose(gain)
    covariance = transpose(rest * cloud.weights[:, None]) @ rest + gain @ R @ transpose(gain)
    covariance, repaired = add_jitter(symmetrise(covariance))
    nis, log_likelihood = log_density(innovation, factor)
    return Updated(
        x + apply(gain, innovation),
        covariance,
        S,
        nis,
        log_likelihood,
        repaired | singular,
    )


def _transform(
    function: Function, x: FloatArray, P: FloatArray, angles: BoolArray | None
) -> _Cloud:
    before, weights = sigma_offsets(P)
    images = function(x[..., None, :] + before)
    finite = np.isfinite(images).all(axis=(-1, -2))
    if not finite.all():
        raise CovarianceError('the function is not finite at a sigma point', np.asarray(~finite))
    reference = images[..., :1, :]
    offsets = _wrap(images - reference, angles)
    mean_offset = np.einsum('s,...sm->...m', weights, offsets)
    return _Cloud(
        before,
        offsets - mean_offset[..., None, :],
        weights,
        _wrap(reference[..., 0, :] + mean_offset, angles),
    )


def _wrap(vector: FloatArray, angles: BoolArray | None) -> FloatArray:
    return vector if angles is None else np.where(angles, wrap_angle(vector), vector)


_ANGLES = np.array([False, True])


class Landmark(DepthSlices):
    """One Gaussian a target over its place in the world, north, east, depth, and the scale of the
    navigation: the unscented filter a navigator would write first."""

    n = 4
    K = 1
    behaviours: tuple[str, ...] = ('fixed',)
    moves = np.zeros(1, np.bool_)

    def __init__(self, config: ObstacleConfig):
        self.config = config
        self.model = config.azimuth_model
        self._beam = beam_of(config)
        position, _, depth = config.drift()
        self._noise = (position**2, depth**2)

    def begin(
        self, z: FloatArray, R: FloatArray, sonar: Sonar, height: HeightPrior | None = None
    ) -> Mixture:
        lowest, highest = depth_span(z, sonar, self.config)
        seen = np.zeros((len(z), 4))
        seen[:, :2], seen[:, 2] = z, sonar.pose.position[2] + 0.5 * (lowest + highest)
        covariance = np.zeros((len(z), 4, 4))
        covariance[:, :2, :2] = R
        covariance[:, 2, 2] = np.square(highest - lowest) / 12.0
        covariance[:, 3, 3] = self.config.scale_std**2

        def place(points: FloatArray) -> FloatArray:
            m = unscented.points(points, *sonar.pose, self.model == 'cone')
            return np.concatenate([geometry.to_world(sonar.pose, m), points[..., 3:]], axis=-1)

        moved = unscented_transform(place, seen, covariance)
        return Mixture(moved.mean[:, None], moved.covariance[:, None], np.ones((len(z), 1)))

    def predict_unchanged(
        self, mixture: Mixture, before: Sonar, after: Sonar, dt: float
    ) -> tuple[Mixture, int]:
        """In the drifting world of the navigation a fixed obstacle moves with the scale error."""
        level, depth = (part * dt for part in self._noise)
        F = np.eye(4)
        F[:2, 3] = (before.pose.position - after.pose.position)[:2]
        x, P, repaired = kalman.predict(
            mixture.x, mixture.P, F, np.diag([level, level, depth, 0.0])
        )
        return Mixture(x, P, mixture.mu), int(np.count_nonzero(repaired))

    def expected(
        self, mixture: Mixture, sonar: Sonar, met: Sequence[Sonar] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        seen = unscented_transform(
            lambda points: self._measure(points, sonar), mixture.x, mixture.P, angles=_ANGLES
        )
        return seen.mean, seen.covariance

    def update(
        self, mixture: Mixture, h: FloatArray, z: FloatArray, R: FloatArray, sonar: Sonar
    ) -> tuple[Mixture, FloatArray, int]:
        after = update(
            mixture.x, mixture.P, z[:, None], lambda points: self._measure(points, sonar),
            R[:, None], angles=_ANGLES,
        )  # fmt: skip
        return (
            Mixture(after.x, after.P, mixture.mu),
            after.log_likelihood[:, 0],
            int(np.count_nonzero(after.repaired)),
        )

    def view(self, mixture: Mixture, sonar: Sonar) -> View:
        x, P = mixture.x[:, 0], mixture.P[:, 0]

        def words(points: FloatArray) -> FloatArray:
            m = geometry.to_body(sonar.pose, points[..., :3])
            offset = points[..., 2] - sonar.pose.position[2]
            return np.stack([*geometry.project(m, self.model), offset], axis=-1)

        seen = unscented_transform(words, x, P, angles=np.array([False, True, False]))
        std = np.sqrt(seen.covariance[:, 2:, 2])
        low, high, above = mixtures.bands(
            np.ascontiguousarray(seen.mean[:, 2:]), std, mixture.mu, 0.5 * (1.0 - BAND)
        )
        place = mixture.x[..., :3] - sonar.pose.position
        near = np.zeros((len(x), 1, 5)), np.zeros((len(x), 1, 5, 5))
        near[0][..., :3], near[1][..., :3, :3] = place, mixture.P[..., :3, :3]
        still = np.ones((len(x), 1)), np.zeros((len(x), 2)), np.zeros((len(x), 2, 2))
        return View(
            seen.mean, seen.covariance, low, high, above, x[:, :3], P[:, :3, :3], *still, near
        )

    def visible(
        self, mixture: Mixture, pose: Pose, widest: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[FloatArray, BoolArray]:
        m = geometry.to_body(pose, mixture.x[..., :3])
        away = np.linalg.norm(m, axis=-1)
        P = np.zeros((*mixture.mu.shape, 3, 3))
        # Range, azimuth and depth, as of the sonar.
        P[..., 0, 0] = np.trace(mixture.P[..., :2, :2], axis1=-2, axis2=-1)
        P[..., 1, 1] = P[..., 0, 0] / np.square(away)
        P[..., 2, 2] = mixture.P[..., 2, 2]
        return mixtures.visible(m, P, mixture.mu, self._beam)

    def _measure(self, points: FloatArray, sonar: Sonar) -> FloatArray:
        out = geometry.to_body(sonar.pose, points[..., :3])
        if sonar.late is None:
            return np.stack(geometry.project(out, self.model), axis=-1)
        return two_way_echo(out, sonar, self.config)


class LandmarkTracker(ObstacleTracker):
    """The obstacle tracker with `Landmark` as its filter; its behaviours are not used, and of the
    navigation it knows no error but the scale."""

    def _apply_config(self, config: ObstacleConfig) -> None:
        super()._apply_config(
            evolve(config, drift_std=0.0, yaw_error_std_deg=0.0, navigation_delay_std=0.0)
        )
        self.filter = Landmark(config)
