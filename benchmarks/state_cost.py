# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Cost of a saved state: the time between two messages, writing, size, and loading.

    python -m benchmarks.state_cost

Every shipped recording is tracked to its end, then its state is saved twenty times. CPU time, the
median; the first column is all that the node waits for, writing is done by another thread.
"""

from __future__ import annotations

from pathlib import Path
import tempfile
import time

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.state_file import (
    intake_from,
    json_parameters,
    read_state,
    Saved,
    state_of,
    write_state,
)
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader

TIMES = 20


def row(bag: Path, path: Path) -> dict[str, float]:
    """Measure milliseconds of taking, writing and loading the state, and its size."""
    system = SYSTEMS[bag.name.split('_')[0]]
    config = load_config(system, own_parameters(bag), {})[0]
    intake = Intake(system.build(config))
    with BagReader(bag) as reader:
        for item in measurements_of(reader, system.name, settings=config.as_dict()):
            if item.measurement is not None and not isinstance(item.measurement, Rejection):
                intake.tracker.process(item.measurement)
    taking, writing, loading, size = [], [], [], 0
    for _ in range(TIMES):
        begin = time.process_time()
        state = state_of(intake)
        taken = time.process_time()
        saved = Saved(
            system=system.name,
            parameters=json_parameters(config),
            saved_ns=time.time_ns(),
            newest_ns=None,
            state=state,
        )
        size = write_state(path, saved)
        taking.append(1e3 * (taken - begin))
        written = time.process_time()
        writing.append(1e3 * (written - taken))
        intake_from(read_state(path), system, config)
        loading.append(1e3 * (time.process_time() - written))
    return {
        'taken, ms': float(np.median(taking)),
        'written, ms': float(np.median(writing)),
        'kB': size / 1000,
        'loaded, ms': float(np.median(loading)),
    }


def main() -> Parts:
    with tempfile.TemporaryDirectory() as folder:
        for bag in sorted(Path('bags').iterdir()):
            if bag.is_dir() and bag.name != 'obstacle_images':
                yield {'recordings': {bag.name: row(bag, Path(folder) / 'state')}}


if __name__ == '__main__':
    study(main, digits=2)
