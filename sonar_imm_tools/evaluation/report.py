# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The report: HTML for readers who need not know filters.

A run is one file, plotly.js inside, so that it can be mailed and opened offline. Several runs are
a front page with a row for each, and beside it a folder of their pages, which share plotly.js.
A plot is unpacked and drawn when it comes into view.

A system provides the key numbers and sections of a run. ``templates/report.html`` adds what is the
same for all: the comparison with a live node, all numbers, what happened to the input, and its
provenance.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from functools import partial
import gzip
from pathlib import Path
import re
from typing import Any
from urllib.parse import quote

from attrs import frozen
from jinja2 import Environment, FileSystemLoader, StrictUndefined
import plotly.graph_objects as go
import plotly.offline

from sonar_imm import __version__
from sonar_imm.files import whole
from sonar_imm.texts import visible

from ..recordings.sources import BagError
from .numbers import Card, Check, counted, flatten, front
from .plotting import plain_content, thumbnail

LEAST_GL_POINTS = 2000
MOST_GL_FIGURES = 4
"""A browser keeps 16 WebGL contexts and blanks the oldest beyond. A figure takes up to three, so
only the largest figures of a page are drawn by WebGL."""
PLOTLYJS = 'plotly.packed.js'
EARLIEST_DATE_NS, LATEST_DATE_NS = 315_532_800 * 10**9, 4_102_444_800 * 10**9
"""Stamps from 1980 to 2100 are shown as dates; others count from a start of their own."""
LONGEST_HEAD = 65536
"""Bytes in which a page says who made it."""


@frozen
class Section:
    """A section of the page: heading, one paragraph, then a figure or a table. picture: whether
    its figure stands for the run on the front page of several."""

    title: str
    text: str
    figure: go.Figure | None = None
    header: Sequence[str] = ()
    rows: Sequence[Sequence[object]] = ()
    picture: bool = False


@frozen(kw_only=True)
class Part:
    """One run of the report. run: the content of ``run.json``; metrics: that of ``metrics.json``;
    seen: what was tracked, in a few words; verdict: on the stated uncertainty, in one."""

    run: Mapping[str, Any]
    metrics: Mapping[str, Any]
    summary: str
    seen: str = ''
    verdict: str = ''
    checks: Sequence[Check] = ()
    cards: Sequence[Card] = ()
    sections: Sequence[Section] = ()

    @property
    def title(self) -> str:
        """The name of the recording."""
        return Path(self.run['bag']).name

    @property
    def input(self) -> str:
        """The topics that were tracked, and what they were read as where their name differs."""
        return ', '.join(
            topic if topic.endswith(f'/{name}') else f'{topic} as {name}'
            for topic, name in self.run['topics'].items()
        )

    @property
    def failed(self) -> list[str]:
        """The checks that failed."""
        return [check.name for check in self.checks if not check.good]

    @property
    def outcome(self) -> str:
        """What the checks and the stated uncertainty say, for the front page."""
        if self.failed:
            return f'FAILED: {", ".join(self.failed)}'
        checked = [f'{counted(len(self.checks), "check")} ok'] if self.checks else []
        return ', '.join([*checked, self.verdict or 'uncertainty not scored'])

    @property
    def start(self) -> str:
        """The date and time of the first estimate; empty where it has none, or before 1980."""
        stamp = self.run.get('first_stamp_ns', 0)
        if not EARLIEST_DATE_NS < stamp < LATEST_DATE_NS:
            return ''
        instant = datetime.fromtimestamp(stamp // 10**9, timezone.utc)
        return f'{instant:%Y-%m-%d %H:%M:%S} UTC'

    @property
    def picture(self) -> go.Figure | None:
        """The figure that stands for the run, None without one."""
        return next((section.figure for section in self.sections if section.picture), None)

    @property
    def was_played(self) -> bool:
        """Whether the node heard the recording: there are other checks than that of the error."""
        return any(not check.name.endswith(' against truth') for check in self.checks)

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
        return about | {'topics': self.input} | dict(self.run.get('versions', {}))


def write_report(path: Path, parts: Sequence[Part]) -> None:
    """Write a report of one or several runs, of one or several systems, to `path`.

    Of several, `path` is the front page, and their pages are in a folder beside it, which is
    ``report_runs`` for ``report.html``.
    """
    if len(parts) == 1:
        write_page(path, report_html(parts[0]))
        return
    folder = path.with_name(f'{path.stem}_runs')
    plotlyjs = packed(_plotlyjs())
    write_page(folder / PLOTLYJS, f"const packedPlotlyJs = '{plotlyjs}';\n")
    names = page_names(parts)
    for part, name in zip(parts, names):
        write_page(folder / name, report_html(part, front_page=f'../{path.name}'))
    write_page(path, front_html(parts, [f'{folder.name}/{name}' for name in names]))


def page_names(parts: Sequence[Part]) -> list[str]:
    """A file name for each page, in their order, of letters that every system takes."""
    digits = len(str(len(parts)))
    return [
        f'{number:0{digits}}_{re.sub(r"[^A-Za-z0-9_-]+", "_", part.title)[:80]}.html'
        for number, part in enumerate(parts, 1)
    ]


def report_html(part: Part, front_page: str = '') -> str:
    """The page of a run as text; the same part gives the same bytes. front_page: where the front
    page of several is, which share plotly.js; without one it is inside the page."""
    figures = [section.figure for section in part.sections if section.figure is not None]
    # Those with most points are drawn by WebGL.
    heavy = [figure for figure in figures if _gl_points(figure) >= LEAST_GL_POINTS]
    fast = sorted(heavy, key=_gl_points, reverse=True)[:MOST_GL_FIGURES]
    return rendered(
        'report.html',
        part=part,
        front_page=quote(front_page),
        draw=partial(_packed_figure, fast),
        plotlyjs='' if front_page else packed(_plotlyjs()),
    )


def front_html(parts: Sequence[Part], links: Sequence[str]) -> str:
    """The front page of several runs, a row for each, with the address of its page."""
    rows = [(part, quote(link), front(part.cards)) for part, link in zip(parts, links)]
    # The picture of one run of each system, the one with most checks.
    best: dict[str, tuple[Part, str, go.Figure]] = {}
    for part, link in zip(parts, links):
        held, picture = best.get(part.run['system']), part.picture
        if picture is not None and (held is None or len(part.checks) > len(held[0].checks)):
            best[part.run['system']] = part, link, picture
    pictures = [(part, quote(link), thumbnail(drawn)) for part, link, drawn in best.values()]
    return rendered('front.html', rows=rows, pictures=pictures)


def rendered(template: str, **values: Any) -> str:
    """A page as text; template: of the folder ``templates``."""
    pages = Environment(
        loader=FileSystemLoader(Path(__file__).with_name('templates')),
        autoescape=True,
        finalize=_visible,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    pages.filters['flat'] = flatten
    # A number and its percent sign stay on one line.
    pages.filters['unbroken'] = lambda text: text.replace(' %', '\u00a0%')
    return pages.get_template(template).render(version=__version__, **values)


def _visible(value: object) -> object:
    """What a page shows of a value: names may hold characters that turn text round."""
    is_html = hasattr(value, '__html__')
    return visible(value) if isinstance(value, str) and not is_html else value


def write_page(path: Path, text: str) -> None:
    """Write a page or script of a report; bytes of file names that are not UTF-8 become visible
    escapes. Raises `BagError` where another file is there that this package did not make."""
    if path.is_file():
        with path.open('rb') as file:
            start = file.read(LONGEST_HEAD)
        if start and not _OURS.match(start):
            raise BagError(f'{path} is there already and is no report; choose another name')
    with whole(path) as unfinished:
        unfinished.write_bytes(text.encode('utf-8', 'backslashreplace'))


_OURS = re.compile(rb'\s*<!doctype html>.*sonar_imm|const packedPlotlyJs = ', re.DOTALL | re.I)


def _plotlyjs() -> str:
    """plotly.js, its one function in parentheses where it begins as known: a browser compiles such
    a one when it reads it, and others when they are called, after another look at 5 MB."""
    text = plotly.offline.get_plotlyjs()
    head, begin, body = text.partition(', () => {\n"use strict";')
    known = begin and body.endswith('}));')
    return f'{head}, ({begin[2:]}{body[:-2]}));' if known else text


def packed(text: str) -> str:
    """A text as the page has it: gzip as base64."""
    compressed = gzip.compress(text.encode('utf-8', 'backslashreplace'), mtime=0)
    return base64.b64encode(compressed).decode('ascii')


def _gl_points(figure: go.Figure) -> int:
    return sum(len(trace.x) for trace in figure.data if trace.type == 'scattergl')


def _packed_figure(accelerated: Sequence[go.Figure], figure: go.Figure) -> str:
    content = plain_content(figure)
    if not any(figure is fast for fast in accelerated):
        for trace in content['data']:
            if trace['type'] == 'scattergl':
                trace['type'] = 'scatter'
    return packed(go.Figure(content).to_json())
