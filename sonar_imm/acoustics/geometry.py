# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where an echo on a forward-looking sonar comes from, and where it will be from elsewhere.

A forward-looking sonar measures range and azimuth and nothing in the vertical: all points of an
arc, from the top of the beam to its bottom, give the same echo. What picks the point on the arc is
the **vertical offset** d_st, how far the obstacle lies below the sonar along the world's vertical.

Two pairs of frames are in use. The literature of underwater vehicles has a world that points
north, east, down (NED) and a body that points forward, starboard, down (FRD); ROS has east, north,
up (ENU) and forward, port, up (FLU). Everything here is written in NED and FRD, so that it can be
read beside the papers; `flip_world`, `flip_body` and `flip_rotation` are the doors to and from
ROS. They are their own inverses.

Notation, all in FRD of the sonar: m (..., 3) obstacle; d range, m; delta azimuth, rad, positive to
starboard; R (..., 3, 3) world from body, ``R = Rz(yaw) Ry(pitch) Rx(roll)``; n = (a, b, c) the
world's vertical seen from the sonar, third row of R. The equations the paper lost in print, (1)
and (7), are

    d = |m|,    tan delta = m_y / m_x  ('plane')    or    sin delta = m_y / d  ('cone')
    n . m = d_st

'plane' is the azimuth of the vertical plane through the echo; 'cone' is what a linear array
measures, the angle to its axis. Inside +-7.5 degrees of elevation they hardly differ.

Source: docs/obstacle.md, after 'forward-looking sonar obstacle tracking' (Daurade).
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import FloatArray

AZIMUTH_MODELS = ('plane', 'cone')

_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_BODY = np.array([1.0, -1.0, -1.0])


class Pose(NamedTuple):
    """Where a body is: position (..., 3) in the world, R (..., 3, 3) world from body."""

    position: Annotated[FloatArray, '*3']
    R: Annotated[FloatArray, '*33']


# -- frames ------------------------------------------------------------------------------------


def flip_world(vector: ArrayLike) -> FloatArray:
    """NED of a vector (..., 3) in ENU, and the other way round.

    >>> flip_world([1.0, 2.0, 3.0]).tolist()
    [2.0, 1.0, -3.0]
    """
    return np.asarray(vector, np.float64) @ _WORLD


def flip_covariance(covariance: ArrayLike) -> FloatArray:
    """NED of a covariance (..., 3, 3) in ENU, and the other way round."""
    return np.asarray(_WORLD @ np.asarray(covariance, np.float64) @ _WORLD)


def flip_body(vector: ArrayLike) -> FloatArray:
    """FRD of a vector (..., 3) in FLU, and the other way round."""
    return np.asarray(vector, np.float64) * _BODY


def flip_rotation(R: ArrayLike) -> FloatArray:
    """NED-from-FRD of the rotation (..., 3, 3) ENU-from-FLU, and the other way round."""
    return np.asarray(_WORLD @ np.asarray(R, np.float64) * _BODY)


def flip_quaternion(q: ArrayLike) -> FloatArray:
    """NED-from-FRD of the quaternion (..., 4) x, y, z, w that is ENU-from-FLU, and the other way
    round: half a turn around the bisector of x and y, then q, then half a turn around x."""
    x, y, z, w = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    return np.sqrt(0.5) * np.stack([x + y, x - y, w - z, w + z], axis=-1)


def rotation(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> FloatArray:
    """``Rz(yaw) Ry(pitch) Rx(roll)``, (..., 3, 3), of angles in radians.

    >>> import numpy as np
    >>> (rotation(0.0, 0.0, np.pi / 2) @ [1.0, 0.0, 0.0]).round(9).tolist()  # x becomes y
    [0.0, 1.0, 0.0]
    """
    roll, pitch, yaw = np.broadcast_arrays(
        *(np.asarray(a, np.float64) for a in (roll, pitch, yaw))
    )
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    sy, cy = np.sin(yaw), np.cos(yaw)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """x, y, z, w of `rotation`.

    >>> import numpy as np
    >>> tuple(round(part, 3) for part in quaternion(0.0, 0.0, np.pi / 2))
    (0.0, 0.0, 0.707, 0.707)
    """
    (sr, cr), (sp, cp), (sy, cy) = (
        (np.sin(0.5 * angle), np.cos(0.5 * angle)) for angle in (roll, pitch, yaw)
    )
    return (
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
        float(cr * cp * cy + sr * sp * sy),
    )


def euler_angles(R: FloatArray) -> FloatArray:
    """Roll, pitch and yaw (..., 3) of a rotation (..., 3, 3); pitch in [-pi/2, pi/2]."""
    return np.stack(
        [
            np.arctan2(R[..., 2, 1], R[..., 2, 2]),
            -np.arcsin(np.clip(R[..., 2, 0], -1.0, 1.0)),
            np.arctan2(R[..., 1, 0], R[..., 0, 0]),
        ],
        axis=-1,
    )


def rotation_of_quaternion(q: ArrayLike) -> FloatArray:
    """The rotation (..., 3, 3) of quaternions (..., 4) x, y, z, w, which need not have unit
    length."""
    q = np.asarray(q, np.float64)
    if q.ndim == 1:  # plain floats: a tenth of the time
        x, y, z, w = q.tolist()
        size = math.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / size, y / size, z / size, w / size
    else:
        x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    if q.ndim == 1:
        return np.array(rows)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def slerp(q0: FloatArray, q1: FloatArray, fraction: ArrayLike) -> FloatArray:
    """The quaternion (..., 4) `fraction` (...) of the way from q0 to q1 (..., 4) at constant rate,
    the short way round. Fractions outside [0, 1] go on at the same rate."""
    if np.ndim(q0) == np.ndim(q1) == 1 and np.ndim(fraction) == 0:
        return _slerp_pair(q0.tolist(), q1.tolist(), float(fraction))  # type: ignore[arg-type]
    q0, q1 = q0 / np.sqrt(_dot(q0, q0)), q1 / np.sqrt(_dot(q1, q1))
    fraction = np.asarray(fraction, np.float64)[..., None]
    cosine = _dot(q0, q1)
    q1, cosine = np.where(cosine < 0.0, -q1, q1), np.abs(cosine)
    aside = q1 - cosine * q0
    sine = np.sqrt(_dot(aside, aside))  # exact for small angles, where acos is not
    angle = np.arctan2(sine, cosine)
    turned = np.sin(fraction * angle) * aside / np.where(sine < 1e-12, 1.0, sine)
    return np.asarray(np.where(sine < 1e-12, q0, np.cos(fraction * angle) * q0 + turned))


def _slerp_pair(q0: list[float], q1: list[float], fraction: float) -> FloatArray:
    """`slerp` of one pair, in plain floats: a fifth of the time."""
    size0, size1 = math.sqrt(sum(a * a for a in q0)), math.sqrt(sum(a * a for a in q1))
    q0, q1 = [a / size0 for a in q0], [a / size1 for a in q1]
    cosine = sum(a * b for a, b in zip(q0, q1))
    if cosine < 0.0:
        cosine, q1 = -cosine, [-a for a in q1]
    aside = [b - cosine * a for a, b in zip(q0, q1)]
    sine = math.sqrt(sum(a * a for a in aside))
    if sine < 1e-12:
        return np.array(q0)
    angle = math.atan2(sine, cosine)
    along, across = math.cos(fraction * angle), math.sin(fraction * angle) / sine
    return np.array([along * a + across * b for a, b in zip(q0, aside)])


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner products (..., 1) of vectors (..., n)."""
    return np.asarray((a[..., None, :] @ b[..., :, None])[..., 0])


def mounted(vehicle: Pose, lever: FloatArray, R_mount: FloatArray) -> Pose:
    """The pose of a sensor that sits at `lever` (3,) of the vehicle, turned by R_mount (3, 3)."""
    return Pose(vehicle.position + apply(vehicle.R, lever), vehicle.R @ R_mount)


# -- from a point to an echo and back ----------------------------------------------------------


def to_world(pose: Pose, m: FloatArray) -> FloatArray:
    """World coordinates (..., 3) of a point m (..., 3) seen from `pose`: eq. (2)."""
    return pose.position + apply(pose.R, m)


def to_body(pose: Pose, point: FloatArray) -> FloatArray:
    """A world point (..., 3) as seen from `pose`."""
    return apply(np.swapaxes(pose.R, -1, -2), point - pose.position)


def project(m: FloatArray, model: str = 'plane') -> tuple[FloatArray, FloatArray]:
    """Range and azimuth (...,) of a point m (..., 3): eq. (1)."""
    d = np.linalg.norm(m, axis=-1)
    if model == 'plane':
        return d, np.arctan2(m[..., 1], m[..., 0])
    return d, np.arcsin(np.clip(m[..., 1] / np.where(d > 0.0, d, 1.0), -1.0, 1.0))


def vertical_offset(m: FloatArray, R: FloatArray) -> FloatArray:
    """d_st (...,), how far m (..., 3) lies below the sonar, m: eq. (7).

    >>> import numpy as np
    >>> R = rotation(0.0, np.radians(30.0), 0.0)
    >>> round(float(vertical_offset(np.array([20.0, 0.0, 0.0]), R)), 3)  # the bow up: above
    -10.0
    """
    return np.asarray(np.einsum('...i,...i->...', R[..., 2, :], m))


def reconstruct(
    d: ArrayLike, delta: ArrayLike, d_st: ArrayLike, R: FloatArray, model: str = 'plane'
) -> FloatArray:
    """The point m (..., 3) with range d, azimuth delta and vertical offset d_st, in front of the
    sonar; NaN where no such point exists.

    With n = (a, b, c) the elevation eps (positive down) solves, in the plane of the azimuth,
    ``k cos eps + c sin eps = d_st / d``, ``k = a cos delta + b sin delta``. On the cone ``m_y = d
    sin delta`` is known, and the same equation holds for the angle eta in the x-z plane.
    """
    d, delta, d_st = (np.asarray(value, np.float64) for value in (d, delta, d_st))
    a, b, c = np.moveaxis(R[..., 2, :], -1, 0)
    if model == 'plane':
        k = a * np.cos(delta) + b * np.sin(delta)
        eps = _arcsin(d_st / (d * np.hypot(k, c))) - np.arctan2(k, c)
        level = d * np.cos(eps)
        parts = level * np.cos(delta), level * np.sin(delta), d * np.sin(eps)
    else:
        m_y, r = d * np.sin(delta), d * np.cos(delta)
        eta = _arcsin((d_st - b * m_y) / (r * np.hypot(a, c))) - np.arctan2(a, c)
        parts = r * np.cos(eta), m_y, r * np.sin(eta)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def predict(m: FloatArray, before: Pose, after: Pose) -> FloatArray:
    """A fixed point m (..., 3) seen from pose `before` as it is seen from `after`: ``R1^T (p0 +
    R0 m - p1)``. Exact, for any time between."""
    return to_body(after, to_world(before, m))


def apply(R: FloatArray, vector: FloatArray) -> FloatArray:
    """Matrix (..., 3, 3) times vector (..., 3), broadcast over the rest."""
    return np.asarray(np.einsum('...ij,...j->...i', R, vector))


def _arcsin(argument: FloatArray) -> FloatArray:
    return np.arcsin(np.where(np.abs(argument) <= 1.0, argument, np.nan))
