# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Traces of a sub-bottom profiler from SEG-Y, the format of seismic instruments.

`segy_lines` reads the file. The interval that small profilers state is often wrong: where it does
not go with the depth of the water that the headers state, that is said, and the sample spacing has
to be given. Where delay or interval change along the line, so do the depths of the traces.

Traces that are never negative are envelopes. For them the pulse and the noise are measured as the
tracker does (`measure_line`), from six hundred traces all along the line at most, and written
beside the bag, where the tracker finds them. Where a gain that grows with time raises the noise
with the depth, each trace states it by depth. Places become the topic ``/position``.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from msg_adapters.array_records import write_trace
from sonar_imm.acoustics.envelopes import is_envelope
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm.trackers.fathometer.water import measure_line

from ..conversion import ConversionReport, converter, Record, write_bag
from ..convert_options import SegyOptions
from ..messages import ros_message
from ..positions import write_position
from ..segy_lines import READ_OPTIONS, read_segy, SegyLine
from ..sources import BagError
from .navigation import navigation_of_table

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
        own['blanking'] = max(
            0.0, math.floor(100.0 * min(w.depth(line)[0] for w in windows)) / 100.0
        )
    records: list[Record] = []
    for window in windows:
        noise = sigma
        if sigma is not None and window is not usual:
            noise = np.interp(window.depth(line), usual.depth(line), sigma)
        records += _records(report, path, line, window, noise, how)
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
    """Return the windows of the line, in order."""
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
    for name, values, unit in (
        ('sample_spacing', {window.spacing for window in windows}, 'm'),
        ('depth_of_sample_0', {window.first for window in windows}, 'm'),
    ):
        low, high = min(values), max(values)
        changes = f'{low:.9g} to {high:.9g} {unit}, as the headers state trace by trace'
        report.notes[name] = f'{low:.9g} {unit}' if low == high else changes
    report.notes['stack'] = str(how.stack)
    usual = SegyOptions()
    own = {name: getattr(how, name) for name in (*READ_OPTIONS, *GRID_OPTIONS)}
    report.notes['read_as'] = json.dumps(
        {
            name: value
            for name, value in own.items()
            if name == 'sound_speed' or value != getattr(usual, name)
        }
    )


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
    line: SegyLine,
    window: Window,
    sigma: FloatArray | None,
    how: SegyOptions,
) -> list[Record]:
    """Return the traces of one window, each the mean of a stack."""
    depth, records = window.depth(line), []
    for first in range(window.rows.start, window.rows.stop - how.stack + 1, how.stack):
        report.rows += how.stack
        rows = slice(first, first + how.stack)
        stamp = line.stamps[rows.stop - 1]
        with report.leaving_out(path, f'trace {first}'):
            trace = Trace(
                stamp_ns=stamp,
                frame_id=how.frame_id,
                depth=depth,
                amplitude=line.amplitude[rows, window.samples].mean(axis=0),
                sigma=sigma,
            )
            records.append((stamp, '/trace', write_trace(trace, ros_message)))
    return records


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
