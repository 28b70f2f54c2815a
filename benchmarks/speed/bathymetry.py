# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How fast the bathymetry tracker is, against the same filter in plain numpy on the same pings.

Both take the complex64 snapshots of the paper's scene and are timed in turn, round after round.
The best round counts, because it is the least disturbed one. Of the tracker the whole of `process`
is timed: variances, filter and estimate. `numpy_filter` runs all particles of a model at once, one
bin after the other; it supposes the scene of the paper, two random walks and noise of unit
variance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any

import numpy as np
from scipy.special import kve

from benchmarks.bathymetry_paper import WALKS
from benchmarks.speed import Bench, seconds_of
from sonar_imm.acoustics.laplace import autocorrelation
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

PEER_BINS = 400
GOAL, GOAL_RATIO = 80_000, 30

Timed = tuple[Callable[[], Any], int]

CHAIN = np.array([[0.98, 0.02], [0.02, 0.98]])
SIGMAS = (0.01, 1.0)
HEIGHT, TILT, SPACING = 15.0, math.radians(30.0), 0.5


def config(**values: Any) -> BathymetryConfig:
    """Parameters with which the tracker computes what the peers compute."""
    defaults = {
        **WALKS,
        'sigmas': SIGMAS,
        'initial_std': 1.0,
        'transition_matrix': tuple(CHAIN.ravel()),
    }
    return BathymetryConfig(**{**defaults, **values})


class NumpyLikelihood:
    """Log likelihood of heights for every bin of a ping, complex Laplace, without constants."""

    def __init__(self, ping: Snapshot):
        self.range, self.P = ping.range, ping.staves
        power = (np.abs(ping.iq) ** 2).mean(axis=1)
        window = np.ones(21)
        level = np.convolve(power, window, 'same') / np.convolve(power**0, window, 'same')
        rho = np.maximum(level - 1.0, 0.01)
        self.c = autocorrelation(ping.iq)
        self.kappa = rho / (1.0 + self.P * rho)

    def log_likelihood(self, t: int, height: FloatArray) -> FloatArray:
        ratio = (HEIGHT - height) / self.range[t]
        with np.errstate(invalid='ignore'):
            u = ratio * math.cos(TILT) - np.sqrt(1.0 - ratio**2) * math.sin(TILT)
        waves = np.exp(-2j * math.pi * SPACING * u[..., None] * np.arange(1, self.P))
        beam = self.c[t, 0].real + 2.0 * (waves @ self.c[t, 1:]).real
        v = np.sqrt(np.maximum(self.c[t, 0].real - self.kappa[t] * beam, 1e-12))
        log_q = np.log(kve(self.P - 1, 2.0 * v)) - 2.0 * v - (self.P - 1) * np.log(v)
        return np.where(np.isnan(u), -np.inf, log_q)


def numpy_filter(ping: Snapshot, particles: int = 100, seed: int = 0) -> FloatArray:
    """Mean height (T,) by the IMM particle filter, one bin after the other."""
    likelihood, rng, N = NumpyLikelihood(ping), np.random.default_rng(seed), particles
    x, w = rng.normal(size=(2, N)), np.full((2, N), 1.0 / N)
    mu, sigma = np.array([0.5, 0.5]), np.array(SIGMAS)[:, None]
    mean = np.empty(len(ping))
    for t in range(len(ping)):
        joint = CHAIN * mu[:, None]
        c = joint.sum(axis=0)
        points = (np.arange(N) + rng.random((2, 1))) / N
        drawn = np.empty_like(x)
        for j in range(2):
            cumulative = np.cumsum(joint[:, j, None] * w)
            index = np.searchsorted(cumulative, points[j] * cumulative[-1])
            drawn[j] = x.ravel()[np.minimum(index, 2 * N - 1)]
        x = drawn + sigma * rng.standard_normal((2, N))
        log_q = likelihood.log_likelihood(t, x)
        q = np.exp(log_q - log_q.max())
        total = q.sum(axis=1)
        w = q / np.maximum(total, 1e-300)[:, None]
        mu = c * total
        mu /= mu.sum()
        mean[t] = mu @ (w * x).sum(axis=1)
    return mean


def cut(ping: Snapshot, bins: int) -> Snapshot:
    """The first `bins` bins of a ping."""
    return Snapshot(
        stamp_ns=ping.stamp_ns,
        range=ping.range[:bins],
        iq=ping.iq[:bins],
        noise_variance=np.ones(min(bins, len(ping))),
    )


def a_ping(**values: Any) -> Snapshot:
    """One ping of the paper's scene, longer: 2000 bins."""
    scene = simulate(scenario('paper', {'pings': 1, 'last_range': 117.0, **values}), 1)
    ping: Snapshot = scene.measurements[0].measurement
    return ping


def rates(methods: Mapping[str, Timed], rounds: int) -> dict[str, float]:
    """Bins per second of each method in the best of `rounds` rounds. `methods` maps a name to a
    function and the number of bins that it processes."""
    best = dict.fromkeys(methods, math.inf)
    for run, _ in methods.values():
        run()
    for _ in range(rounds):
        for name, (run, _) in methods.items():
            best[name] = min(best[name], seconds_of(run))
    return {name: bins / best[name] for name, (_, bins) in methods.items()}


def engines(ping: Snapshot) -> dict[str, Timed]:
    """The tracker with the settings of the peers, and with its coherence gate."""
    variants: dict[str, dict[str, Any]] = {
        'particles': {'gate_false_alarm': 1.0},
        'gated': {},
    }
    trackers = {name: BathymetryTracker(config(**values)) for name, values in variants.items()}
    return {
        name: (lambda tracker=tracker: tracker.process(ping), len(ping))  # type: ignore[misc]
        for name, tracker in trackers.items()
    }


def bench_numpy(rounds: int = 7) -> dict[str, Any]:
    """Bins per second of the tracker and of the same filter in plain numpy. Their estimates may
    differ by no more than Monte Carlo noise."""
    ping = a_ping()
    short = cut(ping, PEER_BINS)
    peer: Timed = (lambda: numpy_filter(short), PEER_BINS)
    speed = rates({**engines(ping), 'numpy': peer}, rounds)
    ratio = speed['particles'] / speed['numpy']
    apart = float(np.sqrt(np.mean(np.square(_heights(short) - numpy_filter(short)))))
    return {
        'bins_per_second': speed,
        'ratio': ratio,
        'ratio_wanted': GOAL_RATIO,
        'wanted': GOAL,
        'rms_difference_m': apart,
        'good': ratio >= GOAL_RATIO and speed['particles'] >= GOAL,
    }


def _heights(ping: Snapshot) -> np.ndarray:
    tracker = BathymetryTracker(config(gate_false_alarm=1.0))
    return tracker.process(ping)[0].state[:, 0]


BENCHES = (Bench('numpy', bench_numpy),)
