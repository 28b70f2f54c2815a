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

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers.fathometer.response import Response
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker

from ... import SECOND
from ...offline.run_folder import read_measurements
from ..plotting import BARE, COLOURS, INK, Picture, TIME
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


def responses(run: Mapping[str, Any]) -> Iterator[Response]:
    """The depth responses of a run as its tracker saw them; none when its recording is gone.

    They are computed again by a tracker with two particles, whose estimates are not used.
    """
    config = FathometerConfig.from_mapping(run['parameters'], ignore_unknown=True)
    tracker = FathometerTracker(evolve(config, particles=2, smoothing_lag=0, preview_seconds=0.0))
    last = None
    for measurement in read_measurements(run):
        tracker.process(measurement)
        if tracker.response is not None and tracker.response is not last:
            last = tracker.response
            yield last


def response_image(run: Mapping[str, Any]) -> Image | None:
    """The `responses` of a run side by side, those with the depths of the first."""
    seen = list(responses(run))
    if not seen:
        return None
    depths = seen[0].depth
    seen = [each for each in seen if len(each.depth) == len(depths)]
    seen.sort(key=lambda response: response.stamp_ns)
    values = np.array([response.amplitude / response.sigma for response in seen])
    return Image(values.T, depths, np.array([each.stamp_ns for each in seen], np.int64))


def response_figure(image: Image | None, records: Sequence[Record], start_ns: int) -> Picture:
    """The response as an image, with the truth as dots and the tracks as lines."""
    figure = Picture()
    if image is not None:
        image = _thinned(image)
        most = float(max(6.0, np.nanpercentile(image.value, 99.7)))
        look: dict[str, Any] = {'title': 'response / noise', 'limits': (0.0, most)}
        look |= {'colours': 'Greys', 'showscale': True, 'hoverinfo': 'skip'}
        time = (image.stamp_ns - start_ns) / SECOND
        figure.image(time, image.depth, np.round(image.value, 2), **look)
    _add_truth(figure, records, lambda true: true.depth, start_ns, 'truth')
    _add_tracks(figure, records, 'depth', start_ns, mode='lines+markers', marker={'size': 4})
    y = {'title': 'depth [m]', 'autorange': 'reversed', 'showgrid': False}
    return figure.styled(520, OVER_TIME, y)


def order_figure(records: Sequence[Record], start_ns: int) -> Picture:
    """The PMF of the number of reflectors over time, and the true number."""
    pmf = np.array([record.pmf for record in records]).T
    figure = Picture()
    figure.image(
        _seconds(records, start_ns),
        records[0].order_min + np.arange(len(pmf)),
        np.round(pmf, 4),
        hovertemplate='%{x:.0f} s, %{y} reflectors: %{z:.3f}<extra></extra>',
    )
    if known := _known(records):
        time, count = _seconds([r for r, _ in known], start_ns), [len(true) for _, true in known]
        steps = {'color': COLOURS[1], 'width': 2, 'shape': 'hv'}
        figure.line(time, count, 'truth', COLOURS[1], gl=True, line=steps, showlegend=True)
    y = {'title': 'number of reflectors', 'dtick': 1} | BARE
    return figure.styled(360, OVER_TIME, y)


def amplitude_figure(
    records: Sequence[Record], start_ns: int, factor: float | None = None
) -> Picture:
    """Amplitude of every track over time, and the true amplitudes times `factor`."""
    figure = Picture()
    if factor:
        name = 'truth, at the same scale'
        _add_truth(figure, records, lambda true: factor * true.strength, start_ns, name)
    _add_tracks(figure, records, 'strength', start_ns)
    y = {'title': 'amplitude, freed of spreading', 'rangemode': 'tozero'}
    return figure.styled(360, TIME, y)


def distance_figure(records: Sequence[Record], cutoff: float, start_ns: int) -> Picture:
    """OSPA of every record with truth."""
    known = _known(records)
    ospa = np.array([pair(record.found.depth, t.depth, cutoff).ospa for record, t in known])
    figure = Picture()
    time = _seconds([record for record, _ in known], start_ns)
    figure.line(time, ospa, None, INK, 1.2, gl=True)
    return figure.styled(280, TIME, {'title': 'OSPA [m]', 'rangemode': 'tozero'})


def _known(records: Sequence[Record]) -> list[tuple[Record, Reflections]]:
    """The records with their truth, where that is known."""
    return [(record, record.true) for record in records if record.true is not None]


def _add_truth(
    figure: Picture,
    records: Sequence[Record],
    values: Callable[[Reflections], FloatArray],
    start_ns: int,
    name: str,
) -> None:
    """All true `values` of each record at its time."""
    if known := _known(records):
        each = [values(true) for _, true in known]
        time = np.repeat(_seconds([record for record, _ in known], start_ns), list(map(len, each)))
        figure.points(time, np.concatenate(each), name, COLOURS[4], 3)


def _add_tracks(
    figure: Picture, records: Sequence[Record], what: str, start_ns: int, **look: Any
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
        figure.line(times, values, name, COLOURS[index % 4], 1.5, gl=True, **further)


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
