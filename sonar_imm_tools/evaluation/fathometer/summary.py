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

"""The scores of a fathometer run as sentences and lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..numbers import error_line


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    if not metrics['records']:
        return 'There is no record in this run.'
    if 'scored_records' not in metrics:
        return (
            f'{metrics["reflectors_mean"]:.1f} reflectors per record in {metrics["records"]} '
            'records. There is no truth to compare with, so only the estimates and their stated '
            'uncertainty are shown.'
        )
    sentences = [
        f'The number of reflectors is right in {100 * metrics["order_right"]:.0f} % of the '
        f'records; a record lies {metrics["ospa_m"]:.3f} m from the true set (OSPA).'
    ]
    if metrics['depth']['n']:
        sentences.append(
            f'Depths are off by {metrics["depth"]["rmse_m"]:.3f} m (RMS); '
            f'{metrics["false_per_record"]:.2f} reflectors per record are false and '
            f'{metrics["missed_per_record"]:.2f} are missed.'
        )
    return ' '.join(sentences)


def lines(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and value of the most important numbers."""
    result = [
        ('records', f'{metrics["records"]}'),
        ('reflectors per record', f'{metrics["reflectors_mean"]:.2f}'),
    ]
    if 'scored_records' not in metrics:
        return result
    result += [
        ('number of reflectors right', f'{100 * metrics["order_right"]:.1f} %'),
        ('OSPA', f'{metrics["ospa_m"]:.3f} m'),
        (
            'false / missed per record',
            f'{metrics["false_per_record"]:.3f} / {metrics["missed_per_record"]:.3f}',
        ),
        *error_line('depth error', metrics['depth'], 'm'),
    ]
    if metrics['amplitude']['n']:
        error = metrics['amplitude']
        result.append(
            (
                'amplitude error, median / 95 %',
                f'{100 * error["median_relative_error"]:.1f} / '
                f'{100 * error["p95_relative_error"]:.1f} %',
            )
        )
    result.append(('identity switches', f'{metrics["identity_switches"]}'))
    return result
