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

"""Array snapshots from a numpy archive (npz).

Arrays are found by their usual names (`NAMES`); other names can be given. Needed are the complex
samples, (bins, staves) for one ping or (pings, bins, staves), and the range or the two-way time of
each bin. Where the archive also has the true floor, with the height and tilt of the sonar, it goes
to ``/truth/estimate``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.snapshots import write_snapshot
from sonar_imm.acoustics import array
from sonar_imm.measurements import Rejection, Snapshot
from sonar_imm.truth import TrueProfile

from ..conversion import ConversionReport, numbers_of, read_npz, Record, stamps_of, write_bag
from ..convert_options import SnapshotsOptions
from ..messages import ros_message
from ..sources import BagError
from ..truth import records_of

NAMES: dict[str, tuple[str, ...]] = {
    'iq': ('iq', 'snapshots', 'Y', 'quadrants'),
    'range': ('range', 'range_m', 'ranges', 'r'),
    'time': ('time', 'two_way_time'),
    'stamp': ('stamp', 'stamps'),
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
}
"""Usual names of each array; the first one that the archive has is taken. Stamps in seconds,
spacings in metres or wavelengths, snr linear and at one stave, tilt in radians."""

FIRST_STAMP_NS = 1_700_000_000_000_000_000
_CONSTANTS = ('sound_speed', 'frequency', 'sample_rate')


def convert_snapshots(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert an npz archive to the topic ``/snapshot``, one message per ping.

    values: as in `SnapshotsOptions`; names are by the names of `NAMES`, and without staves each
    channel is one. Raises `BagError`.
    """
    how = SnapshotsOptions(**values)
    report = ConversionReport(Path(out))
    content = _Archive(path, how.names)
    samples = _samples(content, how.staves)
    stamps = _stamps(content, len(samples), how.ping_rate)
    constants = {name: content.number(name) for name in _CONSTANTS}
    constants['element_spacing'] = _element_spacing(content, constants, report)
    records: list[Record] = []
    for ping, (stamp, iq) in enumerate(zip(stamps, samples)):
        report.rows += 1
        try:
            snapshot = _snapshot(content, ping, stamp, iq, constants, how.frame_id)
        except Rejection as error:
            report.bad_row(content.path, f'ping {ping}', error)
            continue
        records.append((stamp, '/snapshot', write_snapshot(snapshot, ros_message)))
        if (profile := _truth(content, ping, snapshot)) is not None:
            records += records_of(profile, '')
    return write_bag(out, records, report, source=Path(path).name, storage=how.storage)


class _Archive:
    """The arrays of an npz file, by the names of `NAMES`."""

    def __init__(self, path: str | Path, names: Mapping[str, str]):
        self.path = Path(path)
        if unknown := [name for name in names if name not in NAMES]:
            raise BagError(f"unknown array '{unknown[0]}'; the names are {', '.join(NAMES)}")
        there = read_npz(self.path)
        wanted = {what: (names[what],) if what in names else NAMES[what] for what in NAMES}
        self._arrays: dict[str, NDArray] = {}
        for what, candidates in wanted.items():
            found = [name for name in candidates if name in there]
            if found:
                self._arrays[what] = numbers_of(self.path, found[0], there[found[0]])
            elif what in names:
                raise BagError(f"{path} has no array '{names[what]}'; it has {', '.join(there)}")
        self.listed = ', '.join(there)

    def get(self, what: str) -> NDArray | None:
        return self._arrays.get(what)

    def need(self, what: str) -> NDArray:
        if what not in self._arrays:
            raise BagError(
                f'{self.path} has no array {" or ".join(NAMES[what])}; it has {self.listed}'
            )
        return self._arrays[what]

    def number(self, what: str) -> float | None:
        """Give a scalar; None when the archive has none."""
        value = self.get(what)
        if value is None:
            return None
        if value.size != 1 or not np.isfinite(value).all():
            raise BagError(f'{self.path}: {what} has to be one finite number')
        return float(value.ravel()[0])

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


def _stamps(content: _Archive, pings: int, ping_rate: float) -> list[int]:
    stamps = content.get('stamp')
    if stamps is None:
        return [FIRST_STAMP_NS + round(ping * 1e9 / ping_rate) for ping in range(pings)]
    return stamps_of(content.path, stamps, pings, 'pings')


def _element_spacing(
    content: _Archive, constants: Mapping[str, float | None], report: ConversionReport
) -> float | None:
    """Metres between staves. A spacing in wavelengths that cannot be converted is noted instead,
    for the parameters of the tracker."""
    metres = content.number('element_spacing')
    wavelengths = content.number('spacing_wavelengths')
    if metres is not None or wavelengths is None:
        return metres
    speed, frequency = constants['sound_speed'], constants['frequency']
    if speed and frequency:
        return wavelengths * speed / frequency
    report.notes['element_spacing_wavelengths'] = f'{wavelengths:g}'
    return None


def _snapshot(
    content: _Archive,
    ping: int,
    stamp: int,
    iq: NDArray,
    constants: Mapping[str, float | None],
    frame_id: str,
) -> Snapshot:
    bins = len(iq)
    ranges, time = content.per_bin('range', ping, bins), None
    if ranges is None:
        content.need('time')
        time = content.per_bin('time', ping, bins)
        assert time is not None
        ranges = np.asarray(0.5 * (constants['sound_speed'] or 1500.0) * time)
    noise = content.per_bin('noise_variance', ping, bins)
    signal = content.per_bin('signal_variance', ping, bins)
    ratio = content.per_bin('snr', ping, bins)
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
        sound_speed=constants['sound_speed'],
        frequency=constants['frequency'],
        element_spacing=constants['element_spacing'],
        sample_rate=constants['sample_rate'],
    )


def _truth(content: _Archive, ping: int, snapshot: Snapshot) -> TrueProfile | None:
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
