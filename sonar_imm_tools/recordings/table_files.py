# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Files with rows of positions and other numbers, all read as tables: CSV with any delimiter, GPX,
KML and GeoJSON."""

from __future__ import annotations

import codecs
from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
from contextlib import suppress
import csv
import json
import math
from pathlib import Path
import re
from typing import Any, TextIO
from xml.etree import ElementTree

import numpy as np

from .columns import time_unit_of, unit_of
from .sources import BagError, start_of
from .tables import CsvOptions, Table

LONGEST_LINE = 1 << 20
"""Characters."""
RECORDS = 'VEMCO DATA LOG'
"""Begin of a file of records of several kinds, each with its own header, of which detections
(``DET``) are read."""


class CsvTable(Table):
    """The header of a CSV file and an iterator over its rows. Raises `BagError` for no CSV."""

    UNITS_ARE_FREE = True

    def __init__(self, path: str | Path, options: CsvOptions | None = None):
        self.path = Path(path)
        self.options = options or CsvOptions()
        self._kind = ''
        start = start_of(self.path)
        if start[:2] in (b'\xff\xfe', b'\xfe\xff') and b'\0' in start[:64]:
            raise BagError(f'{self.path} is text in UTF-16; save it as UTF-8')
        if _binary(start):
            raise BagError(f'{self.path} is no text, not a CSV file')
        self._encoding = _encoding(start)
        with self._open() as file:
            lines = (line for line in _lines(file) if line.strip() and not _is_aside(line))
            first = next(lines, '')
            if first.startswith(RECORDS):
                first = next((line for line in lines if line.startswith('DET_DESC')), first)
                self._kind = 'DET'
            second = next(lines, '')
        if not first:
            raise BagError(f'{self.path} is empty, not a CSV file')
        likely = max(',;\t|', key=first.count)
        self.delimiter = self.options.delimiter or (likely if likely in first else ' ')
        try:
            headers = [name.strip() for name in next(csv.reader([first], **self._dialect))]
        except csv.Error:
            raise self._no_table(1) from None
        super().__init__(path, options, headers)
        if not self._kind:
            with contextlib.suppress(csv.Error):
                self.units = _units_of(next(csv.reader([second], **self._dialect), []), headers)

    def _no_table(self, line: int) -> BagError:
        return BagError(
            f'{self.path}, line {line} is no line of a CSV file: it holds more than '
            f'{csv.field_size_limit()} characters in a cell, or bytes that are no text'
        )

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        ended, width, header_seen, to_skip = True, 0, False, bool(self.units)

        def lines(file: TextIO) -> Iterator[str]:
            nonlocal ended
            for line in _lines(file):
                ended = line.endswith(('\n', '\r'))
                yield line

        with self._open() as file:
            reader = csv.reader(lines(file), **self._dialect)
            while True:
                try:
                    cells = next(reader)
                except StopIteration:
                    return
                except csv.Error:
                    raise self._no_table(reader.line_num) from None
                if not any(cell.strip() for cell in cells) or _is_aside(cells[0]):
                    continue
                if self._kind:
                    header_seen = cells[0] == self._kind
                if header_seen and to_skip:
                    to_skip = False
                elif header_seen:
                    if len(cells) < width and not ended:
                        self.cut_line = reader.line_num
                    width = len(cells)
                    yield reader.line_num, cells
                else:
                    header_seen = not self._kind

    @property
    def _dialect(self) -> dict[str, Any]:
        return {'delimiter': self.delimiter, 'skipinitialspace': True}

    def _open(self) -> TextIO:
        return self.path.open(encoding=self._encoding, errors='replace', newline='')


def _is_aside(line: str) -> bool:
    """Whether a line is a comment, or names the delimiter, as spreadsheets write."""
    return line.startswith('#') or re.match('sep=.?$', line.strip().lower()) is not None


def _units_of(cells: Sequence[str], headers: Sequence[str]) -> list[str]:
    """The units of the columns where the row below the headers holds them, else nothing. Headers
    with a unit keep it."""
    words = [cell.strip().strip('[]()').strip() for cell in cells]
    known = [bool(unit_of(f'a [{word}]') or time_unit_of(f'a {word}')) for word in words]
    if len(cells) != len(headers) or not any(known) or any(map(re.compile(r'\d').search, words)):
        return []
    return ['' if unit_of(header) else word for word, header in zip(words, headers)]


def _lines(file: TextIO) -> Iterator[str]:
    """The lines of a file; what is longer than any line of a table comes in parts."""
    return iter(lambda: file.readline(LONGEST_LINE), '')


def _binary(start: bytes) -> bool:
    """Whether the first bytes are something else than text: control characters are among them, or
    many that are no UTF-8. A byte of another alphabet here and there is text all the same."""
    controls = sum(byte < 32 and byte not in b'\t\n\r\f\x1a' for byte in start)
    strange = start.decode('utf-8', errors='replace').count('\ufffd')
    return controls > 0 or 10 * strange > len(start)


def _encoding(start: bytes) -> str:
    """UTF-8, or else what spreadsheets of western Europe write."""
    try:
        codecs.getincrementaldecoder('utf-8')().decode(start)  # its end may be cut
    except UnicodeDecodeError:
        return 'cp1252'
    return 'utf-8-sig'


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
        read = list(records)
        self._records = [each for each in read if not isinstance(each, str)]
        words = [each for each in read if isinstance(each, str)]
        problems = [f'{Path(path).name} {word}; what came before it is kept' for word in words]
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
    if text[:1] not in (b'{', b'['):
        return ''
    is_geo = re.search(rb'"type":"Feature(Collection)?"', text.replace(b' ', b''))
    return 'geojson' if is_geo else 'json'


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
                own = _text(element, 'name') if tag == 'wpt' else (names or [''])[-1]
                place = (element.get('lat', ''), element.get('lon', ''), _text(element, 'ele'))
                yield dict(zip(PLACE, (_text(element, 'time'), *place, own)))
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


def _placemark(
    placemark: ElementTree.Element, name: str, cut: bool = False
) -> Iterator[dict[str, str]]:
    """The points of a Placemark: one with a time, or the track of Google's extension, which may
    be cut off."""
    times, places = [], []
    for part in placemark.iter():
        tag, text = part.tag.rpartition('}')[2], (part.text or '').strip()
        times += [text] if tag == 'when' else []
        places += [text.split()] if tag == 'coord' else []
        places += [place.split(',') for place in text.split()] if tag == 'coordinates' else []
    if len(times) != len(places) and not (cut and len(times) > 1):
        times = times * len(places) if len(times) == 1 else [''] * len(places)
    for time, place in zip(times, places):
        if len(place) >= 2:
            longitude, latitude, height = (*place, '')[:3]
            yield dict(zip(PLACE, (time, latitude, longitude, height, name)))


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
