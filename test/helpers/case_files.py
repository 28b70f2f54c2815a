# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Small inputs with known answers for the table of cases (`test/cli/test_cases.py`)."""

from datetime import datetime, timezone
import math

import numpy as np

from msg_adapters.fixes import write_fix, write_geodetic, write_relative
from msg_adapters.navigation import write_heading, write_navigation
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import (
    Fix,
    Navigation,
    RelativeFix,
    VesselFix,
    VesselHeading,
    VesselPose,
)
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter

BEGIN = 1_756_382_400
"""2025-08-28 12:00:00 UTC."""
PLACE = Origin(43.31, 5.36, 0.0)
RECEIVERS = {
    'VR2AR-551': (0, 0),
    'VR2AR-552': (300, 10),
    'VR2AR-553': (290, 250),
    'VR2AR-554': (-10, 260),
}
EAST = np.array([0.0, 0.0, 0.0, 1.0])


def text_of(t, digits=3, pattern='%Y-%m-%d %H:%M:%S'):
    """Seconds since 1970 as text, cut off after `digits` digits."""
    whole = datetime.fromtimestamp(math.floor(t), timezone.utc).strftime(pattern)
    return whole + (f'.{int(t % 1 * 10**digits + 1e-6):0{digits}d}' if digits else '')


def swim(t):
    """The way of a diver (..., 2) at seconds after the begin."""
    t = np.asarray(t, float)
    return np.stack([20 * np.sin(t / 45) + 0.1 * t, 18 * np.cos(t / 40)], axis=-1)


def circle(t):
    """The way of a fish between the receivers."""
    t = np.asarray(t, float)
    return np.stack([140 + 70 * np.cos(t / 80), 130 + 60 * np.sin(t / 80)], axis=-1)


def heard(period=(20, 40), seconds=600, seed=1):
    """(t, receiver) of a tag, right to .1 ms, in the order of their times."""
    rng, t, found = np.random.default_rng(seed), 3.0, []
    while t < seconds:
        for name, place in RECEIVERS.items():
            way = math.dist(circle(t), place) / 1500
            found.append((BEGIN + t + way + rng.normal(scale=1e-4), name))
        t += rng.uniform(*period)
    return sorted(found)


def detections(folder, head, line, **how):
    """detections.csv of `line(k, t, receiver)`, and receivers.csv."""
    places = [f'{name},{x},{y},-3' for name, (x, y) in RECEIVERS.items()]
    (folder / 'receivers.csv').write_text('\n'.join(['receiver,x,y,z', *places]) + '\n')
    lines = [line(k, t, name) for k, (t, name) in enumerate(heard(**how))]
    (folder / 'detections.csv').write_text('\n'.join([head, *lines]) + '\n')


def fixes(folder, rows, head='time,x,y,std'):
    """fixes.csv of rows (seconds after the begin, x, y, ...)."""
    lines = [','.join([f'{text_of(BEGIN + t)}Z', *(f'{v:.4f}' for v in row)]) for t, *row in rows]
    (folder / 'fixes.csv').write_text('\n'.join([head, *lines]) + '\n')


def dive(folder, count=120, scale=1.0, std=0.8, offset=None, seed=2, step=1.0):
    """fixes.csv of one diver. offset(k): what the fix k is off by, m; scale: of the stated std."""
    rng, rows = np.random.default_rng(seed), []
    for k in range(count):
        x, y = swim(k * step) + std * rng.normal(size=2) + (np.array(offset(k)) if offset else 0)
        rows.append((k * step, x, y, scale * std))
    fixes(folder, rows)


def ns(t):
    return round((BEGIN + t) * 1e6) * 1000


def two_sensors(path, apart=5.0, count=200, seed=3):
    """A bag of fixes of two sensors in turn, of which one is `apart` off."""
    rng = np.random.default_rng(seed)
    with BagWriter(path) as bag:
        for k in range(count):
            x, y = swim(k) + 0.5 * rng.normal(size=2) + [0.0, apart * (k % 2)]
            fix = Fix(
                stamp_ns=ns(k), position=(x, y, 0.0), covariance=0.25 * np.eye(2), frame_id='map'
            )
            bag.write('/fix', write_fix(fix, ros_message), ns(k))


def seen_from(t):
    """The way of what a vessel hears, that goes east at 1 m/s."""
    return np.array([12 + 0.8 * t, 6 + 7 * math.sin(t / 18)])


def by_vessel(path, nav, count=80, seed=4):
    """A bag of relative fixes of a vessel with the bow east; nav(bag, k) writes its pose."""
    rng = np.random.default_rng(seed)
    with BagWriter(path) as bag:
        for k in range(count):
            nav(bag, k)
            if k:
                t = k - 0.5
                offset = (*(seen_from(t) - [t, 0] + 0.3 * rng.normal(size=2)), -4.0)
                fix = RelativeFix(
                    stamp_ns=ns(t), offset=offset, covariance=0.09 * np.eye(3), frame_id='usbl'
                )
                bag.write('/relative', write_relative(fix, ros_message), ns(t))


def odometry(variances):
    """nav of `by_vessel`: exact poses that state these variances of roll, pitch and yaw, rad^2."""

    def nav(bag, k):
        pose = VesselPose(
            stamp_ns=ns(k), position=[float(k), 0.0, 0.0], orientation=EAST, frame_id='odom'
        )
        message = write_navigation(pose, ros_message)
        message.pose.covariance[:] = np.diag([0.25, 0.25, 0.25, *variances]).ravel()
        bag.write('/nav', message, ns(k))

    return nav


def satellite(every):
    """nav of `by_vessel`: places on Earth, each `every`-th at 0, 0 with a fix, and the heading."""

    def nav(bag, k):
        latitude, longitude, _ = (
            (0.0, 0.0, 0.0)
            if k % every == every // 2
            else PLACE.geodetic(np.array([float(k), 0.0, 0.0]))
        )
        fix = VesselFix(
            stamp_ns=ns(k), latitude=float(latitude), longitude=float(longitude), frame_id='gps'
        )
        bag.write('/nav_fix', write_geodetic(fix, ros_message), ns(k))
        heading = VesselHeading(stamp_ns=ns(k), orientation=EAST, frame_id='vessel')
        bag.write('/heading', write_heading(heading, ros_message), ns(k))

    return nav


OBSTACLE = np.array([22.0, 4.0])
"""In the frame of the odometry, m."""


def swim_past(bag, seconds, turning=0.0):
    """/odom at 10 Hz of a vehicle at .5 m/s that looks to and fro by `turning`, rad; gives where
    it sees the obstacle at t: range and bearing."""

    def pose(t):
        return 0.5 * t, turning * math.sin(t / 8)

    for k in range(10 * seconds):
        x, yaw = pose(k / 10)
        odometry = Navigation(
            stamp_ns=ns(k / 10),
            position=(x, 0.0, -5.0),
            orientation=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
            velocity=(0.5 * math.cos(yaw), -0.5 * math.sin(yaw), 0.0),
            turn_rate=(0.0, 0.0, turning / 8 * math.cos(k / 80)),
            frame_id='odom',
            child_frame_id='base_link',
        )
        bag.write('/odom', write_navigation(odometry, ros_message), ns(k / 10))

    def seen(t):
        x, yaw = pose(t)
        dx, dy = OBSTACLE - [x, 0.0]
        return math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - yaw, 2 * math.pi)

    return seen


def slow_scan(path, sweep, turning, beams=360, seed=18):
    """A bag of a sonar that turns once in `sweep` s: a LaserScan stamped at its first beam."""
    rng, step = np.random.default_rng(seed), 2 * math.pi / beams
    with BagWriter(path) as bag:
        seen, t = swim_past(bag, 90, turning), 0.2
        while t + sweep < 89:
            ranges = np.full(beams, np.inf, np.float32)
            for k in range(beams):
                distance, bearing = seen(t + k / beams * sweep)
                if abs(bearing + math.pi - k * step) < step / 2:
                    ranges[k] = distance + 0.1 * rng.normal()
            scan = ros_message(
                'sensor_msgs/msg/LaserScan', header=header(t, 'sonar'), angle_min=-math.pi,
                angle_max=math.pi - step, angle_increment=step, time_increment=sweep / beams,
                scan_time=sweep, range_min=0.75, range_max=50.0, ranges=ranges,
                intensities=np.where(np.isinf(ranges), 0, 200).astype(np.float32),
            )  # fmt: skip
            bag.write('/scan', scan, ns(t + sweep))
            t += sweep


def pictures(path, sector_deg, seconds=20, rows=160, far=40.0, seed=19):
    """A bag of pictures at 2 Hz of a sonar's fan as on a screen, whose lower corners are dark."""
    rng, half = np.random.default_rng(seed), math.radians(sector_deg / 2)
    width = int(2 * rows * math.sin(half))
    v, u = np.mgrid[:rows, :width]
    ahead, port = (rows - v) / rows * far, (width / 2 - u) / rows * far
    dark = (np.hypot(ahead, port) > far) | (abs(np.arctan2(port, ahead)) > half)
    with BagWriter(path) as bag:
        seen = swim_past(bag, seconds)
        for k in range(2 * seconds):
            distance, bearing = seen(k / 2)
            away = np.hypot(
                ahead - distance * math.cos(bearing), port - distance * math.sin(bearing)
            )
            pixels = rng.rayleigh(12, dark.shape) + 230 * np.exp(-((away / 0.4) ** 2))
            image = ros_message(
                'sensor_msgs/msg/Image', header=header(k / 2, 'sonar'), height=rows, width=width,
                encoding='mono8', is_bigendian=0, step=width,
                data=np.clip(np.where(dark, 0, pixels), 0, 255).astype(np.uint8).ravel(),
            )  # fmt: skip
            bag.write('/sonar/image', image, ns(k / 2))


def header(t, frame_id):
    seconds, nanoseconds = divmod(ns(t), 10**9)
    stamp = ros_message('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)
    return ros_message('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)
