# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scans of fixes: one message with all positions that were found at a stamp, also without any.

Our own message is a table with one row per fix. Columns: ``x``, ``y`` f8 [m]; ``cov_x_x``,
``cov_x_y``, ``cov_y_y`` f4 [m^2]; optional ``z`` f8 [m], ``cov_z_z`` f4 and with it ``cov_x_z``,
``cov_y_z`` f4, ``id`` i4, whose position it is, and ``valid`` u1, 0 for a fix that its sender
flags as invalid. The columns are there in an empty scan too: a table of something else that
happens to be empty is no scan. As in `fixes`, a negative variance or NaN means unknown, and all
zeros that the covariance was not filled in. A negative ``id`` is nobody's.

Rows that cannot be used are left out, so that ``message.height * message.width - len(scan)``
counts them (see `doubt_scan`).

A geometry_msgs/PoseArray is a scan without covariances.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from attrs import evolve
import numpy as np
from numpy.typing import NDArray

from sonar_imm.measurements import Fixes, NOBODY, Rejection, usable_fixes
from sonar_imm.measurements.variances import LEAST_VARIANCE, MOST_VARIANCE, UNKNOWN_VARIANCE

from .headers import (
    head_of,
    Make,
    make_header,
    make_pose,
    places_of,
    swap_axes,
    swap_covariance,
    to_enu,
)
from .table import decode_table, require_columns, scalar_column, table_of

REQUIRED = ('x', 'y', 'cov_x_x', 'cov_x_y', 'cov_y_y')
OF_Z = {'cov_x_z': (0, 2), 'cov_y_z': (1, 2), 'cov_z_z': (2, 2)}
COLUMNS = (*REQUIRED, 'z', *OF_Z, 'id', 'valid')
MAX_FIXES = 10_000


def read_scan(message: Any, *, world_frame: str = 'enu') -> Fixes:
    """Read a table of fixes; `world_frame` is ``'enu'`` or ``'ned'``. Raises `Rejection`, also
    when there are rows but none can be used."""
    columns = decode_table(message, COLUMNS, most_rows=MAX_FIXES)
    require_columns(columns, REQUIRED, 'fixes')
    values = {name: scalar_column(columns, name) for name in columns}
    if 'valid' in values and not (valid := values['valid'] != 0).all():
        if not valid.any():
            raise Rejection('flagged_invalid', f'all {len(valid)} fixes are flagged as invalid')
        values = {name: column[valid] for name, column in values.items()}
    rows = len(values['x'])
    position, covariance = np.zeros((rows, 3)), np.full((rows, 3, 3), np.nan)
    position[:, 0], position[:, 1] = values['x'], values['y']
    covariance[:, 0, 0], covariance[:, 1, 1] = values['cov_x_x'], values['cov_y_y']
    covariance[:, 0, 1] = covariance[:, 1, 0] = values['cov_x_y']
    if 'z' in values:
        known = np.isfinite(values['z'])
        position[known, 2] = values['z'][known]
        if 'cov_z_z' in values:
            for name, (i, j) in OF_Z.items():
                covariance[:, i, j] = covariance[:, j, i] = values.get(name, 0.0)
            covariance[~known, 2, 2] = np.nan
    return _scan(message, position, covariance, _names(values.get('id')), world_frame)


def read_poses(message: Any, *, world_frame: str = 'enu') -> Fixes:
    """Read a PoseArray as a scan of positions without covariance. Raises `Rejection`."""
    if len(message.poses) > MAX_FIXES:
        raise Rejection(
            'too_large', f'a scan of {len(message.poses)} poses; at most {MAX_FIXES} are read'
        )
    position = places_of(pose.position for pose in message.poses)
    position[:, 2] = np.where(np.isfinite(position[:, 2]), position[:, 2], 0.0)
    return _scan(message, position, None, None, world_frame)


def doubt_scan(message: Any, scan: Fixes) -> str | None:
    """Give ``'unusable_rows'`` where `scan`, read from `message`, left some rows out,
    ``'flagged_invalid'`` where its sender flags some."""
    rows = len(message.poses) if hasattr(message, 'poses') else message.height * message.width
    if len(scan) == rows:
        return None
    if not hasattr(message, 'poses'):
        valid = decode_table(message, ('valid',), most_rows=MAX_FIXES).get('valid')
        if valid is not None and not np.all(valid):
            return 'flagged_invalid'
    return 'unusable_rows'


def write_scan(scan: Fixes, make: Make) -> Any:
    """Write our table; the column ``id`` only when a row says whose it is, the covariances of z
    only when a row states it."""
    n = len(scan)
    covariance = np.full((n, 3, 3), np.nan) if scan.covariance is None else scan.covariance
    columns: dict[str, NDArray] = dict(zip('xyz', scan.position.T))
    places = {'cov_x_x': (0, 0), 'cov_x_y': (0, 1), 'cov_y_y': (1, 1)}
    if np.isfinite(covariance[:, 2, 2]).any():
        places |= OF_Z
    for name, (i, j) in places.items():
        columns[name] = covariance[:, i, j].astype(np.float32)
    if scan.target_id is not None:
        columns['id'] = scan.target_id
    return table_of(scan, columns, make)


def write_poses(scan: Fixes, make: Make) -> Any:
    """Write a PoseArray, which has no room for covariances and identities."""
    poses = [make_pose(position, make) for position in scan.position]
    header = make_header(scan.stamp_ns, scan.frame_id, make)
    return make('geometry_msgs/msg/PoseArray', header=header, poses=poses)


def _scan(
    message: Any,
    position: NDArray,
    covariance: NDArray | None,
    target_id: NDArray | None,
    world_frame: str,
) -> Fixes:
    """The scan of the rows (n,) that can be used."""
    columns, scan = (position, covariance, target_id), None
    sized = _sized(covariance, len(position))
    with suppress(Rejection):
        # A scan looks at its rows itself: where all are good, once is enough.
        scan = _of_rows(message, *columns) if sized.all() else None
    if scan is None:
        keep = usable_fixes(position, covariance) & sized
        if len(keep) and not keep.any():
            raise Rejection('nan', f'none of the {len(keep)} fixes of the scan can be used')
        kept = (None if column is None else column[keep] for column in columns)
        scan = _of_rows(message, *kept)
    return to_enu(scan, world_frame, _turned)


def _of_rows(message: Any, position: Any, covariance: Any, target_id: Any) -> Fixes:
    """The scan of all rows (n,)."""
    head = head_of(message)
    return Fixes(**head, position=position, covariance=covariance, target_id=target_id)


def _turned(scan: Fixes) -> Fixes:
    """The same scan in ENU, of one in NED."""
    covariance = None if scan.covariance is None else swap_covariance(scan.covariance)
    return evolve(scan, position=swap_axes(scan.position), covariance=covariance)


def _sized(covariance: NDArray | None, rows: int) -> NDArray[np.bool_]:
    """Which covariances (n,) can be used, as `measurements.variances` says of one. Those of x and
    y that are said to be unknown become NaN."""
    if covariance is None:
        return np.ones(rows, bool)
    variance = covariance[:, (0, 1), (0, 1)]
    with np.errstate(invalid='ignore'):
        sized = ((variance >= LEAST_VARIANCE) & (variance <= MOST_VARIANCE)).all(axis=1)
        sized &= (variance < UNKNOWN_VARIANCE).any(axis=1)
        if not sized.all():
            flat = covariance[:, :2, :2]
            unknown = ~(variance >= 0.0).all(axis=1) | ~flat.any(axis=(1, 2))
            flat[unknown] = np.nan
            sized |= unknown
    return np.asarray(sized)


def _names(values: NDArray | None) -> NDArray[np.int32] | None:
    """Identities (n,), `NOBODY` where negative or NaN; None when no row has one."""
    if values is None:
        return None
    named = np.where(np.isnan(values) | (values < 0), NOBODY, values)
    good = (named < 2**31) & (named == np.floor(named))
    if not good.all():
        raise Rejection(
            'out_of_range',
            f'fixes: id {named[~good][0]:g} is not a whole number from 0 to 2147483647',
        )
    return None if (named == NOBODY).all() else named.astype(np.int32)
