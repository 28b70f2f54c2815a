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

"""Sigma points of many components at once, compiled; a lane: see `estimation.small_matrices`.

A component has states y (n, lanes), the first four being (d, delta, z, s) of `kernels`. Its sigma
points are on the columns of F (n, n, lanes), the lower Cholesky root of its covariance times the
square root of n + kappa. Number 0 is the centre; `ahead(c)` lies ahead on column c, the next one
behind. The root is triangular: on columns from `PLACED` on an obstacle is where it is at the
centre, so there are `PLACES` different places.

States that a function leaves as they are need no sigma points: their covariance stays, and with
what the function makes of the others it is a sum over the columns, `beside`.
"""

from __future__ import annotations

import math

from ...estimation.arrays import FloatArray
from ...estimation.elementary import phasors
from ...estimation.jit import kernel

PLACED = 3
"""The first so many states say where an obstacle is."""
PLACES = 2 * PLACED + 1
NEAR, NEAREST = 0.25, 0.03
"""Tangents of differences of direction up to which a series does for the arc tangent: after the
angle was halved, and at once. Both end below 1e-17."""
FOREMOST = 3.0
"""rad: an azimuth beyond may come to the other side of 180 degrees."""
_PER_TURN = 0.5 / math.pi


@kernel
def ahead(column: int) -> int:
    """Number of the sigma point ahead on a column; that behind is the next one."""
    return 1 + 2 * column


@kernel
def fan(y: FloatArray, F: FloatArray, points: FloatArray) -> None:
    """One state, y (lanes,), at the sigma points (numbers, lanes): F (columns, lanes) is its row
    of the root, which is zero on all columns that are not given."""
    numbers, lanes = points.shape
    for number in range(numbers):
        column = (number - 1) // 2
        if number == 0 or column >= len(F):
            for k in range(lanes):
                points[number, k] = y[k]
        elif number == ahead(column):
            for k in range(lanes):
                points[number, k] = y[k] + F[column, k]
        else:
            for k in range(lanes):
                points[number, k] = y[k] - F[column, k]


@kernel
def places(
    y: FloatArray,
    F: FloatArray,
    depth: float,
    R: FloatArray,
    cone: bool,
    scratch: FloatArray,
    out: FloatArray,
) -> None:
    """Where the sigma points lie, seen from a sonar at that depth, turned by R (`kernels.point`):
    into out (3, PLACES, lanes). scratch (9, PLACES, lanes)."""
    a, b, c = R[2, 0], R[2, 1], R[2, 2]
    for state in range(len(out)):
        fan(y[state], F[state, : state + 1], scratch[state])
    # All places in one row.
    row, to = scratch.reshape(9, -1), out.reshape(3, -1)
    d, turn, drop, cosine, sine, lean = row[0], row[1], row[2], row[3], row[4], row[5]
    steady, up, level, m0, m1, m2 = row[6], row[7], row[8], to[0], to[1], to[2]
    count = len(d)
    phasors(turn, _PER_TURN, cosine, sine)
    for k in range(count):
        drop[k] -= depth
    r, size = d, turn
    if cone:
        r = level
        for k in range(count):
            r[k] = d[k] * cosine[k]
            m1[k] = d[k] * sine[k]
        for k in range(count):
            drop[k] -= b * m1[k]
    # The world's vertical in the plane of the azimuth, or for a cone in the x-z plane.
    for k in range(count):
        lean[k] = a if cone else a * cosine[k] + b * sine[k]
        size[k] = math.sqrt(lean[k] * lean[k] + c * c)
    for k in range(count):
        steady[k] = c / size[k] if size[k] > 0.0 else 1.0
        lean[k] = lean[k] / size[k] if size[k] > 0.0 else 0.0
    for k in range(count):
        drop[k] /= r[k] * size[k]
    for k in range(count):
        limited = drop[k] if drop[k] < 1.0 else 1.0
        limited = limited if limited > -1.0 else -1.0
        drop[k] = limited
        up[k] = math.sqrt((1.0 - limited) * (1.0 + limited))
    for k in range(count):
        m2[k] = r[k] * (drop[k] * steady[k] - up[k] * lean[k])
    for k in range(count):
        level[k] = r[k] * (up[k] * steady[k] + drop[k] * lean[k])
    for k in range(count):
        m0[k] = level[k] if cone else level[k] * cosine[k]
    if not cone:
        for k in range(count):
            m1[k] = level[k] * sine[k]


@kernel
def turned(M: FloatArray, m: FloatArray, out: FloatArray) -> None:
    """M m of points m (3, numbers, lanes) into the first numbers of out (3, .., lanes)."""
    given, to = m.reshape(3, -1), out.reshape(3, -1)
    for i in range(len(to)):
        for k in range(given.shape[1]):
            to[i, k] = M[i, 0] * given[0, k] + M[i, 1] * given[1, k] + M[i, 2] * given[2, k]


@kernel
def echoes(
    near: FloatArray,
    m: FloatArray,
    cone: bool,
    scratch: FloatArray,
    distance: FloatArray,
    azimuth: FloatArray,
) -> None:
    """Range and azimuth (numbers, lanes) of m (3, numbers, lanes), seen by the sonar
    (`geometry.project`). near (lanes,): azimuths of the centres as they were a moment ago. scratch
    (3, numbers, lanes)."""
    numbers, lanes = distance.shape
    points, work = m.reshape(3, -1), scratch.reshape(3, -1)
    x, y, z = points[0], points[1], points[2]
    flat, turn = distance.reshape(-1), azimuth.reshape(-1)
    for k in range(numbers * lanes):
        flat[k] = math.sqrt(x[k] * x[k] + y[k] * y[k] + z[k] * z[k])
    if cone:
        for k in range(numbers * lanes):
            turn[k] = math.asin(min(1.0, max(-1.0, y[k] / flat[k])))
        return
    dot, cross, t = work[0], work[1], work[2]
    phasors(near, _PER_TURN, cross[:lanes], dot[:lanes])
    for k in range(lanes):
        along, across = cross[k] * x[k] + dot[k] * y[k], cross[k] * y[k] - dot[k] * x[k]
        t[k] = across / along if along > 0.0 else math.inf
    for k in range(lanes):
        # atan t = 2 atan(t / (1 + sqrt(1 + t^2)))
        h = t[k] / (1.0 + math.sqrt(1.0 + t[k] * t[k]))
        u = h * h
        rest = 1.0 / 9.0 - u * (1.0 / 11.0 - u * (1.0 / 13.0 - u * (1.0 / 15.0 - u / 17.0)))
        rest = 1.0 / 3.0 - u * (0.2 - u * (1.0 / 7.0 - u * rest))
        turn[k] = near[k] + 2.0 * h * (1.0 - u * rest)
    for k in range(lanes):
        if not (abs(t[k]) <= NEAR and abs(near[k]) <= FOREMOST):
            turn[k] = math.atan2(y[k], x[k])
    # The others lie near their centre, and on the same side of 180 degrees.
    for number in range(1, numbers):
        start = number * lanes
        for k in range(lanes):
            dot[start + k] = x[k] * x[start + k] + y[k] * y[start + k]
        for k in range(lanes):
            cross[start + k] = x[k] * y[start + k] - y[k] * x[start + k]
    far = 0
    for k in range(lanes, numbers * lanes):
        t[k] = cross[k] / dot[k]
        far += (dot[k] <= 0.0) | (abs(t[k]) >= NEAREST)
    for k in range(lanes, numbers * lanes):
        u = t[k] * t[k]
        rest = 1.0 / 3.0 - u * (0.2 - u * (1.0 / 7.0 - u / 9.0))
        t[k] *= 1.0 - u * rest
    if far:
        for k in range(lanes, numbers * lanes):
            if dot[k] <= 0.0 or abs(cross[k]) >= NEAREST * dot[k]:
                t[k] = math.atan2(cross[k], dot[k])
    for number in range(1, numbers):
        for k in range(lanes):
            azimuth[number, k] = turn[k] + t[number * lanes + k]


@kernel
def weighted(image: FloatArray, centre: FloatArray, weight: FloatArray, mean: FloatArray) -> None:
    """The mean (lanes,) of an image (numbers, lanes) of sigma points, which is taken away from it.
    centre (lanes,): weight of the centre; weight (columns, lanes): of each point on a column."""
    numbers, lanes = image.shape
    for k in range(lanes):
        mean[k] = centre[k] * image[0, k]
    for column in range(len(weight)):
        number = ahead(column)
        for k in range(lanes):
            mean[k] += weight[column, k] * (image[number, k] + image[number + 1, k])
    for number in range(numbers):
        for k in range(lanes):
            image[number, k] -= mean[k]


@kernel
def product(
    first: FloatArray, other: FloatArray, centre: FloatArray, weight: FloatArray, out: FloatArray
) -> None:
    """The covariance (lanes,) of two images without their means: see `weighted`."""
    lanes = len(out)
    for k in range(lanes):
        out[k] = centre[k] * first[0, k] * other[0, k]
    for column in range(len(weight)):
        for number in range(ahead(column), ahead(column) + 2):
            for k in range(lanes):
                out[k] += weight[column, k] * first[number, k] * other[number, k]


@kernel
def beside(image: FloatArray, F: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """The covariance (lanes,) of an image with a state that stays as it is: F (columns, lanes) is
    its row of the root; weight (lanes,): of each point but the centre."""
    lanes = len(out)
    for k in range(lanes):
        out[k] = 0.0
    for column in range(len(F)):
        number = ahead(column)
        for k in range(lanes):
            out[k] += F[column, k] * (image[number, k] - image[number + 1, k])
    for k in range(lanes):
        out[k] *= weight[k]
