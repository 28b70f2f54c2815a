# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which pulse: that of the band, or what the processor makes of each record.

    python -m benchmarks.fathometer_pulse --out docs/results/fathometer_pulse.json

Scenes as cross-spectra, tracked with either pulse and either polarity. ``drift``: the drift of
the paper, 32 hydrophones, seven to nine layers, MVDR (a quarter of the snapshot with four times as
many, which says as much and is made four times as fast). ``strong`` and ``signed``: 16 hydrophones
(as in `fathometer_sea`), 100 snapshots, six layers of 7 to 34 sigma, in ``signed`` two of them
negative; ``strong 32`` and ``signed 32`` under the array of the drift; a tenth as many records for
each run. What is in the file already is kept. P is the share of records whose number of
reflectors is right; OSPA of second order with a cutoff of 2 m; wrong signs per record. The first
five records are not scored.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import fathometer_paper
from benchmarks.study import known, mean_of, Parts, rms, standard_error, study
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import CrossSpectra
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import Drift, drift_of
from sonar_imm_tools.simulation.fathometer.simulator import (
    cross_spectra,
    FathometerScenario,
    scenario,
)

DEPTHS = np.array([52.0, 55.2, 58.5, 61.7, 66.0, 69.3])
STRENGTHS = np.array([0.35, 0.3, 0.25, 0.22, 0.2, 0.15])
SIGNS = {'strong': np.ones(6), 'signed': np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0])}
SCENES = {'strong': 16, 'signed': 16, 'strong 32': 32, 'signed 32': 32, 'drift': 32}
"""Hydrophones of each."""
UNSCORED = 5


def records_of(
    config: FathometerScenario, floor: Drift, rng: np.random.Generator
) -> Iterator[tuple[CrossSpectra, np.ndarray, np.ndarray]]:
    """Cross-spectra, true depths and true amplitudes of each record."""
    for record in range(config.records):
        depth = float(floor.array_depth_stated[record])
        here = floor.present[record]
        spectra = cross_spectra(config, floor, record, depth, rng)
        yield spectra, floor.depth[record, here], floor.amplitude[record, here]


def drift(seed: int, records: int) -> tuple[FathometerScenario, Drift, np.random.Generator]:
    scale = records / 300
    config = FathometerScenario(
        records=records,
        snapshot_seconds=0.35,
        snapshots=256,
        appearing=(int(140 * scale), int(262 * scale)),
        fading=(int(85 * scale),),
    )
    rng = np.random.default_rng(seed)
    return config, drift_of(config, rng), rng


def layers(
    seed: int, records: int, signs: np.ndarray, hydrophones: int = 16
) -> tuple[FathometerScenario, Drift, np.random.Generator]:
    """The six layers under 16 hydrophones, or 80 m deeper and weaker under the 32 of the drift."""
    changes: dict[str, Any] = {
        'level': 'csdm',
        'records': records,
        'snapshots': 100,
        'snapshot_seconds': 0.35,
    }
    config, first, strength = scenario('pressure', changes), DEPTHS, STRENGTHS
    if hydrophones == 32:
        config = FathometerScenario(**{**changes, 'snapshots': 256})
        first, strength = DEPTHS + 80.0, 0.4 * STRENGTHS
    rng = np.random.default_rng(seed)
    depth = first + np.cumsum(0.05 * rng.standard_normal((records, 6)), axis=0)
    array = config.array_depth + rng.uniform(-0.5, 0.5, records)
    stated = array + config.array_depth_std * rng.standard_normal(records)
    amplitude = np.tile(signs * strength, (records, 1))
    return config, Drift(depth, amplitude, amplitude != 0.0, array, stated), rng


def run(
    name: str,
    seed: int,
    records: int,
    particles: int,
    pulses: Sequence[str],
    polarities: Sequence[str] = ('positive', 'both'),
) -> dict[str, dict[str, float]]:
    """Scores of each of `pulses` and `polarities`."""
    if name == 'drift':
        config, floor, rng = drift(seed, records)
    else:
        config, floor, rng = layers(seed, records, SIGNS[name.split()[0]], SCENES[name])
    settings = dict(config.instruments())
    settings |= {'window': 'rectangular', 'overlap': 0.0, 'particles': particles, 'seed': seed}
    settings |= {'depth_min': config.depth_min, 'depth_max': config.depth_max}
    settings |= {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}
    trackers = {
        f'{name}, {pulse}, {polarity}': FathometerTracker(
            FathometerConfig(**settings, pulse=pulse, polarity=polarity)
        )
        for pulse in pulses
        for polarity in polarities
    }
    scores: dict[str, list[list[float]]] = {label: [] for label in trackers}
    for spectra, depth, amplitude in records_of(config, floor, rng):
        for label, tracker in trackers.items():
            (found,) = tracker.process(spectra)
            scores[label].append(_score(found, depth, amplitude))
    names = ('P', 'OSPA', 'depth RMS', 'wrong signs')
    return {
        label: {
            key: float(
                np.sqrt(np.nanmean(np.square(column)))
                if key == 'depth RMS'
                else np.nanmean(column)
            )
            for key, column in zip(names, np.array(each[UNSCORED:]).T)
        }
        for label, each in scores.items()
    }


def _score(found: Estimate, depth: np.ndarray, amplitude: np.ndarray) -> list[float]:
    z = fathometer_paper.reflectors(found)
    away = z[:, :1] - depth
    near = np.abs(away) < 0.4
    wrong = near & (np.sign(z[:, 1:2]) != np.sign(amplitude))
    return [
        *fathometer_paper.score(found, depth),
        rms(away[near]) if near.any() else np.nan,
        float(wrong.sum()),
    ]


def main(
    runs: int = 5,
    records: int = 300,
    particles: int = 5000,
    scenes: Sequence[str] = tuple(SCENES),
    pulses: Sequence[str] = ('band', 'processor'),
    polarities: Sequence[str] = ('positive', 'both'),
    out: Path | None = None,
) -> Parts:
    yield known(out)
    yield {'records': records}
    for name in scenes:
        length = records if name == 'drift' else max(10, records // 10)
        scores: dict[str, list[dict[str, float]]] = {}
        for seed in range(runs):
            made = run(name, seed, length, particles, pulses, polarities)
            for label, row in made.items():
                each = scores.setdefault(label, [])
                each.append(row)
                error = {'P, s.e.': standard_error([row['P'] for row in each])}
                yield {'table': {label: {'runs': float(len(each))} | mean_of(each) | error}}


if __name__ == '__main__':
    study(main, scenes={'choices': list(SCENES)})
