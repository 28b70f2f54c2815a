# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Accuracy of the fathometer tracker on simulated drifts, beside what it replaces.

    python -m benchmarks.fathometer_accuracy --runs 3 --out docs/results/fathometer_accuracy.json

Each run is one drift as cross-spectra (seven to nine reflectors over 300 records under the 32
hydrophones of the paper; a quarter of the snapshot with four times as many, which says as much and
is made four times as fast), processed twice (MVDR and conventional) and tracked by every
configuration. OSPA has a cutoff of 2 m and order 2; a reflector within 0.4 m of a true one is
neither false nor missed.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from benchmarks.study import final_estimates, mean_of, Parts, standard_error, study
from sonar_imm.acoustics.fathometer import coherence, depth_response, noise_sigma, steering
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import CrossSpectra, Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import drift_of
from sonar_imm_tools.simulation.fathometer.simulator import (
    cross_spectra,
    FathometerScenario,
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


def drift(seed: int, records: int) -> tuple[dict[str, list[Trace]], list[FloatArray]]:
    """Traces of one run by processor, and the true depths of each record."""
    scale = records / 300
    config = FathometerScenario(
        records=records,
        snapshot_seconds=0.35,
        snapshots=256,
        appearing=(int(140 * scale), int(262 * scale)),
        fading=(int(85 * scale),),
    )
    rng = np.random.default_rng(seed)
    floor = drift_of(config, rng)
    traces: dict[str, list[Trace]] = {}
    truth = []
    # Cross-spectra of a whole drift would not fit into memory, nor does `check` let them.
    for record in range(records):
        spectra = cross_spectra(config, floor, record, floor.array_depth_stated[record], rng)
        for name, trace in responses(spectra).items():
            traces.setdefault(name, []).append(trace)
        truth.append(floor.depth[record, floor.present[record]])
    return traces, truth


def score(
    tracker: FathometerTracker, traces: list[Trace], truth: list[FloatArray]
) -> dict[str, float]:
    found = final_estimates(tracker, traces)
    rows = []
    for trace, depth in zip(traces, truth):
        estimate = found[trace.stamp_ns]
        right, apart = fathometer_paper.score(estimate, depth)
        near = np.abs(reflectors(estimate)[:, :1] - depth) < NEAR
        false, missed = ~near.any(axis=1), ~near.any(axis=0)
        rows.append((right, apart, false.sum(), missed.sum()))
    names = 'P(order right)', 'OSPA', 'false', 'missed'
    return dict(zip(names, np.mean(rows, axis=0).tolist()))


def main(
    runs: int = 3,
    records: int = 300,
    particles: int = 20_000,
    rows: Sequence[str] = (),
) -> Parts:
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
