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

"""Figures of a run of reflectors: response and tracks, number of reflectors, amplitudes, OSPA."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from sonar_imm.estimation.arrays import FloatArray

from ... import SECOND
from ..plotting import COLOURS, INK, styled
from .fixed_order import FixedOrder
from .records import Image, Record

MOST_DEPTHS, MOST_RECORDS = 500, 1500


def response_figure(image: Image | None, records: Sequence[Record], start_ns: int) -> go.Figure:
    """The response as an image, with the truth as dots and the tracks as lines."""
    figure = go.Figure()
    if image is not None:
        image = _thinned(image)
        figure.add_heatmap(
            x=(image.stamp_ns - start_ns) / SECOND,
            y=image.depth,
            z=np.round(image.value, 2),
            zmin=0.0,
            zmax=float(max(6.0, np.nanpercentile(image.value, 99.7))),
            colorscale='Greys',
            showscale=True,
            colorbar={'title': {'text': 'response / noise', 'side': 'right'}, 'thickness': 12},
            hoverinfo='skip',
        )
    true = [record for record in records if record.true is not None]
    if true:
        figure.add_trace(_dots(true, lambda r: r.true.depth, start_ns, 'truth'))
    for index, (track_id, rows) in enumerate(_tracks(records)):
        figure.add_scattergl(
            x=[_seconds(records[k], start_ns) for k, _ in rows],
            y=[records[k].found.depth[row] for k, row in rows],
            mode='lines+markers',
            name=f'reflector {track_id}',
            line={'color': COLOURS[index % 4], 'width': 1.5},
            marker={'size': 4},
            showlegend=False,
        )
    figure.update_xaxes(title='time [s]', showgrid=False)
    figure.update_yaxes(title='depth [m]', autorange='reversed', showgrid=False)
    return styled(figure, height=520)


def order_figure(records: Sequence[Record], start_ns: int) -> go.Figure:
    """The PMF of the number of reflectors over time, and the true number."""
    pmf = np.array([record.pmf for record in records]).T
    figure = go.Figure()
    figure.add_heatmap(
        x=[_seconds(record, start_ns) for record in records],
        y=records[0].order_min + np.arange(len(pmf)),
        z=np.round(pmf, 4),
        zmin=0.0,
        zmax=1.0,
        colorscale='Blues',
        colorbar={'title': {'text': 'probability', 'side': 'right'}, 'thickness': 12},
        hovertemplate='%{x:.0f} s, %{y} reflectors: %{z:.3f}<extra></extra>',
    )
    true = [record for record in records if record.true is not None]
    if true:
        figure.add_scattergl(
            x=[_seconds(record, start_ns) for record in true],
            y=[len(record.true) for record in true],
            mode='lines',
            name='truth',
            line={'color': COLOURS[1], 'width': 2, 'shape': 'hv'},
            showlegend=True,
        )
    figure.update_xaxes(title='time [s]', showgrid=False)
    figure.update_yaxes(title='number of reflectors', dtick=1, showgrid=False, zeroline=False)
    return styled(figure, height=360)


def amplitude_figure(
    records: Sequence[Record], start_ns: int, factor: float | None = None
) -> go.Figure:
    """Amplitude of every track over time, and the true amplitudes times `factor`."""
    figure = go.Figure()
    if factor:
        true = [record for record in records if record.true is not None]
        name = 'truth, at the same scale'
        figure.add_trace(_dots(true, lambda r: factor * r.true.strength, start_ns, name))
    for index, (track_id, rows) in enumerate(_tracks(records)):
        figure.add_scattergl(
            x=[_seconds(records[k], start_ns) for k, _ in rows],
            y=[records[k].found.strength[row] for k, row in rows],
            mode='lines',
            name=f'reflector {track_id}',
            line={'color': COLOURS[index % 4], 'width': 1.5},
            showlegend=False,
        )
    figure.update_xaxes(title='time [s]', zeroline=False)
    figure.update_yaxes(title='amplitude, freed of spreading', rangemode='tozero')
    return styled(figure, height=360)


def distance_figure(records: Sequence[Record], ospa: FloatArray, start_ns: int) -> go.Figure:
    """OSPA of every record with truth."""
    figure = go.Figure()
    figure.add_scattergl(
        x=[_seconds(record, start_ns) for record in records],
        y=ospa,
        mode='lines',
        line={'color': INK, 'width': 1.2},
    )
    figure.update_xaxes(title='time [s]', zeroline=False)
    figure.update_yaxes(title='OSPA [m]', rangemode='tozero')
    return styled(figure, height=280)


def fixed_order_figure(
    fixed: Sequence[FixedOrder], records: Sequence[Record], start_ns: int
) -> go.Figure:
    """What filters of a fixed number of reflectors find, and the truth, side by side."""
    titles = [f'{one.order} reflectors' for one in fixed]
    figure = make_subplots(
        cols=len(fixed), shared_yaxes=True, subplot_titles=titles, horizontal_spacing=0.02
    )
    true = [record for record in records if record.true is not None]
    for column, one in enumerate(fixed, start=1):
        if true:
            dots = _dots(true, lambda r: r.true.depth, start_ns, 'truth')
            figure.add_trace(dots, row=1, col=column)
        dots = _dots(one.records, lambda r: r.found.depth, start_ns, 'found', COLOURS[0])
        figure.add_trace(dots, row=1, col=column)
    figure.update_traces(showlegend=False)
    figure.update_xaxes(title='time [s]', showgrid=False)
    figure.update_yaxes(autorange='reversed', showgrid=False)
    figure.update_yaxes(title='depth [m]', col=1)
    return styled(figure, height=380)


def _dots(
    records: Sequence[Record],
    values: Callable[[Record], FloatArray],
    start_ns: int,
    name: str,
    colour: str = COLOURS[4],
) -> go.Scattergl:
    """All `values` of each record at its time."""
    each = [(values(record), _seconds(record, start_ns)) for record in records]
    return go.Scattergl(
        x=np.concatenate([np.full(len(value), seconds) for value, seconds in each]),
        y=np.concatenate([value for value, _ in each]),
        mode='markers',
        name=name,
        marker={'size': 3, 'color': colour},
    )


def _tracks(records: Sequence[Record]) -> list[tuple[int, list[tuple[int, int]]]]:
    """(record, row) of every reflector, by id."""
    places: dict[int, list[tuple[int, int]]] = {}
    for k, record in enumerate(records):
        for row, track_id in enumerate(record.found.track_id):
            places.setdefault(int(track_id), []).append((k, row))
    return sorted(places.items())


def _seconds(record: Record, start_ns: int) -> float:
    return (record.stamp_ns - start_ns) / SECOND


def _thinned(image: Image) -> Image:
    """The largest value of each few depths and records: thin reflectors must not vanish."""
    value, depth, stamp = image.value, image.depth, image.stamp_ns
    deep = max(1, -(-len(depth) // MOST_DEPTHS))
    long = max(1, -(-len(stamp) // MOST_RECORDS))
    rows, columns = len(depth) // deep * deep, len(stamp) // long * long
    blocks = value[:rows, :columns].reshape(rows // deep, deep, columns // long, long)
    return Image(
        blocks.max(axis=(1, 3)),
        depth[:rows].reshape(-1, deep).mean(axis=1),
        stamp[:columns:long],
    )
