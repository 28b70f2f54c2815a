"""Traces of a sub-bottom profiler from SEG-Y, the format of seismic instruments.

Of the trace headers only the date, the sample interval and the recording delay are used. The
interval that small profilers state is often wrong; then the sample spacing has to be given.
Headers count whole seconds, so the traces of one second are spread over it evenly.
"""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from itertools import groupby
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters.array_records import write_trace

from ...measurements import Rejection, Trace
from ..conversion import ConversionReport, Record, write_bag
from ..messages import ros_message
from ..sources import BagError

if TYPE_CHECKING:
    import segyio

SECOND = 10**9


def convert_segy(
    path: str | Path,
    out: str | Path,
    *,
    sample_spacing: float | None = None,
    sound_speed: float = 1500.0,
    first_sample: int = 0,
    samples: int | None = None,
    stack: int = 1,
    depth_offset: float = 0.0,
    frame_id: str = 'profiler',
    storage: str = 'mcap',
) -> ConversionReport:
    """Convert a SEG-Y file to the topic ``/trace``.

    sample_spacing: m from sample to sample; None: from the sample interval and `sound_speed`.
    first_sample, samples: which part of a trace is taken. stack: how many successive traces are
    averaged into one, which has the stamp of the last. depth_offset: m, of the transducer. Raises
    `BagError`, and ModuleNotFoundError without segyio.
    """
    import segyio

    report = ConversionReport(Path(out))
    try:
        with segyio.open(str(path), 'r', ignore_geometry=True) as file:
            stamps = _stamps(file, Path(path))
            amplitude = np.asarray(file.trace.raw[:], np.float64)
            header = file.header[0]
            interval = header[segyio.TraceField.TRACE_SAMPLE_INTERVAL] * 1e-6
            delay = header[segyio.TraceField.DelayRecordingTime] * 1e-3
    except (OSError, RuntimeError, ValueError) as error:
        # segyio has no errors of its own.
        reason = getattr(error, 'strerror', None) or f'it is damaged or not SEG-Y ({error})'
        raise BagError(f'{path} cannot be read: {reason}') from None
    spacing = sample_spacing or 0.5 * sound_speed * interval
    if not spacing > 0.0:
        raise BagError(f'{path} states no sample interval; give the sample spacing')
    depth = depth_offset + 0.5 * sound_speed * delay + spacing * np.arange(amplitude.shape[1])
    part = slice(first_sample, None if samples is None else first_sample + samples)
    depth, amplitude = depth[part], amplitude[:, part]
    report.notes['sample_spacing'] = f'{spacing:g} m'
    records = _records(report, Path(path), stamps, depth, amplitude, stack, frame_id)
    return write_bag(out, records, report, source=Path(path).name, storage=storage)


def _records(
    report: ConversionReport,
    path: Path,
    stamps: list[int],
    depth: NDArray,
    amplitude: NDArray,
    stack: int,
    frame_id: str,
) -> list[Record]:
    records: list[Record] = []
    for first in range(0, len(stamps) - stack + 1, stack):
        report.rows += stack
        stamp = stamps[first + stack - 1]
        try:
            trace = Trace(
                stamp_ns=stamp,
                frame_id=frame_id,
                depth=depth,
                amplitude=amplitude[first : first + stack].mean(axis=0),
            )
        except Rejection as error:
            report.bad_row(path, f'trace {first}', error)
            continue
        records.append((stamp, '/trace', write_trace(trace, ros_message)))
    return records


def _stamps(file: segyio.SegyFile, path: Path) -> list[int]:
    """Nanoseconds since 1970 of every trace."""
    import segyio

    fields = segyio.TraceField
    names = ('YearDataRecorded', 'DayOfYear', 'HourOfDay', 'MinuteOfHour', 'SecondOfMinute')
    columns = [file.attributes(getattr(fields, name))[:] for name in names]
    try:
        seconds = [_seconds(*(int(value) for value in row)) for row in zip(*columns)]
    except (ValueError, OverflowError):
        raise BagError(f'{path}: the trace headers hold no date') from None
    stamps: list[int] = []
    for second, group in groupby(seconds):
        count = sum(1 for _ in group)
        stamps += [second * SECOND + k * SECOND // count for k in range(count)]
    return stamps


def _seconds(year: int, day: int, hour: int, minute: int, second: int) -> int:
    if day < 1:
        raise ValueError('days of a year begin with 1')
    start: Any = datetime(year, 1, 1, tzinfo=timezone.utc)
    moment = start + timedelta(days=day - 1, hours=hour, minutes=minute, seconds=second)
    return int(moment.timestamp())
