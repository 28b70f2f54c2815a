# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where an instrument was, and the way from pings of XTF and folders of pictures into a bag.

What does not say it has a table beside the input, or arrays with one value per ping.
Positions in degrees become metres from the first one, in ``/nav``; soundings are ``/ground``.
Attitude is in degrees: heading clockwise from north, bow up, starboard down.

Pings come one by one, so that the length of a file does not matter. One whose clock is off for
itself is left out; a clock that was set is followed, and said.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import math
from pathlib import Path
from typing import Any

from attrs import define, Factory
import numpy as np
from numpy.typing import NDArray

from msg_adapters.navigation import write_navigation, write_range
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import quaternion
from sonar_imm.measurements import Altitude, Navigation

from ... import SECOND
from ..conversion import ConversionReport, flags_of, JUMP, Leaps, new_bag
from ..conversion import Record as Stamped
from ..messages import ros_message
from ..places import ask_for_angle, Degrees, origin_parameters, TURN
from ..positions import write_position
from ..sources import BagError
from ..table_files import CsvTable
from ..tables import CsvOptions, Row
from ..times import BadRow

LATEST = 2**31 * SECOND
_SYSTEMS = {'detections': 'obstacle', 'snapshot': 'bathymetry'}
Record = dict[str, Any]
"""What a reader says of a ping or picture, as in `xtf.pings_of`; attitude, depth and altitude are
left out where they are not known."""


Message = tuple[str, Any]
"""Topic and content of a message to be written."""


@define
class Frame:
    """Metres from the first position. missing: pings without a position; beyond: the first of
    those with another one than is on Earth."""

    frame_id: str = 'map'
    origin: Origin | None = None
    missing: int = 0
    beyond: str = ''
    last_ns: int = -1
    leaps: Leaps = Factory(Leaps)

    def navigation(self, record: Record) -> Navigation | None:
        """Where the ship was at a ping; None where the file does not say."""
        east, north = (float(value) for value in record['place'])
        geodetic = record['units'] == 'degrees'
        known = all(map(math.isfinite, (east, north, record['heading'])))
        on_earth = abs(east) <= 180.0 and abs(north) <= 90.0 and (east or north)
        if not (known and record['units'] and (on_earth or not geodetic)):
            self.missing += 1
            if known and geodetic and (east or north):
                self.beyond = self.beyond or f'latitude {north:g}, longitude {east:g}'
            return None
        if geodetic:
            self.origin = self.origin or Origin(north, east)
            east, north = self.origin.local(north, east)[:2].tolist()
        self.leaps.saw(record['stamp_ns'], east, north)
        depth, pitch, roll = (
            value if math.isfinite(value) else 0.0
            for value in (record.get(name, math.nan) for name in ('depth', 'pitch', 'roll'))
        )
        # ENU from FLU, of degrees from north to the east, bow up, starboard down.
        angles = roll, -pitch, 90.0 - record['heading']
        return Navigation(
            stamp_ns=record['stamp_ns'],
            position=[east, north, -depth],
            orientation=quaternion(*map(math.radians, angles)),
            frame_id=self.frame_id,
        )

    def parameters(self) -> dict[str, list[float]]:
        """The origin as a parameter of nodes; nothing for places in metres."""
        if (place := self.origin) is None:
            return {}
        return origin_parameters((place.latitude, place.longitude, 0.0))

    def tell(self, path: Path, report: ConversionReport) -> None:
        """Report the origin, and what is missing or looks wrong."""
        if self.missing:
            report.problems.append(
                f'{path.name}: {self.missing} pings have no position '
                f'({self.beyond or "0, 0"} is none); they have no navigation'
            )
        self.leaps.tell(path, report)
        if place := self.origin:
            report.notes['origin'] = f'latitude {place.latitude!r}, longitude {place.longitude!r}'


def write_records(
    path: Path,
    records: Iterator[Record],
    report: ConversionReport,
    how: Any,
    messages: Any,
    parameters: dict[str, dict[str, Any]] | None = None,
) -> None:
    """Write the messages of each record and where the ship was. Raises `BagError` when there is
    none."""
    frame = Frame()
    own = {} if parameters is None else parameters
    with new_bag(report, path.name, how, own) as bag:
        for record in _in_time(records, path, report):
            stamp_ns = record['stamp_ns']
            nav, made = None, []
            with report.leaving_out(path, record['where']):
                nav = frame.navigation(record)
                with np.errstate(invalid='ignore'):  # of NaN, which the measurements reject
                    made = list(messages({**record, 'nav': nav}))
            if made and nav is not None and stamp_ns != frame.last_ns:
                frame.last_ns = stamp_ns
                made = [*navigation_messages(record, nav), *made]
            for topic, message in made:
                bag.write(topic, message, stamp_ns)
        if place := frame.parameters():
            for topic in report.messages:
                if system := _SYSTEMS.get(topic.rpartition('/')[2]):
                    own[system] = {**own.get(system, {}), **place}
        if not set(report.messages) - {'/nav', '/altitude'}:
            raise report.nothing(path)
    frame.tell(path, report)


def navigation_messages(record: Record, navigation: Navigation) -> Iterator[Message]:
    """Yield where the ship was and, if the record states it, its altitude."""
    yield '/nav', write_navigation(navigation, ros_message)
    altitude = float(record.get('altitude', math.nan))
    if altitude > 0.0 and math.isfinite(altitude):
        measured = Altitude(stamp_ns=record['stamp_ns'], altitude=altitude, frame_id='sonar')
        yield '/altitude', write_range(measured, ros_message)


def _in_time(records: Iterator[Record], path: Path, report: ConversionReport) -> Iterator[Record]:
    """The records whose clock can be believed: near that of the one before, or of the next."""
    last: int | None = None
    held: list[Record] = []

    def leave_out_held() -> None:
        for record in held:
            report.bad_row(path, record['where'], BadRow('its clock is off', 'clock off'))
        held.clear()

    for record in records:
        stamp_ns = record['stamp_ns']
        if not 0 < stamp_ns < LATEST:
            report.bad_row(path, record['where'], BadRow('it has no time', 'no time'))
            continue
        near = last is None or abs(stamp_ns - last) <= JUMP
        if not near and held and abs(stamp_ns - held[0]['stamp_ns']) <= JUMP:
            report.problems.append(
                f'{path.name}, {held[0]["where"]}: the clock jumps by '
                f'{(held[0]["stamp_ns"] - (last or 0)) / SECOND:g} s and stays there'
            )
            yield held.pop()
            near = True
        leave_out_held()
        if near:
            last = stamp_ns
            yield record
        else:
            held.append(record)
    leave_out_held()


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
            found = {'depth': -row.height()}
            found |= {name: row.optional(name) for name in ('heading', 'roll', 'pitch')}
            place = degrees.place(row)[::-1] if degrees else (row.number('x'), row.number('y'))
            return found | {
                'place': place,
                'stamp_ns': row.stamp_ns(),
                'units': 'degrees' if geodetic else 'metres',
            }

        rows = [record for _, record in report.read_rows(table, parse)]
        ask_for_angle(table, 'heading', (row['heading'] for row in rows))
    report.rows -= len(rows)  # those of the input are counted
    if on_earth and geodetic:
        places = ((row['stamp_ns'], row['place']) for row in rows)
        return [(stamp, '/position', write_position(stamp, *place)) for stamp, place in places]
    return list(_messages(iter(rows), Path(path), report, frame or Frame()))


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
    columns = {'heading': _heading(values, path)}
    columns |= {name: values[name] for name in ('depth', 'altitude') if name in values}
    columns |= {'depth': -values['z']} if 'z' in values else {}
    columns |= {name: _attitude(values, name, path) for name in ('roll', 'pitch')}
    units, axes = ('degrees', ('longitude', 'latitude')) if geodetic else ('metres', ('x', 'y'))
    records = (
        {'stamp_ns': stamp, 'units': units, 'place': tuple(values[axis][k] for axis in axes)}
        | {name: float(column[k]) for name, column in columns.items()}
        for k, stamp in enumerate(stamps)
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
                yield record['stamp_ns'], *message
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
