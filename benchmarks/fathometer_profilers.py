# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How well the floor is followed on envelopes of sub-bottom profilers, with the water found and
off: python -m benchmarks.fathometer_profilers [--out FILE]

Real lines (SONAR_IMM_DATA, needs segyio), converted and tracked by the command as
docs/fathometer.md says, and the simulated scene ``diffuse``. On the real lines the floor is picked
without a tracker: the first of three successive samples above an eighth of what loud traces reach,
and the greatest of the four from there on. A record is followed when a reflector lies within 1 m
of that. Beside it stand two other rules. `edge`: the first of these three samples itself, where
the echo begins. `older`: the first peak above half of the greatest of its record; below weak
floors that is another layer, so `rules_agree` says how often it picks the same as the first rule,
`older_missed_at_edge` how many of the records it calls lost have a reflector within 1 m of the
edge, and `older_lost_below_edge` in how many of them its pick lies less than 1 m below the edge,
up to 2.5 m (the same arrival, a broad one) and more (another layer). `sounder`: what the
instrument itself wrote into the headers as depth of the water, against edge and peak (median, m),
where it goes with either within 2 m; it is often wrong by far more. `at_twice_the_floor`:
reflectors within 1 m of that, of which so many are marked as multiples; `marked`: share of all
reflectors, in the scene of primaries.

Crossings are those of the default rows. L3 and L9 cross where the floor is at 4 m, above the
first sample that is taken (4.5 m), so that this crossing is made once more from the end of the
transmit pulse on (3.4 m). `between_lines` are the numbers of all horizons that were judged.

The parameters that are not measured (depth_std, the form of the likelihood) were chosen on lines
L2 and L9 and on seeds 1 and 2 of the scene; L1 and L3 had no part in that, but the rule by which
the first return keeps its name, and the chain of the water, were made with all four in view. Seeds
of the scene here begin at 11. 5,000 particles throughout.
"""

from __future__ import annotations

import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from benchmarks.study import mean_of, Parts, study
from sonar_imm.estimation.arrays import FloatArray, IntArray
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.cli import main as command
from sonar_imm_tools.evaluation.fathometer.crossing import crossing_metrics, summary
from sonar_imm_tools.evaluation.fathometer.records import records_of
from sonar_imm_tools.evaluation.fathometer.scoring import pair
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.segy_lines import read_segy
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

DATA = Path(os.environ.get('SONAR_IMM_DATA', '../shared/data')) / 'sbp_chiapas'
FILES = {
    'L1': 'MET_EW-WE_SBP_L1_WE_20180313165838.seg',
    'L2': 'MET_EW-WE_SBP_L2_EW_20180313171011.seg',
    'L3': 'MET_EW-WE_SBP_L3_WE_20180313172145.seg',
    'L9': 'MET_NS-SN_SBP_L9_SN_20180313161627.seg',
}
SPACING, FIRST, SAMPLES, STACK, NEAR, PARTICLES = 0.376, 12, 74, 4, 1.0, 5000
UNCUT = 9
"""The first sample after the transmit pulse."""
FEW = ('--set', f'particles={PARTICLES}')
WITHOUT = ('--set', 'water=off')
_RUN, _REACH, _LOUD = 3, 4, 8.0
ROWS = {
    'default': (),
    'seed 1': ('--set', 'seed=1'),
    'water off': WITHOUT,
}


def real_lines(folder: Path) -> Parts:
    """Every line under every row, and the crossings of the default row."""
    for line, name in FILES.items():
        convert(line, folder / f'{line}.bag', FIRST)
        for row, extra in ROWS.items():
            out = folder / (line if not extra else 'other')
            call('track', folder / f'{line}.bag', out, '--overwrite', *FEW, *extra)
            yield {'lines': {line: {row: followed(DATA / name, RunFolder(out))}}}
    for line in ('L3', 'L9'):
        convert(line, folder / f'{line}_uncut.bag', UNCUT)
        call('track', folder / f'{line}_uncut.bag', folder / f'{line}_uncut', *FEW)
    crossings = {}
    for a, b, cut in (('L1', 'L9', ''), ('L2', 'L9', ''), ('L3', 'L9', ''), ('L3', 'L9', 'uncut')):
        first, other = (RunFolder(folder / (f'{c}_{cut}' if cut else c)) for c in (a, b))
        name = f'{a} x {b}, {cut}' if cut else f'{a} x {b}'
        crossings[name] = crossing_metrics(first, other, 3.0)
        print(name, crossings[name], flush=True)
    horizons = [h for c in crossings.values() for at in c['crossings'] for h in at['horizons']]
    between = summary([h for h in horizons if h['judged']])
    yield {'crossings': crossings, 'between_lines': between}


def convert(line: str, bag: Path, first: int) -> None:
    call(
        *('convert', 'segy', DATA / FILES[line], bag, '--sample-spacing', SPACING),
        *('--first-sample', first, '--samples', FIRST + SAMPLES - first, '--stack', STACK),
    )


def call(*arguments: Any) -> None:
    if command([str(argument) for argument in arguments]):
        raise SystemExit('the command failed')


def followed(path: Path, run: RunFolder) -> dict[str, Any]:
    """How a tracked line goes with what is picked without a tracker."""
    raw = read_segy(path).amplitude
    count = len(raw) // STACK
    amplitude = raw[: STACK * count].reshape(count, STACK, -1).mean(axis=1)
    amplitude = amplitude[:, FIRST : FIRST + SAMPLES]
    arrival = SPACING * (FIRST + first_arrivals(amplitude))
    old = SPACING * (FIRST + np.array([_half(trace) for trace in amplitude]))
    edge = SPACING * (FIRST + arrival_edges(amplitude))
    stated = np.median(read_segy(path).water_depth[: STACK * count].reshape(count, STACK), axis=1)
    hits, by_bottom, by_old, by_edge, ids, number = [], [], [], [], set(), []
    twice: list[bool] = []
    marked: list[bool] = []
    for estimate, depth, older, first in zip(run.read_estimates(), arrival, old, edge):
        columns = estimate.columns()
        away = np.abs(np.nan_to_num(columns['depth'], nan=1e9) - depth)
        hits.append(away.min() < NEAR)
        if hits[-1]:
            ids.add(int(columns['track_id'][np.argmin(away)]))
        by_bottom.append(away[np.argmax(columns['is_bottom'])] < NEAR)
        by_edge.append((np.abs(columns['depth'] - first) < NEAR).any())
        by_old.append((np.abs(columns['depth'] - older) < NEAR).any())
        there = np.isfinite(columns['depth'])
        number.append(there.sum())
        double = 2.0 * columns['depth'][np.argmax(columns['is_bottom'])]
        twice += list(np.abs(columns['depth'][there] - double) < NEAR)
        marked += list(columns['multiple_probability'][there] > 0.5)
    lost = ~np.array(by_old)
    below = (old - edge)[lost]
    return {
        'records': count,
        'followed': share(hits),
        'followed_by_is_bottom': share(by_bottom),
        'ids_per_100': round(100.0 * len(ids) / count, 2),
        'followed_older_rule': share(by_old),
        'followed_edge': share(by_edge),
        'rules_agree': share(np.abs(arrival - old) < NEAR),
        'older_missed_at_edge': share(np.array(by_edge)[lost]) if lost.any() else None,
        'older_lost_below_edge': [int(n) for n in np.histogram(below, (-99, 1, 2.5, 99))[0]],
        'sounder': sounder(stated, edge, arrival),
        'reflectors': round(float(np.mean(number)), 2),
        'at_twice_the_floor': int(np.sum(twice)),
        'of_these_marked': int(np.sum(np.array(twice) & np.array(marked))),
        'marked': share(marked),
    }


def sounder(stated: np.ndarray, edge: np.ndarray, peak: np.ndarray) -> dict[str, float]:
    """The instrument's own depths of the bottom (T,), 0 for none, against edges and peaks."""
    good = (stated > 0.0) & ((np.abs(stated - edge) < 2.0) | (np.abs(stated - peak) < 2.0))
    return {
        'stated': share(stated > 0.0),
        'believable': share(good),
        'minus_edge_m': round(float(np.median((stated - edge)[good])), 2),
        'minus_peak_m': round(float(np.median((stated - peak)[good])), 2),
    }


def arrival_edges(amplitude: FloatArray) -> IntArray:
    """Sample at which each trace (T, n) first begins, -1 where none does: the first of three
    successive samples above an eighth of what the loud traces reach."""
    loud = float(np.quantile(amplitude.max(axis=1), 0.99)) / _LOUD
    above = amplitude > loud
    count = amplitude.shape[1] - _RUN + 1
    if count < 1:
        return np.full(len(amplitude), -1)
    run = np.logical_and.reduce([above[:, k : k + count] for k in range(_RUN)])
    return np.where(run.any(axis=1), run.argmax(axis=1), -1)


def first_arrivals(amplitude: FloatArray) -> IntArray:
    """Sample of the first arrival of each trace (T, n), -1 where there is none: the greatest of
    the four from its edge on."""
    return np.array(
        [
            -1 if i < 0 else i + int(np.argmax(trace[i : i + _REACH]))
            for i, trace in zip(arrival_edges(amplitude), amplitude)
        ]
    )


def _half(trace: np.ndarray) -> int:
    first = int(np.argmax(trace > 0.5 * trace.max()))
    return first + int(np.argmax(trace[first : first + 4]))


def share(values: Any) -> float:
    return round(float(np.mean(values)), 3)


def scene_rows(runs: int) -> dict[str, Any]:
    """The scene with the parameters it states, with the water found and off."""
    rows: dict[str, list[dict[str, float]]] = {'default': [], 'water off': []}
    for seed in range(11, 11 + runs):
        config = scenario('diffuse', {'records': 100})
        scene = simulate(config, seed)
        for row, scores in rows.items():
            values = {**config.instruments(), 'particles': PARTICLES}
            if row == 'water off':
                values['water'] = 'off'
            tracker = FathometerTracker(FathometerConfig.from_mapping(values))
            estimates = [tracker.process(item.measurement)[0] for item in scene.measurements]
            scores.append(_score(estimates, scene.truth))
    return {
        row: {name: round(mean, 3) for name, mean in mean_of(scores).items()}
        for row, scores in rows.items()
    }


def _score(estimates: Any, truth: Any) -> dict[str, float]:
    order, apart, bottom, error, inside, ids = [], [], [], [], [], set()
    marked: list[bool] = []
    for estimate, record, true in zip(estimates, records_of(estimates), truth):
        columns = estimate.columns()
        found = pair(record.found.depth, true.depth, 2.0)
        apart.append(found.ospa)
        order.append(len(record.found) == len(true.depth))
        row = int(np.argmax(columns['is_bottom']))
        bottom.append(abs(columns['depth'][row] - true.depth.min()) < NEAR)
        ids.add(int(columns['track_id'][row]))
        marked += list(columns['multiple_probability'] > 0.5)
        off = record.found.depth[found.found] - true.depth[found.true]
        error += list(off)
        inside += list(np.abs(off) <= 2.0 * record.depth_std[found.found])
    return {
        'order_right': float(np.mean(order)),
        'ospa_m': float(np.mean(apart)),
        'bottom_followed': float(np.mean(bottom)),
        'bottom_ids': float(len(ids)),
        'depth_rmse_m': float(np.sqrt(np.mean(np.square(error)))),
        'inside_2_sigma': float(np.mean(inside)),
        'marked': float(np.mean(marked)),
    }


def main(runs: int = 6) -> Parts:
    yield {'scene': {'runs': runs, **scene_rows(runs)}}
    if DATA.exists():
        with tempfile.TemporaryDirectory() as folder:
            yield from real_lines(Path(folder))
    else:
        print(f'no real lines in {DATA}')


if __name__ == '__main__':
    study(
        main,
        runs={'help': 'seeds of the scene'},
        out={'default': Path('docs/results/fathometer_profilers.json')},
    )
