# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the hardest messages cost: CPU time and memory of one message of each kind.

    python -m benchmarks.bounds --out FILE
    python -m benchmarks.bounds --only arrivals_wild_tag

Each case runs in a process of its own, after the tracker is warm: a message at the limit of what
is read, or as large as a recorder would still send it, goes through the adapter and the tracker
with its defaults, three times. Told are its size, the CPU time of the slowest one, and by how much
the peak memory of the process grew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
import resource
import time
from typing import Any

import numpy as np

from benchmarks.study import in_fresh_process, known, Parts, study
from msg_adapters.arrivals import MAX_PAIRS
from msg_adapters.detections import MAX_DETECTIONS
from msg_adapters.inputs import inputs_of
from msg_adapters.scans import MAX_FIXES
from msg_adapters.table import encode_table
from sonar_imm.measurements import Altitude, Navigation, Rejection
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.messages import ros_message, typestore

SECOND = 10**9
TIMES = 3
TABLE = 'sensor_msgs/msg/PointCloud2'

Case = tuple[str, str, Callable[[np.random.Generator], dict[str, Any]]]
"""A system, an input, and what makes the columns of its table."""


def fixes(rng: np.random.Generator) -> dict[str, Any]:
    """As many positions as a scan may have, anywhere in a square kilometre."""
    x, y = rng.uniform(-500.0, 500.0, (2, MAX_FIXES))
    cov = {f'cov_{name}': np.full(MAX_FIXES, np.nan, np.float32) for name in ('x_x', 'x_y', 'y_y')}
    return {'x': x, 'y': y, **cov}


def arrivals_wild_tag(rng: np.random.Generator) -> dict[str, Any]:
    """A tag that as many receivers as there may be hear at times that fit no position."""
    return _arrivals(rng.uniform(-500.0, 500.0, (MAX_PAIRS, 2)), rng.uniform(0.1, 1.0, MAX_PAIRS))


def arrivals_many_divers(rng: np.random.Generator) -> dict[str, Any]:
    """Fifty divers whose echoes twenty receivers hear."""
    angle = 2.0 * np.pi * (np.arange(MAX_PAIRS) % 20) / 20
    rx = 300.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    divers = np.repeat(
        np.random.default_rng(7).uniform(-250.0, 250.0, (MAX_PAIRS // 20, 2)), 20, 0
    )
    path = np.hypot(*(divers - rx).T) + np.hypot(*divers.T)
    toa = (path + rng.normal(0.0, 0.05, MAX_PAIRS)) / 1500.0
    return _arrivals(rx, toa, 0.0) | {'rx_id': (np.arange(MAX_PAIRS) % 20).astype(np.uint16)}


def _arrivals(rx: np.ndarray, toa: np.ndarray, tx: float = np.nan) -> dict[str, Any]:
    n = len(toa)
    return {
        'tx_id': np.zeros(n, np.uint16),
        'rx_id': np.arange(n, dtype=np.uint16),
        **{f'tx_{axis}': np.full(n, tx) for axis in 'xyz'},
        'rx_x': rx[:, 0].copy(),
        'rx_y': rx[:, 1].copy(),
        'rx_z': np.zeros(n),
        'toa': toa,
        'var_toa': np.full(n, 1e-9, np.float32),
    }


def detections(rng: np.random.Generator) -> dict[str, Any]:
    """As many echoes as a ping may have, all over the beam."""
    return {
        'range': rng.uniform(5.0, 80.0, MAX_DETECTIONS).astype(np.float32),
        'bearing': rng.uniform(-1.0, 1.0, MAX_DETECTIONS).astype(np.float32),
    }


def snapshot(rng: np.random.Generator) -> dict[str, Any]:
    """Thirty times as many range bins as the recordings of the package have."""
    bins, staves = 20_000, 8
    return {
        'range': np.linspace(10.0, 400.0, bins, dtype=np.float32),
        'iq': rng.normal(size=(bins, 2 * staves)).astype(np.float32),
        'sound_speed': np.full(bins, 1500.0, np.float32),
    }


def pressure(rng: np.random.Generator) -> dict[str, Any]:
    """Ten seconds of a whole array at its rate."""
    samples, hydrophones = 200_000, 32
    return {
        'p': rng.normal(size=(samples, hydrophones)).astype(np.float32),
        'sample_rate': np.full(samples, 20_000.0, np.float32),
    }


def csdm(rng: np.random.Generator) -> dict[str, Any]:
    """Two thousand frequencies of thirty-two hydrophones."""
    frequencies, hydrophones = 2000, 32
    A = rng.normal(size=(frequencies, hydrophones, 2 * hydrophones))
    A = A[..., :hydrophones] + 1j * A[..., hydrophones:]
    matrices = (A @ A.conj().swapaxes(1, 2)).astype(np.complex64)
    return {
        'frequency': np.linspace(100.0, 4000.0, frequencies, dtype=np.float32),
        'csdm': np.ascontiguousarray(matrices.reshape(frequencies, -1)).view(np.float32),
        'snapshots': np.full(frequencies, 64, np.uint32),
    }


def trace(rng: np.random.Generator) -> dict[str, Any]:
    """A trace of the finest steps that fit the limit of cells."""
    rows = 50_000
    return {
        'depth': np.linspace(50.0, 300.0, rows),
        'amplitude': rng.normal(size=rows),
        'sigma': np.ones(rows),
        'array_depth': np.full(rows, 40.0),
    }


CASES: dict[str, Case] = {
    'fixes': ('diver', 'fixes', fixes),
    'fixes_softly': ('diver', 'fixes', fixes),
    'arrivals_wild_tag': ('diver', 'arrivals', arrivals_wild_tag),
    'arrivals_many_divers': ('diver', 'arrivals', arrivals_many_divers),
    'detections': ('obstacle', 'detections', detections),
    'snapshot': ('bathymetry', 'snapshot', snapshot),
    'pressure': ('fathometer', 'pressure', pressure),
    'csdm': ('fathometer', 'csdm', csdm),
    'trace': ('fathometer', 'trace', trace),
}


def messages(name: str) -> Iterator[Any]:
    """The messages of a case, a second apart."""
    rng = np.random.default_rng(1)
    for second in range(1, TIMES + 1):
        columns = CASES[name][2](rng)
        yield encode_table(columns, stamp_ns=second * SECOND, frame_id='map', make=ros_message)


def cost(name: str) -> dict[str, float]:
    """Size, CPU time and growth of the peak memory of this process, for one case."""
    system, topic, _ = CASES[name]
    settings = {'association': 'gnn'} if name == 'fixes' else {}
    tracker = SYSTEMS[system].build(SYSTEMS[system].config_type()(**settings))
    tracker.warm()
    entry = next(entry for entry in inputs_of(system) if entry.name == topic)
    read = entry.reader(TABLE, 'enu', tracker.config.as_dict())
    prepared = list(messages(name))
    size = max(len(typestore().serialize_cdr(message, TABLE)) for message in prepared)
    before, slowest, outcome = _peak_mb(), 0.0, 'used'
    for second, message in enumerate(prepared, start=1):
        start = time.process_time()
        for measurement in _companions(system, second):
            tracker.process(measurement)  # on which the message before waited
        try:
            tracker.process(read(message))
        except Rejection as rejection:
            outcome = rejection.reason
        slowest = max(slowest, time.process_time() - start)
    grown = _peak_mb() - before
    measured = {'size_mb': size / 1e6, 'cpu_s': slowest, 'memory_mb': grown}
    per_mb = {'cpu_s_per_mb': slowest / (size / 1e6), 'memory_per_byte': grown * 1e6 / size}
    return measured | per_mb | {'refused': float(outcome != 'used')}


def _companions(system: str, second: int) -> Iterator[Any]:
    """Poses without which a ping of the obstacle tracker waits."""
    if system == 'obstacle':
        for half in (-1, 0, 1):
            stamp = second * SECOND + half * SECOND // 10
            place = np.array([1.5 * stamp / SECOND, 0.0, -10.0])
            yield Navigation(
                stamp_ns=stamp, frame_id='map', position=place, orientation=(0.0, 0.0, 0.0, 1.0)
            )
        yield Altitude(stamp_ns=second * SECOND, altitude=10.0)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def measured(name: str) -> dict[str, float]:
    """`cost` in a fresh process."""
    return in_fresh_process(cost, name)


def main(only: Sequence[str] | None = None, out: Path | None = None) -> Parts:
    yield (table := known(out))
    for name in only or CASES:
        if name not in table:
            yield {name: measured(name)}


if __name__ == '__main__':
    study(main, digits=2, only={'action': 'append', 'choices': list(CASES)})
