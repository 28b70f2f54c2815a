# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every real recording of divers and boats in one table each: the default, two of its families
alone, a constant velocity, and a peer.

    export SONAR_IMM_DATA=../shared/data
    python -m benchmarks.recording_scores --no-thinning --out docs/results/recording_scores.json
    python -m benchmarks.recording_scores --recordings --out docs/results/recording_thinned.json

The peer, `plain CV Kalman`, is that of `real_boats`. Tags are compared with GPS 3.4 s later, boats
with GNSS within 20 m of a track; `seen` is the share of what there was to see that has a confirmed
track, `ids` counts their identities. Of raw arrivals the tables hold pings of three or more.
`thinned` is the RMSE with fewer receivers, chosen in eight ways.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from benchmarks.real_boats import PlainKalman
from benchmarks.recordings import (
    autoferry,
    DATA,
    HEADINGS,
    LAG,
    PACE,
    raw_fixes,
    TAG,
    tag_scores,
    thinned,
)
from benchmarks.recordings import load as load_bag
from benchmarks.study import final_estimates, Parts, study
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.recordings.convert import convert_arrivals, convert_fixes

NOISE = 0.1
BOATS = ('radar', 'lidar')
WAYS, RECEIVERS = 8, (5, 4, 3)
CUTOFF, NINETY_FIVE, LONGEST_GAP = 20.0, 5.991, 60.0
SINGLE: dict[str, dict[str, Any]] = {
    'CV Kalman': {'model_set': 'bench_cv', 'acceleration_noise': (NOISE,)},
    'steady alone (heading_speed)': HEADINGS,
    'brisk alone': PACE,
}
THINNED = ('CV Kalman', 'steady alone (heading_speed)', 'brisk alone')
RECORDINGS: dict[str, tuple[str, dict[str, Any]]] = {
    'tow tag, fixes': ('fixes', TAG),
    'tow tag, fixes, covariances times 6': ('fixes', {**TAG, 'covariance_scale': 6.0}),
    'tow tag, arrivals': ('arrivals', TAG),
    **{f'tow tag, {n} receivers a ping': (f'arrivals {n}', TAG) for n in RECEIVERS},
    'boats, radar, stamps -1.5 s': ('radar', {'fix_std': 4.0}),
    'boats, lidar': ('lidar', {'fix_std': 2.0}),
}
"""What each holds, and what is told of it."""


def load(kind: str) -> tuple[list[Any], np.ndarray]:
    """Measurements and truth, rows (stamp s, id, x, y), of a recording."""
    kind, _, receivers_a_ping = kind.partition(' ')
    if kind in BOATS:
        return autoferry(kind, round(-1.5e9) if kind == 'radar' else 0)
    folder = DATA / 'yaps_ssu1'
    with tempfile.TemporaryDirectory() as scratch:
        out, truth = Path(scratch) / kind, folder / 'gps_truth.csv'
        if kind == 'fixes':
            convert_fixes(folder / 'fixes.csv', out, truth=truth)
        else:
            receivers = folder / 'receivers.csv'
            convert_arrivals(folder / 'arrivals.csv', out, receivers=receivers, truth=truth)
        items, places = load_bag(out)
    return (thinned(items, int(receivers_a_ping), 1.0) if receivers_a_ping else items), places


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
    squared: list[float] = []
    normalised: list[float] = []
    ids: set[int] = set()
    there, distance = 0, []
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
    if not tag:
        return {**out, 'GOSPA': float(np.mean(distance))}
    return {
        **out,
        'RMSE, no lag': tag_scores(list(estimates), truth)[0],
        'median': float(np.median(np.sqrt(squared))),
    }


def trackers(kind: str, stated: dict[str, Any]) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Each tracker of a recording by its name."""
    clutter = {'clutter_density': 1e-5} if kind in BOATS else {}

    def ours(values: dict[str, Any]) -> DiverTracker:
        return DiverTracker(DiverConfig(**{**stated, **clutter, **values}))

    yield 'default', lambda: DiverTracker(DiverConfig(**stated))
    for name, values in SINGLE.items():
        yield name, partial(ours, values)
    if kind in BOATS:
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


def of_recording(name: str) -> Iterator[tuple[str, dict[str, float]]]:
    """The rows of a recording's table, each with its name."""
    kind, stated = RECORDINGS[name]
    items, truth = load(kind)
    tag, arrivals = kind not in BOATS, kind.startswith('arrivals')
    # Of a tag two arrivals give a hyperbola, and a single arrival nothing.
    shown = {item.stamp_ns for item in items if not arrivals or len(item) >= 3}
    yield 'raw', scores(raw(items, stated), truth, tag)
    for label, make in trackers(kind, stated):
        final = final_estimates(make(), items)
        kept = [final[stamp] for stamp in sorted(final) if stamp in shown]
        yield label, scores(kept, truth, tag)
        if arrivals and label == 'default' and len(shown) < len(items):
            yield (
                'default, all pings',
                scores([final[stamp] for stamp in sorted(final)], truth, tag),
            )
    if tag:
        smoother = SmoothingDiverTracker(DiverConfig(**{**stated, **SINGLE['CV Kalman']}))
        final_estimates(smoother, items)
        smooth = [each for each in smoother.smoothed() if each.stamp_ns in shown]
        yield 'CV Kalman, smoothed', scores(smooth, truth, tag)


def in_eight_ways() -> Iterator[tuple[str, str, dict[str, float]]]:
    """RMSE with some receivers of each ping, by their number and the tracker."""
    pings, truth = load('arrivals')
    ways = {'default': {}, **{name: SINGLE[name] for name in THINNED}}
    for receivers in RECEIVERS:
        for name, values in ways.items():
            found = []
            for seed in range(1, WAYS + 1):
                tracker = DiverTracker(DiverConfig(**{**TAG, **values}))
                final = final_estimates(tracker, thinned(pings, receivers, 1.0, seed))
                found.append(scores([final[s] for s in sorted(final)], truth, True)['RMSE'])
            row = {'mean': float(np.mean(found)), 'least': min(found), 'most': max(found)}
            yield f'{receivers} receivers a ping', name, row


def main(recordings: Sequence[str] = tuple(RECORDINGS), no_thinning: bool = False) -> Parts:
    if not DATA.is_dir():
        raise SystemExit(f'no recordings at {DATA}: set SONAR_IMM_DATA')
    for name in recordings:
        for label, row in of_recording(name):
            yield {'table': {name: {label: row}}}
    if not no_thinning:
        for thinning, label, row in in_eight_ways():
            yield {'thinned': {thinning: {label: row}}}


if __name__ == '__main__':
    study(main, recordings={'choices': list(RECORDINGS)})
