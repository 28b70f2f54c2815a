# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How fast the diver filter is, against FilterPy with the same computation in the same run.

Times depend on the machine and its load; the ratio of two programs measured in turn hardly does.
Each round times both, one after the other, and the median of the ratios is reported. Their
estimates have to agree, which shows that both did the same work.
"""

from __future__ import annotations

from collections.abc import Sequence
import time
from typing import Any

from attrs import evolve, frozen
import numpy as np

from benchmarks.speed import Bench, seconds_of
from sonar_imm.estimation import bank
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

MODELS, STATES, STEP = 16, 4, 1.0
MANY = 20
"""Targets at once: ten divers and as many tentative tracks."""
RATIO_WANTED = 3.0
CLUTTER_WANTED_MS = 0.3

HEADINGS = DiverConfig(model_set='heading_speed')
"""The set for which these times are wanted."""


@frozen(eq=False)
class Problem:
    """Sixteen coordinated turns, position fixes: F, Q (M, 4, 4), transition (M, M), z (K, 2)."""

    F: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    transition: FloatArray
    z: FloatArray

    @property
    def moves(self) -> bank.Moves:
        """One step, the models last."""
        F, Q = (np.ascontiguousarray(np.moveaxis(part, 0, -1)) for part in (self.F, self.Q))
        return bank.Moves(F, Q, np.zeros((STATES, MODELS)))


def problem(steps: int, seed: int = 0) -> Problem:
    """A target that turns left and right. The transition matrix is not symmetric."""
    rng = np.random.default_rng(seed)
    rates = np.radians(np.linspace(-40.0, 40.0, MODELS))
    F = np.array([turn(rate) for rate in rates])
    Q = np.array([np.diag([0.05, 0.05, 0.02, 0.02]) * (1.0 + 0.1 * j) for j in range(MODELS)])
    transition = 0.8 * np.eye(MODELS) + 0.2 * rng.dirichlet(np.ones(MODELS), MODELS)
    state, z = np.array([0.0, 0.0, 1.0, 0.0]), np.empty((steps, 2))
    for k in range(steps):
        state = turn(rates[(k // 10 * 7) % MODELS]) @ state
        z[k] = state[:2] + rng.normal(0.0, 1.0, 2)
    return Problem(F, Q, np.eye(2, STATES), np.eye(2), transition, z)


def turn(rate: float) -> FloatArray:
    """(4, 4) coordinated turn over `STEP`, state px, py, vx, vy."""
    angle = rate * STEP
    s, c = np.sin(angle), np.cos(angle)
    a, b = (s / rate, (1.0 - c) / rate) if rate else (STEP, 0.0)
    return np.array([[1, 0, a, -b], [0, 1, b, a], [0, 0, c, -s], [0, 0, s, c]], float)


def run_bank(p: Problem, targets: int = 1) -> FloatArray:
    """(K, 4) estimates by our cycle in numpy, of the last of targets that do the same."""
    P = np.broadcast_to(10.0 * np.eye(STATES)[..., None], (targets, STATES, STATES, MODELS))
    block = bank.Gaussians(np.zeros((targets, STATES, MODELS)), P)
    mu = np.full((targets, MODELS), 1.0 / MODELS)
    steps, plain = p.moves, bank.Bank(np.zeros((2, MODELS)))
    row, seen, R = np.arange(targets), np.zeros(targets), np.broadcast_to(p.R, (targets, 2, 2))
    outputs = [np.repeat(np.eye(STATES)[..., None], MODELS, axis=2)]
    means = np.empty((len(p.z), STATES))
    for k, z in enumerate(p.z):
        (block,), c = bank.mix(plain, [block], mu, p.transition[None])
        block = bank.predict(block, steps)
        pairs = bank.weigh(block, row, np.tile(z, (targets, 1)), R)
        log = np.log(c) + pairs.log
        best = log.max(axis=1, keepdims=True)
        total = best + np.log(np.exp(log - best).sum(axis=1, keepdims=True))
        block, weight = bank.update(block, pairs, row, np.exp(pairs.log - total), seen)
        mu = c * weight
        means[k] = bank.combine([block], mu, outputs)[0][-1]
    return means


def run_filterpy(p: Problem) -> FloatArray:
    """(K, 4) estimates by FilterPy. Raises ModuleNotFoundError when it is not installed."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    filters = []
    for F, Q in zip(p.F, p.Q):
        kalman = KalmanFilter(dim_x=STATES, dim_z=2)
        kalman.x, kalman.P = np.zeros(STATES), 10.0 * np.eye(STATES)
        kalman.F, kalman.Q, kalman.H, kalman.R = F, Q, p.H, p.R
        filters.append(kalman)
    imm = IMMEstimator(filters, np.full(MODELS, 1.0 / MODELS), p.transition)
    means = np.empty((len(p.z), STATES))
    for k, z in enumerate(p.z):
        imm.predict()
        imm.update(z)
        means[k] = imm.x
    return means


def bench_step(rounds: int = 7, steps: int = 150) -> dict[str, Any]:
    """Microseconds of one IMM step for each target, ours of one target and of `MANY` at once and
    FilterPy's, and their ratios in paired rounds."""
    p = problem(steps)
    ours, many, theirs = run_bank(p), run_bank(p, MANY), run_filterpy(p)
    agreement = float(max(np.abs(ours - theirs).max(), np.abs(many - theirs).max()))
    runs = ((run_bank, p), (run_bank, p, MANY), (run_filterpy, p))
    times = np.array([[seconds_of(*run) for run in runs] for _ in range(rounds)]) * 1e6 / steps
    times[:, 1] /= MANY
    ratio, ratio_many = times[:, 2] / times[:, 0], times[:, 2] / times[:, 1]
    return {
        'models': MODELS,
        'states': STATES,
        'measurements': 2,
        'steps': steps,
        'rounds': rounds,
        'ours_us': float(np.median(times[:, 0])),
        'targets': MANY,
        'ours_each_us': float(np.median(times[:, 1])),
        'filterpy_us': float(np.median(times[:, 2])),
        'ratio': float(np.median(ratio)),
        'ratio_each': float(np.median(ratio_many)),
        'ratio_lowest': float(ratio.min()),
        'ratio_wanted': RATIO_WANTED,
        'largest_difference_m': agreement,
        'good': bool(np.median(ratio) >= RATIO_WANTED and agreement < 1e-9),
    }


def bench_clutter(rounds: int = 7, scans: int = 200) -> dict[str, Any]:
    """CPU milliseconds that a whole tracker takes for a scan of four divers and three false fixes
    on average, with either association in turn."""
    setting = scenario('crossing', {'duration': scans - 1.0, 'clutter': 3.0})
    scene = [item.measurement for item in simulate(setting, 0).measurements]
    configs = [
        evolve(HEADINGS, **setting.instruments(), association=association)
        for association in ('gnn', 'jipda')
    ]
    DiverTracker(configs[1]).warm()
    spent = np.array([[_cpu_of_tracking(scene, each) for each in configs] for _ in range(rounds)])
    gnn, jipda = np.median(spent, axis=0) * 1e3 / len(scene)
    return {
        'scans': len(scene),
        'fixes': sum(len(scan) for scan in scene if isinstance(scan, Fixes)),
        'rounds': rounds,
        'gnn_cpu_ms': float(gnn),
        'jipda_cpu_ms': float(jipda),
        'wanted_ms': CLUTTER_WANTED_MS,
        'good': bool(max(gnn, jipda) <= CLUTTER_WANTED_MS),
    }


def _cpu_of_tracking(items: Sequence[Any], config: DiverConfig | None = None) -> float:
    """CPU seconds of this process, all its threads, for a new tracker."""
    tracker = DiverTracker(config or HEADINGS)
    begin = time.process_time()
    for item in items:
        tracker.process(item)
    return time.process_time() - begin


BENCHES = Bench('step', bench_step), Bench('clutter', bench_clutter)
