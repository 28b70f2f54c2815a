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

Traces that are never negative are envelopes. For them the pulse and the noise are measured as the
tracker does (`water.look`), from six hundred traces all along the line at most, and written beside
the bag, where the tracker finds them. Where a gain that grows with time raises the noise with the
depth, each trace states it by depth. Places in seconds of arc or degrees become the topic
``/position``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TYPE_CHECKING

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from msg_adapters.array_records import write_trace
from sonar_imm.acoustics.envelopes import is_envelope
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Rejection, Trace
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm.trackers.fathometer.water import look

from ..conversion import ConversionReport, Record, write_bag
from ..convert_options import SegyOptions
from ..messages import ros_message
from ..positions import write_position
from ..sources import BagError

if TYPE_CHECKING:
    import segyio

SECOND = 10**9
HEADERS, TRACE_HEADER = 3600, 240
SAMPLE_BYTES = {3: 2, 8: 1, 6: 8, 7: 3, 9: 8, 11: 2, 12: 8, 15: 3, 16: 1}
"""Of each sample by the code of its format, where they are not 4."""
_LEAST_ARRIVALS, _NEAR = 10, 1.5
_RUNS, _RUN = 10, 60
"""Stretches of successive traces that are looked at, and how many each has."""


def convert_segy(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert a SEG-Y file to the topic ``/trace``, and ``/position`` where it states places.

    values: as in `SegyOptions`. Without sample_spacing the sample interval and sound_speed say it.
    A stack of traces has the stamp of the last. For envelopes the bag gets ``parameters.yaml``.
    Raises `BagError`, and ModuleNotFoundError without segyio.
    """
    how = SegyOptions(**values)
    report = ConversionReport(Path(out))
    line = read_segy(path, report.problems)
    spacing = how.sample_spacing or 0.5 * how.sound_speed * line.interval
    if not spacing > 0.0:
        raise BagError(f'{path} states no sample interval; give the sample spacing')
    start = 0.5 * how.sound_speed * line.delay
    depth = how.depth_offset + start + spacing * np.arange(line.amplitude.shape[1])
    part = slice(how.first_sample, None if how.samples is None else how.first_sample + how.samples)
    depth, amplitude = depth[part], line.amplitude[:, part]
    if amplitude.shape[1] < 2:
        raise BagError(f'{path}: fewer than two samples of a trace are left')
    report.notes['sample_spacing'] = f'{spacing:.9g} m'
    report.notes['stack'] = str(how.stack)
    report.notes['depth_of_sample_0'] = f'{how.depth_offset + start:.9g} m'
    if not how.sample_spacing:
        offset = start + spacing * how.first_sample
        if doubt := doubted_spacing(amplitude, spacing, offset, line.water_depth):
            report.notes['sample_interval'] = doubt
    own, sigma = _instrument(report, amplitude, spacing, how.stack)
    traces = (line.stamps, depth, amplitude, sigma)
    records = _records(report, Path(path), traces, how.stack, how.frame_id)
    records += _positions(line) if records else []
    return write_bag(
        out,
        records,
        report,
        source=Path(path).name,
        storage=how.storage,
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


@contextmanager
def _opened(path: Path, problems: list[str]) -> Iterator[segyio.SegyFile]:
    """The file, or a copy of the whole traces of one that is cut off, which segyio refuses."""
    import segyio

    with path.open('rb') as source, TemporaryDirectory() as folder:
        start = source.read(HEADERS)
        samples, code = (int.from_bytes(start[k : k + 2], 'big') for k in (3220, 3224))
        begin = HEADERS + 3200 * max(int.from_bytes(start[3504:3506], 'big', signed=True), 0)
        each = TRACE_HEADER + samples * SAMPLE_BYTES.get(code, 4)
        traces, rest = divmod(path.stat().st_size - begin, each)
        if rest and traces > 0:
            problems.append(
                f'{path.name} is cut off in trace {traces + 1}; what came before it is kept'
            )
            path = Path(folder) / 'whole'
            with path.open('wb') as copy:
                source.seek(0)
                left = begin + traces * each
                while left and (part := source.read(min(left, 1 << 20))):
                    left -= copy.write(part)
        with segyio.open(str(path), 'r', ignore_geometry=True) as file:
            yield file


def read_segy(path: str | Path, problems: list[str] | None = None) -> SegyLine:
    """problems: gets a sentence where the file is cut off. Raises `BagError`, and
    ModuleNotFoundError without segyio."""
    import segyio

    fields = segyio.TraceField
    try:
        with _opened(Path(path), [] if problems is None else problems) as file:
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
) -> tuple[dict[str, Any], FloatArray | None]:
    """Parameters of the tracker for the traces (T, n), none unless they are envelopes; and their
    noise (n,) where it grows with the depth."""
    if len(amplitude) < stack or not np.isfinite(amplitude).all() or not is_envelope(amplitude):
        return {}, None
    measured = measured_instrument(amplitude, spacing, stack)
    if measured is None:
        report.notes['pulse'] = (
            'the traces are envelopes, but no floor stands free to measure the pulse; leave out '
            'what the instrument adds (--first-sample) or give the tracker parameters'
        )
        return {}, None
    width, by_depth = float(f'{measured[0]:.3g}'), measured[1]
    noise, window = float(f'{np.median(by_depth):.3g}'), spacing * amplitude.shape[1]
    described, sigma = f'{noise:g}', None
    if by_depth[-1] > 2.0 * by_depth[0]:
        described = f'{by_depth[0]:.3g} to {by_depth[-1]:.3g}, growing with the depth'
        noise, sigma = 0.0, by_depth
    report.notes['pulse'] = f'of an envelope, {width:g} m; noise {described}; see parameters.yaml'
    return envelope_parameters(width, noise, window), sigma


def _records(
    report: ConversionReport,
    path: Path,
    traces: tuple[list[int], NDArray, NDArray, FloatArray | None],
    stack: int,
    frame_id: str,
) -> list[Record]:
    stamps, depth, amplitude, sigma = traces
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
                sigma=sigma,
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
    year, day, hour, minute, second = (
        file.attributes(getattr(fields, name))[:].astype(np.int64) for name in names
    )
    if ((year < 1) | (year > 9999) | (day < 1)).any():
        raise BagError(f'{path}: the trace headers hold no date')
    start = (year - 1970).astype('datetime64[Y]').astype('datetime64[s]').astype(np.int64)
    seconds = start + 86_400 * (day - 1) + 3600 * hour + 60 * minute + second
    stamps: list[int] = []
    for second, group in groupby(seconds.tolist()):
        count = sum(1 for _ in group)
        stamps += [second * SECOND + k * SECOND // count for k in range(count)]
    return stamps


def measured_instrument(
    amplitude: FloatArray, spacing: float, stack: int = 1
) -> tuple[float, FloatArray] | None:
    """Standard deviation of the pulse, m, and noise (n,), rms, of envelopes (T, n) with samples
    `spacing` m apart, of which `stack` successive ones are averaged; None when too few traces have
    a floor that stands free."""
    seen = look(_stretches(_stacked(amplitude, stack)), spacing)
    return (spacing * seen.pulse, seen.noise) if seen.pulse > 0.0 else None


def _stretches(amplitude: FloatArray) -> FloatArray:
    """Of many traces (T, n) some stretches of successive ones, all along the line."""
    T = len(amplitude)
    if T <= _RUNS * _RUN:
        return amplitude
    begin = np.linspace(0, T - _RUN, _RUNS).astype(np.int64)
    return amplitude[(begin[:, None] + np.arange(_RUN)).ravel()]


def _stacked(amplitude: FloatArray, stack: int) -> FloatArray:
    count = len(amplitude) // stack
    return np.asarray(amplitude[: count * stack].reshape(count, stack, -1).mean(axis=1))


def doubted_spacing(
    amplitude: FloatArray, spacing: float, offset: float, stated: NDArray
) -> str | None:
    """A sentence when samples `spacing` m apart, the first of the traces (T, n) `offset` m down,
    cannot be right; None otherwise. stated (T,): depth of the water by the headers, m, 0 where
    they say nothing."""
    span = offset + spacing * amplitude.shape[1]
    if not 1.0 <= span <= 12_000.0:
        return f'the sample interval of the headers makes the traces end at {span:g} m'
    if np.count_nonzero(stated > 0.0) < _LEAST_ARRIVALS or not is_envelope(amplitude):
        return None
    seen = look(amplitude, spacing)
    known = (stated > 0.0) & (seen.onset >= 0)
    if np.count_nonzero(known) < _LEAST_ARRIVALS:
        return None
    sample = offset / spacing + seen.onset[known] + seen.lead
    fits = float(np.median(stated[known] / sample))
    if fits / _NEAR <= spacing <= fits * _NEAR:
        return None
    return (
        f'the sample interval of the headers ({spacing:.3g} m a sample) puts the first arrivals '
        f'at {np.median(spacing * sample):.1f} m, where the headers themselves state '
        f'{np.median(stated[known]):.1f} m of water: {fits:.3g} m a sample would fit; '
        'give the sample spacing'
    )
