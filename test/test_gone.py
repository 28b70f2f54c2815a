# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Each removed name answers with one sentence, and what the sentence names is there."""

from pathlib import Path
import re
import shutil
import sys

import pytest

from sonar_imm.gone import GONE
from sonar_imm.node_config import node_config_type
from sonar_imm.nodes import commands
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import COMMANDS, main
from sonar_imm_tools.recordings.convert_options import OPTIONS

ROOT = Path(__file__).resolve().parents[1]
BAGS = {
    'bathymetry': 'bathymetry_paper',
    'diver': 'diver_table1',
    'fathometer': 'fathometer_drift',
    'obstacle': 'obstacle_wreck',
}
OF_SYSTEM = {
    **dict.fromkeys(
        (
            *('variant', 'sigma_reference_bin', 'rough_sigma', 'scatters', 'grid_step'),
            *('grid_extent', 'initial_slope_std', 'redrawn_slope_std', 'multipath_level_db'),
            *('likelihood', 'max_extrapolation', 'initial_mean', 'initial_std', 'shadow_gate'),
            'engine',
        ),
        'bathymetry',
    ),
    **dict.fromkeys(
        (
            *('amplitude_prior', 'proposal', 'output', 'envelope', 'multiples', 'depth_step'),
            *('array_depth_age', 'heave_memory', 'white_noise_gain_db', 'amplitude_memory'),
            *('slope_switch_probability', 'negative_probability', 'track_memory'),
            *('phone_least_share', 'fish_rate', 'bottom_jump', 'detectable_sigmas'),
            'remove_background',
        ),
        'fathometer',
    ),
    **dict.fromkeys(
        (
            *('vertical_beam_width_deg', 'fading_db', 'intensity_weight', 'method', 'components'),
            *('sway_time', 'speed_noise', 'behaviour_time', 'seabed_std', 'ground_std', 'seed'),
            *('ground_radius', 'sector_edge_deg', 'max_offset', 'altitude_std', 'course_window'),
            *('max_altitude_age', 'scale_std', 'landmark_time', 'max_navigation_gap', 'max_gap'),
            *('range_step', 'bearing_step_deg', 'detection_ranges', 'detection_factors'),
            *('position_noise', 'yaw_noise_deg', 'depth_noise', 'outlier_probability'),
            *('training', 'training_beams', 'guard', 'false_alarm', 'growth_false_alarm'),
            'sweep_max_gap',
        ),
        'obstacle',
    ),
}
"""Systems of removed parameters; all others are of the diver."""


def of_kind(kind):
    """The names of one kind, each what stands behind the kind."""
    return sorted(key.removeprefix(f'{kind} ') for key in GONE if key.startswith(f'{kind} '))


def answer(capsys, *arguments):
    """Standard error of a command that has to end with 2, in one line."""
    capsys.readouterr()
    assert main(list(map(str, arguments))) == 2
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line.startswith('sonar-imm: ')]
    assert len(said) == 1 and not any('Traceback' in line for line in lines)
    return said[0]


def known_parameters(systems=SYSTEMS):
    return {
        spec.name
        for system in map(SYSTEMS.get, systems)
        for specs in (
            system.config_type().specs(),
            node_config_type(system).specs(),
        )
        for spec in specs
    }


def test_every_key_is_of_a_kind_that_is_asked():
    kinds = {key.partition(' ')[0] for key in GONE}
    assert kinds == {'command', 'kind', 'parameter', 'choice', 'executable', 'option'}


@pytest.mark.parametrize('name', of_kind('command'))
def test_commands(capsys, name):
    assert name not in COMMANDS
    assert f"'{name}' {GONE[f'command {name}']}" in answer(capsys, name, 'a', 'b')


@pytest.mark.parametrize('name', of_kind('kind'))
def test_kinds_of_conversion(capsys, name):
    assert name not in OPTIONS
    assert f"'{name}' {GONE[f'kind {name}']}" in answer(capsys, 'convert', name, 'a', 'b')


@pytest.mark.parametrize('name', of_kind('option'))
def test_options(capsys, name):
    command, option = name.split()
    said = answer(capsys, command, 'out', f'{option}=1')
    assert f"'{option}' {GONE[f'option {name}']}" in said


@pytest.mark.parametrize('name', of_kind('parameter'))
def test_parameters_of_the_command(capsys, tmp_path, name):
    """By --set, and in a file of parameters."""
    system = OF_SYSTEM.get(name, 'diver')
    assert name not in known_parameters([system])
    track = 'track', ROOT / 'bags' / BAGS[system], tmp_path / 'out'
    due = f"parameter '{name}' {GONE[f'parameter {name}']}"
    assert due in answer(capsys, *track, '--set', f'{name}=1')
    file = tmp_path / 'own.yaml'
    file.write_text(f'/**:\n  ros__parameters:\n    {name}: 1\n')
    assert due in answer(capsys, *track, '--params', file)
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('line', ['targets_to: x', 'model_set: cv'])
def test_a_recording_may_still_have_them(capsys, tmp_path, line):
    """Its parameters.yaml is that of an earlier version."""
    bag = shutil.copytree(ROOT / 'bags' / BAGS['diver'], tmp_path / 'bag')
    (bag / 'parameters.yaml').write_text(f'diver:\n  ros__parameters:\n    {line}\n')
    assert 'was removed' in answer(capsys, 'track', bag, tmp_path / 'out')


@pytest.mark.parametrize('name', of_kind('choice'))
def test_choices(capsys, tmp_path, name):
    parameter, value = name.split()
    track = 'track', ROOT / 'bags' / BAGS['diver'], tmp_path / 'out'
    said = answer(capsys, *track, '--set', f'{parameter}={value}')
    assert f"parameter '{parameter}': '{value}' {GONE[f'choice {name}']}" in said


@pytest.mark.parametrize('name', of_kind('executable'))
def test_programs(capsys, monkeypatch, name):
    monkeypatch.setattr(sys, 'argv', [f'/opt/lib/sonar_imm/{name}'])
    assert commands.main() == 2
    assert capsys.readouterr().err == f'{name} {GONE[f"executable {name}"]}\n'


@pytest.mark.parametrize('key', sorted(GONE))
def test_what_a_sentence_names_is_there(key):
    sentence = GONE[key]
    files = re.findall(r'[a-z_]+/[a-zA-Z_/]+\.(?:py|md|json)', sentence)
    for file in files:
        each = [file.replace('SYSTEM', system) for system in SYSTEMS]
        assert all((ROOT / path).is_file() for path in each), file
    for command in re.findall(r'sonar-imm ([a-z]+)', sentence):
        assert command in COMMANDS
    for kind in re.findall(r'\(kind ([a-z0-9]+)\)', sentence):
        assert kind in OPTIONS
    for parameter in re.findall(r'\(parameter ([a-z_]+)\)', sentence):
        assert parameter in known_parameters()
