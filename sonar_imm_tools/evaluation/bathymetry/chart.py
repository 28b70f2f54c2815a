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

"""A small chart of a run: its soundings in a grid, and where the ship went."""

from __future__ import annotations

from collections.abc import Mapping
import math
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Navigation

from ...offline.run_folder import read_measurements, SOUNDINGS
from ...recordings.export.grid import EMPTY_LABEL, Grid, grid_of
from ...recordings.export.points import Points, read_points
from ..plotting import INK, styled, thin

MOST_CELLS = 160
"""Cells along the longer side of the chart."""
CELLS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0)
MOST_POSES = 1000


def points_of(folder: Path) -> Points | None:
    """The soundings of a run; None without any."""
    if not (folder / SOUNDINGS).is_file():
        return None
    points = read_points(folder / SOUNDINGS)
    return points if len(points) else None


def track_of(run: Mapping[str, Any]) -> FloatArray:
    """Where the ship went (n, 2), east and north; empty when the recording is gone."""
    places = [one.position[:2] for one in read_measurements(run) if isinstance(one, Navigation)]
    track = np.array(places).reshape(-1, 2)
    return track[thin(len(track), MOST_POSES)]


def chart_of(points: Points) -> Grid:
    """The grid of the chart, with cells as small as fit."""
    extent = max(np.ptp(points['x']), np.ptp(points['y']))
    cell = next((c for c in CELLS if extent / c <= MOST_CELLS), math.ceil(extent / MOST_CELLS))
    return grid_of(points, float(cell))


def chart_figure(grid: Grid, track: FloatArray) -> go.Figure:
    """Height of the floor in the grid, north up, and the track of the ship."""
    rows, columns = grid.height.shape
    figure = go.Figure()
    figure.add_heatmap(
        x=grid.west + grid.cell * (np.arange(columns) + 0.5),
        y=grid.north - grid.cell * (np.arange(rows) + 0.5),
        z=grid.height.astype(np.float32),
        customdata=np.dstack(
            [
                grid.uncertainty.astype(np.float32),
                np.where(grid.label == EMPTY_LABEL, np.nan, grid.label).astype(np.float32),
                grid.count,
            ]
        ),
        colorscale='Viridis',
        colorbar={'title': 'z [m]'},
        hovertemplate=(
            'east %{x:.1f} m, north %{y:.1f} m<br>z %{z:.2f} m, sd %{customdata[0]:.2f} m<br>'
            'model %{customdata[1]}, %{customdata[2]} soundings<extra></extra>'
        ),
    )
    if len(track):
        figure.add_scatter(
            x=track[:, 0],
            y=track[:, 1],
            mode='lines',
            name='track of the ship',
            line={'color': INK, 'width': 1.5},
        )
    figure.update_xaxes(title='east [m]', zeroline=False, constrain='domain')
    figure.update_yaxes(title='north [m]', zeroline=False, scaleanchor='x')
    return styled(figure, height=520)
