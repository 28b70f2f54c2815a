# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Lines of traces in SEG-Y and SU files: samples, times, places and depths by their headers.

Whatever differs from trace to trace is read from each trace: sample interval, recording delay and
its scalar. An interval that the trace headers leave out is that of the file header. Either byte
order is found. Headers count whole seconds, so the traces of one second are spread over it evenly.
Places are those of the source, else of the receiver group, else of the common depth point.

Source: SEG-Y revision 2.1, Society of Exploration Geophysicists, 2023.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta, timezone, tzinfo
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, TYPE_CHECKING

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import FloatArray, IntArray

from .. import SECOND
from .sources import BagError
from .times import BadRow, gps_minus_utc, moment_ns, zone_of

if TYPE_CHECKING:
    import segyio

HEADERS, TRACE_HEADER = 3600, 240
SAMPLE_BYTES = {3: 2, 8: 1, 6: 8, 7: 3, 9: 8, 11: 2, 12: 8, 15: 3, 16: 1}
"""Of each sample by the code of its format, where they are not 4."""
SCALARS = (1, 10, 100, 1000, 10_000)
"""Other values of a scalar word are none."""
METRES, ARC_SECONDS, DEGREES, DMS = 1, 2, 3, 4
"""Units of places."""
FEET, FOOT = 2, 0.3048
LOCAL, OTHER, GPS = 1, 3, 5
"""Time bases that are not UTC; 0 is taken for UTC."""
READ_OPTIONS = ('time_zone', 'start', 'rate', 'crs')
"""Arguments of `read_segy`, which are options of the conversion, too."""
PLACES = (('SourceX', 'SourceY'), ('GroupX', 'GroupY'), ('CDP_X', 'CDP_Y'))


@frozen(eq=False)
class SegyLine:
    """T traces of n samples."""

    stamps: list[int]
    """(T,) ns."""
    amplitude: NDArray
    """(T, n)."""
    interval: FloatArray
    """(T,) s from sample to sample; 0 where no header states it."""
    delay: FloatArray
    """(T,) s from the transmission to the first sample."""
    longitude: FloatArray
    """(T,) degrees; NaN where unknown."""
    latitude: FloatArray
    """(T,) degrees; NaN where unknown."""
    water_depth: FloatArray
    """(T,) m, 0 where not stated."""
    problems: list[str]
    """What could not be read or used, one sentence each."""
    questions: list[str]
    """What is assumed and may be wrong, one sentence each."""

    def spacing(self, sound_speed: float, stated: float | None = None) -> FloatArray:
        """Return the depth (T,) from sample to sample, m. stated: m, in place of the interval."""
        interval = 0.5 * sound_speed * self.interval
        return np.full(len(interval), stated) if stated else interval

    def first_depth(self, sound_speed: float, depth_offset: float) -> FloatArray:
        """Return the depth (T,) of the first sample, m, below a transducer at `depth_offset`."""
        return np.asarray(depth_offset + 0.5 * sound_speed * self.delay)


def is_segy(start: bytes) -> bool:
    """Return whether a file begins with a header of 3,200 characters, EBCDIC or ASCII, whose first
    line begins with C, and a format code that exists."""
    if len(start) < HEADERS or start[:1] not in (b'\xc3', b'C'):
        return False
    return bool(_byte_order(start)) and any(start[3220:3222])


def _byte_order(start: bytes) -> Literal['big', 'little', '']:
    """Return the byte order of the numbers in the file header, 'big' or 'little'; empty if neither
    gives a format code that exists."""
    constant = start[3296:3300]
    if constant in (b'\x01\x02\x03\x04', b'\x04\x03\x02\x01'):
        return 'big' if constant[0] == 1 else 'little'
    for order in ('big', 'little'):
        if 1 <= int.from_bytes(start[3224:3226], order) <= 16:
            return order
    return ''


def read_segy(
    path: str | Path,
    *,
    time_zone: str = '',
    start: str = '',
    rate: float = 1.0,
    crs: int | None = None,
) -> SegyLine:
    """Read a SEG-Y file, or an SU file (``.su``).

    :param time_zone: of times that are not UTC; empty if not known.
    :param start: time of the first trace, for traces without a date.
    :param rate: traces per second, for traces without date and time of day.
    :param crs: coordinate system of places in metres or feet, by its EPSG number.
    :raises BagError: the file cannot be read, or something that it leaves open is not stated.
    :raises ModuleNotFoundError: segyio is not installed.
    """
    problems: list[str] = []
    questions: list[str] = []
    try:
        with _opened(Path(path), problems) as (file, header):
            depth, scalar = _words(file, 'SourceWaterDepth', 'ElevationScalar')
            clock = _Clock(Path(path), time_zone, start, rate)
            return SegyLine(
                clock.stamps(file, questions),
                np.asarray(file.trace.raw[:], np.float64),
                _intervals(file, header, questions),
                _delays(file, problems),
                *_places(file, header, crs, problems),
                np.maximum(_scaled(depth, scalar), 0.0),
                problems,
                questions,
            )
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        # segyio has no errors of its own.
        reason = getattr(error, 'strerror', None) or f'it is damaged or not SEG-Y ({error})'
        raise BagError(f'{path} cannot be read: {reason}') from None


@contextmanager
def _opened(path: Path, problems: list[str]) -> Iterator[tuple[segyio.SegyFile, bytes]]:
    """Yield the file, or a copy of the whole traces of one that is cut off, which segyio refuses,
    and its header of 400 bytes in big-endian order, empty for SU."""
    import segyio

    size = path.stat().st_size
    with path.open('rb') as source, TemporaryDirectory() as folder:
        if path.suffix.lower() == '.su':
            with segyio.su.open(
                str(path), 'r', ignore_geometry=True, endian=_order_of_su(path, source.read(240))
            ) as file:
                yield file, b''
            return
        start = source.read(HEADERS)
        order = _byte_order(start)
        if len(start) < HEADERS or not order:
            raise BagError(f'{path} cannot be read: it has no file header of SEG-Y')
        samples, code, more = (
            int.from_bytes(start[k : k + 2], order, signed=k > 3500) for k in (3220, 3224, 3504)
        )
        begin = HEADERS + 3200 * max(more, 0)
        if stated := samples:
            words = start
        else:  # the trace headers have the number, too, and segyio reads that of the file only
            source.seek(begin + 114)
            word = source.read(2)
            samples, words = int.from_bytes(word, order), start[:3220] + word + start[3222:]
        each = TRACE_HEADER + samples * SAMPLE_BYTES.get(code, 4)
        traces, rest = divmod(max(size - begin, 0), each)
        if not traces:
            raise BagError(f'{path} cannot be read: it has no whole trace')
        if rest:
            problems.append(
                f'{path.name} is cut off in trace {traces + 1}; what came before it is kept'
            )
        if rest or not stated:
            path = Path(folder) / 'whole'
            with path.open('wb') as copy:
                source.seek(HEADERS)
                left = begin + traces * each - copy.write(words)
                while left and (part := source.read(min(left, 1 << 20))):
                    left -= copy.write(part)
        with segyio.open(str(path), 'r', ignore_geometry=True, endian=order) as file:
            yield file, start[3200:] if order == 'big' else _swapped(start[3200:])


@contextmanager
def opened_for_change(path: Path) -> Iterator[segyio.SegyFile]:
    """Open a SEG-Y file to change its traces.

    :raises BagError: the file is SU, or no SEG-Y.
    """
    import segyio

    with path.open('rb') as source:
        start = source.read(HEADERS)
    if not is_segy(start):
        raise BagError(f'{path} is no SEG-Y file whose samples could be replaced')
    order = _byte_order(start)
    with segyio.open(str(path), 'r+', ignore_geometry=True, endian=order) as file:
        yield file


def _swapped(header: bytes) -> bytes:
    """Return a file header in the other byte order, for its words of two bytes and the interval of
    eight."""
    words = bytearray(header)
    words[0::2], words[1::2] = header[1::2], header[0::2]
    words[72:80] = header[72:80][::-1]
    return bytes(words)


def _order_of_su(path: Path, header: bytes) -> str:
    """Return the byte order of an SU file: the one by which the file holds whole traces."""
    for order in ('little', 'big'):
        samples = int.from_bytes(header[114:116], order)
        if samples and path.stat().st_size % (TRACE_HEADER + 4 * samples) == 0:
            return order
    raise BagError(f'{path} cannot be read: it is damaged or no SU file')


def _words(file: segyio.SegyFile, *names: str) -> list[NDArray]:
    """Return words of the trace headers, (T,) each, by the names that segyio gives them."""
    import segyio

    return [file.attributes(getattr(segyio.TraceField, name))[:] for name in names]


def _intervals(file: segyio.SegyFile, header: bytes, questions: list[str]) -> FloatArray:
    """Return the sample interval (T,) of each trace, s, else that of the file."""
    # The fields are unsigned, which segyio does not know.
    own = _words(file, 'TRACE_SAMPLE_INTERVAL')[0].astype(np.int64) & 0xFFFF
    whole = float(int.from_bytes(header[16:18], 'big'))
    exact = np.frombuffer(header[72:80], '>f8') if len(header) >= 80 else np.zeros(1)
    # The revision is two words of one byte, of which the greater is the major one.
    if max(header[300:302], default=0) >= 2 and 0.0 < exact[0] < 1e6:
        return np.full(len(own), 1e-6 * exact[0])
    if whole and (own > 0).all() and not (own == whole).any():
        questions.append(
            f'the sample interval is {own[0]:g} us in the trace headers and {whole:g} us in that '
            f'of the file; the first is used. Of the other, depths are {whole / own[0]:.3g} times '
            'as large (--sample-spacing)'
        )
    return 1e-6 * np.where(own > 0, own, whole)


def _delays(file: segyio.SegyFile, problems: list[str]) -> FloatArray:
    """Return the recording delay (T,), s, from milliseconds with the scalar of times."""
    delay, scalar = _words(file, 'DelayRecordingTime', 'ScalarTraceHeader')
    if odd := sorted(set(scalar.tolist()) - {0, *SCALARS, *(-each for each in SCALARS)}):
        problems.append(f'{odd[0]} is no scalar of times; the recording delay is taken without it')

    return np.asarray(1e-3 * _scaled(delay, scalar))


def _scaled(value: NDArray, scalar: NDArray) -> FloatArray:
    """Return header words (T,) with their scalar: a multiplier if positive, a divisor if negative,
    nothing if no power of ten."""
    scalar = np.where(np.isin(np.abs(scalar), SCALARS), scalar, 1).astype(np.float64)
    return np.where(scalar > 0.0, value * scalar, value / np.abs(scalar))


def _places(
    file: segyio.SegyFile, header: bytes, crs: int | None, problems: list[str]
) -> tuple[FloatArray, FloatArray]:
    """Return longitude and latitude (T,), degrees; NaN where unknown."""
    units, scalar = _words(file, 'CoordinateUnits', 'SourceGroupScalar')
    x, y = (np.zeros(len(units)) for _ in 'xy')
    for names in PLACES:
        east, north = (_scaled(word, scalar) for word in _words(file, *names))
        none = (x == 0.0) & (y == 0.0)
        x, y = np.where(none, east, x), np.where(none, north, y)
    stated = (x != 0.0) | (y != 0.0)
    per_degree = np.select([units == ARC_SECONDS, units == DEGREES], [3600.0, 1.0], np.nan)
    longitude, latitude = (
        np.where(units == DMS, _degrees_of_dms(each), each / per_degree) for each in (x, y)
    )
    flat = stated & ~np.isin(units, (ARC_SECONDS, DEGREES, DMS))
    if flat.any():
        place = f'{x[flat][0]:.10g}, {y[flat][0]:.10g}'
        if not crs:
            unit = 'metres or feet' if (units[flat] == METRES).all() else 'an unknown unit'
            problems.append(
                f'{flat.sum()} places are not used: they are in {unit} ({place}); say their '
                'coordinate system, --crs EPSG'
            )
        else:
            from .export.points import degrees_of

            foot = int.from_bytes(header[54:56], 'big') == FEET
            there = np.stack([x[flat], y[flat]], axis=1) * (FOOT if foot else 1.0)
            longitude[flat], latitude[flat] = degrees_of(there, crs)
    good = stated & (np.abs(longitude) <= 360.0) & (np.abs(latitude) <= 90.0)
    if (bad := stated & ~good & (~flat | bool(crs))).any():
        place = f'{x[bad][0]:.10g}, {y[bad][0]:.10g}'
        problems.append(f'{bad.sum()} places are not used: {place} is no place on Earth')
    return np.where(good, longitude, np.nan), np.where(good, latitude, np.nan)


def _degrees_of_dms(value: FloatArray) -> FloatArray:
    """Return degrees (T,) of numbers of the form DDDMMSS.ss."""
    size = np.abs(value)
    minutes = np.floor(size / 100.0) % 100.0
    degrees = np.floor(size / 10_000.0) + minutes / 60.0 + (size % 100.0) / 3600.0
    return np.asarray(np.copysign(degrees, value))


@frozen
class _Clock:
    """How the times of traces are read; fields as the arguments of `read_segy`."""

    path: Path
    time_zone: str
    start: str
    rate: float

    def stamps(self, file: segyio.SegyFile, questions: list[str]) -> list[int]:
        """Return the stamps (T,) of all traces, ns."""
        names = ('YearDataRecorded', 'DayOfYear', 'HourOfDay', 'MinuteOfHour', 'SecondOfMinute')
        words = _words(file, *names, 'TimeBaseCode')
        year, day, hour, minute, second, base = (word.astype(np.int64) for word in words)
        clock = 3600 * hour + 60 * minute + second
        year = np.where((year >= 1) & (year < 100), year + np.where(year < 70, 2000, 1900), year)
        if ((year < 1) | (year > 9999) | (day < 1)).any():
            return self._undated(clock, questions, 'the trace headers hold no date')
        date, end = (
            each.astype('datetime64[Y]').astype('datetime64[D]').astype(np.int64)
            for each in (year - 1970, year - 1969)
        )
        if (wrong := np.flatnonzero(date + day > end)).size:
            k = wrong[0]
            questions.append(f'trace {k + 1} is of day {day[k]} of {year[k]}, which is no date')
            return self._undated(clock, questions, questions[-1])
        seconds = 86_400 * (date + day - 1) + clock

        unknown = np.isin(base, (LOCAL, OTHER))
        if unknown.any() and not self.time_zone:
            raise BagError(
                f'{self.path}: the times are local, and their zone is not stated; say --time-zone '
                'UTC, or that of the clock, e.g. --time-zone +02:00 or Europe/Berlin'
            )
        if self.time_zone:
            seconds = _in_utc(seconds, unknown | (base == 0), zone_of(self.time_zone))
        seconds = np.where(base == GPS, seconds - gps_minus_utc(seconds), seconds)
        return _spread(seconds)

    def _undated(self, clock: IntArray, questions: list[str], why: str) -> list[int]:
        """Return stamps from `start` on, by the time of day (T,) s, or evenly without it."""
        if not self.start:
            raise BagError(
                f'{self.path}: {why}; say when the first trace was recorded, --start '
                '2024-05-31T10:00:00Z'
            )
        try:
            start_ns = moment_ns(self.start, lambda: self.time_zone or 'UTC')
        except BadRow as error:
            raise BagError(f'--start: {error}') from None
        if start_ns is None:
            raise BagError(f"--start: '{self.start}' is not of the form 2024-05-31T10:00:00Z")
        if (clock == clock[0]).all():
            questions.append(
                f'the traces have no times: {self.rate:g} a second from --start on; is --rate '
                'right?'
            )
            step = SECOND / self.rate
            return [start_ns + round(k * step) for k in range(len(clock))]
        days = np.cumsum(np.diff(clock, prepend=clock[0]) < -43_200)
        passed = clock - clock[0] + 86_400 * days
        return [start_ns + stamp for stamp in _spread(passed)]


def _in_utc(seconds: IntArray, local: NDArray[np.bool_], zone: tzinfo) -> IntArray:
    """Return the seconds (T,), of which the `local` ones are of `zone`, as UTC."""
    known, place = np.unique(seconds, return_inverse=True)
    epoch, utc = datetime(1970, 1, 1), []
    for each in known.tolist():
        local_time = (epoch + timedelta(seconds=each)).replace(tzinfo=zone)
        utc.append(round((local_time - epoch.replace(tzinfo=timezone.utc)).total_seconds()))
    there = np.array(utc)
    return np.where(local, there[place.ravel()], seconds)


def _spread(seconds: IntArray) -> list[int]:
    """Return stamps, ns, of which those of one second are spread over it."""
    stamps: list[int] = []
    for second, group in groupby(seconds.tolist()):
        count = sum(1 for _ in group)
        stamps += [second * SECOND + k * SECOND // count for k in range(count)]
    return stamps
