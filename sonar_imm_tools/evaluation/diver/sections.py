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

"""A run of divers on the page: key numbers, and sections with a figure each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from attrs import frozen
import numpy as np

from ..judging import Check
from ..numbers import bounds_remark
from ..page import Card, Part, Section
from ..plotting import nis_figure, seconds
from ..report import run_part
from . import figures
from .matching import match
from .series import Series
from .summary import summary_sentence
from .truth import Truth


@frozen(eq=False, kw_only=True)
class Material:
    """What the page shows. run: content of ``run.json``; metrics: of ``metrics.json``."""

    run: Mapping[str, Any]
    metrics: Mapping[str, Any]
    series: Series
    truth: Truth | None = None
    fixes: Series | None = None


def diver_part(material: Material, checks: Sequence[Check] = ()) -> Part:
    """The whole part of one run, `checks` first."""
    return run_part(
        material.run,
        material.metrics,
        checks,
        summary=summary_sentence(material.metrics),
        cards=_cards(material.metrics),
        sections=_sections(material),
    )


def _cards(metrics: Mapping[str, Any]) -> list[Card]:
    position, raw = metrics.get('position', {}), metrics.get('raw_fix', {})
    cards = []
    if position.get('n'):
        cards.append(
            Card(
                f'{position["rmse_m"]:.2f} m',
                'Position error, RMS',
                f'median {position["median_m"]:.2f} m, 95 % {position["p95_m"]:.2f} m',
            )
        )
        if raw.get('n'):
            cards.append(Card(f'{raw["rmse_m"]:.2f} m', 'Raw fixes, RMS', f'{raw["n"]} fixes'))
        if metrics['velocity']['n']:
            cards.append(Card(f'{metrics["velocity"]["rmse_mps"]:.2f} m/s', 'Velocity error, RMS'))
        consistency = metrics['consistency']
        cards.append(
            Card(
                f'{100 * consistency["coverage"]["95"]:.0f} %',
                'Truth inside the 95 % ellipse',
                '95 % would be perfect',
            )
        )
        cards.append(
            Card(
                f'{consistency["nees_position"]["mean"]:.2f}',
                'NEES of the position',
                bounds_remark(consistency['nees_position']),
            )
        )
        if metrics['tracks']['true_targets'] > 1 or metrics['tracks']['tracks'] > 1:
            cards.append(_tracks_card(metrics['tracks']))
    nis = metrics['consistency']['nis']
    if nis['n']:
        cards.append(Card(f'{nis["mean"]:.2f}', 'NIS of the hits', bounds_remark(nis)))
    if not position.get('n'):
        cards.insert(
            0,
            Card(
                str(metrics['tracks_confirmed']),
                'Confirmed tracks',
                f'{metrics["stamps"]} stamps in {metrics["span_s"]:.0f} s',
            ),
        )
    return cards


def _tracks_card(tracks: Mapping[str, Any]) -> Card:
    return Card(
        f'{tracks["tracks"]} / {tracks["true_targets"]}',
        'Tracks / true targets',
        f'{tracks["identity_switches"]} identity switches, '
        f'{tracks["false_tracks"]} false, '
        f'{100 * tracks["completeness"]:.0f} % complete',
    )


def _sections(material: Material) -> list[Section]:
    series = material.series.confirmed()
    track_id = series.longest_track()
    sections = [
        Section(
            'Map',
            'Seen from above. Dotted: truth. Crosses: raw fixes. Shaded: ellipses that should '
            'hold the target 95 % of the time.',
            figures.map_figure(series, material.truth, material.fixes),
        )
    ]
    if track_id is not None:
        sections += _track_sections(material, series, track_id)
    return sections


def _track_sections(material: Material, series: Series, track_id: int) -> list[Section]:
    count = len(np.unique(series.track_id))
    which = '' if count == 1 else f' Track {track_id}, the longest of {count}.'
    sections = []
    if material.truth is not None and material.metrics.get('position', {}).get('n'):
        matching = match(series, material.truth, cutoff=material.metrics['cutoff_m'])
        sections.append(
            Section(
                'Error, and the predicted error',
                f'The error of a consistent tracker lies inside the band 95 % of the time.{which}',
                figures.error_figure(matching, track_id),
            )
        )
    else:
        sections.append(
            Section(
                'Stated uncertainty',
                f'One sigma on each axis.{which}',
                figures.sigma_figure(series, track_id),
            )
        )
    if series.model_names:
        course = _true_course(material, series, track_id)
        sections.append(
            Section(
                'Which motion model held',
                f'Dark: the model is probable. Headings are counter-clockwise from +x.{which}',
                figures.models_figure(series, track_id, course),
            )
        )
    hits = series.hits()
    if len(hits):
        sections.append(
            Section(
                'Normalised innovations (NIS)',
                'Distance of each measurement from its prediction, in units of the stated '
                'uncertainty, squared. Amber: where the mean should stay.',
                nis_figure(seconds(hits.stamp_ns, hits.scan_ns), hits.nis, hits.nis_dof),
            )
        )
    return sections


def _true_course(
    material: Material, series: Series, track_id: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Seconds and degrees of the true course of the target of a track; None when unknown."""
    relative = material.run.get('parameters', {}).get('model_set') == 'relative_headings'
    if material.truth is None or relative or 'position' not in material.metrics:
        return None
    matching = match(series, material.truth, cutoff=material.metrics['cutoff_m'])
    rows = series.track_id[matching.row] == track_id
    velocity = matching.truth[rows, 2:]
    moving = np.hypot(*velocity.T) > 0.05
    stamps = series.stamp_ns[matching.row[rows]][moving]
    if not len(stamps):
        return None
    return (
        seconds(stamps, series.scan_ns),
        np.degrees(np.arctan2(velocity[moving, 1], velocity[moving, 0])),
    )
