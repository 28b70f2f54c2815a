# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracks from single ranges: pings of which one arrival is received.

One range is a circle or an ellipse. Ranges from several places, of buoys in turn or of a ship that
moves, determine a position and a velocity. After `LEAST` free ranges, then at every `EVERY`-th,
the last `WINDOW` of them are fitted by (x, y, vx, vy), with a normal prior of the velocity and
with accelerations as a target of such speeds has them. The search starts at several places of the
first circle. A track starts with a side (`sides`) for each minimum, if there are at most two, if
each is known to `MOST_STD` and so well that the paths do not bend within it, and if the ranges
fit.

Ranges from a line have a mirror image. The best minimum and its image are the two sides then, and
no range of the line changes their weights. Ranges from one place start no track.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from attrs import evolve
import numpy as np

from ...estimation import bank
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import TENTATIVE
from ...estimation.rows import Rows
from ...measurements import Arrivals, NOBODY
from .config import DiverConfig
from .instruments import Layout
from .known import Known
from .models import ModelSet, start_depths, VELOCITY
from .scan import Birth, Fit, systematic_variance, tag_id, toa_variance
from .sides import Line, line_of_ping, line_through, path_noise

LEAST, EVERY, WINDOW = 5, 3, 20
"""Number of ranges of the first fit, between two fits, and of one fit at most."""

STARTS = 12
"""Number of places of the first circle where the search starts."""

STEPS = 60
"""Maximum number of steps of the search."""

MOST_STD = 10.0
"""Maximum standard deviation of a position, m, along its worst axis."""

MOST_CHI2 = 2.0
"""Maximum chi-square of a range."""

RIVAL = 9.21
"""Chi-square above the best one within which a minimum is a side: likelihood ratio of 100 to 1."""

DISTINCT = 9.0
"""Squared Mahalanobis distance beyond which two minima are two places."""

SMALLEST_GAIN = 1e-6
"""Gain in chi-square that ends a search."""

LEAST_INFORMATION = 1e-12
"""Information added to each component, so that it has an inverse."""

NO_TRACK = (
    'a ping of one arrival begins no track here: ranges from receivers that lie or move off one '
    'line are due'
)
"""Warning while single arrivals are received and no track is confirmed."""


class Ranges(NamedTuple):
    """The last single ranges, R of them."""

    stamp_ns: Annotated[IntArray, 'p'] = np.zeros(0, np.int64)
    """(R,) ns."""
    tx: Annotated[FloatArray, 'p3'] = np.zeros((0, 3))
    """(R, 3) transmitter positions, m."""
    rx: Annotated[FloatArray, 'p3'] = np.zeros((0, 3))
    """(R, 3) receiver positions, m."""
    path: Annotated[FloatArray, 'p'] = np.zeros(0)
    """(R,) path lengths, m; NaN for arrivals of tags and for ranges of a track."""
    variance: Annotated[FloatArray, 'p'] = np.zeros(0)
    """(R,) m^2."""
    free: int = 0
    """Number of single arrivals of no track since a track started from them."""
    alone: int = 0
    """The same, since a track was last confirmed."""

    def with_range(
        self, stamp_ns: int, tx: FloatArray, rx: FloatArray, path: float, variance: float
    ) -> Ranges:
        """Add a range."""
        return Ranges(
            np.append(self.stamp_ns, stamp_ns)[-WINDOW:],
            np.vstack([self.tx, tx])[-WINDOW:],
            np.vstack([self.rx, rx])[-WINDOW:],
            np.append(self.path, path)[-WINDOW:],
            np.append(self.variance, variance)[-WINDOW:],
            self.free,
            self.alone,
        )

    @property
    def line(self) -> Line | None:
        """Line of the last transmitters and receivers; None if they lie otherwise."""
        if not len(self.path):
            return None
        points = np.concatenate([self.tx[:, :2], self.rx[:, :2]])
        return line_through(points, math.sqrt(float(self.variance.mean())))

    def fit(self, config: DiverConfig) -> Fit | None:
        """Return the minima of the free ranges; None if they determine no position."""
        used = np.isfinite(self.path)
        if int(used.sum()) < LEAST:
            return None
        square = config.speed_mean**2 + config.speed_std**2
        problem = Problem(
            (self.stamp_ns[used] - self.stamp_ns[-1]) * 1e-9,
            self.tx[used],
            self.rx[used],
            self.path[used],
            self.variance[used],
            float(np.mean(start_depths(config))),
            config.velocity_std,
            0.5 * square * (1.0 - config.stay_probability) / config.reference_step,
        )
        return fit_ranges(problem, self.line)


# -- the stage -----------------------------------------------------------------------------------


def line_of(known: Known, ping: Arrivals, config: DiverConfig) -> tuple[Known, Line | None]:
    """Return the line of the instruments of a ping, or of the last ranges for a single range; and
    the state with this range."""
    rows = np.arange(len(ping))
    own = _single(ping)
    if own is None or ping.passive:
        return known, line_of_ping(ping, rows, config)
    variance = path_noise(ping, own, config) ** 2
    ranges: Ranges = known.memory['ranges']
    ranges = ranges.with_range(ping.stamp_ns, ping.tx[own[0]], ping.rx[own[0]], math.nan, variance)
    return known.with_memory(ranges=ranges), ranges.line


def births_from_range(
    known: Known, ping: Arrivals, free: BoolArray, config: DiverConfig
) -> tuple[Known, list[Birth]]:
    """Return the birth that a free single range completes, if any, and the state with it."""
    own = _single(ping)
    if own is None or not free[own[0]] or np.isfinite(ping.bearing[own[0]]):
        return known, []
    ranges: Ranges = known.memory['ranges']
    count, tracked = ranges.free + 1, (known.life.status != TENTATIVE).any()
    ranges = ranges._replace(free=count, alone=0 if tracked else ranges.alone + 1)
    fit = None
    if not ping.passive and tag_id(ping) == NOBODY:
        row = own[0]
        variance = toa_variance(ping, config)[row] + systematic_variance(ping, config)[row]
        path, noise = ranges.path.copy(), ranges.variance.copy()
        path[-1] = config.sound_speed * ping.toa[row]
        noise[-1] = config.sound_speed**2 * variance
        ranges = ranges._replace(path=path, variance=noise)
        if count >= LEAST and (count - LEAST) % EVERY == 0:
            fit = ranges.fit(config)
    if fit is None:
        return known.with_memory(ranges=ranges), []
    ranges = ranges._replace(path=np.full(len(ranges.path), np.nan), free=0, alone=0)
    birth = Birth(fit.x[0, :2], fit.P[0, :2, :2], measured=False, fit=fit)
    return known.with_memory(ranges=ranges), [birth]


def warnings(known: Known) -> list[str]:
    """Return the warning while single arrivals start no track."""
    tracked = (known.life.status != TENTATIVE).any()
    return [NO_TRACK] if known.memory['ranges'].alone >= LEAST and not tracked else []


def _single(ping: Arrivals) -> IntArray | None:
    """Return the row (1,) of a ping of one arrival; None for others."""
    rows = np.flatnonzero(np.isfinite(ping.toa))
    if len(rows) != 1 or not (ping.passive or np.isfinite(ping.tx[rows[0]]).all()):
        return None
    return rows


def fitted_rows(fit: Fit, models: ModelSet, layout: Layout, sensor: int) -> Rows:
    """Return the rows of a track: a side for each minimum of the fit."""
    table: Rows | None = None
    for k, (x, P, weight) in enumerate(zip(fit.x, fit.P, fit.weight)):
        states = models.initial_states(x[None, :2], P[None, :2, :2], measured=False)
        at, covariance = layout.with_new_constants(*states[:2])
        if models.families is not None:
            own = np.flatnonzero(models.families.kind == VELOCITY)
            at[:, :, own, :4], covariance[:, :, own, :4, :4] = x, P
        share = math.log(weight / models.rows_per_track)
        rows = models.make_rows(at, covariance, states[2], np.full(at.shape[:2], share), sensor)
        if models.families is not None:
            rows = _with_headings(rows, models, int(own[0]))
        key = {**rows.key, 'side': np.full(len(rows), k)}
        rows = evolve(rows, key=key)
        table = rows if table is None else table.append(rows)
    assert table is not None
    return table


def _with_headings(rows: Rows, models: ModelSet, source: int) -> Rows:
    """Return the rows with the states of all models, and the weights of headings, from those of
    the velocity `source`."""
    only = np.zeros_like(rows.mu)
    only[:, source] = 1.0
    transition = np.broadcast_to(models.initial, (1, *models.chain.matrix.shape))
    blocks, mu = bank.mix(models.bank, rows.blocks, only, transition)
    return rows.replace(blocks=tuple(blocks), mu=mu / mu.sum(axis=1, keepdims=True))


# -- the fit -------------------------------------------------------------------------------------


class Problem(NamedTuple):
    """R path lengths to fit."""

    time: FloatArray
    """(R,) s; 0 is the time of the fit."""
    tx: FloatArray
    """(R, 3) m."""
    rx: FloatArray
    """(R, 3) m."""
    path: FloatArray
    """(R,) m."""
    variance: FloatArray
    """(R,) m^2."""
    height: float
    """z of the target, m."""
    velocity_std: float
    """Prior standard deviation of the velocity on each axis, m/s."""
    acceleration: float
    """Spectral density of the acceleration on each axis, m^2/s^3: the target may turn."""


def fit_ranges(problem: Problem, line: Line | None) -> Fit | None:
    """Fit position and velocity at time 0.

    :param line: line of the instruments.
    :returns: None without a position: see the module.
    """
    x, cost, A = _search(problem)
    good = np.isfinite(cost)
    if not good.any() or cost[good].min() > MOST_CHI2 * len(problem.path):
        return None
    P = np.full((len(x), 4, 4), np.nan)
    P[good] = np.linalg.inv(A[good])
    kept: list[int] = []
    for k in np.argsort(np.where(good, cost, np.inf), kind='stable').tolist():
        if not good[k] or cost[k] > cost[good].min() + RIVAL:
            break
        apart = x[kept] - x[k]
        if all(d @ A[k] @ d > DISTINCT for d in apart):
            kept.append(k)
    if line is not None:
        kept = kept[:1]
    worst = np.linalg.eigvalsh(P[kept][:, :2, :2])[:, -1]
    if len(kept) > 2 or not (worst < MOST_STD**2).all() or not (worst > 0.0).all():
        return None
    if not all(_is_straight(x[k], variance, problem) for k, variance in zip(kept, worst)):
        return None
    weight = np.exp(-0.5 * (cost[kept] - cost[kept].min())) * np.sqrt(np.linalg.det(P[kept]))
    found = Fit(x[kept], P[kept], weight / weight.sum())
    return found if line is None else _with_image(found, line)


def _is_straight(x: FloatArray, variance: float, problem: Problem) -> bool:
    """Return whether the paths bend by less than a standard deviation within the `variance` of a
    position: one Gaussian describes it then.

    x: (4,).
    """
    place = np.full((len(problem.time), 3), problem.height)
    place[:, :2] = x[:2] + problem.time[:, None] * x[2:]
    bend = sum(
        1.0 / np.maximum(np.linalg.norm(place - instrument, axis=1), 1.0)
        for instrument in (problem.tx, problem.rx)
    )
    return bool((0.5 * variance * bend < np.sqrt(problem.variance)).all())


def _with_image(fit: Fit, line: Line) -> Fit:
    """Return a fit of one minimum with its image."""
    T = np.kron(np.eye(2), line.matrix)
    image = fit.x @ T
    image[:, :2] = line.image(fit.x[:, :2])
    return Fit(
        np.concatenate([fit.x, image]),
        np.concatenate([fit.P, T @ fit.P @ T]),
        np.full(2, 0.5),
    )


def _search(problem: Problem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the ends x (S, 4) of the searches by Levenberg and Marquardt, their chi-squares (S,),
    infinite without convergence, and information matrices (S, 4, 4)."""
    angle = 2.0 * math.pi * np.arange(STARTS) / STARTS
    x = np.zeros((STARTS, 4))
    x[:, :2] = 0.5 * (problem.tx[0] + problem.rx[0])[:2]
    x[:, :2] += 0.5 * problem.path[0] * np.column_stack([np.cos(angle), np.sin(angle)])
    cost, A, b = _normal_equations(x, problem)
    damping, settled = np.full(STARTS, 1e-2), np.zeros(STARTS, np.bool_)
    for _ in range(STEPS):
        damped = A + damping[:, None, None] * A * np.eye(4)
        step = np.linalg.solve(damped, b[..., None])[..., 0]
        trial = _normal_equations(x + step, problem)
        better = trial[0] <= cost
        settled |= better & (cost - trial[0] < SMALLEST_GAIN)
        x = np.where(better[:, None], x + step, x)
        cost, A, b = (
            np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
            for new, old in zip(trial, (cost, A, b))
        )
        damping = np.clip(np.where(better, 0.2 * damping, 5.0 * damping), 1e-9, 1e9)
        # Where C changes with x, no step may be downhill any more.
        settled |= damping >= 1e9
        if settled.all():
            break
    return x, np.where(settled, cost, np.inf), A


def _normal_equations(
    x: FloatArray, problem: Problem
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return chi-square (S,), information (S, 4, 4) and gradient (S, 4) at x (S, 4).

    The covariance C of the residuals holds the noise of the ranges, and how far accelerations may
    have moved the target from the straight path: an integrated random walk of the velocity.
    """
    time = problem.time
    place = np.full((len(x), len(time), 3), problem.height)
    place[..., :2] = x[:, None, :2] + time[:, None] * x[:, None, 2:]
    expected, slope = np.zeros((len(x), len(time))), np.zeros((len(x), len(time), 2))
    for instrument in (problem.tx, problem.rx):
        apart = place - instrument
        distance = np.maximum(np.sqrt(np.square(apart).sum(axis=-1)), 1e-6)
        expected += distance
        slope += apart[..., :2] / distance[..., None]
    residual = problem.path - expected
    early, late = np.maximum.outer(-time, -time), np.minimum.outer(-time, -time)
    wander = problem.acceleration * late**2 * (3.0 * early - late) / 6.0
    C = wander * (slope @ np.swapaxes(slope, 1, 2)) + np.diag(problem.variance)
    H = np.concatenate([slope, slope * time[:, None]], axis=-1)
    weighted = np.linalg.solve(C, np.concatenate([H, residual[..., None]], axis=-1))
    prior = np.array([0.0, 0.0, 1.0, 1.0]) / problem.velocity_std**2
    cost = (residual * weighted[..., 4]).sum(axis=1) + (prior * x**2).sum(axis=1)
    information = np.swapaxes(H, 1, 2) @ weighted[..., :4] + np.diag(prior + LEAST_INFORMATION)
    gradient = (H * weighted[..., 4:]).sum(axis=1) - prior * x
    return cost, information, gradient
