# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Records of a vertical array, and ready-made traces, as tables for the fathometer.

``csdm``, one row per frequency: ``frequency`` f4 [Hz]; ``csdm`` f4 x 2N^2, the matrix of N
hydrophones row by row, real and imaginary parts in turn, hydrophone 0 the deepest; optional
``snapshots`` u4, the same in every row.

``pressure``, one row per sample: ``p`` f4 x N, or i1 or i2 x N with ``scale`` f4; ``sample_rate``
f4 [Hz]. The stamp is that of the first sample.

``trace``, one row per depth: ``depth`` f4 [m, down positive]; ``amplitude`` f4; optional ``sigma``
f4, the standard deviation of its noise.

Each may state the depth of hydrophone 0, the same in every row: ``array_depth`` f4 [m, down
positive]; ``csdm`` and ``pressure`` instead ``element_depth`` f4 x N. Where none is stated, the
companion topic gives it (``array_depth``): a depth sensor publishes a position, of which only z is
read, positive up in east-north-up, positive down in north-east-down.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Rejection, Trace
from sonar_imm.measurements.fathometer import MAX_FREQUENCIES, MAX_SAMPLES

from .headers import head_of, Make, make_header
from .table import constant_column, decode_table, require_columns, scalar_column, table_of

Columns = Mapping[str, NDArray]
_DEPTHS = ('array_depth', 'element_depth')


def read_csdm(message: Any, *, world_frame: str = 'enu') -> CrossSpectra:
    """Read a PointCloud2 of cross-spectral density matrices.

    `world_frame` has no meaning here or in the other readers of this module: depths are positive
    downwards in any frame. Raises `Rejection`.
    """
    names = ('frequency', 'csdm', 'snapshots', *_DEPTHS)
    columns = decode_table(message, names, most_rows=MAX_FREQUENCIES)
    require_columns(columns, ('frequency', 'csdm'), 'cross-spectra')
    csdm = _matrices(columns['csdm'])
    return CrossSpectra(
        **head_of(message),
        frequency=scalar_column(columns, 'frequency'),
        csdm=csdm,
        snapshots=_snapshots(columns),
        reference_depth=_array_depth(columns, csdm.shape[-1]),
    )


def write_csdm(record: CrossSpectra, make: Make) -> Any:
    """Write the table of cross-spectra, in single precision."""
    rows = len(record)
    flat = np.ascontiguousarray(record.csdm, np.complex64).reshape(rows, -1)
    columns = {
        'frequency': record.frequency.astype(np.float32),
        'csdm': flat.view(np.float32),
        'snapshots': np.full(rows, record.snapshots, np.uint32),
    }
    return _encode(record, columns, rows, make)


def read_pressure(message: Any, *, world_frame: str = 'enu') -> Pressure:
    """Read a PointCloud2 of pressure samples. Raises `Rejection`."""
    columns = decode_table(message, ('p', 'scale', 'sample_rate', *_DEPTHS), most_rows=MAX_SAMPLES)
    require_columns(columns, ('p', 'sample_rate'), 'pressure')
    samples = _two_dimensional(columns['p'])
    scale = 0.0
    if samples.dtype.kind in 'iu':
        require_columns(columns, ('scale',), 'pressure in whole numbers')
        stated = constant_column(columns, 'scale')
        if stated is None:
            raise Rejection('bad_scale', 'the scale of the pressure is zero or not a number')
        scale = stated
        samples = samples * np.float32(scale)
    rate = constant_column(columns, 'sample_rate')
    return Pressure(
        **head_of(message),
        pressure=samples,
        sample_rate=0.0 if rate is None else rate,
        reference_depth=_array_depth(columns, samples.shape[1]),
        scale=scale,
    )


def write_pressure(block: Pressure, make: Make) -> Any:
    """Write the table of a block; with a `scale` as whole numbers of 8 bits, of 16 where they do
    not fit, clipped at their limits."""
    rows = len(block)
    columns: dict[str, NDArray] = {'p': block.pressure}
    if block.scale:
        whole = np.clip(np.round(block.pressure / np.float32(block.scale)), -(2**15), 2**15 - 1)
        small = np.abs(whole).max() < 2**7
        columns = {
            'p': whole.astype(np.int8 if small else np.int16),
            'scale': np.full(rows, block.scale, np.float32),
        }
    columns['sample_rate'] = np.full(rows, block.sample_rate, np.float32)
    return _encode(block, columns, rows, make)


def read_trace(message: Any, *, world_frame: str = 'enu') -> Trace:
    """Read a PointCloud2 of one trace. Raises `Rejection`."""
    names = ('depth', 'amplitude', 'sigma', 'array_depth')
    columns = decode_table(message, names, most_rows=MAX_SAMPLES)
    require_columns(columns, ('depth', 'amplitude'), 'traces')
    return Trace(
        **head_of(message),
        depth=scalar_column(columns, 'depth'),
        amplitude=scalar_column(columns, 'amplitude'),
        sigma=scalar_column(columns, 'sigma') if 'sigma' in columns else None,
        reference_depth=constant_column(columns, 'array_depth', zero_is_known=True),
    )


def write_trace(trace: Trace, make: Make) -> Any:
    """Write the table of a trace, in single precision."""
    columns = _trace_columns(trace.depth, trace.amplitude, trace.sigma)
    return _encode(trace, columns, len(trace), make)


def write_response(response: Any, make: Make) -> Any:
    """Write a depth response (stamp_ns, frame_id, depth, amplitude and sigma (n,)) as the table of
    a trace with ``x y z`` before it, z up, so that displays can draw it."""
    zero = np.zeros(len(response.depth), np.float32)
    columns = {'x': zero, 'y': zero, 'z': (-response.depth).astype(np.float32)}
    columns |= _trace_columns(response.depth, response.amplitude, response.sigma)
    return table_of(response, columns, make)


def _trace_columns(
    depth: NDArray, amplitude: NDArray, sigma: NDArray | None
) -> dict[str, NDArray]:
    columns = {'depth': depth, 'amplitude': amplitude}
    if sigma is not None:
        columns['sigma'] = sigma
    return {name: column.astype(np.float32) for name, column in columns.items()}


def _encode(record: Any, columns: dict[str, NDArray], rows: int, make: Make) -> Any:
    if record.reference_depth is not None:
        columns['array_depth'] = np.full(rows, record.reference_depth, np.float32)
    return table_of(record, columns, make)


def _matrices(values: NDArray) -> NDArray[np.complexfloating]:
    """Pair the real and imaginary parts (F, 2 N^2) into (F, N, N)."""
    count = 1 if values.ndim == 1 else values.shape[1]
    hydrophones = round((count / 2) ** 0.5)
    if 2 * hydrophones**2 != count:
        raise Rejection(
            'bad_field',
            f'column csdm holds {count} values per row; N hydrophones need 2 N^2: real and '
            'imaginary parts of a whole matrix',
        )
    if values.dtype.kind != 'f':
        raise Rejection('bad_field', f'column csdm holds {values.dtype}, not floats')
    double = values.dtype == np.float64
    paired: NDArray[np.complexfloating] = np.ascontiguousarray(values).view(
        np.complex128 if double else np.complex64
    )
    return paired.reshape(len(values), hydrophones, hydrophones)


def _two_dimensional(column: NDArray) -> NDArray:
    """(rows, count), also without a row and for a count of one."""
    return column[:, None] if column.ndim == 1 else column


def _snapshots(columns: Columns) -> int:
    """How many snapshots were averaged; 0 when not known."""
    count = constant_column(columns, 'snapshots')
    return 0 if count is None else int(min(max(count, 0.0), 2.0**53))


def _array_depth(columns: Columns, hydrophones: int) -> float | None:
    """Depth of hydrophone 0 from ``array_depth`` or ``element_depth``; None without both."""
    depth = constant_column(columns, 'array_depth', zero_is_known=True)
    if depth is not None or 'element_depth' not in columns:
        return depth
    depths = _two_dimensional(columns['element_depth'])
    if depths.shape[1] != hydrophones:
        raise Rejection(
            'bad_field',
            f'element_depth has {depths.shape[1]} values for {hydrophones} hydrophones',
        )
    first = depths[:, 0].astype(np.float64)
    return float(first[0]) if len(first) and np.isfinite(first[0]) else None


def read_array_depth(message: Any, *, world_frame: str = 'enu') -> ArrayDepth:
    """Read a PointStamped or PoseWithCovarianceStamped. Raises `Rejection`."""
    point = message.pose.pose.position if hasattr(message, 'pose') else message.point
    down = world_frame == 'ned' or str(message.header.frame_id).endswith('_ned')
    z = float(point.z)
    return ArrayDepth(
        **head_of(message),
        depth=z if down else -z,
    )


def write_array_depth(depth: ArrayDepth, make: Make) -> Any:
    """Write a PointStamped, z up."""
    return make(
        'geometry_msgs/msg/PointStamped',
        header=make_header(depth.stamp_ns, depth.frame_id, make),
        point=make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=-depth.depth),
    )
