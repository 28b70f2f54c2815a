# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What records that are missing cost the fathometer tracker.

    python -m benchmarks.fathometer_gaps --out docs/results/fathometer_gaps.json

Traces of six layers of 7 to 34 sigma that walk by `walk` from record to record, with the pulse of
50 to 4000 Hz: 20 records, then none for `gap` records, in which the layers go on walking, then 10
more. The tracker has its defaults (depth_std 0.1 m). P in the first, the second and the later
records after the gap; depth errors (rms) and the share of them within two stated standard
deviations in the first record and in the others; identities: the share of the layers that have the
name after the gap, in its first record and three records later, that they had before. 'once' is
what a tracker does that takes a gap for a record (record_interval longer than any gap).

The Kalman filters know which echo is of which layer: one for each, with the same depth_std. What
they are given is the highest point of the record within 0.25 m of where the layer is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.study import Parts, rms, study
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker

LAYERS = np.array([46.0, 52.3, 58.1, 65.4, 71.2, 78.9])
SIGMAS = np.array([34.0, 25.0, 18.0, 12.0, 9.0, 7.0])
STEP, BEFORE, AFTER, SECONDS = 1.0 / 64.0, 20, 10, 10.0
DEPTH = 38.0 + STEP * np.arange(3072)
ARRAY_STD = 0.0
CASES = (0.1, 0.15)
ONCE = {'record_interval': 86400.0, 'slope_std': 0.0}
GAPS = (0, 10, 30, 120)


def scene(
    gap: int,
    walk: float,
    seed: int,
    dip: float | FloatArray = 0.0,
    depth: NDArray[np.floating[Any]] = DEPTH,
    layers: FloatArray = LAYERS,
    sigmas: FloatArray = SIGMAS,
) -> tuple[list[Trace], FloatArray]:
    """Traces, and the true depths (records, layers). dip: what the layers (layers,) are deeper by
    from record to record (records,), m."""
    rng = np.random.default_rng([seed, gap])
    moved = walk * rng.standard_normal((BEFORE + gap + AFTER, len(layers))) + dip
    every = layers + np.cumsum(moved, axis=0)
    there = np.r_[0:BEFORE, BEFORE + gap : len(every)]
    pulse, lags = band_pulse(50.0, 4000.0, 1500.0), np.arange(2 * len(depth))
    spectrum = np.fft.rfft(pulse(STEP * np.minimum(lags, len(lags) - lags)))
    root = np.sqrt(spectrum.real.clip(min=0.0))
    traces = []
    for k in there:
        noise = np.fft.irfft(root * np.fft.rfft(rng.standard_normal(len(lags))), len(lags))
        echoes = pulse(depth[:, None] - every[k]) @ sigmas
        traces.append(
            Trace(
                stamp_ns=round((k + 1) * SECONDS * 1e9),
                depth=depth,
                amplitude=noise[: len(depth)] / noise.std() + echoes,
                sigma=np.ones(len(depth)),
                reference_depth=30.0,
            )
        )
    return traces, every[there]


def highest(trace: Trace, depth: float) -> float:
    """The depth of the highest point of a record within 0.25 m of `depth`."""
    near = np.flatnonzero(np.abs(trace.depth - depth) < 0.25)
    return float(trace.depth[near[np.argmax(trace.amplitude[near])]])


def seen_variance(sigmas: FloatArray) -> FloatArray:
    """Variance (K,) of the depth of the highest point of echoes of so many sigmas (K,), m^2."""
    pulse = band_pulse(50.0, 4000.0, 1500.0)
    curvature = -float(np.diff(pulse(np.array([-1e-3, 0.0, 1e-3])), 2)[0]) / 1e-6
    return 1.0 / (np.square(sigmas) * curvature) + STEP**2 / 12.0


def kalman(traces: Sequence[Trace], truth: FloatArray, gap: int) -> FloatArray:
    """Errors and stated standard deviations (records, 6, 2) with known association."""
    found = np.empty((*truth.shape, 2))
    for i, r in enumerate(seen_variance(SIGMAS)):
        mean, P = 0.0, 1e6
        for k, trace in enumerate(traces):
            seen = highest(trace, truth[k, i])
            P += 0.1**2 * (1 + gap * (k == BEFORE))
            gain = P / (P + r)
            mean, P = mean + gain * (seen - mean), (1.0 - gain) * P
            found[k, i] = mean - truth[k, i], np.sqrt(P)
    return found


def tracked(traces: Sequence[Trace], truth: FloatArray, **parameters: Any) -> dict[str, Any]:
    """right (records,), errors and stated standard deviations of layers that were found
    (records, 6, 2), ids (records, 6), 0 where a layer was not found."""
    config = FathometerConfig(
        **{'array_depth_std': ARRAY_STD, 'sound_speed_std': 0.0, **parameters}
    )
    tracker = FathometerTracker(config)
    right = np.zeros(len(traces), bool)
    found, ids = np.full((*truth.shape, 2), np.nan), np.zeros(truth.shape, int)
    named: set[int] = set()
    dipping = []
    for k, trace in enumerate(traces):
        (estimate,) = tracker.process(trace)
        right[k] = int(np.argmax(estimate.probabilities[0])) + config.order_min == truth.shape[1]
        if not np.isfinite(estimate.state[:, 0]).all():
            continue
        named.update(estimate.extras['track_id'].tolist())
        dipping.append(float(np.mean(estimate.extras['dipping'])))
        for i, z in enumerate(truth[k]):
            row = int(np.argmin(np.abs(estimate.state[:, 0] - z)))
            error = estimate.state[row, 0] - z
            if abs(error) < 0.5:
                found[k, i] = error, np.sqrt(estimate.covariance[row, 0, 0])
                ids[k, i] = estimate.extras['track_id'][row]
    return {
        'right': right,
        'found': found,
        'ids': ids,
        'named': len(named),
        'dipping': float(np.mean(dipping)),
    }


def inside(errors: FloatArray) -> float:
    """Share of errors (..., 2), each with its stated standard deviation, within two of these."""
    errors = errors[np.isfinite(errors).all(axis=-1)]
    return float(np.mean(np.abs(errors[:, 0]) <= 2.0 * errors[:, 1]))


def summary(runs: Sequence[dict[str, Any]]) -> dict[str, float]:
    right = np.array([run['right'] for run in runs])[:, BEFORE:]
    found = np.array([run['found'] for run in runs])[:, BEFORE:]
    ids = np.array([run['ids'] for run in runs])
    before = ids[:, BEFORE - 1 : BEFORE]
    same = (ids[:, BEFORE:] == before) & (before > 0)
    known = before[:, 0] > 0
    return {
        'P, 1st': float(right[:, 0].mean()),
        'P, 2nd': float(right[:, 1].mean()),
        'P, later': float(right[:, 2:].mean()),
        'found, 1st': float(np.isfinite(found[:, 0, :, 0]).mean()),
        'error, 1st, m': rms(found[:, 0, :, 0][np.isfinite(found[:, 0, :, 0])]),
        'inside, 1st': inside(found[:, 0]),
        'inside, later': inside(found[:, 1:]),
        'identities, 1st': float(same[:, 0][known].mean()),
        'identities, 4th': float(same[:, 3][known].mean()),
    }


def main(
    runs: int = 20, particles: int = 20_000, walks: Sequence[float] = CASES, gaps: tuple = GAPS
) -> Parts:
    yield {'runs': runs, 'particles': particles}
    for walk in walks:
        for gap in gaps:
            ways: dict[str, list[dict[str, Any]]] = {'tracker': [], 'once': [], 'Kalman': []}
            for seed in range(runs):
                traces, truth = scene(gap, walk, seed)
                ways['tracker'].append(tracked(traces, truth, particles=particles))
                if gap:
                    ways['once'].append(tracked(traces, truth, particles=particles, **ONCE))
                known = np.ones(truth.shape, int)
                bound = {'right': known[:, 0], 'found': kalman(traces, truth, gap), 'ids': known}
                ways['Kalman'].append(bound)
            for name, made in ways.items():
                if made:
                    yield {'table': {f'walk {walk:g} m, gap {gap}, {name}': summary(made)}}


if __name__ == '__main__':
    study(main)
