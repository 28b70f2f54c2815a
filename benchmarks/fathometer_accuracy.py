# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Accuracy of the fathometer tracker on simulated drifts, beside what it replaces.

    python -m benchmarks.fathometer_accuracy --runs 3 --out docs/results/fathometer_accuracy.json

Each run is one drift as cross-spectra (seven to nine reflectors over 300 records), processed twice
(MVDR and conventional) and tracked by every configuration. OSPA has a cutoff of 2 m and order 2;
a reflector within 0.4 m of a true one is neither false nor missed. Birth delay: records from the
presence of a new reflector to the first of three records in a row that have it. Making the traces
takes about 15 minutes a run, so they can be kept (`--cache`).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import markdown, write_json
from sonar_imm.acoustics.fathometer import coherence, depth_response, noise_sigma, steering
from sonar_imm.estimation.consistency import ospa
from sonar_imm.measurements import CrossSpectra, Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import drift_of
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, FathometerScenario

DEPTHS = (122.0, 1 / 32, 1600)
NEAR = 0.4
PAPER_ORDERS: dict[str, Any] = {
    'order_min': 7,
    'order_max': 9,
    'order_transition_matrix': (0.6, 0.2, 0.2, 0.2, 0.6, 0.2, 0.2, 0.2, 0.6),
}
CONVENTIONAL: dict[str, Any] = {'frequency_min': 200.0}
FINED: dict[str, Any] = {**PAPER_ORDERS, 'amplitude_prior': 'paper'}
OWN_PULSE: dict[str, Any] = {'pulse': 'envelope'}
"""The envelope of a response has another pulse than its real part."""
CONFIGURATIONS: dict[str, tuple[str, dict[str, Any]]] = {
    'MVDR as the paper (envelope, bootstrap), N^-m': (
        'envelope',
        {**FINED, **OWN_PULSE, 'proposal': 'prior'},
    ),
    '+ data-driven proposals': ('envelope', {**FINED, **OWN_PULSE}),
    '  with the pulse of the real part': ('envelope', FINED),
    'MVDR real part, N^-m': ('mvdr', FINED),
    'MVDR real part, N^(-m/2), 7-9': ('mvdr', {**PAPER_ORDERS, 'amplitude_prior': 'bic_half'}),
    'MVDR real part, marginal, 1-12 (default)': ('mvdr', {}),
    '  smoothed, lag 2': ('mvdr', {'smoothing_lag': 2}),
    '  2,000 particles': ('mvdr', {'particles': 2000}),
    **{
        f'fixed order {m}, {name}': ('mvdr', {'order_min': m, 'order_max': m, 'proposal': kind})
        for kind, name in (('prior', 'bootstrap'), ('data', 'data-driven'))
        for m in (7, 8, 9)
    },
    'conventional envelope, pulse of the real part, N^-m': (
        'conventional_envelope',
        {**FINED, **CONVENTIONAL},
    ),
    'conventional real part, N^-m': ('conventional', {**FINED, **CONVENTIONAL}),
    'conventional real part, amplitude memory 0.98, 1-12': (
        'conventional',
        {'amplitude_memory': 0.98, **CONVENTIONAL},
    ),
}


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
        ('conventional_envelope', 'conventional', 200.0, True),
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


def drift(seed: int, records: int, cache: Path | None) -> tuple[dict[str, list[Trace]], list]:
    """Traces of one run by processor, and the true depths and ids of each record."""
    file = cache / f'drift_{seed}_{records}.npz' if cache else None
    if file is None or not file.exists():
        scale = records / 300
        config = FathometerScenario(
            records=records,
            appearing=(int(140 * scale), int(262 * scale)),
            fading=(int(85 * scale),),
        )
        traces: dict[str, list[Trace]] = {}
        truth = []
        # Cross-spectra of a whole drift would not fit into memory, nor does `check` let them.
        rng = np.random.default_rng(seed)
        floor = drift_of(config, rng)
        for record in range(records):
            spectra = cross_spectra(config, floor, record, floor.array_depth_told[record], rng)
            for name, trace in responses(spectra).items():
                traces.setdefault(name, []).append(trace)
            here = floor.present[record]
            truth.append((np.flatnonzero(here), floor.depth[record, here]))
        if file:
            file.parent.mkdir(parents=True, exist_ok=True)
            _save(file, traces, truth)
        return traces, truth
    return _load(file)


def _save(file: Path, traces: dict[str, list[Trace]], truth: list) -> None:
    np.savez_compressed(
        file,
        count=np.array([len(ids) for ids, _ in truth]),
        ids=np.concatenate([ids for ids, _ in truth]),
        true_depth=np.concatenate([depth for _, depth in truth]),
        reference=np.array([one.reference_depth for one in traces['mvdr']]),
        **{name: np.array([one.amplitude for one in each]) for name, each in traces.items()},
        **{f'{name}_sigma': [one.sigma[0] for one in each] for name, each in traces.items()},
    )


def _load(file: Path) -> tuple[dict[str, list[Trace]], list]:
    with np.load(file) as kept:
        ends = np.cumsum(kept['count'])[:-1]
        truth = list(zip(np.split(kept['ids'], ends), np.split(kept['true_depth'], ends)))
        depth, reference = DEPTHS[0] + DEPTHS[1] * np.arange(DEPTHS[2]), kept['reference']
        traces = {
            name: [
                Trace(
                    stamp_ns=(k + 1) * 90 * 10**9,
                    depth=depth,
                    amplitude=amplitude,
                    sigma=np.full(len(depth), sigma),
                    reference_depth=float(reference[k]),
                )
                for k, (amplitude, sigma) in enumerate(zip(kept[name], kept[f'{name}_sigma']))
            ]
            for name in ('mvdr', 'envelope', 'conventional', 'conventional_envelope')
        }
    return traces, truth


def score(config: FathometerConfig, traces: list[Trace], truth: list) -> dict[str, float]:
    tracker, found = FathometerTracker(config), {}
    for trace in traces:
        found.update((one.stamp_ns, one) for one in tracker.process(trace))
    rows: dict[str, list[float]] = {}
    seen_by_id: dict[int, list[tuple[int, bool]]] = {}
    for k, (trace, (ids, depth)) in enumerate(zip(traces, truth)):
        estimate = found[trace.stamp_ns]
        z = estimate.state[np.isfinite(estimate.state[:, 0]), 0]
        order = config.order_min + int(estimate.probabilities[0].argmax())
        distance = np.abs(z[:, None] - depth)
        hit = (distance < NEAR).any(axis=0)
        values = {
            'P(order right)': float(order == len(depth)),
            'OSPA': ospa(z[:, None], depth[:, None], cutoff=2.0, order=2.0),
            'false': float(np.count_nonzero(~(distance < NEAR).any(axis=1))),
            'missed': float(np.count_nonzero(~hit)),
        }
        for name, value in values.items():
            rows.setdefault(name, []).append(value)
        for one, there in zip(ids, hit):
            seen_by_id.setdefault(int(one), []).append((k, bool(there)))
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--runs', type=int, default=3)
    parser.add_argument('--records', type=int, default=300)
    parser.add_argument('--particles', type=int, default=20_000)
    parser.add_argument('--cache', type=Path, help='folder to keep traces in')
    parser.add_argument('--out', type=Path, help='write the numbers as JSON')
    options = parser.parse_args()
    scores: dict[str, list[dict[str, float]]] = {}
    for seed in range(options.runs):
        traces, truth = drift(seed, options.records, options.cache)
        for label, (processor, values) in CONFIGURATIONS.items():
            given = {'particles': options.particles, **values}
            config = FathometerConfig(**given, seed=seed)
            scores.setdefault(label, []).append(score(config, traces[processor], truth))
    table = {
        label: {name: float(np.mean([one[name] for one in each])) for name in each[0]}
        | {
            f'{name}, s.e.': float(
                np.std([one[name] for one in each]) / max(1, len(each) - 1) ** 0.5
            )
            for name in ('P(order right)', 'OSPA')
        }
        for label, each in scores.items()
    }
    print(f'{options.runs} runs of {options.records} records\n\n{markdown(table)}')
    write_json(options.out, {'runs': options.runs, 'records': options.records, 'table': table})


if __name__ == '__main__':
    main()
