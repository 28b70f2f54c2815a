# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How fast the reflector filter is, against the likelihood by least squares over the whole trace.

A particle is cheap because its likelihood needs the response at its reflectors only, O(m^2). The
textbook way fits the pulses to all N samples of the trace, O(N m^2). Both are timed in turn, and
their values have to agree.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
import time
from typing import Any

import numpy as np

from benchmarks.speed import Bench, seconds_of
from sonar_imm.acoustics.fathometer import coherence, steering
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.acoustics.spectra import outer_sum, SnapshotStream
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import CrossSpectra, Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker

REFLECTORS, PARTICLES = 8, 20_000
RECORD_WANTED_MS = 30.0
HEAVE: Mapping[str, Any] = {'polarity': 'both', 'heave': 'independent', 'array_depth_std': 0.5}
"""The dearest options: reflectors of either sign below an array whose told depth is half a metre
wrong."""
SAMPLES, STEP = 1600, 0.03125
FIRST_STAMP_NS, RECORD_NS = 1_700_000_000_000_000_000, 90 * 10**9


def trace(record: int, rng: np.random.Generator) -> Trace:
    """Eight reflectors four metres apart that wander a little, in noise of the same band."""
    depth = 122.0 + STEP * np.arange(SAMPLES)
    pulse = band_pulse(50.0, 4000.0, 1500.0)
    places = 130.0 + 4.0 * np.arange(REFLECTORS) + 0.02 * rng.standard_normal(REFLECTORS)
    white, lags = rng.standard_normal(2 * SAMPLES), np.asarray(STEP * np.arange(-32, 33))
    noise = np.convolve(white, np.asarray(pulse(lags)), mode='same')
    noise = noise[:SAMPLES] / noise.std()
    amplitude = pulse(depth[:, None] - places) @ np.linspace(25.0, 8.0, REFLECTORS) + noise
    return Trace(
        stamp_ns=FIRST_STAMP_NS + record * RECORD_NS,
        depth=depth,
        amplitude=amplitude,
        sigma=np.ones(SAMPLES),
    )


def bench_record(records: int = 12) -> dict[str, Any]:
    """Milliseconds of processor time for one record, at the defaults and with `HEAVE`, turn by
    turn."""
    cases: dict[str, Mapping[str, Any]] = {'defaults': {}, 'both and heave': HEAVE}
    rngs = {name: np.random.default_rng(0) for name in cases}
    trackers = {
        name: FathometerTracker(FathometerConfig(particles=PARTICLES, **options))
        for name, options in cases.items()
    }
    times: dict[str, list[float]] = {name: [] for name in cases}
    orders: dict[str, int] = {}
    for record in range(records + 3):
        for name, tracker in trackers.items():
            record_trace = trace(record, rngs[name])
            begin = time.process_time()
            estimates = tracker.process(record_trace)
            times[name].append(1e3 * (time.process_time() - begin))
            likely = int(np.argmax(estimates[-1].probabilities[0]))
            orders[name] = likely + tracker.config.order_min
    median = {name: float(np.median(each[3:])) for name, each in times.items()}
    return {
        'particles': PARTICLES,
        'reflectors': orders,
        'records': records,
        'median_ms': median,
        'worst_ms': {name: float(np.max(each[3:])) for name, each in times.items()},
        'us_a_particle': 1e3 * median['defaults'] / PARTICLES,
        'wanted_ms': RECORD_WANTED_MS,
        'good': max(median.values()) <= RECORD_WANTED_MS and set(orders.values()) == {REFLECTORS},
    }


def bench_array(
    rounds: int = 7, snapshots: int = 64, length: int = 16_800, hydrophones: int = 32
) -> dict[str, Any]:
    """Milliseconds from pressure to depth responses, for `snapshots` of `length` samples (90 s of
    a real array): transforms, cross-spectra, the checks of their measurement, the processors."""
    rng = np.random.default_rng(0)
    blocks = rng.standard_normal((snapshots, length, hydrophones), np.float32)
    band = slice(length // 240, length // 3)

    def transform() -> np.ndarray:
        stream = SnapshotStream(length, length, band)
        return np.concatenate([stream.push(block) for block in blocks])

    spectra = transform()
    R = outer_sum(spectra) / np.float32(snapshots)
    frequency = np.arange(band.start, band.stop) / 1.4
    w = steering(frequency, 0.18 * np.arange(hydrophones), 1500.0)
    works: dict[str, Callable[[], Any]] = {
        'transforms': transform,
        'cross-spectra': lambda: outer_sum(spectra),
        'their checks': lambda: CrossSpectra(stamp_ns=1, frequency=frequency, csdm=R),
        **{name: partial(coherence, R, w, name) for name in ('conventional', 'mvdr')},
    }
    times = {
        name: float(np.median([seconds_of(work) for _ in range(min(rounds, 3))]))
        for name, work in works.items()
    }
    times['white_noise'] = seconds_of(coherence, R, w, 'white_noise')
    return {'snapshots': snapshots, 'ms': {name: 1e3 * spent for name, spent in times.items()}}


def bench_likelihood(rounds: int = 7, sets: int = 100) -> dict[str, Any]:
    """Microseconds of the log likelihood ratio of one set of eight reflectors, in plain numpy:
    from G and b at their depths, and by least squares over the trace. Also those of a whole
    particle of the tracker."""
    rng = np.random.default_rng(1)
    lattice = np.asarray(STEP * np.arange(SAMPLES))
    pulse = band_pulse(50.0, 4000.0, 1500.0)
    shapes = whitened_pulses(pulse, lattice)
    x = rng.standard_normal(len(shapes))
    b = shapes.T @ x
    gram = shapes.T @ shapes
    places = np.sort(rng.permuted(np.tile(np.arange(20, 1580, 24), (sets, 1)), axis=1)[:, :8])
    short, full = _by_gram(b, gram, places), _by_least_squares(x, shapes, places)
    pairs = np.array(
        [
            [
                seconds_of(_by_gram, b, gram, places),
                seconds_of(_by_least_squares, x, shapes, places),
            ]
            for _ in range(rounds)
        ]
    )
    us = pairs / sets * 1e6
    particle = bench_record(4)['us_a_particle']
    return {
        'sets': sets,
        'samples': len(x),
        'rounds': rounds,
        'gram_numpy_us': float(np.median(us[:, 0])),
        'least_squares_numpy_us': float(np.median(us[:, 1])),
        'particle_us': particle,
        'ratio': float(np.median(us[:, 1])) / particle,
        'largest_relative_difference': float(np.abs(short / full - 1.0).max()),
        'good': bool(np.allclose(short, full, rtol=1e-6)),
    }


def whitened_pulses(pulse: Any, lattice: FloatArray) -> FloatArray:
    """Signature of each depth in the data before they are correlated with the pulse, one column
    per depth: the square root of the pulse's spectrum, so that the Gram matrix is that of the
    pulse."""
    length, step = len(lattice), float(lattice[1] - lattice[0])
    size = length + 200  # a circle with some room between its ends
    lags = step * np.minimum(np.arange(size), size - np.arange(size))
    spectrum = np.fft.rfft(pulse(lags)).real.clip(min=0.0)
    half = np.fft.irfft(np.sqrt(spectrum), size)
    index = (np.arange(size)[:, None] - np.arange(length)[None, :]) % size
    return np.ascontiguousarray(half[index])


def _by_gram(b: FloatArray, gram: FloatArray, places: np.ndarray) -> FloatArray:
    """b^T G^-1 b / 2 of each set."""
    values = np.empty(len(places))
    for k, z in enumerate(places):
        values[k] = 0.5 * b[z] @ np.linalg.solve(gram[np.ix_(z, z)], b[z])
    return values


def _by_least_squares(x: FloatArray, shapes: FloatArray, places: np.ndarray) -> FloatArray:
    """Half of the decrease of the residual sum of squares by fitting each set to all samples."""
    values = np.empty(len(places))
    for k, z in enumerate(places):
        A = shapes[:, z]
        fit = A @ np.linalg.lstsq(A, x, rcond=None)[0]
        values[k] = 0.5 * (x @ x - np.sum(np.square(x - fit)))
    return values


def _record_sentence(result: Mapping[str, Any]) -> str:
    each = ', '.join(
        f'{name} {median:.1f} ms (worst {result["worst_ms"][name]:.1f} ms)'
        for name, median in result['median_ms'].items()
    )
    return (
        f'a record, {result["particles"]} particles, {result["reflectors"]["defaults"]} '
        f'reflectors: {each}; wanted: at most {result["wanted_ms"]:g} ms'
    )


def _likelihood_sentence(result: Mapping[str, Any]) -> str:
    return (
        f'likelihood of 8 reflectors: numpy over {result["samples"]} samples '
        f'{result["least_squares_numpy_us"]:.0f} us, numpy at the reflectors '
        f'{result["gram_numpy_us"]:.1f} us, a whole particle of the tracker '
        f'{result["particle_us"]:.2f} us: {result["ratio"]:.0f} times less than the first'
    )


def _array_sentence(result: Mapping[str, Any]) -> str:
    each = ', '.join(f'{name} {spent:,.0f} ms' for name, spent in result['ms'].items())
    return f'{result["snapshots"]} snapshots of 32 hydrophones: {each}'


BENCHES = (
    Bench('record', lambda rounds: bench_record(), _record_sentence),
    Bench('likelihood', bench_likelihood, _likelihood_sentence),
    Bench('array', bench_array, _array_sentence),
)
