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
`_profile`) and ``problem``, whose ``text`` says why there is no more. This module imports nothing
of the package, so that the child starts fast.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
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
    frequency), sound_speed, place (x, y) in degrees or metres as units says, heading, pitch, roll
    in degrees, depth, altitude in metres."""
    import pyxtf

    # Beside a file the library would unpickle an index; a file descriptor has nothing beside it.
    with open(path, 'rb') as file:
        packets = pyxtf.xtf_read_gen(f'/dev/fd/{file.fileno()}')
        head = next(packets)
        if head.FileFormat != 0x7B:
            raise ValueError(f'the version of the file is {head.FileFormat}, not 123')
        for packet in packets:
            if packet.NumBytesThisRecord < PACKET_HEAD:
                raise ValueError('a packet states no length')
            if isinstance(packet, pyxtf.XTFPingHeader) and (
                packet.HeaderType == pyxtf.XTFHeaderType.sonar
            ):
                yield _xtf_ping(head, packet, pyxtf.XTFChannelType)


def _xtf_ping(head: Any, packet: Any, types: Any) -> Record:
    sides = {types.port.value: 'port', types.stbd.value: 'starboard'}
    channels = []
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
            # As they lie in the file: athwartships, then alongships; 128 are half a turn.
            'angle': None if angle is None else np.asarray(angle)[:, 0] * (math.pi / 128.0),
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
        yield _profile(cast.get_depths_in_meters(), cast.get_sound_speeds_in_meters_per_second())
    yield from _kongsberg(handler)


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
    'ek80': _simrad,
    'kmall': _kmall,
    'all': _all,
}
LIBRARIES = {'xtf': 'pyxtf', **dict.fromkeys(('ek80', 'kmall', 'all'), 'themachinethatgoesping')}


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
