# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the report shows of obstacles: sections with a figure or a table each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle.config import BEHAVIOURS

from .. import plotting as plot
from ..plotting import Picture
from ..report import Section
from .series import level, Matching, Series, TruePath

NEARING = {'title': 'range [m]', 'autorange': 'reversed', 'zeroline': False}
"""The axis of ranges: obstacles come nearer from left to right."""


def sections(
    metrics: Mapping[str, Any],
    series: Series,
    truth: Sequence[TruePath],
    found: Matching | None,
    received: Sequence[Any],
    gap: float,
    origin: Origin | None,
) -> Iterator[Section]:
    """The sections of one run. metrics: content of ``metrics.json``; received: the measurements;
    gap: seconds without truth across which it is not interpolated; origin: as `map_section`."""
    yield from map_section(series, received, origin)
    # The obstacle that each track was matched with last.
    pairs = () if found is None else zip(found.series.track_id[found.row], found.target)
    last = {int(track): truth[target] for track, target in pairs}
    yield Section(
        'Height over range',
        'How far each obstacle lies below the sonar, as it comes nearer from left to right. '
        f'Shaded: the 90 % band.{" Dotted: truth." if truth else ""}',
        offset_figure(series, last, gap),
        picture=True,
    )
    yield Section(
        'Above or below',
        'On a level path above and below look the same, and the probability has to stay at one '
        'half. Rolling decides it.',
        above_figure(series),
    )
    pings = [ping for ping in received if isinstance(ping, Detections) and len(ping)]
    yield Section(
        'Image of the sonar',
        'Tracks among the detections of all pings.'
        + (' Dotted: truth, while the beam holds it.' if truth else ''),
        image_figure(series, pings, truth),
    )
    if found is not None and len(found.row):
        yield Section(
            'Error, and the predicted error',
            'Errors of the vertical offset in units of the stated standard deviation.',
            error_figure(found),
        )
        yield Section(
            'Calibration of the probability of being above',
            'How often an obstacle was above, by the stated probability. Pings of one approach '
            'are not independent.',
            header=('P(above)', 'pings', 'stated', 'was above'),
            rows=[
                (name, group['n'], f'{group["stated"]:.3f}', f'{group["came_true"]:.3f}')
                for name, group in metrics['above']['bins'].items()
            ],
        )
    if behaviours := metrics.get('behaviours'):
        yield Section(
            'What the obstacles do',
            'Mean stated probability of each behaviour, by what the obstacle really does.',
            header=('does', 'rows', *(f'P({name})' for name in BEHAVIOURS)),
            rows=[
                (true, values['n'], *(f'{values[name]:.3f}' for name in BEHAVIOURS))
                for true, values in behaviours['confusion'].items()
            ],
        )
    if collisions := metrics.get('collisions'):
        yield Section(
            'Calibration of the probability of a collision',
            'How often a collision followed, by the stated probability. Forecasts of one approach '
            f'are not independent. Brier score {collisions["brier"]:.3f}; of always stating how '
            f'often it happened, {collisions["brier_of_a_guess"]:.3f}.',
            calibration_figure(collisions['bins']),
        )
    hits = series.pick(np.isfinite(series.nis))
    if len(hits):
        time = plot.seconds(hits.stamp_ns, hits.scan_ns)
        yield Section(
            'Normalised innovations (NIS)',
            'Distance of each detection from its prediction, in units of the stated uncertainty, '
            'squared. NIS says nothing about the height: with a wrong sign of roll it is perfect '
            'too.',
            plot.nis_figure(time, hits.nis, np.full(len(hits), 2.0)),
        )


def map_section(
    series: Series, received: Sequence[Any], origin: Origin | None
) -> Iterator[Section]:
    """Where the vehicle went and the obstacles are; nothing without navigation. origin: of its
    frame on Earth, None when nobody said."""
    way = np.array([item.position[:2] for item in received if isinstance(item, Navigation)])
    if not (len(way) and len(series)):
        return
    figure = Picture()
    x, y = way[plot.thin(len(way), plot.MOST_POINTS)].T
    figure.line(x, y, 'vehicle', plot.INK, 2)
    for name, colour, track in _by_track(series):
        x, y = track.place[plot.thin(len(track), plot.MOST_POINTS)].T
        figure.points(x, y, name, colour)
        figure.data[-1].hovertemplate = f'{name}: x %{{x:.1f}}, y %{{y:.1f}}'
    x_range, y_range = plot.view_of(np.concatenate([way, series.place]))
    along = {'title': 'y [m]', 'range': y_range, 'scaleanchor': 'x', 'scaleratio': 1}
    figure.styled(480, {'title': 'x [m]', 'range': x_range}, along)
    yield Section(
        'Map',
        'Seen from above: the way of the vehicle, and where each track has its obstacle.',
        figure if origin is None else plot.in_degrees(figure, origin),
    )


def _by_track(series: Series) -> Iterator[tuple[str, str, Series]]:
    for order, track_id in enumerate(np.unique(series.track_id).tolist()):
        rows = series.pick(series.track_id == track_id)
        yield f'track {track_id}', plot.COLOURS[order % len(plot.COLOURS)], rows


def offset_figure(series: Series, truths: dict[int, TruePath], gap: float) -> Picture:
    """Vertical offset of each track with its 90 % band over the range, far to near."""
    figure = Picture()
    for name, colour, track in _by_track(series):
        near = track.state[:, 0]
        hidden: dict[str, Any] = {'legendgroup': name, 'showlegend': False}
        figure.band(near, track.low, track.high, colour, (0.15, 0.4), **hidden)
        figure.line(near, track.state[:, 2], name, colour, legendgroup=name)
        if (path := truths.get(int(track.track_id[0]))) is not None:
            seen = path.at(track.stamp_ns, gap)
            figure.add_scatter(x=seen[:, 0], y=seen[:, 2], mode='lines', line=plot.TRUTH, **hidden)
    y = {'title': 'below the sonar [m]', 'autorange': 'reversed'}
    return figure.styled(440, NEARING, y)


def image_figure(
    series: Series, pings: Sequence[Detections], truths: Sequence[TruePath]
) -> Picture:
    """Tracks and echoes in the image of the sonar, ahead is up."""
    figure = Picture()
    if pings:
        echoes = np.concatenate([np.column_stack([ping.range, ping.bearing]) for ping in pings])
        shown = level(echoes[plot.thin(len(echoes), plot.MOST_POINTS)])
        figure.points(-shown[:, 1], shown[:, 0], 'detections', plot.GREY, 3)
        figure.data[-1].hoverinfo = 'skip'
    for path in truths:
        flat = level(path.seen[path.in_beam])
        legend: dict[str, Any] = {'legendgroup': 'truth', 'showlegend': path is truths[0]}
        figure.line(-flat[:, 1], flat[:, 0], 'truth', plot.INK, line=plot.TRUTH, **legend)
    for name, colour, track in _by_track(series):
        flat = level(track.state)
        figure.line(-flat[:, 1], flat[:, 0], name, colour)
    y = {'title': 'ahead [m]', 'scaleanchor': 'x', 'scaleratio': 1, 'rangemode': 'tozero'}
    return figure.styled(620, {'title': 'to starboard [m]'}, y)


def above_figure(series: Series) -> Picture:
    """Probability that the obstacle is above the sonar, over the range."""
    figure = Picture()
    for name, colour, track in _by_track(series):
        figure.line(track.state[:, 0], track.above, name, colour)
    return figure.styled(280, NEARING, {'title': 'P(above)', 'range': [-0.02, 1.02]})


def error_figure(found: Matching) -> Picture:
    """Error of the offset over its stated standard deviation, against the range."""
    sigmas = found.error[:, 2] / np.sqrt(found.series.covariance[found.row, 2, 2])
    figure = Picture()
    look = {'fillcolor': plot.AMBER, 'opacity': 0.2, 'line_width': 0}
    figure.add_hrect(y0=-1.645, y1=1.645, annotation_text='9 in 10 should lie here', **look)
    name = 'error / stated sigma'
    figure.points(found.truth[:, 0], sigmas, name, plot.COLOURS[0], opacity=0.6)
    return figure.styled(320, NEARING, {'title': 'offset error / sigma'})


def calibration_figure(bins: Mapping[str, Mapping[str, float]]) -> Picture:
    """How often what was stated with a probability came true, by bins of it; the area of a point
    is the number of forecasts."""
    stated, came, n = ([b[name] for b in bins.values()] for name in ('stated', 'came_true', 'n'))
    figure = Picture()
    figure.line([0, 1], [0, 1], 'as stated', plot.INK, line=plot.TRUTH)
    figure.add_scatter(
        x=stated,
        y=came,
        mode='lines+markers',
        name='happened',
        text=[f'{count} forecasts' for count in n],
        line={'color': plot.COLOURS[0]},
        marker={'size': [6.0 + 18.0 * (count / max(n)) ** 0.5 for count in n]},
    )
    x = {'title': 'stated probability', 'range': [-0.03, 1.03]}
    return figure.styled(360, x, {'title': 'share that happened', 'range': [-0.03, 1.03]})
