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
import json
from pathlib import Path
import time

import numpy as np

from sonar_imm.evaluation.bathymetry.bench import (
    a_ping,
    engines,
    GOAL,
    GOAL_RATIO,
    PEER_BINS,
    rates,
)
from sonar_imm.evaluation.bathymetry.peers import (
    config,
    cut,
    numpy_filter,
    SIGMAS,
    stone_soup_filter,
)
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker


def peers(ping: Snapshot, rounds: int) -> dict[str, float]:
    short = cut(ping, PEER_BINS)
    methods = {**engines(ping), 'numpy': (lambda: numpy_filter(short), PEER_BINS)}
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
        methods[f'P = {P}'] = {'sigmas': SIGMAS}, a_ping(staves=P)
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
    ping = a_ping()
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
