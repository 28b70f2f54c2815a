# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What an error of the told depth costs, and what it is worth to track it.

    python -m benchmarks.fathometer_heave --out docs/results/fathometer_heave.json

Traces of six layers of 7 to 34 sigma that walk by 0.02 m from record to record, with the pulse of
50 to 4000 Hz; the depth of the array is told 0.5 m rms wrong, anew in each record or as an
autoregression of 0.9, or right. 40 records, scored after 20: P, OSPA (second order, cutoff 2 m),
the error that all layers share and the one relative to it (rms over the records with the right
number); how often the common error lies within two stated heave_std, and its mean square in units
of heave_std (NEES). A tracker that is told the truth (depth_std 0.02) has .954 and 1 of these; one
that expects the layers to move more is more careful than it has to be. The bound is the standard
deviation of a Kalman filter for the mean of six walks of depth_std and the error of the told
depth, whose sum alone is seen: rms over the same records.
"""

from __future__ import annotations

from typing import Any
import warnings

import numpy as np

from benchmarks.fathometer_paper import reflectors, score
from benchmarks.study import Parts, rms, study
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker

LAYERS = np.array([46.0, 49.3, 53.1, 56.4, 60.2, 64.9])
SIGMAS = np.array([34.0, 25.0, 18.0, 12.0, 9.0, 7.0])
WRONG, WALK, ARRAY = 0.5, 0.02, 30.0
RECORDS, UNSCORED = 40, 20
DEPTH = 40.0 + np.arange(2048) / 64.0
STATE: dict[str, Any] = {'heave': 'independent', 'array_depth_std': WRONG}
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    'independent, no state, depth_std 0.1': ('independent', {}),
    'independent, no state, depth_std 0.7': ('independent', {'depth_std': 0.7}),
    'independent, state, depth_std 0.1': ('independent', STATE),
    'independent, state, depth_std 0.05': ('independent', {**STATE, 'depth_std': 0.05}),
    'independent, state, depth_std 0.02': ('independent', {**STATE, 'depth_std': WALK}),
    'memory 0.9, no state': ('memory', {}),
    'memory 0.9, state: independent': ('memory', STATE),
    'memory 0.9, state: memory': ('memory', {**STATE, 'heave': 'memory'}),
    'memory 0.9, state: memory, depth_std 0.02': (
        'memory',
        {**STATE, 'heave': 'memory', 'depth_std': WALK},
    ),
    'no error, no state': ('none', {}),
    'no error, state of 0.5 m': ('none', STATE),
}


def scene(kind: str, seed: int) -> tuple[list[Trace], np.ndarray]:
    """Traces, and the true depths (records, 6)."""
    rng = np.random.default_rng(seed)
    depth = LAYERS + np.cumsum(WALK * rng.standard_normal((RECORDS, len(LAYERS))), axis=0)
    wrong = WRONG * rng.standard_normal(RECORDS)
    if kind == 'memory':
        for k in range(1, RECORDS):
            wrong[k] = 0.9 * wrong[k - 1] + np.sqrt(1.0 - 0.81) * wrong[k]
    if kind == 'none':
        wrong[:] = 0.0
    pulse = band_pulse(50.0, 4000.0, 1500.0)
    step = float(DEPTH[1] - DEPTH[0])
    spectrum = np.fft.rfft(pulse(step * np.minimum(np.arange(4096), 4096 - np.arange(4096))))
    root = np.sqrt(spectrum.real.clip(min=0.0))
    traces = []
    for k in range(RECORDS):
        noise = np.fft.irfft(root * np.fft.rfft(rng.standard_normal(4096)))[: len(DEPTH)]
        traces.append(
            Trace(
                stamp_ns=(k + 1) * 10**9,
                depth=DEPTH,
                amplitude=pulse(DEPTH[:, None] - depth[k] - wrong[k]) @ SIGMAS + noise,
                sigma=np.ones(len(DEPTH)),
                reference_depth=ARRAY + wrong[k],
            )
        )
    return traces, depth


def run(kind: str, options: dict[str, Any], seed: int, particles: int) -> dict[str, float]:
    traces, truth = scene(kind, seed)
    tracker = FathometerTracker(
        FathometerConfig(
            **{'particles': particles, 'seed': seed, 'sound_speed_std': 0.0, **options}
        )
    )
    scores, common, relative, scaled = [], [], [], []
    for k, trace in enumerate(traces):
        (estimate,) = tracker.process(trace)
        if k < UNSCORED:
            continue
        scores.append(score(estimate, truth[k]))
        z = reflectors(estimate)[:, 0]
        if len(z) == len(LAYERS):
            error = z - truth[k]
            common.append(error.mean())
            relative += list(error - error.mean())
            if 'heave' in options:
                scaled.append(error.mean() / estimate.extras['heave_std'][0])
    right, distance = np.array(scores).T
    return {
        'P': float(np.mean(right)),
        'OSPA': float(np.mean(distance)),
        'common, m': rms(common) if common else np.nan,
        'relative, m': rms(relative) if relative else np.nan,
        'common within 2 heave_std': float(np.mean(np.abs(scaled) <= 2.0)) if scaled else np.nan,
        'NEES': float(np.mean(np.square(scaled))) if scaled else np.nan,
    }


def bound(depth_std: float, memory: float) -> float:
    """Standard deviation of the common depth, rms over the records that are scored."""
    P = np.diag([1e6, WRONG**2])
    F, Q = np.diag([1.0, memory]), np.diag([depth_std**2 / len(LAYERS), 0.0])
    Q[1, 1] = WRONG**2 * (1.0 - memory**2)
    variance = []
    for record in range(RECORDS):
        if record:
            P = F @ P @ F.T + Q
        # The sum of both is seen as it is.
        gain = P.sum(axis=1) / P.sum()
        P = P - np.outer(gain, P.sum(axis=0))
        variance.append(P[0, 0])
    return float(np.sqrt(np.mean(variance[UNSCORED:])))


def main(runs: int = 40, particles: int = 3000) -> Parts:
    bounds = {
        f'{kind}, depth_std {std}': {'bound, m': bound(std, memory)}
        for kind, memory in (('independent', 0.0), ('memory 0.9', 0.9))
        for std in (0.1, 0.05, WALK)
    }
    yield {'runs': runs, 'bounds': bounds}
    for label, (kind, values) in ROWS.items():
        found = [run(kind, values, seed, particles) for seed in range(runs)]
        with warnings.catch_warnings():
            # A row without a state has no NEES in any run.
            warnings.simplefilter('ignore', RuntimeWarning)
            mean = {k: float(np.nanmean([row[k] for row in found])) for k in found[0]}
        yield {'table': {label: mean}}


if __name__ == '__main__':
    study(main)
