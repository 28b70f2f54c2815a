# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where an instrument was, for conversions of what does not say it: a table beside the input, or
arrays of an archive with one value per ping.

Positions in degrees become metres from the first one. Attitude is in degrees: heading clockwise
from north, bow up, starboard down.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..conversion import ConversionReport, flags_of
from ..conversion import Record as Stamped
from ..csv_table import CsvTable
from ..places import ask_for_angle, Degrees, TURN
from ..positions import write_position
from ..sources import BagError
from ..tables import CsvOptions, Row
from .sonar_files import Frame, navigation_messages, Record

ARRAYS: dict[str, tuple[str, ...]] = {
    'latitude': ('latitude', 'lat'),
    'longitude': ('longitude', 'lon', 'lng', 'long'),
    'x': ('x', 'east', 'easting'),
    'y': ('y', 'north', 'northing'),
    'z': ('z',),
    'depth': ('sonar_depth',),
    'heading': ('heading', 'hdg'),
    'heading_deg': ('heading_deg',),
    'heading_rad': ('heading_rad',),
    'yaw': ('yaw', 'yaw_rad'),
    'yaw_deg': ('yaw_deg',),
    **{name: (name, f'{name}_deg') for name in ('roll', 'pitch')},
    **{f'{name}_rad': (f'{name}_rad',) for name in ('roll', 'pitch')},
    'altitude': ('altitude',),
}
"""Usual names of arrays with one value per ping. Yaw is in radians, counter-clockwise from east;
heading, roll and pitch are in degrees."""
_SMALL = math.radians(90.0)


def navigation_of_table(
    path: Path | str | None,
    options: CsvOptions,
    report: ConversionReport,
    *,
    on_earth: bool,
    frame: Frame | None = None,
) -> list[Stamped]:
    """Return the messages of a table of positions: ``/position`` if `on_earth` and the table has
    degrees, else ``/nav``, in `frame`. Raises `BagError`."""
    if path is None:
        return []
    with flags_of('nav', report):
        table = CsvTable(path, options)
        table.require('stamp')
        geodetic = table.has('latitude', 'longitude')
        if not geodetic:
            table.require('x', 'y')
        degrees = Degrees(table) if geodetic else None
        if not (on_earth and geodetic):
            table.require('heading')

        def parse(row: Row) -> Record:
            row.require_valid()
            height = row.height()
            record = {name: row.optional(name) for name in ('heading', 'roll', 'pitch')}
            place = (
                (row.number('x'), row.number('y')) if degrees is None else degrees.place(row)[::-1]
            )
            stamp_ns = row.stamp_ns()
            return {**record, 'stamp_ns': stamp_ns, 'place': place, 'depth': -height}

        rows = [record for _, record in report.read_rows(table, parse)]
        ask_for_angle(table, 'heading', (row['heading'] for row in rows))
    units = 'degrees' if geodetic else 'metres'
    report.rows -= len(rows)  # those of the input are counted
    if on_earth and geodetic:
        return [
            (row['stamp_ns'], '/position', write_position(row['stamp_ns'], *row['place']))
            for row in rows
        ]
    records = ({**row, 'units': units, 'altitude': math.nan} for row in rows)
    return list(_messages(records, Path(path), report, frame or Frame()))


def navigation_of_arrays(
    arrays: Mapping[str, NDArray],
    stamps: list[int],
    path: Path,
    report: ConversionReport,
    frame: Frame,
) -> list[Stamped]:
    """Return the ``/nav`` and ``/altitude`` messages in `frame` of arrays by the names of
    `ARRAYS`, one value per ping; none without a place. Raises `BagError`."""
    count = len(stamps)
    values: dict[str, NDArray] = {}
    for name, array in arrays.items():
        if array.size not in (1, count) or np.iscomplexobj(array):
            raise BagError(f'{path}: {name} has the shape {array.shape} for {count} pings')
        values[name] = np.broadcast_to(array.ravel().astype(np.float64), count)
    geodetic = {'latitude', 'longitude'} <= values.keys()
    if not geodetic and not {'x', 'y'} <= values.keys():
        return []
    nothing = np.full(count, math.nan)
    heading = _heading(values, path)
    place = [values[name] for name in (('longitude', 'latitude') if geodetic else ('x', 'y'))]
    depth = -values['z'] if 'z' in values else values.get('depth', nothing)
    roll, pitch = (_attitude(values, name, path) for name in ('roll', 'pitch'))
    altitude = values.get('altitude', nothing)
    records = (
        {
            'stamp_ns': stamps[k],
            'units': 'degrees' if geodetic else 'metres',
            'place': (place[0][k], place[1][k]),
            'heading': float(heading[k]),
            'depth': float(depth[k]),
            'roll': float(roll[k]),
            'pitch': float(pitch[k]),
            'altitude': float(altitude[k]),
        }
        for k in range(count)
    )
    return list(_messages(records, path, report, frame))


def _messages(
    records: Iterator[Record], path: Path, report: ConversionReport, frame: Frame
) -> Iterator[Stamped]:
    """Yield the messages of each record; what cannot be used is counted."""
    for k, record in enumerate(records):
        navigation = None
        with report.leaving_out(path, f'pose {k}'):
            navigation = frame.navigation(record)
        if navigation is not None:
            for message in navigation_messages(record, navigation):
                yield record['stamp_ns'], message.topic, message.content
    frame.tell(path, report)


def _heading(values: Mapping[str, NDArray], path: Path) -> NDArray:
    """Return the heading (n,), degrees clockwise from north. Raises `BagError`."""
    if 'heading_deg' in values:
        return values['heading_deg']
    if 'heading' in values:
        if 0.0 < np.nanmax(np.abs(values['heading']), initial=0.0) <= TURN:
            raise BagError(
                f'{path}: heading may be in degrees or radians, none is beyond 2 pi; say --name '
                'heading_deg=heading or --name heading_rad=heading'
            )
        return values['heading']
    if 'heading_rad' in values:
        return np.degrees(values['heading_rad'])
    if 'yaw_deg' in values:
        return 90.0 - values['yaw_deg']
    if 'yaw' not in values:
        raise BagError(
            f'{path} says where the sonar was and not where it looked; name the array, '
            '--name heading=ARRAY (degrees clockwise from north) or --name yaw=ARRAY (radians '
            'counter-clockwise from east)'
        )
    if np.nanmax(np.abs(values['yaw']), initial=0.0) > 2.0 * math.pi:
        raise BagError(
            f'{path}: yaw has values beyond 2 pi, so it is not in radians; say --name '
            'heading=yaw (degrees clockwise from north) or --name yaw_deg=yaw (degrees '
            'counter-clockwise from east)'
        )
    return 90.0 - np.degrees(values['yaw'])


def _attitude(values: Mapping[str, NDArray], name: str, path: Path) -> NDArray:
    """Return roll or pitch (n,), degrees; NaN without any. Raises `BagError` where the unit is
    open."""
    if f'{name}_rad' in values:
        return np.degrees(values[f'{name}_rad'])
    if name not in values:
        return np.full(len(next(iter(values.values()))), math.nan)
    size = np.abs(values[name])
    if 0.0 < np.nanmax(size, initial=0.0) < _SMALL:
        raise BagError(
            f'{path}: {name} may be in degrees or radians; say --name {name}_deg={name} or '
            f'--name {name}_rad={name}'
        )
    return values[name]
