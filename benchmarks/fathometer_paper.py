# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The paper to the letter, and what single choices of it cost.

    python -m benchmarks.fathometer_paper --out docs/results/fathometer_paper.json

``array``: drifts of the paper as cross-spectra through the tracker, 32 phones, by its
configurations: the default, the paper's (`PAPER`), and both with the output of the array changed.
Penalties of amplitudes and the bootstrap filter are no parameters; `ChangedTracker` sets them in
the model of the sets. P is the share of records whose number of reflectors is right; OSPA of
second order, cutoff 2 m.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.consistency import ospa
from sonar_imm.estimation.set_model import SetModel
from sonar_imm.trackers.fathometer.response import Lattice
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import drift_of
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, FathometerScenario

ORDERS: dict[str, Any] = {
    'order_min': 7,
    'order_max': 9,
    'order_transition_matrix': (0.6, 0.2, 0.2, 0.2, 0.6, 0.2, 0.2, 0.2, 0.6),
}
"""The numbers of reflectors in the paper."""
ENVELOPE: dict[str, Any] = {**ORDERS, 'pulse': 'envelope', 'water': 'off'}
"""Of envelopes as the paper takes them, not as those of a profiler."""
PENALTY: dict[str, Any] = {'amplitude_prior': 'paper'}
"""Of `SetModel`: the best amplitudes of a set, with a factor 1 / N for each of them."""
BOOTSTRAP: dict[str, Any] = {'walk_share': 0.0, 'birth_share': 0.0}
"""Of `SetModel`: particles are drawn from the prior."""
PAPER: dict[str, Any] = {**ENVELOPE, 'output': 'correlation', 'envelope': True}
"""The paper's choices: correlation that is not normalised, its envelope, and, with `PENALTY` and
`BOOTSTRAP`, a bootstrap filter with 7 to 9 reflectors and N^-m. Equation (4) as printed has the
echoes above the array."""
OF_ARRAY: dict[str, dict[str, Any]] = {
    'default': {},
    'default, correlation': {'output': 'correlation'},
    'default, printed': {'output': 'printed'},
    'the paper': PAPER,
    'the paper, coherence': {**PAPER, 'output': 'coherence'},
    'the paper, printed': {**PAPER, 'output': 'printed'},
    'the paper, conventional': {**PAPER, 'processor': 'conventional', 'frequency_min': 200.0},
}
"""Parameters; rows of the paper have `PENALTY` and `BOOTSTRAP` besides."""


class ChangedTracker(FathometerTracker):
    """The tracker with another model of sets. changes: fields of `SetModel`."""

    def __init__(self, config: FathometerConfig, **changes: Any):
        self.changes = changes
        super().__init__(config)

    def _set_model(self, lattice: Lattice) -> SetModel:
        return evolve(super()._set_model(lattice), **self.changes)


def reflectors(estimate: Estimate) -> np.ndarray:
    """The states (k, 2), depth and amplitude, of the reflectors that are there."""
    return estimate.state[np.isfinite(estimate.state[:, 0])]


def score(estimate: Estimate, depth: np.ndarray) -> tuple[float, float]:
    """Whether the number of reflectors is right, and OSPA, m. depth: the true ones (n,)."""
    assert estimate.probabilities is not None
    order = int(estimate.model_names[int(estimate.probabilities[0].argmax())].split('_')[1])
    z = reflectors(estimate)[:, :1]
    return float(order == len(depth)), ospa(z, depth[:, None], cutoff=2.0, order=2.0)


def summary(scores: Iterable[tuple[float, float]]) -> dict[str, float]:
    right, distance = np.array(list(scores)).T
    return {
        'records': float(len(right)),
        'P': float(right.mean()),
        'OSPA': float(distance.mean()),
    }


def of_array(runs: int, records: int, particles: int) -> dict[str, dict[str, float]]:
    scores: dict[str, list[tuple[float, float]]] = {label: [] for label in OF_ARRAY}
    for seed in range(runs):
        # A quarter of the snapshot with four times as many says as much, four times as fast; lags
        # fold earlier, so that noise is measured in the mirror window.
        config = FathometerScenario(
            records=records, snapshot_seconds=0.35, snapshots=256, appearing=(), fading=()
        )
        rng = np.random.default_rng(seed)
        floor = drift_of(config, rng)
        settings: dict[str, Any] = {
            'window': 'rectangular',
            'overlap': 0.0,
            'depth_min': config.depth_min,
            'depth_max': config.depth_max,
            'noise_depth_min': 0.0,
            'noise_depth_max': 0.0,
            'particles': particles,
            'seed': seed,
        }
        trackers = {
            label: ChangedTracker(
                FathometerConfig(**{**settings, **options}),
                **(PENALTY | BOOTSTRAP if label.startswith('the paper') else {}),
            )
            for label, options in OF_ARRAY.items()
        }
        for record in range(records):
            depth = float(floor.array_depth_stated[record])
            spectra = cross_spectra(config, floor, record, depth, rng)
            true = floor.depth[record, floor.present[record]]
            for label, tracker in trackers.items():
                scores[label].append(score(tracker.process(spectra)[-1], true))
    return {label: summary(each) for label, each in scores.items()}


def main(runs: int = 2, records: int = 60, particles: int = 20_000) -> Parts:
    yield {'particles': particles, 'array': of_array(runs, records, particles)}


if __name__ == '__main__':
    study(main, runs={'help': 'drifts'}, records={'help': 'of each of them'})
