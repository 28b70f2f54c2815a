# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Scenes of `diver_field` with fixes that are off by a vector, and with outliers.

*single*: one target (`max_tracks: 1`) in legs, a fix a second. `bursts`: ten fixes 25 m off,
twice; `two 100 m`: two fixes, thrice; `multipath`: 15 to 40 m in runs of six, 30 % of the fixes;
`reflections`: the same with another vector at each fix; `outliers`: 15 % of 30 m on each axis;
`singles`: 3 % by 20 to 60 m; `8 m`: thirty fixes, twice; `begins`: the first five fixes. Fixes
before the tenth do not count. NEES is of the position, 2 is due. `warns`: the share of runs with
a sentence about bursts or outliers.

*scans*: of a sensor with P_D .9 that sees the targets with .7 m, and two or five false fixes in a
square of 120 m. GOSPA is the mean over scans of order 2, cutoff 8 m. `kept`: the share of runs in
which the first target keeps its number. In `new diver`, the first target is missed two or four
times while another one appears 10 to 30 m away.
"""

from __future__ import annotations

from typing import Any
import zlib

import numpy as np

from benchmarks.diver_families import FIRST, followed, INSIDE, integrated, legs, Path, smooth_turns
from benchmarks.study import rms
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

TARGETS: dict[str, tuple[float, dict[str, Any]]] = {
    'diver': (1.0, {}),
    'rov': (0.3, {'target': 'rov'}),
    'boat': (1.0, {}),
}
"""Standard deviation of a fix on each axis, m, and parameters. A boat at 3 m/s is told nothing."""

FAULTS = (
    *('clean', 'bursts', 'two 100 m', 'multipath', 'reflections', 'outliers', 'singles', '8 m'),
    'begins',
)
CASES = ('clean', 'reflections', 'burst', 'crossing', 'new diver 2', 'new diver 4')
SAID = ('taken for', 'the estimate holds both')
FIXES, SCANS = 300, 200
P_DETECTION, STD, HALF, CUTOFF = 0.9, 0.7, 60.0, 8.0


def turned(rng: np.random.Generator, least: float, most: float) -> FloatArray:
    """A vector (2,) of a length between two."""
    angle, length = rng.uniform(-np.pi, np.pi), rng.uniform(least, most)
    return length * np.array([np.cos(angle), np.sin(angle)])


def runs_of_six(rng: np.random.Generator, count: int) -> list[range]:
    """Runs of six fixes that are 30 % of all."""
    found, k = [], 30
    while k < count:
        if rng.uniform() < 0.3 / 6.0 / 0.7:
            found.append(range(k, min(k + 6, count)))
            k += 6
        else:
            k += 1
    return found


def offsets(rng: np.random.Generator, fault: str) -> FloatArray:
    """By how much each fix (n, 2) is off."""
    off = np.zeros((FIXES, 2))
    fixed = {
        'bursts': ((80, 190), 10, 25.0),
        'two 100 m': ((70, 140, 230), 2, 100.0),
        '8 m': ((80, 190), 30, 8.0),
        'begins': ((0,), 5, 25.0),
    }
    if fault in fixed:
        starts, length, distance = fixed[fault]
        for k in starts:
            off[k : k + length] = turned(rng, distance, distance)
    if fault in ('multipath', 'reflections'):
        for run in runs_of_six(rng, FIXES):
            one = turned(rng, 15.0, 40.0)
            off[run] = [one if fault == 'multipath' else turned(rng, 15.0, 40.0) for _ in run]
    wild = rng.uniform(size=FIXES) < {'outliers': 0.15, 'singles': 0.03}.get(fault, 0.0)
    wild[:20] = False
    for k in np.flatnonzero(wild).tolist():
        off[k] = 30.0 * rng.normal(size=2) if fault == 'outliers' else turned(rng, 20.0, 60.0)
    return off


def target_path(rng: np.random.Generator, kind: str) -> FloatArray:
    """Positions (n, 2) of a target, one a second."""
    if kind == 'boat':
        heading = smooth_turns(rng, FIXES, 8.0, 15.0)
        return integrated(np.full(len(heading), 3.0), heading)[::10]
    speed, heading = legs(
        rng, FIXES, *((0.7, 25.0, 60.0) if kind == 'diver' else (0.4, 15.0, 90.0))
    )
    if kind == 'rov':
        speed = np.where(np.arange(len(speed)) // 400 % 3 == 2, 0.0, speed)
    return integrated(speed, heading)[::10]


def single(seed: int, kind: str, fault: str) -> dict[str, float]:
    """Errors of one target whose fixes have a fault."""
    rng = np.random.default_rng([seed, zlib.crc32(f'{kind} {fault}'.encode())])
    std, settings = TARGETS[kind]
    truth = target_path(rng, kind)
    z = truth + std * rng.normal(size=truth.shape) + offsets(rng, fault)
    R = np.tile(np.eye(2) * std**2, (FIXES, 1, 1))
    path = Path(np.arange(float(FIXES)), truth, z, R)
    error, squared, tracker = followed(path, DiverConfig(max_tracks=1, **settings))
    error, squared = error[FIRST:], squared[FIRST:]
    there = np.isfinite(squared)
    said = any(word in each for each in tracker.warnings() for word in SAID)
    return {
        'rmse_m': rms(np.hypot(*error[there].T)),
        'nees': float(np.mean(squared[there])),
        'coverage': float(np.mean(squared[there] <= INSIDE)),
        'tracks': float(tracker._stream.state.life.next_id - 1),
        'warns': float(said),
    }


def swimmers(rng: np.random.Generator, case: str) -> FloatArray:
    """Positions (SCANS, T, 2) of the targets, NaN before one is there."""
    count = {'burst': 3, 'clean': 2, 'crossing': 2}.get(case, 1)
    place, course = rng.uniform(-20.0, 20.0, (count, 2)), rng.uniform(-np.pi, np.pi, count)
    if case == 'crossing':
        place[1] = place[0] + [3.0, 0.0]
    truth = np.empty((SCANS, count, 2))
    for k in range(SCANS):
        truth[k] = place
        turns = rng.uniform(size=count) < 1.0 / 30.0
        course = np.where(turns, course + 1.2 * rng.normal(size=count), course)
        out = np.abs(place).max(axis=1) > 0.7 * HALF
        course = np.where(out, np.arctan2(-place[:, 1], -place[:, 0]), course)
        place = place + 0.7 * np.column_stack([np.cos(course), np.sin(course)])
    if case.startswith('new diver'):
        way = 0.5 * np.maximum(np.arange(SCANS) - 80, 0)[:, None] * turned(rng, 1.0, 1.0)
        new = truth[80, 0] + turned(rng, 10.0, 30.0) + way
        new[:80] = np.nan
        truth = np.concatenate([truth, new[:, None]], axis=1)
    return truth


def scans(seed: int, case: str, false: float) -> dict[str, float]:
    """GOSPA, and the identity of the first target."""
    rng = np.random.default_rng([seed, zlib.crc32(f'{case} {false}'.encode())])
    truth = swimmers(rng, case)
    seen = truth.copy()
    if case == 'reflections':
        for run in runs_of_six(rng, SCANS):
            seen[run, 0] += turned(rng, 15.0, 40.0)
    if case in ('burst', 'crossing'):
        for k in (50, 120):
            seen[k : k + 12, 0] += turned(rng, 25.0, 25.0)
    seen[rng.uniform(size=seen.shape[:2]) > P_DETECTION] = np.nan
    if case.startswith('new diver'):
        seen[80 : 80 + int(case[-1]), 0] = np.nan
        seen[80:84, 1] = truth[80:84, 1]
    tracker, distance, extra, first, kept = DiverTracker(DiverConfig()), [], [], -1, False
    for k, (places, there) in enumerate(zip(seen, truth)):
        z = places[np.isfinite(places[:, 0])]
        z = z + STD * rng.normal(size=z.shape)
        z = np.concatenate([z, rng.uniform(-HALF, HALF, (rng.poisson(false), 2))])
        position = np.column_stack([rng.permutation(z), np.zeros(len(z))])
        covariance = np.tile(STD**2 * np.eye(2), (len(z), 1, 1))
        scan = Fixes(stamp_ns=(k + 1) * 10**9, position=position, covariance=covariance)
        estimate = tracker.process(scan)[-1]
        firm = estimate.extras['track_state'] > 0
        place, ids = estimate.state[firm, :2], estimate.extras['track_id'][firm]
        due = there[np.isfinite(there[:, 0])]
        score = gospa(due, place, CUTOFF)
        distance.append(score.distance)
        extra.append(max(len(place) - len(due), 0))
        apart = np.hypot(*(place - there[0]).T)
        near = int(ids[apart.argmin()]) if len(ids) and apart.min() < 4.0 else -1
        first = near if k == 45 else first
        kept = near == first != -1
    return {
        'gospa_m': float(np.mean(distance)),
        'kept': float(kept),
        'false': float(np.mean(extra)),
    }
