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

"""Positions of CSV rows in local east-north-up metres, also from latitude and longitude."""

from __future__ import annotations

import math

from msg_adapters.arrivals import FARTHEST
from sonar_imm.acoustics.geodesy import Origin

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


def origin_parameters(origin: tuple[float, ...] | None) -> dict[str, float]:
    """An origin by the names of the tracker's parameters; nothing for metres."""
    names = ('origin_latitude', 'origin_longitude', 'origin_height')
    return {} if origin is None else dict(zip(names, origin))


def origin_of_detections(origin: tuple[float, ...]) -> dict[str, dict[str, float]]:
    """`origin_parameters` of the tracker that takes detections, by its name."""
    return {'obstacle': origin_parameters(origin)}


def checked_origin(origin: tuple[float, ...] | None) -> tuple[float, float, float] | None:
    """Complete an origin with height 0. Raises `BagError`."""
    if origin is None:
        return None
    if len(origin) not in (2, 3) or not all(map(math.isfinite, origin)) or abs(origin[0]) > 90.0:
        raise BagError(f'an origin is latitude, longitude and optionally height, got {origin}')
    latitude, longitude, height = (*map(float, origin), 0.0)[:3]
    return latitude, longitude, height
