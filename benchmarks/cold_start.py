# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the first start costs: compiling the kernels, by system and configuration.

    python -m benchmarks.cold_start --out docs/results/cold_start.json

Each case runs in a fresh process with an empty folder of compiled kernels: the tracker is built
and warmed (`trackers.Tracker.warm`) for the inputs of the case. CPU and wall seconds are those of
warming, without the import of Python's libraries; kernels are functions of the package, as many as
were compiled; compilations count those that numba makes of its own functions too, and every
combination of argument types; kB are those of the machine code kept on disk. CPU seconds mean
something only on a machine that does nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import tempfile
import time
from typing import Any

from attrs import field, frozen

from benchmarks.study import in_fresh_process, Parts, study


@frozen
class Case:
    """A system, its inputs (classes of `sonar_imm.measurements`, none: all) and parameters beside
    the defaults."""

    system: str
    inputs: tuple[str, ...] = ()
    parameters: Mapping[str, Any] = field(factory=dict)


CASES = {
    'bathymetry, defaults': Case('bathymetry', ('Snapshot',)),
    'bathymetry, with navigation': Case(
        'bathymetry', ('Snapshot', 'Navigation'), {'navigation': 'required'}
    ),
    'bathymetry, everything': Case('bathymetry', (), {'navigation': 'required'}),
    'fathometer, traces': Case('fathometer', ('Trace',)),
    'fathometer, heave': Case('fathometer', ('Trace',), {'heave': 'memory'}),
    'fathometer, both polarities': Case('fathometer', ('Trace',), {'polarity': 'both'}),
    'fathometer, everything': Case('fathometer', (), {'heave': 'memory', 'polarity': 'both'}),
}


def cold_start(case: Case, cache: str) -> dict[str, float]:
    """Warm a tracker where nothing has been compiled yet; for a process of its own."""
    from numba.core import event

    from sonar_imm import measurements
    from sonar_imm.trackers import SYSTEMS

    compiled: list[tuple[str, str]] = []

    class Counter(event.Listener):
        def on_start(self, event: Any) -> None:
            pass

        def on_end(self, event: Any) -> None:
            function = event.data['dispatcher'].py_func
            compiled.append((function.__module__, function.__qualname__))

    system = SYSTEMS[case.system]
    config = system.config_type()(**case.parameters)
    tracker = system.build(config)
    inputs = {getattr(measurements, name) for name in case.inputs}
    cpu, wall = time.process_time(), time.perf_counter()
    with event.install_listener('numba:compile', Counter()):
        tracker.warm(inputs or None)
    return {
        'CPU s': time.process_time() - cpu,
        'wall s': time.perf_counter() - wall,
        'kernels': len({name for name in compiled if name[0].startswith('sonar_imm')}),
        'compilations': len(compiled),
        'kB': round(sum(path.stat().st_size for path in Path(cache).rglob('*.nbc')) / 1000),
    }


def main(cases: Sequence[str] = tuple(CASES)) -> Parts:
    for name in cases:
        with tempfile.TemporaryDirectory() as cache:
            # Read when numba is imported, which the process does before it is called.
            os.environ['NUMBA_CACHE_DIR'] = cache
            yield {'first start': {name: in_fresh_process(cold_start, CASES[name], cache)}}


if __name__ == '__main__':
    study(main, digits=1, cases={'choices': list(CASES)})
