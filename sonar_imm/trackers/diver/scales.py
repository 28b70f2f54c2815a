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

"""Covariance scales: assumptions about how wrong reported covariances are.

Each scale of `covariance_scales` is one assumption of a track. Scales do not interact; the
likelihoods of fixes weight them, and at each scan a small fraction of the weight is redistributed
by the priors. Only probable scales have a row. The others borrow (`estimation.rows`).

Scales below 1 contribute to the mean of a track, but not to its covariance: errors of a source
that filters its output look like covariances that are reported too large.

Source: docs/diver.md, 'Scaled filters'.
"""

from __future__ import annotations

from collections.abc import Sequence

from attrs import evolve
import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.rows import Borrowed, ROW_AGAIN, ROW_LOST, Rows
from .known import Known
from .models import USUAL_SCALES

REDISTRIBUTED_FRACTION = 5e-4
"""Fraction of the scale weights that is redistributed at each scan, so that a change of the fix
quality is detected."""

MIN_PUBLISHED_SCALE = 1.0
"""Smallest scale whose rows contribute to the published covariance. Smaller scales also fit
time-correlated errors, so they contribute to the mean only."""

RARE = 1e-3
"""Prior of the first scale beyond `USUAL_SCALES`, relative to the priors of those. Beyond, the
prior decreases with the scale."""


def scale_priors(scale: FloatArray) -> FloatArray:
    """Return the priors (k,) of scales (k,), not normalised."""
    most = USUAL_SCALES[1]
    return np.where(scale <= most, 1.0, RARE * most / scale)


def redistribute_weights(known: Known, scales: Sequence[float]) -> Known:
    """Redistribute a small fraction of the scale weights by the priors.

    The fraction is spread over the scales from 1, over the smaller scales, and over these two
    groups. So the relative weights of the scales from 1 do not depend on the smaller scales. New
    tracks get the `scales` without a row.
    """
    rows, borrowed = known.rows, _with_all_scales(known, np.array(scales))
    target = np.concatenate([rows.target, borrowed.target])
    scale = np.concatenate([rows.key['scale'], borrowed.key['scale']])
    weight, prior = np.exp(np.concatenate([rows.logw, borrowed.logw])), scale_priors(scale)
    assumed, share = _same_offsets(rows, borrowed, target, weight)
    group = 2 * assumed + (scale >= MIN_PUBLISHED_SCALE)
    count = 2 * (int(assumed.max(initial=-1)) + 1)
    total, whole = (np.bincount(group, each, minlength=count) for each in (weight, prior))
    groups = (whole.reshape(-1, 2) > 0).sum(axis=1)[assumed]
    after = (1.0 - REDISTRIBUTED_FRACTION) * total[group] + share * REDISTRIBUTED_FRACTION / groups
    kept = (1.0 - REDISTRIBUTED_FRACTION) * weight / total[group]
    logw = np.log(after * (kept + REDISTRIBUTED_FRACTION * prior / whole[group]))
    N = len(rows)
    return known.replace(
        rows=rows.replace(logw=logw[:N]), borrowed=evolve(borrowed, logw=logw[N:])
    )


def _same_offsets(
    rows: Rows, borrowed: Borrowed, target: IntArray, weight: FloatArray
) -> tuple[IntArray, FloatArray | float]:
    """Return the number of the offset of each assumption, and the weight of all its assumptions.

    Weight is redistributed among the same offsets only. Borrowed scales have none.
    """
    if not rows.tail and not rows.key['aside'].any():
        return target, 1.0
    since, aside = (
        np.concatenate([rows.key[name], np.zeros(len(borrowed), rows.key[name].dtype)])
        for name in ('since', 'aside')
    )
    table = np.stack([target, since, aside], axis=1)
    place = np.unique(table, axis=0, return_inverse=True)[1].ravel()
    return place, np.bincount(place, weight)[place].astype(np.float64)


def _with_all_scales(known: Known, scales: FloatArray) -> Borrowed:
    """Return the borrowed list with the scales that tracks lack, at their priors."""
    rows, borrowed = known.rows, known.borrowed
    if len(rows) + len(borrowed) == len(known) * len(scales):
        return borrowed
    there = np.zeros((len(known), len(scales)), np.bool_)
    for each in (rows, borrowed):
        there[each.target, np.abs(each.key['scale'][:, None] - scales).argmin(axis=1)] = True
    prior = scale_priors(scales)
    share = prior / np.where(there, prior, 0.0).sum(axis=1, keepdims=True)
    target, missing = np.nonzero(~there)
    logw = np.log(share[target, missing])
    return borrowed.append(Borrowed(target, {'scale': scales[missing]}, logw))


def protected_rows(rows: Rows) -> BoolArray:
    """Return which rows (N,) are kept at any total weight.

    These are depth hypotheses, the heaviest row of each track, and rows of sufficient weight among
    scales of at least `MIN_PUBLISHED_SCALE`.
    """
    first, scale = rows.first, rows.key['scale']
    # A start depth is a state: all rows of such a track are kept, also the first.
    protected = np.maximum.reduceat(rows.key['start'], first)[rows.target] > 0
    protected &= (rows.key['offset'] < 0) & ~rows.key['aside']
    protected |= rows.logw == np.maximum.reduceat(rows.logw, first)[rows.target]
    is_published = scale >= MIN_PUBLISHED_SCALE
    return protected | (weight_without_small_scales(rows) >= ROW_LOST) & is_published


def can_restore(rows: Rows, borrowed: Borrowed) -> BoolArray:
    """Return which assumptions (B,) have sufficient weight for a row.

    For scales of at least `MIN_PUBLISHED_SCALE`, the weight among these scales is sufficient.
    """
    is_published = rows.key['scale'] >= MIN_PUBLISHED_SCALE
    total = np.add.reduceat(np.where(is_published, np.exp(rows.logw), 0.0), rows.first)
    total = total[borrowed.target]
    is_published = borrowed.key['scale'] >= MIN_PUBLISHED_SCALE
    least = np.where(is_published & (total > 0.0), total, 1.0) * ROW_AGAIN
    return np.asarray(np.exp(borrowed.logw) > least)


def weight_without_small_scales(rows: Rows) -> FloatArray:
    """Return row weights (N,) normalised over scales of at least `MIN_PUBLISHED_SCALE`."""
    return rows.weights_among(rows.key['scale'] >= MIN_PUBLISHED_SCALE)


def estimated_scales(rows: Rows) -> FloatArray:
    """Return the estimated covariance scale (T,) of each track, from scales of at least
    `MIN_PUBLISHED_SCALE`."""
    if not len(rows):
        return np.empty(0)
    return np.asarray(
        np.add.reduceat(weight_without_small_scales(rows) * rows.key['scale'], rows.first)
    )
