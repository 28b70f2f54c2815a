# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the figures of all systems share: colours, style, kinds of traces, and the NIS figure.

Colours are those of Okabe and Ito, which people with any colour vision can tell apart.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
import plotly.graph_objects as go

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimation.arrays import FloatArray, IntArray
from sonar_imm.estimation.association import gate_threshold
from sonar_imm.estimation.consistency import average_bounds
from sonar_imm.texts import visible

from .. import SECOND

INK, GRID, GREY, AMBER = '#1b2733', '#e4e9ee', '#8593a1', '#E69F00'
COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
MOST_POINTS = 20_000
FONT = 'Inter, "Segoe UI", Roboto, Helvetica, Arial, sans-serif'
TRUTH = {'color': INK, 'width': 1.5, 'dash': 'dot'}
"""How the truth is drawn."""
TIME = {'title': 'time [s]', 'zeroline': False}
BARE = {'showgrid': False, 'zeroline': False}
"""An axis of an image."""
_TAG = re.compile(r'<(?!/?(?:b|br|extra|i|sub|sup)>)')
"""Where a tag begins that our own texts do not use."""


class Picture(go.Figure):
    """A figure of a report, in its style."""

    def line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        name: str | None,
        colour: str,
        width: float = 2,
        *,
        gl: bool = False,
        **further: Any,
    ) -> None:
        """Add a line; gl: it may be drawn by WebGL; further: of the trace."""
        add = self.add_scattergl if gl else self.add_scatter
        line = {'color': colour, 'width': width}
        add(x=x, y=y, **{'mode': 'lines', 'name': name, 'line': line} | further)

    def points(
        self, x: ArrayLike, y: ArrayLike, name: str, colour: str, size: float = 4, **marker: Any
    ) -> None:
        """Add points; marker: more of how they look."""
        look = {'size': size, 'color': colour} | marker
        self.add_scattergl(x=x, y=y, mode='markers', name=name, marker=look)

    def band(
        self,
        x: FloatArray,
        low: FloatArray,
        high: FloatArray,
        colour: str,
        opacity: tuple[float, float],
        name: str | None = None,
        **further: Any,
    ) -> None:
        """Add the band between `low` and `high`; opacity: of the area and of its outline."""
        area, outline = (transparent(colour, each) for each in opacity)
        look = {'fill': 'toself', 'fillcolor': area, 'hoverinfo': 'skip'} | further
        x, y = np.concatenate([x, x[::-1]]), np.concatenate([low, high[::-1]])
        self.line(x, y, name, outline, 0.5, **look)

    def image(
        self,
        x: ArrayLike,
        y: ArrayLike,
        z: ArrayLike,
        title: str = 'probability',
        *,
        limits: tuple[float, float] = (0.0, 1.0),
        colours: str = 'Blues',
        **further: Any,
    ) -> None:
        """Add an image of `z` (y, x); title: of its colours."""
        bar = {'title': {'text': title, 'side': 'right'}, 'thickness': 12}
        scale = {'zmin': limits[0], 'zmax': limits[1], 'colorscale': colours, 'colorbar': bar}
        self.add_heatmap(x=x, y=y, z=z, **scale, **further)

    def styled(self, height: int, x: dict[str, Any], y: dict[str, Any]) -> Picture:
        """The same in the style of the page; height: in pixels; x, y: what its axes have."""
        self.update_layout(
            height=height,
            margin={'l': 64, 'r': 24, 't': 44, 'b': 52},
            paper_bgcolor='white',
            plot_bgcolor='white',
            font={'family': FONT, 'size': 13, 'color': INK},
            hovermode='closest',
            legend={'orientation': 'h', 'y': 1.02, 'yanchor': 'bottom', 'x': 0},
        )
        axis = {'gridcolor': GRID, 'zerolinecolor': '#c3ccd5', 'linecolor': '#c3ccd5', 'ticks': ''}
        self.update_xaxes(x | axis)
        self.update_yaxes(y | axis)
        return self


def plain_content(figure: go.Figure) -> dict[str, Any]:
    """The content of `figure` as a dict. Names in its texts make no links and load no pictures:
    plotly reads tags in texts, of which those without attributes stay."""
    content: dict[str, Any] = _plain(figure.to_dict())
    return content


def _plain(value: Any) -> Any:
    if isinstance(value, str):
        return visible(_TAG.sub('&lt;', value))
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray) and value.dtype.kind in 'OU':
        return [_plain(item) for item in value.tolist()]
    return value


def nis_figure(time: FloatArray, nis: FloatArray, dof: FloatArray) -> Picture:
    """NIS of every hit over `time` [s], its running mean, and the chi-square bounds.

    Where the degrees of freedom vary (more or fewer receivers per ping), NIS is divided by them,
    and there are no common bounds.
    """
    same = len(np.unique(dof)) == 1
    shared = int(dof[0]) if same else 0
    nis = nis if same else nis / dof
    figure = Picture()
    shown = thin(len(nis), MOST_POINTS)
    figure.points(time[shown], nis[shown], 'NIS of a hit', COLOURS[0], opacity=0.6)
    width = max(5, min(50, len(nis) // 8))
    if len(nis) > width:
        mean = np.convolve(nis, np.full(width, 1.0 / width), mode='valid')
        figure.line(time[width - 1 :], mean, f'mean of {width}', INK, 2, gl=True)
        if shared:
            low, high = average_bounds(width, shared)
            figure.add_hrect(y0=low, y1=high, fillcolor=AMBER, opacity=0.25, line_width=0)
    if shared:
        figure.add_hline(
            y=gate_threshold(0.95, shared),
            line={'color': COLOURS[1], 'dash': 'dash'},
            annotation_text='95 % of the hits should lie below',
        )
    title = 'NIS' if same else 'NIS / degrees of freedom'
    return figure.styled(340, TIME, {'title': title, 'rangemode': 'tozero'})


def seconds(stamp_ns: IntArray, scan_ns: IntArray) -> FloatArray:
    """Seconds since the first scan of the run."""
    return (stamp_ns - scan_ns[0]) / SECOND if len(scan_ns) else np.empty(0)


def thin(count: int, most: int) -> slice:
    """A slice that takes at most `most` of `count` rows, evenly spaced."""
    return slice(None, None, max(1, -(-count // most)))


def transparent(colour: str, opacity: float) -> str:
    """The colour ``#rrggbb`` with an opacity from 0 to 1."""
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f'rgba({red},{green},{blue},{opacity})'


def in_degrees(figure: go.Figure, origin: Origin) -> go.Figure:
    """A map in metres drawn in latitude and longitude, north up, with a scale bar; at its
    middle a metre is as long to the east as to the north."""

    def geodetic(x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        east, north = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        return origin.degrees(np.column_stack([east, north]))

    x_range, y_range = (figure.layout[name].range for name in ('xaxis', 'yaxis'))
    for trace in figure.data:
        trace.x, trace.y = geodetic(trace.x, trace.y)
        if trace.hovertemplate is not None:
            ends = trace.hovertemplate.partition(': x ')[0]
            trace.hovertemplate = f'{ends}: latitude %{{y:.6f}}, longitude %{{x:.6f}}'
    shape = 1.0 / np.cos(np.radians(origin.latitude))
    degrees = {'tickformat': '.5~f', 'ticksuffix': '\u00b0'}
    figure.update_xaxes(title='longitude', nticks=6, **degrees)
    figure.update_yaxes(title='latitude', scaleratio=shape, **degrees)
    if x_range is None:
        return figure
    longitude, latitude = geodetic(x_range, y_range)
    figure.update_xaxes(range=longitude.tolist())
    figure.update_yaxes(range=latitude.tolist())
    width = x_range[1] - x_range[0]
    bar = scale_length(width / 4.0)
    start, height = x_range[0] + 0.04 * width, y_range[0] + 0.04 * (y_range[1] - y_range[0])
    at = geodetic([start, start + bar], [height, height])
    name = f'{bar / 1000:g} km' if bar >= 1000.0 else f'{bar:g} m'
    figure.line(*at, name, INK, 4, hoverinfo='skip', showlegend=False)
    figure.add_annotation(
        x=at[0][0], y=at[1][0], text=name, showarrow=False, yshift=12, xanchor='left'
    )
    return figure


def scale_length(longest: float) -> float:
    """The longest of 1, 2 and 5 times a power of ten that is at most `longest`."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= longest))


def view_of(points: FloatArray) -> tuple[list[float] | None, list[float] | None]:
    """Ranges of x and y with a margin around `points` (n, 2); None, None without points."""
    if not len(points):
        return None, None
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.08 * max(float((high - low).max()), 1.0)
    x, y = ([float(a - margin), float(b + margin)] for a, b in zip(low, high))
    return x, y


WIDTH, HEIGHT, MARGIN = 260, 150, 6
"""Size of a picture and its empty border, pixels."""
THUMBNAIL_POINTS = 400
"""Points of a line that a picture this small can show."""


def thumbnail(figure: go.Figure) -> str:
    """Draw the first axes of a figure: filled areas, lines and points, without labels or images.

    The view is that of the figure where it states one, else all points. Returns an SVG element.
    """
    traces = [trace for trace in figure.data if trace.type in ('scatter', 'scattergl')]
    traces = [trace for trace in traces if (trace.xaxis or 'x') == 'x' and len(trace.x)]
    points = [np.array([trace.x, trace.y], dtype=float).T for trace in traces]
    points = [
        xy if trace.fill else xy[thin(len(xy), THUMBNAIL_POINTS)]
        for trace, xy in zip(traces, points)
    ]
    place = _placement(figure.layout, points)
    shapes = ''.join(_shapes(trace, place(xy)) for trace, xy in zip(traces, points))
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" aria-hidden="true" fill="none" '
        f'stroke-linecap="round">{shapes}</svg>'
    )


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
    shapes, mode = '', trace.mode or 'lines'
    line, marker = trace.line, trace.marker
    if trace.fill:
        shapes = f'<path fill="{trace.fillcolor}" stroke="none" d="{_path(pixels)}"/>'
    elif 'lines' in mode:
        look = f'stroke="{line.color or GREY}" stroke-width="1.5"'
        dash = ' stroke-dasharray="2 3"' if line.dash else ''
        shapes = f'<path {look}{dash} d="{_path(pixels)}"/>'
    if mode == 'markers':
        colour = marker.color if isinstance(marker.color, str) else marker.line.color
        dots = ''.join(f'M{x:.1f} {y:.1f}h0' for x, y in pixels[np.isfinite(pixels).all(axis=1)])
        shapes += f'<path stroke="{colour or GREY}" stroke-width="2.5" d="{dots}"/>'
    return shapes


def _path(pixels: FloatArray) -> str:
    """Return the commands of a path that is broken at NaN."""
    parts, pen_up = [], True
    seen: Any = np.isfinite(pixels).all(axis=1)
    for (x, y), drawn in zip(pixels, seen):
        if drawn:
            parts.append(f'{"M" if pen_up else "L"}{x:.1f} {y:.1f}')
        pen_up = not drawn
    return ''.join(parts)
