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

"""What the figures of all systems share: colours, style, time axes, and the NIS figure.

Colours are those of Okabe and Ito, which people with any colour vision can tell apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
import plotly.graph_objects as go
from scipy.stats import chi2

from sonar_imm.estimation.arrays import FloatArray

from .. import SECOND

INK, GRID, GREY, AMBER = '#1b2733', '#e4e9ee', '#8593a1', '#E69F00'
COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
MOST_POINTS = 20_000
FONT = 'Inter, "Segoe UI", Roboto, Helvetica, Arial, sans-serif'


def nis_figure(time: FloatArray, nis: FloatArray, dof: FloatArray) -> go.Figure:
    """NIS of every hit over `time` [s], its running mean, and the chi-square bounds.

    Where the degrees of freedom vary (more or fewer receivers per ping), NIS is divided by them,
    and there are no common bounds.
    """
    same = len(np.unique(dof)) == 1
    shared = int(dof[0]) if same else 0
    nis = nis if same else nis / dof
    figure = go.Figure()
    shown = thin(len(nis), MOST_POINTS)
    figure.add_scattergl(
        x=time[shown],
        y=nis[shown],
        mode='markers',
        name='NIS of a hit',
        marker={'size': 4, 'color': COLOURS[0], 'opacity': 0.6},
    )
    width = max(5, min(50, len(nis) // 8))
    if len(nis) > width:
        mean = np.convolve(nis, np.full(width, 1.0 / width), mode='valid')
        figure.add_scattergl(
            x=time[width - 1 :],
            y=mean,
            mode='lines',
            name=f'mean of {width}',
            line={'color': INK, 'width': 2},
        )
        if shared:
            low, high = chi2.ppf([0.025, 0.975], width * shared) / width
            figure.add_hrect(y0=low, y1=high, fillcolor=AMBER, opacity=0.25, line_width=0)
    if shared:
        figure.add_hline(
            y=chi2.ppf(0.95, shared),
            line={'color': COLOURS[1], 'dash': 'dash'},
            annotation_text='95 % of the hits should lie below',
        )
    figure.update_xaxes(title='time [s]', zeroline=False)
    figure.update_yaxes(title='NIS' if same else 'NIS / degrees of freedom', rangemode='tozero')
    return styled(figure, height=340)


def add_band(
    figure: go.Figure, time: FloatArray, half: FloatArray, *, first: bool, row: int
) -> None:
    """Add the band from -half to half to subplot `row`; `first`: with an entry in the legend."""
    figure.add_scatter(
        x=np.concatenate([time, time[::-1]]),
        y=np.concatenate([half, -half[::-1]]),
        fill='toself',
        fillcolor=transparent(AMBER, 0.28),
        mode='lines',
        line={'color': transparent(AMBER, 0.6), 'width': 0.5},
        hoverinfo='skip',
        name='predicted 95 % band',
        legendgroup='band',
        showlegend=first,
        row=row,
        col=1,
    )


def seconds(stamp_ns: NDArray[np.int64], scan_ns: NDArray[np.int64]) -> FloatArray:
    """Seconds since the first scan of the run."""
    return (stamp_ns - scan_ns[0]) / SECOND if len(scan_ns) else np.empty(0)


def thin(count: int, most: int) -> slice:
    """A slice that takes at most `most` of `count` rows, evenly spaced."""
    return slice(None, None, max(1, -(-count // most)))


def transparent(colour: str, opacity: float) -> str:
    """The colour ``#rrggbb`` with an opacity from 0 to 1."""
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f'rgba({red},{green},{blue},{opacity})'


def styled(figure: go.Figure, *, height: int) -> go.Figure:
    """Give `figure` the style of the page; `height` in pixels."""
    figure.update_layout(
        height=height,
        margin={'l': 64, 'r': 24, 't': 44, 'b': 52},
        paper_bgcolor='white',
        plot_bgcolor='white',
        font={'family': FONT, 'size': 13, 'color': INK},
        hovermode='closest',
        legend={'orientation': 'h', 'y': 1.02, 'yanchor': 'bottom', 'x': 0},
    )
    axis = {'gridcolor': GRID, 'zerolinecolor': '#c3ccd5', 'linecolor': '#c3ccd5', 'ticks': ''}
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    return figure
