# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Angles in radians."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray

TWO_PI = 2.0 * np.pi


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """The same direction in [-pi, pi]; apply it to every difference of angles.

    Angles already inside keep their bits. NaN stays NaN. Any shape.

    >>> import math
    >>> round(float(wrap_angle(math.radians(350.0) - math.radians(20.0))), 4)  # -30 degrees
    -0.5236
    """
    angle = np.asarray(angle, np.float64)
    return angle - TWO_PI * np.round(angle / TWO_PI)
