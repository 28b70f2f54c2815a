# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The cost of a step of each tracker, as a file of results: what `sonar-imm bench` measures; of a
record by kernels for other processors; of the first start; and of `sonar-imm convert`.

    python -m benchmarks.speed --out docs/results/speed.json
    python -m benchmarks.speed --parts "first start" --add --out docs/results/speed.json
"""

from __future__ import annotations

from collections.abc import Sequence
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np

from benchmarks.speed import benches_of
from benchmarks.speed.cold_start import cold_start, STARTS
from benchmarks.speed.conversions import CASES, conversion
from benchmarks.speed.fathometer import bench_record, FathometerConfig, FathometerTracker, trace
from benchmarks.study import in_fresh_process, Parts, study

STEPS = ('diver step', 'diver clutter', 'obstacle ping', 'bathymetry ping', 'fathometer record')
"""System and name of the benches that the page on speed shows."""
TARGETS = {
    'this processor': {},
    'x86-64-v3': {'NUMBA_CPU_NAME': 'x86-64-v3', 'NUMBA_CPU_FEATURES': ''},
    'generic': {'NUMBA_CPU_NAME': 'generic', 'NUMBA_CPU_FEATURES': ''},
}
"""Processors that numba compiles for, by its own variables: see docker/numba_target.sh."""
PARTS = ('steps', 'kernel targets', 'first start', 'conversions')


def main(rounds: int = 7, parts: Sequence[str] = PARTS, steps: Sequence[str] = STEPS) -> Parts:
    if 'steps' in parts and len(steps) == len(STEPS):
        yield {'rounds': rounds, 'load': os.getloadavg()[0], 'processors': os.cpu_count()}
    for step in steps if 'steps' in parts else ():
        system, name = step.split()
        (bench,) = (bench for bench in benches_of(system) if bench.name == name)
        yield {'steps': {step: bench.measure(rounds)}}
    if 'kernel targets' in parts:
        yield {'kernel targets': kernel_targets(rounds)}
    for name, case in STARTS.items() if 'first start' in parts else ():
        with tempfile.TemporaryDirectory() as cache:
            # Read when numba is imported, which the process does before it is called.
            os.environ['NUMBA_CACHE_DIR'] = cache
            yield {'first start': {name: in_fresh_process(cold_start, case, cache)}}
    for name in CASES if 'conversions' in parts else ():
        yield {'conversions': {name: conversion(name, 3)}}


def kernel_targets(rounds: int) -> dict[str, Any]:
    """Milliseconds of a fathometer record by kernels of each target, the least of `rounds`
    processes in turn, and whether the estimates are the same bits as those of this processor."""
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in TARGETS}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(rounds):
            for name, variables in TARGETS.items():
                kept = {'NUMBA_CACHE_DIR': os.path.join(folder, name.replace(' ', '_'))}
                child = subprocess.run(
                    [sys.executable, '-c', f'from {__package__}.__main__ import child; child()'],
                    env={**os.environ, **variables, **kept},
                    stdout=subprocess.PIPE,
                    check=True,
                )
                found[name].append(json.loads(child.stdout))
    own = min(run['ms'] for run in found['this processor'])
    digest = found['this processor'][0]['digest']
    return {
        name: {
            'record ms': (least := min(run['ms'] for run in runs)),
            'ratio': least / own,
            'same bits': all(run['digest'] == digest for run in runs),
        }
        for name, runs in found.items()
    }


def child() -> None:
    """Print the time of a record and the digest of some estimates, as JSON."""
    ms = bench_record()['median_ms']['defaults']
    tracker, rng = FathometerTracker(FathometerConfig(particles=2000)), np.random.default_rng(5)
    digest = hashlib.sha256()
    for record in range(10):
        for estimate in tracker.process(trace(record, rng)):
            digest.update(estimate.state.tobytes() + estimate.probabilities.tobytes())
    print(json.dumps({'ms': ms, 'digest': digest.hexdigest()}))


if __name__ == '__main__':
    study(main, parts={'choices': PARTS}, steps={'choices': STEPS})
