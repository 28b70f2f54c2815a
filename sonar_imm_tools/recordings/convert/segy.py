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

"""Traces of a sub-bottom profiler from SEG-Y, the format of seismic instruments.

Of the trace headers the date, the sample interval, the recording delay, the place and the depth of
the water are used. The interval that small profilers state is often wrong: where it does not go
with the depth of the water that the headers state, that is said, and the sample spacing has to be
given. Headers count whole seconds, so the traces of one second are spread over it evenly.

Traces that are never negative are envelopes. For them the pulse and the noise are measured
(`profiler`) and written beside the bag, where the tracker finds them. Places in seconds of arc or
degrees become the topic ``/position``.
"""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from itertools import groupby
from pathlib import Path
from typing import Any, TYPE_CHECKING

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from msg_adapters.array_records import write_trace
from sonar_imm.measurements import Rejection, Trace
from sonar_imm.trackers.fathometer.response import envelope_parameters

from ..conversion import ConversionReport, Record, write_bag
from ..messages import ros_message
from ..positions import write_position
from ..sources import BagError
from .profiler import doubted_spacing, is_envelope, measured_instrument

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
    """Convert a SEG-Y file to the topic ``/trace``, and ``/position`` where it states places.

    sample_spacing: m from sample to sample; None: from the sample interval and `sound_speed`.
    first_sample, samples: which part of a trace is taken. stack: how many successive traces are
    averaged into one, which has the stamp of the last. depth_offset: m, of the transducer. Of
    envelopes the bag gets ``parameters.yaml``. Raises `BagError`, and ModuleNotFoundError without
    segyio.
    """
    report = ConversionReport(Path(out))
    line = read_segy(path)
    spacing = sample_spacing or 0.5 * sound_speed * line.interval
    if not spacing > 0.0:
        raise BagError(f'{path} states no sample interval; give the sample spacing')
    start = 0.5 * sound_speed * line.delay
    depth = depth_offset + start + spacing * np.arange(line.amplitude.shape[1])
    part = slice(first_sample, None if samples is None else first_sample + samples)
    depth, amplitude = depth[part], line.amplitude[:, part]
    if amplitude.shape[1] < 2:
        raise BagError(f'{path}: fewer than two samples of a trace are left')
    report.notes['sample_spacing'] = f'{spacing:.9g} m'
    report.notes['stack'] = str(stack)
    report.notes['depth_of_sample_0'] = f'{depth_offset + start:.9g} m'
    if not sample_spacing:
        offset = start + spacing * first_sample
        if doubt := doubted_spacing(amplitude, spacing, offset, line.water_depth):
            report.notes['sample_interval'] = doubt
    records = _records(report, Path(path), line.stamps, depth, amplitude, stack, frame_id)
    records += _positions(line) if records else []
    own = _instrument(report, amplitude, spacing, stack)
    return write_bag(
        out,
        records,
        report,
        source=Path(path).name,
        storage=storage,
        parameters={'fathometer': own},
    )


@frozen(eq=False)
class SegyLine:
    """What of a SEG-Y file is used: stamps, ns, of its T traces; amplitude (T, n); interval from
    sample to sample and delay of the first, s; longitude and latitude (T,) degrees, NaN where
    unknown; water_depth (T,) m, 0 where not stated."""

    stamps: list[int]
    amplitude: NDArray
    interval: float
    delay: float
    longitude: NDArray
    latitude: NDArray
    water_depth: NDArray


def read_segy(path: str | Path) -> SegyLine:
    """Raises `BagError`, and ModuleNotFoundError without segyio."""
    import segyio

    fields = segyio.TraceField
    try:
        with segyio.open(str(path), 'r', ignore_geometry=True) as file:
            header = file.header[0]
            depth = file.attributes(fields.SourceWaterDepth)[:]
            return SegyLine(
                _stamps(file, Path(path)),
                np.asarray(file.trace.raw[:], np.float64),
                # The field is unsigned, which segyio does not know.
                (header[fields.TRACE_SAMPLE_INTERVAL] & 0xFFFF) * 1e-6,
                header[fields.DelayRecordingTime] * 1e-3,
                *_places(file),
                np.maximum(_scaled(depth, file.attributes(fields.ElevationScalar)[:]), 0.0),
            )
    except (OSError, RuntimeError, ValueError) as error:
        # segyio has no errors of its own.
        reason = getattr(error, 'strerror', None) or f'it is damaged or not SEG-Y ({error})'
        raise BagError(f'{path} cannot be read: {reason}') from None


def _scaled(value: NDArray, scalar: NDArray) -> NDArray:
    """Header words (T,) with their scalar: a multiplier when positive, a divisor when negative."""
    scalar = np.where(scalar == 0, 1, scalar).astype(np.float64)
    return np.where(scalar > 0.0, value * scalar, value / np.abs(scalar))


def _places(file: segyio.SegyFile) -> tuple[NDArray, NDArray]:
    """Longitude and latitude (T,), degrees; NaN where the headers say none, or metres of a grid
    that they do not name."""
    import segyio

    fields = segyio.TraceField
    units = file.attributes(fields.CoordinateUnits)[:]
    scalar = file.attributes(fields.SourceGroupScalar)[:]
    per_degree = np.select([units == 2, units == 3], [3600.0, 1.0], np.nan)
    x = _scaled(file.attributes(fields.SourceX)[:], scalar) / per_degree
    y = _scaled(file.attributes(fields.SourceY)[:], scalar) / per_degree
    good = (np.abs(x) <= 360.0) & (np.abs(y) <= 90.0) & ((x != 0.0) | (y != 0.0))
    return np.where(good, x, np.nan), np.where(good, y, np.nan)


def _positions(line: SegyLine) -> list[Record]:
    """Where the line was whenever its headers say a new place."""
    records: list[Record] = []
    last = (np.nan, np.nan)
    for stamp, place in zip(line.stamps, zip(line.longitude, line.latitude)):
        if np.isfinite(place).all() and place != last:
            records.append((stamp, '/position', write_position(stamp, *map(float, place))))
            last = place
    return records


def _instrument(
    report: ConversionReport, amplitude: NDArray, spacing: float, stack: int
) -> dict[str, Any]:
    """Parameters of the tracker for the traces (T, n), none unless they are envelopes."""
    if len(amplitude) < stack or not np.isfinite(amplitude).all() or not is_envelope(amplitude):
        return {}
    measured = measured_instrument(amplitude, spacing, stack)
    if measured is None:
        report.notes['pulse'] = (
            'the traces are envelopes, but no first arrival stands free to measure the pulse; '
            'leave out the transmit pulse (--first-sample) or give the tracker parameters'
        )
        return {}
    width, noise = (float(f'{value:.3g}') for value in measured)
    report.notes['pulse'] = f'of an envelope, {width:g} m; noise {noise:g}; see parameters.yaml'
    return envelope_parameters(width, noise)


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
