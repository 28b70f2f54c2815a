# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Processes that share work, where they cannot."""

from multiprocessing import synchronize
import socket

from helpers.dying import work
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
