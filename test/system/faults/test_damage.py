# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Recordings that are damaged, disks that are full or may not be written to, and `track` killed at
any moment: only a process can be killed, and a limit of the size of files is one of a process; the
rest goes into the same part of the figures."""

import contextlib
import io
import math
import random
import resource
import shutil
import signal
import subprocess
import sys
import time

from helpers.dive_scenes import write_dive
from helpers.faults.cases import BAGS, CASES
from helpers.faults.figures import count, long_form
from helpers.source import ROOT
import numpy as np
import pytest

from sonar_imm.files import UNFINISHED
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import RunFolder

pytestmark = pytest.mark.system

KINDS = ('cut short', 'one bit flipped')
SIGNALS_OF_DAMAGE = 'problem damaged checksum CRC truncated index corrupt'.split() + ['not read']


def run(*words):
    """The command in this process: exit code, and what it said."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        code = main([str(word) for word in words])
    return code, output.getvalue()


def tracked(bag, out):
    """What became of `track`: exit code, words, and the estimates as bytes, None without."""
    system = next(case.system for case in CASES.values() if case.bag == bag.name)
    code, message = run('track', bag, out, '--system', system)
    estimates = out / 'estimate.csv'
    return code, message, estimates.read_bytes() if estimates.exists() else None


def damage(folder, kind, rng):
    """Spoil the recording in `folder`."""
    (file,) = folder.glob('*.mcap')
    whole = bytearray(file.read_bytes())
    if kind == 'cut short':
        del whole[int(rng.integers(len(whole) // 20, len(whole))) :]
    else:
        whole[int(rng.integers(len(whole)))] ^= 1 << int(rng.integers(8))
    file.write_bytes(whole)


@pytest.mark.parametrize('kind', KINDS)
def test_damage_of_a_recording_is_said_or_harmless(kind, tmp_path, figures):
    """What is tracked without a word is what would have been tracked without the damage."""
    tries, silent, failed, reported = count(3, 12), [], [], 0
    figures.skip_if_measured(tries, what=kind)
    rng = np.random.default_rng(len(kind))
    names = ['diver_table1', 'obstacle_movers'] if long_form() else ['diver_table1']
    whole = {name: tracked(BAGS / name, tmp_path / f'whole_{name}') for name in names}
    assert all(code == 0 for code, _, _ in whole.values())
    for turn in range(tries):
        name = names[turn % len(names)]
        bag = tmp_path / f'{turn}' / name
        shutil.copytree(BAGS / name, bag)
        damage(bag, kind, rng)
        code, message, estimates = tracked(bag, tmp_path / f'out_{turn}')
        unused = code == 1 and 'no measurement was used' in message
        known = code in (0, 2) or unused
        if not known or 'Traceback' in message or (code == 2) == (estimates is not None):
            failed.append((turn, code, message[-300:]))
        problem = code == 2 or any(word in message for word in SIGNALS_OF_DAMAGE)
        reported += problem
        if not problem and estimates != whole[name][2]:
            silent.append((turn, message[-300:]))
    figures.add({'what': kind}, tried=tries, said=reported, silent=len(silent), failed=len(failed))
    assert not failed and not silent


def command(*arguments):
    return [sys.executable, '-m', 'sonar_imm_tools.cli', *map(str, arguments)]


def limited(size, *words):
    """The command as a process that may not write files above `size` bytes, as on a full disk."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return subprocess.run(command(*words), preexec_fn=limit, capture_output=True, text=True)


def test_a_full_disk_is_one_sentence_and_leaves_nothing_that_looks_whole(tmp_path, figures):
    tries, bad = count(1, 4), []
    figures.skip_if_measured(tries, what='full disk')
    rng = np.random.default_rng(3)
    whole = tmp_path / 'whole'
    run('track', BAGS / 'diver_table1', whole)
    largest = max(file.stat().st_size for file in whole.rglob('*') if file.is_file())
    for turn in range(tries):
        out = tmp_path / f'out_{turn}'
        done = limited(int(rng.integers(0, largest)), 'track', BAGS / 'diver_table1', out)
        words = [line for line in done.stderr.splitlines() if line.startswith('sonar-imm:')]
        if done.returncode != 2 or len(words) != 1 or 'Traceback' in done.stderr or out.exists():
            bad.append((turn, done.returncode, done.stderr[-300:]))
    said = tries - len(bad)
    figures.add({'what': 'full disk'}, tried=tries, said=said, silent=0, failed=len(bad))
    assert not bad


def test_a_folder_that_may_not_be_written_to_is_one_sentence(figures):
    # /sys belongs to the kernel: not even root makes a folder there
    code, message = run('track', BAGS / 'diver_table1', '/sys/sonar_imm')
    said = int(code == 2)
    figures.add({'what': 'read-only folder'}, tried=1, said=said, silent=0, failed=1 - said)
    *before, sentence = message.splitlines()
    assert code == 2 and '/sys/sonar_imm' in sentence
    message = ('using the parameters of the recording', 'diver <- ')
    assert all(line.startswith(message) for line in before)


MOMENTS = count(4, 20)


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
