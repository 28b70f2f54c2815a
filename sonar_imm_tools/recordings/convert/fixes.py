# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""CSV tables of position fixes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
import itertools
import math
from pathlib import Path

import numpy as np

from msg_adapters.fixes import check_size, write_fix
from msg_adapters.scans import write_scan
from sonar_imm.intake import RepeatFilter
from sonar_imm.measurements import Fix, Fixes, NOBODY, Rejection

from ... import SECOND
from ..columns import is_of_vessel, name_of, rank_of, UNRELATED
from ..conversion import ask_for_units, ConversionReport, converter, Record, write_bag
from ..convert_options import FixesOptions
from ..messages import ros_message
from ..places import bearings_from, LocalFrame, origin_parameters, PolarRows
from ..sources import BagError, quoted
from ..tables import Row, Table
from ..times import BadRow
from ..track_files import open_table
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
    elif table.has('range', 'bearing') and _may_be_of_vessel(table):
        names = ('x', 'y') if table.has('x', 'y') else ('latitude', 'longitude')
        headers = [table.header(name) for name in names]
        columns = ' '.join(f"--column 'vessel_{n}={h}'" for n, h in zip(names, headers))
        raise BagError(
            f'{table.path}: {" and ".join(headers)} may be the position of the target, or that of '
            f'a vessel from which {table.header("range")} and {table.header("bearing")} are '
            f'measured. Of the target: --ignore range. Of a vessel: sonar-imm convert relative '
            f'{quoted(table.path)} OUT_BAG {columns}'
        )
    frame = None if polar else LocalFrame(table, how.origin)
    origin = frame.origin if frame else None
    place = ('range', 'bearing') if polar else ('x', 'y')
    if frame and frame.geodetic:
        place = ('latitude', 'longitude')

    repeats: dict[str, RepeatFilter] = {}
    repeated: list[int] = []

    def parse(row: Row) -> tuple[int, Fix | None, str]:
        row.require_valid()
        name, stamp_ns = row.text('id'), row.stamp_ns()
        if row.empty(*place):
            if name:
                raise BadRow(f'{name} has no position')
            return stamp_ns, None, name
        if frame:
            position, covariance = frame.position(row), _covariance(row)
        else:
            assert polar is not None
            flat, covariance = polar.place(row)
            position = (*flat.tolist(), row.height())
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
    ask_for_units(
        [fix.stamp_ns for fix in fixes], [fix.position[:2] for fix in fixes], table.path, report
    )
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
    named = _names_divers(table, rows, report)
    records: Iterable[Record]
    if named or empty:
        stamps = [stamp for _, stamp in empty]
        records = _scans(rows, stamps, named, table.path, report, how.frame_id)
    else:
        records = ((fix.stamp_ns, '/fix', write_fix(fix, ros_message)) for fix in fixes)
    if frame:
        origin = frame.origin
        report.notes.update(frame.notes())
    truth: list[Record] = []
    if how.truth is not None and rows:
        truth = truth_records(how.truth, report, how.truth_options, how.frame_id, origin)
    if empty:
        report.notes['empty scans'] = (
            f'{len(empty)} rows have a time and no position, the first in line '
            f'{empty[0][0]}: nobody was seen then'
        )
    if not named and (shared := _shared([fix.stamp_ns for fix in fixes])):
        report.notes['shared stamps'] = shared
    if repeated:
        report.notes['repeated'] = (
            f'{len(repeated)} rows hold a position that came before, the first in line '
            f'{repeated[0]}; the tracker leaves them out (repeat_time)'
        )
    streams = by_name((name if named else '', stamp) for _, stamp, _, name in read)
    every = itertools.chain(records, truth, beside) if rows else []
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


def by_name(stamps: Iterable[tuple[str, int]]) -> dict[str, list[int]]:
    """The stamps of each diver, in their order."""
    found: dict[str, list[int]] = {}
    for name, stamp_ns in stamps:
        found.setdefault(name, []).append(stamp_ns)
    return found


def _may_be_of_vessel(table: Table) -> bool:
    """Say whether positions beside range and bearing have neither a word for the target nor one of
    a vessel beside them, nor were named by hand."""
    names = [name for name in ('x', 'y', 'latitude', 'longitude') if table.has(name)]
    vessel = any(table.has(name) for name in ('vessel_x', 'vessel_latitude'))
    ranks = [rank_of(name, table.header(name)) for name in names]
    return not vessel and min(ranks) >= 0 and not set(names) & set(table.options.columns)


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


def _names_divers(
    table: Table, rows: Sequence[tuple[int, Fix, str]], report: ConversionReport
) -> bool:
    """Whether the column ``id`` says whose the rows are. One that is another in most rows numbers
    the rows."""
    names = [name for _, _, name in rows if name]
    if not names:
        return False
    if len(names) > 1 and 2 * len(set(names)) > len(names):
        report.notes['id'] = f'{table.header("id")} changes from row to row and names no diver'
        return False
    return True


def _scans(
    rows: Sequence[tuple[int, Fix, str]],
    empty: Sequence[int],
    named: bool,
    path: Path,
    report: ConversionReport,
    frame_id: str,
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
    unknown = np.full((3, 3), np.nan)
    return [
        (
            stamp_ns,
            '/fixes',
            write_scan(
                Fixes(
                    stamp_ns=stamp_ns,
                    position=np.array([fix.position for fix, _ in scan]).reshape(-1, 3),
                    covariance=np.array(
                        [unknown if fix.covariance is None else fix.covariance for fix, _ in scan]
                    ).reshape(-1, 3, 3),
                    target_id=[number for _, number in scan] if named else None,
                    frame_id=frame_id,
                ),
                ros_message,
            ),
        )
        for stamp_ns, scan in by_stamp.items()
    ]


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
    if math.isnan(var_x + var_y + cov_xy) or var_x < 0.0 or var_y < 0.0:
        return None
    if var_x == var_y == cov_xy == 0.0:
        return None
    return np.array([[var_x, cov_xy], [cov_xy, var_y]])


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
