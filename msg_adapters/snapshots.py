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

"""Array snapshots of one side-scan ping as a table, one row per range bin.

Columns: ``range`` f4 [m, one way, middle of the bin] or ``time`` f8 [s, two-way, since the header
stamp, which is the transmission]; ``iq`` f4 x 2N (real and imaginary parts in turn, stave 0
first). Optional, the same in every row: ``sound_speed`` [m/s], ``frequency`` [Hz],
``element_spacing`` [m], ``sample_rate`` [Hz]. Optional, row by row: ``noise_variance``,
``signal_variance`` [squared units of iq, per stave].

An organised cloud is read too: one row of the image per range bin, one column per stave, with
``re`` and ``im`` instead of ``iq``. Its other columns are the same along each row.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.measurements import Rejection, Snapshot
from sonar_imm.measurements.bathymetry import MAX_BINS, MAX_STAVES

from .headers import Make, stamp_ns
from .table import constant_column, decode_table, encode_table, scalar_column

CONSTANTS = ('sound_speed', 'frequency', 'element_spacing', 'sample_rate')
VARIANCES = ('noise_variance', 'signal_variance')
COLUMNS = ('range', 'time', 'iq', 're', 'im', *CONSTANTS, *VARIANCES)
DEFAULT_SOUND_SPEED = 1500.0
"""m/s, for times without a sound speed, until the tracker replaces it (`Snapshot.ranges`)."""


def read_snapshot(message: Any, *, world_frame: str = 'enu', side: str = '') -> Snapshot:
    """Read a PointCloud2 of array snapshots.

    `world_frame` has no meaning here: a snapshot is in the frame of its array. `side`: where the
    array looks, when the topic says so. Bins with samples
    that are not finite are kept and marked. Raises `Rejection`.
    """
    columns = decode_table(message, COLUMNS, most_rows=MAX_BINS * MAX_STAVES)
    if 're' in columns and 'im' in columns and 'iq' not in columns:
        columns = _organised(columns, int(message.height), int(message.width))
    if 'iq' not in columns:
        raise Rejection('missing_column', 'a table of snapshots needs the column iq')
    iq = _complex(columns['iq'])
    constants = {name: constant_column(columns, name) for name in CONSTANTS}
    ranges, time = _ranges(columns, constants['sound_speed'])
    variances: dict[str, Any] = {
        name: scalar_column(columns, name) for name in VARIANCES if name in columns
    }
    return Snapshot(
        stamp_ns=stamp_ns(message),
        frame_id=str(message.header.frame_id),
        range=ranges,
        iq=iq,
        two_way_time=time,
        side=side,
        **variances,
        **constants,
    )


def write_snapshot(snapshot: Snapshot, make: Make) -> Any:
    """Write the table of a snapshot, in single precision; times are written when it has them."""
    rows = len(snapshot)
    columns: dict[str, NDArray] = {}
    if snapshot.two_way_time is None:
        columns['range'] = snapshot.range.astype(np.float32)
    else:
        columns['time'] = np.asarray(snapshot.two_way_time, np.float64)
    columns['iq'] = np.ascontiguousarray(snapshot.iq, np.complex64).view(np.float32)
    for name in CONSTANTS:
        if (value := getattr(snapshot, name)) is not None:
            columns[name] = np.full(rows, value, np.float32)
    for name in VARIANCES:
        if (values := getattr(snapshot, name)) is not None:
            columns[name] = values.astype(np.float32)
    return encode_table(columns, stamp_ns=snapshot.stamp_ns, frame_id=snapshot.frame_id, make=make)


def _complex(values: NDArray) -> NDArray[np.complexfloating]:
    """Pair the real and imaginary parts (n, 2N) into (n, N)."""
    if values.ndim == 1 or values.shape[1] % 2:
        count = 1 if values.ndim == 1 else values.shape[1]
        raise Rejection(
            'bad_field',
            f'column iq holds {count} values per row; real and imaginary parts come in pairs',
        )
    double = values.dtype in (np.dtype(np.float64), np.dtype(np.int32), np.dtype(np.uint32))
    parts = np.ascontiguousarray(values, np.float64 if double else np.float32)
    return parts.view(np.complex128 if double else np.complex64)


def _organised(columns: dict[str, NDArray], bins: int, staves: int) -> dict[str, NDArray]:
    """Turn an organised cloud into a table with one row per range bin."""
    if not staves:
        raise Rejection('no_staves', 'the organised cloud of snapshots has no column: no staves')
    parts = [scalar_column(columns, name).reshape(bins, staves) for name in ('re', 'im')]
    single = {
        name: column.reshape(bins, staves, -1)[:, 0].squeeze(axis=-1)
        for name, column in columns.items()
        if name not in ('re', 'im') and column.ndim == 1
    }
    return {**single, 'iq': np.stack(parts, axis=-1).reshape(bins, 2 * staves)}


def _ranges(
    columns: dict[str, NDArray], sound_speed: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Give ranges, and times where the table has them instead."""
    if 'range' in columns:
        return scalar_column(columns, 'range'), None
    if 'time' not in columns:
        raise Rejection('missing_column', 'a table of snapshots needs the column range or time')
    time = scalar_column(columns, 'time')
    return 0.5 * (sound_speed or DEFAULT_SOUND_SPEED) * time, time
