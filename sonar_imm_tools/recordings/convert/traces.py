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

"""Ready-made traces, such as depth responses computed elsewhere, from a numpy archive or a CSV."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.array_records import write_trace
from sonar_imm.measurements import Rejection, Trace
from sonar_imm.truth import PRESENT, TrueReflectors

from ..conversion import ConversionReport, numbers_of, read_npz, Record, stamps_of, write_bag
from ..convert_options import TracesOptions
from ..csv_table import CsvTable, Row
from ..messages import ros_message
from ..sources import BagError
from ..truth import records_of

FIRST_STAMP_NS = 1_700_000_000_000_000_000
Arrays = dict[str, NDArray]

NAMES = {
    'depth', 'amplitude', 'sigma', 'reference_depth', 'reflector_depth', 'reflector_amplitude',
}  # fmt: skip
"""The arrays of an archive that are read, beside its stamps."""


def convert_traces(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert traces to the topic ``/trace``.

    values: as in `TracesOptions`. An archive (.npz) has ``depth`` (n,) and ``amplitude`` (n,) or
    (T, n). Optional: ``stamp`` (T,) s, without which there are `rate` traces per second; ``sigma``
    as one number, (T,) or (T, n); ``reference_depth`` (T,) of the array; as truth
    ``reflector_depth`` and ``reflector_amplitude`` (T, K), where a reflector is present while its
    amplitude exceeds 0.4 of its largest value.

    Any other file is read as a CSV of ``stamp``, ``depth``, ``amplitude`` and optionally ``std``,
    one row per sample, trace after trace. Raises `BagError`.
    """
    how = TracesOptions(**values)
    report = ConversionReport(Path(out))
    if Path(path).suffix.lower() == '.npz':
        records = _from_archive(report, Path(path), how.rate, how.frame_id)
    else:
        records = _from_table(report, CsvTable(path, how.options), how.frame_id)
    return write_bag(out, records, report, source=Path(path).name, storage=how.storage)


def _from_archive(
    report: ConversionReport, path: Path, rate: float, frame_id: str
) -> list[Record]:
    arrays = read_npz(path)
    for name in arrays.keys() & NAMES:
        numbers_of(path, name, arrays[name])
    for name in ('depth', 'amplitude'):
        if name not in arrays:
            raise BagError(f"{path} has no array '{name}'; it has {', '.join(arrays)}")
    amplitude = np.atleast_2d(arrays['amplitude'])
    depth, T = arrays['depth'], len(amplitude)
    if amplitude.ndim != 2 or depth.shape != amplitude.shape[1:]:
        raise BagError(
            f'{path}: depth has the shape {depth.shape} and amplitude {arrays["amplitude"].shape};'
            ' (n,) and (traces, n) are needed'
        )
    stamps = _stamps(arrays, path, T, rate)
    sigma = _rows(arrays, path, 'sigma', amplitude.shape)
    reference = _rows(arrays, path, 'reference_depth', (T,))
    records: list[Record] = []
    for k, stamp in enumerate(stamps):
        report.rows += 1
        try:
            trace = Trace(
                stamp_ns=stamp,
                frame_id=frame_id,
                depth=depth,
                amplitude=amplitude[k],
                sigma=None if sigma is None else sigma[k],
                reference_depth=None if reference is None else reference[k],
            )
        except Rejection as error:
            report.bad_row(path, f'trace {k}', error)
            continue
        records.append((stamp, '/trace', write_trace(trace, ros_message)))
    return records + _truth(arrays, path, stamps, frame_id)


def _stamps(arrays: Arrays, path: Path, count: int, rate: float) -> list[int]:
    if 'stamp' not in arrays:
        return [FIRST_STAMP_NS + round(k * 1e9 / rate) for k in range(count)]
    return stamps_of(path, arrays['stamp'], count, 'traces')


def _rows(arrays: Arrays, path: Path, name: str, shape: tuple[int, ...]) -> NDArray | None:
    """The array `name` broadcast to `shape`, from one number, one per trace or all of them; None
    when there is none."""
    value = arrays.get(name)
    if value is None:
        return None
    if value.ndim == 1 and len(shape) == 2 and len(value) == shape[0]:
        value = value[:, None]
    try:
        return np.broadcast_to(value, shape)
    except ValueError:
        raise BagError(
            f'{path}: {name} has the shape {value.shape} for {shape[0]} traces'
        ) from None


def _truth(arrays: Arrays, path: Path, stamps: list[int], frame_id: str) -> list[Record]:
    depth, amplitude = arrays.get('reflector_depth'), arrays.get('reflector_amplitude')
    if depth is None or amplitude is None:
        return []
    if depth.ndim != 2 or depth.shape != amplitude.shape or len(depth) != len(stamps):
        raise BagError(
            f'{path}: reflector_depth {depth.shape} and reflector_amplitude {amplitude.shape} '
            f'need one row for each of {len(stamps)} traces'
        )
    present = np.isfinite(depth) & (amplitude > PRESENT * np.nanmax(amplitude, axis=0))
    records = []
    for k, stamp in enumerate(stamps):
        there = np.flatnonzero(present[k])
        true = TrueReflectors(
            stamp_ns=stamp,
            frame_id=frame_id,
            track_id=(1 + there).astype(np.uint32),
            depth=depth[k, there].astype(np.float64),
            amplitude=amplitude[k, there].astype(np.float64),
        )
        records += records_of(true, '')
    return records


def _from_table(report: ConversionReport, table: CsvTable, frame_id: str) -> list[Record]:
    table.require('stamp', 'depth', 'amplitude')

    def parse(row: Row) -> tuple[int, float, float, float]:
        return row.stamp_ns(), row.number('depth'), row.optional('amplitude'), row.optional('std')

    records: list[Record] = []
    rows = report.read_rows(table, parse)
    for stamp, group in groupby(rows, key=lambda pair: pair[1][0]):
        lines = list(group)
        values = np.array([sample[1:] for _, sample in lines])
        try:
            trace = Trace(
                stamp_ns=stamp,
                frame_id=frame_id,
                depth=values[:, 0],
                amplitude=values[:, 1],
                sigma=values[:, 2],
            )
        except Rejection as error:
            report.bad_row(table.path, f'trace from line {lines[0][0].line}', error)
            continue
        records.append((stamp, '/trace', write_trace(trace, ros_message)))
    return records
