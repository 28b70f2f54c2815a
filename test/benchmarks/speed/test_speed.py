# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm bench`` finds the benches of every system in a checkout, and says where they are;
what is measured beside a peer is the same sums."""

import functools
import json

import pytest

from benchmarks import speed
from benchmarks.speed import bathymetry, diver, fathometer, obstacle
import sonar_imm
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import main


def fast(rounds):
    return {'rounds': rounds, 'good': rounds > 2}


def without_peer(rounds):
    raise ModuleNotFoundError('no', name='filterpy.kalman')


@pytest.fixture
def benches(monkeypatch):
    """Benches in place of those of every system."""
    return lambda *made: monkeypatch.setattr(speed, 'benches_of', lambda system: made)


@pytest.mark.parametrize('system', SYSTEMS)
def test_benches_have_names_of_their_own(system):
    names = [bench.name for bench in speed.benches_of(system)]
    assert names and len(set(names)) == len(names) and 'node_ms' not in names


def test_the_command_measures_and_leaves_out_what_has_no_peer(benches, capsys):
    benches(speed.Bench('fast', fast), speed.Bench('peer', without_peer))
    assert main(['bench', 'diver', '--skip-node', '--rounds', '3', '--strict']) == 0
    text = capsys.readouterr().out
    assert 'fast: rounds 3, good True' in text and 'peer left out' in text and 'filterpy' in text
    assert main(['bench', 'diver', '--skip-node', '--rounds', '1', '--json']) == 0
    assert json.loads(capsys.readouterr().out) == {'diver': {'fast': {'rounds': 1, 'good': False}}}
    assert main(['bench', 'diver', '--skip-node', '--rounds', '1', '--strict']) == 1


def test_a_library_that_is_no_peer_is_not_left_out(benches):
    def broken(rounds):
        raise ModuleNotFoundError('no', name='numpy_of_another_name')

    benches(speed.Bench('broken', broken))
    with pytest.raises(ModuleNotFoundError):
        main(['bench', 'diver', '--skip-node'])


def test_without_a_checkout_it_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sonar_imm, '__file__', str(tmp_path / 'sonar_imm' / '__init__.py'))
    assert main(['bench', 'diver']) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert 'benchmarks/' in line and 'make bench' in line


def test_every_way_to_track_a_ping_is_timed(monkeypatch):
    ping = bathymetry.a_ping(last_range=27.0)
    monkeypatch.setattr(bathymetry, 'a_ping', lambda: ping)
    speeds = bathymetry.bench_ping(rounds=1)['bins_per_second']
    assert set(speeds) == set(bathymetry.METHODS) and min(speeds.values()) > 0.0


def test_the_best_round_of_each_method_counts(monkeypatch):
    """By a clock that only the methods move: rounds of 3, 2 and 4 seconds for 10 bins are 5 bins
    per second; the first call compiles and is not timed."""
    clock, costs = [0.0], {'a': iter([100.0, 3.0, 2.0, 4.0]), 'b': iter([1.0, 8.0, 9.0, 10.0])}

    def take(name):
        clock[0] += next(costs[name])

    monkeypatch.setattr(bathymetry.time, 'process_time', lambda: clock[0])
    methods = {name: functools.partial(take, name) for name in 'ab'}
    assert bathymetry.rates(methods, 10, rounds=3) == {'a': 5.0, 'b': 1.25}


def test_filterpy_does_the_same_sums_for_a_diver():
    pytest.importorskip('filterpy')
    assert diver.bench_step(rounds=1, steps=8)['largest_difference_m'] < 1e-9


def test_a_scan_of_divers_is_timed_with_either_association():
    clutter = diver.bench_clutter(rounds=1, scans=15)
    assert clutter['fixes'] > 15 and min(clutter['gnn_cpu_ms'], clutter['jipda_cpu_ms']) > 0.0


def test_a_record_is_timed_with_all_its_reflectors():
    record = fathometer.bench_record(2)
    assert set(record['reflectors'].values()) == {8}
    assert set(record['median_ms']) == set(record['reflectors'])


def test_all_obstacles_are_tracked_and_every_ping_is_timed():
    result = obstacle.bench_ping(rounds=1, pings=16, obstacles=10, clutter=30)
    assert result['tracked'] >= 10 and result['pings'] == 6
    assert 0.0 < result['median_ms'] <= result['p99_ms']
