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

"""A run of reflectors on the page: key numbers, and sections with a figure each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker

from ...offline.run_folder import read_measurements
from ..judging import Check
from ..page import Card, Part, Section
from ..report import run_part
from . import figures
from .fixed_order import fixed_orders
from .records import Image, Record
from .scoring import pair
from .summary import summary_sentence


def fathometer_part(
    run: Mapping[str, Any],
    metrics: Mapping[str, Any],
    records: Sequence[Record],
    checks: Sequence[Check] = (),
) -> Part:
    """The whole part of one run, `checks` first."""
    return run_part(
        run,
        metrics,
        checks,
        summary=summary_sentence(metrics),
        cards=_cards(metrics),
        sections=_sections(run, metrics, records) if records else [],
    )


def response_image(run: Mapping[str, Any]) -> Image | None:
    """The depth responses of a run as its tracker saw them; None when its recording is gone.

    They are computed again by a tracker with two particles, whose estimates are not used.
    """
    config = FathometerConfig.from_mapping(run['parameters'], ignore_unknown=True)
    tracker = FathometerTracker(evolve(config, particles=2, smoothing_lag=0, preview_seconds=0.0))
    columns, depths, last = [], None, None
    for measurement in read_measurements(run):
        tracker.process(measurement)
        response = tracker.response
        if response is None or response is last:
            continue
        last = response
        if depths is None:
            depths = response.depth
        if len(response.depth) == len(depths):
            columns.append((response.stamp_ns, response.amplitude / response.sigma))
    if depths is None:
        return None
    columns.sort(key=lambda column: column[0])
    return Image(
        np.array([value for _, value in columns]).T,
        depths,
        np.array([stamp for stamp, _ in columns], np.int64),
    )


def _cards(metrics: Mapping[str, Any]) -> list[Card]:
    if 'scored_records' not in metrics:
        return [
            Card(f'{metrics["reflectors_mean"]:.1f}', 'Reflectors per record'),
            Card(str(metrics['ids']), 'Reflectors in all', f'{metrics["records"]} records'),
        ]
    cards = [
        Card(f'{100 * metrics["order_right"]:.0f} %', 'Number of reflectors right'),
        Card(f'{metrics["ospa_m"]:.3f} m', 'OSPA', f'cutoff {metrics["cutoff_m"]:g} m'),
        Card(
            f'{metrics["false_per_record"]:.2f} / {metrics["missed_per_record"]:.2f}',
            'False / missed per record',
        ),
    ]
    if metrics['depth']['n']:
        depth = metrics['depth']
        cards.append(
            Card(
                f'{depth["rmse_m"]:.3f} m',
                'Depth error, RMS',
                f'{100 * depth["inside_2_sigma"]:.0f} % within two stated sigma',
            )
        )
    if metrics['amplitude']['n']:
        error = metrics['amplitude']['median_relative_error']
        cards.append(Card(f'{100 * error:.0f} %', 'Amplitude error, median'))
    return cards


def _sections(
    run: Mapping[str, Any], metrics: Mapping[str, Any], records: Sequence[Record]
) -> list[Section]:
    committed = [record for record in records if not record.preview]
    start = records[0].stamp_ns
    image = response_image(run)
    sections = [
        Section(
            'Depth response and reflectors',
            'Grey: the response. Lines: the reflectors that were found, one colour per identity. '
            'Yellow: the true depths, where they are known.',
            figures.response_figure(image, committed, start),
        )
    ]
    if committed:
        sections += [
            Section(
                'How many there are',
                'Dark: this number of reflectors is probable. Line: the true number, when known.',
                figures.order_figure(committed, start),
            ),
            Section(
                'Amplitudes',
                'Corrected for spherical spreading where the depth of the array is known. A '
                'passive array measures ratios only, so the truth is scaled to match.',
                figures.amplitude_figure(
                    committed, start, metrics.get('amplitude', {}).get('factor')
                ),
            ),
        ]
    true = [record for record in committed if record.true is not None]
    if true:
        ospa = [pair(r.found.depth, r.true.depth, metrics['cutoff_m']).ospa for r in true]
        sections.append(
            Section(
                'Distance from the truth',
                'OSPA: RMS depth error, where a false or missed reflector counts as an error of '
                'the cutoff.',
                figures.distance_figure(true, np.array(ospa), start),
            )
        )
    if image is not None and committed:
        sections.append(_fixed_section(run, image, committed, metrics['cutoff_m'], start))
    return sections


def _fixed_section(
    run: Mapping[str, Any],
    image: Image,
    records: Sequence[Record],
    cutoff: float,
    start_ns: int,
) -> Section:
    fixed = fixed_orders(run, image, records, cutoff)
    text = 'Bootstrap filters with a fixed number of reflectors, on the same responses. '
    text += 'Blue: what they find. Yellow: the true depths, where they are known.'
    if np.isfinite([one.ospa for one in fixed]).all():
        apart = ', '.join(f'{one.ospa:.2f} m with {one.order}' for one in fixed)
        text += f' OSPA: {apart}.'
    return Section(
        'With a fixed number of reflectors',
        text,
        figures.fixed_order_figure(fixed, records, start_ns),
    )
