"""Angles in radians."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray

TWO_PI = 2.0 * np.pi


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """The same direction in [-pi, pi]; apply it to every difference of angles.

    Angles already inside keep their bits. NaN stays NaN. Any shape.
    """
    angle = np.asarray(angle, np.float64)
    return angle - TWO_PI * np.round(angle / TWO_PI)
