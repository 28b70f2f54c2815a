# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""What a variance says besides its number: one table for every message and file.

| a variance that is | of x and y | of z | of roll, pitch | of the heading |
|---|---|---|---|---|
| NaN or negative; zeros alone | unknown | not stated | unknown | unknown |
| below 1e-12 | refused | not stated | used | used |
| from 1e6 m^2, .3 rad^2 on; inf | not measured | not stated | unknown, and said | no heading |

Unknown: a parameter stands in. Not measured: the fix is refused; that of a vessel places nothing.
A zero beside variances that are none is meant: a vehicle in a plane.
"""

from __future__ import annotations

import numpy as np

from ..estimation.arrays import FloatArray
from .checks import check_covariance, Rejection

LEAST_VARIANCE, MOST_VARIANCE = 1e-12, 1e16
"""Limits of a variance, m^2, with which arithmetic is possible: a micrometre and 100,000 km."""
UNKNOWN_VARIANCE = 1e6
"""Variance, m^2, that senders write for what they do not measure: from it on."""
UNMEASURED_ANGLE = 0.3
"""The same of an angle, rad^2: drivers write pi^2, 99 or 1e6. The composition of positions is an
expansion that does not hold there."""


def is_stated(block: FloatArray) -> bool:
    """Whether a covariance (n, n) says something: no NaN, no negative variance, not zeros alone.
    An infinite variance says that it is not measured."""
    variance = np.diag(block)
    beside = np.isfinite(block[~np.eye(len(block), dtype=bool)]).all()
    return bool(beside and block.any() and (variance >= 0.0).all())


def check_flat(block: FloatArray, what: str) -> None:
    """Raise `Rejection` for a stated covariance of x and y (2, 2) that cannot be used."""
    variance = np.diag(block)
    if np.isinf(variance).any():
        raise Rejection('not_measured', f'{what} states that x or y is not measured')
    check_covariance(block, what)
    least, most = np.linalg.eigvalsh(block)
    if least >= UNKNOWN_VARIANCE:
        raise Rejection(
            'not_measured',
            f'{what} states that it is not measured: a standard deviation of {np.sqrt(least):g} m',
        )
    if least < LEAST_VARIANCE or most > MOST_VARIANCE:
        raise Rejection(
            'out_of_range',
            f'{what} states a standard deviation from {np.sqrt(least):g} m to {np.sqrt(most):g} m',
        )


def by_axis(block: FloatArray) -> FloatArray | None:
    """The covariance (n, n) of a vessel's position or attitude, axis by axis: NaN in row and
    column of an axis that is unknown, variances of at most `MOST_VARIANCE`; None when none is
    known."""
    variance = np.diag(block)
    unknown, large = ~(variance >= 0.0), variance > MOST_VARIANCE
    if not variance[~unknown].any():
        return None
    kept, alone = block.copy(), unknown | large
    kept[alone] = kept[:, alone] = 0.0
    unknown |= ~np.isfinite(kept).all(axis=1)
    kept[large, large] = MOST_VARIANCE
    kept[unknown] = kept[:, unknown] = np.nan
    return kept


def filled(covariance: FloatArray | None, assumed: FloatArray) -> FloatArray:
    """The covariance (n, n), of which `by_axis` has marked what is unknown, with what is assumed
    there, and where it is zero throughout."""
    if covariance is None:
        return assumed
    unknown = np.isnan(np.diag(covariance))
    whole = np.where(unknown | unknown[:, None], 0.0, covariance)
    if not whole.any():
        return assumed
    whole[unknown, unknown] = np.diag(assumed)[unknown]
    return whole
