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

"""The report: one HTML file for readers who need not know filters.

A system provides the key numbers and the figures of a run. `run_part` adds what is the same for
all: the comparison with a live node, all numbers, what happened to the input, and its provenance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sonar_imm import __version__
from sonar_imm.files import whole

from .judging import Check
from .numbers import flatten
from .page import Card, folded, mapping_table, Part, render, Section, table


def write_report(path: Path, parts: Sequence[Part]) -> None:
    """Write one report of one or several runs, of one or several systems, to `path`."""
    with whole(path) as unfinished:
        unfinished.write_text(report_html(parts), encoding='utf-8')


def report_html(parts: Sequence[Part]) -> str:
    """The report as text; the same parts give the same bytes."""
    return render(
        ', '.join(part.title for part in parts),
        parts,
        footer=f'Made by sonar_imm {__version__}. Times are seconds since the first '
        'estimate of a run.',
    )


def run_part(
    run: Mapping[str, Any],
    metrics: Mapping[str, Any],
    checks: Sequence[Check],
    *,
    summary: str,
    cards: Iterable[Card],
    sections: Iterable[Section],
) -> Part:
    """One run on the page: `checks` first, then the sections of its system, then the rest.

    run: the content of ``run.json``; metrics: that of ``metrics.json``.
    """
    return Part(
        f'sonar_imm · {run["system"]} tracker',
        Path(run['bag']).name,
        summary,
        tuple(cards),
        (*_comparison(checks), *sections, _numbers(metrics), *_about(run)),
    )


def _comparison(checks: Sequence[Check]) -> list[Section]:
    if not checks:
        return []
    rows = [
        (check.name, check.result, check.wanted, 'yes' if check.good else 'NO') for check in checks
    ]
    return [
        Section(
            'Live node against offline tracker',
            'The recording was played to a real ROS 2 node, '
            'message by message, and what the node published was compared with the offline run.',
            html=table(('check', 'result', 'wanted', 'good'), rows),
        )
    ]


def _numbers(metrics: Mapping[str, Any]) -> Section:
    return Section(
        'All numbers',
        'The content of metrics.json. The bounds suppose that successive errors are '
        'independent, which those of one track are not quite.',
        html=folded('Show them', mapping_table(('metric', 'value'), flatten(metrics))),
    )


def _about(run: Mapping[str, Any]) -> list[Section]:
    counts = run.get('counts', {})
    refused = run.get('refused', {})
    sections = [
        Section(
            'What happened to the input',
            'Every message is accounted for.',
            html=table(('outcome', 'messages'), counts.items()),
        )
    ]
    if refused:
        rows = [(reason, entry['count'], entry['example']) for reason, entry in refused.items()]
        sections.append(
            Section(
                'Refused input',
                'Messages that could not be used, with the first of each kind.',
                html=table(('reason', 'messages', 'why'), rows),
            )
        )
    parameters = folded(
        'Show them', mapping_table(('parameter', 'value'), run.get('parameters', {}))
    )
    about = {
        key: run[key]
        for key in ('bag', 'bag_sha256', 'bag_bytes', 'order', 'smoothed', 'topics')
        if key in run
    } | dict(run.get('versions', {}))
    about['topics'] = [f'{topic} as {name}' for topic, name in run['topics'].items()]
    return [
        *sections,
        Section('Parameters', 'The parameters of the tracker.', html=parameters),
        Section(
            'Provenance',
            'Input and versions, to repeat the run.',
            html=mapping_table(('what', 'value'), about),
        ),
    ]
