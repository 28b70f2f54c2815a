# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Tracks of divers and obstacles for chart plotters, GIS and tables: GPX, KML, GeoJSON, CSV and
Parquet.

Rows of confirmed and coasting tracks, one for each estimate. The ellipse of the horizontal
position has one standard deviation on its axes; times 2.45 it holds 95 %.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray
from sonar_imm.texts import visible

from ..sources import BagError
from . import CsvWriter
from .horizons import feature, utc_text, write_features
from .points import degrees_of

Degrees = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Longitude and latitude (n,) of places (n, 3) in metres, of which z may be NaN."""

COLOURS = ('#e41a1c', '#377eb8', '#4daf4a', '#984ea3', '#ff7f00', '#a65628', '#f781bf', '#666666')
_SPACE = 'urn:sonar_imm:track'
_DIGITS = {'latitude': 8, 'longitude': 8}


@frozen(eq=False)
class Tracks:
    """columns: n rows by track, then time; stamp_ns and track_id are whole numbers, time_utc and
    model text, the rest float64, NaN where not known; latitude and longitude in degrees."""

    columns: dict[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.columns['stamp_ns'])

    def each(self) -> Iterator[tuple[int, IntArray]]:
        """Each track: its number and its rows."""
        numbers = self.columns['track_id']
        for number in np.unique(numbers):
            yield int(number), np.flatnonzero(numbers == number)

    def name(self, number: int, rows: IntArray) -> str:
        """The name of the target of a track, else the number of the track."""
        names = self.columns.get('target_name', np.array([''] * len(self)))[rows]
        return str(next((name for name in names[::-1] if name), number))

    def row(self, k: int) -> dict[str, Any]:
        """What JSON and text can hold of a row: None for what is not known."""
        found = {}
        for name, column in self.columns.items():
            value = column[k].item()
            if isinstance(value, float):
                value = round(value, _DIGITS.get(name, 3)) if np.isfinite(value) else None
            found[name] = value
        return found


def tracks_of(
    estimates: Sequence[Estimate], degrees: Degrees | None, names: Mapping[str, str] | None = None
) -> Tracks:
    """The rows of all confirmed and coasting tracks of a run.

    degrees: for estimates that do not say themselves where they lie on Earth. names: of targets by
    target ID, for the column ``target_name``. Raises `BagError`
    where there is nothing to export.
    """
    parts = [_rows(estimate) for estimate in estimates if len(estimate)]
    parts = [part for part in parts if len(part['stamp_ns'])]
    if not parts:
        raise BagError('there are no confirmed tracks to export')
    columns = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        columns[name] = np.concatenate(
            [part.get(name, np.full(len(part['stamp_ns']), np.nan)) for part in parts]
        )
    if names and 'target_id' in columns:
        ids = (str(int(each)) if np.isfinite(each) else '' for each in columns['target_id'])
        columns['target_name'] = np.array([names.get(each, '') for each in ids])
    order = np.lexsort((columns['stamp_ns'], columns['track_id']))
    columns = {name: column[order] for name, column in columns.items()}
    if degrees is not None:
        places = np.column_stack([columns[axis] for axis in 'xyz'])
        columns['longitude'], columns['latitude'] = degrees(places)
    return Tracks(columns)


def _rows(estimate: Estimate) -> dict[str, NDArray[Any]]:
    """The columns of one estimate. Raises `BagError` for one of another system."""
    given = estimate.columns()
    if 'track_state' not in given or 'px' not in given:
        raise BagError('these estimates hold no tracks: only divers and obstacles have them')
    kept = np.asarray(given['track_state']) > 0
    unknown = np.full(len(kept), np.nan)

    def column(name: str) -> FloatArray:
        return np.asarray(given.get(name, unknown), float)[kept]

    # The place of an obstacle has a covariance of its own; a diver's is part of the state.
    prefix = 'place_cov_{}_{}' if 'place_cov_x_x' in given else 'cov_p{}_p{}'
    covariance = (column(prefix.format(*pair)) for pair in ('xx', 'xy', 'yy'))
    major, minor, angle = _ellipses(*covariance)
    vx, vy = column('vx'), column('vy')
    count = int(kept.sum())
    rows: dict[str, NDArray[Any]] = {
        'stamp_ns': np.full(count, estimate.stamp_ns, np.int64),
        'time_utc': np.full(count, utc_text(estimate.stamp_ns)),
        'track_id': np.asarray(given['track_id'], np.int64)[kept],
        'state': np.where(np.asarray(given['track_state'])[kept] == 1, 'confirmed', 'coasting'),
        **{name: column(name) for name in ('latitude', 'longitude')},
        **{axis: column(f'p{axis}') for axis in 'xyz'},
        'std_major': major,
        'std_minor': minor,
        'major_azimuth_deg': np.degrees(angle) % 180.0,
        'speed': np.hypot(vx, vy),
        'course_deg': np.degrees(np.arctan2(vx, vy)) % 360.0,
    }
    # What a target does: by families of models, by behaviours, or by the models themselves.
    families = [name for name in given if name.startswith('family_')]
    models = [name for name in given if name.startswith('prob_')]
    behaviours = [name for name in models if name not in ('prob_above', 'prob_below')]
    models = families or behaviours or models
    labels = np.array([name.removeprefix('prob_').removeprefix('family_') for name in models])
    probabilities = np.column_stack([column(name) for name in models])
    rows['model'] = labels[np.argmax(np.nan_to_num(probabilities), axis=1)]
    extras = ('target_id', 'existence', 'collision_probability', 'vertical_offset_lo')
    more = (*models, *extras, 'vertical_offset_hi')
    return rows | {name: column(name) for name in more if name in given}


def _ellipses(
    xx: FloatArray, xy: FloatArray, yy: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard deviations along the axes of covariances, and the azimuth of the major one,
    clockwise from y."""
    covariance = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    values, vectors = np.linalg.eigh(np.where(np.isfinite(covariance), covariance, 0.0))
    values = np.sqrt(np.maximum(values, 0.0))
    major = vectors[..., 1]
    return values[..., 1], values[..., 0], np.arctan2(major[..., 0], major[..., 1])


def write_tracks(path: Path, tracks: Tracks, kind: str, name: str) -> int:
    """Write a file of a kind of `FORMATS`; name: of the run. Gives how many rows have no place on
    Earth and were left out. Raises `BagError` when all are."""
    if kind in ('csv', 'parquet'):
        {'csv': _write_csv, 'parquet': _write_parquet}[kind](path, tracks)
        return 0
    there = np.isfinite(tracks.columns['latitude'])
    if not there.any():
        raise BagError(
            'nobody says where the tracks lie on Earth: say it with --crs and --origin, or '
            'write a .csv'
        )
    kept = Tracks({column: values[there] for column, values in tracks.columns.items()})
    {'gpx': _write_gpx, 'kml': _write_kml, 'geojson': _write_geojson}[kind](path, kept, name)
    return int((~there).sum())


def _write_csv(path: Path, tracks: Tracks) -> None:
    with path.open('w', encoding='utf-8', errors='backslashreplace', newline='') as file:
        writer = CsvWriter(file)
        writer.write(tracks.columns)
        for k in range(len(tracks)):
            writer.write('' if value is None else value for value in tracks.row(k).values())


def _write_parquet(path: Path, tracks: Tracks) -> None:
    import pyarrow
    import pyarrow.parquet

    table = pyarrow.table({name: column.tolist() for name, column in tracks.columns.items()})
    with path.open('wb') as file:  # the library names only files whose names are UTF-8
        pyarrow.parquet.write_table(table, file)


def _write_geojson(path: Path, tracks: Tracks, name: str) -> None:
    """A line for each track, with the colours that viewers of GeoJSON know, and its points."""
    features = []
    for turn, (number, rows) in enumerate(tracks.each()):
        style = {'stroke': COLOURS[turn % len(COLOURS)], 'stroke-width': 2}
        points = [tracks.row(int(k)) for k in rows]
        if len(points) > 1:
            about = {
                'track_id': number,
                'name': tracks.name(number, rows),
                'begin_utc': points[0]['time_utc'],
                'end_utc': points[-1]['time_utc'],
            }
            places = [_place(point) for point in points]
            features.append(feature('LineString', places, about | style))
        for point in points:
            about = {key: value for key, value in point.items() if key not in _PLACE}
            about |= {'marker-color': style['stroke'], 'marker-size': 'small'}
            features.append(feature('Point', _place(point), about))
    write_features(path, features, name=name)


_PLACE = ('latitude', 'longitude', 'z')


def _place(point: dict[str, Any]) -> list[float]:
    height = [] if point['z'] is None else [point['z']]
    return [point['longitude'], point['latitude'], *height]


def _write_gpx(path: Path, tracks: Tracks, name: str) -> None:
    """Tracks of GPX 1.1; what GPX has no word for in extensions."""
    root = ElementTree.Element(
        'gpx',
        {'version': '1.1', 'creator': 'sonar_imm', 'xmlns': 'http://www.topografix.com/GPX/1/1'}
        | {'xmlns:sonar': _SPACE},
    )
    ElementTree.SubElement(ElementTree.SubElement(root, 'metadata'), 'name').text = name
    for number, rows in tracks.each():
        track = ElementTree.SubElement(root, 'trk')
        ElementTree.SubElement(track, 'name').text = tracks.name(number, rows)
        segment = ElementTree.SubElement(track, 'trkseg')
        for k in rows:
            point = tracks.row(int(k))
            place = {'lat': f'{point["latitude"]:.8f}', 'lon': f'{point["longitude"]:.8f}'}
            element = ElementTree.SubElement(segment, 'trkpt', place)
            if point['z'] is not None:
                ElementTree.SubElement(element, 'ele').text = str(point['z'])
            ElementTree.SubElement(element, 'time').text = point['time_utc']
            more = ElementTree.SubElement(element, 'extensions')
            for key in ('std_major', 'std_minor', 'major_azimuth_deg', 'speed', 'course_deg'):
                ElementTree.SubElement(more, f'sonar:{key}').text = str(point[key])
            ElementTree.SubElement(more, 'sonar:model').text = str(point['model'])
    _write_xml(path, root)


def _write_kml(path: Path, tracks: Tracks, name: str) -> None:
    """Two Placemarks for each track, in a colour of its own: a timed track, and its line, because
    GIS programs know no timed tracks."""
    google = 'http://www.google.com/kml/ext/2.2'
    root = ElementTree.Element(
        'kml', {'xmlns': 'http://www.opengis.net/kml/2.2', 'xmlns:gx': google}
    )
    document = ElementTree.SubElement(root, 'Document')
    ElementTree.SubElement(document, 'name').text = name
    for turn, (number, rows) in enumerate(tracks.each()):
        colour = COLOURS[turn % len(COLOURS)]
        track, line = (
            ElementTree.SubElement(_placemark(document, tracks.name(number, rows), colour), shape)
            for shape in ('gx:Track', 'LineString')
        )
        points = [tracks.row(int(k)) for k in rows]
        for point in points:
            ElementTree.SubElement(track, 'when').text = point['time_utc']
        places = [
            (f'{point["longitude"]:.8f}', f'{point["latitude"]:.8f}', str(point['z'] or 0))
            for point in points
        ]
        for place in places:
            ElementTree.SubElement(track, 'gx:coord').text = ' '.join(place)
        ElementTree.SubElement(line, 'coordinates').text = ' '.join(map(','.join, places))
        data = ElementTree.SubElement(ElementTree.SubElement(track, 'ExtendedData'), 'SchemaData')
        for key in ('std_major', 'std_minor', 'major_azimuth_deg', 'speed', 'model'):
            column = ElementTree.SubElement(data, 'gx:SimpleArrayData', {'name': key})
            for point in points:
                ElementTree.SubElement(column, 'gx:value').text = str(point[key])
    _write_xml(path, root)


def _placemark(document: ElementTree.Element, name: str, colour: str) -> ElementTree.Element:
    """Return a new Placemark. colour: '#rrggbb' of its line."""
    placemark = ElementTree.SubElement(document, 'Placemark')
    ElementTree.SubElement(placemark, 'name').text = name
    line = ElementTree.SubElement(ElementTree.SubElement(placemark, 'Style'), 'LineStyle')
    # KML writes alpha, blue, green, red.
    ElementTree.SubElement(line, 'color').text = f'ff{colour[5:7]}{colour[3:5]}{colour[1:3]}'
    ElementTree.SubElement(line, 'width').text = '2'
    return placemark


def _write_xml(path: Path, root: ElementTree.Element) -> None:
    for element in root.iter():
        element.text = visible(element.text or '')  # XML has no place for control characters
    ElementTree.indent(root, ' ')
    ElementTree.ElementTree(root).write(path, encoding='utf-8', xml_declaration=True)


def write_obstacles(
    path: Path, landmarks: Sequence[dict[str, Any]], epsg: int, origin: tuple[float, float, float]
) -> None:
    """Points (RFC 7946), the third coordinate the height in the frame of the navigation.

    landmarks: as run.json has them, see `trackers.obstacle.memory.Landmark.row`; origin: of their
    frame in the coordinate system `epsg`. Raises `BagError`. Needs rasterio."""
    places = np.array([[each[axis] for axis in 'xyz'] for each in landmarks]) + origin
    heights = places[:, 2].tolist()
    longitudes, latitudes = (axis.tolist() for axis in degrees_of(places[:, :2], epsg))
    features = []
    for each, longitude, latitude, height in zip(landmarks, longitudes, latitudes, heights):
        std = {f'{axis}_std_m': each[f'cov_{axis}_{axis}'] ** 0.5 for axis in 'xyz'}
        band = {f'{name}_m': each[name] + origin[2] for name in ('z_low', 'z_high')}
        properties = {
            'track_id': int(each['track_id']),
            'existence': round(each['existence'], 4),
            **{name: round(value, 3) for name, value in (std | band).items()},
            'last_seen_utc': utc_text(int(each['seen_ns'])),
        }
        place = [round(longitude, 8), round(latitude, 8), round(height, 3)]
        features.append(feature('Point', place, properties))
    write_features(path, features)
