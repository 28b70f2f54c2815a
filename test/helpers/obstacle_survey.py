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

"""A vehicle that comes by the same obstacles again and again, for the tests of memory."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Altitude, Detections, Navigation

SECOND = 10**9
DEPTH = 20.0
RADIUS = 12.0
SPEED = 1.5


class Ping(NamedTuple):
    """A ping: in which pass, which of the obstacles gave an echo, (n,), and where the navigation
    of that moment has them, (n, 3) ENU."""

    stamp_ns: int
    leg: int
    seen: np.ndarray
    place: np.ndarray


def lane(length, passes):
    """Places and headings of a vehicle that goes to and fro between two parallel lines, 2 RADIUS
    apart, each `length` m long: north (n,), east (n,), heading (n,) rad, twice a second."""
    step = 0.5 * SPEED
    north, east, heading = [], [], []
    for k in range(passes):
        along = np.arange(0.0, length, step)
        out = k % 2 == 0
        north.append(along if out else length - along)
        east.append(np.full(len(along), 0.0 if out else 2.0 * RADIUS))
        heading.append(np.full(len(along), 0.0 if out else np.pi))
        turn = np.arange(0.0, np.pi, step / RADIUS)
        side = 1.0 if out else -1.0
        north.append((length if out else 0.0) + side * RADIUS * np.sin(turn))
        east.append(RADIUS - side * RADIUS * np.cos(turn))
        heading.append(turn + (0.0 if out else np.pi))
    return np.concatenate(north), np.concatenate(east), np.unwrap(np.concatenate(heading))


def survey(
    obstacles,
    seed,
    *,
    length=120.0,
    passes=3,
    drift=0.01,
    yaw_drift_deg=0.02,
    clutter=0.2,
    P_D=0.9,
):
    """Measurements of a survey over obstacles (n, 3) NED, and its pings."""
    rng = np.random.default_rng(seed)
    north, east, heading = lane(length, passes)
    n = len(north)
    t = 0.5 * np.arange(n)
    wave = [np.sin(2.0 * np.pi * t / period + rng.uniform(0, 6)) for period in (6.0, 8.0, 20.0)]
    roll, pitch, heave = np.radians(2.1) * wave[0], np.radians(1.4) * wave[1], 0.3 * wave[2]
    position = np.column_stack([north, east, DEPTH + heave])
    R = geometry.rotation(roll, pitch, heading)
    walk = np.sqrt(0.5) * drift * rng.normal(size=(n, 2)).cumsum(axis=0)
    turned = np.radians(yaw_drift_deg) * np.sqrt(0.5) * rng.normal(size=n).cumsum()
    seen_R = geometry.rotation(roll, pitch, heading + turned)
    seen_at = position + np.column_stack([walk, np.zeros(n)])
    q = Rotation.from_matrix(geometry.flip_rotation(seen_R)).as_quat()
    leg = _pass_of(length, passes)
    measurements, pings = [], []
    for k in range(n):
        stamp = (k + 2) * SECOND // 2
        measurements.append(Altitude(stamp_ns=stamp, altitude=10.0 - heave[k]))
        measurements.append(
            Navigation(
                stamp_ns=stamp,
                position=geometry.flip_world(seen_at[k]),
                orientation=q[k],
                frame_id='odom',
            )
        )
        m = geometry.to_body(geometry.Pose(position[k], R[k]), np.asarray(obstacles))
        d, azimuth = geometry.project(m)
        inside = (np.abs(azimuth) < np.radians(22.5)) & (d < 60.0) & (m[:, 0] > 0.0)
        inside &= np.abs(np.arcsin(m[:, 2] / d)) < np.radians(7.5)
        inside &= rng.uniform(size=len(d)) < P_D
        z = np.column_stack([d, azimuth])[inside]
        z = z + [0.15, np.radians(0.25)] * rng.normal(size=z.shape)
        false = rng.poisson(clutter)
        other = rng.uniform([1.0, -np.radians(22.5)], [60.0, np.radians(22.5)], (false, 2))
        z = np.vstack([z, other])
        measurements.append(Detections(stamp_ns=stamp, range=z[:, 0], bearing=-z[:, 1]))
        away = np.asarray(obstacles) - position[k]
        there = seen_at[k] + away @ (seen_R[k] @ R[k].T).T
        pings.append(Ping(stamp, int(leg[k]), inside, geometry.flip_world(there)))
    return measurements, pings


def _pass_of(length, passes):
    step = 0.5 * SPEED
    straight, turn = (
        len(np.arange(0.0, end, step * s)) for end, s in ((length, 1.0), (np.pi, 1.0 / RADIUS))
    )
    return np.repeat(np.arange(passes), straight + turn)
