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
"""Binary files of sonars, read by libraries of others in a process of their own.

A damaged file may make a library fail, hang, or ask for memory without end. So each runs in a
child process that may take `MEMORY` bytes and be silent for `SILENCE` seconds. What it gave until
then is kept.

The child gives records, dicts with the key ``kind``: ``ping`` (see the readers), ``profile`` (see
`_profile`), ``note`` (name, text) and ``problem``, whose ``text`` says why there is no more. This
module imports nothing of the package, so that the child starts fast.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime, timedelta
import math
import os
from pathlib import Path
import pickle
import subprocess
import sys
import threading
from typing import Any
import warnings

import numpy as np

Record = dict[str, Any]

MEMORY = 1 << 30
"""Most bytes that a reader may take for itself; files that it maps do not count."""
SILENCE = 120.0
"""Seconds without a record after which a reader is stopped."""
PACKET_HEAD = 14
"""Bytes at the head of each packet of XTF."""
DEGREES, METRES = 3, 0
"""What positions of XTF are given in."""
POWER_STEP = 10.0 * math.log10(2.0) / 256.0
"""Decibels of a count of the power of an EK60."""
CUT = 'a datagram is cut off'
MOST_WAITING = 200
"""Pings that wait for a position of the ship."""


def read_apart(reader: str, path: Path) -> Iterator[Record]:
    """The records of a file, by a reader of `READERS`; when it breaks down the last record says
    so. Raises ImportError where its library is missing."""
    command = [sys.executable, '-m', __name__, reader, str(path)]
    surroundings = {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=surroundings
    ) as child:
        assert child.stdout is not None
        try:
            while True:
                watch = threading.Timer(SILENCE, child.kill)
                watch.start()
                try:
                    record = pickle.load(child.stdout)
                except (EOFError, pickle.UnpicklingError):
                    yield {'kind': 'problem', 'text': _end_of(child, watch)}
                    return
                finally:
                    watch.cancel()
                if record['kind'] == 'end':
                    return
                if record['kind'] == 'missing':
                    raise ImportError(record['text'])
                yield record
        finally:
            child.kill()


def _end_of(child: subprocess.Popen[bytes], watch: threading.Timer) -> str:
    """Why a child gave no more."""
    code, late = child.wait(), watch.finished.is_set()
    if late:
        return f'its reader was stopped after {SILENCE:g} s without a record'
    return f'its reader broke down (signal {-code})' if code < 0 else 'its reader ended early'


def _xtf(path: str) -> Iterator[Record]:
    """Pings of XTF: stamp_ns, channels (dicts of side, name, samples, slant_range, delay,
    frequency), soundings (n, 3): metres east and north of the place, and depth below the surface,
    None in a ping of side scan; sound_speed, place (x, y) in degrees or metres as units says,
    heading, pitch, roll in degrees, depth, altitude in metres."""
    import pyxtf

    # Beside a file the library would unpickle an index; a file descriptor has nothing beside it.
    with open(path, 'rb') as file:
        place = f'/dev/fd/{file.fileno()}'
        if not os.path.exists(place):  # Windows
            place = path
            if os.path.exists(f'{os.path.splitext(path)[0]}.pyxtf_idx'):
                raise ValueError('the index of pyxtf beside it is not opened; move it away')
        packets = pyxtf.xtf_read_gen(place)
        head = next(packets)
        if head.FileFormat != 0x7B:
            raise ValueError(f'the version of the file is {head.FileFormat}, not 123')
        kinds = pyxtf.XTFHeaderType
        others: Counter[str] = Counter()
        for packet in packets:
            if packet.NumBytesThisRecord < PACKET_HEAD:
                raise ValueError('a packet states no length')
            if isinstance(packet, pyxtf.XTFPingHeader) and (
                packet.HeaderType in (kinds.sonar, kinds.bathy_xyza)
            ):
                yield _xtf_ping(head, packet, pyxtf)
            else:
                with suppress(ValueError):  # a type that the library does not know either
                    others[kinds(packet.HeaderType).name] += 1
        if others:
            text = ', '.join(f'{count} {name}' for name, count in others.most_common(12))
            yield {'kind': 'note', 'name': 'packets not taken', 'text': text}


def _xtf_ping(head: Any, packet: Any, pyxtf: Any) -> Record:
    types = pyxtf.XTFChannelType
    sides = {types.port.value: 'port', types.stbd.value: 'starboard'}
    channels, soundings = [], None
    if packet.HeaderType == pyxtf.XTFHeaderType.bathy_xyza:
        beams = np.frombuffer(packet.data, np.dtype(pyxtf.XTFBeamXYZA))
        names = ('dPosOffsetTrX', 'dPosOffsetTrY', 'fDepth')
        soundings = np.column_stack([beams[name].astype(np.float64) for name in names])
    for header, samples in zip(packet.ping_chan_headers, packet.data):
        if len(samples) < header.NumSamples:
            raise ValueError('a ping is cut off')
        info = (
            head.ChanInfo[header.ChannelNumber] if header.ChannelNumber < 6 else head.ChanInfo[0]
        )
        channels.append(
            {
                'side': sides.get(info.TypeOfChannel, ''),
                'name': info.ChannelName.decode('latin-1'),
                'samples': samples,
                'slant_range': header.SlantRange,
                'delay': header.TimeDelay,
                'frequency': _hertz(header.Frequency or info.Frequency),
            }
        )
    try:
        stamp_ns = int(packet.get_time().astype('datetime64[ns]').astype(np.int64))
    except (ValueError, OverflowError):
        stamp_ns = -1
    place = packet.SensorXcoordinate, packet.SensorYcoordinate
    if not any(place):
        place = packet.ShipXcoordinate, packet.ShipYcoordinate
    units = {DEGREES: 'degrees', METRES: 'metres'}.get(head.NavUnits, '')
    return {
        'kind': 'ping',
        'stamp_ns': stamp_ns,
        'channels': channels,
        'soundings': soundings,
        # Half the speed of sound is what many programs write there.
        'sound_speed': packet.SoundVelocity * (2.0 if packet.SoundVelocity < 1000.0 else 1.0),
        # Who has no position leaves it at zero.
        'units': units if any(place) else '',
        'place': place,
        'heading': packet.SensorHeading or packet.ShipGyro,
        'pitch': packet.SensorPitch,
        'roll': packet.SensorRoll,
        'depth': packet.SensorDepth,
        'altitude': packet.SensorPrimaryAltitude,
    }


def _hertz(stated: float) -> float:
    """A frequency of XTF, which some programs write in kHz."""
    return 1e3 * stated if stated < 1e4 else stated


def _simrad(path: str) -> Iterator[Record]:
    """Pings of EK80: stamp_ns, channel, sample_interval s, sound_speed m/s and the place as in
    `_placed`;

    iq (bins, sectors), or power in dB (bins,) and angle (bins,), the phase in rad of the starboard
    half against the port half; None where the file has none;
    frequency Hz, of a chirp its middle; spacing of the halves in m, as the transducer's
    sensitivity has it;
    chirp: None, or band Hz, duration s, slope, rate Hz and filters (coefficients, decimation).
    """
    from themachinethatgoesping.echosounders import simradraw

    kinds = simradraw.t_SimradRawDatagramIdentifier
    handler = simradraw.SimradRawFileHandler(path, show_progress=False)
    filters: dict[tuple[str, int], tuple[np.ndarray, int]] = {}
    for stage in handler.datagram_interface.datagrams(kinds.FIL1):
        key = stage.get_channel_id_stripped(), stage.get_stage()
        filters[key] = np.array(stage.get_coefficients()), stage.get_decimation_factor()
    for ping in handler.get_pings():
        (data,) = ping.file_data.datagrams(kinds.RAW3)
        samples = data.get_sample_data()
        signal, channel = ping.file_data.get_parameter(), ping.get_channel_id()
        built = ping.file_data.transceiver_information
        transducer = built.get_transducer()
        pairs = getattr(samples, 'complex_samples', None)
        angle = getattr(samples, 'angle', None)
        speed = ping.file_data.get_environment().SoundSpeed
        frequency, chirp = signal.Frequency, None
        if math.isfinite(signal.FrequencyStart):
            frequency = 0.5 * (signal.FrequencyStart + signal.FrequencyEnd)
            chirp = {
                'band': (signal.FrequencyStart, signal.FrequencyEnd),
                'duration': signal.PulseDuration,
                'slope': signal.Slope,
                'rate': built.get_transceiver().RxSampleFrequency,
                'filters': [filters[key] for key in sorted(filters) if key[0] == channel],
            }
        yield {
            'kind': 'ping',
            'channel': channel,
            'iq': None if pairs is None else np.asarray(pairs)[..., 0] + 1j * pairs[..., 1],
            'power': samples.get_power(True) if samples.has_power() else None,
            'angle': None if angle is None else _electrical(angle),
            'sample_interval': signal.SampleInterval,
            'frequency': frequency,
            'spacing': transducer.AngleSensitivityAthwartship
            * speed
            / (2.0 * math.pi * (transducer.Frequency or math.nan)),
            'chirp': chirp,
            'sound_speed': speed,
            **_placed(ping),
        }
        ping.release()
    # Of a datagram that is cut off the library says nothing. Its length stands at both ends.
    with open(path, 'rb') as file:
        end = file.seek(0, os.SEEK_END)
        file.seek(max(end - 4, 0))
        length = int.from_bytes(file.read(4), 'little')
        file.seek(max(end - length - 8, 0))
        if int.from_bytes(file.read(4), 'little') != length:
            raise ValueError(CUT)


def _ek60(path: str) -> Iterator[Record]:
    """Pings of EK60 and ES60, as `_simrad` has them: power and angles. A ping waits for the next
    position, between that and the last one it has its place."""
    from ektools import ekfile, parse
    from ektools.simrad_parsers import SimradRawParser

    built: list[Any] = []
    ship, parser, read = _Ship(), SimradRawParser(), 0
    waiting: list[Record] = []
    for kind, size, moment, content in ekfile(path).datagrams():
        read += size + 8
        if kind == 'CON0':
            built = list(parse(content)['configuration'].values())
        elif kind == 'NME0':
            if ship.takes(_nanoseconds(moment), content[12:]):
                yield from map(ship.placed, waiting)
                waiting.clear()
        elif kind == 'RAW0':
            data = parser.from_string(content, size)
            channel = built[data['channel'] - 1]
            power, angle = data['power'], data['angle']
            speed, frequency = float(data['sound_velocity']), float(data['frequency'])
            spacing = channel['angle_sensitivity_athwartship'] * speed
            waiting.append(
                {
                    'kind': 'ping',
                    'stamp_ns': _nanoseconds(moment),
                    'channel': channel['channel_id'],
                    'iq': None,
                    'power': None if power is None else power * POWER_STEP,
                    'angle': None if angle is None else _electrical(angle),
                    'sample_interval': float(data['sample_interval']),
                    'frequency': frequency,
                    'spacing': spacing / (2.0 * math.pi * (frequency or math.nan)),
                    'chirp': None,
                    'sound_speed': speed,
                    'pitch': float(data['pitch']),
                    'roll': float(data['roll']),
                    'depth': float(data['transducer_depth']),
                }
            )
            if len(waiting) > MOST_WAITING:
                yield from map(ship.placed, waiting)
                waiting.clear()
    yield from map(ship.placed, waiting)
    if read < os.path.getsize(path):
        raise ValueError(CUT)


def _electrical(angle: Any) -> np.ndarray:
    """Phase in rad of the starboard half against the port half. As they lie in the file:
    athwartships, then alongships; 128 are half a turn."""
    return np.asarray(angle)[:, 0] * (math.pi / 128.0)


def _nanoseconds(moment: datetime) -> int:
    """Since 1970, of a time in UTC that does not say so."""
    return (moment - datetime(1970, 1, 1)) // timedelta(microseconds=1) * 1000


class _Ship:
    """Where a ship is by its last two positions (ns, longitude, latitude), and its heading, or
    else its course, in degrees."""

    def __init__(self) -> None:
        self.last = self.next = (0, math.nan, math.nan)
        self.heading = self.course = math.nan

    def takes(self, stamp_ns: int, content: bytes) -> bool:
        """Whether a sentence of NMEA says where the ship is."""
        import pynmea2

        with suppress(Exception):  # whatever is wrong with it, the next one may be right
            sentence = pynmea2.parse(content.strip(b'\0\r\n ').decode('ascii'))
            if sentence.sentence_type == 'HDT':
                self.heading = float(sentence.heading)
            elif sentence.sentence_type == 'VTG':
                self.course = float(sentence.true_track)
            elif sentence.sentence_type in ('GGA', 'GLL', 'RMC') and sentence.lat:
                place = stamp_ns, float(sentence.longitude), float(sentence.latitude)
                if any(place[1:]):  # 0, 0 is what a receiver without a fix writes
                    self.last, self.next = self.next, place
                    return True
        return False

    def placed(self, ping: Record) -> Record:
        """A ping with the place of the ship, as in `_placed`."""
        stamps = [self.last[0], self.next[0]]
        known = [math.isfinite(place[1]) for place in (self.last, self.next)]
        east, north = math.nan, math.nan
        if all(known):
            east, north = (
                float(np.interp(ping['stamp_ns'], stamps, [self.last[k], self.next[k]]))
                for k in (1, 2)
            )
        elif known[1]:
            east, north = self.next[1:]
        heading = self.heading if math.isfinite(self.heading) else self.course
        place = {'units': 'degrees', 'place': (east, north), 'heading': heading}
        return {**ping, **place, 'altitude': math.nan}


def _kmall(path: str) -> Iterator[Record]:
    from themachinethatgoesping.echosounders import kmall

    kind = kmall.t_KMALLDatagramIdentifier.S_SOUND_VELOCITY_PROFILE
    handler = kmall.KMALLFileHandler(path, show_progress=False)
    for cast in handler.datagram_interface.datagrams(kind):
        yield _profile(cast.get_svp_depths(), cast.get_svp_sound_velocities())
    yield from _kongsberg(handler)


def _all(path: str) -> Iterator[Record]:
    from themachinethatgoesping.echosounders import kongsbergall

    kind = kongsbergall.t_KongsbergAllDatagramIdentifier.SoundSpeedProfileDatagram
    handler = kongsbergall.KongsbergAllFileHandler(path, show_progress=False)
    for cast in handler.datagram_interface.datagrams(kind):
        # The library takes depths for centimetres; they are steps of the resolution, in cm.
        depths = 0.01 * cast.get_depth_resolution() * cast.get_depths_and_sound_speeds()[:, 0]
        yield _profile(depths, cast.get_sound_speeds_in_meters_per_second())
    yield from _kongsberg(handler)
    # As in `_simrad`. Each datagram ends with 3 and a sum of two bytes.
    with open(path, 'rb') as file:
        file.seek(-3, os.SEEK_END)
        if file.read(1) != b'\3':
            raise ValueError(CUT)


def _profile(depths: Any, speeds: Any) -> Record:
    """A cast of sound speed: depths m and speeds m/s in turn."""
    return {'kind': 'profile', 'values': np.column_stack([depths, speeds]).ravel().tolist()}


def _kongsberg(handler: Any) -> Iterator[Record]:
    """Pings of a multibeam: stamp_ns, the place as in `_placed`, and soundings (n, 3): metres
    forward, to starboard and down of the reference point of the ship."""
    for ping in handler.get_pings():
        soundings = None
        if ping.bottom.has_xyz():
            found = ping.bottom.get_xyz()
            soundings = np.column_stack([found.x, found.y, found.z]).astype(np.float64)
        yield {'kind': 'ping', 'soundings': soundings, **_placed(ping)}
        ping.release()


def _placed(ping: Any) -> Record:
    """stamp_ns; place (longitude, latitude), heading, pitch, roll in degrees and depth in metres,
    NaN where the file does not say."""
    known = math.nan
    record = {
        'stamp_ns': round(ping.get_timestamp() * 1e6) * 1000,
        'units': 'degrees',
        'place': (known, known),
        **dict.fromkeys(('heading', 'pitch', 'roll', 'depth', 'altitude'), known),
    }
    with suppress(Exception):  # a file without navigation
        there = ping.get_geolocation()
        record |= {'place': (there.longitude, there.latitude), 'heading': there.yaw}
        record |= {'pitch': there.pitch, 'roll': there.roll, 'depth': there.z}
    return record


READERS: dict[str, Callable[[str], Iterator[Record]]] = {
    'xtf': _xtf,
    'ek60': _ek60,
    'ek80': _simrad,
    'kmall': _kmall,
    'all': _all,
}
LIBRARIES = {
    'xtf': 'pyxtf',
    'ek60': 'ektools',
    **dict.fromkeys(('ek80', 'kmall', 'all'), 'themachinethatgoesping'),
}


def _bound_memory() -> None:
    """Bound what this process may take from now on, where the system can (not on Windows)."""
    try:
        import resource
    except ImportError:
        return
    taken = 0
    with suppress(OSError):
        text = Path('/proc/self/status').read_text(encoding='ascii')
        taken = next(1024 * int(line.split()[1]) for line in text.splitlines() if 'VmData' in line)
    resource.setrlimit(resource.RLIMIT_DATA, (taken + MEMORY, taken + MEMORY))


def _main(reader: str, path: str) -> None:
    """Write the records of a file to the standard output. What a library prints goes astray."""
    out = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)

    def give(kind: str, **rest: Any) -> None:
        pickle.dump({'kind': kind, **rest}, out, protocol=5)
        out.flush()

    warnings.simplefilter('ignore')
    for unused in ('matplotlib', 'numba'):  # a library loads them for its plots, for a second
        sys.modules[unused] = None  # type: ignore[assignment]
    try:
        __import__(LIBRARIES[reader])
    except ImportError as error:
        give('missing', text=str(error))
        return
    _bound_memory()
    try:
        for record in READERS[reader](path):
            give(**record)
    except MemoryError:
        give('problem', text=f'its reader needs more than {MEMORY >> 20} MB')
    except Exception as error:  # whatever a library of others raises
        give('problem', text=f'its reader gives up: {type(error).__name__} {error}'.strip())
    give('end')


if __name__ == '__main__':
    _main(*sys.argv[1:])
