# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the first start costs: compiling the kernels.

Each case runs in a fresh process with an empty folder for them: the tracker is built and warmed
(`trackers.Tracker.warm`) for the inputs of the case. CPU and wall seconds are those of warming,
without the import of Python's libraries; kernels are functions of the package, as many as were
compiled; compilations count those that numba makes of its own functions too, and every combination
of argument types; kB are those of the machine code kept on disk.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import time
from typing import Any

from attrs import field, frozen

from sonar_imm import measurements
from sonar_imm.trackers import SYSTEMS


@frozen
class Case:
    """A system, its inputs (classes of `sonar_imm.measurements`) and parameters beside the
    defaults."""

    system: str
    inputs: tuple[str, ...]
    parameters: Mapping[str, Any] = field(factory=dict)


STARTS = {
    'bathymetry, defaults': Case('bathymetry', ('Snapshot',)),
    'bathymetry, with navigation': Case(
        'bathymetry', ('Snapshot', 'Navigation'), {'navigation': 'required'}
    ),
    'fathometer, traces': Case('fathometer', ('Trace',)),
    'fathometer, heave': Case('fathometer', ('Trace',), {'heave': 'memory'}),
}


def cold_start(case: Case, cache: str) -> dict[str, float]:
    """Warm a tracker where nothing has been compiled yet; for a process of its own."""
    from numba.core import event

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
        tracker.warm(inputs)
    return {
        'CPU s': time.process_time() - cpu,
        'wall s': time.perf_counter() - wall,
        'kernels': len({name for name in compiled if name[0].startswith('sonar_imm')}),
        'compilations': len(compiled),
        'kB': round(sum(path.stat().st_size for path in Path(cache).rglob('*.nbc')) / 1000),
    }
