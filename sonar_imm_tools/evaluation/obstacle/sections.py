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

"""A run of obstacles on the page: key numbers, and sections with a figure each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.measurements import Detections
from sonar_imm.trackers.obstacle.config import BEHAVIOURS

from ..judging import Check
from ..numbers import bounds_remark
from ..page import Card, Part, Section, table
from ..plotting import nis_figure, seconds
from ..report import run_part
from . import figures
from .deferred import DeferredEstimates
from .series import Matching, Series, TruePath
from .summary import summary_sentence


@frozen(eq=False, kw_only=True)
class Material:
    """What the page shows. run: content of ``run.json``; metrics: of ``metrics.json``."""

    run: Mapping[str, Any]
    metrics: Mapping[str, Any]
    series: Series
    truth: tuple[TruePath, ...] | None = None
    found: Matching | None = None
    deferred: DeferredEstimates | None = None
    received: Sequence[Any] = ()
    gap: float = 60.0


def obstacle_part(material: Material, checks: Sequence[Check] = ()) -> Part:
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
    cards, consistency = [], metrics['consistency']
    near = metrics.get('vertical_offset_near', {})
    if near.get('n'):
        cards.append(
            Card(
                f'{near["rmse_m"]:.2f} m',
                'Height error within 50 m, RMS',
                f'median {near["median_m"]:.2f} m, 95 % {near["p95_m"]:.2f} m',
            )
        )
    if metrics.get('range', {}).get('n'):
        cards.append(
            Card(
                f'{100 * consistency["band_coverage"]:.0f} %',
                'Truth inside the 90 % band',
                '90 % would be perfect',
            )
        )
        cards.append(
            Card(
                f'{consistency["nees_offset"]["mean"]:.2f}',
                'NEES of the offset',
                bounds_remark(consistency['nees_offset']),
            )
        )
        cards.append(
            Card(
                f'{metrics["gospa"]["mean_m"]:.2f} m',
                'GOSPA',
                f'{metrics["gospa"]["missed_per_ping"]:.2f} missed, '
                f'{metrics["gospa"]["false_per_ping"]:.2f} false per ping',
            )
        )
    else:
        cards.append(
            Card(
                str(metrics['tracks_confirmed']),
                'Confirmed obstacles',
                f'{metrics["pings"]} pings in {metrics["span_s"]:.0f} s',
            )
        )
    if consistency['nis']['n']:
        cards.append(
            Card(
                f'{consistency["nis"]["mean"]:.2f}',
                'NIS of the hits',
                bounds_remark(consistency['nis']),
            )
        )
    return cards


def _sections(material: Material) -> list[Section]:
    series, found = material.series, material.found
    pings = [one for one in material.received if isinstance(one, Detections) and len(one)]
    sections = [
        Section(
            'Height over range',
            'How far each obstacle lies below the sonar, as it comes '
            'nearer from left to right. Shaded: the 90 % band. Dotted: truth.',
            figures.offset_figure(series, _truths(material), material.gap),
        ),
        Section(
            'Above or below',
            'On a level path above and below look the same, and the probability has to stay at '
            'one half. Rolling decides it.',
            figures.above_figure(series),
        ),
        Section(
            'Image of the sonar',
            'Tracks among the detections of all pings. Dotted: truth, while the beam holds it.',
            figures.image_figure(series, pings, material.truth or ()),
        ),
    ]
    if material.deferred is not None:
        sections.append(
            Section(
                f'Deferred estimate: RMSD of track {material.deferred.track_id}',
                'The paper estimates the offset afterwards, from all echoes of the track. The '
                'curve shows how badly each assumed offset explains them. Diamonds: least RMSD. '
                'The paper looks below the sonar alone; a single such number is worth some 4 m.',
                figures.rmsd_figure(material.deferred),
            )
        )
    if found is not None and len(found.row):
        sections.append(
            Section(
                'Error, and the predicted error',
                'Errors of the vertical offset in units of the stated standard deviation.',
                figures.error_figure(found),
            )
        )
        bins = material.metrics['above']['bins']
        sections.append(
            Section(
                'Calibration of the probability of being above',
                'How often an obstacle was above, by the stated probability. Pings of one '
                'approach are not independent.',
                html=table(
                    ('P(above)', 'pings', 'stated', 'was above'),
                    [
                        (name, one['n'], one['stated'], one['came_true'])
                        for name, one in bins.items()
                    ],
                ),
            )
        )
    sections += _motion_sections(material.metrics)
    hits = series.pick(np.isfinite(series.nis))
    if len(hits):
        sections.append(
            Section(
                'Normalised innovations (NIS)',
                'Distance of each detection from its prediction, in units of the stated '
                'uncertainty, squared. NIS says nothing about the height: with a wrong sign of '
                'roll it is perfect too.',
                nis_figure(
                    seconds(hits.stamp_ns, series.ping_ns), hits.nis, np.full(len(hits), 2.0)
                ),
            )
        )
    return sections


def _motion_sections(metrics: Mapping[str, Any]) -> list[Section]:
    sections = []
    if behaviours := metrics.get('behaviours'):
        names = list(BEHAVIOURS)
        rows = [
            (true, values['n'], *(values[name] for name in names))
            for true, values in behaviours['confusion'].items()
        ]
        sections.append(
            Section(
                'What the obstacles do',
                'Mean stated probability of each behaviour, by what the obstacle really does.',
                html=table(('does', 'rows', *(f'P({name})' for name in names)), rows),
            )
        )
    if collisions := metrics.get('collisions'):
        sections.append(
            Section(
                'Calibration of the probability of a collision',
                'How often a collision followed, by the stated probability. Forecasts of one '
                'approach are not independent. '
                f'Brier score {collisions["brier"]:.3f}; of always saying how often it happened, '
                f'{collisions["brier_of_a_guess"]:.3f}.',
                figures.calibration_figure(collisions['bins']),
            )
        )
    return sections


def _truths(material: Material) -> dict[int, TruePath]:
    found, truth = material.found, material.truth
    if found is None or not truth:
        return {}
    return {
        track: truth[target]
        for track, target in zip(found.series.track_id[found.row].tolist(), found.target.tolist())
    }
