# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Boats in clutter (Autoferry scenario 13): trackers tuned on one half and scored on the other.

    SONAR_IMM_DATA=../shared/data python -m benchmarks.real_boats

Radar and lidar by themselves, two boats with GNSS. Each tracker has the same number of settings,
and the one with the best GOSPA in the first half of the recording is scored in the second, and the
other way round. `PlainKalman` is what one writes in an afternoon: it shows what the rest is worth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.recordings import autoferry, BOATS, DATA, HEADINGS, scores
from benchmarks.study import final_estimates, mean_of, Parts, study
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

STDS, LIVES = (2.0, 3.0, 4.0, 6.0), ((3, 5), (4, 6))
RECORDINGS = {
    'radar': ('radar', 0.0),
    'radar, stamps -1.5 s': ('radar', -1.5),
    'lidar': ('lidar', 0.0),
}
"""Each with its sensor and the seconds that are added to its stamps: those of the radar are known
to be about one scan late."""
HALVES = ('GOSPA first half', 'GOSPA second half')


def predicted(
    x: np.ndarray, P: np.ndarray, dt: float, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """State (4,) and covariance of a constant velocity after dt seconds."""
    F = np.eye(4) + dt * np.eye(4, k=2)
    Q = noise**2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    return F @ x, F @ P @ F.T + Q


def updated(
    x: np.ndarray, P: np.ndarray, z: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same after a position z (2,) with the covariance R (2, 2)."""
    K = P[:, :2] @ np.linalg.inv(P[:2, :2] + R)
    return x + K @ (z - x[:2]), P - K @ P[:2]


class PlainKalman:
    """A constant-velocity Kalman filter a track, global nearest neighbours, M of N hits."""

    def __init__(self, noise: float, std: float, hits: int, window: int):
        self.noise, self.R, self.hits, self.window = noise, std**2 * np.eye(2), hits, window
        self.tracks: list[dict[str, Any]] = []
        self.stamp_ns, self.number = 0, 0

    def process(self, scan: Fixes) -> list[Estimate]:
        dt = (scan.stamp_ns - self.stamp_ns) * 1e-9 if self.stamp_ns else 0.0
        self.stamp_ns = scan.stamp_ns
        z = scan.position[:, :2]
        cost = np.full((len(self.tracks), len(z)), 1e3)
        for t, track in enumerate(self.tracks):
            track['x'], track['P'] = predicted(track['x'], track['P'], dt, self.noise)
            v = z - track['x'][:2]
            S = track['P'][:2, :2] + self.R
            nis = np.einsum('da,ab,db->d', v, np.linalg.inv(S), v)
            cost[t] = np.where(nis < 13.8, nis + np.log(np.linalg.det(S)), 1e3)
        pairs = {t: d for t, d in zip(*linear_sum_assignment(cost)) if cost[t, d] < 1e3}
        for t, track in enumerate(self.tracks):
            track['seen'] = [*track['seen'][1 - self.window :], t in pairs]
            if t in pairs:
                track['x'], track['P'] = updated(track['x'], track['P'], z[pairs[t]], self.R)
            track['firm'] = track['firm'] or sum(track['seen']) >= self.hits
        for d in set(range(len(z))) - set(pairs.values()):
            self.number += 1
            x, P = np.append(z[d], [0.0, 0.0]), np.diag([*np.diag(self.R), 4.0, 4.0])
            self.tracks.append({'x': x, 'P': P, 'seen': [True], 'firm': False, 'id': self.number})
        self.tracks = [track for track in self.tracks if self._lives(track)]
        return [self._estimate(scan.stamp_ns)]

    def _lives(self, track: dict[str, Any]) -> bool:
        if track['firm']:
            return len(track['seen']) < 5 or any(track['seen'][-5:])
        return len(track['seen']) - sum(track['seen']) <= self.window - self.hits

    def _estimate(self, stamp_ns: int) -> Estimate:
        n = len(self.tracks)
        state = np.reshape([track['x'] for track in self.tracks], (n, 4))
        extras = {
            'track_id': np.array([track['id'] for track in self.tracks], int),
            'track_state': np.array([track['firm'] for track in self.tracks], int),
        }
        return Estimate(
            stamp_ns=stamp_ns,
            frame_id='map',
            xyz=np.zeros((n, 3), np.float32),
            state_names=('px', 'py', 'vx', 'vy'),
            state=state,
            covariance=np.reshape([track['P'] for track in self.tracks], (n, 4, 4)),
            extras=extras,
        )


Make = Callable[[float, float, tuple[int, int]], Any]


def ours(**values: Any) -> Make:
    """A tracker of this package; the noise that is tuned is that of its motion, which the families
    find themselves."""

    def make(noise: float, std: float, life: tuple[int, int]) -> DiverTracker:
        motions: dict[str, dict[str, Any]] = {
            'bench_cv': {'acceleration_noise': (noise,)},
            'heading_speed': {'speed_noise': noise},
            'families': {},
        }
        settings: dict[str, Any] = {
            **motions[values['model_set']],
            'fix_std': std,
            'confirm_hits': life[0],
            'confirm_window': life[1],
        }
        return DiverTracker(DiverConfig(clutter_density=1e-5, **{**values, **settings}))

    return make


TRACKERS: dict[str, tuple[Make, tuple[float, ...]]] = {
    'plain CV Kalman': (lambda q, s, life: PlainKalman(q, s, *life), (0.1, 0.3, 1.0)),
    'CV Kalman, gnn': (ours(model_set='bench_cv'), (0.1, 0.3, 1.0)),
    'CV Kalman, jipda': (ours(model_set='bench_cv', association='jipda'), (0.1, 0.3, 1.0)),
    'families, gnn': (ours(model_set='families', association='gnn'), (0.0,)),
    'families (default), jipda': (ours(model_set='families'), (0.0,)),
    'heading_speed, gnn': (ours(**HEADINGS, **BOATS), (0.03, 0.1, 0.3)),
    'heading_speed, jipda': (ours(**HEADINGS, **BOATS, association='jipda'), (0.03, 0.1, 0.3)),
}


def tuned(make: Make, noises: Sequence[float], items: list, truth: np.ndarray) -> dict[str, float]:
    """Scores of each half with the setting that is best in the other; all but GOSPA are means."""
    stamps = sorted(item.stamp_ns for item in items)
    middle = stamps[len(stamps) // 2]
    halves: list[list[dict[str, float]]] = [[], []]
    for setting in product(noises, STDS, LIVES):
        final = final_estimates(make(*setting), items)
        for k, part in enumerate(halves):
            part.append(scores([final[s] for s in sorted(final) if (s >= middle) == k], truth))
    best = [int(np.argmin([each['GOSPA'] for each in part])) for part in halves]
    scored = [halves[0][best[1]], halves[1][best[0]]]
    means = mean_of(scored)
    return {
        **{name: each['GOSPA'] for name, each in zip(HALVES, scored)},
        **{name: means[name] for name in ('missed', 'false')},
        'tracks': means['ids'],
        'RMSE': means['RMSE'],
    }


def main(recordings: Sequence[str] = tuple(RECORDINGS)) -> Parts:
    if not (DATA / 'autoferry').is_dir():
        raise SystemExit(f'no recordings at {DATA}: set SONAR_IMM_DATA')
    for name in recordings:
        sensor, offset = RECORDINGS[name]
        items, truth = autoferry(sensor, round(offset * 1e9))
        for label, (make, noises) in TRACKERS.items():
            yield {'table': {name: {label: tuned(make, noises, items, truth)}}}


if __name__ == '__main__':
    study(main, recordings={'choices': list(RECORDINGS)})
