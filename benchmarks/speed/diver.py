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

from collections.abc import Mapping, Sequence
import time
from typing import Any

from attrs import evolve, frozen
import numpy as np

from benchmarks.speed import Bench, seconds_of
from sonar_imm.estimation import bank, imm
from sonar_imm.estimation.arrays import FloatArray, IndexArray
from sonar_imm.estimation.association import assign, association_cost, gate_threshold
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

MODELS, STATES, STEP = 16, 4, 1.0
MANY = 20
"""Targets at once: ten divers and as many tentative tracks."""
RATIO_WANTED = 3.0
SCAN_WANTED_MS = 100.0
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
    block, mu = started(np.zeros((targets, STATES)), 10.0)
    steps, plain = p.moves, bank.Bank(np.zeros((2, MODELS)))
    row, seen = np.arange(targets), np.zeros(targets)
    outputs = [np.repeat(np.eye(STATES)[..., None], MODELS, axis=2)]
    means = np.empty((len(p.z), STATES))
    for k, z in enumerate(p.z):
        (block,), c = bank.mix(plain, [block], mu, p.transition[None])
        block = bank.predict(block, steps)
        block, mu = updated(block, c, row, np.tile(z, (targets, 1)), p.R, seen)
        means[k] = bank.combine([block], mu, outputs)[0][-1]
    return means


def started(x: FloatArray, variance: float) -> tuple[bank.Gaussians, FloatArray]:
    """Targets at x (T, 4) under all models alike, and their model probabilities (T, M)."""
    P = np.broadcast_to(variance * np.eye(STATES)[..., None], (len(x), STATES, STATES, MODELS))
    block = bank.Gaussians(np.repeat(x[..., None], MODELS, axis=2), P)
    return block, np.full((len(x), MODELS), 1.0 / MODELS)


def updated(
    block: bank.Gaussians,
    c: FloatArray,
    row: IndexArray,
    z: FloatArray,
    R: FloatArray,
    missed: FloatArray,
) -> tuple[bank.Gaussians, FloatArray]:
    """Update the targets `row` (p,) by fixes z (p, 2); missed (T,) is 1 for the others."""
    pairs = bank.weigh(block, row, z, np.broadcast_to(R, (len(row), 2, 2)))
    log = np.log(c[row]) + pairs.log
    best = log.max(axis=1, keepdims=True)
    total = best + np.log(np.exp(log - best).sum(axis=1, keepdims=True))
    block, weight = bank.update(block, pairs, row, np.exp(pairs.log - total), missed)
    return block, c * weight


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


def bench_scan(targets: int = 1000, scans: int = 20) -> dict[str, Any]:
    """Milliseconds of a whole scan: mix, predict, gate, assign, update, combine."""
    p = problem(1)
    rng = np.random.default_rng(1)
    side = 20.0 * np.sqrt(targets)
    x = np.zeros((targets, STATES))
    x[:, :2] = rng.uniform(0.0, side, (targets, 2))
    block, mu = started(x, 1.0)
    times, hits = [], []
    for _ in range(scans + 1):
        z = block.x[:, :2, 0] + rng.normal(0.0, 1.0, (targets, 2))
        begin = time.perf_counter()
        block, mu, hit = _scan(p, block, mu, z)
        times.append(1e3 * (time.perf_counter() - begin))
        hits.append(hit / targets)
    median = float(np.median(times[1:]))
    return {
        'targets': targets,
        'scans': scans,
        'median_ms': median,
        'worst_ms': float(np.max(times[1:])),
        'assigned': float(np.mean(hits)),
        'wanted_ms': SCAN_WANTED_MS,
        'good': median <= SCAN_WANTED_MS,
    }


def _scan(
    p: Problem, block: bank.Gaussians, mu: FloatArray, z: FloatArray
) -> tuple[bank.Gaussians, FloatArray, int]:
    """One scan of many targets, and how many of them were hit."""
    targets = len(mu)
    (block,), c = bank.mix(bank.Bank(np.zeros((2, MODELS))), [block], mu, p.transition[None])
    block = bank.predict(block, p.moves)
    expected, P = np.moveaxis(block.x[:, :2], -1, 1), np.moveaxis(block.P, -1, 1)
    H, R = np.tile(p.H, (1, MODELS, 1, 1)), np.tile(p.R, (len(z), 1, 1))
    fit = imm.gate(expected, H, P, c, z, R, gate_threshold(0.999, 2))
    target, detection = imm.pairs_inside(fit)
    cost = association_cost(fit[target, detection], 0.95, 1e-4)
    chosen = assign(target, detection, cost, targets, len(z))
    hit = np.flatnonzero(chosen >= 0)
    block, mu = updated(block, c, hit, z[chosen[hit]], p.R, (chosen < 0).astype(np.float64))
    bank.combine([block], mu, [np.repeat(np.eye(STATES)[..., None], MODELS, axis=2)])
    return block, mu, len(hit)


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


def _step_sentence(step: Mapping[str, Any]) -> str:
    return (
        f'IMM step, {step["models"]} models, {step["states"]} states, {step["measurements"]} '
        f'measurements: {step["ours_us"]:.0f} us, FilterPy {step["filterpy_us"]:.0f} us: '
        f'{step["ratio"]:.1f} times as fast (wanted {step["ratio_wanted"]:.0f}; lowest of '
        f'{step["rounds"]} paired rounds {step["ratio_lowest"]:.1f}); of {step["targets"]} '
        f'targets at once {step["ours_each_us"]:.0f} us each: {step["ratio_each"]:.0f} times as '
        f'fast; the estimates agree to {step["largest_difference_m"]:.0e} m'
    )


def _scan_sentence(scan: Mapping[str, Any]) -> str:
    return (
        f'scan of {scan["targets"]} targets with gating and assignment: median '
        f'{scan["median_ms"]:.1f} ms (wanted {scan["wanted_ms"]:.0f}), worst of '
        f'{scan["scans"]} {scan["worst_ms"]:.1f} ms'
    )


def _clutter_sentence(clutter: Mapping[str, Any]) -> str:
    return (
        f'tracker, CPU for a scan of 4 divers and 3 false fixes: {clutter["gnn_cpu_ms"]:.2f} ms '
        f'with gnn, {clutter["jipda_cpu_ms"]:.2f} ms with jipda (wanted '
        f'{clutter["wanted_ms"]:.1f}; median of {clutter["rounds"]} rounds)'
    )


BENCHES = (
    Bench('step', bench_step, _step_sentence),
    Bench('scan', lambda rounds: bench_scan(), _scan_sentence),
    Bench('clutter', bench_clutter, _clutter_sentence),
)
