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

"""The scores of a diver run as sentences and lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..numbers import chi2_line, coverage_sentence, error_line


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    position = metrics.get('position', {})
    if not position.get('n'):
        known = 'scored_stamps' in metrics
        return f'{metrics["tracks_confirmed"]} confirmed tracks in {metrics["span_s"]:.0f} s. ' + (
            'None of them was matched with the truth.'
            if known
            else 'There is no truth to compare with, so only the estimates and their stated '
            'uncertainty are shown.'
        )
    sentences = [f'On average the track lies {position["rmse_m"]:.2f} m from the truth (RMS).']
    raw = metrics.get('raw_fix', {})
    if raw.get('n'):
        sentences.append(_against_fixes(position['rmse_m'], raw['rmse_m']))
    sentences.append(coverage_sentence(metrics['consistency']['coverage']['95']))
    return ' '.join(sentences)


def _against_fixes(tracked: float, raw: float) -> str:
    if not raw > 0.0:
        return 'The raw fixes are the truth itself: no tracker can be better than they are.'
    change = 1.0 - tracked / raw
    return f'The raw fixes lie {raw:.2f} m away: tracking ' + (
        f'removes {100 * change:.0f} % of the error.'
        if change >= 0.0
        else f'adds {-100 * change:.0f} % to it.'
    )


def lines(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and value of the most important numbers."""
    consistency = metrics['consistency']
    result = [
        *error_line('position error', metrics.get('position', {}), 'm'),
        *error_line('raw fixes', metrics.get('raw_fix', {}), 'm'),
        *error_line('velocity error', metrics.get('velocity', {}), 'mps', 'm/s'),
        *chi2_line('NEES, position', consistency.get('nees_position', {})),
        *chi2_line('NEES, whole state', consistency.get('nees_state', {})),
        *chi2_line('NIS', consistency['nis']),
    ]
    if metrics.get('position', {}).get('n'):
        result.append(
            (
                'truth inside 50 / 90 / 95 % ellipse',
                ' / '.join(f'{100 * share:.0f} %' for share in consistency['coverage'].values()),
            )
        )
    if metrics.get('lag'):
        result.append(
            (
                'best lag of the estimates',
                f'{metrics["lag"]["best_s"]:.2f} s, then RMSE '
                f'{metrics["lag"]["rmse_at_best_m"]:.3f} m',
            )
        )
    result += [
        (name.replace('_', ' '), f'{value:.3g}')
        for name, value in metrics.get('tracks', {}).items()
    ]
    return result
