# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Files beside a recording: the parameters of its instruments reach the tracker, the limit of its
error reaches the check."""

import json

import pytest

from sonar_imm.parameters import parameters_from_yaml
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.own_files import (
    own_limit,
    own_parameters,
    own_recipe,
    unusual,
    write_own_limit,
    write_own_parameters,
)
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.simulation.fathometer.simulator import scenario as fathometer_scenario
from sonar_imm_tools.simulation.obstacle.simulator import scenario as obstacle_scenario


def test_only_what_differs_from_the_defaults_is_told():
    config = SYSTEMS['obstacle'].config_type()
    assert unusual(obstacle_scenario('approach').instruments(), config) == {}
    moved = obstacle_scenario('approach', {'sonar_lever': (2.0, 0.0, -0.3), 'roll_rms_deg': 4.0})
    assert unusual(moved.instruments(), config) == {'sonar_lever': (2.0, 0.0, -0.3)}


def test_drawn_cross_spectra_have_no_window():
    config = SYSTEMS['fathometer'].config_type()
    # The length of a snapshot, which the tracker would choose by itself, is part of the scene.
    common = {'snapshot_seconds': 1.4, 'sound_speed_std': 0.0}
    assert unusual(fathometer_scenario('drift_traces').instruments(), config) == common
    given = unusual(fathometer_scenario('drift_spectra').instruments(), config)
    assert given == common | {'window': 'rectangular', 'overlap': 0.0}


def test_the_file_is_one_of_ros(tmp_path):
    assert write_own_parameters(tmp_path, {'obstacle': {}}) is None
    assert own_parameters(tmp_path) is None
    values = {'sonar_lever': (2.0, 0.0, -0.3), 'azimuth_model': 'cone', 'max_range': 50.0}
    path = write_own_parameters(tmp_path, {'obstacle': values, 'fls_detector': {}})
    assert own_parameters(tmp_path).path == path
    text = path.read_text()
    read = parameters_from_yaml(text, node_name='obstacle')
    assert SYSTEMS['obstacle'].config_type().from_mapping(read).sonar_lever == (2.0, 0.0, -0.3)
    # A recording that another tracker reads too does not tell it strange words.
    assert parameters_from_yaml(text, node_name='diver') == {}


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    bag = tmp_path_factory.mktemp('own') / 'scene'
    settings = ('--set', 'sonar_lever=2,0,-0.3', '--set', 'last_range=80')
    assert main(['simulate', 'obstacle', str(bag), *settings]) == 0
    return bag


def parameters_of(bag, folder, *options):
    assert main(['track', str(bag), str(folder), *options]) == 0
    return json.loads((folder / 'run.json').read_text())['parameters']


def test_track_uses_them_unless_told_otherwise(bag, tmp_path, capsys):
    assert parameters_of(bag, tmp_path / 'own')['sonar_lever'] == [2.0, 0.0, -0.3]
    assert f'using the parameters of the recording, {bag}' in capsys.readouterr().out
    changed = parameters_of(bag, tmp_path / 'set', '--set', 'max_tracks=5')
    assert changed['sonar_lever'] == [2.0, 0.0, -0.3] and changed['max_tracks'] == 5
    other = tmp_path / 'other.yaml'
    other.write_text('max_tracks: 7\n')
    given = parameters_of(bag, tmp_path / 'given', '--params', str(other))
    assert f'--params is used in place of the parameters of the recording, {bag}' in (
        capsys.readouterr().out
    )
    assert given['sonar_lever'] == [0.0, 0.0, 0.0] and given['max_tracks'] == 7


def test_a_spoilt_file_is_one_sentence(bag, tmp_path, capsys):
    (tmp_path / 'bag').mkdir()
    for file in bag.iterdir():
        (tmp_path / 'bag' / file.name).write_bytes(file.read_bytes())
    (tmp_path / 'bag' / 'parameters.yaml').write_text('obstacle: {ros__parameters: {levr: 1}}\n')
    assert main(['track', str(tmp_path / 'bag'), str(tmp_path / 'out')]) == 2
    assert "unknown parameter 'levr'" in capsys.readouterr().err


# -- the limit ------------------------------------------------------------------------------------


def test_a_limit_and_how_a_recording_is_made_again_are_kept(tmp_path):
    assert own_limit(tmp_path) is None
    for recipe in (None, [], ['--scenario', 'a scene', '--set', 'fading=']):
        if recipe is not None:
            write_own_limit(tmp_path, 0.88, recipe)
            assert own_limit(tmp_path) == 0.88
        if recipe:
            assert own_recipe(tmp_path) == recipe
            continue
        with pytest.raises(BagError, match='does not state how'):
            own_recipe(tmp_path)


@pytest.mark.parametrize(
    'text, sentence',
    [
        ('limit: ten', 'states no number'),
        ('limit: true', 'states no number'),
        ('[1, 2]', 'states no number'),
        ('', 'states no number'),
        ('limit: .nan', 'finite'),
        ('limit: .inf', 'finite'),
        ('limit: -1', 'not negative'),
        ('limit: [', 'not YAML'),
        ('\udcff\udcfe\x00limit', 'not YAML'),
    ],
)
def test_any_other_limit_is_one_sentence(tmp_path, text, sentence):
    (tmp_path / 'check.yaml').write_text(text, errors='surrogateescape')
    with pytest.raises(BagError, match=sentence):
        own_limit(tmp_path)
