# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of position fixes, on their own or relative to a vessel whose pose stands in the same
row. Both kinds of table are read, checked and grouped alike, and therefore stand here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
import math
from pathlib import Path
import re
from typing import Any, NamedTuple

from attrs import evolve
import numpy as np

from msg_adapters.arrivals import FARTHEST
from msg_adapters.fixes import check_size, write_fix, write_geodetic, write_relative
from msg_adapters.inputs.topic import tag_numbers
from msg_adapters.navigation import write_heading, write_navigation
from msg_adapters.scans import write_scan
from sonar_imm.intake import RepeatFilter
from sonar_imm.measurements import (
    Fix,
    Fixes,
    NOBODY,
    Rejection,
    RelativeFix,
    VesselFix,
    VesselHeading,
    VesselPose,
)

from ... import SECOND
from ..columns import is_of_vessel, name_of, rank_of, UNRELATED
from ..conversion import ask_for_units, ConversionReport, converter, Leaps, Record, write_bag
from ..convert_options import FixesOptions, RelativeOptions
from ..messages import ros_message
from ..places import (
    ask_for_angle,
    bearings_from,
    checked_origin,
    Degrees,
    LocalFrame,
    origin_parameters,
    PolarRows,
)
from ..sources import BagError, quoted
from ..table_files import CsvTable, open_table
from ..tables import Row, Table
from ..times import BadRow
from ..truth import number_names, truth_records

REPEAT_TIME = 5.0
"""Seconds within which the same position is a repeated poll: the default of the tracker."""
_UNITS = (
    ('whole hours', 3600 * SECOND),
    ('whole minutes', 60 * SECOND),
    ('whole seconds', SECOND),
)
"""Resolutions of stamps, ns, the coarsest first."""


@converter(FixesOptions)
def convert_fixes(path: Path, how: FixesOptions, report: ConversionReport) -> None:
    """Convert a CSV of position fixes to the topic ``/fix``, or ``/fixes`` with identities.

    Columns as in `FixesOptions`. Of z the variance is ``var_z`` (``cov_xz cov_yz``) or ``std_z``,
    else not stated. A row with empty uncertainties becomes a fix without covariance, one with a
    time and no position an empty scan: then all rows become scans, ``/fixes``. Latitudes become
    metres around the origin, which the tracker finds in ``parameters.yaml`` beside the bag.

    Rows that ``valid`` says are not are left out and counted. Repeated polls (the same position of
    the same diver again a moment later, see `RepeatFilter`) stay, and are counted: the tracker
    leaves them out.
    """
    write_fixes(open_table(path, how.options), report, how)


def write_fixes(
    table: Table, report: ConversionReport, how: FixesOptions, beside: Sequence[Record] = ()
) -> None:
    """`convert_fixes` of a table that is open, with records `beside` its own."""
    table.require('stamp')
    polar = None
    placed = table.has('x', 'y') or table.has('latitude', 'longitude')
    if table.has('range', 'bearing') and not placed:
        if how.bearings == 'bow':
            raise BagError(
                f'{table.path}: bearings from the bow need the pose of the vessel; see '
                'sonar-imm convert relative'
            )
        if not how.bearings:
            _ask_for_vessel(table)
        bearings = bearings_from(table, how.bearings, 'north')
        polar = PolarRows(table, bearings, how.range_std, how.bearing_std_deg, how.ranges)
    elif table.has('range', 'bearing'):
        _ask_for_target(table)
    frame = None if polar else LocalFrame(table, how.origin)
    origin = frame.origin if frame else None
    place = ('latitude', 'longitude') if frame and frame.geodetic else ('x', 'y')
    place = ('range', 'bearing') if polar else place
    repeats: dict[str, RepeatFilter] = {}
    repeated: list[int] = []

    def parse(row: Row) -> tuple[int, Fix | None, str]:
        row.require_valid()
        name, stamp_ns = row.text('id'), row.stamp_ns()
        if row.empty(*place):
            if name:
                raise BadRow(f'{name} has no position')
            return stamp_ns, None, name
        if polar:
            flat, covariance = polar.place(row)
            position = (*flat.tolist(), row.height())
        else:
            assert frame is not None
            position, covariance = frame.position(row), _covariance(row)
        fix = Fix(
            stamp_ns=stamp_ns,
            position=position,
            covariance=_with_height(row, covariance, how.depth_std),
            frame_id=how.frame_id,
        )
        check_size(fix)
        try:
            repeats.setdefault(name, RepeatFilter(REPEAT_TIME)).fresh(fix)
        except Rejection:
            repeated.append(row.line)
        return stamp_ns, fix, name

    read = [(row.line, *parsed) for row, parsed in report.read_rows(table, parse)]
    rows = [(line, fix, name) for line, _, fix, name in read if fix is not None]
    empty = [(line, stamp_ns) for line, stamp_ns, fix, _ in read if fix is None]
    if polar:
        polar.check_unit()
    fixes = [fix for _, fix, _ in rows]
    stamps = [fix.stamp_ns for fix in fixes]
    ask_for_units(stamps, [fix.position[:2] for fix in fixes], table.path, report)
    if not rows:
        for line, _ in empty:
            report.bad_row(table.path, f'line {line}', f'{" and ".join(place)} are empty')
        empty = []
    if depth := next((name for name in ('z', 'depth') if table.has(name)), ''):
        known = how.depth_std is not None or table.has('var_z') or table.has('std_z')
        if not table.is_blank(depth):
            report.notes['depth'] = (
                'is tracked with --set dimensions=3'
                if known
                else f'{table.header(depth)} is not tracked, since no column is its standard '
                'deviation; say --depth-std METRES'
            )
    names = [name for _, _, name in rows if name]
    named = bool(names)
    if len(names) > 1 and 2 * len(set(names)) > len(names):  # it numbers the rows
        report.notes['id'] = f'{table.header("id")} changes from row to row and names no diver'
        named = False
    if named or empty:
        records = _scans(rows, [stamp for _, stamp in empty], named, table.path, report, how)
    else:
        records = [(fix.stamp_ns, '/fix', write_fix(fix, ros_message)) for fix in fixes]
    if frame:
        origin = frame.origin
        report.notes.update(frame.notes())
    if rows:
        records += truth_records(how, report, origin)
    if empty:
        report.notes['empty scans'] = (
            f'{len(empty)} rows have a time and no position, the first in line '
            f'{empty[0][0]}: nobody was seen then'
        )
    if not named and (shared := _shared(stamps)):
        report.notes['shared stamps'] = shared
    if repeated:
        report.notes['repeated'] = (
            f'{len(repeated)} rows hold a position that came before, the first in line '
            f'{repeated[0]}; the tracker leaves them out (repeat_time)'
        )
    streams = _by_name((name if named else '', stamp) for _, stamp, _, name in read)
    every = [*records, *beside] if rows else []
    write_bag(report, every, table.path, how, {'diver': origin_parameters(origin)}, streams)


def _ask_for_vessel(table: Table) -> None:
    """Raise `BagError` where columns of numbers are left over beside range and bearing that may be
    the position or the heading of a vessel."""
    used = {table.index[name] for name in _OF_RANGES if name in table.index}
    left = [
        header
        for k, header in enumerate(table.headers)
        if k not in used
        and (is_of_vessel(header) or name_of(header) not in UNRELATED and table.varies(k))
    ]
    if left:
        raise BagError(
            f'{table.path}: {len(left)} columns may be the position or the heading of a vessel '
            f'({", ".join(left)}) and are not used. If ranges and bearings are measured from a '
            f'vessel: sonar-imm convert relative {quoted(table.path)} OUT_BAG, with --column '
            'heading=HEADER and so on. If from a sensor that does not move: --bearings north'
        )


_OF_RANGES = (
    'stamp', 'date', 'fraction', 'range', 'bearing', 'std_range', 'std_bearing', 'z', 'depth',
    'height', 'var_z', 'std_z', 'std_depth', 'var_depth', 'std', 'id', 'valid', 'status',
    'quality',
)  # fmt: skip
"""Quantities of a table of ranges and bearings from one place."""


def _by_name(stamps: Iterable[tuple[str, int]]) -> dict[str, list[int]]:
    """The stamps of each diver, in their order."""
    found: dict[str, list[int]] = {}
    for name, stamp_ns in stamps:
        found.setdefault(name, []).append(stamp_ns)
    return found


def _ask_for_target(table: Table) -> None:
    """Raise `BagError` where positions beside range and bearing have neither a word for the target
    nor one of a vessel beside them, nor were named by hand."""
    names = [name for name in ('x', 'y', 'latitude', 'longitude') if table.has(name)]
    vessel = any(table.has(name) for name in ('vessel_x', 'vessel_latitude'))
    ranks = [rank_of(name, table.header(name)) for name in names]
    if vessel or min(ranks) < 0 or set(names) & set(table.options.columns):
        return
    names = ['x', 'y'] if table.has('x', 'y') else ['latitude', 'longitude']
    headers = [table.header(name) for name in names]
    columns = ' '.join(f"--column 'vessel_{n}={h}'" for n, h in zip(names, headers))
    raise BagError(
        f'{table.path}: {" and ".join(headers)} may be the position of the target, or that of '
        f'a vessel from which {table.header("range")} and {table.header("bearing")} are '
        f'measured. Of the target: --ignore range. Of a vessel: sonar-imm convert relative '
        f'{quoted(table.path)} OUT_BAG {columns}'
    )


def _shared(stamps: Sequence[int]) -> str:
    """What is said of rows without a name that share stamps; '' where few do."""
    counts = Counter(stamps)
    most = max(counts.values(), default=0)
    several = sum(count for count in counts.values() if count > 1)
    if 2 * several <= len(stamps):
        return ''
    step = next((unit for unit, ns in _UNITS if all(stamp % ns == 0 for stamp in counts)), '')
    rounded = f' The stamps are {step}.' if step else ''
    return (
        f'up to {most} rows have one stamp: they are taken for {most} targets that are seen at '
        f'once.{rounded} If they are of one target, their stamps lack the seconds or a fraction '
        '(--column fraction=HEADER)'
    )


def _scans(
    rows: Sequence[tuple[int, Fix, str]],
    empty: Sequence[int],
    named: bool,
    path: Path,
    report: ConversionReport,
    how: FixesOptions,
) -> list[Record]:
    """Scans of the rows with the same stamp, each with the number of its diver where the rows are
    named, and those at the stamps `empty`, in which nobody was seen."""
    numbers = number_names([name for _, _, name in rows if name]) if named else {}
    report.target_names = numbers
    if any(str(number) != name for name, number in numbers.items()):
        report.notes['id'] = ', '.join(f'{name} is {number}' for name, number in numbers.items())
    by_stamp: dict[int, list[tuple[Fix, int]]] = {stamp_ns: [] for stamp_ns in empty}
    for line, fix, name in rows:
        scan = by_stamp.setdefault(fix.stamp_ns, [])
        number = numbers.get(name, NOBODY)
        if number != NOBODY and any(number == other for _, other in scan):
            report.bad_row(path, f'line {line}', f'{name} is there at this time')
            continue
        scan.append((fix, number))
    unknown, records = np.full((3, 3), np.nan), []
    for stamp_ns, scan in by_stamp.items():
        covariance = [unknown if fix.covariance is None else fix.covariance for fix, _ in scan]
        fixes = Fixes(
            stamp_ns=stamp_ns,
            position=np.array([fix.position for fix, _ in scan]).reshape(-1, 3),
            covariance=np.array(covariance).reshape(-1, 3, 3),
            target_id=[number for _, number in scan] if named else None,
            frame_id=how.frame_id,
        )
        records.append((stamp_ns, '/fixes', write_scan(fixes, ros_message)))
    return records


def _covariance(row: Row) -> np.ndarray | None:
    """The covariance (2, 2) that a row states; None when it is empty, negative or all zero."""
    if row.table.has('var_x', 'var_y'):
        var_x, var_y = row.optional('var_x'), row.optional('var_y')
        cov_xy = row.optional('cov_xy') if row.table.has('cov_xy') else 0.0
    else:
        names = ('std_x', 'std_y') if row.table.has('std_x', 'std_y') else ('std', 'std')
        std_x, std_y = row.optional(names[0]), row.optional(names[1])
        var_x, cov_xy, var_y = std_x * std_x, 0.0, std_y * std_y
        if std_x < 0.0 or std_y < 0.0:
            return None
    known = var_x >= 0.0 and var_y >= 0.0 and not math.isnan(cov_xy)
    stated = known and not var_x == var_y == cov_xy == 0.0
    return np.array([[var_x, cov_xy], [cov_xy, var_y]]) if stated else None


def _with_height(
    row: Row, covariance: np.ndarray | None, depth_std: float | None
) -> np.ndarray | None:
    """`covariance` (2, 2) with what the row states of z, or `depth_std`, m, as (3, 3); as it is
    where nothing is known."""
    variance = row.optional('var_z') if row.table.has('var_z') else row.optional('std_z')
    variance = variance if row.table.has('var_z') else variance * abs(variance)
    if not variance > 0.0 and depth_std is not None:
        variance = depth_std**2
    if not variance > 0.0 or row.empty('z') and row.empty('depth') and row.empty('height'):
        return covariance
    whole = np.full((3, 3), np.nan)
    whole[2, 2] = variance
    if covariance is not None:
        whole[:2, :2] = covariance
        for axis, name in enumerate(('cov_xz', 'cov_yz')):
            across = row.optional(name) if row.table.has(name) else 0.0
            whole[2, axis] = whole[axis, 2] = across
    return whole


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
        offset, whole = np.append(flat, row.height()), None
        if covariance is not None:  # up it is as uncertain as in the worst direction of the plane
            whole = np.zeros((3, 3))
            whole[:2, :2], whole[2, 2] = covariance, np.linalg.eigvalsh(covariance)[1]
        fix = RelativeFix(stamp_ns=stamp_ns, offset=offset, covariance=whole)
        return _Parsed(stamp_ns, pose, fix, name)

    rows = [parsed for _, parsed in report.read_rows(table, parse)]
    if polar:
        polar.check_unit()
    if not levelled:
        ask_for_angle(table, 'heading', headings)
    leaps, origin = Leaps(), checked_origin(how.origin)
    if geodetic:
        leaps.saw_all(row.pose[0][2] for row in rows)
    else:
        origin = None
        for row in rows:
            leaps.saw(row.stamp_ns, *row.pose[0][2].position[:2].tolist())
    leaps.tell(table.path, report)
    tags = {row.name: re.sub(r'[^A-Za-z0-9_]+', '_', row.name) for row in rows if row.name}
    if geodetic and rows and origin is None:
        first: VesselFix = rows[0].pose[0][2]
        origin = (first.latitude, first.longitude, 0.0)
    if origin is not None:
        report.notes['origin'] = 'latitude {!r}, longitude {!r}, height {!r}'.format(*origin)
    records: list[Record] = []
    if any(row.fix is not None for row in rows):
        # Poses go before what is measured from them, one for each stamp, the first.
        records = [
            (stamp_ns, topic, write(measurement, ros_message))
            for stamp_ns, pose in {row.stamp_ns: row.pose for row in reversed(rows)}.items()
            for topic, write, measurement in pose
        ]
        records += [_target(row, tags, how.frame_id) for row in rows]
    if empty := sum(row.fix is None for row in rows):
        report.notes['empty scans'] = (
            f'{empty} rows have a time and no position: nobody was seen then'
        )
    if records:
        records += truth_records(how, report, origin)
    known: dict[str, Any] = {
        **origin_parameters(origin),
        'relative_axes': 'enu' if levelled else 'flu',
        'frame_id': how.frame_id,
    }
    if tags:
        known['tags'] = list(dict.fromkeys(tags.values()))
        numbers = tag_numbers(known['tags'])
        report.target_names = {name: numbers[tag] for name, tag in tags.items()}
    streams = _by_name((row.name, row.stamp_ns) for row in rows)
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


def _target(row: _Parsed, tags: dict[str, str], frame_id: str) -> Record:
    """The position of a row, or the scan in which nobody was seen."""
    if row.fix is None:
        nobody = Fixes(stamp_ns=row.stamp_ns, position=np.empty((0, 3)), frame_id=frame_id)
        return row.stamp_ns, '/fixes', write_scan(nobody, ros_message)
    fix = evolve(row.fix, frame_id=tags.get(row.name, TRANSCEIVER))
    return row.stamp_ns, '/relative', write_relative(fix, ros_message)
