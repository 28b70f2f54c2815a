# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Every real recording of divers and boats: the default, single families, a constant velocity, and
a peer; and obstacles on the real motion of a vehicle.

    export SONAR_IMM_DATA=../shared/data
    python -m benchmarks.recordings --out docs/results/recordings.json

A towed acoustic tag (yaps): truth is a hand-held GPS, itself good to a few metres and ahead of the
tag; errors are against GPS 3.4 s later. Boats (Autoferry scenario 13), not divers: a record of
``scenario13_detections.json`` is one scan of one sensor: ``measurement`` is 2 x M, north then east
relative to the own ship (a flat pair for M = 1, empty for none), and ``ownshipPosition`` is north
and east of the own ship. Every record is a scan of fixes, also one without detections: that
nothing was seen is evidence too. Infrared and camera (bearings only) are left out.

`table`: boats count with GNSS within 20 m of a track; `seen` is the share of what there was to see
that has a confirmed track, `ids` counts their identities. Of raw arrivals it holds pings of three
or more. `thinned` is the RMSE with fewer receivers, chosen in eight ways.

`tuned`: radar and lidar, each tracker with the setting that has the best GOSPA in the other half.
`PlainKalman` is what one writes in an afternoon: it shows what the rest is worth.

`motion`: see `real_navigation`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
import json
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks import real_navigation
from benchmarks.study import DATA, final_estimates, mean_of, Parts, study
from msg_adapters.estimates import read_estimate
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Arrivals, Fix, Fixes, Rejection
from sonar_imm.trackers.diver.births import locate_fix
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.recordings.convert import convert_arrivals, convert_fixes
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader

SENSORS = {'lidar': 1, 'radar': 2}


def autoferry(sensor: str, time_offset_ns: int = 0) -> tuple[list[Fixes], NDArray[np.float64]]:
    """The scans of radar or lidar in scenario 13 by time, and the truth: rows (stamp s, id, x, y),
    east and north in m. time_offset_ns: added to the stamps of the scans."""
    detections, truth = (
        json.loads((DATA / f'autoferry/scenario13_{name}.json').read_text(encoding='utf-8'))
        for name in ('detections', 'groundTruth')
    )
    return scans_of(detections, sensor, time_offset_ns), truth_of(truth)


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

HEADINGS: dict[str, Any] = {'model_set': 'heading_speed'}
PACE: dict[str, Any] = {**HEADINGS, 'speed_noise': 0.07}
"""A swimmer whose speed, spread by `speed_std` = .4 m/s, is another one after a minute: a random
walk of sqrt(2 / 60 s) .4 m/s over a second, as that of a process that forgets within a minute."""
COLUMNS = ('tx_id', 'rx_id', 'tx', 'rx', 'toa', 'var_toa', 'bearing', 'var_bearing')


def estimate_of(
    stamp_ns: int,
    names: tuple[str, ...],
    state: Any,
    covariance: Any,
    ids: Sequence[int] | np.ndarray,
    firm: Sequence[bool] | np.ndarray,
) -> Estimate:
    """The estimate of tracks with states (n, m), covariances (n, m, m), IDs (n,), and whether they
    are confirmed (n,)."""
    n, m = len(ids), len(names)
    return Estimate(
        stamp_ns=stamp_ns,
        frame_id='map',
        xyz=np.zeros((n, 3), np.float32),
        state_names=names,
        state=np.reshape(state, (n, m)),
        covariance=np.reshape(covariance, (n, m, m)),
        extras={'track_id': np.array(ids, int), 'track_state': np.array(firm, int)},
    )


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
        ids = number + np.arange(len(places))
        number += len(places)
        out.append(estimate_of(item.stamp_ns, ('px', 'py'), places, R, ids, np.ones(len(ids))))
    return out


def thinned(items: list, receivers: int, seed: int) -> list:
    """Fewer receivers per ping."""
    rng = np.random.default_rng(seed)
    out = []
    for ping in items:
        rows = np.sort(rng.permutation(len(ping))[:receivers])
        if len(rows) > 1:
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


# -- tables

WAYS, RECEIVERS = 8, (5, 4, 3)
SINGLE: dict[str, dict[str, Any]] = {
    'CV Kalman': {'model_set': 'bench_cv', 'acceleration_noise': (0.1,)},
    'steady alone (heading_speed)': HEADINGS,
    'brisk alone': PACE,
}
RECORDINGS: dict[str, tuple[str, dict[str, Any]]] = {
    'tow tag, fixes': ('fixes', TAG),
    'tow tag, fixes, covariances times 6': ('fixes', {**TAG, 'covariance_scale': 6.0}),
    'tow tag, arrivals': ('arrivals', TAG),
    **{f'tow tag, {n} receivers a ping': (f'arrivals {n}', TAG) for n in RECEIVERS},
    'boats, radar, stamps -1.5 s': ('radar', {'fix_std': 4.0}),
    'boats, lidar': ('lidar', {'fix_std': 2.0}),
}
"""What each holds, and what is told of it."""


def load(kind: str) -> tuple[list[Any], NDArray[np.float64]]:
    """Measurements and truth, rows (stamp s, id, x, y), of a recording."""
    kind, _, receivers_a_ping = kind.partition(' ')
    if kind in SENSORS:
        return autoferry(kind, round(-1.5e9) if kind == 'radar' else 0)
    folder = DATA / 'yaps_ssu1'
    with tempfile.TemporaryDirectory() as scratch:
        bag, truth = Path(scratch) / kind, folder / 'gps_truth.csv'
        if kind == 'fixes':
            convert_fixes(folder / 'fixes.csv', bag, truth=truth)
        else:
            receivers = folder / 'receivers.csv'
            convert_arrivals(folder / 'arrivals.csv', bag, receivers=receivers, truth=truth)
        with BagReader(bag) as reader:
            found = [item.measurement for item in measurements_of(reader, 'diver')]
        with BagReader(bag) as reader:
            tables = [read_estimate(i.message) for i in reader.messages(['/truth/estimate'])]
    items = [each for each in found if not isinstance(each, Rejection)]
    places = [
        (table.stamp_ns * 1e-9, int(i), x, y)
        for table in tables
        for i, x, y in zip(*(table.extras[name] for name in ('track_id', 'px', 'py')))
    ]
    many = int(receivers_a_ping or 0)
    return (thinned(items, many, 1) if many else items), np.array(places)


def trackers(kind: str, stated: dict[str, Any]) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Each tracker of a recording by its name."""
    clutter = {'clutter_density': 1e-5} if kind in SENSORS else {}

    def ours(values: dict[str, Any]) -> DiverTracker:
        return DiverTracker(DiverConfig(**{**stated, **clutter, **values}))

    yield 'default', lambda: DiverTracker(DiverConfig(**stated))
    for name, values in SINGLE.items():
        yield name, partial(ours, values)
    if kind in SENSORS:
        yield 'plain CV Kalman', lambda: PlainKalman(0.3, stated['fix_std'], 3, 5)


def of_recording(name: str) -> Iterator[tuple[str, dict[str, float]]]:
    """The rows of a recording's table, each with its name."""
    kind, stated = RECORDINGS[name]
    items, truth = load(kind)
    tag, arrivals = kind not in SENSORS, kind.startswith('arrivals')
    # Of a tag two arrivals give a hyperbola, and a single arrival nothing.
    shown = {item.stamp_ns for item in items if not arrivals or len(item) >= 3}
    yield 'raw', scores(raw(items, DiverConfig(**stated)), truth, tag)
    for label, make in trackers(kind, stated):
        final = final_estimates(make(), items)
        kept = [final[stamp] for stamp in sorted(final) if stamp in shown]
        yield label, scores(kept, truth, tag)
        if arrivals and label == 'default' and len(shown) < len(items):
            every = [final[stamp] for stamp in sorted(final)]
            yield 'default, all pings', scores(every, truth, tag)
    if tag:
        smoother = SmoothingDiverTracker(DiverConfig(**{**stated, **SINGLE['CV Kalman']}))
        final_estimates(smoother, items)
        smooth = [each for each in smoother.smoothed() if each.stamp_ns in shown]
        yield 'CV Kalman, smoothed', scores(smooth, truth, tag)


def in_eight_ways() -> Iterator[tuple[str, str, dict[str, float]]]:
    """RMSE with some receivers of each ping, by their number and the tracker."""
    pings, truth = load('arrivals')
    ways = {'default': {}, **SINGLE}
    for receivers in RECEIVERS:
        for name, values in ways.items():
            found = []
            for seed in range(1, WAYS + 1):
                tracker = DiverTracker(DiverConfig(**{**TAG, **values}))
                final = final_estimates(tracker, thinned(pings, receivers, seed))
                found.append(scores([final[s] for s in sorted(final)], truth, True)['RMSE'])
            row = {'mean': float(np.mean(found)), 'least': min(found), 'most': max(found)}
            yield f'{receivers} receivers a ping', name, row


# -- tuned

STDS, LIVES = (2.0, 3.0, 4.0, 6.0), ((3, 5), (4, 6))
BOATS = {
    'radar': ('radar', 0.0),
    'radar, stamps -1.5 s': ('radar', -1.5),
    'lidar': ('lidar', 0.0),
}
"""Each with its sensor and the seconds that are added to its stamps: those of the radar are known
to be about one scan late."""
HALVES = ('GOSPA first half', 'GOSPA second half')


class PlainKalman:
    """A constant-velocity Kalman filter a track, global nearest neighbours, M of N hits."""

    def __init__(self, noise: float, std: float, hits: int, window: int):
        self.noise, self.R, self.hits, self.window = noise, std**2 * np.eye(2), hits, window
        self.tracks: list[dict[str, Any]] = []
        self.stamp_ns, self.number = 0, 0

    def process(self, scan: Fixes) -> list[Estimate]:
        dt = (scan.stamp_ns - self.stamp_ns) * 1e-9 if self.stamp_ns else 0.0
        self.stamp_ns = scan.stamp_ns
        F = np.eye(4) + dt * np.eye(4, k=2)
        steps = [[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]
        Q = self.noise**2 * np.kron(steps, np.eye(2))
        z = scan.position[:, :2]
        cost = np.full((len(self.tracks), len(z)), 1e3)
        for t, track in enumerate(self.tracks):
            track['x'], track['P'] = F @ track['x'], F @ track['P'] @ F.T + Q
            v = z - track['x'][:2]
            S = track['P'][:2, :2] + self.R
            nis = np.einsum('da,ab,db->d', v, np.linalg.inv(S), v)
            cost[t] = np.where(nis < 13.8, nis + np.log(np.linalg.det(S)), 1e3)
        pairs = {t: d for t, d in zip(*linear_sum_assignment(cost)) if cost[t, d] < 1e3}
        for t, track in enumerate(self.tracks):
            track['seen'] = [*track['seen'][1 - self.window :], t in pairs]
            if t in pairs:
                x, P = track['x'], track['P']
                K = P[:, :2] @ np.linalg.inv(P[:2, :2] + self.R)
                track['x'], track['P'] = x + K @ (z[pairs[t]] - x[:2]), P - K @ P[:2]
            track['firm'] = track['firm'] or sum(track['seen']) >= self.hits
        for d in set(range(len(z))) - set(pairs.values()):
            self.number += 1
            x, P = np.append(z[d], [0.0, 0.0]), np.diag([*np.diag(self.R), 4.0, 4.0])
            self.tracks.append({'x': x, 'P': P, 'seen': [True], 'firm': False, 'id': self.number})
        self.tracks = [track for track in self.tracks if self._lives(track)]
        names, keys = ('px', 'py', 'vx', 'vy'), ('x', 'P', 'id', 'firm')
        columns = [[track[key] for track in self.tracks] for key in keys]
        return [estimate_of(scan.stamp_ns, names, *columns)]

    def _lives(self, track: dict[str, Any]) -> bool:
        if track['firm']:
            return len(track['seen']) < 5 or any(track['seen'][-5:])
        return len(track['seen']) - sum(track['seen']) <= self.window - self.hits


PACES: dict[str, Any] = {'speed_mean': 2.0, 'speed_std': 1.5}
"""Of boats."""
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
    'heading_speed, gnn': (ours(**HEADINGS, **PACES), (0.03, 0.1, 0.3)),
    'heading_speed, jipda': (ours(**HEADINGS, **PACES, association='jipda'), (0.03, 0.1, 0.3)),
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


PARTS = ('table', 'thinned', 'tuned', 'motion')


def main(recordings: Sequence[str] = tuple(RECORDINGS), parts: Sequence[str] = PARTS) -> Parts:
    if not DATA.is_dir():
        raise SystemExit(f'no recordings at {DATA}: set SONAR_IMM_DATA')
    for name in recordings if 'table' in parts else ():
        for label, row in of_recording(name):
            yield {'table': {name: {label: row}}}
    for thinning, label, row in in_eight_ways() if 'thinned' in parts else ():
        yield {'thinned': {thinning: {label: row}}}
    for name, (sensor, offset) in BOATS.items() if 'tuned' in parts else ():
        items, truth = autoferry(sensor, round(offset * 1e9))
        for label, (make, noises) in TRACKERS.items():
            yield {'tuned': {name: {label: tuned(make, noises, items, truth)}}}
    if 'motion' in parts:
        yield {'motion': real_navigation.rows()}


if __name__ == '__main__':
    study(main, recordings={'choices': list(RECORDINGS)}, parts={'choices': PARTS})
