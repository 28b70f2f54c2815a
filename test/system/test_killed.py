# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A process that is killed leaves nothing that looks whole; only a process can be killed."""

import contextlib
import math
import os
import random
import signal
import subprocess
import sys
import time

from helpers.commands import children, contents
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
    moments = [0.0, *(chance.uniform(0.0, 1.05) for _ in range(MOMENTS // 2 - 1))]
    moments += [chance.uniform(0.75, 1.02) for _ in range(MOMENTS - len(moments))]
    for number, moment in enumerate(moments):
        _killed(bag, runs / f'run{number}', moment * usual)
    whole = sum(whole_run(runs / f'run{number}') for number in range(MOMENTS))
    assert whole < MOMENTS
    names = {path.name for path in runs.glob('*')} - {'once'}
    others = {name for name in names if UNFINISHED not in name}
    assert len(others) == whole and all(name.startswith('run') for name in names)


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


def test_a_worker_that_is_killed_costs_a_survey_its_job_only(tmp_path):
    """While lines are read, and while tiles are made."""
    pytest.importorskip('rasterio')
    pytest.importorskip('pyarrow')
    lines = tmp_path / 'lines'
    small = [f'--set={name}' for name in ('lines=3', 'length=60', 'ghost=false', 'spacing=20')]
    simulate = command('simulate', 'survey', lines, '--soundings', *small)
    subprocess.run(simulate, cwd=ROOT, check=True)
    first, todo = None, [None, 'lines/*.npz', 'tiles/*.npz']
    for turn in range(30):  # a quick command may have done its work before this process looks
        work, out = todo[0], tmp_path / f'out{turn}'
        arguments = command('survey', lines, out, '--adjust', '--jobs', 2)
        with subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.PIPE, text=True) as it:
            while work and it.poll() is None and not list((out / '.work').glob(work)):
                time.sleep(0.002)
            workers = _workers(it.pid) if work else []
            for worker in workers[:1]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(worker, signal.SIGKILL)
            error = it.communicate()[1]
        assert it.returncode == 0 and 'Traceback' not in error, error
        found = contents(out, 'survey.json')
        found = {name: content for name, content in found.items() if '.work' not in name}
        first = first or found
        assert found == first and 'survey.tif' in found
        del todo[: not work or len(workers) == 2]
        if not todo:
            return
    pytest.fail(f'no worker was met at {todo}')


def _workers(command_id):
    """The processes that share the work of the command: forks of one that it has started."""
    with contextlib.suppress(OSError):  # it has ended
        return [worker for child in children(command_id) for worker in children(child)]
    return []
