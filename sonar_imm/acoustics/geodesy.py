# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Latitude and longitude, and metres east, north, up of an origin.

The ellipsoid of WGS 84 and its conversions are those of pymap3d: plain numpy, exact in closed form
from latitude and longitude to metres and to a nanometre back, kept by others and tested against
other libraries. What is added here is the turn of covariances: east and north are not the same
directions at the origin and at a place far from it.
"""

from __future__ import annotations

from attrs import frozen
import numpy as np

from ..estimation.arrays import FloatArray

NEAR_ZERO = 1e-4
"""Degrees; both of a position below it are the place of receivers without a fix."""
EARTH_RADIUS = 6_371_008.8
"""Metres, the mean."""
EXACT = 1e-3
"""Metres to which a height is met."""
MOST_STEPS = 8
"""Of the search for it; 2 suffice within 100 km, 5 within 1000 km."""


@frozen
class Origin:
    """The origin of local metres: latitude and longitude in degrees, height above the ellipsoid in
    metres."""

    latitude: float
    longitude: float
    height: float = 0.0

    def local(
        self, latitude: float | FloatArray, longitude: float | FloatArray, height: float = 0.0
    ) -> FloatArray:
        """East, north, up (3,) or (3, n) in metres of one place or n in degrees and metres."""
        from pymap3d import geodetic2enu  # only needed for latitudes

        return np.array(
            geodetic2enu(latitude, longitude, height, self.latitude, self.longitude, self.height),
            np.float64,
        )

    def geodetic(self, enu: FloatArray) -> FloatArray:
        """Latitude, longitude in degrees and height in metres (..., 3) of places (..., 3)."""
        from pymap3d import enu2geodetic

        east, north, up = np.moveaxis(np.asarray(enu, np.float64), -1, 0)
        there = enu2geodetic(east, north, up, self.latitude, self.longitude, self.height)
        return np.stack([np.asarray(part, np.float64) for part in there], axis=-1)

    def at_height(self, places: FloatArray, above: float | FloatArray = 0.0) -> FloatArray:
        """Return latitude, longitude in degrees and height in metres (..., 3) of places (..., 2).

        The places are metres east and north in the plane of the origin. They lie `above` the
        height of the origin along the ellipsoid, not in that plane, which is 785 m higher 100 km
        away: its own latitude and longitude there are 12 m nearer to the origin. NaN for places
        farther than the Earth's radius.
        """
        places = np.asarray(places, np.float64)
        radius = EARTH_RADIUS + self.height
        squared = np.square(places).sum(axis=-1)
        up = above + np.sqrt(np.maximum(radius**2 - squared, 0.0)) - radius
        for _ in range(MOST_STEPS):
            found = self.geodetic(np.concatenate([places, up[..., None]], axis=-1))
            miss = self.height + above - found[..., 2]
            if not np.abs(miss).max(initial=0.0) > EXACT:
                break
            up = up + miss
        found[np.abs(miss) > EXACT] = np.nan
        return found

    def degrees(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Longitude and latitude (n,) of places (n, 2 or 3), metres east, north and up; at the
        height of the origin (`at_height`) where up is NaN or missing."""
        places = np.asarray(places, np.float64)
        found = self.at_height(places[:, :2])
        if places.shape[1] == 3:
            known = np.isfinite(places[:, 2])
            found[known] = self.geodetic(places[known])
        return found[:, 1], found[:, 0]

    def axes(self, latitude: float, longitude: float) -> FloatArray:
        """(3, 3) that turns vectors in east, north, up of a place into those of the origin: the
        convergence of the meridians and the tilt of the vertical."""
        there = _to_earth(latitude, longitude)
        return np.asarray(_to_earth(self.latitude, self.longitude).T @ there)

    def turn(self, latitude: float, longitude: float) -> FloatArray:
        """(3, 3) that turns vectors in east, north, up of a place into those of the origin.

        About the vertical only: ten kilometres away the meridians converge by .1 to .3 degrees
        (more near a pole), and the vertical tilts by .1. A height that is not known must not be
        spread over east and north by the tilt: this is for covariances, `axes` for what is
        measured whole.
        """
        east, north = self.axes(latitude, longitude)[:2, 0]
        c, s = np.array([east, north]) / np.hypot(east, north)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _to_earth(latitude: float, longitude: float) -> FloatArray:
    """(3, 3) that turns east, north, up at a place into axes fixed to the Earth."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    sp, cp, sl, cl = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])
