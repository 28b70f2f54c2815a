# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the report shows of sea floors: sections with a figure each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
import math
from pathlib import Path
from typing import Any

import numpy as np

from sonar_imm.acoustics import array, spatial
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Navigation, Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.trackers.bathymetry.likelihood import spacing_of

from ... import SECOND
from ...offline.run_folder import read_measurements, RunFolder
from ...recordings.export.points import Points, read_points
from ...survey.chart import Chart, chart_of
from ...survey.line import budget_of, without_far
from ..plotting import AMBER, BARE, COLOURS, INK, Picture, thin
from ..report import Section
from .scoring import BAND, Profile, runs, Swath

MOST_BINS = 1200
DIRECTIONS = 161
FLOOR_DB = -20
MOST_CELLS = 160
"""Cells along the longer side of the chart."""
CELLS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0)
MOST_POSES = 1000
SLANT = {'title': 'slant range [m]'}


def sections(run: Mapping[str, Any], folder: Path, swath: Swath) -> Iterator[Section]:
    """The sections of one run in `folder`. run: content of ``run.json``."""
    if swath.profiles:
        yield from _of_pings(run, swath)
    if (points := points_of(folder)) is not None:
        grid = finest_chart(points, run)
        yield Section(
            'Chart',
            f'{len(points)} soundings in cells of {grid.cell:g} m, as `sonar-imm export` writes '
            'them; north is up. Dark line: the ship.',
            chart_figure(grid, track_of(run)),
        )


def _of_pings(run: Mapping[str, Any], swath: Swath) -> Iterator[Section]:
    number = len(swath.profiles) // 2
    profile = swath.profiles[number]
    which = f' Ping {number + 1} of {len(swath.profiles)}.'
    true = '' if profile.truth is None else ' Dotted: truth. Blue: the true rough patch.'
    two = ' Where bins have two surfaces, the estimate is the lower; the upper has its own line.'
    if profile.two is None or not profile.two.any():
        two = ''
    elif profile.upper is None:
        two = ' Bins with two surfaces are marked: the estimate there is neither.'
    yield Section(
        'Profile of the floor',
        'Height along one ping. Shaded: two standard deviations, which should hold 95 % of the '
        f'truth.{true}{two}{which}',
        profile_figure(profile),
        picture=True,
    )
    snapshot = None  # when the recording is gone
    for ping in read_measurements(run):
        if isinstance(ping, Snapshot) and ping.stamp_ns == profile.stamp_ns:
            if len(ping) == len(profile.range) and profile.side in ('', ping.side):
                snapshot = ping
                break
    if snapshot is not None:
        spacing = spacing_of(snapshot, BathymetryConfig.from_mapping(run['parameters']))
        yield Section(
            'Pseudo-spectrum and estimated angle',
            'Light: directions with much sound (Capon spectrum of the samples, 11 bins at a time, '
            f'no terrain model). Line: the estimated angle.{which}',
            spectrum_figure(profile, snapshot, spacing),
        )
    yield Section(
        'Which terrain model held',
        f'Dark: the model is probable. Lines: ends of the true patch.{which}',
        models_figure(profile, swath.model_names),
    )
    if swath.rough.any():
        yield Section(
            'Rough floor over the whole run',
            'One row per ping. Dark: probably rough.',
            segmentation_figure(swath),
        )
    if profile.verdict is not None:
        yield Section(
            'Smooth, rough, or cannot tell',
            'Probability of rough floor along one ping. Blue: the true rough patch. Marked: bins '
            'that are called neither smooth nor rough, since nobody could tell there, or the '
            f'probability lies between .1 and .9.{which}',
            verdict_figure(profile, swath.roughness(profile)),
        )


def profile_figure(profile: Profile) -> Picture:
    """Height of the floor along one ping with its two-sigma band, the truth and the true patch."""
    figure = Picture()
    shown = thin(len(profile.range), MOST_BINS)
    ranges, height, std = profile.range[shown], profile.height[shown], profile.height_std[shown]
    known = np.isfinite(std)
    high, low = (height + BAND * std)[known], (height - BAND * std)[known]
    name = 'two standard deviations'
    figure.band(ranges[known], high, low, AMBER, (0.3, 0.6), name=name)
    _shade_patches(figure, profile)
    if profile.truth is not None:
        true = np.where(profile.truth.echo, profile.truth.height, np.nan)[shown]
        dotted = {'color': INK, 'width': 1.0, 'dash': 'dot'}
        figure.line(ranges, true, 'truth', INK, line=dotted)
        if profile.truth.height_2 is not None:
            second = np.isfinite(profile.truth.height_2)
            place, height_2 = profile.range[second], profile.truth.height_2[second]
            figure.points(place, height_2, 'truth, second surface', INK, size=2)
    figure.line(ranges, height, 'estimate', COLOURS[0], 1.4)
    marks = [('no echo', ~profile.echoes, 3)]
    if profile.upper is not None:
        _add_upper(figure, profile)
    elif profile.two is not None:
        marks.append(('two surfaces: no sounding', profile.two, 4))
    if profile.unsure is not None:
        marks.append(('one surface or two: no sounding', profile.unsure, 4))
    for name, marked, colour in marks:
        place = profile.range[marked]
        place = place[thin(len(place), MOST_BINS)]
        bottom = np.full(len(place), float(np.nanmin(profile.height)) - 0.3)
        if len(place):
            figure.points(place, bottom, name, COLOURS[colour], symbol='line-ns-open')
    y = {'title': 'height above the reference [m]'}
    return figure.styled(400, SLANT | {'zeroline': False}, y)


def _patches(profile: Profile) -> list[tuple[float, float]]:
    """The ranges at which each true patch begins and ends."""
    found = [] if profile.truth is None else runs(profile.truth.patch)
    return [(profile.range[begin], profile.range[end - 1]) for begin, end in found]


def _shade_patches(figure: Picture, profile: Profile) -> None:
    for begin, end in _patches(profile):
        figure.add_vrect(x0=begin, x1=end, fillcolor=COLOURS[5], opacity=0.12, line_width=0)


def _add_upper(figure: Picture, profile: Profile) -> None:
    assert profile.upper is not None and profile.two is not None
    for number, (begin, end) in enumerate(runs(profile.two)):
        where = profile.range[begin:end]
        height, std = (part[begin:end] for part in profile.upper)
        high, low, colour = height + BAND * std, height - BAND * std, COLOURS[2]
        figure.band(where, high, low, colour, (0.15, 0.3), showlegend=False)
        shown: dict[str, Any] = {'legendgroup': 'upper', 'showlegend': number == 0}
        figure.line(where, height, 'upper surface', colour, 1.4, **shown)


def spectrum_figure(profile: Profile, snapshot: Snapshot, spacing: float) -> Picture:
    """Angular pseudo-spectrum of one ping, with the estimated and the true angle.

    spacing: distance between staves in wavelengths, negative for a conjugated array.
    """
    largest = array.largest_sine(abs(spacing))
    sines = np.linspace(-largest, largest, DIRECTIONS)
    bins = thin(len(snapshot), MOST_BINS)
    power = spatial.ping_spectrum(
        snapshot.iq[bins], sines, abs(spacing), method='capon', conjugate=spacing < 0.0
    )
    decibels = 10.0 * np.log10(power / power.max(axis=1, keepdims=True))
    angles = np.degrees(np.arcsin(sines))
    figure = Picture()
    figure.image(
        np.round(profile.range[bins], 3),
        np.round(angles, 2),
        np.maximum(np.round(decibels), FLOOR_DB).T.astype(np.int8),
        'dB below the peak',
        limits=(FLOOR_DB, 0),
        colours='Greys_r',
        hovertemplate='%{x:.2f} m, %{y:.1f}°: %{z} dB<extra></extra>',
    )
    if profile.truth is not None:
        true = np.degrees(np.where(profile.truth.echo, profile.truth.angle, np.nan))
        figure.line(profile.range[bins], true[bins], 'truth', AMBER, 1.2)
    estimated = np.degrees(profile.angle)
    figure.line(profile.range[bins], estimated[bins], 'estimate', COLOURS[1], 1.6)
    # The estimates with a margin, inside the view of the array.
    view, known = [float(angles[0]), float(angles[-1])], estimated[np.isfinite(estimated)]
    if len(known):
        view = [max(float(known.min()) - 12.0, view[0]), min(float(known.max()) + 12.0, view[1])]
    y = {'title': 'angle from broadside [°]', 'range': view}
    return figure.styled(420, SLANT | BARE, y | BARE)


def models_figure(profile: Profile, names: Sequence[str]) -> Picture:
    """Probability of each terrain model along one ping, as a heat strip."""
    bins = thin(len(profile.range), MOST_BINS)
    figure = Picture()
    figure.image(
        np.round(profile.range[bins], 3),
        list(names),
        np.round(profile.probabilities[bins].T, 3),
        hovertemplate='%{x:.2f} m, %{y}: %{z:.3f}<extra></extra>',
    )
    for place in chain(*_patches(profile)):
        figure.add_vline(x=place, line={'color': COLOURS[1]})
    return figure.styled(180 + 24 * len(names), SLANT | BARE, BARE)


def segmentation_figure(swath: Swath) -> Picture:
    """Probability of rough floor over pings and range, with the ends of the true patches."""
    first = swath.profiles[0]
    same_side = [profile for profile in swath.profiles if profile.side == first.side]
    profiles = same_side[thin(len(same_side), 400)]
    longest = max(profiles, key=lambda profile: len(profile.range))
    ranges = longest.range[thin(len(longest.range), 600)]
    seconds = [(profile.stamp_ns - first.stamp_ns) / SECOND for profile in profiles]
    rough = np.stack(
        [
            np.interp(ranges, profile.range, swath.roughness(profile), left=np.nan, right=np.nan)
            for profile in profiles
        ]
    )
    figure = Picture()
    figure.image(
        np.round(ranges, 3),
        seconds,
        np.round(rough, 2),
        'probability of rough',
        hovertemplate='%{x:.2f} m, %{y:.2f} s: %{z:.2f}<extra></extra>',
    )
    ends = [(x, y) for each, y in zip(profiles, seconds) for x in chain(*_patches(each))]
    if ends:
        (x, y), name = np.array(ends).T, 'ends of the true patch'
        figure.points(x, y, name, COLOURS[1], 6, symbol='line-ns-open')
    return figure.styled(340, SLANT | BARE, {'title': 'time [s]', 'autorange': 'reversed'} | BARE)


def verdict_figure(profile: Profile, rough: FloatArray) -> Picture:
    """Probability (n,) of rough floor along one ping, and the bins that cannot be told."""
    figure = Picture()
    shown = thin(len(profile.range), MOST_BINS)
    _shade_patches(figure, profile)
    figure.line(profile.range[shown], rough[shown], 'rough', COLOURS[0], 1.4)
    assert profile.verdict is not None
    place = profile.range[shown][profile.verdict[shown] == 2]
    if len(place):
        bottom = np.full(len(place), -0.05)
        figure.points(place, bottom, 'cannot tell', COLOURS[3], symbol='line-ns-open')
    return figure.styled(300, SLANT | {'zeroline': False}, {'title': 'probability of rough floor'})


def points_of(folder: Path) -> Points | None:
    """The soundings of a run; None without any."""
    place = RunFolder(folder).soundings()
    points = without_far(read_points(place)) if place else ()
    return points or None


def track_of(run: Mapping[str, Any]) -> FloatArray:
    """Where the ship went (n, 2), east and north; empty when the recording is gone."""
    navigation = [pose for pose in read_measurements(run) if isinstance(pose, Navigation)]
    track = np.array([pose.position[:2] for pose in navigation]).reshape(-1, 2)
    return track[thin(len(track), MOST_POSES)]


def finest_chart(points: Points, run: Mapping[str, Any]) -> Chart:
    """The chart of a run, with cells as small as fit."""
    extent = max(np.ptp(points['x']), np.ptp(points['y']))
    cell = next((c for c in CELLS if extent / c <= MOST_CELLS), math.ceil(extent / MOST_CELLS))
    return chart_of(points, float(cell), *budget_of(run))


def chart_figure(grid: Chart, track: FloatArray) -> Picture:
    """Height of the floor in the grid, north up, and the track of the ship."""
    x, y = grid.axes()
    figure, shown = Picture(), ('depth', 'uncertainty', 'label', 'count')
    depth, *others = (grid.bands[name].astype(np.float32) for name in shown)
    hover = (
        'east %{x:.1f} m, north %{y:.1f} m<br>z %{z:.2f} m, sd %{customdata[0]:.2f} m<br>'
        'model %{customdata[1]}, %{customdata[2]} soundings<extra></extra>'
    )
    colours = {'colorscale': 'Viridis', 'colorbar': {'title': 'z [m]'}}
    data = np.dstack(others)
    figure.add_heatmap(x=x, y=y, z=-depth, customdata=data, hovertemplate=hover, **colours)
    if len(track):
        figure.line(track[:, 0], track[:, 1], 'track of the ship', INK, 1.5)
    east = {'title': 'east [m]', 'zeroline': False, 'constrain': 'domain'}
    return figure.styled(520, east, {'title': 'north [m]', 'zeroline': False, 'scaleanchor': 'x'})
