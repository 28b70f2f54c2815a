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

A system provides the key numbers and sections of a run. ``templates/report.html`` adds what is the
same for all: the comparison with a live node, all numbers, what happened to the input, and its
provenance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from attrs import frozen
from jinja2 import Environment, FileSystemLoader, StrictUndefined
import plotly.graph_objects as go
import plotly.offline

from sonar_imm import __version__
from sonar_imm.files import whole

from .numbers import Card, Check, flatten

LEAST_GL_POINTS = 2000
MOST_GL_FIGURES = 4
"""A browser keeps 16 WebGL contexts and blanks the oldest beyond. A figure takes up to three, so
only the largest figures of a page are drawn by WebGL."""


@frozen
class Section:
    """A section of the page: heading, one paragraph, then a figure or a table."""

    title: str
    text: str
    figure: go.Figure | None = None
    header: Sequence[str] = ()
    rows: Sequence[Sequence[object]] = ()


@frozen(kw_only=True)
class Part:
    """One run on the page. run: the content of ``run.json``; metrics: that of ``metrics.json``."""

    run: Mapping[str, Any]
    metrics: Mapping[str, Any]
    summary: str
    checks: Sequence[Check] = ()
    cards: Sequence[Card] = ()
    sections: Sequence[Section] = ()

    @property
    def title(self) -> str:
        """The name of the recording."""
        return Path(self.run['bag']).name

    @property
    def check_rows(self) -> list[tuple[str, str, str, str]]:
        """The checks as a table."""
        return [(c.name, c.result, c.wanted, 'yes' if c.good else 'NO') for c in self.checks]

    @property
    def refused(self) -> list[tuple[str, int, str]]:
        """Why messages could not be used, how many, and the first of each kind."""
        reasons = self.run.get('refused', {}).items()
        return [(reason, entry['count'], entry['example']) for reason, entry in reasons]

    @property
    def provenance(self) -> dict[str, Any]:
        """What is needed to repeat the run."""
        names = ('bag', 'bag_sha256', 'bag_bytes', 'order', 'smoothed')
        about = {name: self.run[name] for name in names if name in self.run}
        topics = [f'{topic} as {name}' for topic, name in self.run['topics'].items()]
        return about | {'topics': topics} | dict(self.run.get('versions', {}))


def write_report(path: Path, parts: Sequence[Part]) -> None:
    """Write one report of one or several runs, of one or several systems, to `path`."""
    with whole(path) as unfinished:
        unfinished.write_text(report_html(parts), encoding='utf-8')


def report_html(parts: Sequence[Part]) -> str:
    """The report as text; the same parts give the same bytes."""
    pages = Environment(
        loader=FileSystemLoader(Path(__file__).with_name('templates')),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.filters['flat'] = flatten
    # A number and its percent sign stay on one line.
    pages.filters['unbroken'] = lambda text: text.replace(' %', '\u00a0%')
    return pages.get_template('report.html').render(
        parts=parts,
        draw=partial(_draw, _accelerated(parts)),
        plotlyjs=plotly.offline.get_plotlyjs(),
        version=__version__,
    )


def _accelerated(parts: Sequence[Part]) -> list[go.Figure]:
    """The figures that are drawn by WebGL: the few that have most points."""
    figures = [section.figure for part in parts for section in part.sections]
    heavy = [figure for figure in figures if figure and _gl_points(figure) >= LEAST_GL_POINTS]
    return sorted(heavy, key=_gl_points, reverse=True)[:MOST_GL_FIGURES]


def _gl_points(figure: go.Figure) -> int:
    return sum(len(trace.x) for trace in figure.data if trace.type == 'scattergl')


def _draw(accelerated: Sequence[go.Figure], figure: go.Figure, name: str) -> str:
    if not any(figure is fast for fast in accelerated):
        content = figure.to_dict()
        for trace in content['data']:
            if trace['type'] == 'scattergl':
                trace['type'] = 'scatter'
        figure = go.Figure(content)
    buttons = ['lasso2d', 'select2d', 'autoScale2d']
    config = {'displaylogo': False, 'responsive': True, 'modeBarButtonsToRemove': buttons}
    return figure.to_html(full_html=False, include_plotlyjs=False, div_id=name, config=config)
