# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The textbook conversion from range and bearing, for comparison with `acoustics.polar`."""

import numpy as np
from numpy.typing import ArrayLike

from sonar_imm.estimation.arrays import FloatArray


def linearised_polar_to_cartesian(
    range_: ArrayLike, bearing: ArrayLike, var_range: ArrayLike, var_bearing: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """The conventional conversion, biased at long range, to position (..., 2)
    and first-order covariance (..., 2, 2)."""
    r = np.asarray(range_, np.float64)
    cosine, sine = np.cos(bearing), np.sin(bearing)
    jacobian = np.stack(
        [np.stack([cosine, -r * sine], axis=-1), np.stack([sine, r * cosine], axis=-1)], axis=-2
    )
    variances = np.stack(np.broadcast_arrays(var_range, var_bearing), axis=-1)
    covariance = np.einsum('...ik,...k,...jk->...ij', jacobian, variances, jacobian)
    return np.stack([r * cosine, r * sine], axis=-1), covariance
