# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Files of positions that are no CSV, as the tables that converters read: GPX, KML and GeoJSON."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
import json
import math
from pathlib import Path
import re
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .csv_table import CsvTable
from .sources import BagError, start_of
from .tables import CsvOptions, Table

LARGEST_JSON = 200_000_000
"""Bytes of a GeoJSON file, which is read as a whole."""
PLACE = ('stamp', 'latitude', 'longitude', 'height', 'id')
TIMES = ('coordTimes', 'times', 'coordinateProperties.times')
"""Where writers of GeoJSON keep the times of a line."""


class TrackFile(Table):
    """Rows that were read from a file of another kind than CSV: cells by name of column, and words
    for what is wrong with the file."""

    def __init__(
        self,
        path: str | Path,
        options: CsvOptions | None,
        records: Iterable[Mapping[str, str] | str],
        what: str,
    ):
        self._records, problems = [], []
        for record in records:
            if isinstance(record, str):
                problems.append(f'{Path(path).name} {record}; what came before it is kept')
            else:
                self._records.append(record)
        names = dict.fromkeys(name for record in self._records for name in record)
        if not names:
            raise BagError(' '.join([f'{path} is {what} without a position', *problems]))
        super().__init__(path, options, list(names))
        self.problems = problems

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        for number, record in enumerate(self._records, start=1):
            yield number, [record.get(name, '') for name in self.headers]


def open_table(path: str | Path, options: CsvOptions | None = None) -> Table:
    """The table of a file, whatever kind it is of. Raises `BagError`."""
    kind = kind_of_text(Path(path))
    if kind in ('gpx', 'kml'):
        return TrackFile(path, options, _read_xml(Path(path), kind), f'a {kind.upper()} file')
    if kind == 'geojson':
        return TrackFile(path, options, _read_geojson(Path(path)), 'a GeoJSON file')
    return CsvTable(path, options)


def kind_of_text(path: Path) -> str:
    """gpx, kml, json, geojson or '' by the first bytes of a file. Raises `BagError` where it
    cannot be read."""
    text = start_of(path).removeprefix(b'\xef\xbb\xbf').lstrip()
    if text.startswith(b'<'):
        return next((kind for kind in ('gpx', 'kml') if f'<{kind}'.encode() in text), '')
    if text[:1] in (b'{', b'['):
        head = text.replace(b' ', b'')
        names = (b'"FeatureCollection"', b'"Feature"')
        return 'geojson' if any(b'"type":' + name in head for name in names) else 'json'
    return ''


def _read_xml(path: Path, kind: str) -> Iterator[dict[str, str] | str]:
    """Positions of a GPX or KML file; what has no time has an empty one. A line without times that
    only draws a timed track again is left out. A file that is damaged ends with a word about
    it."""
    names: list[str] = []
    lines: list[list[dict[str, str]]] = []
    timed: set[tuple[tuple[str, str], ...]] = set()
    marks: list[ElementTree.Element] = []
    if b'<!' in start_of(path).replace(b'<!--', b'').replace(b'<![CDATA[', b''):
        raise BagError(
            f'{path} declares entities, which {kind.upper()} has not and which may multiply'
        )
    try:
        for event, element in ElementTree.iterparse(path, events=('start', 'end')):
            tag = element.tag.rpartition('}')[2]
            if event == 'start':
                names += [''] if tag in ('trk', 'rte', 'Placemark') else []
                marks += [element] if tag == 'Placemark' else []
                continue
            if tag == 'name' and names:
                names[-1] = names[-1] or (element.text or '').strip()
            elif tag in ('trkpt', 'rtept', 'wpt'):
                yield _gpx_point(element, names[-1] if names else '')
                element.clear()
            elif tag == 'Placemark':
                points = list(_placemark(marks.pop(), names.pop()))
                if len(points) > 1 and not any(point['stamp'] for point in points):
                    lines.append(points)
                else:
                    timed.add(_places(points))
                    yield from points
                element.clear()
            elif tag in ('trk', 'rte'):
                names.pop()
                element.clear()
    except (ElementTree.ParseError, UnicodeError) as error:
        for mark, name in zip(marks, names):
            yield from _placemark(mark, name, cut=True)
        yield f'is damaged {kind.upper()}: {error}'
    for points in lines:
        if _places(points) not in timed:
            yield from points


def _places(points: list[dict[str, str]]) -> tuple[tuple[str, str], ...]:
    """Return longitude and latitude of points, as written."""
    return tuple((point['longitude'], point['latitude']) for point in points)


def _text(element: ElementTree.Element, tag: str) -> str:
    found = (part.text or '' for part in element if part.tag.rpartition('}')[2] == tag)
    return next(found, '').strip()


def _gpx_point(point: ElementTree.Element, name: str) -> dict[str, str]:
    place = (point.get('lat', ''), point.get('lon', ''), _text(point, 'ele'))
    own = _text(point, 'name') if point.tag.endswith('wpt') else name
    return dict(zip(PLACE, (_text(point, 'time'), *place, own)))


def _placemark(
    placemark: ElementTree.Element, name: str, cut: bool = False
) -> Iterator[dict[str, str]]:
    """The points of a Placemark: one with a time, or the track of Google's extension, which may
    be cut off."""
    times, places = [], []
    for part in placemark.iter():
        tag, text = part.tag.rpartition('}')[2], (part.text or '').strip()
        if tag == 'when':
            times.append(text)
        elif tag == 'coord':
            places.append(text.split())
        elif tag == 'coordinates':
            places += [place.split(',') for place in text.split()]
    if len(times) != len(places) and not (cut and len(times) > 1):
        times = times * len(places) if len(times) == 1 else [''] * len(places)
    for time, place in zip(times, places):
        if len(place) < 2:
            continue
        longitude, latitude, *height = place
        yield dict(zip(PLACE, (time, latitude, longitude, height[0] if height else '', name)))


def _read_geojson(path: Path) -> Iterator[dict[str, str] | str]:
    """The points of all features, with their properties; those of lines with their times."""
    if path.stat().st_size > LARGEST_JSON:
        raise BagError(f'{path} has more than {LARGEST_JSON // 10**6} MB')
    text = path.read_text(encoding='utf-8-sig', errors='replace')
    damage = ''
    try:
        whole = json.loads(text)
    except (ValueError, RecursionError) as error:
        begin = text.find('[', text.find('"features"')) + 1
        whole, damage = {'features': whole_items(text, begin)}, f'is damaged JSON: {error}'
        if named := _CRS.search(text[:begin]):
            whole['crs'] = {'properties': {'name': named[1]}}
    features = whole.get('features') if isinstance(whole, dict) else None
    parts = []
    for feature in features if isinstance(features, list) else [whole]:
        if not isinstance(feature, dict):
            continue
        geometry, found = feature.get('geometry') or {}, feature.get('properties') or {}
        if isinstance(geometry, dict) and isinstance(found, dict):
            parts.append((found, _places_of(geometry)))
    if (epsg := _crs_of(path, whole)) is not None:
        _to_degrees([place for _, places in parts for place in places], epsg)
    for found, places in parts:
        cells = {str(name): _cell(value) for name, value in found.items()}
        times = _times_of(found)
        for number, place in enumerate(places):
            row = dict(zip(('longitude', 'latitude', 'height'), map(_cell, place)))
            if len(times) == len(places):
                row['stamp'] = _cell(times[number])
            yield cells | row
    if damage:
        yield damage


_CRS = re.compile(r'"crs".{0,80}?"name"\s*:\s*"((?!name")[^"]*)"', re.DOTALL)
"""The name of the coordinate system at the head of a file."""


def _crs_of(path: Path, whole: Any) -> int | None:
    """The EPSG number of a member ``crs``, as GeoJSON had it until 2016 and GIS programs still
    write it; None for longitude and latitude. Raises `BagError` for one that is not known."""
    crs = whole.get('crs') if isinstance(whole, dict) else None
    about = crs.get('properties') if isinstance(crs, dict) else None
    name = str(about.get('name', '') if isinstance(about, dict) else '')
    if not name or 'CRS84' in name.upper():
        return None
    numbers = re.search(r'EPSG.*?(\d+)$', name.upper())
    if numbers is None:
        raise BagError(
            f"{path} is in the coordinate system '{name}', which is not known; write it with "
            'longitude and latitude (EPSG:4326)'
        )
    return None if int(numbers[1]) == 4326 else int(numbers[1])


def _to_degrees(places: list[Any], epsg: int) -> None:
    """Write longitude and latitude into places of a coordinate system. Raises `BagError`."""
    from .export.points import degrees_of

    numbers = [
        [value if isinstance(value, (int, float)) else math.nan for value in place[:2]]
        for place in places
    ]
    degrees = degrees_of(np.array(numbers, np.float64).reshape(-1, 2), epsg)
    for place, longitude, latitude in zip(places, *degrees):
        place[0], place[1] = float(longitude), float(latitude)


def whole_items(text: str, at: int) -> list[Any]:
    """What is whole of a JSON list that is cut off, from the character `at` behind its bracket."""
    items, decoder = [], json.JSONDecoder()
    with suppress(ValueError, RecursionError):
        while True:
            while text[at : at + 1] in (' ', '\t', '\r', '\n', ','):
                at += 1
            item, at = decoder.raw_decode(text, at)
            items.append(item)
    return items


def _places_of(geometry: Mapping[str, Any]) -> list[Any]:
    """The positions of a point or a line, of several one after the other."""
    found, kind = geometry.get('coordinates'), geometry.get('type')
    depth = {'Point': 0, 'MultiPoint': 1, 'LineString': 1, 'MultiLineString': 2}.get(str(kind))
    if depth is None or not isinstance(found, list):
        return []
    places: list[Any] = [found]
    for _ in range(depth):
        places = [part for place in places if isinstance(place, list) for part in place]
    return [place for place in places if isinstance(place, list) and len(place) >= 2]


def _times_of(properties: Mapping[str, Any]) -> list[Any]:
    for path in TIMES:
        found: Any = properties
        for name in path.split('.'):
            found = found.get(name) if isinstance(found, dict) else None
        if isinstance(found, list):
            nested = any(isinstance(part, list) for part in found)
            return [time for part in found for time in part] if nested else found
    return []


def _cell(value: Any) -> str:
    if value is None or isinstance(value, (list, dict)):
        return ''
    if isinstance(value, float) and not math.isfinite(value):
        return 'nan'
    return str(value)
