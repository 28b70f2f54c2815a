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
"""Raw files of Simrad's split beams and of Kongsberg's multibeams.

The halves of a split beam are an array of two staves: ``/snapshot`` of the bathymetry tracker.
Soundings are ``/ground``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.snapshots import write_snapshot
from sonar_imm.measurements import Rejection, Snapshot

from ..conversion import ConversionReport, converter
from ..convert_options import Ek80Options, KongsbergOptions
from ..foreign import Record
from ..messages import ros_message
from ..sources import start_of
from .sonar_files import ground_message, Message, speed_of, write_pings

HALVES: dict[int, Sequence[Sequence[int]]] = {4: ((0, 3), (1, 2)), 3: ((0,), (1,))}
"""The sectors of a split beam that make its starboard and its port half, by their number."""


@converter(Ek80Options)
def convert_ek80(path: Path, how: Ek80Options, report: ConversionReport) -> None:
    """Convert the complex samples, or the power and angles, of a split-beam echo sounder to
    ``/snapshot``.
    """
    reader = 'ek60' if start_of(path, 8)[4:8] == b'CON0' else 'ek80'
    others: set[str] = set()
    chosen = ''

    def messages(ping: Record) -> Iterator[Message]:
        nonlocal chosen
        if how.channel not in ping['channel'] or chosen not in ('', ping['channel']):
            others.add(ping['channel'])
            return
        if ping['iq'] is None and (ping['power'] is None or ping['angle'] is None):
            raise Rejection('power_only', 'it holds power alone, which says no direction')
        chosen = ping['channel']
        snapshot = _split_beam(ping, how)
        yield Message('/snapshot', write_snapshot(snapshot, ros_message))

    write_pings(path, reader, report, how, messages)
    report.notes['channel'] = chosen
    if others:
        report.notes['other channels'] = ', '.join(sorted(others))


@converter(KongsbergOptions)
def convert_kongsberg(path: Path, how: KongsbergOptions, report: ConversionReport) -> None:
    """Convert the soundings of a KMALL or .all file to ``/ground``, beside ``/nav``."""

    def messages(ping: Record) -> Iterator[Message]:
        if ping['soundings'] is None:
            raise Rejection('no_soundings', 'it has no soundings')
        # Of a file that is cut off, the library makes soundings at the ship itself.
        found = ping['soundings']
        found = found[np.isfinite(found).all(axis=1) & found.any(axis=1)]
        if not len(found):
            raise Rejection('no_soundings', 'none of its soundings is valid')
        # Soundings are level: they turn with the heading alone.
        heading = math.radians(ping['heading'])
        s, c = math.sin(heading), math.cos(heading)
        offset = np.column_stack(
            [s * found[:, 0] + c * found[:, 1], c * found[:, 0] - s * found[:, 1], -found[:, 2]]
        )
        yield ground_message(ping, offset)

    reader = 'kmall' if start_of(path, 8)[4:5] == b'#' else 'all'
    profiles: dict[str, dict[str, Any]] = {'bathymetry': {}}
    write_pings(path, reader, report, how, messages, profiles)
    if 'sound_speed_profile' in profiles['bathymetry']:
        report.notes['sound speed'] = (
            'the last profile is in parameters.yaml beside the bag, for --params of other bags'
        )


def _split_beam(ping: Record, how: Ek80Options) -> Snapshot:
    """The halves, or the chosen sums, of the sectors of a split beam."""
    interval, spacing = float(ping['sample_interval']), how.element_spacing
    if not (math.isfinite(interval) and interval > 0.0):
        raise Rejection('out_of_range', f'its samples are {interval:g} s apart')
    if ping['iq'] is None:
        iq = _of_angles(ping, how)
    else:
        sectors = ping['iq'].shape[1]
        staves = HALVES.get(sectors, ()) if how.staves is None else how.staves
        if len(staves) < 2 or any(not 0 <= k < sectors for stave in staves for k in stave):
            raise Rejection('bad_staves', f'it has {sectors} sectors; --staves says which to take')
        iq = np.stack([ping['iq'][:, list(stave)].sum(axis=1) for stave in staves], axis=1)
        if ping['chirp'] is not None:
            iq = _compressed(iq, ping['chirp'], interval)
    if spacing is None and how.staves is None and 0.0 < ping['spacing'] < 10.0:
        spacing = float(ping['spacing'])
    iq, speed = iq[1:], speed_of(ping)  # the first sample lies at range 0
    return Snapshot(
        stamp_ns=ping['stamp_ns'],
        frame_id=how.frame_id,
        range=np.arange(1, 1 + len(iq)) * 0.5 * speed * interval,
        iq=iq,
        sound_speed=speed,
        frequency=float(ping['frequency']),
        element_spacing=spacing,
        sample_rate=1.0 / interval,
    )


def _of_angles(ping: Record, how: Ek80Options) -> np.ndarray:
    """(R, 2) of power and the phase of the starboard half against the port half."""
    if how.staves is not None:
        raise Rejection('bad_staves', 'it holds power and angles: there are no sectors to choose')
    if len(ping['power']) != len(ping['angle']):
        raise Rejection('bad_shape', 'its powers and angles are not equally many')
    turn = np.exp(0.5j * ping['angle'])
    size = 10.0 ** (np.asarray(ping['power'], np.float64) / 20.0)
    return np.column_stack([size * turn, size * turn.conj()])


def _compressed(iq: np.ndarray, chirp: Record, interval: float) -> np.ndarray:
    """Samples (R, N) of a chirp after the matched filter: a linear sweep with Hann edges, sent
    through the filters of the receiver (Andersen et al., 2024, Methods Ecol. Evol. 15)."""
    (low, high), duration, rate = chirp['band'], chirp['duration'], chirp['rate']
    known = all(map(math.isfinite, (low, high, duration, chirp['slope'], rate)))
    if not (known and 2.0 <= duration * rate <= 1e6 and 0.0 <= chirp['slope'] <= 0.5):
        raise Rejection('chirp', 'it is a chirp of which the file does not say how it was made')
    if (
        not abs(math.prod(step for _, step in chirp['filters']) / rate - interval)
        < 1e-3 * interval
    ):
        raise Rejection('chirp', 'it is a chirp whose filters the file does not hold')
    time = np.arange(int(duration * rate)) / rate
    replica = np.cos(2.0 * math.pi * (low + 0.5 * (high - low) / duration * time) * time)
    edges = np.hanning(round(2.0 * chirp['slope'] * duration * rate))
    rise, fall = edges[: len(edges) // 2], edges[len(edges) // 2 :]
    replica[: len(rise)] *= rise
    replica[len(replica) - len(fall) :] *= fall
    for coefficients, step in chirp['filters']:
        replica = np.convolve(replica, coefficients)[::step]
    replica /= np.sum(np.abs(replica) ** 2)
    lags = [np.correlate(stave, replica, mode='full')[len(replica) - 1 :] for stave in iq.T]
    return np.column_stack(lags)
