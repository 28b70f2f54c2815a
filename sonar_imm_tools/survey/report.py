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

"""The page of a survey: chart, uncertainty, what competes, misties, what could not be told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
import math
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import plotly.offline

from sonar_imm import __version__
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.files import whole

from ..evaluation.plotting import add_points, COLOURS, styled
from ..offline.run_folder import REPORT
from .adjustment import robust_rms
from .chart import Chart
from .making import Survey

MOST_CELLS = 400
"""Cells along the longer side of a figure."""
SUN = (math.radians(315.0), math.radians(45.0))
"""Azimuth from north, clockwise, and elevation of the light."""
STYLE = (
    'body{font-family:Inter,"Segoe UI",Roboto,Helvetica,Arial,sans-serif;max-width:60rem;'
    'margin:2rem auto;padding:0 1rem;color:#1b2733}table{border-collapse:collapse}'
    'td,th{padding:.2rem .8rem;text-align:left;border-bottom:1px solid #e4e9ee}'
)


def write_report(out: Path, survey: Survey, chart: Chart, content: Mapping[str, Any]) -> None:
    """Write report.html. content: that of adjustment.json."""
    with whole(out / REPORT) as unfinished:
        unfinished.write_text(page(survey, chart, content), encoding='utf-8')


def page(survey: Survey, chart: Chart, content: Mapping[str, Any]) -> str:
    """The page as text; the same survey gives the same bytes."""
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Survey</title>',
        f'<style>{STYLE}</style><script>{plotly.offline.get_plotlyjs()}</script></head><body>',
        f'<h1>Survey</h1><p>{_summary(survey, chart)}</p>',
        *(f'<p><strong>{escape(sentence)}</strong></p>' for sentence in survey.warnings),
    ]
    seen = chart.bands
    thin = max(1, math.ceil(max(chart.shape) / MOST_CELLS))
    competing = np.where(np.nan_to_num(seen['hypotheses']) > 1, seen['competing_depth'], np.nan)
    figures = [
        ('Depth', 'With the light from north-west.', hillshaded(chart, thin)),
        (
            'Uncertainty',
            'One standard deviation: noise, errors that pings and lines have in common, and what '
            'is not known of the corrections, the common level included.',
            _image(chart, seen['uncertainty'], thin, 'sd [m]', 'Cividis'),
        ),
        (
            'Competing depths',
            'Where other soundings, two or more, say another depth: how much deeper it would be.',
            _image(chart, competing - seen['depth'], thin, 'deeper by [m]', 'RdBu'),
        ),
        (
            'Misties',
            'Robust rms of the difference of two lines that cross.',
            misties_figure(survey),
        ),
    ]
    for number, (title, text, figure) in enumerate(figures):
        drawn = figure.to_html(full_html=False, include_plotlyjs=False, div_id=f'figure{number}')
        parts.append(f'<h2>{title}</h2><p>{text}</p>{drawn}')
    if content['parameters']:
        parts += _corrections(content)
    parts.append(f'<p>sonar_imm {__version__}</p></body></html>\n')
    return '\n'.join(parts)


def hillshaded(chart: Chart, thin: int) -> go.Figure:
    """Depths, darker where they turn from the light."""
    depth = chart.bands['depth'][::thin, ::thin]
    figure = _image(chart, chart.bands['depth'], thin, 'depth [m]', 'Viridis_r')
    # Rows go south.
    down, east = (
        np.gradient(-depth, thin * chart.cell) if min(depth.shape) > 1 else (0 * depth,) * 2
    )
    azimuth, elevation = SUN
    light = math.sin(elevation) - math.cos(elevation) * (
        math.sin(azimuth) * east - math.cos(azimuth) * down
    )
    shade = np.clip(light / np.sqrt(1.0 + np.square(east) + np.square(down)), 0.0, 1.0)
    x, y = _axes(chart, thin)
    figure.add_heatmap(
        x=x,
        y=y,
        z=(1.0 - shade).astype(np.float32),
        colorscale=[[0.0, 'rgba(0,0,0,0)'], [1.0, 'rgba(0,0,0,0.7)']],
        showscale=False,
        hoverinfo='skip',
    )
    return figure


def misties_figure(survey: Survey) -> go.Figure:
    """Robust rms of each pair of lines, before and after."""
    figure = go.Figure()
    pairs = sorted({*survey.before, *survey.after})
    for name, found, colour in (
        ('before', survey.before, COLOURS[1]),
        ('after', survey.after, COLOURS[0]),
    ):
        there = [k for k, pair in enumerate(pairs) if pair in found]
        values = [robust_rms(found[pairs[k]]) for k in there]
        if there:
            add_points(figure, there, values, name, colour, 6)
    return styled(
        figure, 320, {'title': 'pair of lines'}, {'title': 'rms [m]', 'rangemode': 'tozero'}
    )


def _image(chart: Chart, values: FloatArray, thin: int, title: str, colours: str) -> go.Figure:
    x, y = _axes(chart, thin)
    shown = values[::thin, ::thin].astype(np.float32)
    low, high = (-1.0, 1.0)
    if np.isfinite(shown).any():
        low, high = np.nanquantile(shown, [0.01, 0.99]).tolist()
    if colours == 'RdBu':
        high = max(abs(low), abs(high))
        low = -high
    figure = go.Figure()
    figure.add_heatmap(
        x=x, y=y, z=shown, colorscale=colours, zmin=low, zmax=high, colorbar={'title': title}
    )
    axis = {'zeroline': False, 'tickformat': 'd'}
    east = {'title': 'east [m]', 'constrain': 'domain', 'nticks': 5, **axis}
    north = {'title': 'north [m]', 'scaleanchor': 'x', **axis}
    return styled(figure, 560, east, north)


def _axes(chart: Chart, thin: int) -> tuple[FloatArray, FloatArray]:
    rows, columns = chart.shape
    x = chart.west + chart.cell * (np.arange(columns)[::thin] + 0.5)
    y = chart.north - chart.cell * (np.arange(rows)[::thin] + 0.5)
    return np.asarray(x, np.float64), np.asarray(y, np.float64)


def _summary(survey: Survey, chart: Chart) -> str:
    lines = [line for line in survey.lines if not line['failure']]
    total = sum(line['soundings'] for line in lines)
    depth = chart.bands['depth']
    words = [
        f'{len(lines)} lines with {total:,} soundings; depths of {np.nanmin(depth):.1f} to '
        f'{np.nanmax(depth):.1f} m; median standard deviation '
        f'{np.nanmedian(chart.bands["uncertainty"]):.2f} m.'
    ]
    if survey.adjustment is not None:
        rms = survey.adjustment.rms
        words.append(f'Misties {rms[0]:.3f} m rms before the adjustment, {rms[-1]:.3f} m after.')
    elif survey.crossing_cells:
        words.append(
            f'Not adjusted: misties of {survey.rms_before:.3f} m rms are in the uncertainty.'
        )
    failed = [line['name'] for line in survey.lines if line['failure']]
    if failed:
        words.append(f'Not read: {escape(", ".join(failed))}.')
    return ' '.join(words)


def _corrections(content: Mapping[str, Any]) -> list[str]:
    """Tables of the corrections, true less reported, and of what could not be told."""
    rows = [
        (
            row['line'] or 'survey',
            row['name'],
            f'{row["value"]:+.4f}',
            f'{row["std"]:.4f}',
            f'{100.0 * row["told"]:.1f} %',
        )
        for row in content['parameters']
    ]
    weak = [(f'{100.0 * e["share"]:.1f} %', e['combination']) for e in content['not_told'][:20]]
    return [
        '<h2>Corrections</h2><p>True less reported; <em>told</em> is the share of the prior '
        'variance that the lines took away.</p>',
        _table(('of', 'correction', 'value', 'sd', 'told'), rows),
        '<h2>What could not be told</h2><p>Combinations of corrections, in units of their priors, '
        'of which the lines say less than the prior does, and what is left of its variance.</p>',
        _table(('left', 'combination'), weak),
    ]


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = ''.join(f'<th>{name}</th>' for name in heads)
    body = ''.join(
        '<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>' for row in rows
    )
    return f'<table><tr>{head}</tr>{body}</table>'
