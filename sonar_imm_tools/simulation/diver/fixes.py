# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers as fixes: in scans with clutter, from a vessel, or in latitude and longitude.

In the motion `crossing` each pair meets near the middle of the scene: straight paths at an angle
of 20 to 90 degrees, .5 to .9 m/s, that pass each other within a metre about half way through. The
sensor `scans` gives one `Fixes` for each scan, also an empty one. `usbl` is a transceiver under a
vessel that circles the scene: range and direction of each diver in the axes of the transceiver,
with the diver's number, and the vessel's pose between two scans, with white errors that it states.
`geodetic` gives positions in latitude and longitude around `ORIGIN`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random import Generator

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Fixes, GeodeticFix, RelativeFix, VesselPose

ANGLE = np.deg2rad([20.0, 90.0])
CROSSING_SPEED = (0.5, 0.9)
CLOSEST = 1.0
MEETING = (0.46, 0.58)
"""When a pair is closest, in lengths of the scene."""
MIDDLE = 20.0
"""Metres from the origin, on each axis, within which pairs meet."""


def crossing_paths(divers: int, times: FloatArray, rng: Generator) -> list[FloatArray]:
    """States (n, 4), px py vx vy, of `divers` at `times`; with an odd number the last one swims
    as if it had met a partner."""
    paths: list[FloatArray] = []
    for _ in range((divers + 1) // 2):
        meeting = rng.uniform(*MEETING) * times[-1]
        place = rng.uniform(-MIDDLE, MIDDLE, 2)
        heading = rng.uniform(0.0, 2.0 * np.pi)
        between = rng.uniform(*ANGLE) * rng.choice([-1.0, 1.0])
        side = rng.uniform(0.0, 2.0 * np.pi)
        apart = rng.uniform(0.0, CLOSEST) * np.array([np.cos(side), np.sin(side)])
        for angle, start in ((heading, place), (heading + between, place + apart)):
            velocity = rng.uniform(*CROSSING_SPEED) * np.array([np.cos(angle), np.sin(angle)])
            position = start + (times - meeting)[:, None] * velocity
            paths.append(np.hstack([position, np.tile(velocity, (len(times), 1))]))
    return paths[:divers]


def sense_scan(scan: Any) -> list[Fixes]:
    """All fixes of one scan, a `Scan` of the simulator, in no particular order: of the divers that
    are there, and false ones in the square."""
    rng, half, std = scan.rng, scan.config.clutter_range, scan.config.fix_std
    seen = scan.seen()[:, :2]
    false = rng.uniform(-half, half, (rng.poisson(scan.config.clutter), 2))
    points = rng.permutation(np.vstack([seen + std * rng.normal(size=seen.shape), false]))
    return [
        Fixes(
            stamp_ns=scan.stamp_ns,
            position=np.column_stack([points, np.zeros(len(points))]),
            covariance=np.tile(std**2 * np.eye(2), (len(points), 1, 1)),
            frame_id='map',
        )
    ]


def instruments_of_scans(config: Any) -> dict[str, float]:
    """What a user knows of such a sensor, by the names of the tracker's parameters."""
    return {
        'clutter_density': max(config.clutter, 1e-3) / (2.0 * config.clutter_range) ** 2,
        'detection_probability': min(max(config.detection_probability, 0.01), 0.999),
    }


ORIGIN = Origin(59.0, 10.0)
LEVER = np.array([2.0, -1.0, -3.0])
"""From the reference of the vessel's navigation to the transceiver, metres."""
RADIUS, VESSEL_SPEED = 50.0, 1.0
"""Of the vessel's circle, m, and along it, m/s."""
_HALF_NS = 500_000_000_000
BEFORE_NS = 300_000_000
"""The pose is that much older than the scan."""
POSITION_STD, HEADING_STD_DEG, ATTITUDE_STD_DEG = 0.3, 1.0, 0.3


def instruments_of_places(config: Any) -> dict[str, Any]:
    """What a tracker has to know of these sensors."""
    if config.sensor == 'geodetic':
        return {'origin': (ORIGIN.latitude, ORIGIN.longitude, 0.0)}
    return {
        'tags': tuple(f'diver_{number}' for number in range(1, config.divers + 1)),
        'transceiver_lever': tuple(LEVER.tolist()),
        'relative_range_std': config.range_std,
        'relative_angle_std_deg': config.bearing_std_deg,
    }


def namespace_of(measurement: Any) -> str:
    """A topic for each diver with a transponder: their message has no room for the number."""
    return f'diver_{measurement.target_id}' if isinstance(measurement, RelativeFix) else ''


def vessel_at(stamp_ns: int) -> tuple[FloatArray, FloatArray]:
    """Position (3,) and roll, pitch, yaw (3,) of the vessel, in a light swell."""
    seconds = (stamp_ns + _HALF_NS) % (2 * _HALF_NS) * 1e-9 - _HALF_NS * 1e-9
    angle = VESSEL_SPEED * seconds / RADIUS
    place = RADIUS * np.array([np.cos(angle), np.sin(angle), 0.0])
    roll, pitch = 0.05 * np.sin(seconds), 0.03 * np.sin(0.7 * seconds)
    return place, np.array([roll, pitch, angle + 0.5 * np.pi])


def sense_from_vessel(scan: Any) -> list[VesselPose | RelativeFix]:
    """The pose of the vessel a moment before the scan, and each diver that is heard."""
    config, rng, stamp_ns = scan.config, scan.rng, scan.stamp_ns
    pose_ns = stamp_ns - BEFORE_NS
    place, attitude = vessel_at(pose_ns)
    std = np.radians([ATTITUDE_STD_DEG, ATTITUDE_STD_DEG, HEADING_STD_DEG])
    wrong = attitude + std * rng.normal(size=3)
    measured: list[VesselPose | RelativeFix] = [
        VesselPose(
            stamp_ns=pose_ns,
            position=place + POSITION_STD * rng.normal(size=3),
            orientation=geometry.quaternion(*wrong),
            pose_covariance=np.diag([*[POSITION_STD**2] * 3, *std**2]),
            frame_id='map',
        )
    ]
    place, attitude = vessel_at(stamp_ns)
    R = geometry.rotation(*attitude)
    for number, diver in enumerate(scan.present, start=1):
        if rng.uniform() >= config.detection_probability:
            continue
        seen = geometry.rotation(0.0, 0.0, scan.errors.bearing) @ (R.T @ (diver - place) - LEVER)
        bent = np.radians(config.bearing_std_deg) * rng.normal(size=3)
        distance = float(np.linalg.norm(seen))
        turned = seen + np.cross(bent, seen)
        turned *= (distance + config.range_std * rng.normal()) / np.linalg.norm(turned)
        measured.append(
            RelativeFix(stamp_ns=stamp_ns, offset=turned, target_id=number, frame_id='usbl')
        )
    return measured


def sense_geodetic(scan: Any) -> list[GeodeticFix]:
    """Positions with a white error, in latitude and longitude."""
    fixes, std = [], scan.config.fix_std
    for diver in scan.present:
        if scan.rng.uniform() >= scan.config.detection_probability:
            continue
        where = diver + np.append(std * scan.rng.normal(size=2), 0.0)
        latitude, longitude, height = ORIGIN.geodetic(where).tolist()
        fixes.append(
            GeodeticFix(
                stamp_ns=scan.stamp_ns,
                latitude=latitude,
                longitude=longitude,
                height=height,
                covariance=np.diag([std**2, std**2, 1.0]),
                frame_id='gps',
            )
        )
    return fixes
