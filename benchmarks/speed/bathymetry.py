# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How fast the bathymetry tracker is: bins per second of whole pings of the paper's scene.

Methods are timed in turn, round after round. The best round counts, because it is the least
disturbed one. The whole of `process` is timed, in CPU time: variances, filter and estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
import math
import time
from typing import Any

from benchmarks.bathymetry_paper import WALKS
from benchmarks.speed import Bench
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

GOAL = 80_000
METHODS: dict[str, dict[str, Any]] = {
    'default': {},
    'two walks': WALKS,
    'particles': {**WALKS, 'gate_false_alarm': 1.0},
}


def a_ping(**values: Any) -> Snapshot:
    """One ping of the paper's scene, longer: 2000 bins."""
    scene = simulate(scenario('paper', {'pings': 1, 'last_range': 117.0, **values}), 1)
    ping: Snapshot = scene.measurements[0].measurement
    return ping


def rates(methods: Mapping[str, Callable[[], Any]], bins: int, rounds: int) -> dict[str, float]:
    """Bins per second of each method, which processes so many, in the best of `rounds` rounds."""
    best = dict.fromkeys(methods, math.inf)
    for run in methods.values():
        run()
    for _ in range(rounds):
        for name, run in methods.items():
            begin = time.process_time()
            run()
            best[name] = min(best[name], time.process_time() - begin)
    return {name: bins / seconds for name, seconds in best.items()}


def bench_ping(rounds: int = 7) -> dict[str, Any]:
    """Bins per second by default, with two walks, and without the coherence gate."""
    ping = a_ping()
    trackers = {name: BathymetryTracker(BathymetryConfig(**v)) for name, v in METHODS.items()}
    methods = {name: partial(each.process, ping) for name, each in trackers.items()}
    speed = rates(methods, len(ping), rounds)
    return {'bins_per_second': speed, 'wanted': GOAL, 'good': speed['particles'] >= GOAL}


BENCHES = (Bench('ping', bench_ping),)
