# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Positions of CSV rows in local metres: from latitude and longitude, or by range and bearing.

Which of these a table holds, in which units, is asked of the same cells: so all are in one place.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
import math
import re

import numpy as np

from msg_adapters.arrivals import FARTHEST
from sonar_imm.acoustics.geodesy import NEAR_ZERO, Origin
from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian
from sonar_imm.estimation.arrays import FloatArray

from .columns import FROM_BOW, FROM_NORTH, LEVEL, plain, sign_in, sign_of, SLANT, unit_of
from .sources import BagError
from .tables import NUMBER, Row, Table
from .times import BadRow


def check_place(latitude: float, longitude: float) -> None:
    """Raise `BadRow` for degrees that are no position on Earth."""
    if max(abs(latitude), abs(longitude)) < NEAR_ZERO:
        raise BadRow(
            'latitude 0, longitude 0 is what receivers without a fix write', 'no position'
        )
    if (latitude, longitude) == (91.0, 181.0):
        raise BadRow('latitude 91, longitude 181 is no position in AIS', 'no position')
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        swapped = '; are the two swapped?' if abs(longitude) <= 90.0 else ''
        raise BadRow(
            f'latitude {latitude:g}, longitude {longitude:g} is not a position on Earth{swapped}'
        )


_DEGREES = re.compile(
    r'([A-Za-z]*)\s*([-+]?)(\d+(?:[.,]\d+)?)\s*(?:[°º:d\s]\s*(\d+(?:[.,]\d+)?))?'
    r"\s*(?:['′’:m\s]\s*(\d+(?:[.,]\d+)?))?\s*(?:[°º'′’\"″”]|'')?\s*([A-Za-z]*)$"
)
"""Degrees, minutes and seconds with a hemisphere before or behind them."""
_LETTERS = re.compile(r'(\d)\s*d\s*(\d+)\s*m\s*([\d.]+)\s*s', re.IGNORECASE)
"""Degrees, minutes and seconds marked by letters, of which the last is no south."""
FARTHEST_APART = 5.0
"""Metres that metres and degrees of the same rows may differ by, beside a tenth of the way."""
NEAR_ORIGIN = 1e5
"""Metres from a stated origin that positions are within."""
LEAST_ROWS, SLOWEST = 5, 2e-4
"""Rows by which units are judged; a speed in degrees a second, of 22 m/s, which in metres no
measured position has."""
_AXES = ('latitude', 'longitude')
_UNKNOWN = (91.0, 181.0, 999.0, 9999.0)


class Degrees:
    """Latitude and longitude of the rows of a table, in degrees.

    Cells hold decimal degrees, degrees and minutes (``59 25.8 N``), also seconds
    (``59°25'48"N``), or degrees and minutes in one number, as in NMEA (``5925.8``). The hemisphere
    is in the cell or in a column beside it. prefix: ``vessel_`` for the positions of a vessel.
    Raises `BagError` for a table with latitude and longitude exchanged.
    """

    def __init__(self, table: Table, prefix: str = ''):
        self._names = {axis: f'{prefix}{axis}' for axis in _AXES}
        named = [axis for axis in _AXES if f'{prefix}{axis}_hemisphere' in table.index]
        self._signs = {axis: self._sign_column(table, axis) for axis in _AXES}
        found = [axis for axis in _AXES if self._signs[axis] is not None]
        if len(found) == 1 and not named:
            name = f'{prefix}{found[0]}_hemisphere'
            raise BagError(
                f'{table.path}: {table.header(name)} may be the hemisphere of '
                f'{table.header(self._names[found[0]])}; say --column '
                f"'{name}={table.header(name)}' or --ignore {name}"
            )
        values = {axis: self._first_values(table, axis) for axis in _AXES}
        self._stated = {
            axis: None if (found < 0.0).any() else sign_in(axis, table.header(self._names[axis]))
            for axis, found in values.items()
        }
        latitude, longitude = (np.abs(values[axis]) for axis in _AXES)
        self._ask_for_radians(table, latitude, longitude)
        limits = (latitude, 90.0), (longitude, 360.0)
        beyond = [len(each) and 2.0 * np.mean(each > limit) > 1.0 for each, limit in limits]
        if beyond[0] and latitude.max() <= 180.0 and (longitude <= 90.0).all():
            raise self._exchanged(table, 'one is beyond 90 degrees and the other is not')
        self.packed = any(beyond) and all(
            (each % 100.0 < 60.0).all() and (each < 100.0 * limit).all() for each, limit in limits
        )

    def _ask_for_radians(self, table: Table, latitude: FloatArray, longitude: FloatArray) -> None:
        """Raise `BagError` where degrees without a unit may be radians, or lie off Africa."""
        north, east = self._names.values()
        stated = any(unit_of(table.with_unit(name)) for name in (north, east))
        few = min(len(latitude), len(longitude)) < LEAST_ROWS
        if not table.UNITS_ARE_FREE or stated or few or self._signs['latitude']:
            return
        small = latitude.max() <= 0.5 * math.pi and longitude.max() <= math.pi
        if small and latitude.max() > NEAR_ZERO:
            raise BagError(
                f'{table.path}: {table.header(north)} and {table.header(east)} may be degrees or '
                f'radians, such as {latitude[0]:.6g}; write {north}_deg or {north}_rad in the '
                'header'
            )

    def _exchanged(self, table: Table, why: str) -> BagError:
        north, east = (table.header(name) for name in self._names.values())
        return BagError(
            f'{table.path}: {north} and {east} look exchanged, since {why}; say --column '
            f"'{self._names['latitude']}={east}' --column '{self._names['longitude']}={north}'"
        )

    def check_origin(self, table: Table, origin: tuple[float, float, float]) -> None:
        """Raise `BagError` where the first position is near a stated origin only with latitude and
        longitude exchanged."""
        for row in table.first_rows:
            with suppress(BadRow):
                place = self.place(row)
                ways = [
                    float(np.linalg.norm(Origin(*origin).local(*each)[:2]))
                    for each in (place, place[::-1])
                    if abs(each[0]) <= 90.0
                ]
                if len(ways) == 2 and ways[1] < NEAR_ORIGIN < 0.1 * ways[0]:
                    raise self._exchanged(table, f'the origin is {ways[0] / 1e3:.0f} km away')
                return

    def place(self, row: Row) -> tuple[float, float]:
        """Latitude and longitude of a row. Raises `BadRow`."""
        latitude, longitude = self.unchecked(row)
        check_place(latitude, longitude)
        return latitude, longitude

    def unchecked(self, row: Row) -> tuple[float, float]:
        """Latitude and longitude, also those of no position. Raises `BadRow`."""
        return self._value(row, 'latitude'), self._value(row, 'longitude')

    def _value(self, row: Row, axis: str) -> float:
        name = self._names[axis]
        text = _LETTERS.sub(r"\1°\2'\3″", row.text(name))
        found = None if NUMBER.match(text) else _DEGREES.match(text)
        if found is None:
            value, words = row.number(name), []
        else:
            before, minus, *numbers, behind = found.groups()
            parts = [float((part or '0').replace(',', '.')) for part in numbers]
            value = parts[0] + parts[1] / 60.0 + parts[2] / 3600.0
            if max(parts[1:]) >= 60.0:
                raise row.bad(name, '')
            value = -value if minus == '-' else value
            words = [word for word in (before, behind) if word]
        for part, sixtieth in (('minutes', 60.0), ('seconds', 3600.0)):
            own = row.optional(f'{name}_{part}') if row.table.has(f'{name}_{part}') else 0.0
            if not 0.0 <= own < 60.0:
                raise row.bad(f'{name}_{part}', ', not 0 to 60')
            value += math.copysign(own / sixtieth, -1.0 if text.startswith('-') else 1.0)
        if self.packed and (found is None or numbers[1] is None):
            whole = math.floor(abs(value) / 100.0)
            value = math.copysign(whole + (abs(value) - 100.0 * whole) / 60.0, value)
        letters: dict[str, float] = {}
        if (beside := self._signs[axis]) is not None:
            column, letters = beside
            words.append(row.text(column) or 'nothing')
        signs = {letters.get(word.lower()) or sign_of(axis, word) for word in words}
        if not words and (stated := self._stated[axis]) is not None:
            value = stated * value
        for sign in signs:
            if sign is None or len(signs) > 1 or value < 0.0 < sign:
                raise row.bad(name, f" with the hemisphere '{words[-1][:20]}'")
            value = sign * abs(value)
        return value

    def _sign_column(self, table: Table, axis: str) -> tuple[str, dict[str, float]] | None:
        """The column of the hemisphere: one by its name, one of words for hemispheres beside the
        degrees, or the only one of such words; None without one."""
        at, name = table.index[self._names[axis]], f'{self._names[axis]}_hemisphere'
        if name in table.options.ignore:
            return None
        taken = {k for quantity, k in table.index.items() if quantity != name}
        words = {
            k: {cell.lower() for cell in table.first_cells(k)}
            for k in range(len(table.headers))
            if k not in taken
        }
        letters = {'o'} if axis == 'longitude' else set()
        fitting = [
            k
            for k, found in words.items()
            if found and all(word in letters or sign_of(axis, word) for word in found)
        ]
        beside = [k for k in (at + 1, at - 1) if k in fitting]
        named = words.get(table.index.get(name, -1))
        if named and all(map(NUMBER.match, named)):
            del table.index[name]  # an offset to the north or east
        if name not in table.index:
            if not beside and len(fitting) != 1:
                return None
            table.index[name] = (beside or fitting)[0]
        found = words.get(table.index[name], set())
        if 'o' not in found:
            return name, {}
        found |= set(plain(table.header(name)).split('_'))
        signs = {sign_of(axis, word) for word in found - {'o'}} - {None}
        if len(signs) != 1:
            raise BagError(
                f"{table.path}: 'O' in {table.header(name)} may be east (Ost) or west (Ouest, "
                'Oeste); write E or W'
            )
        return name, {'o': -(signs.pop() or 1.0)}

    def _first_values(self, table: Table, axis: str) -> FloatArray:
        cells = table.first_cells(table.index[self._names[axis]])
        values = [float(cell.replace(',', '.')) for cell in cells if NUMBER.match(cell)]
        factor = table.factor(self._names[axis])
        return factor * np.array([value for value in values if abs(value) not in _UNKNOWN])


class LocalFrame:
    """The local frame of the positions of a table.

    origin: (latitude, longitude, height) in degrees and metres; None for tables in metres. Without
    a stated origin the first position is the origin. Raises `BagError` for a table without
    positions.
    """

    def __init__(self, table: Table, origin: tuple[float, ...] | None = None):
        degrees = table.has('latitude', 'longitude')
        if degrees and table.has('x', 'y') and _are_hemispheres(table):
            del table.index['x'], table.index['y']
        metres = table.has('x', 'y')
        self.geodetic = degrees and (not metres or table.is_blank('x', 'y'))
        self.origin = checked_origin(origin) if self.geodetic else None
        self._degrees = Degrees(table) if self.geodetic else None
        if self._degrees is not None and self.origin is not None:
            self._degrees.check_origin(table, self.origin)
        if not self.geodetic:
            if not any(table.has(name) for name in ('x', 'y')):
                for found, other in (('latitude', 'longitude'), ('longitude', 'latitude')):
                    if table.has(found):
                        table.require(other)
                raise BagError(
                    f'{table.path} has no column for x and y, nor for latitude and longitude; it '
                    f'has {", ".join(table.headers)}; say which columns hold the position, as in '
                    '--column x=HEADER'
                )
            table.require('x', 'y')
            if degrees:
                _ask_for_places(table)
            _ask_for_degrees(table)

    def position(self, row: Row) -> tuple[float, float, float]:
        """Give x, y, z of a row in metres. Raises `BadRow`."""
        if self._degrees is None:
            x, y, z = row.number('x'), row.number('y'), row.height()
            if max(abs(x), abs(y), abs(z)) > FARTHEST:
                raise BadRow(f'the position {x:g}, {y:g}, {z:g} is more than 100,000 km away')
            return x, y, z
        latitude, longitude = self._degrees.place(row)
        beside = any(
            name in row.table.index and row.table.first_cells(row.table.index[name])
            for name in ('z', 'depth')
        )  # an altitude beside a depth is that over the ground
        of_sea = row.table.has('height') and not beside
        height = row.optional('height') if of_sea else row.height()
        height = 0.0 if math.isnan(height) else height
        self.origin = self.origin or (latitude, longitude, 0.0)
        east, north, up = Origin(*self.origin).local(latitude, longitude, height).tolist()
        return east, north, up

    def notes(self) -> dict[str, str]:
        """The origin, which is needed to convert back to latitude and longitude."""
        if self.origin is None:
            return {}
        notes = {'origin': 'latitude {!r}, longitude {!r}, height {!r}'.format(*self.origin)}
        if self._degrees is not None and self._degrees.packed:
            notes['degrees'] = 'degrees and minutes in one number (DDMM.MM)'
        return notes


def _are_hemispheres(table: Table) -> bool:
    """Say whether x and y, as ``E`` and ``N`` are taken for, are the hemispheres of degrees."""
    pairs = ('longitude', 'x'), ('latitude', 'y')
    cells = [(axis, table.first_cells(table.index[name])) for axis, name in pairs]
    return all(found and all(sign_of(axis, cell) for cell in found) for axis, found in cells)


def _ask_for_places(table: Table) -> None:
    """Raise `BagError` where x and y move by another distance than latitude and longitude do."""
    if table.is_blank('latitude', 'longitude') or {'x', 'y'} & set(table.options.columns):
        return
    degrees, metres, places, origin = Degrees(table), [], [], None
    for row in table.first_rows:
        with suppress(BadRow):
            place = degrees.place(row)
            origin = origin or Origin(*place)
            metres.append([row.number('x'), row.number('y')])
            places.append(origin.local(*place)[:2])
    if len(metres) != len(places) or not metres:
        return
    ways = [np.linalg.norm(np.array(each) - each[0], axis=1).max() for each in (metres, places)]
    if abs(ways[0] - ways[1]) > FARTHEST_APART + 0.1 * max(ways):
        x, y, north, east = map(table.header, ('x', 'y', 'latitude', 'longitude'))
        raise BagError(
            f'{table.path}: {x} and {y} move by {ways[0]:.3g} m, {north} and {east} by '
            f'{ways[1]:.3g} m; say which are not the positions: --ignore x or --ignore latitude'
        )


def speeds_of_degrees(seconds: FloatArray, places: FloatArray) -> FloatArray:
    """Return the speeds (m,) of places (n, 2), of unknown unit, a second between stamps (n,) that
    rise; none where not all places could be degrees, longitude first."""
    if not (np.abs(places) <= (180.0, 90.0)).all():
        return np.empty(0)
    rising = np.diff(seconds) > 0.0
    return np.hypot(*np.diff(places, axis=0)[rising].T) / np.diff(seconds)[rising]


def _ask_for_degrees(table: Table) -> None:
    """Raise `BagError` where x and y without a unit move as longitude and latitude do."""
    if any(unit_of(table.with_unit(name)) or name in table.options.columns for name in 'xy'):
        return
    rows = []
    for row in table.first_rows:
        with suppress(BadRow, BagError):
            rows.append((row.stamp_ns() * 1e-9, row.number('x'), row.number('y')))
    if len(rows) < LEAST_ROWS or not table.UNITS_ARE_FREE:
        return
    places = np.array(rows)
    speeds = speeds_of_degrees(places[:, 0], places[:, 1:])
    moving = speeds[speeds > 0.0]
    if len(moving) >= LEAST_ROWS and np.median(moving) < SLOWEST:
        x, y = table.header('x'), table.header('y')
        raise BagError(
            f'{table.path}: {x} and {y}, such as {places[0, 1]:.7g}, {places[0, 2]:.7g}, move by '
            f'{np.median(moving):.2g} a second, as degrees do; say --column longitude={x} '
            f'--column latitude={y}, or for metres --column x={x} --column y={y}'
        )


def origin_parameters(origin: tuple[float, ...] | None) -> dict[str, list[float]]:
    """Give an origin as the tracker's parameter; nothing for metres."""
    return {} if origin is None else {'origin': list(origin)}


def checked_origin(origin: tuple[float, ...] | None) -> tuple[float, float, float] | None:
    """Complete an origin with height 0. Raises `BagError`."""
    if origin is None:
        return None
    if len(origin) not in (2, 3) or not all(map(math.isfinite, origin)) or abs(origin[0]) > 90.0:
        raise BagError(f'an origin is latitude, longitude and optionally height, got {origin}')
    latitude, longitude, height = (*map(float, origin), 0.0)[:3]
    return latitude, longitude, height


TURN = 6.3
"""Radians; beyond it angles can only be degrees."""
_LEAST, _SHARE = 1.0, 0.05
"""A depth matters where a slant range and a horizontal one differ by more: m, share of it."""


def bearings_from(table: Table, stated: str | None, usual: str) -> str:
    """Where bearings of a table count from: as stated, else as usual. Raises `BagError` where the
    header has a word for the other one of north and bow."""
    other, words = {'north': ('bow', FROM_BOW), 'bow': ('north', FROM_NORTH)}[usual]
    if stated is None and words & set(plain(table.header('bearing')).split('_')):
        raise BagError(
            f'{table.path}: {table.header("bearing")} may count from {other} or from {usual}; say '
            f'--bearings {other} or --bearings {usual}'
        )
    return stated or usual


class PolarRows:
    """Range and bearing of rows as x and y, and their covariance.

    x and y are forward and to port for bearings from the bow, else east and north. range_std, m,
    and bearing_std_deg are for rows that state none; where those are missing too, a row has no
    covariance. A bearing is in degrees unless its header says rad.
    """

    def __init__(
        self,
        table: Table,
        counted_from: str,
        range_std: float | None = None,
        bearing_std_deg: float | None = None,
        ranges: str = '',
    ):
        table.require('range', 'bearing')
        for name, other in (('std_range', 'std_bearing'), ('std_bearing', 'std_range')):
            if table.has(name) and (range_std, bearing_std_deg) == (None, None):
                table.require(other)
        self._table, self._counted_from = table, counted_from
        self._unit = self._std_unit = math.radians(1.0)
        if unit_of(table.with_unit('bearing')):
            self._unit, self._std_unit = 1.0, table.factor('bearing')
        if unit_of(table.with_unit('std_bearing')):
            self._std_unit = 1.0
        self._range_std = math.nan if range_std is None else range_std
        self._bearing_std = math.nan if bearing_std_deg is None else math.radians(bearing_std_deg)
        self._largest = 0.0
        self._slant = (ranges or self._kind_of_ranges()) == 'slant'

    def _kind_of_ranges(self) -> str:
        """Whether ranges are slant or horizontal by their header, or where the depth hardly
        matters. Raises `BagError`."""
        header = self._table.header('range')
        for kind, words in (('slant', SLANT), ('horizontal', LEVEL)):
            if any(word.startswith(words) for word in plain(header).split('_')):
                return kind
        pairs = []
        for row in self._table.first_rows:
            with suppress(BadRow):
                pairs.append((row.number('range'), abs(row.height())))
        if not pairs:
            return 'horizontal'
        far, deep = np.array(pairs).T
        apart = far - np.sqrt(np.maximum(far**2 - deep**2, 0.0))
        if np.median(apart - np.maximum(_LEAST, _SHARE * far)) > 0.0:
            raise BagError(
                f'{self._table.path}: {header} may be along the ray or in the plane, which differ '
                f'by {np.median(apart):.3g} m at these depths; say --ranges slant or --ranges '
                'horizontal'
            )
        return 'horizontal'

    def place(self, row: Row) -> tuple[FloatArray, FloatArray | None]:
        """x and y (2,), m, and covariance (2, 2) or None. Raises `BadRow`."""
        distance, bearing = row.number('range'), row.number('bearing')
        if distance < 0.0:
            raise BadRow(f'{row.table.header("range")} is {distance:g}, a negative distance')
        if abs(bearing) * self._unit > 2.0 * TURN:
            raise BadRow(f'{row.table.header("bearing")} is {bearing:g}, more than two turns')
        self._largest = max(self._largest, abs(bearing))
        slant, height = distance, row.height() if self._slant else 0.0
        if abs(height) > slant:
            raise BadRow(f'the range {slant:g} m is less than the depth {abs(height):g} m')
        distance = math.sqrt(slant**2 - height**2)
        angle = bearing * self._unit
        angle = {'bow': -angle, 'north': 0.5 * math.pi - angle, 'east': angle}[self._counted_from]
        std_range, std_bearing = row.optional('std_range'), row.optional('std_bearing')
        std_range = std_range if std_range > 0.0 else self._range_std
        std_range *= slant / max(distance, 0.05 * slant) if slant else 1.0
        std_bearing = std_bearing * self._std_unit if std_bearing > 0.0 else self._bearing_std
        if math.isnan(std_range + std_bearing):
            return distance * np.array([math.cos(angle), math.sin(angle)]), None
        if std_bearing > 1.0:
            raise BadRow(f'the bearing is good to {math.degrees(std_bearing):g} degrees only')
        return unbiased_polar_to_cartesian(distance, angle, std_range**2, std_bearing**2)

    def check_unit(self) -> None:
        """Raise `BagError` where neither the header nor the bearings say degrees or radians."""
        ask_for_angle(self._table, 'bearing', [self._largest])


def ask_for_angle(table: Table, name: str, values: Iterable[float]) -> None:
    """Raise `BagError` where neither the header of an angle nor its values, of which those that
    are NaN do not count, say degrees or radians."""
    largest = max((abs(value) for value in values if not math.isnan(value)), default=0.0)
    if table.has(name) and not unit_of(table.with_unit(name)) and 0.0 < largest <= TURN:
        raise BagError(
            f'{table.path}: {table.header(name)} may be degrees or radians, none is beyond '
            f'{largest:.3g}; write {name}_deg or {name}_rad in the header'
        )
