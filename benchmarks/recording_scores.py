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

"""Every real recording of divers and boats in one table each: the default, its single families,
conventional filters, and a peer.

    SONAR_IMM_DATA=../shared/data python -m benchmarks.recording_scores \\
        --out docs/results/recording_scores.json

`plain CV Kalman` is that of `real_boats`; the peer is FilterPy's Kalman filter with the noise of
ours, which takes the fixes of a tag one by one and knows no clutter. Tags are
compared with GPS 3.4 s later, boats with GNSS within 20 m of a track; `seen` is the share of what
there was to see that has a confirmed track, `ids` counts their identities.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
import tempfile
from typing import Any

from filterpy.kalman import KalmanFilter
import numpy as np

from benchmarks.real_boats import PlainKalman
from benchmarks.real_recordings import autoferry, DATA, HEADINGS, LAG, PACE, raw_fixes, TAG
from benchmarks.real_recordings import load as load_bag
from benchmarks.study import final_estimates, Parts, study
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.recordings.convert import convert_arrivals, convert_fixes

NOISE = 0.1
CUTOFF, NINETY_FIVE, LONGEST_GAP = 20.0, 5.991, 60.0
SINGLE: dict[str, dict[str, Any]] = {
    'CV Kalman': {'model_set': 'cv', 'acceleration_noise': (NOISE,)},
    'steady alone (heading_speed)': HEADINGS,
    'brisk alone': PACE,
    'lively alone': {
        'model_set': 'cv_cv',
        'acceleration_noise': (0.05, 0.6),
        'baseline_stay_probability': 0.85,
    },
    'quiet alone': {'model_set': 'cv', 'acceleration_noise': (0.03,)},
}
RECORDINGS: dict[str, tuple[str, dict[str, Any]]] = {
    'tow tag, fixes': ('fixes', TAG),
    'tow tag, fixes, covariances times 6': ('fixes', {**TAG, 'covariance_scale': 6.0}),
    'tow tag, arrivals': ('arrivals', TAG),
    'boats, radar, stamps -1.5 s': ('radar', {'fix_std': 4.0}),
    'boats, lidar': ('lidar', {'fix_std': 2.0}),
}
"""What each holds, and what is told of it."""


def load(kind: str) -> tuple[list[Any], np.ndarray]:
    """Measurements and truth, rows (stamp s, id, x, y), of a recording."""
    if kind in ('radar', 'lidar'):
        return autoferry(kind, round(-1.5e9) if kind == 'radar' else 0)
    folder = DATA / 'yaps_ssu1'
    with tempfile.TemporaryDirectory() as scratch:
        out, truth = Path(scratch) / kind, folder / 'gps_truth.csv'
        if kind == 'fixes':
            convert_fixes(folder / 'fixes.csv', out, truth=truth)
        else:
            receivers = folder / 'receivers.csv'
            convert_arrivals(folder / 'arrivals.csv', out, receivers=receivers, truth=truth)
        return load_bag(out)


def present(truth: np.ndarray, at: float) -> np.ndarray:
    """Where the targets (k, 2) are at a time, by their own rows next to it."""
    places = []
    for number in np.unique(truth[:, 1]):
        path = truth[truth[:, 1] == number]
        after = int(np.searchsorted(path[:, 0], at))
        if 0 < after < len(path) and path[after, 0] - path[after - 1, 0] < LONGEST_GAP:
            places.append([np.interp(at, path[:, 0], path[:, c]) for c in (2, 3)])
    return np.reshape(places, (-1, 2))


def scores(estimates: Sequence[Estimate], truth: np.ndarray, tag: bool) -> dict[str, float]:
    """What a recording makes of a tracker: of a tag every estimate counts, however far it is."""
    cutoff, lag = (1e6, LAG) if tag else (CUTOFF, 0.0)
    squared, normalised, ids, there, distance = [], [], set(), 0, []
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
        for target, row in enumerate(found.estimate_of):
            if row >= 0:
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
    return out if tag else {**out, 'GOSPA': float(np.mean(distance))}


class Peer:
    """FilterPy's Kalman filter with our noise, for one target, each fix as it comes."""

    def __init__(self, scale: float):
        self.scale, self.stamp_ns = scale, 0
        self.filter = KalmanFilter(dim_x=4, dim_z=2)
        self.filter.H = np.eye(2, 4)

    def process(self, fix: Fix) -> list[Estimate]:
        z, R = fix.position[:2], np.asarray(fix.covariance)[:2, :2] * self.scale
        kalman, dt = self.filter, (fix.stamp_ns - self.stamp_ns) * 1e-9
        if not self.stamp_ns:
            kalman.x, kalman.P = np.append(z, [0.0, 0.0]), np.diag([*np.diag(R), 1.0, 1.0])
        else:
            kalman.F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
            q = NOISE**2 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
            kalman.predict(Q=np.kron(q, np.eye(2)))
            kalman.update(z, R=R)
        self.stamp_ns = fix.stamp_ns
        return [
            Estimate(
                stamp_ns=fix.stamp_ns,
                frame_id='map',
                xyz=np.zeros((1, 3), np.float32),
                state_names=('px', 'py', 'vx', 'vy'),
                state=np.reshape(kalman.x, (1, 4)),
                covariance=np.reshape(kalman.P, (1, 4, 4)),
                extras={'track_id': np.ones(1, int), 'track_state': np.ones(1, int)},
            )
        ]


def trackers(kind: str, stated: dict[str, Any]) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Each tracker of a recording by its name."""
    clutter = {} if kind in ('fixes', 'arrivals') else {'clutter_density': 1e-5}

    def ours(values: dict[str, Any]) -> DiverTracker:
        return DiverTracker(DiverConfig(**{**stated, **clutter, **values}))

    yield 'default', lambda: DiverTracker(DiverConfig(**stated))
    for name, values in SINGLE.items():
        yield name, lambda values=values: ours(values)
    if kind == 'fixes':
        yield 'FilterPy, CV Kalman', lambda: Peer(stated.get('covariance_scale', 1.0))
    if kind in ('radar', 'lidar'):
        yield 'plain CV Kalman', lambda: PlainKalman(0.3, stated['fix_std'], 3, 5)


def raw(items: Sequence[Any], stated: dict[str, Any]) -> list[Estimate]:
    """Each fix, or what each ping gives by itself, as an estimate of its own; of scans each fix as
    a track that was never seen before."""
    if not isinstance(items[0], Fixes):
        return raw_fixes(list(items), DiverConfig(**stated))
    R, out, number = stated['fix_std'] ** 2 * np.eye(2), [], 0
    for scan in items:
        count = len(scan)
        extras = {'track_id': number + np.arange(count), 'track_state': np.ones(count, int)}
        number += count
        out.append(
            Estimate(
                stamp_ns=scan.stamp_ns,
                frame_id='map',
                xyz=np.zeros((count, 3), np.float32),
                state_names=('px', 'py'),
                state=np.reshape(scan.position[:, :2], (-1, 2)),
                covariance=np.tile(R, (count, 1, 1)),
                extras=extras,
            )
        )
    return out


def main(recordings: Sequence[str] = tuple(RECORDINGS)) -> Parts:
    if not DATA.is_dir():
        raise SystemExit(f'no recordings at {DATA}: set SONAR_IMM_DATA')
    for name in recordings:
        kind, stated = RECORDINGS[name]
        items, truth = load(kind)
        tag = kind in ('fixes', 'arrivals')
        if kind == 'arrivals':
            # Of a tag two arrivals give a hyperbola, and one nothing.
            shown = {item.stamp_ns for item in items if len(item) >= 3}
        else:
            shown = {item.stamp_ns for item in items}
        yield {'table': {name: {'raw': scores(raw(items, stated), truth, tag)}}}
        for label, make in trackers(kind, stated):
            final = final_estimates(make(), items)
            kept = [final[stamp] for stamp in sorted(final) if stamp in shown]
            yield {'table': {name: {label: scores(kept, truth, tag)}}}


if __name__ == '__main__':
    study(main, recordings={'choices': list(RECORDINGS)})
