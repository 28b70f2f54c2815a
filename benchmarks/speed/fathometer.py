# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How fast the reflector filter is: whole records of eight reflectors."""

from __future__ import annotations

from collections.abc import Mapping
import time
from typing import Any

import numpy as np

from benchmarks.speed import Bench
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.measurements import Trace
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


BENCHES = (Bench('record', lambda rounds: bench_record()),)
