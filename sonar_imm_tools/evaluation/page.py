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

"""The page of a report: HTML and CSS, without any knowledge of tracking.

Everything is inside one file, plotly.js too, so a report can be mailed and opened offline.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from attrs import frozen
import plotly.graph_objects as go
import plotly.offline

STYLE = """
:root { --ink: #1b2733; --soft: #5b6875; --line: #e0e6ec; --blue: #0072B2; --ground: #f4f7f9; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink); line-height: 1.5;
  font-family: Inter, "Segoe UI", Roboto, Helvetica, Arial, sans-serif; }
header { background: linear-gradient(120deg, #0b2a42, #0f4c6e); color: white;
  padding: 40px 0 84px; }
header small { letter-spacing: .08em; text-transform: uppercase; opacity: .75; font-size: 12px; }
h1 { margin: 4px 0 12px; font-size: 30px; font-weight: 650; overflow-wrap: anywhere; }
header p { margin: 0; max-width: 820px; font-size: 17px; opacity: .95; }
.wrap { max-width: 1180px; margin: 0 auto; padding: 0 24px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(140px, 1fr)); gap: 14px;
  margin-top: -54px; }
.card, section { background: white; border: 1px solid var(--line); border-radius: 10px;
  box-shadow: 0 1px 3px rgba(20, 40, 60, .06); }
.card { padding: 16px 18px; }
.card b { display: block; font-size: 27px; font-weight: 650; font-variant-numeric: tabular-nums; }
.card span { display: block; font-size: 13px; font-weight: 600; line-height: 1.3;
  min-height: 2.6em; }
.card i { display: block; font-style: normal; font-size: 12.5px; color: var(--soft); }
section { margin: 18px 0; padding: 22px 26px; overflow-x: auto; }
h2 { margin: 0 0 2px; font-size: 19px; }
section > p { margin: 0 0 8px; color: var(--soft); max-width: 860px; font-size: 14px; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; }
th { text-align: left; color: var(--soft); font-weight: 600;
  border-bottom: 2px solid var(--line); }
th, td { padding: 5px 12px 5px 0; vertical-align: top; }
td { border-bottom: 1px solid var(--line); overflow-wrap: anywhere; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
details summary { cursor: pointer; color: var(--blue); font-size: 14px; padding: 4px 0; }
footer { color: var(--soft); font-size: 12.5px; padding-bottom: 40px; }
@media print { body { background: white; } section, .card { box-shadow: none;
  break-inside: avoid; } }
"""


LEAST_GL_POINTS = 2000
MOST_GL_FIGURES = 4
"""A browser keeps 16 WebGL contexts and blanks the oldest beyond. A figure takes up to three, so
only the largest figures of a page are drawn by WebGL."""


@frozen
class Card:
    """One key number: the value, what it is, and a line to compare it with."""

    value: str
    title: str
    remark: str = ''


@frozen
class Section:
    """A section of the page: heading, one paragraph, then a figure or some HTML."""

    title: str
    text: str
    figure: go.Figure | None = None
    html: str = ''


@frozen
class Part:
    """One recording on the page: a header with title and result, key numbers, sections."""

    kicker: str
    title: str
    summary: str
    cards: tuple[Card, ...]
    sections: tuple[Section, ...]


def render(title: str, parts: Sequence[Part], *, footer: str) -> str:
    """The whole page as text. The same arguments give the same bytes."""
    fast = _accelerated(parts)
    body = '\n'.join(_part(part, f'figure-{index}', fast) for index, part in enumerate(parts))
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE}</style>
<script>{plotly.offline.get_plotlyjs()}</script></head>
<body>
{body}
<footer class="wrap">{escape(footer)}</footer></body></html>
"""


def _accelerated(parts: Sequence[Part]) -> list[go.Figure]:
    """The figures that are drawn by WebGL: the few that have most points."""
    figures = [one.figure for part in parts for one in part.sections if one.figure is not None]
    heavy = [one for one in figures if _gl_points(one) >= LEAST_GL_POINTS]
    return sorted(heavy, key=_gl_points, reverse=True)[:MOST_GL_FIGURES]


def _gl_points(figure: go.Figure) -> int:
    return sum(len(trace.x) for trace in figure.data if trace.type == 'scattergl')


def _without_gl(figure: go.Figure) -> go.Figure:
    """The same figure, drawn without WebGL."""
    content = figure.to_dict()
    for trace in content['data']:
        if trace['type'] == 'scattergl':
            trace['type'] = 'scatter'
    return go.Figure(content)


def _part(part: Part, name: str, fast: Sequence[go.Figure]) -> str:
    boxes = '\n'.join(
        f'<div class="card"><span>{escape(card.title)}</span>'
        f'<b>{escape(card.value)}</b><i>{_prose(card.remark)}</i></div>'
        for card in part.cards
    )
    body = '\n'.join(
        _section(section, f'{name}-{index}', fast) for index, section in enumerate(part.sections)
    )
    return (
        f'<header><div class="wrap"><small>{escape(part.kicker)}</small>'
        f'<h1>{escape(part.title)}</h1><p>{_prose(part.summary)}</p></div></header>\n'
        f'<main class="wrap"><div class="cards">{boxes}</div>\n{body}</main>'
    )


def table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """An HTML table; numbers are aligned."""
    head = ''.join(f'<th>{escape(text)}</th>' for text in header)
    body = ''.join(f'<tr>{"".join(_cell(value) for value in row)}</tr>' for row in rows)
    return f'<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def folded(summary: str, html: str) -> str:
    """`html` folded away behind the line `summary`, which opens it."""
    return f'<details><summary>{escape(summary)}</summary>{html}</details>'


def mapping_table(header: tuple[str, str], values: Mapping[str, object]) -> str:
    """A two-column table of names and values."""
    return table(header, values.items())


def _prose(text: str) -> str:
    """Running text; a number and its percent sign stay on one line."""
    return escape(text.replace(' %', '\u00a0%'))


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f'<td class="number">{value:.6g}</td>'
    kind = ' class="number"' if isinstance(value, int) else ''
    text = ', '.join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
    return f'<td{kind}>{escape(text)}</td>'


def _section(section: Section, name: str, fast: Sequence[go.Figure]) -> str:
    figure = ''
    if section.figure is not None:
        accelerated = any(one is section.figure for one in fast)
        drawn = section.figure if accelerated else _without_gl(section.figure)
        figure = drawn.to_html(
            full_html=False,
            include_plotlyjs=False,
            div_id=name,
            config={
                'displaylogo': False,
                'responsive': True,
                'modeBarButtonsToRemove': ['lasso2d', 'select2d', 'autoScale2d'],
            },
        )
    return (
        f'<section><h2>{escape(section.title)}</h2><p>{_prose(section.text)}</p>'
        f'{figure}{section.html}</section>'
    )
