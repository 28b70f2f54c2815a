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

"""The scores of an obstacle run as sentences and lines of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..numbers import chi2_line, error_line
from .scoring import NEAR

_DEFERRED = ('online', 'rmsd', 'rmsd_both_sides', 'refit')


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    offset = metrics.get('vertical_offset', {})
    if not offset.get('n'):
        known = 'scored_rows' in metrics
        return (
            f'{metrics["tracks_confirmed"]} confirmed obstacles in {metrics["span_s"]:.0f} s. '
            + (
                'None of them was matched with the truth.'
                if known
                else 'There is no truth to compare with, so only the estimates and their stated '
                'uncertainty are shown.'
            )
        )
    near = metrics['vertical_offset_near']
    sentences = []
    if near['n']:
        sentences.append(
            f'Within {NEAR:.0f} m the height of an obstacle is right to '
            f'{near["rmse_m"]:.2f} m (RMS).'
        )
    held = metrics['consistency']['band_coverage']
    sentences.append(f'Its 90 % band holds the truth {100 * held:.0f} % of the time.')
    tracks = metrics['tracks']
    sentences.append(
        f'{tracks["found_obstacles"]} of {tracks["true_obstacles"]} obstacles were '
        f'found, {tracks["false_tracks"]} tracks were false.'
    )
    return ' '.join(sentences)


def motion_lines(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Velocity, behaviours and forecasts of collisions, as far as they were scored."""
    result = []
    for name, values in metrics.get('velocity', {}).items():
        result.append((f'velocity error, {name}, RMSE an axis', f'{values["rmse_m_s"]:.3f} m/s'))
        result += chi2_line('NEES, velocity', values.get('nees', {}))
    for name, values in metrics.get('behaviours', {}).get('confusion', {}).items():
        result.append((f'P({name}) of what is', f'{values[name]:.3f} ({values["n"]} rows)'))
    if collisions := metrics.get('collisions'):
        result.append(
            (
                'Brier score of collisions',
                f'{collisions["brier"]:.3f}, of a guess {collisions["brier_of_a_guess"]:.3f} '
                f'({collisions["n"]} forecasts, {100 * collisions["happened"]:.0f} % happened)',
            )
        )
    return result


def lines(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and value of the most important numbers."""
    consistency = metrics['consistency']
    result = [
        *error_line('range error', metrics.get('range', {}), 'm'),
        *error_line('bearing error', metrics.get('bearing', {}), 'deg'),
        *error_line('vertical offset error', metrics.get('vertical_offset', {}), 'm'),
        *error_line(f'the same within {NEAR:.0f} m', metrics.get('vertical_offset_near', {}), 'm'),
        *chi2_line('NEES, vertical offset', consistency.get('nees_offset', {})),
        *chi2_line('NEES, whole state', consistency.get('nees_state', {})),
        *chi2_line('NIS', consistency['nis']),
    ]
    if metrics.get('vertical_offset', {}).get('n'):
        held = consistency['band_coverage']
        result.append(('truth inside the 90 % band', f'{100 * held:.0f} %'))
        result.append(('Brier score of P(above)', f'{metrics["above"]["brier"]:.3f}'))
        result += motion_lines(metrics)
        result.append(('GOSPA', f'{metrics["gospa"]["mean_m"]:.2f} m'))
    if deferred := metrics.get('deferred'):
        result.append(
            (
                'vertical offset: online / RMSD / of both sides / refitted',
                ' / '.join(f'{deferred[f"{name}_m"]:+.2f}' for name in _DEFERRED)
                + ' m'
                + (f', truth {deferred["truth_m"]:+.2f} m' if 'truth_m' in deferred else ''),
            )
        )
    result += [
        (name.replace('_', ' '), f'{value:.3g}')
        for name, value in metrics.get('tracks', {}).items()
    ]
    return result
