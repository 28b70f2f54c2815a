# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures of a sonar as a screen shows them: the fan, far at one end, beams from its middle.

A fan has two signs: it is ``2 R sin(fov / 2)`` pixels wide, R high, and what lies outside the
sector or beyond the range R is dark. Then ranges by beams are taken from it by linear
interpolation. Pictures of ranges by beams have no such corners.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.measurements import Rejection

DARK = 0.1
"""Most of what lies outside of a fan has less than this share of the mean of what lies inside."""
MOST = 0.98
"""So much is most."""
LEAST_PIXELS = 16
ALIKE = 0.07
"""Share by which the width of a fan may differ from that of its sector."""


def unfolded(pixels: NDArray[Any], fov_deg: float) -> NDArray[Any]:
    """Return ranges (rows, near first) by beams of a picture (rows, columns) that is a fan, and
    any other picture as it is.

    :raises Rejection: for a fan of another sector than `fov_deg`.
    """
    rows, columns = pixels.shape
    half = 0.5 * columns / max(rows, 1)
    if min(rows, columns) < LEAST_PIXELS or not 0.2 < half <= 1.0 + ALIKE:
        return pixels
    drawn = 2.0 * np.arcsin(min(half, 1.0))
    for picture in (pixels[::-1], pixels):
        if _is_fan(picture, float(drawn)):
            break
    else:
        return pixels
    stated = np.radians(fov_deg)
    if abs(2.0 * np.sin(0.5 * min(stated, np.pi)) / (2.0 * half) - 1.0) > ALIKE:
        raise Rejection(
            'no_geometry',
            f'the picture is the fan as a screen shows it, {np.degrees(drawn):.0f} deg wide by '
            f'its width and height, and image_fov_deg is {fov_deg:g}: correct it, or send ranges '
            'by beams',
        )
    return _by_beams(picture, float(stated))


def _is_fan(picture: NDArray[Any], sector: float) -> bool:
    """Whether a picture (rows, columns), the middle of whose first row is where the sonar would
    be, is dark outside of the sector."""
    outside = _outside(*picture.shape, sector)
    bright = float(np.mean(picture[~outside], dtype=np.float64))
    if not bright > 0.0:
        return False
    dark = picture[outside] <= DARK * bright
    return bool(dark.mean() >= MOST)


@lru_cache(maxsize=4)
def _outside(rows: int, columns: int, sector: float) -> BoolArray:
    """Return which pixels lie well outside of the fan."""
    ahead = np.arange(rows)[:, None] + 0.5
    aside = np.abs(np.arange(columns) + 0.5 - 0.5 * columns)
    beyond = np.hypot(ahead, aside) > rows + 2.0
    edge = aside * np.cos(0.5 * sector) - ahead * np.sin(0.5 * sector)
    return np.asarray(beyond | (edge > 2.0))


def _by_beams(picture: NDArray[Any], sector: float) -> FloatArray:
    """Return the ranges by beams of a picture whose first row is the near one; beams are as far
    apart as pixels at half the range."""
    from scipy.ndimage import map_coordinates  # loads a BLAS that others do not need

    rows, columns = picture.shape
    beams = max(LEAST_PIXELS, int(0.5 * sector * rows))
    angle = sector * ((np.arange(beams) + 0.5) / beams - 0.5)
    distance = np.arange(rows)[:, None] + 0.5
    places = distance * np.cos(angle) - 0.5, distance * np.sin(angle) + 0.5 * (columns - 1)
    return np.asarray(map_coordinates(picture.astype(np.float64), places, order=1, mode='nearest'))
