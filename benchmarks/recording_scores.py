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
    PACE,
    raw,
    scores,
    TAG,
    thinned,
)
from benchmarks.recordings import load as load_bag
from benchmarks.study import final_estimates, Parts, study
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.recordings.convert import convert_arrivals, convert_fixes

NOISE = 0.1
BOATS = ('radar', 'lidar')
WAYS, RECEIVERS = 8, (5, 4, 3)
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


def of_recording(name: str) -> Iterator[tuple[str, dict[str, float]]]:
    """The rows of a recording's table, each with its name."""
    kind, stated = RECORDINGS[name]
    items, truth = load(kind)
    tag, arrivals = kind not in BOATS, kind.startswith('arrivals')
    # Of a tag two arrivals give a hyperbola, and a single arrival nothing.
    shown = {item.stamp_ns for item in items if not arrivals or len(item) >= 3}
    yield 'raw', scores(raw(items, DiverConfig(**stated)), truth, tag)
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
