# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Coverage: the detection probability of a sensor as a function of the target position.

Targets outside the sector of a sonar cannot be detected, so they count no miss. With a configured
coverage

* a track is detected with the mean probability over its density, ``p_t = E[p(x)]``, and a fix at z
  has the detection probability ``p(z)`` (`DetectionProbability`);
* a miss changes the density of each model to ``(1 - p(x)) N(x; m, P)``, so that a target that left
  the coverage is predicted outside (`apply_misses`). Expectations are means over `POINTS`;
* a miss has the weight ``ln(1 - p_t) / ln(1 - p)``, with p the configured `detection_probability`
  (feature `miss_weight`).

A `Coverage` is a sector with constant probability, or a table over x and y or over range, read
from a file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from statistics import NormalDist

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import TENTATIVE
from ...estimation.bank import Gaussians
from .config import DiverConfig
from .coverage_map import Coverage, DetectionProbability, MOST
from .known import Feature, Known, track_positions
from .models import ModelSet
from .scan import Group

FEATURES = {'miss_weight': Feature(0.0)}
"""miss_weight: accumulated weight of misses that are not counted yet."""

POINTS_OF_MODEL = 64
"""Number of points per model."""

GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Golden ratio."""

LEAST = 0.01
"""Minimum detection probability at a fix, because coverages are not exact."""

LEAST_LOOK = 0.25
"""Minimum miss weight of a tentative track, so that rarely detected tracks end."""

FAR_OUT = 2.5
"""Stretch of the points of a track. If the probability is constant over the stretched points, the
models are not evaluated."""

NOWHERE, NO_COVARIANCE = np.empty((0, 2)), np.empty((0, 2, 2))
"""No fixes."""


def _points() -> FloatArray:
    """Return (64, 2) points of equal weight with the moments of a standard normal distribution.

    A Fibonacci lattice, so that an edge of any direction crosses the points one by one.
    """
    place = (np.arange(POINTS_OF_MODEL) + 0.5) / POINTS_OF_MODEL
    other = (place + np.arange(POINTS_OF_MODEL) * GOLDEN) % 1.0
    quantile = [[NormalDist().inv_cdf(u) for u in axis.tolist()] for axis in (place, other)]
    points = np.array(quantile).T - np.mean(quantile, axis=1)
    return np.asarray(
        np.linalg.solve(np.linalg.cholesky(points.T @ points), points.T).T * POINTS_OF_MODEL**0.5
    )


POINTS = _points()


def detection_stage(
    stated: Mapping[str, Coverage], models: ModelSet
) -> Callable[[Known, Group], Known]:
    """Return the stage that computes the detection probabilities of a group of fixes."""

    def detect(known: Known, group: Group) -> Known:
        coverage = sensor_coverage(stated, group.sensor, group.config)
        if coverage is not None and group.target_id is None:
            p = group.config.detection_probability
            group.detection = detection_probability(known, models, coverage, p, group.z, group.R)
        return known

    return detect


def miss_stage(
    models: ModelSet, moves_all: Callable[[Known], bool]
) -> Callable[[Known, Group], Known]:
    """Return the stage that applies misses. moves_all: whether an update may change the whole
    state."""

    def miss(known: Known, group: Group) -> Known:
        if not group.is_complete or group.target_id is not None:
            return known
        association = group.association
        assert association is not None
        exists = np.maximum(association.exists, 1e-300)
        share = np.where(association.hit, 0.0, np.minimum(association.missed / exists, 1.0))
        return apply_misses(known, models, group.detection, share, moves_all(known))

    return miss


def sensor_coverage(
    stated: Mapping[str, Coverage], sensor: str, config: DiverConfig
) -> Coverage | None:
    """Return the coverage of a sensor; None for no limits."""
    return stated.get(sensor if sensor in config.sensors else '')


def detection_probability(
    known: Known,
    models: ModelSet,
    coverage: Coverage,
    p: float,
    z: FloatArray = NOWHERE,
    R: FloatArray = NO_COVARIANCE,
) -> DetectionProbability:
    """Return the detection probabilities of tracks, and at fixes z (D, 2), R (D, 2, 2).

    p: nominal probability inside the coverage.
    """
    tentative = known.life.status == TENTATIVE
    tracks, same = _constant_probability(
        known, models, coverage, p, np.where(tentative, 1.0, FAR_OUT)
    )
    if not same.all():
        rows = known.rows
        selected = np.flatnonzero(~same[rows.target])
        at = np.concatenate(
            [
                coverage.probability(_model_points(block.select(selected)), p).mean(axis=-1)
                for block in rows.blocks
            ],
            axis=1,
        )
        of_row = rows.weight[selected] * (rows.mu[selected] * at).sum(axis=1)
        whole = np.bincount(rows.target[selected], of_row, minlength=len(known))
        tracks = np.where(same, tracks, whole)
    there = coverage.probability(_sigma_points(z, R), p).mean(axis=1)
    return DetectionProbability(coverage, p, np.minimum(tracks, MOST), np.clip(there, LEAST, MOST))


def apply_misses(
    known: Known,
    models: ModelSet,
    seen: DetectionProbability | None,
    share: FloatArray,
    moves_all: bool,
) -> Known:
    """Update the tracks by a miss, which has the probability `share` (T,).

    :param seen: None for a sensor without limits.
    :param moves_all: False if an update may not change the whole state. Then only models and rows
        are weighted.
    """
    if seen is None:
        return known.with_columns(miss_weight=known['miss_weight'] + 1.0)
    coverage, p = seen.coverage, seen.nominal
    tentative = known.life.status == TENTATIVE
    looks = np.where(tentative, np.maximum(seen.miss_weight, LEAST_LOOK), seen.miss_weight)
    known = known.with_columns(miss_weight=known['miss_weight'] + looks)
    selected = (share > 0.0) & ~tentative
    if not selected.any():
        return known
    far_out = np.full(len(known), FAR_OUT)
    selected &= ~_constant_probability(known, models, coverage, p, far_out)[1]
    rows = known.rows
    own = np.flatnonzero(selected[rows.target])
    if not len(own):
        return known
    factor, blocks = np.ones(rows.mu.shape), []
    for part, block in zip(models.parts, rows.blocks):
        points = _model_points(block.select(own))
        left = 1.0 - share[rows.target[own], None, None] * coverage.probability(points, p)
        factor[own[:, None], np.arange(part.models.start, part.models.stop)] = left.mean(axis=-1)
        blocks.append(_condition_on_miss(block, own, points, left) if moves_all else block)
    rows, total = rows.replace(blocks=tuple(blocks)).multiply_models(factor)
    logw = rows.logw + np.log(np.maximum(total, 1e-300))
    # Keep the total weight of rows, because borrowed weights do not change.
    sums = rows.log_sum(known.rows.logw) - rows.log_sum(logw)
    return known.replace(rows=rows.replace(logw=logw + sums[rows.target]))


def _condition_on_miss(
    block: Gaussians, own: np.ndarray, points: FloatArray, left: FloatArray
) -> Gaussians:
    """Condition the rows `own` (k,) of a block on a miss: points (k, m, 64, 2), weights `left` (k,
    m, 64)."""
    weight = left / left.sum(axis=-1, keepdims=True)
    mean = np.einsum('rmk,rmka->rma', weight, points)
    apart = points - mean[:, :, None]
    spread = np.einsum('rmk,rmka,rmkb->rmab', weight, apart, apart)
    x, P = (np.moveaxis(part, -1, 1) for part in block.select(own))
    before = P[..., :2, :2]
    # Other components move by their regression on the position.
    gain = np.swapaxes(np.linalg.solve(before, P[..., :2, :]), -1, -2)
    moved = x + np.einsum('rmna,rma->rmn', gain, mean - x[..., :2])
    grown = P + gain @ (spread - before) @ np.swapaxes(gain, -1, -2)
    after_x, after_P = block.x.copy(), block.P.copy()
    after_x[own] = np.moveaxis(moved, 1, -1)
    after_P[own] = np.moveaxis(0.5 * (grown + np.swapaxes(grown, -1, -2)), 1, -1)
    return Gaussians(after_x, after_P)


def _model_points(block: Gaussians) -> FloatArray:
    """Return the points (N, m, 64, 2) of all models."""
    place, covariance = block.x[:, :2], block.P[:, :2, :2]
    return _sigma_points(np.moveaxis(place, -1, 1), np.moveaxis(covariance, -1, 1))


def _constant_probability(
    known: Known, models: ModelSet, coverage: Coverage, p: float, stretch: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the detection probability (T,) at each track, and whether it is constant over the
    points stretched by `stretch` (T,)."""
    if not len(known):
        return np.empty(0), np.empty(0, np.bool_)
    mean, covariance = track_positions(known, models)
    at = coverage.probability(_sigma_points(mean, stretch[:, None, None] ** 2 * covariance), p)
    return at[:, 0], at.max(axis=1) == at.min(axis=1)


def _sigma_points(mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (..., 64, 2) points of normal distributions, mean (..., n), covariance (..., n, n),
    position first."""
    # By the Cholesky factor, written out.
    a = np.sqrt(np.maximum(covariance[..., 0, 0], 1e-12))
    b = covariance[..., 1, 0] / a
    c = np.sqrt(np.maximum(covariance[..., 1, 1] - b * b, 0.0))
    x = mean[..., 0, None] + a[..., None] * POINTS[:, 0]
    y = mean[..., 1, None] + b[..., None] * POINTS[:, 0] + c[..., None] * POINTS[:, 1]
    return np.stack([x, y], axis=-1)
