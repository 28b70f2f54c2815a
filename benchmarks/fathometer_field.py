# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Profiler lines with a floor that is known: ghosts in the water, and whether the floor is said.

    python -m benchmarks.fathometer_floor --out docs/results/fathometer_floor.json

Lines of 120 envelopes of a Gaussian pulse of 0.15 m, 0.05 m a sample over 20 m, in complex noise
of rms 0.02 with echoes of modulus one for the floor at about 10 m and of 0.5 and 0.25 at 3 m and
6 m below it, each of a phase of its own. Nothing is told to the tracker but that it is a trace.

ghosts: reflectors a record of existence 0.5 or more that lie more than 1 m above the floor; label:
share of the records whose greatest `is_bottom` is within 0.5 m of the floor, and what it says
there; inside: share with the floor within two `bottom_depth_std` of `bottom_depth`. Records after
the tenth count. `halves`: of the lines of real data, if SONAR_IMM_DATA names them, even and odd
traces: share of the records whose floors differ by more than 0.75 m, and what is said where they
do and do not.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.study import known, Parts, study
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm.trackers.fathometer.water import Water
from sonar_imm_tools.recordings.segy_lines import read_segy

STEP, SAMPLES, RECORDS, PULSE, NOISE = 0.05, 400, 120, 0.15, 0.02
SETTLED, APART, SPACING = 10, 0.75, 0.376
LINES: dict[str, dict[str, Any]] = {
    'flat': {},
    'quiet water': {'noise': 0.002},
    'silent water': {'noise': 0.002, 'threshold': 0.02},
    'growing gain': {'gain': 0.12},
    'coarse': {'steps': 32},
    'soft floor': {'floor': 0.15},
    'scatter': {'scatter': 0.3},
    'transmit pulse': {'ring': 1.5},
    'waves': {'waves': 2.5},
    'fault': {'fault': 3.0},
    'fish': {'fish': 0.4},
    'echo at a fixed depth': {'fixed': 0.2, 'waves': 1.0},
}


def line(
    seed: int,
    *,
    records: int = RECORDS,
    noise: float = NOISE,
    threshold: float = 0.0,
    gain: float = 0.0,
    steps: int = 0,
    floor: float = 1.0,
    scatter: float = 0.0,
    ring: float = 0.0,
    waves: float = 0.0,
    fault: float = 0.0,
    fish: float = 0.0,
    fixed: float = 0.0,
) -> tuple[list[Trace], FloatArray]:
    """Traces of a line, and the depth of its floor (T,), m. threshold: below which nothing is
    written; gain: growth of all by e over so many 1/m; steps of a converter up to one; floor:
    amplitude; scatter: rms below it, falling over 1.5 m; ring: m of transmit pulse; waves:
    amplitude, m, in 25 records; fault, m, at half of the line; fish: share of the records with a
    school; fixed: amplitude of an echo at 4 m."""
    rng, depth = np.random.default_rng(seed), STEP * np.arange(SAMPLES)
    record = np.arange(records)
    below = 10.0 + 0.3 * np.sin(record / 19.0) + waves * np.sin(2.0 * np.pi * record / 25.0)
    below = below + fault * (record >= records // 2)
    traces = []

    def echo(place: float, amplitude: float, width: float = PULSE) -> FloatArray:
        phase = np.exp(2j * np.pi * rng.random())
        return amplitude * phase * np.exp(-0.5 * np.square((depth - place) / width))

    for k, z in enumerate(below):
        field = noise * _normal(rng, SAMPLES) + echo(z, floor)
        field = field + echo(z + 3.0, 0.5 * floor) + echo(z + 6.0, 0.25 * floor)
        if scatter:
            under = np.maximum(depth - z, 0.0)
            level = scatter * np.exp(-under / 1.5) * (depth > z)
            field = field + level * _normal(rng, SAMPLES)
        if rng.random() < fish:
            school = rng.uniform(3.0, 8.0)
            for place in school + 0.3 * rng.standard_normal(4):
                field = field + echo(place, rng.uniform(0.1, 0.5))
        if fixed:
            field = field + echo(4.0, fixed)
        if ring:
            field = field + 2.0 * np.exp(-np.maximum(depth - ring, 0.0) / 0.1)
        heard = np.abs(field) * np.exp(gain * depth)
        if steps:
            heard = np.round(heard * steps) / steps
        heard[heard < threshold] = 0.0
        traces.append(Trace(stamp_ns=(k + 1) * 10**9, depth=depth, amplitude=heard))
    return traces, below


def _normal(rng: np.random.Generator, count: int) -> FloatArray:
    return rng.standard_normal((count, 2)) @ np.array([1.0, 1j]) / np.sqrt(2.0)


def tracked(traces: Sequence[Trace], floor: FloatArray, particles: int) -> dict[str, float]:
    """A line with nothing told but what converters write."""
    config = FathometerConfig(
        particles=particles, min_separation=0.45, depth_std=0.35, order_max=6, sound_speed_std=0.0
    )
    tracker, rows = FathometerTracker(config), []
    for trace, z in zip(traces, floor.tolist()):
        for estimate in tracker.process(trace):
            found = estimate.columns()
            if trace.stamp_ns <= SETTLED * 10**9:
                continue
            depth, label = found['depth'], np.nan_to_num(found['is_bottom'])
            best = int(np.argmax(label))
            near = np.abs(depth - z) < 0.5
            error = found['bottom_depth'][0] - z
            rows.append(
                (
                    np.sum((found['existence'] >= 0.5) & (depth < z - 1.0)),
                    abs(depth[best] - z) < 0.5,
                    label[near].max(initial=0.0),
                    abs(error) <= 2.0 * found['bottom_depth_std'][0],
                    abs(error),
                )
            )
    ghosts, right, said, inside, error = np.array(rows, np.float64).T
    return {
        'ghosts': float(ghosts.mean()),
        'label': float(right.mean()),
        'said': float(said.mean()),
        'inside': float(inside.mean()),
        'error': float(np.nanmedian(error)),
        'warnings': float(len(tracker.warnings())),
    }


def halves(path: Path, spacing: float) -> dict[str, float]:
    """Even and odd traces of a real line, each stacked in pairs, as two lines."""
    amplitude = read_segy(path).amplitude
    depth = spacing * np.arange(amplitude.shape[1])
    floors = []
    for half in (amplitude[::2], amplitude[1::2]):
        water, found = Water(FathometerConfig()), []
        stacked = half[: len(half) // 2 * 2].reshape(-1, 2, half.shape[1]).mean(axis=1)
        for k, row in enumerate(stacked):
            trace = Trace(stamp_ns=k + 1, depth=depth, amplitude=row)
            if water.active is None:
                water.begin(trace)
            _, _, floor = water.take(trace)
            sure = floor.posterior[:-1]
            said = 0.0
            if len(sure):
                best = int(np.argmax(sure))
                said = float(sure[max(0, best - 2) : best + 3].sum())
            found.append((*floor.depth, said))
        floors.append(np.array(found))
    count = min(map(len, floors))
    (z, std, said), (other, other_std, _) = (each[SETTLED:count].T for each in floors)
    apart = np.abs(z - other)
    inside = apart <= 2.0 * np.hypot(std, other_std)
    differ = ~(apart <= APART)
    return {
        'records': float(count - SETTLED),
        'apart': float(differ.mean()),
        'inside': float(inside.mean()),
        'said where apart': float(said[differ].mean()) if differ.any() else float('nan'),
        'said where not': float(said[~differ].mean()),
    }


def real_lines() -> list[Path]:
    folder = Path(os.environ.get('SONAR_IMM_DATA', '../shared/data')) / 'sbp_chiapas'
    return sorted(folder.glob('*.seg'))


def main(
    runs: int = 2,
    particles: int = 3000,
    cases: Sequence[str] = tuple(LINES),
    out: Path | None = None,
) -> Parts:
    yield known(out)
    for path in real_lines():
        yield {'halves': {path.stem.split('_SBP_')[1][:5]: halves(path, SPACING)}}
    for case in cases:
        found = []
        for seed in range(runs):
            found.append(tracked(*line(seed, **LINES[case]), particles))
            mean = {key: float(np.mean([row[key] for row in found])) for key in found[0]}
            yield {'lines': {case: {'runs': len(found), 'particles': particles} | mean}}


if __name__ == '__main__':
    study(main, cases={'choices': list(LINES)})
