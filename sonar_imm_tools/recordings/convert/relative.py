# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""CSV tables of positions relative to a vessel, whose pose stands in the same row."""

from __future__ import annotations

from collections.abc import Callable
import math
from pathlib import Path
import re
from typing import Any, NamedTuple

from attrs import evolve
import numpy as np

from msg_adapters.arrivals import FARTHEST
from msg_adapters.fixes import write_geodetic, write_relative
from msg_adapters.inputs.topic import tag_numbers
from msg_adapters.navigation import write_heading, write_navigation
from msg_adapters.scans import write_scan
from sonar_imm.measurements import Fixes, RelativeFix, VesselFix, VesselHeading, VesselPose

from ..conversion import ConversionReport, converter, Leaps, Record, write_bag
from ..convert_options import RelativeOptions
from ..csv_table import CsvTable
from ..messages import ros_message
from ..places import (
    ask_for_angle,
    bearings_from,
    checked_origin,
    Degrees,
    origin_parameters,
    PolarRows,
)
from ..sources import BagError
from ..tables import Row
from ..times import BadRow
from ..truth import truth_records
from .fixes import by_name

TRANSCEIVER = 'transceiver'
"""Frame of a position that does not say whose it is."""


class _Parsed(NamedTuple):
    """A row: topic, writer and measurement of each part of the vessel's pose; the position, None
    for an empty scan; whose it is."""

    stamp_ns: int
    pose: list[tuple[str, Callable[..., Any], Any]]
    fix: RelativeFix | None
    name: str


@converter(RelativeOptions)
def convert_relative(path: Path, how: RelativeOptions, report: ConversionReport) -> None:
    """Convert a CSV of positions relative to a vessel to ``/relative``, in a frame of the name
    where ``id`` says whose they are, and the vessel to ``/nav``, or ``/nav_fix`` and ``/heading``.

    Columns and values: as in `RelativeOptions`. The tracker composes them as it does live; what it
    has to know (``tags``, ``relative_axes``, the origin) is in ``parameters.yaml`` beside the bag.
    Rows with the same stamp share the pose of the first of them. Raises `BagError`.
    """
    table = CsvTable(path, how.options)
    table.require('stamp')
    geodetic = table.has('vessel_latitude', 'vessel_longitude')
    if not geodetic:
        table.require('vessel_x', 'vessel_y')
    degrees = Degrees(table, 'vessel_') if geodetic else None
    polar = None
    if not table.has('forward', 'starboard'):
        across = table.has('forward') or table.has('starboard')
        table.require(*(('forward', 'starboard') if across else ('range', 'bearing')))
        bearings = bearings_from(table, how.bearings, 'bow')
        polar = PolarRows(table, bearings, how.range_std, how.bearing_std_deg, how.ranges)
    levelled = polar is not None and bearings != 'bow'
    if not levelled and not table.has('heading'):
        left = [
            header
            for k, header in enumerate(table.headers)
            if k not in table.index.values() and table.first_numbers(k, 1.0)
        ]
        raise BagError(
            f'{table.path} has no column for heading, and bearings count from the bow; not used '
            f'are {", ".join(left) or "no columns of numbers"}. If one of them is the heading: '
            f"--column 'heading={left[0] if left else 'HEADER'}'. If bearings count from north: "
            '--bearings north'
        )
    place = ('range', 'bearing') if polar else ('forward', 'starboard')

    headings: list[float] = []

    def parse(row: Row) -> _Parsed:
        row.require_valid()
        headings.append(row.optional('heading'))
        stamp_ns, name = row.stamp_ns(), row.text('id')
        pose = _pose(row, stamp_ns, degrees, levelled, how.frame_id)
        if row.empty(*place):
            if name:
                raise BadRow(f'{name} has no position')
            return _Parsed(stamp_ns, pose, None, name)
        if polar:
            flat, covariance = polar.place(row)
        else:
            flat, covariance = np.array([row.number('forward'), -row.number('starboard')]), None
        std = row.optional('std')
        if covariance is None and std > 0.0:
            covariance = std**2 * np.eye(2)
        offset = np.append(flat, row.height())
        fix = RelativeFix(stamp_ns=stamp_ns, offset=offset, covariance=_upright(covariance))
        return _Parsed(stamp_ns, pose, fix, name)

    rows = [parsed for _, parsed in report.read_rows(table, parse)]
    if polar:
        polar.check_unit()
    if not levelled:
        ask_for_angle(table, 'heading', headings)
    leaps = Leaps()
    if geodetic:
        leaps.saw_all(row.pose[0][2] for row in rows)
    else:
        for row in rows:
            leaps.saw(row.stamp_ns, *row.pose[0][2].position[:2].tolist())
    leaps.tell(table.path, report)
    tags = {row.name: re.sub(r'[^A-Za-z0-9_]+', '_', row.name) for row in rows if row.name}
    origin = checked_origin(how.origin)
    if geodetic and rows and origin is None:
        first: VesselFix = rows[0].pose[0][2]
        origin = (first.latitude, first.longitude, 0.0)
    if geodetic and origin is not None:
        report.notes['origin'] = 'latitude {!r}, longitude {!r}, height {!r}'.format(*origin)
    records: list[Record] = []
    if any(row.fix is not None for row in rows):
        records = _poses(rows) + [_target(row, tags, how.frame_id) for row in rows]
    if empty := sum(row.fix is None for row in rows):
        report.notes['empty scans'] = (
            f'{empty} rows have a time and no position: nobody was seen then'
        )
    if how.truth is not None and records:
        records += truth_records(
            how.truth, report, how.truth_options, how.frame_id, origin if geodetic else None
        )
    known: dict[str, Any] = dict(origin_parameters(origin if geodetic else None))
    known |= {'relative_axes': 'enu' if levelled else 'flu', 'frame_id': how.frame_id}
    if tags:
        known['tags'] = list(dict.fromkeys(tags.values()))
        numbers = tag_numbers(known['tags'])
        report.target_names = {name: numbers[tag] for name, tag in tags.items()}
    streams = by_name((row.name, row.stamp_ns) for row in rows)
    write_bag(report, records, path, how, {'diver': known}, streams)


def _pose(
    row: Row, stamp_ns: int, degrees: Degrees | None, levelled: bool, frame_id: str
) -> list[tuple[str, Callable[..., Any], Any]]:
    """Topic, writer and measurement of each part of the vessel's pose. Raises `BadRow`."""
    heading = row.optional('heading') if levelled else row.number('heading')
    if abs(heading) > 720.0:
        raise BadRow(f'{row.table.header("heading")} is {heading:g} degrees')
    yaw = 0.5 * math.pi - math.radians(0.0 if math.isnan(heading) else heading)
    orientation = np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])
    if degrees is None:
        position = np.array([row.number('vessel_x'), row.number('vessel_y'), 0.0])
        if np.abs(position).max() > FARTHEST:
            raise BadRow(f'the vessel at {position[0]:g}, {position[1]:g} is not on Earth')
        pose = VesselPose(
            stamp_ns=stamp_ns, position=position, orientation=orientation, frame_id=frame_id
        )
        return [('/nav', write_navigation, pose)]
    latitude, longitude = degrees.place(row)
    where = VesselFix(stamp_ns=stamp_ns, latitude=latitude, longitude=longitude, frame_id='gps')
    lies = VesselHeading(stamp_ns=stamp_ns, orientation=orientation, frame_id='vessel')
    return [('/nav_fix', write_geodetic, where), ('/heading', write_heading, lies)]


def _upright(covariance: np.ndarray | None) -> np.ndarray | None:
    """(3, 3) of a covariance (2, 2) in the plane; up as uncertain as the worst direction in it."""
    if covariance is None:
        return None
    whole = np.zeros((3, 3))
    whole[:2, :2] = covariance
    whole[2, 2] = np.linalg.eigvalsh(covariance)[1]
    return whole


def _poses(rows: list[_Parsed]) -> list[Record]:
    """One pose for each stamp, the first; poses go before what is measured from them."""
    poses = {row.stamp_ns: row.pose for row in reversed(rows)}
    return [
        (stamp_ns, topic, write(measurement, ros_message))
        for stamp_ns, pose in poses.items()
        for topic, write, measurement in pose
    ]


def _target(row: _Parsed, tags: dict[str, str], frame_id: str) -> Record:
    """The position of a row, or the scan in which nobody was seen."""
    if row.fix is None:
        nobody = Fixes(stamp_ns=row.stamp_ns, position=np.empty((0, 3)), frame_id=frame_id)
        return row.stamp_ns, '/fixes', write_scan(nobody, ros_message)
    fix = evolve(row.fix, frame_id=tags.get(row.name, TRANSCEIVER))
    return row.stamp_ns, '/relative', write_relative(fix, ros_message)
