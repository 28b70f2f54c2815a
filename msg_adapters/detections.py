# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a forward-looking sonar detected in one ping, from every message that says so.

Our own message is a table with one row per echo and one message per ping. A ping in which nothing
was seen is a table without rows, because a miss is evidence too. Columns: ``x y z`` f4 [m, for
display]; ``range`` [m], ``bearing`` [rad, REP-103: positive to port]; optional ``var_range``,
``var_bearing``, ``intensity``, ``extent_range``, ``extent_bearing``, ``elevation`` [rad, positive
up], ``var_elevation``, ``time_offset`` [s after the stamp]. A table without range and bearing is
read from x, y, z, of which z says no elevation: flat sonars send 0.

The other messages use different axes; the rules are these. In the messages of
marine_acoustic_msgs receive angles count to starboard, and beams point along z with x up and y to
starboard; some drivers and simulators publish beams with x forward and y to port all the same
(`beam_axes`).

A sender that counts bearings to the other side than its message says is read with
`bearing_positive` ``'starboard'``, which turns round what the rules above give.

Ranges and bearings that are not finite (REP-117: too near, nothing there, error) are dropped, so
that the length of the result may be smaller than that of the message.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import (
    BEAM_AXES,
    Detections,
    LONGEST_SCAN,
    nanoseconds,
    OPTIONAL_COLUMNS,
    Rejection,
)

from .headers import head_of, Make, places_of
from .table import decode_table, require_columns, scalar_column, table_of

MAX_DETECTIONS = 10_000
COLUMNS = ('x', 'y', 'z', 'range', 'bearing', *OPTIONAL_COLUMNS)
SOUND_SPEEDS = (1300.0, 1700.0)
"""m/s; outside, the field was not filled in or is something else."""
NEAREST, FARTHEST = 0.01, 1e4
"""Metres: no echo comes from nearer or farther."""
UNTIMED = 0.3
"""Seconds from which it matters that the rays of a scan have no times."""
BEARING_SIDES = ('port', 'starboard')
LEAST_VARIANCE, MOST_VARIANCE = 1e-12, 1e6
"""A stated variance outside is a field that was not filled in."""


def read_detections(message: Any, *, bearing_positive: str = 'port', **_: Any) -> Detections:
    """Read a table of detections; with no row it is a ping in which nothing was seen.

    Raises `Rejection`.
    """
    columns = decode_table(message, COLUMNS, most_rows=MAX_DETECTIONS)
    if 'range' in columns or 'bearing' in columns:
        require_columns(columns, ('range', 'bearing'), 'detections')
        distance, bearing = scalar_column(columns, 'range'), scalar_column(columns, 'bearing')
    elif columns or message.height * message.width:
        require_columns(columns, ('x', 'y', 'z'), 'detections')
        distance, bearing = _polar(*(scalar_column(columns, name) for name in 'xyz'))
    else:
        distance = bearing = np.empty(0)
    optional: dict[str, Any] = {
        name: scalar_column(columns, name) for name in OPTIONAL_COLUMNS if name in columns
    }
    for name in ('var_range', 'var_bearing', 'var_elevation'):
        if name in optional:
            optional[name] = _variances(optional[name])
    return _detections(message, distance, bearing, bearing_positive, **optional)


def read_pose_array(message: Any, *, bearing_positive: str = 'port', **_: Any) -> Detections:
    """Read a PoseArray: positions in the sonar's frame, x forward, y to port, z up."""
    places = places_of(pose.position for pose in message.poses)
    return _detections(message, *_polar(*places.T), bearing_positive)


def read_point_cloud(message: Any, *, bearing_positive: str = 'port', **_: Any) -> Detections:
    """Read a sensor_msgs/PointCloud, the older of the two, as drivers of scanning sonars publish:
    points in the sonar's frame, x forward, y to port; a channel called intensity, or one whose
    name begins so, has their strength. Raises `Rejection`."""
    if len(message.points) > MAX_DETECTIONS:
        raise Rejection(
            'too_large',
            f'a ping of {len(message.points)} detections; at most {MAX_DETECTIONS} are read',
        )
    places = np.array([[p.x, p.y, p.z] for p in message.points], np.float64).reshape(-1, 3)
    found = [
        np.array(channel.values, np.float64)
        for channel in message.channels
        if str(channel.name).lower().startswith('intensit')
        and len(channel.values) == len(message.points)
    ]
    extra: dict[str, Any] = {'intensity': found[0]} if found else {}
    return _detections(message, *_polar(*places.T), bearing_positive, **extra)


def read_detections_3d(message: Any, *, bearing_positive: str = 'port', **_: Any) -> Detections:
    """Read a vision_msgs/Detection3DArray: centres of boxes in the sonar's frame, x forward, y to
    port, z up, each of which has an elevation.

    Variances are those of the covariance of the first hypothesis, where it states one; intensity
    is its score. A box whose centre is nowhere (all 0) is where that hypothesis has it.
    """
    places, covariances, scores = [], [], []
    for detection in message.detections:
        best = detection.results[0] if len(detection.results) else None
        centre = detection.bbox.center.position
        if best is not None and not (centre.x or centre.y or centre.z):
            centre = best.pose.pose.position
        own = np.zeros(36) if best is None else np.asarray(best.pose.covariance, np.float64)
        places.append(centre)
        covariances.append(own.reshape(6, 6)[:3, :3])
        scores.append(np.nan if best is None else float(best.hypothesis.score))
    m, C = places_of(places), np.array(covariances).reshape(-1, 3, 3)
    distance, bearing = _polar(*m.T)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        level = np.hypot(m[:, 0], m[:, 1])
        elevation = np.arctan2(m[:, 2], level)
        along = m / distance[:, None]
        aside = np.column_stack([-np.sin(bearing), np.cos(bearing), np.zeros(len(m))])
        variances = [_along(axis, C) for axis in (along, aside, np.cross(along, aside))]
        scales: list[FloatArray] = [np.ones(len(m)), level**2, distance**2]
        stated: list[Any] = [_variances(v / scale) for v, scale in zip(variances, scales)]
    return _detections(
        message,
        distance,
        bearing,
        bearing_positive,
        elevation=elevation,
        intensity=np.array(scores, np.float64),
        **dict(zip(('var_range', 'var_bearing', 'var_elevation'), stated)),
    )


def read_laser_scan(message: Any, *, bearing_positive: str = 'port', **_: Any) -> Detections:
    """Read a LaserScan: an echo for each range inside its limits; angles count to port. Its stamp
    is that of the first ray; where it states a `time_increment`, each ray has its own time, and
    the stamp becomes that of the last one."""
    distance: FloatArray = np.array(message.ranges, np.float64)
    with np.errstate(invalid='ignore'):  # a step that is not finite leaves no bearing
        steps = np.arange(len(distance), dtype=np.float64)
        bearing = float(message.angle_min) + float(message.angle_increment) * steps
    inside = (distance >= message.range_min) & (distance <= message.range_max)
    intensity = np.array(message.intensities, np.float64)
    if len(intensity) != len(distance):
        intensity = np.full(len(distance), np.nan)
    distance = np.where(inside, distance, np.nan)
    step, period = float(message.time_increment), float(message.scan_time)
    takes = step * max(len(distance) - 1, 0)
    if not (np.isfinite(takes) and takes > 0.0):
        untimed = period if UNTIMED < period <= LONGEST_SCAN else 0.0
        return _detections(
            message, distance, bearing, bearing_positive, intensity=intensity, untimed=untimed
        )
    if takes > LONGEST_SCAN:
        raise Rejection(
            'out_of_range', f'a scan of {takes:g} s; at most {LONGEST_SCAN:g} s are read'
        )
    late = step * steps - takes
    return _detections(
        message, distance, bearing, bearing_positive, takes, intensity=intensity, time_offset=late
    )


def read_sonar_ranges(
    message: Any, *, beam_axes: str = 'auto', bearing_positive: str = 'port', **_: Any
) -> Detections:
    """Read a SonarRanges: ranges along unit vectors whose axes are `beam_axes`.

    ``'marine'``: z forward, x up, y to starboard, as the message defines; ``'rep103'``: x forward,
    y to port; ``'auto'``: forward is the one of x and z along which the beams point more.
    """
    distance = np.array(message.ranges, np.float64)
    beams = places_of(message.beam_unit_vec)
    if len(beams) != len(distance):
        raise Rejection(
            'bad_shape', f'SonarRanges has {len(distance)} ranges and {len(beams)} beams'
        )
    return _detections(
        message,
        _good(distance, message.flags),
        beam_bearings(beams, beam_axes),
        bearing_positive,
        intensity=_one_each(message.intensities, len(distance), 'intensities'),
    )


def read_sonar_detections(
    message: Any, *, sound_speed: float = 1500.0, bearing_positive: str = 'port', **_: Any
) -> Detections:
    """Read a SonarDetections: two-way travel times and receive angles, starboard positive.

    The speed of sound is that of the message, `sound_speed` [m/s] where it states none. The stamp
    is that of the transmission, so a beam's transmit delay changes nothing of its range.
    """
    times = np.array(message.two_way_travel_times, np.float64)
    angles = _one_each(message.rx_angles, len(times), 'rx_angles')
    stated = float(message.ping_info.sound_speed)
    speed = stated if SOUND_SPEEDS[0] <= stated <= SOUND_SPEEDS[1] else sound_speed
    return _detections(
        message,
        _good(0.5 * speed * times, message.flags),
        -angles,
        bearing_positive,
        intensity=_one_each(message.intensities, len(times), 'intensities'),
    )


def write_detections(detections: Detections, make: Make) -> Any:
    """Write our table, with z = 0 for display; optional columns only when something is known."""
    distance, bearing = detections.range, detections.bearing
    columns: dict[str, NDArray] = {
        'x': (distance * np.cos(bearing)).astype(np.float32),
        'y': (distance * np.sin(bearing)).astype(np.float32),
        'z': np.zeros(len(distance), np.float32),
        'range': distance,
        'bearing': bearing,
    }
    for name in OPTIONAL_COLUMNS:
        values = getattr(detections, name)
        if np.isfinite(values).any():
            columns[name] = values.astype(np.float32)
    return table_of(detections, columns, make)


def beam_bearings(beams: FloatArray, beam_axes: str) -> FloatArray:
    """Bearings (n,), positive to port, of unit vectors (n, 3); see `read_sonar_ranges`."""
    if beam_axes not in BEAM_AXES:
        raise ValueError(f"beam_axes must be one of {', '.join(BEAM_AXES)}, got '{beam_axes}'")
    x, y, z = beams.T
    if beam_axes == 'auto':
        finite = np.isfinite(beams).all(axis=1)
        beam_axes = 'marine' if z[finite].sum() >= x[finite].sum() else 'rep103'
    return np.arctan2(-y, z) if beam_axes == 'marine' else np.arctan2(y, x)


def _detections(
    message: Any,
    distance: FloatArray,
    bearing: FloatArray,
    bearing_positive: str,
    takes: float = 0.0,
    *,
    untimed: float = 0.0,
    **optional: Any,
) -> Detections:
    """Put columns (n,) together, without the rows that are no echo; takes: s by which the scan
    ends later than its message is stamped; untimed: see `Detections`."""
    if bearing_positive not in BEARING_SIDES:
        raise ValueError(
            f"bearing_positive must be one of {', '.join(BEARING_SIDES)}, got '{bearing_positive}'"
        )
    if len(distance) > MAX_DETECTIONS:
        raise Rejection(
            'too_large', f'a ping of {len(distance)} detections; at most {MAX_DETECTIONS} are read'
        )
    seen = np.abs(bearing[np.isfinite(bearing)])
    if len(seen) and seen.max() > 2.0 * np.pi:
        raise Rejection(
            'out_of_range',
            f'detections: a bearing of {seen.max():g} is beyond 2 pi; bearings are in radians',
        )
    far = distance[np.isfinite(distance)]
    if len(far) and far.min() > FARTHEST:
        raise Rejection(
            'out_of_range',
            f'detections: all ranges are beyond {FARTHEST:g}, from {far.min():g} on; '
            'ranges are in metres',
        )
    keep = np.isfinite(distance) & np.isfinite(bearing) & (distance >= NEAREST)
    keep &= distance <= FARTHEST
    head = head_of(message)
    head['stamp_ns'] += nanoseconds(takes)
    return Detections(
        **head,
        range=distance[keep],
        bearing=bearing[keep] if bearing_positive == 'port' else -bearing[keep],
        untimed=untimed,
        **{name: column[keep] for name, column in optional.items()},
    )


def _polar(x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    with np.errstate(over='ignore', invalid='ignore'):
        return np.sqrt(x**2 + y**2 + z**2), np.arctan2(y, x)


def _along(axis: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variance (n,) along unit vectors (n, 3) of covariances (n, 3, 3)."""
    return np.asarray(np.einsum('ni,nij,nj->n', axis, covariance, axis))


def _variances(values: FloatArray) -> FloatArray:
    return np.where((values >= LEAST_VARIANCE) & (values <= MOST_VARIANCE), values, np.nan)


def _good(distance: FloatArray, flags: Any) -> FloatArray:
    """NaN for detections whose flag is not OK; without flags all are good."""
    given = [int(flag.flag) for flag in flags]
    if not given:
        return distance
    marks = _one_each(given, len(distance), 'flags')
    return np.where(marks == 0, distance, np.nan)


def _one_each(values: ArrayLike, count: int, name: str) -> FloatArray:
    """(count,) of an array that is empty (unknown), of length one (the same for all) or full."""
    array = np.array(values, np.float64).ravel()
    if len(array) == count:
        return array
    if len(array) > 1:
        raise Rejection('bad_shape', f'{name} has {len(array)} values for {count} detections')
    return np.full(count, array[0] if len(array) else np.nan)
