# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Processes that share work, where they cannot."""

from multiprocessing import synchronize
import os
import socket
import subprocess
import sys
import time

from helpers.dying import work
from helpers.source import ROOT
import pytest

from sonar_imm.parameters import ConfigError
from sonar_imm_tools.offline import jobs
from sonar_imm_tools.offline.jobs import cluster, processes, workers


@pytest.mark.parametrize('error', [FileNotFoundError(2, 'No such file'), OSError(38, 'Not there')])
def test_without_shared_memory_there_is_a_sentence_that_helps(monkeypatch, error):
    """What a semaphore costs in a container without /dev/shm."""

    def refused(*args, **options):
        raise error

    monkeypatch.setattr(synchronize.SemLock, '__init__', refused)
    with pytest.raises(OSError, match='--jobs 1'), processes(2):
        pass


def test_a_process_that_dies_costs_its_call_only(tmp_path):
    with workers(2) as run:
        found = {
            k: (result, failure)
            for k, result, failure in run(work, [(tmp_path, k) for k in range(6)])
        }
        again = list(run(work, [(tmp_path, 5)]))
    assert {k: found[k] for k in (0, 1, 2, 5)} == {k: (k * k, '') for k in (0, 1, 2, 5)}
    assert 'was ended' in found[3][1] and 'not this one' in found[4][1]
    assert again == [(0, 25, '')]


def test_one_process_does_calls_in_turn(tmp_path):
    with workers() as run:
        found = list(run(work, [(tmp_path, 1), (tmp_path, 4)]))
    assert found == [(0, 1, ''), (1, None, 'ValueError: not this one')]


def test_a_missing_scheduler_is_one_sentence(monkeypatch):
    pytest.importorskip('distributed')
    monkeypatch.setattr(jobs, 'CONNECT_SECONDS', 0.5)
    with socket.create_server(('127.0.0.1', 0)) as silent:
        address = f'127.0.0.1:{silent.getsockname()[1]}'
        with pytest.raises(ConfigError, match=f'no dask scheduler answers at {address} '):
            cluster(address).__enter__()
    with pytest.raises(ConfigError, match='no dask scheduler'):  # the port is closed now
        cluster(address).__enter__()
    with pytest.raises(ConfigError, match='no dask scheduler at nonsense: .*port'):
        cluster('nonsense').__enter__()


def test_the_example_of_slurm_hands_in_its_jobs_and_cancels_them(tmp_path):
    """By commands that stand in for those of Slurm, and keep what they are given."""
    pytest.importorskip('dask_jobqueue')
    (tmp_path / 'sbatch').write_text(f'#!/bin/sh\ncp $1 {tmp_path}/$$.job\necho job $$\n')
    (tmp_path / 'scancel').write_text(f'#!/bin/sh\ntouch {tmp_path}/$1.gone\n')
    for name in ('sbatch', 'scancel'):
        (tmp_path / name).chmod(0o755)
    example = subprocess.Popen(
        [sys.executable, ROOT / 'examples' / 'howto' / 'slurm_cluster.py'], text=True,
        env={**os.environ, 'PATH': f'{tmp_path}:{os.environ["PATH"]}'}, cwd=tmp_path,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    end = time.monotonic() + 60.0
    while len(list(tmp_path.glob('*.job'))) < 4 and time.monotonic() < end:
        time.sleep(0.1)
    address = example.communicate('\n', timeout=60)[0].splitlines()[0]
    jobs = {path.stem: path.read_text() for path in tmp_path.glob('*.job')}
    assert len(jobs) == 4 and {path.stem for path in tmp_path.glob('*.gone')} == set(jobs)
    for text in jobs.values():
        assert '#SBATCH --cpus-per-task=16' in text and '. /data/venv/bin/activate' in text
        assert f'{address} ' in text and '--nworkers 16 ' in text
