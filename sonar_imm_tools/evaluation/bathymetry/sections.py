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

"""A run of sea floors on the page: key numbers, and sections with a figure each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.trackers.bathymetry.likelihood import spacing_of

from ...offline.run_folder import read_measurements
from ..judging import Check
from ..page import Card, Part, Section
from ..report import run_part
from . import chart, figures
from .profiles import Profile, Swath
from .summary import percent, summary_sentence


def bathymetry_part(
    folder: Path,
    run: Mapping[str, Any],
    metrics: Mapping[str, Any],
    swath: Swath,
    checks: Sequence[Check],
) -> Part:
    """The whole part of one run, `checks` first."""
    return run_part(
        run,
        metrics,
        checks,
        summary=summary_sentence(metrics),
        cards=_cards(metrics),
        sections=[*_sections(run, swath), *_chart(folder, run)],
    )


def _cards(metrics: Mapping[str, Any]) -> list[Card]:
    height = metrics.get('height', {})
    if not height.get('all', {}).get('n'):
        return [
            Card(str(metrics['pings']), 'Pings', f'{metrics["bins"]} range bins'),
            Card(percent(metrics['heard_share']), 'Bins with an echo'),
            Card(f'{metrics["height_std_median_m"]:.2f} m', 'Stated uncertainty, median'),
            Card(percent(metrics['rough_share']), 'Bins labelled rough'),
        ]
    every = height['all']
    cards = [
        Card(
            f'{every["rmse_m"]:.2f} m',
            'Height error, RMS',
            f'median {every["median_m"]:.2f} m, 95 % {every["p95_m"]:.2f} m',
        )
    ]
    if height['patch']['n'] and height['smooth']['n']:
        cards.append(Card(f'{height["smooth"]["rmse_m"]:.2f} m', 'On smooth floor, RMS'))
        cards.append(Card(f'{height["patch"]["rmse_m"]:.2f} m', 'In rough patches, RMS'))
    angle = metrics['angle']['all']
    if angle['n']:
        cards.append(Card(f'{angle["rmse_deg"]:.2f}°', 'Angle error, RMS'))
    cards.append(
        Card(
            percent(metrics['inside_band']['all']),
            'Truth inside two standard deviations',
            '95 % would be perfect',
        )
    )
    found = metrics.get('segmentation', {})
    if found.get('patches'):
        cards.append(
            Card(
                f'{found["iou"]:.2f}',
                'Overlap of the rough patches',
                f'noticed {found["bins_late_in"]:.0f} bins late, left '
                f'{found["bins_late_out"]:.0f} bins late',
            )
        )
    return cards


def _sections(run: Mapping[str, Any], swath: Swath) -> list[Section]:
    if not swath.profiles:
        return []
    number = len(swath.profiles) // 2
    profile = swath.profiles[number]
    which = f' Ping {number + 1} of {len(swath.profiles)}.'
    sections = [
        Section(
            'Profile of the floor',
            'Height along one ping. Dotted: truth. Shaded: two standard deviations, which should '
            f'hold 95 % of the truth. Blue: the true rough patch.{which}',
            figures.profile_figure(profile),
        )
    ]
    if (snapshot := _snapshot(run, profile)) is not None:
        spacing = spacing_of(snapshot, BathymetryConfig.from_mapping(run['parameters']))
        sections.append(
            Section(
                'Pseudo-spectrum and estimated angle',
                'Light: directions with much sound (Capon spectrum of the samples, 11 bins at a '
                f'time, no terrain model). Line: the estimated angle.{which}',
                figures.spectrum_figure(profile, snapshot, spacing),
            )
        )
    sections.append(
        Section(
            'Which terrain model held',
            f'Dark: the model is probable. Lines: ends of the true patch.{which}',
            figures.models_figure(profile, swath.model_names),
        )
    )
    if swath.rough.any():
        sections.append(
            Section(
                'Rough floor over the whole run',
                'One row per ping. Dark: probably rough.',
                figures.segmentation_figure(swath),
            )
        )
    return sections


def _chart(folder: Path, run: Mapping[str, Any]) -> list[Section]:
    """The chart of the soundings; nothing without navigation."""
    points = chart.points_of(folder)
    if points is None:
        return []
    grid = chart.chart_of(points)
    return [
        Section(
            'Chart',
            f'{len(points)} soundings in cells of {grid.cell:g} m, as `sonar-imm export` writes '
            'them; north is up. Dark line: the ship.',
            chart.chart_figure(grid, chart.track_of(run)),
        )
    ]


def _snapshot(run: Mapping[str, Any], profile: Profile) -> Snapshot | None:
    """The samples of one ping, None when the recording is gone."""
    for one in read_measurements(run):
        if not isinstance(one, Snapshot) or one.stamp_ns != profile.stamp_ns:
            continue
        if len(one) == len(profile.range) and profile.side in ('', one.side):
            return one
    return None
