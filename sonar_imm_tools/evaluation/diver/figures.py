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

"""The figures of divers. Each function takes arrays and gives one plotly figure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from sonar_imm.estimation.arrays import FloatArray

from ..plotting import (
    add_band,
    COLOURS,
    GREY,
    INK,
    MOST_POINTS,
    seconds,
    styled,
    thin,
    transparent,
)
from .matching import Matching
from .series import IntArray, Series
from .truth import Truth

MOST_ELLIPSES = 60
MOST_TRACKS_NAMED = 12


def map_figure(series: Series, truth: Truth | None, fixes: Series | None) -> go.Figure:
    """Truth, fixes and tracks from above with equal axes; 95 % ellipses along each track."""
    figure = go.Figure()
    if fixes is not None and len(fixes):
        shown = thin(len(fixes), MOST_POINTS)
        figure.add_scattergl(
            x=fixes.state[shown, 0],
            y=fixes.state[shown, 1],
            mode='markers',
            name='raw fixes',
            hoverinfo='skip',
            marker={'symbol': 'x-thin', 'size': 5, 'line': {'color': GREY, 'width': 1}},
        )
    for path in truth.paths if truth else ():
        shown = thin(len(path.stamp_ns), MOST_POINTS)
        figure.add_scatter(
            x=path.state[shown, 0],
            y=path.state[shown, 1],
            mode='lines',
            name='truth',
            legendgroup='truth',
            showlegend=path is truth.paths[0],
            hovertemplate=f'target {path.track_id}: x %{{x:.2f}}, y %{{y:.2f}}',
            line={'color': INK, 'width': 1.5, 'dash': 'dot'},
        )
    for order, track_id in enumerate(_tracks_by_length(series)):
        _add_track(figure, series.pick(series.track_id == track_id), order)
    # Clutter can lie anywhere: the first view shows tracks and truth, the rest by zooming out.
    paths = truth.paths if truth else ()
    x_range, y_range = view_of(
        np.concatenate([series.state[:, :2], *(path.state[:, :2] for path in paths)])
    )
    figure.update_xaxes(title='x [m]', range=x_range)
    figure.update_yaxes(title='y [m]', range=y_range, scaleanchor='x', scaleratio=1)
    return styled(figure, height=640)


def view_of(points: FloatArray) -> tuple[list[float] | None, list[float] | None]:
    """Ranges of x and y with a margin around `points` (n, 2); None, None without points."""
    if not len(points):
        return None, None
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.08 * max(float((high - low).max()), 1.0)
    return tuple([float(a - room), float(b + room)] for a, b in zip(low, high))


def _add_track(figure: go.Figure, track: Series, order: int) -> None:
    colour = COLOURS[order % len(COLOURS)]
    name = f'track {track.track_id[0]}'
    shown = thin(len(track), MOST_POINTS)
    outline = outlines(track.state[:, :2], track.covariance[:, :2, :2])
    figure.add_scatter(
        x=outline[:, 0],
        y=outline[:, 1],
        mode='lines',
        fill='toself',
        fillcolor=transparent(colour, 0.10),
        hoverinfo='skip',
        line={'color': transparent(colour, 0.35), 'width': 1},
        legendgroup=name,
        showlegend=False,
    )
    figure.add_scatter(
        x=track.state[shown, 0],
        y=track.state[shown, 1],
        mode='lines+markers',
        name=name,
        legendgroup=name,
        showlegend=order < MOST_TRACKS_NAMED,
        line={'color': colour, 'width': 2},
        marker={'size': 4},
        customdata=seconds(track.stamp_ns[shown], track.scan_ns),
        hovertemplate='%{customdata:.1f} s: x %{x:.2f}, y %{y:.2f}',
    )


def error_figure(matching: Matching, track_id: int) -> go.Figure:
    """Error in x and y of one track, over the 95 % band that the tracker predicted."""
    rows = matching.series.track_id[matching.row] == track_id
    row = matching.row[rows]
    order = np.argsort(matching.series.stamp_ns[row], kind='stable')
    row, error = row[order], matching.error[rows][order]
    time = seconds(matching.series.stamp_ns[row], matching.series.scan_ns)
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    for axis, name in enumerate('xy'):
        sigma = np.sqrt(matching.series.covariance[row, axis, axis])
        add_band(figure, time, 1.96 * sigma, first=axis == 0, row=axis + 1)
        figure.add_scattergl(
            x=time,
            y=error[:, axis],
            mode='lines+markers',
            name='error of the track',
            legendgroup='error',
            showlegend=axis == 0,
            row=axis + 1,
            col=1,
            line={'color': COLOURS[0], 'width': 1.2},
            marker={'size': 3},
        )
        figure.update_yaxes(title=f'{name} error [m]', row=axis + 1, col=1)
    figure.update_xaxes(zeroline=False)
    figure.update_xaxes(title='time [s]', row=2, col=1)
    return styled(figure, height=460)


def sigma_figure(series: Series, track_id: int) -> go.Figure:
    """Stated standard deviations over time, for runs without truth."""
    track = series.pick(series.track_id == track_id)
    figure = go.Figure()
    for axis, name in enumerate('xy'):
        figure.add_scattergl(
            x=seconds(track.stamp_ns, track.scan_ns),
            mode='lines',
            name=name,
            y=np.sqrt(track.covariance[:, axis, axis]),
            line={'color': COLOURS[axis], 'width': 1.5},
        )
    figure.update_xaxes(title='time [s]', zeroline=False)
    figure.update_yaxes(title='stated sigma [m]', rangemode='tozero')
    return styled(figure, height=320)


def models_figure(
    series: Series, track_id: int, truth_course: tuple[FloatArray, FloatArray] | None
) -> go.Figure:
    """Model probabilities of one track as a heat strip, headings in order, other models below.

    truth_course: (seconds, degrees) of the true course, drawn over the heading rows; None without.
    """
    track = series.pick(series.track_id == track_id)
    track = track.pick(thin(len(track), 4000))
    order = np.array(model_order(track.model_names), int)
    headings = sum(name.startswith('heading_') for name in track.model_names)
    others = len(order) - headings
    figure = go.Figure()
    figure.add_heatmap(
        x=seconds(track.stamp_ns, track.scan_ns),
        y=np.arange(len(order)),
        z=track.probabilities[:, order].T,
        zmin=0.0,
        zmax=1.0,
        colorscale='Blues',
        colorbar={'title': {'text': 'probability', 'side': 'right'}, 'thickness': 12},
        customdata=np.tile(np.array(track.model_names)[order][:, None], (1, len(track))),
        hovertemplate='%{x:.1f} s, %{customdata}: %{z:.3f}<extra></extra>',
    )
    if truth_course is not None and headings:
        time, degrees = truth_course
        figure.add_scattergl(
            x=time,
            y=others + np.mod(degrees, 360.0) * headings / 360.0,
            mode='markers',
            name='true course',
            showlegend=True,
            marker={'color': COLOURS[1], 'size': 4},
        )
    figure.update_yaxes(
        tickvals=np.arange(len(order)),
        showgrid=False,
        zeroline=False,
        ticktext=[model_label(track.model_names[index]) for index in order],
        range=[-0.5, len(order) - 0.5],
    )
    figure.update_xaxes(title='time [s]', showgrid=False, zeroline=False)
    return styled(figure, height=180 + 18 * len(order))


def outlines(
    mean: FloatArray, covariance: FloatArray, *, probability: float = 0.95, points: int = 40
) -> NDArray[np.float64]:
    """(m, 2) outlines of Gaussian ellipses that hold `probability`, NaN rows between them."""
    shown = thin(len(mean), MOST_ELLIPSES)
    values, vectors = np.linalg.eigh(covariance[shown])
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    radii = np.sqrt(-2.0 * np.log1p(-probability) * np.maximum(values, 0.0))
    shape = vectors @ (radii[:, :, None] * circle)
    closed = mean[shown, None] + shape.transpose(0, 2, 1)
    return np.concatenate([closed, np.full((len(closed), 1, 2), np.nan)], axis=1).reshape(-1, 2)


def model_order(names: tuple[str, ...]) -> list[int]:
    """Indices of `names`: other models first, that is at the bottom, then headings by angle."""
    return sorted(
        range(len(names)), key=lambda index: (names[index].startswith('heading_'), names[index])
    )


def model_label(name: str) -> str:
    """Label of a model: ``heading_022`` gives ``22°``."""
    return f'{int(name[8:])}°' if name.startswith('heading_') and name[8:].isdigit() else name


def _tracks_by_length(series: Series) -> IntArray:
    ids, counts = np.unique(series.track_id, return_counts=True)
    return ids[np.argsort(-counts, kind='stable')]
