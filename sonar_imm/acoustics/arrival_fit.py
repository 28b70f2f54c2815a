# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The likelihood of a position given one ping, and its minima: the engine under `localisation`.

All usable rows of a ping, arrival times in metres and bearings in radians, become one
least-squares problem in x and y. The unknown time of emission of passive rows enters linearly, so
it is solved in closed form and projected out of the residuals and the Jacobian (variable
projection), which leaves two unknowns in every case.

The sum of squares has several minima: two ellipses cross at two points or more, and so do two
hyperbolas. The search therefore starts where the ellipse of one arrival comes nearest to the
others, or on a polar grid where there is no ellipse, and a Levenberg-Marquardt iteration runs from
all starts at once.
"""

from __future__ import annotations

from attrs import astuple, frozen
import numpy as np
from scipy.spatial.distance import cdist

from ..estimation.angles import wrap_angle
from ..estimation.arrays import BoolArray, FloatArray, IndexArray
from .multistatic import bearing, bearing_jacobian, slant_range

ELLIPSES = 4
ELLIPSE_ANGLES = 96
GRID_RADII = 24
GRID_ANGLES = 36
MAX_STARTS = 32
MAX_ITERATIONS = 60
CURVED_AFTER = 8
SMALLEST_GAIN = 1e-5
"""A step ends the iteration when it promises to lower chi-square by less than this share of it (or
1e-10)."""
FAR = 10.0
"""A run further out than this many `max_range` is given up where it is."""
SAME_POINT = 1e-3
"""Minima closer than this, in metres, are one."""


@frozen(eq=False)
class ArrivalFit:
    """One ping as a least-squares problem over m rows: n arrival times first, then the bearings.

    tx (n, 3) equals rx where the row is passive; rx (n, 3); active (n,); bearing_rx (m - n, 3);
    observed (m,) in metres and radians; weight (m,) inverse variances; target_z and max_range in
    metres; epoch: the time in s from which the passive times in `observed` count.
    """

    tx: FloatArray
    rx: FloatArray
    active: BoolArray
    bearing_rx: FloatArray
    observed: FloatArray
    weight: FloatArray
    target_z: float
    max_range: float
    epoch: float = 0.0

    @property
    def centre(self) -> FloatArray:
        """Middle (2,) of all instruments: plausible positions lie within `max_range` of it."""
        return np.concatenate([self.tx, self.rx, self.bearing_rx])[:, :2].mean(axis=0)

    def residuals(self, position: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (k, m) and Jacobian of the prediction (k, m, 2) at positions (k, 2), the
        emission time at its best for the `weight` (m,) or (k, m)."""
        distance, jacobian = slant_range(position, self.rx, self.target_z)
        residual = self.observed[: len(self.rx)] - distance
        if self.active.any():
            distance, direction = slant_range(position, self.tx, self.target_z)
            residual = residual - self.active * distance
            jacobian = jacobian + self.active[:, None] * direction
        if not self.active.all():
            share = self._emission_share(weight)
            residual = residual - ~self.active * (share * residual).sum(axis=-1, keepdims=True)
            common = (share[..., None] * jacobian).sum(axis=-2, keepdims=True)
            jacobian = jacobian - ~self.active[:, None] * common
        if len(self.bearing_rx):
            residual = np.concatenate([residual, self._bearing_residual(position)], axis=-1)
            across = bearing_jacobian(position, self.bearing_rx)
            jacobian = np.concatenate([jacobian, across], axis=-2)
        return residual, jacobian

    def cost(self, position: FloatArray, weight: FloatArray) -> FloatArray:
        """Chi-square (k,) at positions (k, 2) for `weight` (m,): the residuals alone, for many
        positions."""
        place = np.column_stack([position, np.full(len(position), self.target_z)])
        residual = self.observed[: len(self.rx)] - cdist(place, self.rx)
        if self.active.any():
            residual -= self.active * cdist(place, self.tx)
        if not self.active.all():
            residual -= ~self.active * (residual @ self._emission_share(weight))[:, None]
        cost = np.square(residual) @ weight[: len(self.rx)]
        if len(self.bearing_rx):
            cost = cost + np.square(self._bearing_residual(position)) @ weight[len(self.rx) :]
        return cost

    def curvature(self, position: FloatArray, pull: FloatArray) -> FloatArray:
        """Second derivative of the ranges at positions (k, 2), summed over the rows with the
        weights `pull` (k, m): (k, 2, 2). Bearings are left out: their part is small."""
        total = np.zeros((len(position), 2, 2))
        for points, share in ((self.rx, np.ones(len(self.rx))), (self.tx, self.active)):
            if share.any():
                distance, direction = slant_range(position, points, self.target_z)
                bend = share * pull[:, : len(points)] / np.maximum(distance, 1e-3)
                along = np.swapaxes(direction * bend[..., None], -1, -2) @ direction
                total += bend.sum(axis=-1)[:, None, None] * np.eye(2) - along
        return total

    def _bearing_residual(self, position: FloatArray) -> FloatArray:
        return wrap_angle(self.observed[len(self.rx) :] - bearing(position, self.bearing_rx))

    def _emission_share(self, weight: FloatArray) -> FloatArray:
        """Share (..., n) of each passive row in the estimate of the time of emission."""
        passive = weight[..., : len(self.rx)] * ~self.active
        return passive / np.maximum(passive.sum(axis=-1, keepdims=True), 1e-300)

    def starts(self, weight: FloatArray) -> FloatArray:
        """Positions (k, 2) near which the minima for `weight` (m,) must be, best first."""
        kept = weight[: len(self.rx)] > 0.0
        ellipses, passive = np.flatnonzero(self.active & kept), np.flatnonzero(~self.active & kept)
        grid = self._ellipses(ellipses) if len(ellipses) else self._polar_grid()
        cost = self.cost(grid.reshape(-1, 2), weight).reshape(grid.shape[:2])
        lowest = (cost <= np.roll(cost, 1, axis=1)) & (cost <= np.roll(cost, -1, axis=1))
        if not len(ellipses):
            walled = np.pad(cost, ((1, 1), (0, 0)), constant_values=np.inf)
            lowest &= (cost <= walled[:-2]) & (cost <= walled[2:])
        found = grid[lowest][np.argsort(cost[lowest], kind='stable')[:MAX_STARTS]]
        return np.concatenate([self._closed_form(passive), found]) if len(passive) > 2 else found

    def _ellipses(self, rows: IndexArray) -> FloatArray:
        """Points (ellipses, angles, 2) on the ellipses of the most accurate of `rows`."""
        rows = rows[np.argsort(-self.weight[rows], kind='stable')[:ELLIPSES]]
        baseline = (self.tx - self.rx)[rows, :2]
        separation = np.hypot(baseline[:, 0], baseline[:, 1])
        # A range sum short of the baseline (noise) still gets a thin ellipse around it.
        path = np.maximum(self.observed[rows], 1.0001 * separation + 1e-3)
        major = np.where(separation[:, None] > 0.0, baseline, [1.0, 0.0])
        major /= np.hypot(major[:, :1], major[:, 1:])
        minor = np.column_stack([-major[:, 1], major[:, 0]])
        angle = np.linspace(0.0, 2.0 * np.pi, ELLIPSE_ANGLES, endpoint=False)
        along = 0.5 * path[:, None] * np.cos(angle)
        across = 0.5 * np.sqrt(np.square(path) - np.square(separation))[:, None] * np.sin(angle)
        middle = 0.5 * (self.tx + self.rx)[rows, None, :2]
        return middle + along[..., None] * major[:, None] + across[..., None] * minor[:, None]

    def _polar_grid(self) -> FloatArray:
        """Points (radii, angles, 2) around the centre, radii growing to `max_range`."""
        angle = np.linspace(0.0, 2.0 * np.pi, GRID_ANGLES, endpoint=False)
        instruments = np.concatenate([self.rx, self.bearing_rx])[:, :2]
        aperture = np.abs(instruments - self.centre).max()
        smallest = min(max(0.05 * aperture, 1e-3 * self.max_range), 0.5 * self.max_range)
        radius = np.geomspace(smallest, self.max_range, GRID_RADII)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return self.centre + radius[:, None, None] * direction

    def _closed_form(self, rows: IndexArray) -> FloatArray:
        """The two positions (2, 2) at which the spheres of three or more passive rows meet.

        Squaring m_i - b = |p - rx_i| leaves A (x, y, b) = (s 1 + k) / 2 with s = x^2 + y^2 - b^2:
        solved as if s were known, then s from a quadratic. Source: S. Bancroft, "An algebraic
        solution of the GPS equations", IEEE Trans. AES 21(1), 1985, with the height of the target
        known.
        """
        sensor, measured = self.rx[rows, :2] - self.centre, self.observed[rows]
        height = self.target_z - self.rx[rows, 2]
        constant = np.square(sensor).sum(axis=-1) + np.square(height) - np.square(measured)
        sides = 0.5 * np.column_stack([np.ones(len(rows)), constant])
        (u, v) = np.linalg.lstsq(np.column_stack([sensor, -measured]), sides, rcond=None)[0].T
        metric = np.array([1.0, 1.0, -1.0])
        a, b, c = u @ (metric * u), 2.0 * u @ (metric * v) - 1.0, v @ (metric * v)
        # Noise can push the two meeting points past each other: then the one between them serves.
        spread = np.sqrt(max(b * b - 4.0 * a * c, 0.0))
        larger = -0.5 * (b + np.copysign(spread, b))
        roots = np.array([larger / a if a else 0.0, c / larger if larger else 0.0])
        meeting = self.centre + (roots[:, None] * u + v)[:, :2]
        return np.where(np.isfinite(meeting), meeting, self.centre)


@frozen(eq=False)
class Minima:
    """Where the search ended: position (k, 2), cost (k,), information (k, 2, 2) and whether it
    converged (k,)."""

    position: FloatArray
    cost: FloatArray
    information: FloatArray
    converged: BoolArray

    def distinct(self) -> Minima:
        """The converged ones, best first, each once (starts may meet in one minimum)."""
        order = np.flatnonzero(self.converged)
        order = order[np.argsort(self.cost[order], kind='stable')]
        gap = np.abs(self.position[order, None] - self.position[order]).max(axis=-1)
        order = order[~np.tril(gap < SAME_POINT, -1).any(axis=1)]
        return Minima(*(values[order] for values in astuple(self)))

    def joined(self, other: Minima) -> Minima:
        """Both sets as one."""
        return Minima(*(np.concatenate(pair) for pair in zip(astuple(self), astuple(other))))


def minimise(fit: ArrivalFit, starts: FloatArray, weight: FloatArray) -> Minima:
    """Levenberg-Marquardt from every start (k, 2) at once; `weight` (m,), or (k, m) by start.

    Runs towards a minimum with large residuals, a ghost or a ping with a reflection, would take
    hundreds of such steps. After `CURVED_AFTER` of them the Hessian therefore gets the second
    derivative of the ranges too (Newton), which costs more per step.
    """
    weight = np.broadcast_to(weight, (len(starts), len(fit.weight)))
    position, damping = starts.copy(), np.full(len(starts), 1e-3)
    cost, gradient, hessian, information = _expansion(fit, position, weight, False)
    converged = np.zeros(len(starts), bool)
    for iteration in range(MAX_ITERATIONS):
        step = _damped_step(hessian, information, gradient, damping)
        step = np.clip(step, -fit.max_range, fit.max_range)
        trial = _expansion(fit, position + step, weight, iteration >= CURVED_AFTER)
        better = (trial[0] <= cost) & ~converged
        # Little gain counts when damping is not the cause, or when no step at all goes downhill.
        gain = (gradient * step).sum(axis=-1)
        converged |= (gain < SMALLEST_GAIN * cost + 1e-10) & (~better | (damping <= 1.0))
        position = np.where(better[:, None], position + step, position)
        # Hyperbolas lead some runs to infinity: nothing plausible lies there, so they end.
        away = np.abs(position - fit.centre).max(axis=-1)
        converged |= away > FAR * fit.max_range
        cost = np.where(better, trial[0], cost)
        gradient = np.where(better[:, None], trial[1], gradient)
        hessian = np.where(better[:, None, None], trial[2], hessian)
        information = np.where(better[:, None, None], trial[3], information)
        damping = np.where(better, np.maximum(0.1 * damping, 1e-12), 10.0 * damping)
        if converged.all():
            break
    return Minima(position, cost, information, converged)


def _expansion(
    fit: ArrivalFit, position: FloatArray, weight: FloatArray, curved: bool
) -> tuple[FloatArray, ...]:
    """Cost (k,), half its downhill gradient (k, 2), half its Hessian, whole where `curved`, and
    the information (k, 2, 2)."""
    residual, jacobian = fit.residuals(position, weight)
    pull = weight * residual
    transposed = np.swapaxes(jacobian, -1, -2)
    information = (transposed * weight[:, None, :]) @ jacobian
    gradient = (transposed @ pull[..., None])[..., 0]
    hessian = information - fit.curvature(position, pull) if curved else information
    return (pull * residual).sum(axis=-1), gradient, hessian, information


def _damped_step(
    hessian: FloatArray, information: FloatArray, gradient: FloatArray, damping: FloatArray
) -> FloatArray:
    """Solve (H + shift I) step = gradient for 2 x 2 matrices in closed form, the shift making H
    positive definite."""
    a, b, d = hessian[:, 0, 0], hessian[:, 0, 1], hessian[:, 1, 1]
    trace = information[:, 0, 0] + information[:, 1, 1]
    smallest = 0.5 * (a + d) - np.hypot(0.5 * (a - d), b)
    shift = damping * trace + np.maximum(-2.0 * smallest, 0.0)
    a, d = a + shift, d + shift
    x, y = gradient.T
    step = np.stack([d * x - b * y, a * y - b * x], axis=-1)
    return step / np.maximum(a * d - b * b, 1e-300)[:, None]
