# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the report shows of reflectors: sections with a figure each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from attrs import evolve
import numpy as np
import plotly.graph_objects as go

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker

from ... import SECOND
from ...offline.run_folder import read_measurements
from ..plotting import add_image, add_line, add_points, BARE, COLOURS, INK, styled, TIME
from ..report import Section
from .scoring import Image, pair, Record, Reflections

MOST_DEPTHS, MOST_RECORDS = 500, 1500
OVER_TIME = {'title': 'time [s]', 'showgrid': False}


def sections(
    run: Mapping[str, Any], metrics: Mapping[str, Any], records: Sequence[Record]
) -> Iterator[Section]:
    """The sections of one run. run: content of ``run.json``; metrics: of ``metrics.json``."""
    if not records:
        return
    committed = [record for record in records if not record.preview]
    start = records[0].stamp_ns
    yield Section(
        'Depth response and reflectors',
        'Grey: the response. Lines: the reflectors that were found, one colour per identity. '
        'Yellow: the true depths, where they are known.',
        response_figure(response_image(run), committed, start),
        picture=True,
    )
    if not committed:
        return
    yield Section(
        'How many there are',
        'Dark: this number of reflectors is probable. Line: the true number, when known.',
        order_figure(committed, start),
    )
    yield Section(
        'Amplitudes',
        'Corrected for spherical spreading where the depth of the array is known. A passive array '
        'measures ratios only, so the truth is scaled to match.',
        amplitude_figure(committed, start, metrics.get('amplitude', {}).get('factor')),
    )
    if _known(committed):
        yield Section(
            'Distance from the truth',
            'OSPA: RMS depth error, where a false or missed reflector counts as an error of the '
            'cutoff.',
            distance_figure(committed, metrics['cutoff_m'], start),
        )


def response_image(run: Mapping[str, Any]) -> Image | None:
    """The depth responses of a run as its tracker saw them; None when its recording is gone.

    They are computed again by a tracker with two particles, whose estimates are not used.
    """
    config = FathometerConfig.from_mapping(run['parameters'], ignore_unknown=True)
    tracker = FathometerTracker(evolve(config, particles=2, smoothing_lag=0, preview_seconds=0.0))
    columns, depths, last = [], None, None
    for measurement in read_measurements(run):
        tracker.process(measurement)
        response = tracker.response
        if response is None or response is last:
            continue
        last = response
        if depths is None:
            depths = response.depth
        if len(response.depth) == len(depths):
            columns.append((response.stamp_ns, response.amplitude / response.sigma))
    if depths is None:
        return None
    columns.sort(key=lambda column: column[0])
    return Image(
        np.array([value for _, value in columns]).T,
        depths,
        np.array([stamp for stamp, _ in columns], np.int64),
    )


def response_figure(image: Image | None, records: Sequence[Record], start_ns: int) -> go.Figure:
    """The response as an image, with the truth as dots and the tracks as lines."""
    figure = go.Figure()
    if image is not None:
        image = _thinned(image)
        most = float(max(6.0, np.nanpercentile(image.value, 99.7)))
        add_image(
            figure,
            (image.stamp_ns - start_ns) / SECOND,
            image.depth,
            np.round(image.value, 2),
            'response / noise',
            limits=(0.0, most),
            colours='Greys',
            showscale=True,
            hoverinfo='skip',
        )
    _add_truth(figure, records, lambda true: true.depth, start_ns, 'truth')
    _add_tracks(figure, records, 'depth', start_ns, mode='lines+markers', marker={'size': 4})
    y = {'title': 'depth [m]', 'autorange': 'reversed', 'showgrid': False}
    return styled(figure, 520, OVER_TIME, y)


def order_figure(records: Sequence[Record], start_ns: int) -> go.Figure:
    """The PMF of the number of reflectors over time, and the true number."""
    pmf = np.array([record.pmf for record in records]).T
    figure = go.Figure()
    add_image(
        figure,
        _seconds(records, start_ns),
        records[0].order_min + np.arange(len(pmf)),
        np.round(pmf, 4),
        hovertemplate='%{x:.0f} s, %{y} reflectors: %{z:.3f}<extra></extra>',
    )
    if known := _known(records):
        figure.add_scattergl(
            x=_seconds([record for record, _ in known], start_ns),
            y=[len(true) for _, true in known],
            mode='lines',
            name='truth',
            line={'color': COLOURS[1], 'width': 2, 'shape': 'hv'},
            showlegend=True,
        )
    y = {'title': 'number of reflectors', 'dtick': 1} | BARE
    return styled(figure, 360, OVER_TIME, y)


def amplitude_figure(
    records: Sequence[Record], start_ns: int, factor: float | None = None
) -> go.Figure:
    """Amplitude of every track over time, and the true amplitudes times `factor`."""
    figure = go.Figure()
    if factor:
        name = 'truth, at the same scale'
        _add_truth(figure, records, lambda true: factor * true.strength, start_ns, name)
    _add_tracks(figure, records, 'strength', start_ns)
    y = {'title': 'amplitude, freed of spreading', 'rangemode': 'tozero'}
    return styled(figure, 360, TIME, y)


def distance_figure(records: Sequence[Record], cutoff: float, start_ns: int) -> go.Figure:
    """OSPA of every record with truth."""
    known = _known(records)
    ospa = np.array([pair(record.found.depth, t.depth, cutoff).ospa for record, t in known])
    figure = go.Figure()
    time = _seconds([record for record, _ in known], start_ns)
    add_line(figure, time, ospa, None, INK, 1.2, gl=True)
    return styled(figure, 280, TIME, {'title': 'OSPA [m]', 'rangemode': 'tozero'})


def _known(records: Sequence[Record]) -> list[tuple[Record, Reflections]]:
    """The records with their truth, where that is known."""
    return [(record, record.true) for record in records if record.true is not None]


def _add_truth(
    figure: go.Figure,
    records: Sequence[Record],
    values: Callable[[Reflections], FloatArray],
    start_ns: int,
    name: str,
) -> None:
    """All true `values` of each record at its time."""
    if known := _known(records):
        each = [values(true) for _, true in known]
        time = np.repeat(_seconds([record for record, _ in known], start_ns), list(map(len, each)))
        add_points(figure, time, np.concatenate(each), name, COLOURS[4], 3)


def _add_tracks(
    figure: go.Figure, records: Sequence[Record], what: str, start_ns: int, **look: Any
) -> None:
    """A line for every reflector: `what` of it over time."""
    places: dict[int, list[tuple[float, float]]] = {}
    for record, time in zip(records, _seconds(records, start_ns)):
        for track_id, value in zip(record.found.track_id, getattr(record.found, what)):
            places.setdefault(int(track_id), []).append((time, value))
    for index, (track_id, rows) in enumerate(sorted(places.items())):
        times, values = zip(*rows)
        name = f'reflector {track_id}'
        further = {'showlegend': False} | look
        add_line(figure, times, values, name, COLOURS[index % 4], 1.5, gl=True, **further)


def _seconds(records: Sequence[Record], start_ns: int) -> list[float]:
    return [(record.stamp_ns - start_ns) / SECOND for record in records]


def _thinned(image: Image) -> Image:
    """The largest value of each few depths and records: thin reflectors must not vanish."""
    value, depth, stamp = image.value, image.depth, image.stamp_ns
    deep = max(1, -(-len(depth) // MOST_DEPTHS))
    long = max(1, -(-len(stamp) // MOST_RECORDS))
    rows, columns = len(depth) // deep * deep, len(stamp) // long * long
    blocks = value[:rows, :columns].reshape(rows // deep, deep, columns // long, long)
    return Image(
        blocks.max(axis=(1, 3)), depth[:rows].reshape(-1, deep).mean(axis=1), stamp[:columns:long]
    )
