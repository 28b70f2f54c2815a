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

"""The figures of sea floors. Each function takes arrays and gives one plotly figure."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import plotly.graph_objects as go

from sonar_imm.acoustics import array, spatial
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Snapshot

from ... import SECOND
from ..plotting import AMBER, COLOURS, INK, styled, thin, transparent
from .profiles import Profile, Swath
from .scoring import BAND, runs

MOST_BINS = 1200
DIRECTIONS = 161
FLOOR_DB = -20


def profile_figure(profile: Profile) -> go.Figure:
    """Height of the floor along one ping with its two-sigma band, the truth and the true patch."""
    figure = go.Figure()
    shown = thin(len(profile.range), MOST_BINS)
    ranges, height, std = profile.range[shown], profile.height[shown], profile.height_std[shown]
    known = np.isfinite(std)
    figure.add_scatter(
        x=np.concatenate([ranges[known], ranges[known][::-1]]),
        y=np.concatenate([(height + BAND * std)[known], (height - BAND * std)[known][::-1]]),
        fill='toself',
        fillcolor=transparent(AMBER, 0.3),
        mode='lines',
        line={'color': transparent(AMBER, 0.6), 'width': 0.5},
        name='two standard deviations',
        hoverinfo='skip',
    )
    if profile.truth is not None:
        _mark_patches(figure, profile)
        figure.add_scatter(
            x=ranges,
            y=np.where(profile.truth.echo, profile.truth.height, np.nan)[shown],
            mode='lines',
            name='truth',
            line={'color': INK, 'width': 1.0, 'dash': 'dot'},
        )
    figure.add_scatter(
        x=ranges,
        y=height,
        mode='lines',
        name='estimate',
        line={'color': COLOURS[0], 'width': 1.4},
    )
    _mark_silence(figure, profile)
    figure.update_xaxes(title='slant range [m]', zeroline=False)
    figure.update_yaxes(title='height above the reference [m]')
    return styled(figure, height=400)


def spectrum_figure(
    profile: Profile, snapshot: Snapshot, spacing: float, method: str = 'capon'
) -> go.Figure:
    """Angular pseudo-spectrum of one ping, with the estimated and the true angle.

    spacing: distance between staves in wavelengths, negative for a conjugated array.
    """
    largest = array.largest_sine(abs(spacing))
    sines = np.linspace(-largest, largest, DIRECTIONS)
    bins = thin(len(snapshot), MOST_BINS)
    power = spatial.ping_spectrum(
        snapshot.iq[bins], sines, abs(spacing), method=method, conjugate=spacing < 0.0
    )
    decibels = 10.0 * np.log10(power / power.max(axis=1, keepdims=True))
    angles = np.degrees(np.arcsin(sines))
    figure = go.Figure()
    figure.add_heatmap(
        x=np.round(profile.range[bins], 3),
        y=np.round(angles, 2),
        z=np.maximum(np.round(decibels), FLOOR_DB).T.astype(np.int8),
        zmin=FLOOR_DB,
        zmax=0,
        colorscale='Greys_r',
        colorbar={'title': {'text': 'dB below the peak', 'side': 'right'}, 'thickness': 12},
        hovertemplate='%{x:.2f} m, %{y:.1f}°: %{z} dB<extra></extra>',
    )
    if profile.truth is not None:
        true = np.degrees(np.where(profile.truth.echo, profile.truth.angle, np.nan))
        figure.add_scatter(
            x=profile.range[bins],
            y=true[bins],
            mode='lines',
            name='truth',
            line={'color': AMBER, 'width': 1.2},
        )
    figure.add_scatter(
        x=profile.range[bins],
        y=np.degrees(profile.angle[bins]),
        mode='lines',
        name='estimate',
        line={'color': COLOURS[1], 'width': 1.6},
    )
    figure.update_xaxes(title='slant range [m]', showgrid=False, zeroline=False)
    figure.update_yaxes(
        title='angle from broadside [°]',
        showgrid=False,
        zeroline=False,
        range=_view(np.degrees(profile.angle), angles),
    )
    return styled(figure, height=420)


def models_figure(profile: Profile, names: Iterable[str]) -> go.Figure:
    """Probability of each terrain model along one ping, as a heat strip."""
    names = tuple(names)
    bins = thin(len(profile.range), MOST_BINS)
    figure = go.Figure()
    figure.add_heatmap(
        x=np.round(profile.range[bins], 3),
        y=list(names),
        z=np.round(profile.probabilities[bins].T, 3),
        zmin=0.0,
        zmax=1.0,
        colorscale='Blues',
        colorbar={'title': {'text': 'probability', 'side': 'right'}, 'thickness': 12},
        hovertemplate='%{x:.2f} m, %{y}: %{z:.3f}<extra></extra>',
    )
    if profile.truth is not None:
        for begin, end in runs(profile.truth.patch):
            for bin_number in (begin, end - 1):
                figure.add_vline(x=profile.range[bin_number], line={'color': COLOURS[1]})
    figure.update_xaxes(title='slant range [m]', showgrid=False, zeroline=False)
    figure.update_yaxes(showgrid=False, zeroline=False)
    return styled(figure, height=180 + 24 * len(names))


def segmentation_figure(swath: Swath) -> go.Figure:
    """Probability of rough floor over pings and range, with the ends of the true patches."""
    one_side = [one for one in swath.profiles if one.side == swath.profiles[0].side]
    profiles = one_side[thin(len(one_side), 400)]
    longest = max(profiles, key=lambda profile: len(profile.range))
    bins = thin(len(longest.range), 600)
    ranges = longest.range[bins]
    seconds = [(one.stamp_ns - swath.profiles[0].stamp_ns) / SECOND for one in profiles]
    rough = np.stack(
        [
            np.interp(ranges, one.range, swath.roughness(one), left=np.nan, right=np.nan)
            for one in profiles
        ]
    )
    figure = go.Figure()
    figure.add_heatmap(
        x=np.round(ranges, 3),
        y=seconds,
        z=np.round(rough, 2),
        zmin=0.0,
        zmax=1.0,
        colorscale='Blues',
        colorbar={'title': {'text': 'probability of rough', 'side': 'right'}, 'thickness': 12},
        hovertemplate='%{x:.2f} m, %{y:.2f} s: %{z:.2f}<extra></extra>',
    )
    ends = [
        (one.range[place], when)
        for one, when in zip(profiles, seconds)
        if one.truth is not None
        for begin, end in runs(one.truth.patch)
        for place in (begin, end - 1)
    ]
    if ends:
        x, y = np.array(ends).T
        figure.add_scattergl(
            x=x,
            y=y,
            mode='markers',
            name='ends of the true patch',
            marker={'color': COLOURS[1], 'size': 6, 'symbol': 'line-ns-open'},
        )
    figure.update_xaxes(title='slant range [m]', showgrid=False, zeroline=False)
    figure.update_yaxes(title='time [s]', showgrid=False, zeroline=False, autorange='reversed')
    return styled(figure, height=340)


def _view(shown: FloatArray, angles: FloatArray) -> list[float]:
    """Range of the angle axis: the estimates with a margin, inside the view of the array."""
    known = shown[np.isfinite(shown)]
    if not len(known):
        return [float(angles[0]), float(angles[-1])]
    low, high = float(known.min()) - 12.0, float(known.max()) + 12.0
    return [max(low, float(angles[0])), min(high, float(angles[-1]))]


def _mark_patches(figure: go.Figure, profile: Profile) -> None:
    for begin, end in runs(profile.truth.patch):
        figure.add_vrect(
            x0=profile.range[begin],
            x1=profile.range[end - 1],
            fillcolor=COLOURS[5],
            opacity=0.12,
            line_width=0,
        )


def _mark_silence(figure: go.Figure, profile: Profile) -> None:
    """Ticks at the bottom where there was no echo."""
    silent = profile.range[~profile.heard]
    if len(silent):
        silent = silent[thin(len(silent), MOST_BINS)]
        figure.add_scattergl(
            x=silent,
            y=np.full(len(silent), float(np.nanmin(profile.height)) - 0.3),
            mode='markers',
            name='no echo',
            marker={'color': COLOURS[3], 'size': 4, 'symbol': 'line-ns-open'},
        )
