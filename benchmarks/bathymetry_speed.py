"""Speed of the bathymetry tracker beside a plain numpy filter and Stone Soup, in one run.

    python -m benchmarks.bathymetry_speed --out docs/results/bathymetry_speed.json

All peers see the same complex64 snapshots of the paper's scene, with two random walks, and are
timed in turn, round after round, on one core; the best round counts, as the one least disturbed.
`process` is the whole tracker: variances, coherence gate, filter and estimate. The numpy filter is
written as one would: all particles of a model at once, one bin after the other. Stone Soup's
multi-model particle filter is not the same algorithm (one set of particles that carry their
model), has the same law and as many particles in all, and is timed on fewer bins.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta
import json
import math
from pathlib import Path
import time

import numpy as np
from scipy.special import kve

from sonar_imm.acoustics.laplace import autocorrelation
from sonar_imm.measurements import Snapshot
from sonar_imm.simulation.bathymetry import scenario, simulate
from sonar_imm.trackers.bathymetry import BathymetryConfig, BathymetryTracker

CHAIN = np.array([[0.98, 0.02], [0.02, 0.98]])
SIGMAS = (0.01, 1.0)
HEIGHT, TILT, SPACING = 15.0, math.radians(30.0), 0.5
PEER_BINS = 400
GOAL, GOAL_RATIO = 80_000, 30


def config(**values) -> BathymetryConfig:
    defaults = {'sigmas': SIGMAS, 'initial_std': 1.0, 'transition_matrix': tuple(CHAIN.ravel())}
    return BathymetryConfig(**{**defaults, **values})


class NumpyLaw:
    """The Laplace law of all bins of a ping over heights."""

    def __init__(self, ping: Snapshot):
        self.range, self.P = ping.range, ping.staves
        power = (np.abs(ping.iq) ** 2).mean(axis=1)
        window = np.ones(21)
        level = np.convolve(power, window, 'same') / np.convolve(power**0, window, 'same')
        rho = np.maximum(level - 1.0, 0.01)
        self.c = autocorrelation(ping.iq)
        self.kappa = rho / (1.0 + self.P * rho)

    def log_density(self, t: int, height: np.ndarray) -> np.ndarray:
        ratio = (HEIGHT - height) / self.range[t]
        with np.errstate(invalid='ignore'):
            u = ratio * math.cos(TILT) - np.sqrt(1.0 - ratio**2) * math.sin(TILT)
        waves = np.exp(-2j * math.pi * SPACING * u[..., None] * np.arange(1, self.P))
        beam = self.c[t, 0].real + 2.0 * (waves @ self.c[t, 1:]).real
        v = np.sqrt(np.maximum(self.c[t, 0].real - self.kappa[t] * beam, 1e-12))
        log_q = np.log(kve(self.P - 1, 2.0 * v)) - 2.0 * v - (self.P - 1) * np.log(v)
        return np.where(np.isnan(u), -np.inf, log_q)


def numpy_filter(ping: Snapshot, particles: int = 100, seed: int = 0) -> np.ndarray:
    """Mean height (T,) by the IMM particle filter, one bin after the other."""
    law, rng, N = NumpyLaw(ping), np.random.default_rng(seed), particles
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
        log_q = law.log_density(t, x)
        q = np.exp(log_q - log_q.max())
        total = q.sum(axis=1)
        w = q / np.maximum(total, 1e-300)[:, None]
        mu = c * total
        mu /= mu.sum()
        mean[t] = mu @ (w * x).sum(axis=1)
    return mean


def stone_soup_filter(ping: Snapshot, particles: int = 200) -> np.ndarray:
    """Mean height (T,) by Stone Soup's multi-model particle filter."""
    from stonesoup.base import Property
    from stonesoup.models.measurement.base import MeasurementModel
    from stonesoup.models.transition.linear import RandomWalk
    from stonesoup.predictor.particle import MultiModelPredictor
    from stonesoup.resampler.particle import SystematicResampler
    from stonesoup.types.array import StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import MultiModelParticleState
    from stonesoup.updater.particle import MultiModelParticleUpdater

    class Law(MeasurementModel):
        """A detection is the number of its bin; the law knows the samples."""

        law: NumpyLaw = Property()
        ndim_meas = 1

        def function(self, state, noise=False, **kwargs):
            raise NotImplementedError

        def rvs(self, num_samples=1, **kwargs):
            raise NotImplementedError

        def pdf(self, state1, state2, **kwargs):
            return np.exp(self.logpdf(state1, state2))

        def logpdf(self, state1, state2, **kwargs):
            heights = np.asarray(state2.state_vector[0, :], np.float64)
            return self.law.log_density(int(state1.state_vector[0, 0]), heights)

    # Stone Soup scales the variance with the time step, which is one second here.
    predictor = MultiModelPredictor([RandomWalk(sigma**2) for sigma in SIGMAS], CHAIN, [[0], [0]])
    law = Law(ndim_state=1, mapping=(0,), law=NumpyLaw(ping))
    updater = MultiModelParticleUpdater(law, predictor, SystematicResampler())
    np.random.seed(0)
    start = datetime(2026, 1, 1)
    state = MultiModelParticleState(
        StateVectors(np.random.normal(size=(1, particles))),
        weight=np.full(particles, 1.0 / particles),
        dynamic_model=np.random.randint(0, 2, particles),
        timestamp=start,
    )
    mean = np.empty(len(ping))
    for t in range(len(ping)):
        stamp = start + timedelta(seconds=t + 1)
        prediction = predictor.predict(state, timestamp=stamp)
        detection = Detection([t], timestamp=stamp)
        state = updater.update(SingleHypothesis(prediction, detection))
        mean[t] = float(np.mean(state.state_vector[0, :]))
        state.hypothesis = None
        state.parent = None
    return mean


def cut(ping: Snapshot, bins: int) -> Snapshot:
    return Snapshot(
        stamp_ns=ping.stamp_ns,
        range=ping.range[:bins],
        iq=ping.iq[:bins],
        noise_variance=np.ones(min(bins, len(ping))),
    )


def rates(methods: dict, rounds: int) -> dict[str, float]:
    """Bins a second of each method, the best of `rounds` rounds in turn; `methods` maps a name to
    (callable, bins)."""
    best = dict.fromkeys(methods, math.inf)
    for run, _ in methods.values():
        run()
    for _ in range(rounds):
        for name, (run, _) in methods.items():
            begin = time.perf_counter()
            run()
            best[name] = min(best[name], time.perf_counter() - begin)
    return {name: bins / best[name] for name, (_, bins) in methods.items()}


def peers(ping: Snapshot, rounds: int) -> dict[str, float]:
    particles, gated, grid = (
        BathymetryTracker(config(**values))
        for values in ({'shadow_gate': False}, {}, {'engine': 'grid', 'shadow_gate': False})
    )
    short, bins = cut(ping, PEER_BINS), len(ping)
    methods = {
        'particles': (lambda: particles.process(ping), bins),
        'particles, coherence gate': (lambda: gated.process(ping), bins),
        'grid': (lambda: grid.process(ping), bins),
        'numpy': (lambda: numpy_filter(short), PEER_BINS),
    }
    try:
        stone_soup_filter(cut(ping, 3))
        methods['Stone Soup'] = (lambda: stone_soup_filter(short), PEER_BINS)
    except ImportError:
        print('Stone Soup is not installed; it is left out')
    return rates(methods, rounds)


def scaling(ping: Snapshot, rounds: int) -> dict[str, float]:
    """Bins a second with more models, more particles, more staves, and pings in parallel."""
    methods = {}
    for M in (1, 2, 4, 8):
        values = {'model_set': 'height_bank', 'sigmas': tuple(np.geomspace(0.01, 1.0, M).tolist())}
        methods[f'M = {M}'] = values, ping
    for N in (50, 100, 300, 1000):
        methods[f'N = {N}'] = {'sigmas': SIGMAS, 'particles_per_model': N}, ping
    for P in (2, 4, 8, 16, 32):
        scene = simulate(scenario('paper', {'pings': 1, 'staves': P}), 1)
        methods[f'P = {P}'] = {'sigmas': SIGMAS}, scene.measurements[0].measurement
    trackers = {
        name: (BathymetryTracker(BathymetryConfig(shadow_gate=False, **values)), snapshot)
        for name, (values, snapshot) in methods.items()
    }
    return rates(
        {
            name: (lambda t=tracker, s=snapshot: t.process(s), len(snapshot))
            for name, (tracker, snapshot) in trackers.items()
        },
        rounds,
    )


def in_parallel(ping: Snapshot, threads: int, pings: int = 32) -> float:
    """Bins a second of several trackers in threads: the kernels release Python's lock."""
    trackers = [BathymetryTracker(config(shadow_gate=False)) for _ in range(threads)]

    def work(tracker: BathymetryTracker) -> None:
        for _ in range(pings):
            tracker.process(ping)

    with ThreadPoolExecutor(threads) as pool:
        begin = time.perf_counter()
        list(pool.map(work, trackers))
        return threads * pings * len(ping) / (time.perf_counter() - begin)


def agreement(ping: Snapshot) -> float:
    """RMS difference, metres, between the numpy filter and the tracker: they are one filter."""
    short = cut(ping, PEER_BINS)
    mine = BathymetryTracker(config(shadow_gate=False)).process(short)[0].state[:, 0]
    return float(np.sqrt(np.mean(np.square(mine - numpy_filter(short)))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--threads', type=int, default=1, help='also this many pings at a time')
    parser.add_argument('--out', type=Path, help='write the numbers here, as JSON')
    options = parser.parse_args()
    ping = simulate(scenario('paper', {'pings': 1, 'last_range': 117.0}), 1).measurements[0]
    ping = ping.measurement
    result = {
        'bins_per_second': peers(ping, options.rounds),
        'scaling': scaling(ping, options.rounds),
        'rms_difference_to_numpy_m': agreement(ping),
    }
    if options.threads > 1:
        result['threads'] = {
            str(count): in_parallel(ping, count) for count in (1, options.threads)
        }
    speed = result['bins_per_second']
    result['times_numpy'] = speed['particles'] / speed['numpy']
    for name, value in {**speed, **result['scaling']}.items():
        print(f'{name:28}{value:12,.0f} bins/s')
    for count, value in result.get('threads', {}).items():
        print(f'{count + " threads":28}{value:12,.0f} bins/s')
    fast = speed['particles'] >= GOAL and result['times_numpy'] >= GOAL_RATIO
    print(
        f'{result["times_numpy"]:.0f} times numpy (goal {GOAL_RATIO}; and {GOAL:,} bins/s): '
        f'{"reached" if fast else "missed"}'
    )
    if options.out:
        options.out.write_text(json.dumps(result, indent=2) + '\n')


if __name__ == '__main__':
    main()
