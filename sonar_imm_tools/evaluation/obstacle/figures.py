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

"""The figures of obstacles. Each function takes arrays and gives one plotly figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Detections
from sonar_imm.trackers.obstacle.deferred import Deferred

from ..plotting import AMBER, COLOURS, GREY, INK, MOST_POINTS, styled, thin, transparent
from .deferred import DeferredEstimates
from .series import level, Matching, Series, TruePath


def offset_figure(series: Series, truths: dict[int, TruePath], gap: float) -> go.Figure:
    """Vertical offset of each track with its 90 % band over the range, far to near."""
    figure = go.Figure()
    for order, track_id in enumerate(np.unique(series.track_id).tolist()):
        track = series.pick(series.track_id == track_id)
        colour, name = COLOURS[order % len(COLOURS)], f'track {track_id}'
        near = track.state[:, 0]
        figure.add_scatter(
            x=np.concatenate([near, near[::-1]]),
            y=np.concatenate([track.low, track.high[::-1]]),
            fill='toself',
            fillcolor=transparent(colour, 0.15),
            mode='lines',
            hoverinfo='skip',
            line={'color': transparent(colour, 0.4), 'width': 0.5},
            legendgroup=name,
            showlegend=False,
        )
        figure.add_scatter(
            x=near,
            y=track.state[:, 2],
            mode='lines',
            name=name,
            legendgroup=name,
            line={'color': colour, 'width': 2},
        )
        if track_id in truths:
            seen = truths[track_id].at(track.stamp_ns, gap)
            figure.add_scatter(
                x=seen[:, 0],
                y=seen[:, 2],
                mode='lines',
                legendgroup=name,
                showlegend=False,
                line={'color': INK, 'width': 1.5, 'dash': 'dot'},
            )
    figure.update_xaxes(title='range [m]', autorange='reversed', zeroline=False)
    figure.update_yaxes(title='below the sonar [m]', autorange='reversed')
    return styled(figure, height=440)


def image_figure(
    series: Series, pings: Sequence[Detections], truths: Sequence[TruePath]
) -> go.Figure:
    """Tracks and echoes in the image of the sonar, ahead is up."""
    figure = go.Figure()
    if pings:
        echoes = np.concatenate([np.column_stack([ping.range, ping.bearing]) for ping in pings])
        shown = level(echoes[thin(len(echoes), MOST_POINTS)])
        figure.add_scattergl(
            x=-shown[:, 1],
            y=shown[:, 0],
            mode='markers',
            name='detections',
            hoverinfo='skip',
            marker={'size': 3, 'color': GREY},
        )
    for path in truths:
        flat = level(path.seen[path.in_beam])
        figure.add_scatter(
            x=-flat[:, 1],
            y=flat[:, 0],
            mode='lines',
            name='truth',
            legendgroup='truth',
            showlegend=path is truths[0],
            line={'color': INK, 'width': 1.5, 'dash': 'dot'},
        )
    for order, track_id in enumerate(np.unique(series.track_id).tolist()):
        flat = level(series.state[series.track_id == track_id])
        figure.add_scatter(
            x=-flat[:, 1],
            y=flat[:, 0],
            mode='lines',
            name=f'track {track_id}',
            line={'color': COLOURS[order % len(COLOURS)], 'width': 2},
        )
    figure.update_xaxes(title='to starboard [m]')
    figure.update_yaxes(title='ahead [m]', scaleanchor='x', scaleratio=1, rangemode='tozero')
    return styled(figure, height=620)


def rmsd_figure(deferred: DeferredEstimates) -> go.Figure:
    """RMSD against the assumed offset, as in the paper's Figure 5."""
    figure = go.Figure()
    for curve, name, colour in (
        (deferred.both, 'RMSD, both sides', COLOURS[1]),
        (deferred.plain, 'RMSD, as the paper', COLOURS[0]),
        (deferred.refit, 'first echo and scale refitted', COLOURS[2]),
    ):
        _add_curve(figure, curve, name, colour, deferred.altitude)
    figure.add_vrect(
        x0=deferred.band[0],
        x1=deferred.band[1],
        fillcolor=AMBER,
        opacity=0.25,
        line_width=0,
        annotation_text='90 % band, online',
    )
    for value, name, dash, side in (
        (deferred.online, 'online', 'dash', 'right'),
        (deferred.truth, 'truth', 'dot', 'left'),
        (deferred.altitude, 'sea floor', 'dashdot', 'right'),
    ):
        if np.isfinite(value):
            figure.add_vline(
                x=value,
                line={'color': INK, 'width': 1.5, 'dash': dash},
                annotation_text=name,
                annotation_position=f'bottom {side}',
            )
    figure.update_xaxes(title='vertical offset at the first echo, below the sonar [m]')
    figure.update_yaxes(title='RMSD [pixels of range and bearing]', type='log')
    return styled(figure, height=440)


def _add_curve(
    figure: go.Figure, curve: Deferred, name: str, colour: str, altitude: float
) -> None:
    figure.add_scatter(
        x=curve.offset,
        y=curve.rmsd,
        mode='lines',
        name=name,
        line={'color': colour, 'width': 2},
        customdata=altitude - curve.offset,
        hovertemplate='%{x:.2f} m below, %{customdata:.2f} m above the floor: %{y:.2f}',
    )
    if np.isfinite(curve.best):
        figure.add_scatter(
            x=[curve.best],
            y=[curve.least],
            mode='markers',
            showlegend=False,
            marker={'color': colour, 'size': 10, 'symbol': 'diamond'},
            hovertemplate='least: %{x:.2f} m',
        )


def above_figure(series: Series) -> go.Figure:
    """Probability that the obstacle is above the sonar, over the range."""
    figure = go.Figure()
    for order, track_id in enumerate(np.unique(series.track_id).tolist()):
        rows = series.track_id == track_id
        figure.add_scatter(
            x=series.state[rows, 0],
            y=series.above[rows],
            mode='lines',
            name=f'track {track_id}',
            line={'color': COLOURS[order % len(COLOURS)], 'width': 2},
        )
    figure.update_xaxes(title='range [m]', autorange='reversed', zeroline=False)
    figure.update_yaxes(title='P(above)', range=[-0.02, 1.02])
    return styled(figure, height=280)


def error_figure(found: Matching) -> go.Figure:
    """Error of the offset over its stated standard deviation, against the range."""
    error = found.error[:, 2]
    sigma: FloatArray = np.sqrt(found.series.covariance[found.row, 2, 2])
    figure = go.Figure()
    figure.add_hrect(
        y0=-1.645,
        y1=1.645,
        fillcolor=AMBER,
        opacity=0.2,
        line_width=0,
        annotation_text='9 in 10 should lie here',
    )
    figure.add_scattergl(
        x=found.truth[:, 0],
        y=error / sigma,
        mode='markers',
        name='error / stated sigma',
        marker={'size': 4, 'color': COLOURS[0], 'opacity': 0.6},
    )
    figure.update_xaxes(title='range [m]', autorange='reversed', zeroline=False)
    figure.update_yaxes(title='offset error / sigma')
    return styled(figure, height=320)


def calibration_figure(bins: Mapping[str, Mapping[str, float]]) -> go.Figure:
    """How often what was stated with a probability came true, by bins of it; the area of a point
    is the number of forecasts."""
    stated = [one['stated'] for one in bins.values()]
    came, n = [one['came_true'] for one in bins.values()], [one['n'] for one in bins.values()]
    figure = go.Figure()
    figure.add_scatter(
        x=[0, 1],
        y=[0, 1],
        mode='lines',
        name='as stated',
        line={'color': INK, 'width': 1.5, 'dash': 'dot'},
    )
    figure.add_scatter(
        x=stated,
        y=came,
        mode='lines+markers',
        name='happened',
        text=[f'{count} forecasts' for count in n],
        line={'color': COLOURS[0]},
        marker={'size': [6.0 + 18.0 * (count / max(n)) ** 0.5 for count in n]},
    )
    figure.update_xaxes(title='stated probability', range=[-0.03, 1.03])
    figure.update_yaxes(title='share that happened', range=[-0.03, 1.03])
    return styled(figure, height=360)
