"""How long a record takes, beside the likelihood on the whole record in plain numpy.

    python -m benchmarks.fathometer_speed

Each number is the median over repetitions, all in one run on one machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
import time

import numpy as np

from benchmarks.tables import write_json
from sonar_imm.acoustics.fathometer import coherence, steering
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.acoustics.spectra import outer_sum, SnapshotStream
from sonar_imm.measurements import CrossSpectra
from sonar_imm.simulation.fathometer.simulator import FathometerScenario, simulate
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker


def median_seconds(work: Callable[[], object], repetitions: int) -> float:
    spent = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begin)
    return float(np.median(spent))


def tracking(particles: int, threads: int, records: int = 40) -> tuple[float, bytes]:
    """Seconds a record with 8 reflectors, and all states, to compare."""
    scene = simulate(
        FathometerScenario(level='trace', records=records, appearing=(), fading=()), 0
    )
    tracker = FathometerTracker(FathometerConfig(particles=particles, threads=threads))
    tracker.warm()
    spent, states = [], []
    for one in scene.measurements:
        begin = time.perf_counter()
        estimates = tracker.process(one.measurement)
        spent.append(time.perf_counter() - begin)
        states += [each.state.tobytes() + each.probabilities.tobytes() for each in estimates]
    return float(np.median(spent)), b''.join(states)


def whole_record_likelihood(particles: int = 200) -> float:
    """Seconds a particle of 8 reflectors, by least squares on all 1600 samples."""
    depth = 122.0 + np.arange(1600) / 32.0
    rng = np.random.default_rng(0)
    pulse, y = band_pulse(50.0, 4000.0, 1500.0), rng.standard_normal(1600)
    places = np.sort(rng.uniform(122.0, 172.0, (particles, 8)), axis=1)

    def work() -> float:
        total = 0.0
        for z in places:
            A = pulse(depth[:, None] - z)
            a = np.linalg.solve(A.T @ A, A.T @ y)
            residual = y - A @ a
            total += 0.5 * float(y @ y - residual @ residual)
        return total

    return median_seconds(work, 3) / particles


def covariance(repetitions: int) -> dict[str, float]:
    """Seconds for 90 s of pressure: transforms, outer products, processors."""
    rng = np.random.default_rng(0)
    blocks = rng.standard_normal((64, 16800, 32), np.float32)

    def transform() -> np.ndarray:
        stream = SnapshotStream(16800, 16800, slice(70, 5601))
        return np.concatenate([stream.push(block) for block in blocks])

    spectra = transform()
    R = outer_sum(spectra) / np.float32(64)
    frequency = np.arange(70, 5601) / 1.4
    w = steering(frequency, 0.18 * np.arange(32), 1500.0)
    return {
        'transforms of 64 snapshots': median_seconds(transform, repetitions),
        'covariance, matrix products': median_seconds(lambda: outer_sum(spectra), repetitions),
        'checks of the cross-spectra': median_seconds(
            lambda: CrossSpectra(stamp_ns=1, frequency=frequency, csdm=R), repetitions
        ),
        'conventional': median_seconds(lambda: coherence(R, w, 'conventional'), repetitions),
        'MVDR': median_seconds(lambda: coherence(R, w, 'mvdr'), repetitions),
        'white noise': median_seconds(lambda: coherence(R, w, 'white_noise'), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--repetitions', type=int, default=3)
    parser.add_argument('--out', type=Path, help='write the numbers as JSON')
    options = parser.parse_args()
    seconds = covariance(options.repetitions)
    one, states = tracking(20_000, 1)
    four, same = tracking(20_000, 4)
    seconds |= {
        '20,000 particles, 8 reflectors': one,
        'the same on 4 threads': four,
        '2,000 particles': tracking(2_000, 1)[0],
        'a particle': one / 20_000,
        'a particle, least squares on all samples (numpy)': whole_record_likelihood(),
    }
    for name, value in seconds.items():
        print(f'{name:50s} {1e3 * value:12.4f} ms')
    print(f'the same bytes on 1 and 4 threads: {states == same}')
    write_json(options.out, {'seconds': seconds, 'same_bytes': states == same})


if __name__ == '__main__':
    main()
