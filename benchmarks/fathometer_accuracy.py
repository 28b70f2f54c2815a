# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Accuracy of the fathometer tracker on simulated drifts, beside what it replaces.

    python -m benchmarks.fathometer_accuracy --runs 3 --out docs/results/fathometer_accuracy.json
    python -m benchmarks.fathometer_accuracy --pulses --runs 5 --particles 5000 --out FILE

Each run is one drift as cross-spectra (seven to nine reflectors over 300 records under the 32
hydrophones of the paper; a quarter of the snapshot with four times as many, which says as much and
is made four times as fast), processed twice (MVDR and conventional) and tracked by every
configuration. OSPA has a cutoff of 2 m and order 2; a reflector within 0.4 m of a true one is
neither false nor missed. Birth delay: records from the presence of a new reflector to the first of
three records in a row that have it. Numbers are written after each run; other rows that are in the
file are kept.

`--pulses`: which pulse, that of the band or what the processor makes of each record, with either
polarity. ``drift``: as above. ``strong`` and ``signed``: 16 hydrophones (as in `fathometer_sea`),
100 snapshots, six layers of 7 to 34 sigma, in ``signed`` two of them negative; ``strong 32`` and
``signed 32`` under the array of the drift; a tenth as many records for each run. The first five
records are not scored; wrong signs are per record.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import fathometer_paper
from benchmarks.fathometer_paper import (
    BOOTSTRAP,
    ChangedTracker,
    ENVELOPE,
    ORDERS,
    PENALTY,
    reflectors,
)
from benchmarks.study import final_estimates, known, mean_of, Parts, rms, standard_error, study
from sonar_imm.acoustics.fathometer import coherence, depth_response, noise_sigma, steering
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import CrossSpectra, Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import Drift, drift_of
from sonar_imm_tools.simulation.fathometer.simulator import (
    cross_spectra,
    FathometerScenario,
    scenario,
)

DEPTHS = (122.0, 1 / 32, 1600)
NEAR = 0.4
CONVENTIONAL: dict[str, Any] = {'frequency_min': 200.0}
CONFIGURATIONS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    'MVDR as the paper (envelope, bootstrap), N^-m': ('envelope', ENVELOPE, PENALTY | BOOTSTRAP),
    '+ data-driven proposals': ('envelope', ENVELOPE, PENALTY),
    'MVDR real part, marginal, 1-12 (default)': ('mvdr', {}, {}),
    '  smoothed, lag 2': ('mvdr', {'smoothing_lag': 2}, {}),
    '  2,000 particles': ('mvdr', {'particles': 2000}, {}),
    'fixed order 8, bootstrap': ('mvdr', {'order_min': 8, 'order_max': 8}, BOOTSTRAP),
    'conventional real part, N^-m': ('conventional', {**ORDERS, **CONVENTIONAL}, PENALTY),
    'conventional real part, amplitude memory 0.98, 1-12': (
        'conventional',
        {'amplitude_memory': 0.98, **CONVENTIONAL},
        {},
    ),
}
"""The trace, parameters, and what of `SetModel` is changed."""


Truth = list[tuple[np.ndarray, np.ndarray]]
"""The ids and the depths of the reflectors of each record."""


def responses(spectra: CrossSpectra) -> dict[str, Trace]:
    """The record as MVDR (real part and envelope) and conventional traces."""
    depth = DEPTHS[0] + DEPTHS[1] * np.arange(DEPTHS[2])
    w = steering(spectra.frequency, 0.18 * np.arange(spectra.hydrophones), 1500.0)
    reference = spectra.reference_depth
    assert reference is not None
    spacing = float(spectra.frequency[1] - spectra.frequency[0])
    made = {}
    for name, processor, low, envelope in (
        ('mvdr', 'mvdr', 50.0, False),
        ('envelope', 'mvdr', 50.0, True),
        ('conventional', 'conventional', 200.0, False),
    ):
        band = spectra.frequency >= low
        gamma = coherence(spectra.csdm[band], w[band], processor)
        comb = float(spectra.frequency[band][0]), spacing

        noise = depth_response(gamma, *comb, (180.0, DEPTHS[1], 3840), reference, 1500.0)
        made[name] = Trace(
            stamp_ns=spectra.stamp_ns,
            depth=depth,
            amplitude=depth_response(gamma, *comb, DEPTHS, reference, 1500.0, envelope=envelope),
            sigma=np.full(DEPTHS[2], noise_sigma(noise)),
            reference_depth=reference,
        )
    return made


def drift(seed: int, records: int) -> tuple[dict[str, list[Trace]], Truth]:
    """Traces of one run by processor, and the true depths and ids of each record."""
    config, floor, rng = drift_scene(seed, records)
    traces: dict[str, list[Trace]] = {}
    truth = []
    # Cross-spectra of a whole drift would not fit into memory, nor does `check` let them.
    for record in range(records):
        spectra = cross_spectra(config, floor, record, floor.array_depth_stated[record], rng)
        for name, trace in responses(spectra).items():
            traces.setdefault(name, []).append(trace)
        here = floor.present[record]
        truth.append((np.flatnonzero(here), floor.depth[record, here]))
    return traces, truth


def score(tracker: FathometerTracker, traces: list[Trace], truth: Truth) -> dict[str, float]:
    found = final_estimates(tracker, traces)
    rows: dict[str, list[float]] = {}
    seen_by_id: dict[int, list[tuple[int, bool]]] = {}
    for k, (trace, (ids, depth)) in enumerate(zip(traces, truth)):
        estimate = found[trace.stamp_ns]
        right, apart = fathometer_paper.score(estimate, depth)
        distance = np.abs(reflectors(estimate)[:, :1] - depth)
        hit = (distance < NEAR).any(axis=0)
        values = {
            'P(order right)': right,
            'OSPA': apart,
            'false': float(np.count_nonzero(~(distance < NEAR).any(axis=1))),
            'missed': float(np.count_nonzero(~hit)),
        }
        for name, value in values.items():
            rows.setdefault(name, []).append(value)
        for number, there in zip(ids, hit):
            seen_by_id.setdefault(int(number), []).append((k, bool(there)))
    result = {name: float(np.mean(values)) for name, values in rows.items()}
    born = [history for history in seen_by_id.values() if history[0][0] > 5]
    result['birth delay'] = float(np.mean([_delay(history) for history in born])) if born else 0.0
    return result


def _delay(history: list[tuple[int, bool]]) -> int:
    """Records until a reflector is there for three in a row; all it has when it never is."""
    there = [seen for _, seen in history]
    for k in range(len(there) - 2):
        if all(there[k : k + 3]):
            return k
    return len(there)


# -- pulses ---------------------------------------------------------------------------------------

LAYER_DEPTHS = np.array([52.0, 55.2, 58.5, 61.7, 66.0, 69.3])
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


def drift_scene(seed: int, records: int) -> tuple[FathometerScenario, Drift, np.random.Generator]:
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
    config, first, strength = scenario('pressure', changes), LAYER_DEPTHS, STRENGTHS
    if hydrophones == 32:
        config = FathometerScenario(**{**changes, 'snapshots': 256})
        first, strength = LAYER_DEPTHS + 80.0, 0.4 * STRENGTHS
    rng = np.random.default_rng(seed)
    depth = first + np.cumsum(0.05 * rng.standard_normal((records, 6)), axis=0)
    array = config.array_depth + rng.uniform(-0.5, 0.5, records)
    stated = array + config.array_depth_std * rng.standard_normal(records)
    amplitude = np.tile(signs * strength, (records, 1))
    return config, Drift(depth, amplitude, amplitude != 0.0, array, stated), rng


def pulse_scores(
    name: str,
    seed: int,
    records: int,
    particles: int,
    pulses: Sequence[str],
    polarities: Sequence[str] = ('positive', 'both'),
) -> dict[str, dict[str, float]]:
    """Scores of each of `pulses` and `polarities`."""
    if name == 'drift':
        config, floor, rng = drift_scene(seed, records)
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
            scores[label].append(_pulse_score(found, depth, amplitude))
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


def _pulse_score(found: Estimate, depth: np.ndarray, amplitude: np.ndarray) -> list[float]:
    z = fathometer_paper.reflectors(found)
    away = z[:, :1] - depth
    near = np.abs(away) < 0.4
    wrong = near & (np.sign(z[:, 1:2]) != np.sign(amplitude))
    return [
        *fathometer_paper.score(found, depth),
        rms(away[near]) if near.any() else np.nan,
        float(wrong.sum()),
    ]


def pulses_table(runs: int, records: int, particles: int, scenes: Sequence[str]) -> Parts:
    for name in scenes:
        length = records if name == 'drift' else max(10, records // 10)
        scores: dict[str, list[dict[str, float]]] = {}
        for seed in range(runs):
            made = pulse_scores(name, seed, length, particles, ('band', 'processor'))
            for label, row in made.items():
                each = scores.setdefault(label, [])
                each.append(row)
                error = {'P, s.e.': standard_error([row['P'] for row in each])}
                yield {'table': {label: {'runs': float(len(each))} | mean_of(each) | error}}


def main(
    runs: int = 3,
    records: int = 300,
    particles: int = 20_000,
    rows: Sequence[str] = (),
    pulses: bool = False,
    out: Path | None = None,
) -> Parts:
    yield known(out)
    if pulses:
        wanted_scenes = [name for name in SCENES if not rows or any(word in name for word in rows)]
        yield {'records': records}
        yield from pulses_table(runs, records, particles, wanted_scenes)
        return
    wanted = {
        label: given
        for label, given in CONFIGURATIONS.items()
        if not rows or any(word in label for word in rows)
    }
    scores: dict[str, list[dict[str, float]]] = {label: [] for label in wanted}
    for seed in range(runs):
        traces, truth = drift(seed, records)
        for label, (processor, values, changes) in wanted.items():
            exact = {'particles': particles, 'sound_speed_std': 0.0}
            config = FathometerConfig(**{**exact, **values}, seed=seed)
            tracker = ChangedTracker(config, **changes)
            scores[label].append(score(tracker, traces[processor], truth))
        table = {
            label: {'runs': float(len(each))}
            | mean_of(each)
            | {
                f'{name}, s.e.': standard_error([row[name] for row in each])
                for name in ('P(order right)', 'OSPA')
            }
            for label, each in scores.items()
        }
        yield {'records': records, 'table': table}


if __name__ == '__main__':
    study(main, rows={'help': 'only rows with one of these words in the name'})
