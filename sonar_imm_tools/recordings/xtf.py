# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Pings of XTF: side scan (packets 0) and processed soundings (packets 17).

The packets of a file are walked here, one in memory at a time, and those are given to pyxtf as
bytes: it opens no file itself, for it would unpickle an index that lies beside one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from itertools import chain, islice
import os
from pathlib import Path
from typing import Any
import warnings

import numpy as np

from .conversion import ConversionReport
from .places import speeds_of_degrees
from .sources import BagError

FILE_HEAD, PACKET_HEAD, LARGEST_PACKET = 1024, 14, 64 << 20  # bytes
MARK = b'\xce\xfa'
SIDE_SCAN, SOUNDINGS, VERSION, MOST_CHANNELS = 0, 17, 0x7B, 6
SIDES, UNITS = {1: 'port', 2: 'starboard'}, {3: 'degrees', 0: 'metres'}
PLACES_READ, SLOWEST = 200, 0.01
"""Places by which the unit of a file is judged, and the least median speed of a survey, m/s."""


def pings_in(path: Path, report: ConversionReport, units: str) -> Iterator[dict[str, Any]]:
    """Yield the pings of `pings_of`, with places in `units` where these are stated.

    :param units: 'degrees', 'metres', or 'auto' for those of the file.
    :raises BagError: the file does not say the unit, or its places cannot be of the one it says.
    """
    pings = pings_of(path, report)
    first = list(islice(pings, PLACES_READ)) if units == 'auto' else []
    where = [ping for ping in first if ping['units'] and ping['stamp_ns'] >= 0]
    if where and (why := _doubted_unit(where)):
        raise BagError(f'{path}: {why}; say --units degrees or --units metres')
    for ping in chain(first, pings):
        stated = ping['units'] and units != 'auto'
        yield {**ping, 'units': units} if stated else ping


def _doubted_unit(pings: list[dict[str, Any]]) -> str:
    """Say why the places of pings may be of another unit than the file says; empty if not."""
    unit, place = pings[0]['units'], np.array([ping['place'] for ping in pings], np.float64)
    such = f'such as {place[0, 0]:.7g}, {place[0, 1]:.7g}'
    if unit not in UNITS.values():
        return f'the file does not say the unit of its places, {such}'
    if unit == 'degrees':
        on_earth = (np.abs(place) <= (180.0, 90.0)).all(axis=1)
        beyond = 2 * on_earth.sum() < len(place)
        return f'the file says that its places are degrees, and they are {such}' if beyond else ''
    speeds = speeds_of_degrees(np.array([ping['stamp_ns'] for ping in pings]) * 1e-9, place)
    if not (len(speeds) and 0.0 < np.median(speeds) < SLOWEST):
        return ''
    return (
        f'the file says that its places are metres; they are {such} and move by '
        f'{np.median(speeds):.2g} a second, as degrees do'
    )


def pings_of(path: Path, report: ConversionReport) -> Iterator[dict[str, Any]]:
    """The pings of a file: where (its word), stamp_ns (-1 for none), channels (dicts of side,
    name, samples, slant_range m, delay s, frequency Hz), soundings (n, 3), metres east and north
    of the place and depth below the surface, None in a ping of side scan; sound_speed m/s, place
    (x, y) in degrees or metres as units says, empty without a place, layback m from there to the
    sonar, heading, pitch, roll in degrees, depth, altitude m.

    The report is told what ended a file early, and what was not taken. Raises `BagError` without
    pyxtf."""
    try:
        import pyxtf
    except ImportError:
        raise BagError(f"{path.name} needs pyxtf: pip install 'sonar_imm[xtf]'") from None
    others: Counter[int] = Counter()
    try:
        for head, packet in _packets(path, others, pyxtf):
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')  # of a ping without soundings, or of NaN
                ping = _ping(head, packet, pyxtf)
            report.rows += 1
            yield {'where': f'ping {report.rows}', **ping}
    except Exception as error:  # whatever a library of others raises
        own = isinstance(error, _DamageError)
        why = f'{"" if own else f"its reader gives up: {type(error).__name__} "}{error}'
        report.problems.append(f'{path.name}: {why}; what came before it is kept')
    if others:
        names = {each.value: each.name for each in pyxtf.XTFHeaderType}
        counts = (f'{count} {names.get(kind, kind)}' for kind, count in others.most_common(12))
        report.notes['packets not taken'] = ', '.join(counts)


class _DamageError(Exception):
    """What is wrong with a file, in words of our own."""


def _packets(path: Path, others: Counter[int], pyxtf: Any) -> Iterator[tuple[Any, bytes]]:
    """The head of the file with each packet of pings; the others are counted by type."""
    if not path.is_file():
        raise _DamageError('this is no file')  # a pipe would never answer
    with path.open('rb') as file:
        if len(start := file.read(FILE_HEAD)) < FILE_HEAD:
            raise _DamageError('the head of the file is cut off')
        head = pyxtf.XTFFileHeader.create_from_buffer(buffer=BytesIO(start))
        if head.FileFormat != VERSION:
            raise _DamageError(f'the version of the file is {head.FileFormat}, not {VERSION}')
        if (count := head.channel_count()) > MOST_CHANNELS:
            raise _DamageError(f'it has {count} channels, more than {MOST_CHANNELS}')
        while start := file.read(PACKET_HEAD):
            length = int.from_bytes(start[10:], 'little')
            if len(start) < PACKET_HEAD:
                raise _DamageError('a packet is cut off')
            if start[:2] != MARK or not PACKET_HEAD <= length <= LARGEST_PACKET:
                raise _DamageError('a packet does not begin as packets do')
            if start[2] in (SIDE_SCAN, SOUNDINGS):
                yield head, start + file.read(length - PACKET_HEAD)
            elif file.seek(length - PACKET_HEAD, 1) > os.fstat(file.fileno()).st_size:
                raise _DamageError('a packet is cut off')
            else:
                others[start[2]] += 1


def _ping(head: Any, content: bytes, pyxtf: Any) -> dict[str, Any]:
    """A ping as `pings_of` has it, by the bytes of its packet."""
    channels, soundings, make = [], None, pyxtf.XTFPingHeader.create_from_buffer
    try:
        packet = make(buffer=BytesIO(content), file_header=head)
    except ValueError:  # that of ctypes or numpy for too few bytes
        raise _DamageError('a ping is cut off') from None
    if packet.HeaderType == SOUNDINGS:
        beams = np.frombuffer(packet.data, np.dtype(pyxtf.XTFBeamXYZA))
        names = ('dPosOffsetTrX', 'dPosOffsetTrY', 'fDepth')
        soundings = np.column_stack([beams[name].astype(np.float64) for name in names])
    for number, samples in enumerate(packet.data if soundings is None else ()):
        header = packet.ping_chan_headers[number]
        # Of the last packet the bytes that only fill it up may be missing.
        if len(samples) < (header.NumSamples or head.sonar_info[number].Reserved):
            raise _DamageError('a ping is cut off')
        info = head.ChanInfo[header.ChannelNumber if header.ChannelNumber < MOST_CHANNELS else 0]
        frequency = header.Frequency or info.Frequency
        channels.append(
            {
                'side': SIDES.get(info.TypeOfChannel, ''),
                'name': info.ChannelName.decode('latin-1'),
                'samples': samples,
                'slant_range': header.SlantRange,
                'delay': header.TimeDelay,
                'frequency': frequency * (1e3 if frequency < 1e4 else 1.0),  # some write kHz
            }
        )
    try:
        stamp_ns = int(packet.get_time().astype('datetime64[ns]').astype(np.int64))
    except (ValueError, OverflowError):
        stamp_ns = -1
    place = packet.SensorXcoordinate, packet.SensorYcoordinate
    ship = packet.ShipXcoordinate, packet.ShipYcoordinate
    place = place if any(place) else ship
    return {
        'stamp_ns': stamp_ns,
        'channels': channels,
        'soundings': soundings,
        # Half the speed of sound is what many programs write there.
        'sound_speed': packet.SoundVelocity * (2.0 if packet.SoundVelocity < 1000.0 else 1.0),
        # Who has no position leaves it at zero.
        'units': UNITS.get(head.NavUnits, 'unknown') if any(place) else '',
        'place': place,
        'layback': float(packet.Layback) if place == ship else 0.0,
        'heading': packet.SensorHeading or packet.ShipGyro,
        'pitch': packet.SensorPitch,
        'roll': packet.SensorRoll,
        'depth': packet.SensorDepth,
        'altitude': packet.SensorPrimaryAltitude,
    }
