# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer at sea: pressure against cross-spectra of the same model, run by run.

    python -m benchmarks.fathometer_sea --out docs/results/fathometer_sea.json

The scene: 16 hydrophones 0.25 m apart, 100 Hz to 2800 Hz, at 30 m and half a metre about it, told
to 0.03 m; layers of amplitude 0.35, 0.25 and 0.2 at 52 m, 58.5 m and 66 m that walk by 0.05 m from
record to record; ships and noise of the hydrophones. Pressure is drawn from the cross-spectral
model over each whole record, in whole numbers of 2.5 steps to a standard deviation where it says
so; cross-spectra are drawn from the same model frequency by frequency, of as many snapshots as fit
into the record side by side, which gives a response of the same noise. Every row has the same
floors. Rows are written as runs end. P is the share
of records whose number of reflectors is right, OSPA of second order with a cutoff of 2 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.fathometer_paper import score
from benchmarks.study import Parts, standard_error, study
from sonar_imm.trackers.fathometer.pressure import automatic_snapshot
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import Drift, FathometerScenario
from sonar_imm_tools.simulation.fathometer.simulator import (
    cross_spectra,
    pressure_blocks,
    scenario,
)

LAYERS, AMPLITUDES = np.array([52.0, 58.5, 66.0]), np.array([0.35, 0.25, 0.2])
SETTLED = 4
"""Records after which a run is scored once more."""
MIRROR: dict[str, Any] = {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}
LONG: dict[str, Any] = {'record_seconds': 20.0, 'records': 20}
FEW: dict[str, Any] = {'snapshot_seconds': 1.4, **MIRROR}
ROWS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    '8 s, pressure': ('pressure', {}, {}),
    '8 s, pressure, pulse of the band': ('pressure', {}, {'pulse': 'band'}),
    '8 s, pressure, snapshots of 1.4 s': ('pressure', {}, FEW),
    '8 s, pressure, snapshots of 1.4 s, pulse of the band': (
        'pressure',
        {},
        {'pulse': 'band', **FEW},
    ),
    '8 s, pressure, int8': ('pressure', {'steps_per_sigma': 2.5}, {}),
    '8 s, cross-spectra': ('csdm', {}, MIRROR),
    '20 s, pressure': ('pressure', LONG, {}),
    '20 s, pressure, pulse of the band': ('pressure', LONG, {'pulse': 'band'}),
    '20 s, pressure, conventional': ('pressure', LONG, {'processor': 'conventional'}),
    '20 s, cross-spectra': ('csdm', LONG, MIRROR),
}
"""Name: level, what differs of the scene, what differs of the tracker."""


def floor_of(config: FathometerScenario, seed: int) -> Drift:
    rng = np.random.default_rng([seed, 0])
    T = config.records
    depth = LAYERS + np.cumsum(0.05 * rng.standard_normal((T, 3)), axis=0)
    array = config.array_depth + rng.uniform(-0.5, 0.5, T)
    stated = array + config.array_depth_std * rng.standard_normal(T)
    amplitude = np.tile(AMPLITUDES, (T, 1))
    return Drift(depth, amplitude, amplitude > 0.0, array, stated)


def run(
    level: str, scene: dict[str, Any], options: Sequence[dict[str, Any]], seed: int
) -> list[dict[str, Any]]:
    """One run with each of `options`, which see the same noise; numbers of each record."""
    config = scenario('pressure', {'level': level, 'steps_per_sigma': 0.0, **scene})
    floor, rng = floor_of(config, seed), np.random.default_rng([seed, 1])
    stated = {k: v for k, v in config.instruments().items() if k not in ('window', 'overlap')}
    stated |= {'depth_min': config.depth_min, 'depth_max': config.depth_max}
    stated.pop('snapshot_seconds', None)
    settings = [FathometerConfig(**{**stated, **each}, seed=seed) for each in options]
    if level == 'csdm':
        reach = config.depth_max - config.array_depth
        seconds = automatic_snapshot(settings[0], config.phones, reach)
        count = round(config.record_seconds / seconds)
        config = evolve(config, snapshot_seconds=seconds, snapshots=count)
        # Drawn frequency by frequency, their noise does not fade.
        settings = [evolve(each, window='rectangular', overlap=0.0) for each in settings]
    trackers = [FathometerTracker(each) for each in settings]
    found: list[dict[str, Any]] = [{'right': [], 'ospa': []} for _ in options]
    for record in range(config.records):
        depth = float(floor.array_depth_stated[record])
        if level == 'csdm':
            measured: list[Any] = [cross_spectra(config, floor, record, depth, rng)]
        else:
            measured = pressure_blocks(config, floor, record, depth, rng)
        for tracker, rows in zip(trackers, found):
            for estimate in (each for item in measured for each in tracker.process(item)):
                right, distance = score(estimate, floor.depth[record])
                rows['right'].append(right)
                rows['ospa'].append(distance)
    return found


def row_of(runs: list[dict[str, Any]]) -> dict[str, float]:
    def mean(name: str, first: int) -> tuple[float, float]:
        each = [float(np.mean(found[name][first:])) for found in runs]
        return float(np.mean(each)), standard_error(each)

    row: dict[str, float] = {}
    for first, label in ((0, ''), (SETTLED, f' from record {SETTLED}')):
        for name, title in (('right', 'P'), ('ospa', 'OSPA')):
            value, error = mean(name, first)
            row[f'{title}{label}'] = value
            row[f'{title}{label}, s.e.'] = error
    return row


def main(runs: int = 20, particles: int = 5000, rows: Sequence[str] = ()) -> Parts:
    yield {'particles': particles}
    wanted = [name for name in ROWS if not rows or any(word in name for word in rows)]
    # Rows of one level and scene see the same noise, which is drawn once.
    for (level, scene), group in groupby(wanted, key=lambda name: ROWS[name][:2]):
        names = list(group)
        options = [{'particles': particles, **ROWS[name][2]} for name in names]
        found: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
        for seed in range(runs):
            for name, each in zip(names, run(level, scene, options, seed)):
                found[name].append(each)
                yield {'table': {name: {'runs': seed + 1, **row_of(found[name])}}}


if __name__ == '__main__':
    study(main, rows={'help': 'only rows with one of these words in the name'})
