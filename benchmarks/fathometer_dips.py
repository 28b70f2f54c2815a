# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Layers that dip, tracked with a slope for each reflector and without.

    python -m benchmarks.fathometer_dips --out docs/results/fathometer_dips.json

Traces of eight layers of 7 to 34 sigma that walk by .1 m and are deeper by `dip` m from record to
record: 20 records, then none for `gap` records, then 10 more; gaps in which the layers would leave
the trace are left out. 'parallel': all dip alike; 'fan': by half to one and a half times `dip`,
growing with depth; 'turn': down for 15 records, then up. The tracker has its defaults; 'still' is
the same without slopes (slope_std 0). P: share of the records whose number of layers is right, of
the first 20 ('before') and after the gap; inside: depths within two stated standard deviations;
identities: how many were given in a run, for eight layers, and the share of the layers that have
after the gap the one that they had before. dipping: the mean probability of it.

The Kalman filters know which echo is of which layer: one for each, with depth and slope, the same
depth_std, and the slope N(0, .4^2) before anything is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.fathometer_gaps import (
    BEFORE,
    highest,
    inside,
    scene,
    SECONDS,
    seen_variance,
    STEP,
    tracked,
)
from benchmarks.study import Parts, rms, study
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Trace

LAYERS = np.array([46.0, 51.3, 55.1, 59.4, 64.2, 68.9, 73.0, 78.2])
SIGMAS = np.array([34.0, 28.0, 22.0, 17.0, 13.0, 11.0, 9.0, 7.0])
DEPTH = 40.0 + STEP * np.arange(4608)
DIPS, GAPS = (0.0, 0.1, 0.2, 0.4, 0.8), (0, 10, 30, 120)
WALK, RECORDS = 0.1, 30


def case(kind: str, dip: float, gap: int, seed: int) -> tuple[list[Trace], FloatArray]:
    """Traces, and the true depths (records, 8)."""
    slope: float | FloatArray = dip
    if kind == 'fan':
        slope = dip * np.linspace(0.5, 1.5, len(LAYERS))
    if kind == 'turn':
        slope = np.where(np.arange(RECORDS + gap) < 15, dip, -dip)[:, None]
    return scene(gap, WALK, seed, slope, DEPTH, LAYERS, SIGMAS)


def kalman(traces: Sequence[Trace], truth: FloatArray, gap: int) -> FloatArray:
    """Errors and stated standard deviations (records, 8, 2) with known association."""
    found = np.empty((*truth.shape, 2))
    for i, r in enumerate(seen_variance(SIGMAS)):
        mean, P = np.array([truth[0, i], 0.0]), np.diag([1e6, 0.4**2])
        for k, trace in enumerate(traces):
            times = 1 + gap * (k == BEFORE)
            F = np.array([[1.0, times], [0.0, 1.0]])
            mean, P = F @ mean, F @ P @ F.T + np.diag([times * WALK**2, 0.0])
            gain = P[:, 0] / (P[0, 0] + r)
            mean = mean + gain * (highest(trace, truth[k, i]) - mean[0])
            P = P - np.outer(gain, P[0])
            found[k, i] = mean[0] - truth[k, i], np.sqrt(P[0, 0])
    return found


def summary(runs: Sequence[dict[str, Any]]) -> dict[str, float]:
    right = np.array([run['right'] for run in runs])
    found = np.array([run['found'] for run in runs])
    ids = np.array([run['ids'] for run in runs])
    before = ids[:, BEFORE - 1 : BEFORE]
    known = before[:, 0] > 0
    same = (ids[:, BEFORE:] == before) & (before > 0)

    def kept(record: int) -> float:
        return float(same[:, record][known].mean()) if known.any() else 0.0

    errors = found[:, :, :, 0]
    return {
        'P, before': float(right[:, :BEFORE].mean()),
        'P, 1st': float(right[:, BEFORE].mean()),
        'P, 2nd': float(right[:, BEFORE + 1].mean()),
        'P, later': float(right[:, BEFORE + 2 :].mean()),
        'inside, before': inside(found[:, :BEFORE]),
        'inside, after': inside(found[:, BEFORE:]),
        'error, m': rms(errors[np.isfinite(errors)]),
        'identities': float(np.mean([run['named'] for run in runs])),
        'kept, 1st': kept(0),
        'kept, 4th': kept(3),
        'dipping': float(np.mean([run['dipping'] for run in runs])),
    }


def main(
    runs: int = 20,
    particles: int = 20_000,
    kinds: Sequence[str] = ('parallel', 'fan', 'turn'),
    dips: Sequence[float] = DIPS,
    gaps: Sequence[int] = GAPS,
) -> Parts:
    yield {'runs': runs, 'particles': particles, 'record_seconds': SECONDS}
    for kind in kinds:
        for dip in dips:
            for gap in gaps:
                lowest = dip * (RECORDS + gap) if kind == 'parallel' else 0.0
                if lowest + LAYERS[-1] > DEPTH[-1] - 1.0 or (kind != 'parallel' and gap):
                    continue
                if kind != 'parallel' and dip not in (0.2, 0.4):
                    continue
                ways: dict[str, list[dict[str, Any]]] = {'slopes': [], 'still': [], 'Kalman': []}
                for seed in range(runs):
                    traces, truth = case(kind, dip, gap, seed)
                    ways['slopes'].append(tracked(traces, truth, particles=particles))
                    ways['still'].append(
                        tracked(traces, truth, particles=particles, slope_std=0.0)
                    )
                    known = np.ones(truth.shape, int)
                    bound: dict[str, Any] = {'found': kalman(traces, truth, gap), 'ids': known}
                    bound |= {'right': known[:, 0], 'named': len(LAYERS)}
                    ways['Kalman'].append({**bound, 'dipping': float(dip > 0.0)})
                for name, made in ways.items():
                    yield {'table': {f'{kind} {dip:g} m, gap {gap}, {name}': summary(made)}}


if __name__ == '__main__':
    study(main)
