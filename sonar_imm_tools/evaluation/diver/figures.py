# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the report shows of divers: sections with a figure each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

import numpy as np
from plotly.subplots import make_subplots

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimation.arrays import FloatArray

from .. import plotting as plot
from ..plotting import Picture
from ..report import Section
from .series import match, Matching, Series, Truth

MOST_ELLIPSES = 60
MOST_TRACKS_NAMED = 12


def sections(
    metrics: Mapping[str, Any],
    series: Series,
    truth: Truth | None = None,
    fixes: Series | None = None,
    origin: Origin | None = None,
    names: Mapping[str, str] | None = None,
) -> Iterator[Section]:
    """The sections of one run. metrics: content of ``metrics.json``; origin: where the frame of
    the tracks lies on Earth, None when nobody said; names: of targets by target ID."""
    series = series.confirmed()
    in_metres = map_figure(series, truth, fixes, names)
    yield Section(
        'Map',
        f'Seen from above.{"" if truth is None else " Dotted: truth."} Crosses: raw fixes. '
        'Shaded: ellipses that should hold the target 95 % of the time.',
        in_metres if origin is None else plot.in_degrees(in_metres, origin),
        picture=True,
    )
    track_id = series.longest_track()
    if track_id is None:
        return
    count = len(np.unique(series.track_id))
    name = series.name(track_id, names or {})
    which = '' if count == 1 else f' Of {name}, the longest of {count}.'
    matching = None
    if truth is not None and 'position' in metrics:
        matching = match(series, truth, cutoff=metrics['cutoff_m'])
    if matching is not None and len(matching.row):
        yield Section(
            'Error, and the predicted error',
            f'The error of a consistent tracker lies inside the band 95 % of the time.{which}',
            error_figure(matching, track_id),
        )
    else:
        text = f'One sigma on each axis.{which}'
        yield Section('Stated uncertainty', text, sigma_figure(series, track_id))
    if series.model_names:
        yield Section(
            'Which motion model held',
            f'Dark: the model is probable. Headings are counter-clockwise from +x.{which}',
            models_figure(series, track_id, true_course(matching, track_id)),
        )
    hits = series.hits()
    if len(hits):
        yield Section(
            'Normalised innovations (NIS)',
            'Distance of each measurement from its prediction, in units of the stated '
            'uncertainty, squared. Amber: where the mean should stay.',
            plot.nis_figure(plot.seconds(hits.stamp_ns, hits.scan_ns), hits.nis, hits.nis_dof),
        )


def true_course(matching: Matching | None, track_id: int) -> tuple[FloatArray, FloatArray] | None:
    """Seconds and degrees of the true course of the target of a track; None when unknown."""
    if matching is None:
        return None
    rows = matching.series.track_id[matching.row] == track_id
    velocity = matching.truth[rows, 2:]
    moving = np.hypot(*velocity.T) > 0.05
    stamps = matching.series.stamp_ns[matching.row[rows]][moving]
    if not len(stamps):
        return None
    course = np.degrees(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    return plot.seconds(stamps, matching.series.scan_ns), course


def map_figure(
    series: Series,
    truth: Truth | None,
    fixes: Series | None,
    names: Mapping[str, str] | None = None,
) -> Picture:
    """Truth, fixes and tracks from above with equal axes; 95 % ellipses along each track.

    names: of targets by target ID.
    """
    figure = Picture()
    if fixes is not None and len(fixes):
        shown = plot.thin(len(fixes), plot.MOST_POINTS)
        figure.add_scattergl(
            x=fixes.state[shown, 0],
            y=fixes.state[shown, 1],
            mode='markers',
            name='raw fixes',
            hoverinfo='skip',
            marker={'symbol': 'x-thin', 'size': 5, 'line': {'color': plot.GREY, 'width': 1}},
        )
    paths = truth.paths if truth else ()
    for path in paths:
        x, y = path.state[plot.thin(len(path.stamp_ns), plot.MOST_POINTS), :2].T
        legend: dict[str, Any] = {'legendgroup': 'truth', 'showlegend': path is paths[0]}
        hover = f'target {path.track_id}: x %{{x:.2f}}, y %{{y:.2f}}'
        figure.line(x, y, 'truth', plot.INK, line=plot.TRUTH, hovertemplate=hover, **legend)
    ids, counts = np.unique(series.track_id, return_counts=True)
    for order, track_id in enumerate(ids[np.argsort(-counts, kind='stable')]):
        track = series.pick(series.track_id == track_id)
        # Labels are HTML.
        _add_track(figure, track, order, escape(series.name(track_id, names or {})))
    # Clutter can lie anywhere: the first view shows tracks and truth, the rest by zooming out.
    every = [series.state[:, :2], *(path.state[:, :2] for path in paths)]
    x_range, y_range = plot.view_of(np.concatenate(every))
    y = {'title': 'y [m]', 'range': y_range, 'scaleanchor': 'x', 'scaleratio': 1}
    return figure.styled(640, {'title': 'x [m]', 'range': x_range}, y)


def _add_track(figure: Picture, track: Series, order: int, name: str) -> None:
    colour = plot.COLOURS[order % len(plot.COLOURS)]
    x, y = outlines(track.state[:, :2], track.covariance[:, :2, :2]).T
    group: dict[str, Any] = {'legendgroup': name, 'showlegend': False}
    fill = plot.transparent(colour, 0.10)
    area = group | {'fill': 'toself', 'fillcolor': fill, 'hoverinfo': 'skip'}
    figure.line(x, y, None, plot.transparent(colour, 0.35), 1, **area)
    track = track.pick(plot.thin(len(track), plot.MOST_POINTS))
    shown = group | {'showlegend': order < MOST_TRACKS_NAMED, 'mode': 'lines+markers'}
    time = plot.seconds(track.stamp_ns, track.scan_ns)
    hover = '%{customdata:.1f} s: x %{x:.2f}, y %{y:.2f}'
    shown |= {'marker': {'size': 4}, 'customdata': time, 'hovertemplate': hover}
    x, y = track.state[:, :2].T
    figure.line(x, y, name, colour, **shown)


def error_figure(matching: Matching, track_id: int) -> Picture:
    """Error in x and y of one track, over the 95 % band that the tracker predicted."""
    series = matching.series
    rows = series.track_id[matching.row] == track_id
    row = matching.row[rows]
    order = np.argsort(series.stamp_ns[row], kind='stable')
    row, error = row[order], matching.error[rows][order]
    time = plot.seconds(series.stamp_ns[row], series.scan_ns)
    figure = make_subplots(
        figure=Picture(), rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06
    )
    for axis, name in enumerate('xy'):
        place = {'row': axis + 1, 'col': 1}
        shared = {'showlegend': axis == 0, **place}
        half = 1.96 * np.sqrt(series.covariance[row, axis, axis])
        band = {'name': 'predicted 95 % band', 'legendgroup': 'band', **shared}
        figure.band(time, half, -half, plot.AMBER, (0.28, 0.6), **band)
        line = {'mode': 'lines+markers', 'marker': {'size': 3}, 'legendgroup': 'error', **shared}
        name_of_all = 'error of the track'
        figure.line(time, error[:, axis], name_of_all, plot.COLOURS[0], 1.2, gl=True, **line)
        figure.update_yaxes(title=f'{name} error [m]', **place)
    figure.update_xaxes(title='time [s]', row=2, col=1)
    return figure.styled(460, {'zeroline': False}, {})


def sigma_figure(series: Series, track_id: int) -> Picture:
    """Stated standard deviations over time, for runs without truth."""
    track = series.pick(series.track_id == track_id)
    time = plot.seconds(track.stamp_ns, track.scan_ns)
    figure = Picture()
    for axis, name in enumerate('xy'):
        sigma = np.sqrt(track.covariance[:, axis, axis])
        figure.line(time, sigma, name, plot.COLOURS[axis], 1.5, gl=True)
    return figure.styled(320, plot.TIME, {'title': 'stated sigma [m]', 'rangemode': 'tozero'})


def models_figure(
    series: Series, track_id: int, truth_course: tuple[FloatArray, FloatArray] | None
) -> Picture:
    """Model probabilities of one track as a heat strip, headings in order, other models below;
    what several families have (`headings_together`) in one row.

    truth_course: (seconds, degrees) of the true course, drawn over the heading rows; None without.
    """
    track = series.pick(series.track_id == track_id)
    track = track.pick(plot.thin(len(track), 4000))
    names, probabilities = headings_together(track.model_names, track.probabilities)
    order = np.array(model_order(names), int)
    headings = sum(name.startswith('heading_') for name in names)
    names = np.array(names)[order]
    figure = Picture()
    figure.image(
        plot.seconds(track.stamp_ns, track.scan_ns),
        np.arange(len(order)),
        probabilities[:, order].T,
        customdata=np.tile(names[:, None], (1, len(track))),
        hovertemplate='%{x:.1f} s, %{customdata}: %{z:.3f}<extra></extra>',
    )
    if truth_course is not None and headings:
        time, degrees = truth_course
        row = len(order) - headings + np.mod(degrees, 360.0) * headings / 360.0
        figure.points(time, row, 'true course', plot.COLOURS[1])
        figure.data[-1].showlegend = True
    rows = {'tickvals': np.arange(len(order)), 'range': [-0.5, len(order) - 0.5]}
    labels = [model_label(name) for name in names]
    height = 180 + 18 * len(order)
    return figure.styled(height, plot.TIME | plot.BARE, {'ticktext': labels} | rows | plot.BARE)


def outlines(mean: FloatArray, covariance: FloatArray, *, probability: float = 0.95) -> FloatArray:
    """(m, 2) outlines of Gaussian ellipses that hold `probability`, NaN rows between them."""
    shown = plot.thin(len(mean), MOST_ELLIPSES)
    values, vectors = np.linalg.eigh(covariance[shown])
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    radii = np.sqrt(-2.0 * np.log1p(-probability) * np.maximum(values, 0.0))
    shape = vectors @ (radii[:, :, None] * circle)
    closed = mean[shown, None] + shape.transpose(0, 2, 1)
    return np.concatenate([closed, np.full((len(closed), 1, 2), np.nan)], axis=1).reshape(-1, 2)


def headings_together(
    names: tuple[str, ...], probabilities: FloatArray
) -> tuple[tuple[str, ...], FloatArray]:
    """Models and their probabilities (n, M), the same heading of `steady` and `brisk` added up."""
    short = [name.removeprefix('steady_').removeprefix('brisk_') for name in names]
    first = tuple(dict.fromkeys(short))
    added = np.array([[name == each for each in first] for name in short], float)
    return first, probabilities @ added


def model_order(names: tuple[str, ...]) -> list[int]:
    """Indices of `names`: other models first, that is at the bottom, then headings by angle."""
    return sorted(range(len(names)), key=lambda k: (names[k].startswith('heading_'), names[k]))


def model_label(name: str) -> str:
    """Label of a model: ``heading_022`` gives ``22°``."""
    return f'{int(name[8:])}°' if name.startswith('heading_') and name[8:].isdigit() else name
