# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A process that is killed leaves nothing that looks whole; only a process can be killed. Workers
that die cost their job only: `offline/test_tracking.py`."""

import math
import random
import signal
import subprocess
import sys
import time

from helpers.dive_bags import write_dive
from helpers.faults.figures import count
from helpers.source import ROOT
import pytest

from sonar_imm.files import UNFINISHED
from sonar_imm_tools.offline.run_folder import RunFolder

pytestmark = pytest.mark.system
MOMENTS = count(6, 20)


def command(*arguments):
    return [sys.executable, '-m', 'sonar_imm_tools.cli', *map(str, arguments)]


def whole_run(path):
    """Whether `path` is a finished run; anything else that is there fails the test."""
    if not path.exists():
        return False
    folder = RunFolder(path)
    assert folder.read_run()['estimates'] == len(folder.read_estimates()) > 0
    return True


def test_track_is_killed_at_any_moment(tmp_path):
    bag = write_dive(tmp_path / 'bag' / 'dive')
    runs = tmp_path / 'runs'
    usual = _killed(bag, runs / 'once', math.inf)
    # Half of the moments where the files are written and moved, which is at the end.
    chance = random.Random(14)
    for number in range(MOMENTS):
        moment = chance.uniform(*((0.0, 1.05) if number % 2 else (0.75, 1.02))) * bool(number)
        _killed(bag, runs / f'run{number}', moment * usual)
    whole = sum(whole_run(runs / f'run{number}') for number in range(MOMENTS))
    assert whole < MOMENTS
    left = {path.name for path in runs.glob('*') if UNFINISHED not in path.name}
    assert len(left - {'once'}) == whole


def _killed(bag, out, moment):
    """Track `bag`, killed `moment` seconds after the first trace of `out`; seconds it lived."""
    with subprocess.Popen(command('track', bag, out), cwd=ROOT, stdout=subprocess.DEVNULL) as it:
        while it.poll() is None and not list(out.parent.glob(f'{out.name}*')):
            time.sleep(0.001)
        begin = time.perf_counter()
        try:
            it.wait(None if math.isinf(moment) else moment)
        except subprocess.TimeoutExpired:
            it.send_signal(signal.SIGKILL)
    return time.perf_counter() - begin
