# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Real recordings, read and scored: a towed acoustic tag (yaps) and boats (Autoferry).

`recording_scores` and `real_boats` print what docs/results/recordings.md shows. Truth of the tag
is a hand-held GPS, itself good to a few metres and ahead of the tag, which is towed: errors are
given against GPS as it is and against GPS 3.4 s later.

A record of ``scenario13_detections.json`` is one scan of one sensor: ``measurement`` is 2 x M,
north then east relative to the own ship (a flat pair for M = 1, empty for none), and
``ownshipPosition`` is north and east of the own ship. Every record is a scan of fixes, also one
without detections: that nothing was seen is evidence too. Infrared and camera (bearings only) are
left out. The targets are boats, not divers.
"""

from __future__ import annotations

from collections.abc import Sequence
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.estimates import read_estimate
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Arrivals, Fix, Fixes, Rejection
from sonar_imm.trackers.diver.births import locate_fix
from sonar_imm.trackers.diver.tracker import DiverConfig
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader

DATA = Path(os.environ.get('SONAR_IMM_DATA', '../shared/data'))
SENSORS = {'lidar': 1, 'radar': 2}


def autoferry(sensor: str, time_offset_ns: int = 0) -> tuple[list[Fixes], NDArray[np.float64]]:
    """The scans of radar or lidar in scenario 13 by time, and the truth: rows (stamp s, id, x, y),
    east and north in m. time_offset_ns: added to the stamps of the scans."""
    folder = DATA / 'autoferry'
    scans = scans_of(_read(folder / 'scenario13_detections.json'), sensor, time_offset_ns)
    return scans, truth_of(_read(folder / 'scenario13_groundTruth.json'))


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding='utf-8'))


def scans_of(records: Any, sensor: str, time_offset_ns: int = 0) -> list[Fixes]:
    """The scans of one sensor by time."""
    scans = [
        Fixes(
            stamp_ns=_nanoseconds(record['time']) + time_offset_ns,
            position=np.pad(_east_north(record), ((0, 0), (0, 1))),
            covariance=None,
            frame_id='map',
        )
        for record in records
        if record['sensorID'] == SENSORS[sensor]
    ]
    return sorted(scans, key=lambda scan: scan.stamp_ns)


def _east_north(record: Any) -> NDArray[np.float64]:
    """Detections (M, 2) of one record as east, north in the world."""
    relative = np.array(record['measurement'], np.float64).reshape(2, -1)
    return (relative + np.array(record['ownshipPosition'])[:, None])[::-1].T


def truth_of(groups: Any) -> NDArray[np.float64]:
    """Rows (stamp s, id, x, y) by time; in the file targets are repeated, each with its time."""
    rows = {
        (_nanoseconds(target['time']), int(target['targetID'])): target['position'][1::-1]
        for group in groups
        for target in group
    }
    return np.array(
        [(stamp * 1e-9, number, *rows[stamp, number]) for stamp, number in sorted(rows)]
    )


def _nanoseconds(seconds: float) -> int:
    """A double resolves about 0.2 us today."""
    return round(seconds * 1e9)


LAG = 3.4
CUTOFF, NINETY_FIVE, LONGEST_GAP = 20.0, 5.991, 60.0

TAG: dict[str, Any] = {
    'max_tracks': 1,
    'confirm_hits': 1,
    'max_coast': 600.0,
    'sound_speed': 1545.0,
    'target_z': -1.0,
    'toa_std': 0.0009,
}
"""What a user knows: one tag, silent for half a minute at a time, a metre deep, in water of this
sound speed, with receivers of this accuracy. Everything else is at its default."""

BOATS: dict[str, Any] = {'speed_mean': 2.0, 'speed_std': 1.5, 'speed_noise': 0.1}
HEADINGS: dict[str, Any] = {'model_set': 'heading_speed'}
PACE: dict[str, Any] = {**HEADINGS, 'speed_noise': 0.07}
"""A swimmer whose speed, spread by `speed_std` = .4 m/s, is another one after a minute: a random
walk of sqrt(2 / 60 s) .4 m/s over a second, as that of a process that forgets within a minute."""
COLUMNS = ('tx_id', 'rx_id', 'tx', 'rx', 'toa', 'var_toa', 'bearing', 'var_bearing')


def load(bag: Path) -> tuple[list, np.ndarray]:
    """Measurements of a bag, and truth as rows (stamp s, id, x, y)."""
    with BagReader(bag) as reader:
        found = [item.measurement for item in measurements_of(reader, 'diver')]
    truth = []
    with BagReader(bag) as reader:
        for item in reader.messages(['/truth/estimate']):
            table = read_estimate(item.message)
            truth += [
                (table.stamp_ns * 1e-9, int(i), x, y)
                for i, x, y in zip(
                    table.extras['track_id'], table.extras['px'], table.extras['py']
                )
            ]
    return [each for each in found if not isinstance(each, Rejection)], np.array(truth)


def raw(items: Sequence[Any], config: DiverConfig) -> list[Estimate]:
    """The fixes themselves, or those that each ping gives by itself, each a track without a
    past."""
    out: list[Estimate] = []
    number = 0
    for item in items:
        places, R = np.empty((0, 2)), np.empty((0, 2, 2))
        if isinstance(item, Fixes):
            places = item.position[:, :2]
            R = np.tile(config.fix_std**2 * np.eye(2), (len(places), 1, 1))
        elif isinstance(item, Fix):
            assert item.covariance is not None
            places = item.position[None, :2]
            R = config.covariance_scale * item.covariance[None, :2, :2]
        elif fix := locate_fix(item, np.arange(len(item)), config):
            places, R = fix.position[None, :2], np.asarray(fix.covariance)[None]
        else:
            continue
        count = len(places)
        extras: dict[str, Any] = {
            'track_id': number + np.arange(count),
            'track_state': np.ones(count, np.uint8),
        }
        number += count
        out.append(
            Estimate(
                stamp_ns=item.stamp_ns,
                frame_id='map',
                xyz=np.zeros((count, 3), np.float32),
                state_names=('px', 'py'),
                state=np.reshape(places, (-1, 2)),
                covariance=R,
                extras=extras,
            )
        )
    return out


def thinned(items: list, receivers: int, keep: float, seed: int = 1) -> list:
    """Fewer receivers per ping, and fewer pings."""
    rng = np.random.default_rng(seed)
    out = []
    for ping in items:
        rows = np.sort(rng.permutation(len(ping))[:receivers])
        if rng.uniform() < keep and len(rows) > 1:
            columns = {name: getattr(ping, name)[rows] for name in COLUMNS}
            out.append(Arrivals(stamp_ns=ping.stamp_ns, frame_id=ping.frame_id, **columns))
    return out


def present(truth: np.ndarray, at: float) -> np.ndarray:
    """Where the targets (k, 2) are at a time, by their own rows next to it."""
    places = []
    for number in np.unique(truth[:, 1]):
        path = truth[truth[:, 1] == number]
        after = int(np.searchsorted(path[:, 0], at))
        if 0 < after < len(path) and path[after, 0] - path[after - 1, 0] < LONGEST_GAP:
            places.append([np.interp(at, path[:, 0], path[:, c]) for c in (2, 3)])
    return np.reshape(places, (-1, 2))


def scores(
    estimates: Sequence[Estimate], truth: np.ndarray, tag: bool = False
) -> dict[str, float]:
    """What a recording makes of a tracker: of a tag every estimate counts, however far it is."""
    cutoff, lag = (1e6, LAG) if tag else (CUTOFF, 0.0)
    squared: list[float] = []
    normalised: list[float] = []
    ids: set[int] = set()
    there = false = 0
    distance = []
    for estimate in estimates:
        at = present(truth, estimate.stamp_ns * 1e-9 + lag)
        if tag and not len(at):
            continue
        rows = np.flatnonzero(estimate.extras['track_state'] > 0)
        state, P = estimate.state[rows, :2], estimate.covariance[rows, :2, :2]
        found = gospa(at, state, cutoff, 2)
        distance.append(found.distance)
        there += len(at)
        ids.update(estimate.extras['track_id'][rows].tolist())
        matched = np.flatnonzero(found.estimate_of >= 0)
        false += len(rows) - len(matched)
        for target, row in zip(matched, found.estimate_of[matched]):
            error = state[row] - at[target]
            squared.append(float(error @ error))
            normalised.append(float(error @ np.linalg.solve(P[row], error)))
    out = {
        'RMSE': float(np.sqrt(np.mean(squared))),
        'NEES': float(np.mean(normalised)),
        'coverage': float(np.mean(np.array(normalised) < NINETY_FIVE)),
        'seen': len(squared) / there,
        'ids': len(ids),
    }
    if tag:
        return {**out, 'median': float(np.median(np.sqrt(squared)))}
    count = len(estimates)
    wrong = {'missed': (there - len(squared)) / count, 'false': false / count}
    return {**out, 'GOSPA': float(np.mean(distance)), **wrong}
