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

"""What innovations say of the stated covariances of fixes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.consistency import FARTHEST

MEMORY = 50.0
"""Fixes over which `FixConsistency` is gathered and forgotten."""

OPTIMISTIC, PESSIMISTIC, CORRELATED = 1.7, 0.5, 0.3
"""Mean NIS for each coordinate above and below which, and lag-1 correlation above which, a
covariance is not what it says. Of `MEMORY` fixes with true covariances the mean has a standard
deviation of 0.14, so that the first is five sigmas away: motion takes up a part of errors that are
larger than stated, and leaves a mean of about 2 however much larger they are."""

TOO_SMALL, ENOUGH = 2.0, 12.0
"""Scale of the covariances of fixes above which they are too small to be left as they are, and the
sum of the logarithms of what was above it, over groups of fixes in turn, that is evidence enough:
8 groups where the scale is 10, 17 where it is 4. Of true covariances the sum stayed below 4 in
four hours of the scenes of `simulate`."""


class FixConsistency(NamedTuple):
    """When a stated covariance of fixes cannot be true, and what innovations cannot tell: sums
    over the last fixes of confirmed tracks.

    number of fixes; nis, for each coordinate; pairs of successive fixes, their cross product and
    mean square of whitened innovations; of `families` the scale of the covariances that the copies
    of the filter tell, and the evidence (`ENOUGH`) that it is above `TOO_SMALL`.

    Innovations of a filter with true covariances have a mean NIS of their number of coordinates
    (2) and are white; one beyond three sigmas for each coordinate is a sharp turn and counts as
    that. Larger: the covariances are optimistic, and may be scaled up. Smaller, or correlated from
    fix to fix: the source filters its output, so that its errors last, or its covariances are
    pessimistic. These two look the same. And a source that states only the white part of errors
    that last looks perfect: from one sensor, a bias slower than the motion is not in the
    innovations. So a covariance is never scaled down on this evidence; `warnings` says what the
    user has to state.
    """

    number: float = 0.0
    nis: float = 0.0
    pairs: float = 0.0
    cross: float = 0.0
    square: float = 0.0
    scale: float = 1.0
    evidence: float = 0.0

    def with_fixes(self, white: FloatArray, before: FloatArray) -> FixConsistency:
        """Return the sums with whitened innovations (k, 2), and those of the fix `before` (k, 2)
        of the same tracks, NaN for none, of which about the last `MEMORY` count.

        An innovation longer than `FARTHEST` allows is a sharp turn and says nothing of noise: it
        is shortened to that."""
        white, before = _shorten(white), _shorten(before)
        paired = np.isfinite(before).all(axis=1)
        own, earlier = white[paired], before[paired]
        total = self.number + len(white)
        kept = min(1.0, MEMORY / total) if total else 1.0
        return self._replace(
            number=kept * total,
            nis=kept * (self.nis + 0.5 * float(np.square(white).sum())),
            pairs=kept * (self.pairs + len(own)),
            cross=kept * (self.cross + float((own * earlier).sum())),
            square=kept
            * (self.square + 0.5 * float(np.square(own).sum() + np.square(earlier).sum())),
        )

    def with_scale(self, scale: FloatArray, tentative: BoolArray) -> FixConsistency:
        """Return this after fixes whose covariances were taken `scale` (k,) times, by tracks of
        which some are `tentative` (k,)."""
        if tentative.all():
            return self
        # What one track takes for true is true; others may be on the wrong fixes.
        least = float(scale[~tentative].min())
        evidence = max(self.evidence + math.log(least / TOO_SMALL), 0.0)
        return self._replace(scale=least, evidence=evidence)

    @property
    def mean_nis(self) -> float:
        """For each coordinate, 1 where all is well; NaN without a fix."""
        return self.nis / self.number if self.number else float('nan')

    @property
    def lag_1(self) -> float:
        """Correlation of successive whitened innovations; NaN without a pair."""
        return self.cross / self.square if self.square else float('nan')

    def warnings(self, bias_stated: bool) -> list[str]:
        """Sentences on covariances that cannot be true: of `families` as soon as the evidence is
        enough, else once `MEMORY` fixes were seen."""
        if self.evidence >= ENOUGH:
            times = self.scale * max(self.mean_nis, 1.0)
            return [
                f'fixes scatter some {math.sqrt(times):.2g} times as far as they state: their '
                f'covariances are {times:.2g} times too small; multiply covariance_scale by that'
            ]
        if self.number < 0.99 * MEMORY:
            return []
        if self.mean_nis > OPTIMISTIC:
            return [
                f'fixes miss by more than they state: mean NIS {self.mean_nis:.2g} for each '
                'coordinate, 1 is due; raise covariance_scale (model_set families finds out by '
                'how much) or the noise of the motion'
            ]
        if not bias_stated and (self.mean_nis < PESSIMISTIC or self.lag_1 > CORRELATED):
            return [
                f'the errors of the fixes last, or their covariances are too large (mean NIS '
                f'{self.mean_nis:.2g} for each coordinate, correlation {self.lag_1:.2g} from fix '
                'to fix); the data cannot tell which: state fix_bias_std and fix_bias_time'
            ]
        return []


def whiten_innovations(
    mean: FloatArray,
    covariance: FloatArray,
    z: FloatArray,
    R: FloatArray,
    before: FloatArray,
    tentative: BoolArray,
    known: FixConsistency,
) -> tuple[FloatArray, FixConsistency]:
    """Return the whitened innovations (k, 2) of fixes z (k, 2), R (k, 2, 2) of k tracks, and what
    is `known` of them with those of confirmed tracks.

    mean (k, 2), covariance (k, 2, 2): the fix that a mixture expects; before (k, 2): the whitened
    innovation of its last fix; tentative (k,).
    """
    S = covariance + R
    # The inverse of the Cholesky factor of 2 x 2, written out.
    with np.errstate(invalid='ignore', divide='ignore'):
        a = np.sqrt(S[:, 0, 0])
        b = S[:, 1, 0] / a
        first = (z[:, 0] - mean[:, 0]) / a
        second = (z[:, 1] - mean[:, 1] - b * first) / np.sqrt(S[:, 1, 1] - b * b)
    white = np.column_stack([first, second])
    firm = ~tentative & np.isfinite(white).all(axis=1)
    return white, known.with_fixes(white[firm], before[firm])


def _shorten(white: FloatArray) -> FloatArray:
    """Return whitened innovations (k, 2) that are no longer than `FARTHEST` allows."""
    square = np.square(white).sum(axis=1, keepdims=True)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.where(square > 2.0 * FARTHEST, np.sqrt(2.0 * FARTHEST / square), 1.0) * white
