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

"""The scores of a bathymetry run as sentences and lines of text."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from ..numbers import error_line


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    height = metrics.get('height', {}).get('all', {})
    if not height.get('n'):
        return (
            f'{metrics["pings"]} pings with {metrics["bins"]} range bins, of which '
            f'{percent(metrics["heard_share"])} have an echo. There is no truth to compare with, '
            'so only the estimates and their stated uncertainty are shown.'
        )
    sentences = [f'On average the floor lies {height["rmse_m"]:.2f} m from the truth (RMS)']
    patch, smooth = metrics['height']['patch'], metrics['height']['smooth']
    if patch['n'] and smooth['n']:
        sentences[0] += (
            f': {smooth["rmse_m"]:.2f} m where it is smooth, {patch["rmse_m"]:.2f} m in rough '
            'patches'
        )
    sentences[0] += '.'
    sentences.append(
        f'{percent(metrics["inside_band"]["all"])} of the bins lie inside the band of two '
        'standard deviations; 95 % would be perfect.'
    )
    found = metrics.get('segmentation', {})
    if found.get('patches'):
        sentences.append(
            f'What is labelled rough and what is rough overlap by {percent(found["iou"])}.'
        )
    return ' '.join(sentences)


def lines(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and value of the most important numbers."""
    result = [
        ('pings, range bins', f'{metrics["pings"]}, {metrics["bins"]}'),
        ('bins with an echo', percent(metrics['heard_share'])),
    ]
    for place in ('all', 'smooth', 'patch', 'shadow'):
        result += error_line(
            f'height error, {place}', metrics.get('height', {}).get(place, {}), 'm'
        )
    result += error_line('angle error, all', metrics.get('angle', {}).get('all', {}), 'deg')
    inside = metrics.get('inside_band', {})
    if inside and not math.isnan(inside['all']):
        result.append(
            (
                'inside two sd, smooth / patch',
                f'{percent(inside["smooth"])} / {percent(inside["patch"])}',
            )
        )
    found = metrics.get('segmentation', {})
    if found.get('patches'):
        result.append(('overlap of the rough patches', f'{found["iou"]:.2f}'))
        result.append(
            (
                'bins late, into / out of a patch',
                f'{found["bins_late_in"]:.0f} / {found["bins_late_out"]:.0f}',
            )
        )
    gate = metrics.get('gate', {})
    if gate.get('shadow_bins'):
        result.append(('shadow passed over', percent(gate['shadow_passed_over'])))
    return result


def percent(share: float) -> str:
    """A share in percent, '-' when it is unknown."""
    return '-' if math.isnan(share) else f'{100.0 * share:.0f} %'
