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

"""Monte Carlo sweeps: runs alone and in processes, failures, sums."""

import contextlib
import csv
from importlib import import_module
import json
import math
import os
from pathlib import Path
import socket

from attrs import evolve
from helpers.clusters import small_cluster
import numpy as np
import pytest

from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.evaluation import sweep as sweeps
from sonar_imm_tools.evaluation.sweep import Outcome, Sweep
from sonar_imm_tools.offline import jobs
from sonar_imm_tools.offline.tracking import InputOptions
from sonar_imm_tools.recordings.sources import BagError

TINY = {
    'bathymetry': ('paper', {'pings': 1, 'last_range': 22.0}, 'height.all.rmse_m'),
    'diver': ('table1', {'duration': 15.0}, 'position.rmse_m'),
    'fathometer': ('drift_traces', {'records': 2}, 'ospa_m'),
    'obstacle': ('approach', {'first_range': 30.0, 'last_range': 20.0}, 'gospa.mean_m'),
}
"""Scenario, what makes it small, and a metric that needs truth, by system."""


def sweep_of(system, topics=None):
    name, overrides, _ = TINY[system]
    scene = import_module(f'sonar_imm_tools.simulation.{system}').scenario(name, overrides)
    config = SYSTEMS[system].config_type()()
    return Sweep(
        system=system,
        scenario=name,
        scene=scene,
        config=config,
        options=InputOptions(topics=topics),
    )


@pytest.fixture
def diver():
    return sweep_of('diver')


def test_every_system_has_a_tiny_scene():
    assert list(TINY) == list(SYSTEMS)


@pytest.mark.parametrize('system', list(TINY))
def test_each_system_is_simulated_tracked_and_scored(system):
    first, second, again = sweeps.run_here(sweep_of(system), [3, 4, 3])
    metric = TINY[system][2]
    assert not first.failure and first.versions['sonar_imm']
    assert metric in first.metrics
    assert first == again and first.metrics != second.metrics


def test_every_system_comes_through_a_pickle():
    cloudpickle = pytest.importorskip('cloudpickle')
    for system in TINY:
        sweep = sweep_of(system)
        assert cloudpickle.loads(cloudpickle.dumps(sweep)) == sweep


def listening():
    """Addresses, hexadecimal as the kernel has them, on which this process and its children listen
    for TCP."""
    family = {os.getpid()}
    for path in sorted(Path('/proc').glob('[0-9]*/stat'), key=lambda path: int(path.parts[2])):
        with contextlib.suppress(OSError):
            if int(path.read_text().rpartition(')')[2].split()[1]) in family:
                family.add(int(path.parts[2]))
    sockets = set()
    for process in family:
        for handle in Path(f'/proc/{process}/fd').iterdir():
            with contextlib.suppress(OSError):
                sockets.add(os.readlink(handle).removeprefix('socket:[').rstrip(']'))
    lines = [
        line.split()
        for table in ('tcp', 'tcp6')
        for line in Path(f'/proc/net/{table}').read_text().splitlines()[1:]
    ]
    return {
        words[1].partition(':')[0] for words in lines if words[3] == '0A' and words[9] in sockets
    }


def heard_here_only(outcomes):
    """`outcomes`; while there are some, their processes listen on this machine only."""
    yield next(outcomes)
    assert not Path('/proc/net/tcp').exists() or listening() == {'0100007F'}
    yield from outcomes


def test_processes_make_the_same_files_as_one_process(diver, tmp_path):
    pytest.importorskip('distributed')
    seeds = range(5, 9)
    for name, outcomes in (
        ('one', sweeps.run_here(diver, reversed(seeds))),
        ('two', heard_here_only(sweeps.run_on_processes(diver, seeds, 2))),
    ):
        done = list(outcomes)
        assert len(done) == 4
        sweeps.prepare(tmp_path / name)
        sweeps.write(tmp_path / name, sweeps.record(diver, done), done)
    for file in ('sweep.csv', 'sweep.json'):
        assert (tmp_path / 'one' / file).read_bytes() == (tmp_path / 'two' / file).read_bytes()
    with (tmp_path / 'two' / 'sweep.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert [int(row['seed']) for row in rows] == list(seeds)
    summary = json.loads((tmp_path / 'two' / 'sweep.json').read_text())['summary']
    assert summary['position.rmse_m']['mean'] == pytest.approx(
        np.mean([float(row['position.rmse_m']) for row in rows]), rel=1e-14
    )


def test_a_cluster_is_found_by_its_address(diver):
    with small_cluster(protocol='tcp') as there:
        lost = evolve(diver, options=InputOptions(topics={'/nowhere': 'fix'}))
        notes = []
        (found,) = sweeps.run_on_cluster(diver, [5], there.scheduler_address, notes.append)
        (missed,) = sweeps.run_on_cluster(lost, [5], there.scheduler_address, notes.append)
    assert found == next(sweeps.run_here(diver, [5])) and not notes
    assert "'/nowhere'" in missed.failure


def test_nobody_at_the_address_is_one_sentence(diver, monkeypatch):
    pytest.importorskip('distributed')
    monkeypatch.setattr(jobs, 'CONNECT_SECONDS', 0.5)
    with socket.create_server(('127.0.0.1', 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(ConfigError, match=f'no dask scheduler answers at 127.0.0.1:{port} '):
            next(sweeps.run_on_cluster(diver, [0], f'127.0.0.1:{port}'))
    with pytest.raises(ConfigError, match='no dask scheduler'):
        next(sweeps.run_on_cluster(diver, [0], f'127.0.0.1:{port}'))  # closed by now
    with pytest.raises(ConfigError, match='no dask scheduler at nonsense: .*port'):
        next(sweeps.run_on_cluster(diver, [0], 'nonsense'))


def test_a_failure_tells_the_same_each_time():
    bad = sweep_of('diver', topics={'/fix': 'fxi', '/nowhere': 'fix'})
    first, again = sweeps.run_here(bad, [0, 0])
    assert first.failure == again.failure and 'fxi' in first.failure
    lost = sweep_of('diver', topics={'/nowhere': 'fix'})
    assert next(sweeps.run_here(lost, [0])).failure.startswith("scene has no topic '/nowhere'")


def test_a_worker_with_another_version_is_refused(diver):
    outcome = sweeps.run_seed(evolve(diver, version='0.0.9'), 0)
    assert 'the sweep 0.0.9' in outcome.failure and not outcome.metrics


def test_nested_metrics_become_flat_numbers():
    metrics = {
        'n': 3,
        'a': {'b': {'c': 0.5, 'd': math.nan}, 'ok': True},
        'name': 'x',
        'none': None,
        'list': [1.0],
        'far': math.inf,
    }
    given = sweeps.finite_numbers(metrics)
    assert given == {'n': 3, 'a.b.c': 0.5, 'a.ok': 1}
    assert type(given['a.ok']) is int  # not True in a table


@pytest.mark.filterwarnings('error')  # one run has no spread, and says nothing on the terminal
def test_the_sums_are_those_of_the_runs_that_gave_the_metric():
    outcomes = [
        Outcome(2, {'a': 4.0, 'b': 7}),
        Outcome(0, {'a': 1.0}),
        Outcome(3, failure='no'),
        Outcome(1, {'a': 1.0}),
    ]
    summary = sweeps.summarise(outcomes)
    assert list(summary) == ['a', 'b']
    assert summary['a'] == pytest.approx(
        {'runs': 3, 'mean': 2.0, 'std': math.sqrt(3.0), 'stderr': 1.0, 'p05': 1.0, 'p95': 3.7}
    )
    assert summary['b']['runs'] == 1 and math.isnan(summary['b']['stderr'])


def test_the_table_has_empty_cells(diver, tmp_path):
    outcomes = [Outcome(2, {'a': 4.5, 'b': 7}), Outcome(0, {'a': 1.0}), Outcome(1, failure='no')]
    sweeps.write(tmp_path, sweeps.record(diver, outcomes), outcomes)
    assert (tmp_path / 'sweep.csv').read_text() == (
        'seed,failure,a,b\n0,,1.0,\n1,no,,\n2,,4.5,7\n'
    )


def test_an_earlier_sweep_is_kept(diver, tmp_path):
    sweeps.prepare(tmp_path / 'out')
    (tmp_path / 'out' / 'note.txt').write_text('mine')
    sweeps.prepare(tmp_path / 'out')
    sweeps.write(tmp_path / 'out', sweeps.record(diver, []), [])
    with pytest.raises(BagError, match='holds a sweep already'):
        sweeps.prepare(tmp_path / 'out')
    sweeps.prepare(tmp_path / 'out', overwrite=True)
    assert [path.name for path in (tmp_path / 'out').iterdir()] == ['note.txt']
    with pytest.raises(BagError, match='is a file'):
        sweeps.prepare(tmp_path / 'out' / 'note.txt')
