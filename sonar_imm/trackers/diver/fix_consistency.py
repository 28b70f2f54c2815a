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

"""When a stated covariance of fixes cannot be true, and what innovations cannot tell.

Innovations of a filter with true covariances have a mean NIS of their number of coordinates (2)
and are white; one beyond three sigmas for each coordinate is a sharp turn and counts as that.
Larger: the covariances are optimistic, and may be scaled up. Smaller, or correlated from fix to
fix: the source filters its output, so that its errors last, or its covariances are pessimistic.
These two look the same. And a source that states only the white part of errors that last looks
perfect: from one sensor, a bias slower than the motion is not in the innovations. So a covariance
is never scaled down on this evidence; `warnings` says what the user has to state.
"""

from __future__ import annotations

from attrs import frozen

from .fix_kernels import Sums

MEMORY = 50.0
"""Fixes over which the evidence is gathered and forgotten."""

OPTIMISTIC, PESSIMISTIC, CORRELATED = 1.7, 0.5, 0.3
"""Mean NIS for each coordinate above and below which, and lag-1 correlation above which, a
covariance is not what it says. Of `MEMORY` fixes with true covariances the mean has a standard
deviation of 0.14, so that the first is five sigmas away: motion takes up a part of errors that are
larger than stated, and leaves a mean of about 2 however much larger they are."""


@frozen
class FixConsistency:
    """Sums over the last fixes of confirmed tracks: count; nis, for each coordinate; pairs of
    successive fixes, their cross product and mean square of whitened innovations."""

    count: float = 0.0
    nis: float = 0.0
    pairs: float = 0.0
    cross: float = 0.0
    square: float = 0.0

    @property
    def sums(self) -> Sums:
        """All of them, as `fix_kernels.watch` takes and gives them."""
        return self.count, self.nis, self.pairs, self.cross, self.square

    @property
    def mean_nis(self) -> float:
        """For each coordinate, 1 where all is well; NaN without a fix."""
        return self.nis / self.count if self.count else float('nan')

    @property
    def lag_1(self) -> float:
        """Correlation of successive whitened innovations; NaN without a pair."""
        return self.cross / self.square if self.square else float('nan')

    def warnings(self, bias_stated: bool) -> list[str]:
        """Sentences on covariances that cannot be true, once `MEMORY` fixes were seen."""
        if self.count < 0.99 * MEMORY:
            return []
        if self.mean_nis > OPTIMISTIC:
            return [
                f'fixes miss by more than they state: mean NIS {self.mean_nis:.2g} for each '
                'coordinate, 1 is due; raise covariance_scale or the noise of the motion'
            ]
        if not bias_stated and (self.mean_nis < PESSIMISTIC or self.lag_1 > CORRELATED):
            return [
                f'the errors of the fixes last, or their covariances are too large (mean NIS '
                f'{self.mean_nis:.2g} for each coordinate, correlation {self.lag_1:.2g} from fix '
                'to fix); the data cannot tell which: state fix_bias_std and fix_bias_time'
            ]
        return []
