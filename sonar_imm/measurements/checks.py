# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What every measurement class checks with: the one way to refuse input, stamps, arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..estimation.arrays import FloatArray
from ..texts import in_one_line

LAST_NS = 2**31 * 10**9


class Rejection(ValueError):
    """Input that cannot be used: `reason` is a short code for counters (``'nan'``), `sentence`
    tells the user, on one line; `missing`: parameters with which it could be used."""

    def __init__(self, reason: str, sentence: str, missing: tuple[str, ...] = ()):
        self.reason = reason
        self.sentence = in_one_line(sentence)
        self.missing = missing
        super().__init__(self.sentence)


def floats(value: Any, *shape: int | None) -> FloatArray:
    """Read-only float64 array of that `shape`, in which None matches any length."""
    array = np.array(value, dtype=np.float64)
    if len(shape) != array.ndim or any(
        want not in (None, got) for want, got in zip(shape, array.shape)
    ):
        raise Rejection('bad_shape', f'an array of shape {shape} is needed, got {array.shape}')
    array.flags.writeable = False
    return array


def column(value: Any) -> FloatArray:
    """Read-only (n,)."""
    return floats(value, None)


def point(value: Any) -> FloatArray:
    """Read-only (3,)."""
    return floats(value, 3)


def points(value: Any) -> FloatArray:
    """Read-only (n, 3)."""
    return floats(value, None, 3)


def quaternion(value: Any) -> FloatArray:
    """Read-only (4,): x, y, z, w."""
    return floats(value, 4)


def nanoseconds(seconds: float) -> int:
    """`seconds` in the unit of stamps."""
    return round(seconds * 1e9)


def check_stamp(stamp_ns: int) -> None:
    """Raise `Rejection` for a stamp that is zero (never filled in), negative, or later than ROS 2
    can say."""
    if not stamp_ns > 0:
        raise Rejection(
            'bad_stamp', f'the header stamp is {stamp_ns} ns; the sensor driver has to fill it in'
        )
    if not stamp_ns < LAST_NS:
        raise Rejection(
            'bad_stamp',
            f'the header stamp is {stamp_ns} ns, beyond 2038-01-19: seconds in ROS 2 have 32 bits',
        )


def positives(value: Any) -> FloatArray | None:
    """Read-only (n,), NaN where the value is no variance or standard deviation, which are positive
    and whose squares are numbers; None when none is."""
    if value is None:
        return None
    array = np.array(value, np.float64)
    array[~((array > 1e-150) & (array < 1e150))] = np.nan
    array.flags.writeable = False
    return None if np.isnan(array).all() else array


def complexes(value: Any) -> NDArray[np.complexfloating]:
    """Read-only copy, complex64 or complex128 as it came, anything else as complex128."""
    array = np.asarray(value)
    kept = array.dtype in (np.dtype(np.complex64), np.dtype(np.complex128))
    array = array.astype(array.dtype if kept else np.complex128, copy=True)
    array.flags.writeable = False
    return array


def content_key(kind: str, *parts: NDArray | np.generic | None) -> bytes:
    """The content of a measurement as bytes: it orders those of one stamp and tells duplicates."""
    return kind.encode() + b''.join(part.tobytes() for part in parts if part is not None)


def check_covariance(covariance: FloatArray, what: str) -> None:
    """Raise `Rejection` unless `covariance` (n, n) is finite, symmetric and positive definite."""
    if not np.isfinite(covariance).all():
        raise Rejection('nan', f'the covariance of {what} is not finite')
    scale = float(np.abs(covariance).max())
    # Halved, so that nothing overflows; np.allclose takes five times as long.
    if np.abs(0.5 * covariance - 0.5 * covariance.T).max() > 0.5e-6 * scale:
        raise Rejection('bad_covariance', f'the covariance of {what} is not symmetric')
    if scale <= 0.0 or np.linalg.eigvalsh(covariance)[0] <= 1e-12 * scale:
        raise Rejection('bad_covariance', f'the covariance of {what} is not positive definite')
