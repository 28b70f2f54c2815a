# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What keeping the state of a tracker costs: the time between two messages, the writing, the size.

    python -m benchmarks.state_cost

Every shipped recording is tracked to its end, then its state is saved twenty times. CPU time, the
median; the first column is all that the node waits for, the rest is done by another thread.
"""

from __future__ import annotations

from pathlib import Path
import tempfile
import time

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.measurements import Rejection
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.state_file import frozen_state, json_parameters, Saved, write_state
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader

TIMES = 20


def row(bag: Path, path: Path) -> dict[str, float]:
    """Milliseconds of taking and of writing the state, and its size."""
    system = SYSTEMS[bag.name.split('_')[0]]
    config = load_config(system, own_parameters(bag), {})[0]
    tracker = system.build(config)
    with BagReader(bag) as reader:
        for item in measurements_of(reader, system.name, settings=config.as_dict()):
            if item.measurement is not None and not isinstance(item.measurement, Rejection):
                tracker.process(item.measurement)
    taking, writing, size = [], [], 0
    for _ in range(TIMES):
        begin = time.process_time()
        state = frozen_state(tracker)
        taken = time.process_time()
        saved = Saved(
            system=system.name,
            parameters=json_parameters(config),
            saved_ns=time.time_ns(),
            newest_ns=None,
            state=state,
            extras={},
        )
        size = write_state(path, saved)
        taking.append(1e3 * (taken - begin))
        writing.append(1e3 * (time.process_time() - taken))
    return {
        'taken, ms': float(np.median(taking)),
        'written, ms': float(np.median(writing)),
        'kB': size / 1000,
    }


def main() -> Parts:
    with tempfile.TemporaryDirectory() as folder:
        for bag in sorted(Path('bags').iterdir()):
            if bag.is_dir() and bag.name != 'obstacle_images':
                yield {'recordings': {bag.name: row(bag, Path(folder) / 'state')}}


if __name__ == '__main__':
    study(main, digits=2)
