# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Numpy archives (npz): array snapshots, and ready-made traces such as depth responses computed
elsewhere; traces also as CSV.

The arrays of snapshots are found by their usual names (`NAMES`); other names can be given. Needed
are the complex samples, (bins, staves) for one ping or (pings, bins, staves), and the range or the
two-way time of each bin. Where the archive also has the true floor, with the height and tilt of
the sonar, it goes to ``/truth/estimate``. Both kinds of archive are opened and dated alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
import math
from pathlib import Path
from typing import Any
import zipfile
import zlib

import numpy as np
from numpy.typing import NDArray

from msg_adapters.array_records import write_trace
from msg_adapters.snapshots import write_snapshot
from sonar_imm.acoustics import array
from sonar_imm.measurements import Rejection, Snapshot, Trace
from sonar_imm.truth import PRESENT, TrueProfile, TrueReflectors

from ..conversion import ConversionReport, converter, Record, write_bag
from ..convert_options import SnapshotsOptions, TracesOptions
from ..mcap_records import MAX_RATIO, MAX_UNPACKED, TOO_LARGE
from ..messages import ros_message
from ..sources import BagError
from ..table_files import CsvTable
from ..tables import Row
from ..truth import records_of
from .navigation import ARRAYS, Frame, navigation_of_arrays, navigation_of_table

NAMES: dict[str, tuple[str, ...]] = {
    'iq': ('iq', 'snapshots', 'Y', 'quadrants'),
    'range': ('range', 'range_m', 'ranges', 'r'),
    'time': ('time', 'two_way_time'),
    'stamp': ('stamp', 'stamps', 'timestamp', 'timestamps', 'ping_time', 'unix_time', 'epoch'),
    'sound_speed': ('sound_speed', 'c'),
    'frequency': ('frequency', 'f0'),
    'element_spacing': ('element_spacing',),
    'spacing_wavelengths': ('spacing_wavelengths', 'element_spacing_wavelengths', 'dlam'),
    'sample_rate': ('sample_rate', 'fs'),
    'noise_variance': ('noise_variance', 'sn2'),
    'signal_variance': ('signal_variance', 'ss2'),
    'snr': ('snr', 'rho'),
    'height': ('height', 'h'),
    'patch': ('patch',),
    'sonar_height': ('sonar_height', 'H'),
    'tilt': ('tilt',),
    **ARRAYS,
}
"""Usual names of each array; the first one that the archive has is taken, of more than a letter
also in capitals. Stamps in s, ms, us, ns or datetime64, spacings in metres or wavelengths, snr
linear and at one stave, tilt in radians."""

TRACE_NAMES = {
    'depth', 'amplitude', 'sigma', 'reference_depth', 'reflector_depth', 'reflector_amplitude',
}  # fmt: skip
"""The arrays of traces that are read, beside their stamps."""

LONGEST_ECHO = 60.0
"""Seconds that sound takes there and back, at most."""
EPOCH_UNITS = {
    1: (0.0, 2.0**31),
    10**3: (1e11, 2.2e12),
    10**6: (1e14, 2.2e15),
    10**9: (1e17, 2e18),
}
"""Parts of a second in which times since 1970 are counted, by the size of those until 2038."""
FIRST_STAMP_NS = 1_700_000_000_000_000_000
Arrays = dict[str, NDArray]
_CONSTANTS = ('sound_speed', 'frequency', 'sample_rate', 'element_spacing')


@converter(SnapshotsOptions)
def convert_snapshots(path: Path, how: SnapshotsOptions, report: ConversionReport) -> None:
    """Convert an npz archive to the topic ``/snapshot``, one message per ping."""
    content = _Archive(path, how.names)
    samples = _samples(content, how.staves)
    times = content.get('stamp') if 'stamp' in how.names else content.times(len(samples))
    stamps = _stamps(content.path, times, len(samples), how.ping_rate, 'pings', report)
    constants = {name: content.number(name) for name in _CONSTANTS}
    wavelengths = content.number('spacing_wavelengths')
    if constants['element_spacing'] is None and wavelengths is not None:
        speed, frequency = constants['sound_speed'], constants['frequency']
        if speed and frequency:
            constants['element_spacing'] = wavelengths * speed / frequency
        else:  # for the parameters of the tracker
            report.notes['element_spacing_wavelengths'] = f'{wavelengths:g}'
    poses = {name: array for name in ARRAYS if (array := content.get(name)) is not None}
    frame = Frame()
    records = navigation_of_table(how.nav, how.nav_options, report, on_earth=False, frame=frame)
    records += [] if how.nav else navigation_of_arrays(poses, stamps, path, report, frame)
    for ping, (stamp, iq) in enumerate(zip(stamps, samples)):
        report.rows += 1
        snapshot = None
        with report.leaving_out(content.path, f'ping {ping}'):
            snapshot = _snapshot(content, ping, stamp, iq, constants, how.frame_id)
            records.append((stamp, '/snapshot', write_snapshot(snapshot, ros_message)))
        if snapshot and (profile := _true_floor(content, ping, snapshot)) is not None:
            records += records_of(profile, '')
    _note_ignored(path, content.unused, report)
    own = {'bathymetry': frame.parameters()}
    write_bag(report, records, path, how, own, needed='/snapshot')


def _note_ignored(path: Path, arrays: Sequence[str], report: ConversionReport) -> None:
    if arrays:
        report.notes[f'ignored arrays of {path.name}'] = ', '.join(arrays)


class _Archive:
    """The arrays of an npz file, by the names of `NAMES`."""

    def __init__(self, path: str | Path, names: Mapping[str, str]):
        self.path = Path(path)
        usual = {other: what for what, others in NAMES.items() for other in others}
        names = {usual.get(name, name): array for name, array in names.items()}
        if unknown := [name for name in names if name not in NAMES]:
            raise BagError(f"unknown array '{unknown[0]}'; the names are {', '.join(NAMES)}")
        there = read_npz(self.path)
        self._arrays: dict[str, NDArray] = {}
        taken: set[str] = set()
        for what, usually in NAMES.items():
            candidates = (names[what],) if what in names else usually
            found = [name for name in candidates if name in there]
            found += [name for name in there if len(name) > 1 and name.lower() in candidates]
            taken |= set(found)
            if found:
                array = there[found[0]]
                dated = what == 'stamp' and array.dtype.kind == 'M'
                self._arrays[what] = array if dated else numbers_of(self.path, found[0], array)
            elif what in names:
                raise BagError(f"{path} has no array '{names[what]}'; it has {', '.join(there)}")
        self.listed = ', '.join(there)
        self.unused = [name for name in there if name not in taken]

    def get(self, what: str) -> NDArray | None:
        return self._arrays.get(what)

    def times(self, pings: int) -> NDArray | None:
        """Give the stamps: also a time of each ping beside the range of each bin."""
        time = self.get('time')
        if 'stamp' in self._arrays or time is None or 'range' not in self._arrays:
            return self.get('stamp')
        of_pings = time.shape == (pings,) and np.nanmax(np.abs(time), initial=0.0) > LONGEST_ECHO
        return time if of_pings or time.shape == (pings,) != self._arrays['range'].shape else None

    def need(self, *what: str) -> NDArray:
        """Give the first of these that is there. Raises `BagError`."""
        for each in what:
            if each in self._arrays:
                return self._arrays[each]
        usual = ' or '.join(name for each in what for name in NAMES[each])
        raise BagError(f'{self.path} has no array {usual}; it has {self.listed}')

    def number(self, what: str) -> float | None:
        """Give a scalar; None when the archive has none."""
        value = self.get(what)
        if value is not None and (value.size != 1 or not np.isfinite(value).all()):
            raise BagError(f'{self.path}: {what} has to be one finite number')
        return None if value is None else float(value.ravel()[0])

    def per_bin(self, what: str, ping: int, bins: int) -> NDArray | None:
        """Give the row (bins,) of a ping, from one number, (bins,) or (pings, bins); None when the
        archive has none."""
        value = self.get(what)
        if value is None:
            return None
        row = value[min(ping, len(value) - 1)] if value.ndim == 2 and len(value) else value
        if row.size == 1:
            return np.full(bins, row.ravel()[0])
        if row.shape != (bins,):
            raise Rejection('bad_shape', f'{what} has the shape {value.shape} for {bins} bins')
        return row


def _samples(content: _Archive, staves: Sequence[Sequence[int]] | None) -> NDArray:
    """The samples (pings, bins, staves)."""
    iq = content.need('iq')
    if iq.ndim not in (2, 3) or not np.issubdtype(iq.dtype, np.complexfloating):
        raise BagError(
            f'{content.path}: the samples are {iq.dtype} of shape {iq.shape}; complex of shape '
            '(bins, staves) or (pings, bins, staves) are needed'
        )
    iq = iq[None] if iq.ndim == 2 else iq
    if staves is None:
        return iq
    channels = iq.shape[2]
    if wrong := [k for stave in staves for k in stave if not 0 <= k < channels]:
        raise BagError(f'{content.path} has the channels 0 to {channels - 1}, not {wrong[0]}')
    return np.stack([iq[:, :, list(stave)].sum(axis=2) for stave in staves], axis=2)


def _snapshot(
    content: _Archive,
    ping: int,
    stamp: int,
    iq: NDArray,
    constants: Mapping[str, Any],
    frame_id: str,
) -> Snapshot:
    bins = len(iq)
    ranges, time = content.per_bin('range', ping, bins), None
    if ranges is None:
        content.need('range', 'time')
        time = content.per_bin('time', ping, bins)
        assert time is not None
        ranges = np.asarray(0.5 * (constants['sound_speed'] or 1500.0) * time)
    noise, signal, ratio = (
        content.per_bin(name, ping, bins) for name in ('noise_variance', 'signal_variance', 'snr')
    )
    if signal is None and ratio is not None and noise is not None:
        signal = ratio * noise
    return Snapshot(
        stamp_ns=stamp,
        frame_id=frame_id,
        range=ranges,
        iq=iq,
        two_way_time=time,
        noise_variance=noise,
        signal_variance=signal,
        **constants,
    )


def _true_floor(content: _Archive, ping: int, snapshot: Snapshot) -> TrueProfile | None:
    """The true floor, when the archive has it and says where the sonar was."""
    bins = len(snapshot)
    height = content.per_bin('height', ping, bins)
    sonar_height, tilt = content.number('sonar_height'), content.number('tilt')
    if height is None or sonar_height is None or tilt is None or not math.isfinite(tilt):
        return None
    depth = sonar_height - height
    patch = content.per_bin('patch', ping, bins)
    outward = array.across_track(depth, snapshot.range)
    return TrueProfile(
        stamp_ns=snapshot.stamp_ns,
        frame_id=snapshot.frame_id,
        range=snapshot.range,
        height=np.asarray(height, np.float64),
        angle=array.angle_of_depth(depth, snapshot.range, tilt),
        patch=np.zeros(bins, bool) if patch is None else np.asarray(patch, bool),
        valid=np.abs(depth) <= snapshot.range,
        xyz=np.column_stack([np.zeros(bins), -outward, -depth]),
    )


@converter(TracesOptions)
def convert_traces(path: Path, how: TracesOptions, report: ConversionReport) -> None:
    """Convert traces to the topic ``/trace``.

    In an archive (.npz) ``sigma`` is one number, (T,) or (T, n), ``reference_depth`` (T,) of the
    array; as truth a reflector is present while its amplitude exceeds 0.4 of its largest value.
    Any other file is a CSV, one row per sample, trace after trace.
    """
    records = navigation_of_table(how.nav, how.nav_options, report, on_earth=True)
    if path.suffix.lower() == '.npz':
        records += _from_archive(report, path, how.rate, how.frame_id)
    else:
        records += _from_table(report, CsvTable(path, how.options), how.frame_id)
    write_bag(report, records, path, how, needed='/trace')


def _from_archive(
    report: ConversionReport, path: Path, rate: float, frame_id: str
) -> list[Record]:
    arrays = read_npz(path)
    ignored = [name for name in arrays if name not in {*TRACE_NAMES, 'stamp'}]
    _note_ignored(path, ignored, report)
    for name in arrays.keys() & TRACE_NAMES:
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
    stamps = _stamps(path, arrays.get('stamp'), T, rate, 'traces', report)
    shapes = (('sigma', amplitude.shape), ('reference_depth', (T,)))
    given = {'amplitude': amplitude} | {
        name: _rows(path, name, arrays[name], shape) for name, shape in shapes if name in arrays
    }
    records: list[Record] = []
    for k, stamp in enumerate(stamps):
        report.rows += 1
        with report.leaving_out(path, f'trace {k}'):
            own = {name: array[k] for name, array in given.items()}
            trace = Trace(stamp_ns=stamp, frame_id=frame_id, depth=depth, **own)
            records.append((stamp, '/trace', write_trace(trace, ros_message)))
    return records + _true_reflectors(arrays, path, stamps, frame_id)


def _rows(path: Path, name: str, value: NDArray, shape: tuple[int, ...]) -> NDArray:
    """The array `name` broadcast to `shape`, from one number, one per trace or all of them."""
    if value.ndim == 1 and len(shape) == 2 and len(value) == shape[0]:
        value = value[:, None]
    try:
        return np.broadcast_to(value, shape)
    except ValueError:
        sentence = f'{path}: {name} has the shape {value.shape} for {shape[0]} traces'
        raise BagError(sentence) from None


def _true_reflectors(arrays: Arrays, path: Path, stamps: list[int], frame_id: str) -> list[Record]:
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
        samples = np.array([sample[1:] for _, sample in lines]).T
        given = dict(zip(('depth', 'amplitude', 'sigma'), samples))
        with report.leaving_out(table.path, f'trace from line {lines[0][0].line}'):
            trace = Trace(stamp_ns=stamp, frame_id=frame_id, **given)
            records.append((stamp, '/trace', write_trace(trace, ros_message)))
    return records


def read_npz(path: Path) -> dict[str, NDArray]:
    """Every array of a numpy archive (npz) by name. Raises `BagError`."""
    try:
        with path.open('rb') as file:
            if not zipfile.is_zipfile(file):
                raise BagError(f'{path} is not a numpy archive (npz)')
        with zipfile.ZipFile(path) as packed:
            size = sum(part.file_size for part in packed.infolist())
        if size > max(MAX_UNPACKED, MAX_RATIO * path.stat().st_size):
            raise BagError(f'{path} {TOO_LARGE}')
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError('numpy gives the bytes of anything else, such as an archive')
        return arrays
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror or error}') from None
    except (ValueError, EOFError, MemoryError, zlib.error, zipfile.BadZipFile):
        raise BagError(f'{path} is damaged, or holds more than plain arrays') from None


def numbers_of(path: Path, name: str, array: NDArray) -> NDArray:
    """The array `name` of an archive, where it holds numbers. Raises `BagError`."""
    if array.dtype.kind not in 'biufc':
        raise BagError(f"{path}: the array '{name}' holds no numbers")
    return array


def _stamps(
    path: Path, times: NDArray | None, count: int, rate: float, what: str, report: ConversionReport
) -> list[int]:
    """Nanoseconds of the stamps of `count` messages, `what` names them; `rate` per second without
    any. Raises `BagError` for those that a message cannot hold."""
    if times is None:
        flag = {'pings': '--ping-rate', 'traces': '--rate'}[what]
        report.notes['stamps'] = f'the archive states none: {rate:g} {what} a second ({flag})'
        return [FIRST_STAMP_NS + round(k * 1e9 / rate) for k in range(count)]
    if times.dtype.kind == 'M':
        times = times.astype('datetime64[ns]').astype(np.int64)
    values = numbers_of(path, 'stamp', times).ravel()
    size = np.abs(values.astype(np.float64))
    for parts, (least, most) in EPOCH_UNITS.items():
        if len(values) == count and (least <= size).all() and (size < most).all():
            if values.dtype.kind in 'iu':
                return [int(stamp) * (10**9 // parts) for stamp in values]
            return [round(float(stamp) * (1e9 / parts)) for stamp in values.real]
    raise BagError(f'{path}: {count} {what} need as many finite stamps, in seconds before 2038')
