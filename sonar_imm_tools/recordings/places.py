# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Positions of CSV rows in local metres: from latitude and longitude, or by range and bearing."""

from __future__ import annotations

import math
import re

import numpy as np

from msg_adapters.arrivals import FARTHEST
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian
from sonar_imm.estimation.arrays import FloatArray

from .csv_table import BadRow, Row, Table
from .sources import BagError


def check_place(latitude: float, longitude: float) -> None:
    """Raise `BadRow` for degrees that are no position on Earth."""
    if latitude == longitude == 0.0:
        raise BadRow(
            'latitude 0, longitude 0 is what receivers without a fix write', 'no position'
        )
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        swapped = '; are the two swapped?' if abs(longitude) <= 90.0 else ''
        raise BadRow(
            f'latitude {latitude:g}, longitude {longitude:g} is not a position on Earth{swapped}'
        )


class LocalFrame:
    """The local frame of the positions of a table.

    origin: (latitude, longitude, height) in degrees and metres; None for tables in metres. Without
    a stated origin the first position is the origin. Raises `BagError` for a table without
    positions.
    """

    def __init__(self, table: Table, origin: tuple[float, ...] | None = None):
        self.geodetic = not table.has('x', 'y') and table.has('latitude', 'longitude')
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
        self.origin = checked_origin(origin) if self.geodetic else None

    def position(self, row: Row) -> tuple[float, float, float]:
        """Give x, y, z of a row in metres. Raises `BadRow`."""
        if self.geodetic:
            return self._from_geodetic(row)
        x, y, z = row.number('x'), row.number('y'), row.height()
        if max(abs(x), abs(y), abs(z)) > FARTHEST:
            raise BadRow(f'the position {x:g}, {y:g}, {z:g} is more than 100,000 km away')
        return x, y, z

    def notes(self) -> dict[str, str]:
        """The origin, which is needed to convert back to latitude and longitude."""
        if self.origin is None:
            return {}
        return {'origin': 'latitude {!r}, longitude {!r}, height {!r}'.format(*self.origin)}

    def _from_geodetic(self, row: Row) -> tuple[float, float, float]:
        latitude, longitude = row.number('latitude'), row.number('longitude')
        check_place(latitude, longitude)
        height = row.optional('height') if row.table.has('height') else row.height()
        height = 0.0 if math.isnan(height) else height
        if self.origin is None:
            self.origin = (latitude, longitude, 0.0)
        east, north, up = Origin(*self.origin).local(latitude, longitude, height).tolist()
        return east, north, up


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


BEARINGS = ('bow', 'north', 'east')
"""Where bearings count from: clockwise from the bow or from north, counter-clockwise from east."""
_TURN = 6.3


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
    ):
        table.require('range', 'bearing')
        for name, other in (('std_range', 'std_bearing'), ('std_bearing', 'std_range')):
            if table.has(name) and (range_std, bearing_std_deg) == (None, None):
                table.require(other)
        self._table, self._counted_from = table, counted_from
        self._unit = _radians(table.header('bearing')) or math.radians(1.0)
        self._std_unit = _radians(table.header('std_bearing')) or self._unit
        self._range_std = math.nan if range_std is None else range_std
        self._bearing_std = math.nan if bearing_std_deg is None else math.radians(bearing_std_deg)
        self._largest = 0.0

    def place(self, row: Row) -> tuple[FloatArray, FloatArray | None]:
        """x and y (2,), m, and covariance (2, 2) or None. Raises `BadRow`."""
        distance, bearing = row.number('range'), row.number('bearing')
        if distance < 0.0:
            raise BadRow(f'{row.table.header("range")} is {distance:g}, a negative distance')
        if abs(bearing) * self._unit > 2.0 * _TURN:
            raise BadRow(f'{row.table.header("bearing")} is {bearing:g}, more than two turns')
        self._largest = max(self._largest, abs(bearing))
        angle = bearing * self._unit
        angle = {'bow': -angle, 'north': 0.5 * math.pi - angle, 'east': angle}[self._counted_from]
        std_range, std_bearing = row.optional('std_range'), row.optional('std_bearing')
        std_range = std_range if std_range > 0.0 else self._range_std
        std_bearing = std_bearing * self._std_unit if std_bearing > 0.0 else self._bearing_std
        if math.isnan(std_range + std_bearing):
            return distance * np.array([math.cos(angle), math.sin(angle)]), None
        if std_bearing > 1.0:
            raise BadRow(f'the bearing is good to {math.degrees(std_bearing):g} degrees only')
        return unbiased_polar_to_cartesian(distance, angle, std_range**2, std_bearing**2)

    def check_unit(self) -> None:
        """Raise `BagError` where neither the header nor the bearings say degrees or radians."""
        header = self._table.header('bearing')
        if _radians(header) is None and 0.0 < self._largest <= _TURN:
            raise BagError(
                f'{self._table.path}: {header} may be degrees or radians, none is beyond '
                f'{self._largest:.3g}; write bearing_deg or bearing_rad in the header'
            )


def _radians(header: str) -> float | None:
    """The unit of an angle that its header names, in radians."""
    unit = re.search(r'[_ \[(](deg|rad|°)', header.lower())
    return None if unit is None else 1.0 if unit.group(1) == 'rad' else math.radians(1.0)
