# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Lines of a profiler: envelopes of a Gaussian pulse in complex noise, with a floor at about 10 m
and two reflectors below it; and real lines as two, of even and odd traces."""

import numpy as np

from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.tracker import FathometerTracker
from sonar_imm.trackers.fathometer.water import Water
from sonar_imm_tools.recordings.segy_lines import read_segy

STEP, SAMPLES, PULSE, SETTLED = 0.05, 400, 0.15, 10
LINES = {
    'flat': {},
    'silent water': {'noise': 0.002, 'threshold': 0.02},
    'scatter': {'scatter': 0.3},
    'transmit pulse': {'ring': 1.5},
    'waves': {'waves': 2.5},
}


def line(
    seed, *, records=120, noise=0.02, threshold=0.0, scatter=0.0, ring=0.0, waves=0.0, fixed=0.0
):
    """Traces of a line, and the depth of its floor (T,), m. threshold: below which nothing is
    written; scatter: rms below the floor, falling over 1.5 m; ring: m of transmit pulse; waves:
    amplitude, m, in 25 records; fixed: amplitude of an echo at 4 m."""
    rng, depth = np.random.default_rng(seed), STEP * np.arange(SAMPLES)
    record = np.arange(records)
    below = 10.0 + 0.3 * np.sin(record / 19.0) + waves * np.sin(2.0 * np.pi * record / 25.0)
    traces = []

    def echo(place, amplitude):
        phase = np.exp(2j * np.pi * rng.random())
        return amplitude * phase * np.exp(-0.5 * np.square((depth - place) / PULSE))

    def noise_of(rms):
        return rms * rng.standard_normal((SAMPLES, 2)) @ [1.0, 1j] / np.sqrt(2.0)

    for k, z in enumerate(below):
        field = noise_of(noise) + echo(z, 1.0) + echo(z + 3.0, 0.5) + echo(z + 6.0, 0.25)
        if scatter:
            under = np.maximum(depth - z, 0.0)
            field = field + noise_of(1.0) * scatter * np.exp(-under / 1.5) * (depth > z)
        if fixed:
            field = field + echo(4.0, fixed)
        if ring:
            field = field + 2.0 * np.exp(-np.maximum(depth - ring, 0.0) / 0.1)
        heard = np.abs(field)
        heard[heard < threshold] = 0.0
        traces.append(Trace(stamp_ns=(k + 1) * 10**9, depth=depth, amplitude=heard))
    return traces, below


def tracked(traces, floor, particles):
    """With nothing told but what converters write, after the tenth record. ghosts: reflectors a
    record of existence 0.5 or more that lie more than 1 m above the floor; label: share of the
    records whose greatest `is_bottom` is within 0.5 m of the floor, and what it says there;
    inside: share with the floor within two `bottom_depth_std`."""
    config = FathometerConfig(
        particles=particles, min_separation=0.45, depth_std=0.35, order_max=6, sound_speed_std=0.0
    )
    tracker, rows = FathometerTracker(config), []
    for trace, z in zip(traces, floor.tolist()):
        for found in (estimate.columns() for estimate in tracker.process(trace)):
            if trace.stamp_ns <= SETTLED * 10**9:
                continue
            depth, label = found['depth'], np.nan_to_num(found['is_bottom'])
            near, best = np.abs(depth - z) < 0.5, np.argmax(label)
            error = abs(found['bottom_depth'][0] - z)
            rows.append(
                {
                    'ghosts': np.sum((found['existence'] >= 0.5) & (depth < z - 1.0)),
                    'label': near[best],
                    'said': label[near].max(initial=0.0),
                    'inside': error <= 2.0 * found['bottom_depth_std'][0],
                }
            )
    return {name: np.mean([row[name] for row in rows]) for name in rows[0]}


def halves(path, spacing):
    """Even and odd traces, each stacked in pairs: share of the records whose floors differ by more
    than 0.75 m (apart), and by less than two standard deviations (inside)."""
    amplitude = read_segy(path).amplitude
    depth = spacing * np.arange(amplitude.shape[1])
    floors = []
    for half in (amplitude[::2], amplitude[1::2]):
        water, found = Water(FathometerConfig()), []
        stacked = half[: len(half) // 2 * 2].reshape(-1, 2, half.shape[1]).mean(axis=1)
        for k, row in enumerate(stacked):
            trace = Trace(stamp_ns=k + 1, depth=depth, amplitude=row)
            if water.active is None:
                water.begin(trace)
            found.append(water.take(trace)[2].depth)
        floors.append(np.array(found))
    count = min(map(len, floors))
    (z, std), (other, other_std) = (each[SETTLED:count].T for each in floors)
    apart = np.abs(z - other)
    inside = np.mean(apart <= 2.0 * np.hypot(std, other_std))
    return {'apart': np.mean(~(apart <= 0.75)), 'inside': inside}
