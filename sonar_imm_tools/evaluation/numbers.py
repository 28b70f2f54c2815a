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

"""Metrics that all systems share, and how they are put into words.

Errors are summarised by RMSE, median and 95 % point. Whether the stated uncertainty holds is
tested by NEES and NIS, which are chi-square distributed when it does. Their bounds suppose that
successive errors are independent. The errors of one track are correlated over a few stamps, so a
mean slightly outside its bounds proves nothing; one far outside does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consistency import average_bounds, nees

SINGULAR = 1e-9


def flatten(values: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Nested mappings as one; the keys are joined by dots."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            result.update(flatten(value, f'{prefix}{key}.'))
        else:
            result[f'{prefix}{key}'] = value
    return result


def error_summary(error: FloatArray, *, unit: str = 'm') -> dict[str, float]:
    """RMSE, median and 95 % point of non-negative errors; NaN when there are none."""
    if not len(error):
        return {'n': 0, **{f'{name}_{unit}': float('nan') for name in ('rmse', 'median', 'p95')}}
    return {
        'n': len(error),
        f'rmse_{unit}': float(np.sqrt(np.mean(error**2))),
        f'median_{unit}': float(np.median(error)),
        f'p95_{unit}': float(np.percentile(error, 95.0)),
    }


def usable_nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """NEES of the rows that are finite and whose covariance is not singular.

    A filter that is certain of one heading states a velocity along that heading only. Then its
    covariance is singular, and NEES is not defined.
    """
    good = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    values = np.linalg.eigvalsh(covariance[good])
    good[good] = values[:, 0] > SINGULAR * values[:, -1]
    return nees(error[good], covariance[good]) if good.any() else np.empty(0)


def chi2_summary(values: FloatArray, dof: int) -> dict[str, Any]:
    """Mean of chi-square values, `dof` expected, with its two-sided 95 % bounds."""
    if not len(values):
        return {'n': 0, 'dof': dof, 'mean': float('nan'), 'believable': None}
    low, high = average_bounds(len(values), dof)
    mean = float(np.mean(values))
    return {
        'n': len(values),
        'dof': dof,
        'mean': mean,
        'low': low,
        'high': high,
        'believable': bool(low <= mean <= high),
    }


def nis_summary(nis: FloatArray, dof: FloatArray) -> dict[str, Any]:
    """Mean NIS of all hits with its bounds; divided by the degrees of freedom where these vary."""
    if not len(nis) or (dof == dof[0]).all():
        return chi2_summary(nis, int(dof[0]) if len(nis) else 2)
    low, high = average_bounds(1, int(dof.sum()))
    mean, low, high = (float(value / dof.sum()) for value in (nis.sum(), low, high))
    return {
        'n': len(nis),
        'dof': 1,
        'mean': mean,
        'low': low,
        'high': high,
        'believable': low <= mean <= high,
        'divided_by_dof': True,
    }


def coverage_sentence(coverage: float) -> str:
    """What `coverage`, the share of truth inside the stated 95 % ellipses, says about them."""
    held = f'its 95 % ellipses hold the truth {100 * coverage:.0f} % of the time'
    if coverage < 0.90:
        return f'The tracker is overconfident: {held}.'
    if coverage > 0.99:
        return f'The tracker is more cautious than it needs to be: {held}.'
    return f'The stated uncertainty is consistent with the errors: {held}.'


def bounds_remark(summary: Mapping[str, Any]) -> str:
    """What to compare the mean of a `chi2_summary` or `nis_summary` with."""
    if 'low' not in summary:
        return f'{summary["n"]} values'
    if summary.get('divided_by_dof'):
        return (
            f'per degree of freedom: 1 expected, {summary["low"]:.2f} to '
            f'{summary["high"]:.2f} believable'
        )
    return f'{summary["dof"]} expected, {summary["low"]:.2f} to {summary["high"]:.2f} believable'


def error_line(
    title: str, summary: Mapping[str, Any], unit: str, shown: str = ''
) -> list[tuple[str, str]]:
    """Title and value of an `error_summary` in `unit` (printed as `shown`), if it has errors."""
    if not summary.get('n'):
        return []
    values = (f'{summary[f"{name}_{unit}"]:.3f}' for name in ('rmse', 'median', 'p95'))
    return [(f'{title}, RMSE / median / 95 %', ' / '.join(values) + f' {shown or unit}')]


def chi2_line(title: str, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and value of a `chi2_summary` or `nis_summary`, if it has values."""
    if not summary.get('n'):
        return []
    return [
        (title, f'{summary["mean"]:.2f}, believable {summary["low"]:.2f} to {summary["high"]:.2f}')
    ]
