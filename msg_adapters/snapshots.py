# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Array snapshots of one side-scan ping as a table, one row per range bin.

Columns: ``range`` f4 [m, one way, middle of the bin] or ``time`` f8 [s, two-way, since the header
stamp, which is the transmission]; ``iq`` f4 x 2N (real and imaginary parts in turn, stave 0
first). Optional, the same in every row: ``sound_speed`` [m/s], ``frequency`` [Hz],
``element_spacing`` [m], ``sample_rate`` [Hz]. Optional, row by row: ``noise_variance``,
``signal_variance`` [squared units of iq, per stave].

An organised cloud is read too: one row of the image per range bin, one column per stave, with
``re`` and ``im`` instead of ``iq``. Its other columns are the same along each row.

Interferometers are often recorded as images without a place for complex numbers. A ping is then
spread over messages, which are taken apart by the names of their fields, so that RawSonarImage of
marine_acoustic_msgs and messages like it serve alike:

* amplitude and phase of two staves: one value of each per range, the phase of stave 1 against
  stave 0; or amplitude and phase of every stave, one "beam" a stave;
* in-phase and quadrature samples: one message per stave, stave 0 first, with two "beams" or with
  the two numbers in turn.

Samples are an image with its own datatype (``dtype``, ``beam_count``, ``is_bigendian``, ``data``)
or an array of numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import ComplexArray, FloatArray
from sonar_imm.measurements import Rejection, Snapshot
from sonar_imm.measurements.bathymetry import MAX_BINS, MAX_STAVES

from .detections import SOUND_SPEEDS
from .headers import head_of, Make
from .sonar_images import DTYPES, image_samples
from .table import constant_column, decode_table, scalar_column, table_of

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
    constants: dict[str, Any] = {name: constant_column(columns, name) for name in CONSTANTS}
    ranges, time = _ranges(columns, constants['sound_speed'])
    variances: dict[str, Any] = {
        name: scalar_column(columns, name) for name in VARIANCES if name in columns
    }
    return Snapshot(
        **head_of(message),
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
    return table_of(snapshot, columns, make)


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


# -- from sonar images ------------------------------------------------------------------------


FIELDS: dict[str, str] = {
    'amplitude': 'image',
    'phase': 'image',
    'iq': 'image',
    'sample_rate': 'sample_rate',
    'sample0': 'sample0',
    'frequency': 'ping_info.frequency',
    'sound_speed': 'ping_info.sound_speed',
}
"""Where things stand in a message, as in RawSonarImage; a dot leads into a message inside."""


def snapshot_of_phase(
    amplitude: Any, phase: Any, *, radians_per_count: float | None = None, **how: Any
) -> Snapshot:
    """The snapshot of an image of amplitudes and one of phases, with the same shape.

    radians_per_count: what one count of the phase is; None: 1 for floats, and for whole numbers
    the full circle over their range. `how`: see `_snapshot`. Raises `Rejection`.
    """
    fields, order = how.get('fields', FIELDS), how.get('order', 'range_major')
    size, _ = _samples(amplitude, fields['amplitude'], order)
    turn, counts = _samples(phase, fields['phase'], order)
    if size.shape != turn.shape:
        raise Rejection(
            'bad_shape',
            f'{size.shape[0]} ranges and {size.shape[1]} channels of amplitude do not fit '
            f'{turn.shape[0]} and {turn.shape[1]} of phase',
        )
    scale = radians_per_count
    if scale is None:
        scale = 1.0 if counts is None else 2.0 * math.pi / counts
    wave = np.exp(1j * scale * turn)
    iq = size * wave if size.shape[1] > 1 else np.column_stack([size + 0j, size * wave])
    return _snapshot(amplitude, iq, **how)


def snapshot_of_staves(messages: Sequence[Any], **how: Any) -> Snapshot:
    """The snapshot of one message per stave with in-phase and quadrature samples; see
    `snapshot_of_phase`."""
    fields, order = how.get('fields', FIELDS), how.get('order', 'range_major')
    staves = [_in_quadrature(_samples(message, fields['iq'], order)[0]) for message in messages]
    if len({len(stave) for stave in staves}) > 1:
        raise Rejection(
            'bad_shape', f'the staves have {", ".join(str(len(stave)) for stave in staves)} ranges'
        )
    return _snapshot(messages[0], np.column_stack(staves), **how)


def _snapshot(
    message: Any,
    iq: ComplexArray,
    *,
    fields: Mapping[str, str] = FIELDS,
    order: str = 'range_major',
    sound_speed: float = 1500.0,
    element_spacing: float | None = None,
    side: str = '',
) -> Snapshot:
    """fields: as `FIELDS`; order: of samples in an image, see `sonar_images`; sound_speed: m/s,
    where the message states none; element_spacing: m."""
    rate = _number(message, fields['sample_rate'])
    if rate is None or not rate > 0.0:
        raise Rejection(
            'out_of_range', f"no sample rate in the field '{fields['sample_rate']}': it is {rate}"
        )
    stated = _number(message, fields['sound_speed'])
    known = stated is not None and SOUND_SPEEDS[0] <= stated <= SOUND_SPEEDS[1]
    speed = stated if known else sound_speed
    first = _number(message, fields['sample0']) or 0.0
    frequency = _number(message, fields['frequency'])
    assert speed is not None
    return Snapshot(
        **head_of(message),
        range=(first + np.arange(len(iq))) * speed / (2.0 * rate),
        iq=iq.astype(np.complex64),
        sound_speed=speed,
        frequency=frequency if frequency else None,
        element_spacing=element_spacing,
        sample_rate=rate,
        side=side,
    )


def _find(message: Any, path: str) -> Any:
    """What stands at a dotted path; None when it is not there."""
    for name in path.split('.'):
        message = getattr(message, name, None)
    return message


def _number(message: Any, path: str) -> float | None:
    value = _find(message, path)
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _samples(message: Any, path: str, order: str) -> tuple[FloatArray, int | None]:
    """Samples (ranges, channels), and how many values their datatype has, None for floats."""
    found = _find(message, path)
    if found is None:
        raise Rejection('missing_column', f"the message has no field '{path}'")
    most = MAX_BINS * MAX_STAVES
    if hasattr(found, 'beam_count'):
        beams, code = int(found.beam_count), int(found.dtype)
        if not 0 <= code < len(DTYPES):
            raise Rejection('bad_field', f'the image has the unknown datatype {code}')
        dtype = np.dtype(DTYPES[code])
        count = len(memoryview(found.data).cast('B')) // dtype.itemsize
        if not 1 <= beams <= MAX_STAVES or count > most:
            raise Rejection('too_large', f'an image of {count} samples in {beams} channels')
        return image_samples(found, count // beams, beams, order), _values_of(dtype)
    values = np.asarray(found)
    if values.dtype.kind not in 'iuf' or values.ndim != 1:
        raise Rejection('bad_field', f"the field '{path}' holds no row of numbers")
    if len(values) > most:
        raise Rejection('too_large', f"the field '{path}' holds {len(values)} samples")
    return values.astype(np.float64)[:, None], _values_of(values.dtype)


def _values_of(dtype: np.dtype) -> int | None:
    return 256**dtype.itemsize if dtype.kind in 'iu' else None


def _in_quadrature(samples: FloatArray) -> ComplexArray:
    """Complex samples (ranges,) of two channels, or of one with both in turn."""
    if samples.shape[1] == 1 and len(samples) % 2 == 0:
        samples = samples.reshape(-1, 2)
    if samples.shape[1] != 2:
        raise Rejection(
            'bad_shape',
            f'in-phase and quadrature samples are two channels, not {samples.shape[1]} of '
            f'{len(samples)} ranges',
        )
    return np.asarray(samples[:, 0] + 1j * samples[:, 1])
