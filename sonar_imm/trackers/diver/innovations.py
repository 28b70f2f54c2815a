# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Consistency of the fix covariances with the innovations."""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.consistency import FARTHEST

MEMORY = 50.0
"""Number of fixes over which `FixConsistency` averages."""

OPTIMISTIC, PESSIMISTIC, CORRELATED = 1.7, 0.5, 0.3
"""Limits of the NIS per coordinate, and of the lag-1 correlation.

Over `MEMORY` fixes with correct covariances, the mean NIS has a standard deviation of 0.14, so the
first limit is at five sigma. Motion absorbs part of larger errors: the NIS stays near 2 for any
excess.
"""

TOO_SMALL, MOST, ENOUGH = 2.0, 10.0, 12.0
"""Scale above which covariances are too small, the scale above which one fix counts no more, and
the evidence that triggers a warning.

The evidence is the accumulated log of the scale over `TOO_SMALL`: 8 groups of fixes at scale 10,
17 at scale 4. With correct covariances it stayed below 4 in four hours of `simulate` scenarios.
"""


LAST_SHARE = 0.5
"""Scale, relative to the largest one, above which covariances are wrong by more than that."""


class FixConsistency(NamedTuple):
    """Consistency sums over the last fixes of confirmed tracks.

    With correct covariances, the NIS per coordinate is 1 and innovations are white. Innovations
    beyond 3 sigma per coordinate are sharp turns and are limited. A larger NIS: covariances are
    too small. A smaller or correlated NIS: errors are time-correlated because the source filters
    its output, or covariances are too large; the data cannot separate these cases. Time-correlated
    errors slower than the motion do not show in innovations of one sensor. So covariances are
    never scaled down from this evidence; `warnings` names the parameters to set.
    """

    number: float = 0.0
    """Number of fixes."""
    nis: float = 0.0
    """Sum of NIS per coordinate."""
    pairs: float = 0.0
    """Number of pairs of successive fixes."""
    cross: float = 0.0
    """Sum of products of successive whitened innovations."""
    square: float = 0.0
    """Sum of their mean squares."""
    scale: float = 1.0
    """Covariance scale estimated by the scaled filters."""
    evidence: float = 0.0
    """Evidence that the scale exceeds `TOO_SMALL`."""
    stated: bool = False
    """True after a fix that states a covariance."""
    assumed: bool = False
    """True after a fix without covariance, of a sensor whose `fix_std` is not set."""
    hidden: float = 0.0
    """Share of the fixes whose variance is too small to show beside the motion."""

    def with_fixes(self, white: FloatArray, before: FloatArray) -> FixConsistency:
        """Add whitened innovations (k, 2), and those `before` (k, 2) of the same tracks, NaN for
        none.

        Innovations longer than `FARTHEST` are shortened to it.
        """
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

    def with_scale(
        self, scale: FloatArray, tentative: BoolArray, hidden: BoolArray
    ) -> FixConsistency:
        """Add the scale (k,) estimated by tracks, of which some are `tentative` (k,).

        hidden: (k,) True where the innovation is nearly all motion. The scale then stands for
        errors of the models.
        """
        if tentative.all():
            return self
        share = float(hidden[~tentative].mean())
        known = self._replace(hidden=self.hidden + (share - self.hidden) / MEMORY)
        shown = scale[~tentative & ~hidden]
        if not len(shown):
            return known
        # The smallest scale counts: other tracks may follow wrong fixes.
        least = float(shown.min())
        evidence = max(self.evidence + math.log(min(least, MOST) / TOO_SMALL), 0.0)
        return known._replace(scale=least, evidence=evidence)

    def with_covariances(self, stated: bool, usual: bool) -> FixConsistency:
        """Add fixes of a sensor.

        :param stated: whether a fix states a covariance.
        :param usual: whether `fix_std` of the sensor is its default.
        """
        if self.stated or (self.assumed and not stated):
            return self
        return self._replace(stated=stated, assumed=self.assumed or (usual and not stated))

    @property
    def mean_nis(self) -> float:
        """NIS per coordinate, expected 1; NaN without a fix."""
        return self.nis / self.number if self.number else float('nan')

    @property
    def lag_1(self) -> float:
        """Correlation of successive whitened innovations; NaN without a pair."""
        return self.cross / self.square if self.square else float('nan')

    @property
    def are_too_small(self) -> bool:
        """True if the covariances are too small."""
        return self.evidence >= ENOUGH

    def errors_last(self, bias_stated: bool) -> bool:
        """Return whether the errors of fixes may last, or covariances are too large.

        bias_stated: whether `fix_bias_std` is set.
        """
        if bias_stated or self.are_too_small or self.hidden > 0.5:
            return False
        if self.number < 0.99 * MEMORY:
            return False
        # Large innovations that are correlated are those of a motion that no model has.
        return self.mean_nis < (1.0 if self.lag_1 > CORRELATED else PESSIMISTIC)

    def warnings(self, bias_stated: bool, largest: float = MOST, sensor: str = '') -> list[str]:
        """Return warnings about wrong covariances: for families when the evidence suffices,
        otherwise after `MEMORY` fixes.

        :param bias_stated: whether `fix_bias_std` is set.
        :param largest: largest scale of `covariance_scales`.
        :param sensor: name of one of several sensors.
        """
        whose = f' of sensor {sensor}' if sensor else ''
        if self.are_too_small:
            return [self._too_small(largest, whose)]
        if self.number < 0.99 * MEMORY:
            return []
        if self.mean_nis > OPTIMISTIC:
            return [
                f'fix innovations{whose} are too large: NIS {self.mean_nis:.2g} per coordinate '
                '(expected 1). Increase covariance_scale or the motion noise; model_set families '
                'estimates the scale'
            ]
        if self.errors_last(bias_stated):
            return [
                f'fix innovations{whose} are too small or correlated: NIS {self.mean_nis:.2g} per '
                f'coordinate (expected 1), lag-1 correlation {self.lag_1:.2g} (expected 0). If '
                'the source filters its output, set fix_bias_std; otherwise its covariances are '
                'too large. The published covariance includes that of a fix'
            ]
        return []

    def _too_small(self, largest: float, whose: str) -> str:
        """Return the warning about covariances that are too small."""
        times = self.scale * max(self.mean_nis, 1.0)
        if self.scale > LAST_SHARE * largest and largest > MOST:
            more = 'a million' if largest == 1e6 else f'{largest:,.6g}'
            return (
                f'fix covariances{whose} too small by a factor of more than {more}: errors are '
                f'more than {math.sqrt(largest):,.4g} times as large as reported. Check the unit '
                'of the covariances'
            )
        factor = _rounded(times)
        action = 'Correct its covariances' if whose else f'Multiply covariance_scale by {factor}'
        return (
            f'fix covariances{whose} too small by a factor {factor}: errors are '
            f'{_rounded(math.sqrt(times))} times as large as reported. {action}'
        )


def _rounded(value: float) -> str:
    """Return a number >= 1 with two significant digits and without an exponent."""
    return f'{float(f"{value:.2g}"):.12g}'


class SensorConsistency(NamedTuple):
    """Consistency of the fixes of each sensor, by its number."""

    sensors: tuple[FixConsistency, ...] = ()

    def of(self, number: int) -> FixConsistency:
        """Return the consistency of a sensor."""
        return self.sensors[number] if number < len(self.sensors) else FixConsistency()

    def with_sensor(self, number: int, consistency: FixConsistency) -> SensorConsistency:
        """Replace the consistency of a sensor."""
        found = [self.of(each) for each in range(max(len(self.sensors), number + 1))]
        found[number] = consistency
        return SensorConsistency(tuple(found))

    def without_sums(self) -> SensorConsistency:
        """Forget all innovations."""
        return SensorConsistency(
            tuple(
                FixConsistency(stated=each.stated, assumed=each.assumed) for each in self.sensors
            )
        )

    @property
    def together(self) -> FixConsistency:
        """The sums over all sensors."""
        if len(self.sensors) < 2:
            return self.of(0)
        sums = np.sum([each[:5] for each in self.sensors], axis=0)
        number, nis, pairs, cross, square = sums.tolist()
        return FixConsistency(number, nis, pairs, cross, square)

    @property
    def assumed(self) -> bool:
        """True if no fix states a covariance, and `fix_std` of a sensor is not set."""
        return any(each.assumed for each in self.sensors) and not any(
            each.stated for each in self.sensors
        )

    def errors_last(self, bias_stated: bool) -> bool:
        """Return whether the errors of any sensor may last, see `FixConsistency`."""
        return any(each.errors_last(bias_stated) for each in self.sensors)

    def warnings(self, bias_stated: bool, largest: float, names: Sequence[str]) -> list[str]:
        """Return the warnings of all sensors, by name if there are several with fixes."""
        several = sum(each.number > 0.0 for each in self.sensors) > 1
        found = []
        for number, each in enumerate(self.sensors):
            name = (names[number] or 'without a name') if several else ''
            found += each.warnings(bias_stated, largest, name)
        return found


def whiten_innovations(
    mean: FloatArray,
    covariance: FloatArray,
    z: FloatArray,
    R: FloatArray,
    before: FloatArray,
    tentative: BoolArray,
    known: FixConsistency,
) -> tuple[FloatArray, FixConsistency]:
    """Return the whitened innovations (k, 2) of fixes z (k, 2), R (k, 2, 2), and the updated sums.

    :param mean: (k, 2) predicted fix.
    :param covariance: (k, 2, 2) of the prediction.
    :param before: (k, 2) previous whitened innovation of the tracks.
    :param tentative: (k,) True for tracks that are not counted.
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
    """Limit whitened innovations (k, 2) to the length `FARTHEST`."""
    square = np.square(white).sum(axis=1, keepdims=True)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.where(square > 2.0 * FARTHEST, np.sqrt(2.0 * FARTHEST / square), 1.0) * white
