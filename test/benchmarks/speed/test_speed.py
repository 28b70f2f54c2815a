# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm bench`` finds the benches of every system in a checkout, and says where they are."""

import json

import pytest

from benchmarks import speed
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
