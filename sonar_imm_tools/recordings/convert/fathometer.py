# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Traces of a sub-bottom profiler from SEG-Y, and the sound of an array of hydrophones.

The interval that small profilers state is often wrong: where it does not go with the depth of the
water that the headers state, that is said, and the sample spacing has to be given. Where delay or
interval change along the line, so do the depths of the traces.

Traces that are never negative are envelopes. For them the pulse and the noise are measured as the
tracker does, from six hundred traces all along the line at most, and written beside the bag. Where
a gain that grows with time raises the noise with the depth, each trace states it by depth.

Sound (WAV or FLAC, one channel for each hydrophone) is read in blocks, so that the length of a
file does not matter. What a full scale is worth in pascals is an option: the tracker needs ratios
only. Whole numbers of 16 bits stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
import json
import math
from operator import itemgetter
from pathlib import Path
import re
import time
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters.array_records import write_pressure, write_trace
from sonar_imm.acoustics.envelopes import is_envelope
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Pressure, Trace
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm.trackers.fathometer.water import measure_line

from ... import SECOND
from ..conversion import ConversionReport, converter, new_bag, Record, write_bag
from ..convert_options import HydrophonesOptions, SegyOptions
from ..messages import ros_message
from ..positions import write_position
from ..segy_lines import READ_OPTIONS, read_segy, SegyLine
from ..sources import BagError
from ..times import BadRow, moment_ns
from ..writer import BagWriter
from .navigation import navigation_of_table

if TYPE_CHECKING:
    import soundfile

GRID_OPTIONS = ('sound_speed', 'sample_spacing', 'depth_offset')
_LEAST_ARRIVALS, _NEAR = 10, 1.5
_RUNS, _RUN = 10, 60
"""Stretches of successive traces that are looked at, and how many each has."""


@converter(SegyOptions)
def convert_segy(path: Path, how: SegyOptions, report: ConversionReport) -> None:
    """Convert a SEG-Y file to the topic ``/trace``, and ``/position`` where it states places.

    Without sample_spacing the sample interval and sound_speed say it. A stack of traces has the
    stamp of the last. For envelopes the bag gets ``parameters.yaml``. Raises `BagError`, and
    ModuleNotFoundError without segyio.
    """
    line = read_segy(path, **{name: getattr(how, name) for name in READ_OPTIONS})
    report.problems += line.problems
    report.questions += line.questions
    windows = _windows(line, how)
    usual = max(windows, key=lambda window: len(window.rows))
    if not all(window.spacing > 0.0 for window in windows):
        raise BagError(f'{path} states no sample interval; say --sample-spacing')
    amplitude = line.amplitude[usual.rows.start : usual.rows.stop, usual.samples]
    if amplitude.shape[1] < 2:
        raise BagError(f'{path}: fewer than two samples of a trace are left')
    _note_windows(report, windows, how)
    if not how.sample_spacing:
        offset = usual.depth(line)[0] - how.depth_offset
        stated = line.water_depth[usual.rows]
        if doubt := doubted_spacing(amplitude, usual.spacing, offset, stated):
            report.notes['sample_interval'] = doubt
    own, sigma = _instrument(report, amplitude, usual.spacing, how.stack)
    if own and how.first_sample:
        # The transmit pulse is left out: what comes first may be a shallow floor.
        first = min(window.depth(line)[0] for window in windows)
        own['blanking'] = max(0.0, math.floor(100.0 * first) / 100.0)
    records: list[Record] = []
    for window in windows:
        depth, noise = window.depth(line), sigma
        if sigma is not None and window is not usual:
            noise = np.interp(depth, usual.depth(line), sigma)
        for begin in range(window.rows.start, window.rows.stop - how.stack + 1, how.stack):
            report.rows += how.stack
            rows = slice(begin, begin + how.stack)
            stamp = line.stamps[rows.stop - 1]
            with report.leaving_out(path, f'trace {begin}'):
                trace = Trace(
                    stamp_ns=stamp,
                    frame_id=how.frame_id,
                    depth=depth,
                    amplitude=line.amplitude[rows, window.samples].mean(axis=0),
                    sigma=noise,
                )
                records.append((stamp, '/trace', write_trace(trace, ros_message)))
    if records:
        beside = navigation_of_table(how.nav, how.nav_options, report, on_earth=True)
        records += beside or _positions(line)
    write_bag(report, records, path, how, {'fathometer': own})


class Window(NamedTuple):
    """Successive traces whose samples lie at the same depths."""

    rows: range
    first: float
    """Depth of the first sample of the file, m."""
    spacing: float
    """m from sample to sample."""
    samples: slice
    """The samples that are taken."""

    def depth(self, line: SegyLine) -> FloatArray:
        """Return the depth of the taken samples, m."""
        whole = self.first + self.spacing * np.arange(line.amplitude.shape[1])
        return np.asarray(whole[self.samples])


def _windows(line: SegyLine, how: SegyOptions) -> list[Window]:
    spacing = line.spacing(how.sound_speed, how.sample_spacing)
    first = line.first_depth(how.sound_speed, how.depth_offset)
    begins = np.flatnonzero((np.diff(spacing) != 0.0) | (np.diff(first) != 0.0)) + 1
    end = None if how.samples is None else how.first_sample + how.samples
    bounds = [0, *begins.tolist(), len(spacing)]
    return [
        Window(range(a, b), float(first[a]), float(spacing[a]), slice(how.first_sample, end))
        for a, b in zip(bounds, bounds[1:])
    ]


def _note_windows(report: ConversionReport, windows: list[Window], how: SegyOptions) -> None:
    """Note where the samples lie, for the reader and for the export of horizons."""
    for name, values in (
        ('sample_spacing', [window.spacing for window in windows]),
        ('depth_of_sample_0', [window.first for window in windows]),
    ):
        low, high = min(values), max(values)
        changes = f'{low:.9g} to {high:.9g} m, as the headers state trace by trace'
        report.notes[name] = f'{low:.9g} m' if low == high else changes
    report.notes['stack'] = str(how.stack)
    names, usual = (*READ_OPTIONS, *GRID_OPTIONS), SegyOptions()
    told = [n for n in names if n == 'sound_speed' or getattr(how, n) != getattr(usual, n)]
    report.notes['read_as'] = json.dumps({name: getattr(how, name) for name in told})


def _positions(line: SegyLine) -> list[Record]:
    """Where the line was whenever its headers say a new place."""
    places = zip(line.stamps, line.longitude.tolist(), line.latitude.tolist())
    known = (each for each in places if np.isfinite(each[1:]).all())
    new = (next(group) for _, group in groupby(known, key=itemgetter(1, 2)))
    return [(stamp, '/position', write_position(stamp, *place)) for stamp, *place in new]


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


def measured_instrument(
    amplitude: FloatArray, spacing: float, stack: int = 1
) -> tuple[float, FloatArray] | None:
    """Standard deviation of the pulse, m, and noise (n,), rms, of envelopes (T, n) with samples
    `spacing` m apart, of which `stack` successive ones are averaged; None when too few traces have
    a floor that stands free."""
    T = len(amplitude) // stack
    stacked = amplitude[: T * stack].reshape(T, stack, -1).mean(axis=1)
    if T > _RUNS * _RUN:  # some stretches of successive traces, all along the line
        begin = np.linspace(0, T - _RUN, _RUNS).astype(np.int64)
        stacked = stacked[(begin[:, None] + np.arange(_RUN)).ravel()]
    tables = measure_line(stacked, spacing)
    return (spacing * tables.pulse, tables.noise) if tables.pulse > 0.0 else None


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
    tables = measure_line(amplitude, spacing)
    known = (stated > 0.0) & (tables.onset >= 0)
    if np.count_nonzero(known) < _LEAST_ARRIVALS:
        return None
    sample = offset / spacing + tables.onset[known] + tables.lead
    fits = float(np.median(stated[known] / sample))
    if fits / _NEAR <= spacing <= fits * _NEAR:
        return None
    return (
        f'the sample interval of the headers ({spacing:.3g} m a sample) puts the first arrivals '
        f'at {np.median(spacing * sample):.1f} m, where the headers themselves state '
        f'{np.median(stated[known]):.1f} m of water: {fits:.3g} m a sample would fit; '
        'give the sample spacing'
    )


LONGEST_BLOCK = 2**24
"""Samples of all channels in a block."""
FULL_SCALE = 2**15
_NAMED = re.compile(r'(?<!\d)(?:20)?(\d\d)(\d\d)(\d\d)[T_\-.]?(\d\d)(\d\d)(\d\d)(?!\d)')


@converter(HydrophonesOptions)
def convert_hydrophones(path: Path, how: HydrophonesOptions, report: ConversionReport) -> None:
    """Convert the channels of a sound file to the topic ``/pressure``, block by block.

    The bag gets ``parameters.yaml`` with the number of hydrophones.
    """
    places = navigation_of_table(how.nav, how.nav_options, report, on_earth=True)
    try:
        import soundfile
    except ImportError:
        raise BagError("sound needs soundfile: pip install 'sonar_imm[sound]'") from None
    try:
        audio = soundfile.SoundFile(str(path))
    except (soundfile.LibsndfileError, OSError) as error:
        raise BagError(f'{path} cannot be read as sound: {error}') from None
    with audio:
        channels = _channels(audio, how.channels)
        start_ns = _start_ns(path, how)
        if not how.start:
            utc = np.datetime64(start_ns, 'ns').astype('datetime64[s]')
            report.notes['start'] = f'{utc}Z by the name of the file (--start, --time-zone)'
        rows = max(2, round(how.block * audio.samplerate))
        if rows * audio.channels > LONGEST_BLOCK:
            raise BagError(
                f'blocks of {how.block:g} s have {rows * audio.channels} samples; say a shorter '
                '--block'
            )
        report.notes['sound'] = (
            f'{audio.channels} channels, {audio.samplerate} Hz, '
            f'{audio.frames / audio.samplerate:.1f} s, {audio.subtype}'
        )
        if 'should be' in audio.extra_info:  # words of libsndfile
            report.problems.append(
                f'{path.name} is shorter than it says of itself; what is there is kept'
            )
        report.notes['full scale'] = f'{how.full_scale:g} Pa'
        own = {'fathometer': {'phones': len(channels)}}
        with new_bag(report, path.name, how, own) as bag:
            _write_blocks(audio, bag, report, how, channels, start_ns, rows)
            if not bag.counts:
                raise report.nothing(path)
            for stamp_ns, topic, message in places:
                bag.write(topic, message, stamp_ns)


def _write_blocks(
    audio: soundfile.SoundFile,
    bag: BagWriter,
    report: ConversionReport,
    how: HydrophonesOptions,
    channels: list[int],
    start_ns: int,
    rows: int,
) -> None:
    source, whole, done = Path(audio.name), audio.subtype == 'PCM_16', 0
    while True:
        try:
            samples = audio.read(rows, dtype='int16' if whole else 'float32', always_2d=True)
        except RuntimeError as error:
            report.problems.append(f'{source.name}: the rest cannot be read: {error}')
            return
        if len(samples) < 2:
            return
        report.rows += len(samples)
        scale = how.full_scale / FULL_SCALE if whole else 0.0
        pressure = samples[:, channels] * np.float32(scale or how.full_scale)
        stamp_ns = start_ns + round(done * SECOND / audio.samplerate)
        done += len(samples)
        with report.leaving_out(source, f'{done / audio.samplerate:.1f} s'):
            block = Pressure(
                stamp_ns=stamp_ns,
                frame_id=how.frame_id,
                pressure=pressure,
                sample_rate=float(audio.samplerate),
                reference_depth=how.depth,
                scale=scale,
            )
            bag.write('/pressure', write_pressure(block, ros_message), stamp_ns)


def _channels(audio: soundfile.SoundFile, wanted: Sequence[int] | None) -> list[int]:
    """The channels of the hydrophones, the deepest first."""
    channels = list(range(audio.channels)) if wanted is None else list(wanted)
    if wrong := [k for k in channels if not 0 <= k < audio.channels]:
        raise BagError(f'{audio.name} has the channels 0 to {audio.channels - 1}, not {wrong[0]}')
    if len(channels) < 2:
        raise BagError(f'{audio.name} has one channel; an array has at least two hydrophones')
    return channels


def _start_ns(path: Path, how: HydrophonesOptions) -> int:
    """When the first sample was taken, from the option or the name of the file."""
    text = how.start
    if not text:
        found = _NAMED.search(path.stem)
        if found is None:
            raise BagError(
                f'{path.name} does not say when it begins; say --start 2024-05-31T10:00:00Z, or '
                '--start 0 where the time of day is of no use'
            )
        text = '20{}-{}-{} {}:{}:{}'.format(*found.groups())
    if text in ('0', 'now'):
        return SECOND if text == '0' else time.time_ns()
    try:
        start_ns = moment_ns(text, lambda: how.time_zone)
    except BadRow as error:
        raise BagError(str(error)) from None
    if start_ns is None:
        raise BagError(f"'{text}' is no time; write 2024-05-31T10:00:00Z")
    return start_ns
