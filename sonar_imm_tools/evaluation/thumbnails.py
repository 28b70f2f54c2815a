# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Small pictures for the front page of a report: the lines and points of a figure as SVG."""

from __future__ import annotations

from typing import Any

import numpy as np
import plotly.graph_objects as go

from sonar_imm.estimation.arrays import FloatArray

from .plotting import GREY, thin

WIDTH, HEIGHT, MARGIN = 260, 150, 6
"""Size of a picture and its empty border, pixels."""
MOST_POINTS = 400
"""Points of a line that a picture this small can show."""


def thumbnail(figure: go.Figure) -> str:
    """Draw the first axes of a figure: filled areas, lines and points, without labels or images.

    The view is that of the figure where it states one, else all points. Returns an SVG element.
    """
    traces = [trace for trace in figure.data if trace.type in ('scatter', 'scattergl')]
    traces = [trace for trace in traces if (trace.xaxis or 'x') == 'x' and len(trace.x)]
    points = [_points(trace) for trace in traces]
    place = _placement(figure.layout, points)
    shapes = ''.join(_shapes(trace, place(xy)) for trace, xy in zip(traces, points))
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" aria-hidden="true" fill="none" '
        f'stroke-linecap="round">{shapes}</svg>'
    )


def _points(trace: Any) -> FloatArray:
    """Return the points of a trace, (N, 2), NaN where its line is broken."""
    xy = np.column_stack([np.asarray(trace.x, dtype=float), np.asarray(trace.y, dtype=float)])
    return xy if trace.fill else xy[thin(len(xy), MOST_POINTS)]


def _placement(layout: go.Layout, points: list[FloatArray]) -> Any:
    """Return the function from coordinates (N, 2) to pixels, y downwards."""
    every = np.concatenate([np.full((1, 2), np.nan), *points])
    every = every[np.isfinite(every).all(axis=1)]
    axes = (layout.xaxis, layout.yaxis)
    low, high = np.zeros(2), np.ones(2)
    for side, axis in enumerate(axes):
        if axis.range is not None:
            low[side], high[side] = axis.range
        elif len(every):
            low[side], high[side] = every[:, side].min(), every[:, side].max()
            if axis.autorange == 'reversed':
                low[side], high[side] = high[side], low[side]
    size = np.array([WIDTH, HEIGHT]) - 2.0 * MARGIN
    span = np.where(high == low, 1.0, high - low)
    scale = size / span
    if layout.yaxis.scaleanchor:
        scale = np.sign(scale) * np.abs(scale).min()
    middle = (low + high) / 2.0

    def place(xy: FloatArray) -> FloatArray:
        pixels: FloatArray = (xy - middle) * scale * [1.0, -1.0] + [WIDTH / 2, HEIGHT / 2]
        return pixels

    return place


def _shapes(trace: Any, pixels: FloatArray) -> str:
    """Return the paths of one trace; pixels: (N, 2)."""
    shapes = ''
    mode = trace.mode or 'lines'
    line, marker = trace.line, trace.marker
    if trace.fill:
        shapes += f'<path fill="{trace.fillcolor}" stroke="none" d="{_path(pixels)}"/>'
    elif 'lines' in mode:
        dash = ' stroke-dasharray="2 3"' if line.dash else ''
        shapes += (
            f'<path stroke="{line.color or GREY}" stroke-width="1.5"{dash} d="{_path(pixels)}"/>'
        )
    if mode == 'markers':
        colour = marker.color if isinstance(marker.color, str) else marker.line.color
        shapes += (
            f'<path stroke="{colour or GREY}" stroke-width="2.5" '
            f'd="{"".join(f"M{x:.1f} {y:.1f}h0" for x, y in pixels[_finite(pixels)])}"/>'
        )
    return shapes


def _path(pixels: FloatArray) -> str:
    """Return the commands of a path that is broken at NaN."""
    parts = []
    pen_up = True
    for (x, y), drawn in zip(pixels, _finite(pixels)):
        if drawn:
            parts.append(f'{"M" if pen_up else "L"}{x:.1f} {y:.1f}')
        pen_up = not drawn
    return ''.join(parts)


def _finite(pixels: FloatArray) -> Any:
    return np.isfinite(pixels).all(axis=1)
