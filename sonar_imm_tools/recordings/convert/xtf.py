# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Side scan and processed soundings from XTF, whose pings become a bag one by one.

The packets of a file (0: side scan, 17: soundings) are walked here, one in memory at a time, and
given to pyxtf as bytes: it opens no file itself, for it would unpickle an index that lies beside
one. Each ping of a side scan is an image of one beam abeam. Where a side has channels of phases
too, it is an interferometer and becomes ``/snapshot``. One road, and so in one place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from itertools import chain, islice
import math
import os
from pathlib import Path
from typing import Any
import warnings

from attrs import define, evolve, Factory
import numpy as np

from msg_adapters.detections import SOUND_SPEEDS, write_detections
from msg_adapters.snapshots import write_snapshot
from msg_adapters.soundings import write_ground
from sonar_imm.measurements import Ground, MAX_IMAGE_CELLS, Rejection, Snapshot, SonarImage
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig

from ..conversion import ConversionReport, converter
from ..convert_options import XtfOptions
from ..messages import ros_message
from ..places import speeds_of_degrees
from ..sources import BagError
from .navigation import Message, Record, write_records

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
        yield {**ping, 'units': units} if ping['units'] and units != 'auto' else ping


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
    usual = np.median(speeds) if len(speeds) else 0.0
    says = f'the file says that its places are metres; they are {such} and move by {usual:.2g} a '
    return f'{says}second, as degrees do' if 0.0 < usual < SLOWEST else ''


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


LOOKS = {'starboard': -90.0, 'port': 90.0}
"""Where side scan looks, degrees to port of ahead."""
MOST_CLIPPED = 0.01
"""Of the samples, at full scale, before it is said."""
LEAST_FULL_SCALE = 127
ABEAM: dict[str, Any] = {'horizontal_fov_deg': 3.0, 'vertical_fov_deg': 80.0}
"""Parameters of the obstacle tracker for the narrow, high beam of a side scan."""


@converter(XtfOptions)
def convert_xtf(path: Path, how: XtfOptions, report: ConversionReport) -> None:
    """Convert the side scan of an XTF file: echoes to ``/detections``, and where a side has a
    channel of phases to ``/port/snapshot`` and ``/starboard/snapshot``. Processed soundings of a
    multibeam become ``/ground``.
    """
    config = DetectorConfig.from_mapping(how.parameters)
    mount = {**ABEAM, 'sonar_mount_rpy_deg': [0.0, 0.0, LOOKS[how.side]]}
    phases, seen = False, _Seen(how)

    def messages(ping: Record) -> Iterator[Message]:
        nonlocal phases
        seen.ping(ping)
        if ping['soundings'] is not None:
            yield _ground(ping)
            return
        sides = _sides(ping, how.port_samples)
        if not sides:
            raise Rejection('no_side_scan', 'it has no channel of side scan')
        if how.side not in sides and not any(map(_is_phase, chain(*sides.values()))):
            (other,) = sides
            raise Rejection('other_side', f'it has channels of {other} alone: --side {other}')
        if magnitudes := _magnitudes(sides.get(how.side, []), how):
            image = _image(ping, magnitudes[0], how)
            mount['max_range'] = max(mount.get('max_range', 1.0), float(image.range[-1]))
            found = detect(image, config)
            # An image of one beam cannot show how wide it is.
            wide = np.full(len(found), np.radians(config.beam_width_deg) ** 2 / 12.0)
            seen.image(magnitudes, len(found))
            found = evolve(found, var_bearing=wide, extent_bearing=np.full(len(found), np.nan))
            yield '/detections', write_detections(found, ros_message)
        for side, channels in sides.items():
            if (snapshot := _interferometer(ping, side, channels, how)) is not None:
                phases = True
                yield f'/{side}/snapshot', write_snapshot(snapshot, ros_message)

    pings = pings_in(path, report, how.units)
    write_records(path, pings, report, how, messages, {'obstacle': mount})
    seen.tell(path, report)
    if set(report.messages) <= {'/nav', '/altitude', '/ground'}:
        return
    other = next(side for side in LOOKS if side != how.side)
    report.notes['side'] = f'echoes of {how.side}; those of the other by --side {other}'
    report.notes['samples'] = (
        'amplitudes and phases' if phases else 'magnitude only: no channel is called a phase'
    )


@define
class _Seen:
    """What of a file of side scan has to be said at its end."""

    how: XtfOptions
    pings: int = 0
    headings: int = 0
    layback: float = 0.0
    images: int = 0
    echoes: int = 0
    samples: int = 0
    clipped: int = 0
    top: int = 0
    """The highest sample."""
    frequencies: set[float] = Factory(set)

    def ping(self, ping: Record) -> None:
        self.pings += 1
        self.headings += ping['heading'] != 0.0
        self.layback = max(self.layback, ping['layback'])

    def image(self, magnitudes: list[Record], echoes: int) -> None:
        """Count the echoes and samples of an image. magnitudes: channels of its side."""
        self.images += 1
        self.echoes += echoes
        self.frequencies |= {float(channel['frequency']) for channel in magnitudes}
        samples = magnitudes[0]['samples']
        if samples.dtype.kind in 'iu':
            self.samples += len(samples)
            if (top := int(samples.max())) > self.top:
                self.top, self.clipped = top, 0
            # Of a converter of 8, 12 or 15 bits the highest value is all ones, too.
            if self.top >= LEAST_FULL_SCALE and not self.top & (self.top + 1):
                self.clipped += int((samples == self.top).sum())

    def tell(self, path: Path, report: ConversionReport) -> None:
        if self.images and not self.echoes:
            report.questions.append(
                f'{path.name}: no echo was found in {self.images} pings of {self.how.side}; is '
                'the other --side meant, or another threshold (--set threshold_margin_db=-3.0)?'
            )
        if self.pings and not self.headings and '/nav' in report.messages:
            report.questions.append(
                f'{path.name}: the heading is 0 in all {self.pings} pings; does the file hold '
                'one? Echoes lie to the east and west of the line now'
            )
        if self.layback > 0.0:
            report.questions.append(
                f'{path.name}: the places are those of the ship, and the sonar is up to '
                f'{self.layback:g} m behind them (layback), which is not taken off'
            )
        if self.clipped > MOST_CLIPPED * self.samples:
            report.questions.append(
                f'{path.name}: {self.clipped / self.samples:.1%} of the samples are at full '
                'scale: was the gain too high?'
            )
        if len(self.frequencies) > 1:
            listed = ', '.join(f'{frequency:g}' for frequency in sorted(self.frequencies))
            report.notes['frequencies'] = f'{listed} Hz; --frequency HZ chooses one'


def _ground(ping: Record) -> Message:
    """The soundings of a ping of a multibeam. Raises `Rejection`."""
    found = ping['soundings']
    found = found[np.isfinite(found).all(axis=1) & (found[:, 2] != 0.0)]
    if not len(found):
        raise Rejection('no_soundings', 'none of its soundings is valid')
    if (nav := ping['nav']) is None:
        raise Rejection('no_position', 'its soundings have no position of the ship')
    offset = np.column_stack([found[:, :2], -found[:, 2] - nav.position[2]])
    ground = Ground(
        stamp_ns=ping['stamp_ns'],
        position=nav.position + offset,
        variance=np.zeros(len(found)),
        frame_id=nav.frame_id,
    )
    return '/ground', write_ground(ground, ros_message)


def _speed_of(ping: Record) -> float:
    stated = float(ping['sound_speed'])
    return stated if SOUND_SPEEDS[0] <= stated <= SOUND_SPEEDS[1] else 1500.0


def _sides(ping: Record, port_samples: str) -> dict[str, list[Record]]:
    """The channels of each side, their samples from near to far."""
    found: dict[str, list[Record]] = {}
    for channel in ping['channels']:
        if channel['side'] in LOOKS and len(channel['samples']):
            samples = channel['samples']
            if len(samples) > MAX_IMAGE_CELLS:  # before each takes eight bytes and more
                raise Rejection('too_large', f'a channel has {len(samples)} samples')
            if channel['side'] == 'port' and port_samples == 'far':
                samples = samples[::-1]
            found.setdefault(channel['side'], []).append({**channel, 'samples': samples})
    return found


def _magnitudes(channels: list[Record], how: XtfOptions) -> list[Record]:
    """The channels of magnitudes of a side, first the one that is used."""
    found = [channel for channel in channels if not _is_phase(channel)]
    if (wanted := how.frequency) is not None:
        found.sort(key=lambda channel: abs(channel['frequency'] - wanted))
    return found


def _image(ping: Record, channel: Record, how: XtfOptions) -> SonarImage:
    """The magnitudes of one side: an image of one beam, seen from the array."""
    return SonarImage(
        stamp_ns=ping['stamp_ns'],
        range=_ranges(channel, _speed_of(ping)),
        bearing=np.zeros(1),
        amplitude=np.abs(channel['samples'].astype(np.float64))[:, None],
        frame_id=how.frame_id,
    )


def _is_phase(channel: Record) -> bool:
    return 'phase' in channel['name'].lower()


def _ranges(channel: Record, sound_speed: float) -> np.ndarray:
    """(R,) m, middle of each sample. Raises `Rejection`."""
    far, count = float(channel['slant_range']), len(channel['samples'])
    if not (math.isfinite(far) and 0.0 < far <= 1e4):
        raise Rejection('out_of_range', f'it states a slant range of {far:g} m')
    delay = float(channel['delay'])
    near = 0.5 * sound_speed * delay if 0.0 < delay < 10.0 else 0.0
    return near + far * (np.arange(count) + 0.5) / count


def _interferometer(
    ping: Record, side: str, channels: list[Record], how: XtfOptions
) -> Snapshot | None:
    """Amplitudes with a phase of stave 1 against stave 0, or with one of each stave."""
    phases = [channel for channel in channels if _is_phase(channel)]
    magnitudes = [channel for channel in channels if not _is_phase(channel)]
    if not (phases and magnitudes):
        return None
    size = magnitudes[0]['samples'].astype(np.float64)
    if any(len(phase['samples']) != len(size) for phase in phases):
        raise Rejection('bad_shape', 'its phases and amplitudes are not equally many')
    turns = np.column_stack([_turns(phase['samples'], how.radians_per_count) for phase in phases])
    if len(phases) == 1:
        turns = np.column_stack([np.zeros(len(size)), turns])
    speed = _speed_of(ping)
    distance = _ranges(magnitudes[0], speed)
    return Snapshot(
        stamp_ns=ping['stamp_ns'],
        frame_id=how.frame_id,
        range=distance,
        iq=(size[:, None] * np.exp(1j * turns)).astype(np.complex64),
        sound_speed=speed,
        frequency=float(magnitudes[0]['frequency']) or None,
        element_spacing=how.element_spacing,
        sample_rate=0.5 * speed / float(distance[1] - distance[0]) if len(size) > 1 else None,
        side=side,
    )


def _turns(samples: np.ndarray, radians_per_count: float | None) -> np.ndarray:
    if radians_per_count is None:
        whole = samples.dtype.kind in 'iu'
        radians_per_count = 2.0 * math.pi / 256**samples.dtype.itemsize if whole else 1.0
    return np.asarray(samples.astype(np.float64) * radians_per_count)
