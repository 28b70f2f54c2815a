# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Arrival times of one ping as a table, one row per transmitter-receiver pair.

Columns: ``tx_id``, ``rx_id`` u2; ``tx_x tx_y tx_z rx_x rx_y rx_z`` f8 [m]; ``toa`` f8 [s after the
header stamp, which is the transmission]; optional ``var_toa`` f4 [s^2], ``bearing`` f8 [rad at the
receiver, counter-clockwise from +x], ``var_bearing`` f4 [rad^2], ``elevation`` f8 [rad at the
receiver, up positive], ``var_elevation`` f4 [rad^2], ``depth`` f8 [m, down positive, what the
diver reports of itself], ``var_depth`` f4 [m^2]; NaN where not measured.

Extension for acoustic tags: with NaN in ``tx_x tx_y tx_z`` of every row the target itself emits,
at an unknown time near the stamp, and only the differences between receivers carry information.
When some rows have a transmitter, rows without one are dropped.
"""

from __future__ import annotations

from typing import Any

from attrs import evolve
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.measurements import Arrivals, Rejection

from .headers import head_of, Make, swap_axes, to_enu
from .table import decode_table, require_columns, scalar_column, table_of

_TX, _RX = ('tx_x', 'tx_y', 'tx_z'), ('rx_x', 'rx_y', 'rx_z')
REQUIRED = ('tx_id', 'rx_id', *_TX, *_RX, 'toa')
COLUMNS = (
    *REQUIRED,
    'var_toa',
    'bearing',
    'var_bearing',
    'elevation',
    'var_elevation',
    'depth',
    'var_depth',
)

MAX_PAIRS = 1000
"""Most rows of a ping: time grows with their number, and none of a network has as many."""
FARTHEST = 1e8
"""Most metres from the origin, the limit that `Fix` has too."""
DEEPEST = 12_000.0
"""Most metres of depth that a diver can report."""
LONGEST = 3600.0
"""Most seconds from the stamp to an arrival."""
LEAST_VAR_TOA, LEAST_VAR_BEARING = 1e-18, 1e-12
"""A stated variance below (1 ns)^2 or (1 urad)^2 is a field that was not filled in."""
LEAST_VAR_DEPTH = 1e-8
"""Likewise below (0.1 mm)^2."""


def read_arrivals(message: Any, *, world_frame: str = 'enu') -> Arrivals:
    """Read an arrivals table; `world_frame` is ``'enu'`` or ``'ned'``.

    Rows whose arrival time or positions cannot be used are dropped, so that
    ``message.height * message.width - len(arrivals)`` counts them. Variances that are not positive
    and finite become NaN (unknown). Raises `Rejection` when the table does not fit or no row is
    left.
    """
    columns = decode_table(message, COLUMNS, most_rows=MAX_PAIRS)
    require_columns(columns, REQUIRED, 'arrivals')
    values = {name: scalar_column(columns, name) for name in REQUIRED}
    rows = len(values['toa'])
    if not rows:
        raise Rejection('empty', 'the ping has no arrivals')
    tx = np.column_stack([values[name] for name in _TX])
    rx = np.column_stack([values[name] for name in _RX])
    keep = _usable(values['toa'], tx, rx)
    if not keep.any():
        raise Rejection('nan', f'none of the {rows} arrivals has a usable time and positions')
    arrivals = Arrivals(
        **head_of(message),
        tx_id=_ids(values['tx_id'][keep], 'tx_id'),
        rx_id=_ids(values['rx_id'][keep], 'rx_id'),
        tx=tx[keep],
        rx=rx[keep],
        toa=values['toa'][keep],
        var_toa=_variances(columns, 'var_toa', rows, LEAST_VAR_TOA)[keep],
        bearing=_bearings(columns, rows)[keep],
        var_bearing=_variances(columns, 'var_bearing', rows, LEAST_VAR_BEARING)[keep],
        elevation=_elevations(columns, rows)[keep],
        var_elevation=_variances(columns, 'var_elevation', rows, LEAST_VAR_BEARING)[keep],
        depth=_depths(columns, rows)[keep],
        var_depth=_variances(columns, 'var_depth', rows, LEAST_VAR_DEPTH)[keep],
    )
    return to_enu(arrivals, world_frame, _turned)


def _turned(arrivals: Arrivals) -> Arrivals:
    """The same ping in ENU, of one in NED, whose bearings go clockwise from north."""
    return evolve(
        arrivals,
        tx=swap_axes(arrivals.tx),
        rx=swap_axes(arrivals.rx),
        bearing=wrap_angle(np.pi / 2 - arrivals.bearing),
    )


def write_arrivals(arrivals: Arrivals, make: Make) -> Any:
    """Write an arrivals table; of bearing, elevation and depth the columns that were measured."""
    columns: dict[str, NDArray] = {'tx_id': arrivals.tx_id, 'rx_id': arrivals.rx_id}
    columns.update(zip(_TX, arrivals.tx.T))
    columns.update(zip(_RX, arrivals.rx.T))
    columns['toa'] = arrivals.toa
    columns['var_toa'] = arrivals.var_toa.astype(np.float32)
    for name in ('bearing', 'elevation', 'depth'):
        if not np.isnan(getattr(arrivals, name)).all():
            columns[name] = getattr(arrivals, name)
            columns[f'var_{name}'] = getattr(arrivals, f'var_{name}').astype(np.float32)
    return table_of(arrivals, columns, make)


def _usable(toa: NDArray, tx: NDArray, rx: NDArray) -> NDArray[np.bool_]:
    """Rows (n,) with a finite time and receiver and, where any row has one, a transmitter."""
    received = (np.abs(toa) <= LONGEST) & (np.abs(rx) <= FARTHEST).all(axis=1)
    emitted = (np.abs(tx) <= FARTHEST).all(axis=1)
    if (received & emitted).any():
        return received & emitted & (toa > 0.0)
    return received & np.isnan(tx).all(axis=1)


def _ids(values: NDArray, name: str) -> NDArray[np.uint16]:
    """Check that identifiers are whole numbers of 16 bits."""
    good = (values >= 0) & (values <= 65535) & (values == np.floor(values))
    if not good.all():
        raise Rejection(
            'out_of_range',
            f'arrivals: {name} {values[~good][0]:g} is not a whole number from 0 to 65535',
        )
    return values.astype(np.uint16)


def _optional(columns: dict[str, NDArray], name: str, rows: int) -> NDArray:
    """The column (rows,), NaN where missing or not finite."""
    if name not in columns:
        return np.full(rows, np.nan)
    values = scalar_column(columns, name)
    return np.where(np.isfinite(values), values, np.nan)


def _variances(columns: dict[str, NDArray], name: str, rows: int, least: float) -> NDArray:
    """Variances (rows,), NaN where missing or not a variance."""
    values = _optional(columns, name, rows)
    return np.where(values >= least, values, np.nan)


def _elevations(columns: dict[str, NDArray], rows: int) -> NDArray:
    """Elevations (rows,), NaN where missing. What is beyond a right angle is refused."""
    values = _optional(columns, 'elevation', rows)
    if (np.abs(values) > 0.5 * np.pi + 1e-6).any():
        raise Rejection(
            'out_of_range',
            f'arrivals: an elevation of {np.nanmax(np.abs(values)):g} is beyond pi/2; elevations '
            'are in radians',
        )
    return values


def _depths(columns: dict[str, NDArray], rows: int) -> NDArray:
    """Depth reports (rows,), NaN where missing or deeper than any sea."""
    values = _optional(columns, 'depth', rows)
    return np.where(np.abs(values) <= DEEPEST, values, np.nan)


def _bearings(columns: dict[str, NDArray], rows: int) -> NDArray:
    """Bearings (rows,) wrapped into [-pi, pi], NaN where missing. Degrees are refused."""
    values = _optional(columns, 'bearing', rows)
    if (np.abs(values) > 2.0 * np.pi + 1e-6).any():
        raise Rejection(
            'out_of_range',
            f'arrivals: a bearing of {np.nanmax(np.abs(values)):g} is '
            'beyond 2 pi; bearings are in radians',
        )
    return wrap_angle(values)
