# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Sound of an array of hydrophones, WAV or FLAC, one channel for each, as blocks of pressure.

The file is read in blocks, so that its length does not matter. What a full scale is worth in
pascals is an option: the tracker needs ratios only. Whole numbers of 16 bits stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import re
import time
from typing import TYPE_CHECKING

import numpy as np

from msg_adapters.array_records import write_pressure
from sonar_imm.measurements import Pressure

from ... import SECOND
from ..conversion import ConversionReport, converter, provenance
from ..convert_options import HydrophonesOptions
from ..messages import ros_message
from ..sources import BagError
from ..times import BadRow, moment_ns
from ..writer import BagWriter
from .navigation import navigation_of_table

if TYPE_CHECKING:
    import soundfile

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
    with _opened(path) as audio:
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
        notes = provenance(path.name, report.notes)
        own = {'fathometer': {'phones': len(channels)}}
        with BagWriter(report.path, storage=how.storage, custom_data=notes, parameters=own) as bag:
            _write_blocks(audio, bag, report, how, channels, start_ns, rows)
            if not bag.count:
                raise report.nothing(path)
            for stamp_ns, topic, message in places:
                bag.write(topic, message, stamp_ns)
                report.messages[topic] += 1


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
            report.messages['/pressure'] += 1


def _opened(path: Path) -> soundfile.SoundFile:
    try:
        import soundfile
    except ImportError:
        raise BagError("sound needs soundfile: pip install 'sonar_imm[sound]'") from None
    try:
        return soundfile.SoundFile(str(path))
    except (soundfile.LibsndfileError, OSError) as error:
        raise BagError(f'{path} cannot be read as sound: {error}') from None


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
