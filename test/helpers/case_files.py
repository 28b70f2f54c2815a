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
from sonar_imm.measurements import Fix, RelativeFix, VesselFix, VesselHeading, VesselPose
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
