# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Each removed name answers with one sentence, and what the sentence names is there."""

import re
import shutil
import sys

from helpers.source import ROOT
import pytest

from sonar_imm.gone import GONE
from sonar_imm.node_config import node_config_type
from sonar_imm.nodes import commands
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import COMMANDS, main
from sonar_imm_tools.recordings.convert_options import OPTIONS

BAG = ROOT / 'bags' / 'diver_table1'


def of_kind(kind):
    return sorted(key.removeprefix(f'{kind} ') for key in GONE if key.startswith(f'{kind} '))


def answer(capsys, *arguments):
    """Standard error of a command that has to end with 2, in one line."""
    capsys.readouterr()
    assert main(list(map(str, arguments))) == 2
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith('sonar-imm: ')]
    assert len(said) == 1 and not any('Traceback' in line for line in lines)
    return said[0]


def known_parameters(system):
    specs = *system.config_type().specs(), *node_config_type(system).specs()
    return {spec.name for spec in specs}


def test_commands_kinds_of_conversion_and_options(capsys):
    kinds = {key.partition(' ')[0] for key in GONE}
    assert kinds == {'command', 'kind', 'parameter', 'choice', 'executable', 'option'}
    for kind, known, words in (('command', COMMANDS, []), ('kind', OPTIONS, ['convert'])):
        for name in of_kind(kind):
            assert name not in known
            assert f"'{name}' {GONE[f'{kind} {name}']}" in answer(capsys, *words, name, 'a', 'b')
    for name in of_kind('option'):
        command, option = name.split()
        said = answer(capsys, command, 'out', f'{option}=1')
        assert f"'{option}' {GONE[f'option {name}']}" in said


def test_parameters():
    """Of the systems that do not have one of this name any more, or never had."""
    for name in of_kind('parameter'):
        systems = [s for s in SYSTEMS.values() if name not in known_parameters(s)]
        assert systems, name
        for system in systems:
            with pytest.raises(ConfigError) as caught:
                system.config_type().from_mapping({name: 1})
            assert f"parameter '{name}' {GONE[f'parameter {name}']}" in str(caught.value)


def test_parameters_of_the_command(capsys, tmp_path):
    """By --set, and in a file of parameters."""
    track, name = ('track', BAG, tmp_path / 'out'), of_kind('parameter')[0]
    due = f"parameter '{name}' {GONE[f'parameter {name}']}"
    assert due in answer(capsys, *track, '--set', f'{name}=1')
    file = tmp_path / 'own.yaml'
    file.write_text(f'/**:\n  ros__parameters:\n    {name}: 1\n')
    assert due in answer(capsys, *track, '--params', file)
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('line', ['targets_to: x', 'model_set: cv'])
def test_a_recording_may_still_have_them(capsys, tmp_path, line):
    """Its parameters.yaml is that of an earlier version."""
    bag = shutil.copytree(BAG, tmp_path / 'bag')
    (bag / 'parameters.yaml').write_text(f'diver:\n  ros__parameters:\n    {line}\n')
    assert 'was removed' in answer(capsys, 'track', bag, tmp_path / 'out')


def test_choices_and_programs(capsys, monkeypatch):
    for name in of_kind('choice'):
        parameter, value = name.split()
        with pytest.raises(ConfigError) as caught:
            SYSTEMS['diver'].config_type().from_mapping({parameter: value})
        assert f"parameter '{parameter}': '{value}' {GONE[f'choice {name}']}" in str(caught.value)
    for name in of_kind('executable'):
        monkeypatch.setattr(sys, 'argv', [f'/opt/lib/sonar_imm/{name}'])
        assert commands.main() == 2
        assert capsys.readouterr().err == f'{name} {GONE[f"executable {name}"]}\n'


def test_what_a_sentence_names_is_there():
    known = set().union(*map(known_parameters, SYSTEMS.values()))
    for key, sentence in GONE.items():
        for file in re.findall(r'[a-z_]+/[a-zA-Z_/]+\.(?:py|md|json)', sentence):
            each = [file.replace('SYSTEM', system) for system in SYSTEMS]
            assert all((ROOT / path).is_file() for path in each), file
        assert set(re.findall(r'sonar-imm ([a-z]+)', sentence)) <= set(COMMANDS), key
        assert set(re.findall(r'\(kind ([a-z0-9]+)\)', sentence)) <= set(OPTIONS), key
        assert set(re.findall(r'\(parameter ([a-z_]+)\)', sentence)) <= known, key
