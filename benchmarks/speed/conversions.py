# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What `sonar-imm convert` costs, by kind of file.

Each file is made here by other means than the package has, and converted by the whole command in a
process of its own, `rounds` times. CPU seconds are the least of them, with the start of the
command, which is also given alone (`nothing`); they depend little on what else the machine does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import resource
import struct
import subprocess
import sys
from tempfile import TemporaryDirectory
from typing import Any
import wave

import numpy as np

BEGIN = 1_750_000_000
"""Seconds since 1970 of the first record."""
Made = tuple[Path, int, tuple[str, ...]]
"""A file, how many records it holds, and the options of its conversion."""


def fixes(folder: Path, rows: int = 50_000) -> Made:
    """A table of positions, ten a second."""
    rng, k = np.random.default_rng(1), np.arange(rows)
    place = np.column_stack([0.05 * k, 20.0 * np.sin(1e-3 * k)]) + rng.normal(size=(rows, 2))
    lines = ['time,x,y,std'] + [
        f'{BEGIN + 0.1 * n:.1f},{x:.3f},{y:.3f},1.0' for n, (x, y) in enumerate(place)
    ]
    return _written(folder / 'fixes.csv', lines), rows, ()


def nmea(folder: Path, lines: int = 60_000) -> Made:
    """GGA, RMC and HDT of a vessel, once a second each."""
    found = []
    for k in range(lines // 3):
        clock = f'{k // 3600:02d}{k // 60 % 60:02d}{k % 60:02d}.00'
        place = f'5430.{k % 10_000:04d},N,01005.{3 * k % 10_000:04d},E'
        found.append(_sentence(f'GPGGA,{clock},{place},1,09,0.9,12.0,M,44.0,M,,'))
        found.append(_sentence(f'GPRMC,{clock},A,{place},4.1,90.0,030625,,,A'))
        found.append(_sentence('HEHDT,090.0,T'))
    return _written(folder / 'log.nmea', found), len(found), ()


def ais(folder: Path, lines: int = 30_000) -> Made:
    """Position reports of 30 ships, each behind a tag block with its time."""
    from pyais.encode import encode_dict

    found = []
    for k in range(lines):
        report: dict[str, Any] = {
            'msg_type': 1, 'mmsi': 211_000_000 + k % 30, 'lat': 54.5 + 1e-6 * k, 'lon': 10.0,
            'speed': 5.0, 'course': 0.0, 'accuracy': 1, 'second': k % 60,
        }  # fmt: skip
        (sentence,), block = encode_dict(report, sentence_type='VDM'), f'c:{BEGIN // 60 * 60 + k}'
        found.append(f'\\{block}*{_sum(block)}\\{sentence}')
    return _written(folder / 'ais.nmea', found), lines, ()


def telemetry(folder: Path, tags: int = 60, rows: int = 70_000) -> Made:
    """Detections of `tags` tags by seven receivers, to a microsecond."""
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.uniform(-300.0, 300.0, (7, 2)), np.full(7, -5.0)])
    stations = ['receiver,x,y,z'] + [
        f'VR2W-{100 + k},{x:.1f},{y:.1f},{z:.1f}' for k, (x, y, z) in enumerate(places)
    ]
    _written(folder / 'stations.csv', stations)
    found = []
    for n in range(rows // 7):
        tag, place = n % tags, np.append(rng.uniform(-200.0, 200.0, 2), -3.0)
        sent = BEGIN + 30.0 * (n // tags) + 30.0 * tag / tags
        for k, distance in enumerate(np.linalg.norm(places - place, axis=1)):
            heard = sent + distance / 1500.0
            found.append((heard, f'{heard:.6f},VR2W-{100 + k},A69-1601-{tag}'))
    lines = ['time,receiver,tag'] + [line for _, line in sorted(found)]
    options = ('--receivers', str(folder / 'stations.csv'))
    return _written(folder / 'detections.csv', lines), len(found), options


def segy(folder: Path, traces: int = 9000, samples: int = 1000) -> Made:
    """A line of a profiler, IEEE floats."""
    rng = np.random.default_rng(1)
    head = bytearray(3600)
    head[:3200] = 'C 1 A LINE'.ljust(3200).encode('cp037')
    struct.pack_into('>HHH', head, 3216, 40, 0, samples)
    struct.pack_into('>H', head, 3224, 5)
    content = np.zeros(traces, [('head', '>i2', 120), ('data', '>f4', samples)])
    content['data'] = rng.normal(size=(traces, samples))
    words, k = content['head'], np.arange(traces)
    words[:, [57, 58]] = samples, 40
    clock = [k * 0 + 2025, k * 0 + 154, k // 14_400, k // 240 % 60, k // 4 % 60, k * 0 + 2]
    words[:, 78:84] = np.column_stack(clock)
    path = folder / 'line.sgy'
    path.write_bytes(bytes(head) + content.tobytes())
    return path, traces, ()


def xtf(folder: Path, pings: int = 2000, samples: int = 2000) -> Made:
    """Side scan of two channels of 16 bits, five pings a second."""
    rng = np.random.default_rng(1)
    head = bytearray(1024)
    struct.pack_into('<B', head, 0, 0x7B)
    struct.pack_into('<HH', head, 164, 3, 2)
    for k in range(2):
        struct.pack_into('<BBHHH', head, 256 + 128 * k, 1 + k, 0, 0, 0, 2)
        struct.pack_into('<f', head, 288 + 128 * k, 450.0)
    parts = [bytes(head)]
    for k in range(pings):
        ping = bytearray(256)
        size = 256 + 2 * (64 + 2 * samples)
        size += -size % 64
        struct.pack_into('<HBBH', ping, 0, 0xFACE, 0, 0, 2)
        struct.pack_into('<I', ping, 10, size)
        struct.pack_into('<HBBBBBB', ping, 14, 2025, 6, 3, 10, k // 300, k // 5 % 60, k % 5 * 20)
        struct.pack_into('<f', ping, 32, 750.0)
        struct.pack_into('<dd', ping, 160, 54.0 + 1e-6 * k, 10.0)
        struct.pack_into('<f', ping, 212, 1.0)
        for side in range(2):
            channel = bytearray(64)
            struct.pack_into('<HHf', channel, 0, side, 0, 50.0)
            struct.pack_into('<I', channel, 42, samples)
            echoes = np.round(200.0 * rng.exponential(size=samples)).astype('<u2')
            ping += channel + echoes.tobytes()
        parts.append(bytes(ping).ljust(size, b'\0'))
    path = folder / 'line.xtf'
    path.write_bytes(b''.join(parts))
    return path, pings, ()


def sound(folder: Path, seconds: int = 60, rate: int = 48_000, channels: int = 8) -> Made:
    """Sound of an array, 16 bits."""
    path, rng = folder / 'array.wav', np.random.default_rng(1)
    with wave.open(str(path), 'wb') as file:
        file.setparams((channels, 2, rate, 0, 'NONE', 'NONE'))
        for _ in range(seconds):
            file.writeframes(
                rng.normal(scale=1000.0, size=(rate, channels)).astype('<i2').tobytes()
            )
    return path, seconds * rate, ('--start', '0')


def snapshots(folder: Path, pings: int = 200, bins: int = 2000, staves: int = 8) -> Made:
    """Array snapshots in a numpy archive."""
    rng, shape = np.random.default_rng(1), (pings, bins, staves)
    iq = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    path = folder / 'line.npz'
    np.savez(path, iq=iq, range=1.0 + 0.05 * np.arange(bins), stamp=BEGIN + np.arange(pings))
    return path, pings, ()


CASES: dict[str, tuple[str, str, Callable[..., Made]]] = {
    'CSV of fixes': ('fixes', 'rows', fixes),
    'NMEA 0183': ('nmea', 'sentences', nmea),
    'AIS': ('nmea', 'sentences', ais),
    'telemetry, 60 tags': ('detections', 'rows', telemetry),
    'telemetry, 1 tag': ('detections', 'rows', lambda folder: telemetry(folder, 1)),
    'SEG-Y, 1000 samples': ('segy', 'traces', segy),
    'XTF, 2 x 2000 samples': ('xtf', 'pings', xtf),
    'WAV, 8 channels': ('hydrophones', 'samples', sound),
    'npz, 2000 x 8': ('snapshots', 'pings', snapshots),
}
"""By the name of a row: the kind of `convert`, its records, and what makes a file."""


def _sum(text: str) -> str:
    """The checksum of a sentence."""
    total = 0
    for byte in text.encode():
        total ^= byte
    return f'{total:02X}'


def _sentence(text: str) -> str:
    return f'${text}*{_sum(text)}'


def _written(path: Path, lines: Sequence[str]) -> Path:
    path.write_text('\n'.join(lines) + '\n', encoding='utf-8')
    return path


def cpu_seconds(*words: str) -> float:
    """CPU seconds of the command `sonar-imm` with `words`; raises CalledProcessError."""
    command = [sys.executable, '-m', 'sonar_imm_tools.cli', *words]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return sum(getattr(after, each) - getattr(before, each) for each in ('ru_utime', 'ru_stime'))


def conversion(name: str, rounds: int) -> dict[str, Any]:
    """Convert the file of a case."""
    kind, unit, make = CASES[name]
    with TemporaryDirectory(prefix='sonar_imm_conversions_') as place:
        folder = Path(place)
        path, records, options = make(folder)
        spent = min(
            cpu_seconds('convert', kind, str(path), str(folder / f'bag{k}'), *options)
            for k in range(rounds)
        )
        size = path.stat().st_size / 1e6
    return {
        'records': records,
        'unit': unit,
        'MB': size,
        'CPU s': spent,
        'records per CPU s': round(records / spent),
        'MB per CPU s': size / spent,
    }
