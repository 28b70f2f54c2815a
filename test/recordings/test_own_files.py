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
import shutil

from helpers.commands import run
from helpers.dive_scenes import write_dive
import numpy as np
import pytest

from sonar_imm.acoustics.rays import Profile
from sonar_imm.parameters import parameters_from_yaml
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings import own_files
from sonar_imm_tools.recordings.own_files import own_limit, unusual, write_own_parameters
from sonar_imm_tools.recordings.sound_speed import mean_speed, MOST_POINTS, read_profile
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.simulation.fathometer.simulator import scenario as fathometer_scenario
from sonar_imm_tools.simulation.obstacle.simulator import scenario as obstacle_scenario


def test_only_what_differs_from_the_defaults_is_told():
    config = SYSTEMS['obstacle'].config_type()
    assert unusual(obstacle_scenario('approach').instruments(), config) == {}
    moved = obstacle_scenario('approach', {'sonar_lever': (2.0, 0.0, -0.3), 'roll_rms_deg': 4.0})
    assert unusual(moved.instruments(), config) == {'sonar_lever': (2.0, 0.0, -0.3)}
    config = SYSTEMS['fathometer'].config_type()
    # The length of a snapshot, which the tracker would choose by itself, is part of the scene.
    common = {'snapshot_seconds': 1.4, 'sound_speed_std': 0.0}
    assert unusual(fathometer_scenario('drift_traces').instruments(), config) == common
    given = unusual(fathometer_scenario('drift_spectra').instruments(), config)
    assert given == common | {'window': 'rectangular', 'overlap': 0.0}


def test_the_file_is_one_of_ros(tmp_path):
    assert write_own_parameters(tmp_path, {'obstacle': {}}) is None
    assert own_files.own_parameters(tmp_path) is None
    values = {'sonar_lever': (2.0, 0.0, -0.3), 'azimuth_model': 'cone', 'max_range': 50.0}
    path = write_own_parameters(tmp_path, {'obstacle': values, 'fls_detector': {}})
    assert own_files.own_parameters(tmp_path).path == path
    text = path.read_text()
    read = parameters_from_yaml(text, node_name='obstacle')
    assert SYSTEMS['obstacle'].config_type().from_mapping(read).sonar_lever == (2.0, 0.0, -0.3)
    # A recording that another tracker reads too does not tell it strange words.
    assert parameters_from_yaml(text, node_name='diver') == {}


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    bag = tmp_path_factory.mktemp('own') / 'scene'
    settings = ('--set', 'sonar_lever=2,0,-0.3', '--set', 'last_range=80')
    assert run('simulate', 'obstacle', bag, *settings) == 0
    return bag


def parameters_of(bag, folder, *options):
    assert run('track', bag, folder, *options) == 0
    return json.loads((folder / 'run.json').read_text())['parameters']


def test_track_uses_them_unless_told_otherwise(bag, tmp_path, capsys):
    assert parameters_of(bag, tmp_path / 'own')['sonar_lever'] == [2.0, 0.0, -0.3]
    assert f'using the parameters of the recording, {bag}' in capsys.readouterr().out
    changed = parameters_of(bag, tmp_path / 'set', '--set', 'max_tracks=5')
    assert changed['sonar_lever'] == [2.0, 0.0, -0.3] and changed['max_tracks'] == 5
    other = tmp_path / 'other.yaml'
    other.write_text('max_tracks: 7\n')
    given = parameters_of(bag, tmp_path / 'given', '--params', other)
    said = f'--params is used in place of the parameters of the recording, {bag}'
    assert said in capsys.readouterr().out
    assert given['sonar_lever'] == [0.0, 0.0, 0.0] and given['max_tracks'] == 7
    # A spoilt file is one sentence.
    spoilt = shutil.copytree(bag, tmp_path / 'bag')
    (spoilt / 'parameters.yaml').write_text('obstacle: {ros__parameters: {levr: 1}}\n')
    assert run('track', spoilt, tmp_path / 'out') == 2
    assert "unknown parameter 'levr'" in capsys.readouterr().err


# -- the limit ------------------------------------------------------------------------------------


def test_a_limit_and_how_a_recording_is_made_again_are_kept(tmp_path):
    assert own_limit(tmp_path) is None
    recipe = ['--scenario', 'a scene', '--set', 'fading=']
    own_files.write_own_limit(tmp_path, 0.88, recipe)
    assert own_limit(tmp_path) == 0.88 and own_files.own_recipe(tmp_path) == recipe
    own_files.write_own_limit(tmp_path, 0.5, [])
    assert own_limit(tmp_path) == 0.5
    for _ in range(2):  # without a recipe, and without a file
        with pytest.raises(BagError, match='does not state how'):
            own_files.own_recipe(tmp_path)
        (tmp_path / 'check.yaml').unlink(missing_ok=True)


def test_any_other_limit_is_one_sentence(tmp_path):
    for text, sentence in (
        ('limit: ten', 'states no number'), ('limit: true', 'states no number'),
        ('[1, 2]', 'states no number'), ('', 'states no number'), ('limit: .nan', 'finite'),
        ('limit: .inf', 'finite'), ('limit: -1', 'not negative'), ('limit: [', 'not YAML'),
        ('\udcff\udcfe\x00limit', 'not YAML'),
    ):  # fmt: skip
        (tmp_path / 'check.yaml').write_text(text, errors='surrogateescape')
        with pytest.raises(BagError, match=sentence):
            own_limit(tmp_path)


# -- profiles of the speed of sound


DEPTH, SPEED = [0.5, 10.0, 20.0, 35.0], [1490.1, 1488.0, 1485.5, 1480.2]
ROWS = list(zip(DEPTH, SPEED))
UP = [(30.0, 1482.0), (9.0, 1489.0)]
"""The way up of a cast."""


def lines(rows, separator=' '):
    return [separator.join(f'{value:.9g}' for value in row) for row in rows]


FILES = {
    'caris.svp': [
        '[SVP_VERSION_2]', 'caris.svp', 'Section 2012-123 10:20:30 43:04:00 -070:42:00',
        *lines(ROWS + UP), 'Section 2012-124 10:20:30 43:04:00 -070:42:00', '0 1600', '50 1600',
    ],
    'kongsberg.asvp': [
        '( SoundVelocity  1.0 0 201203151200 43.06 -70.7 -1 0 0 OMS_ P 0004 )', *lines(ROWS),
    ],
    'seabird.cnv': [
        '* Sea-Bird SBE19plus Data File:', '# nquan = 4', '# name 0 = prDM: Pressure [db]',
        '# name 1 = depSM: Depth [salt water, m]', '# name 2 = t090C: Temperature [deg C]',
        '# name 3 = svCM: Sound Velocity [Chen-Millero, m/s]', '*END*',
        *lines([(depth * 1.01, depth, 8.0, speed) for depth, speed in ROWS + UP]),
        ' 1 -9.990e-29 8 1500',
    ],
    'plain.csv': ['Depth (m),Temperature,Sound Velocity (m/s)',
                  *(f'{depth},8,{speed}' for depth, speed in ROWS)],
    'german.csv': ['Tiefe;Schallgeschwindigkeit',
                   *(f'{depth};{speed}'.replace('.', ',') for depth, speed in ROWS)],
    'bare.txt': lines(ROWS),
    'negative.csv': ['depth,speed', *(f'{-depth},{speed}' for depth, speed in ROWS)],
}  # fmt: skip


def write(path, rows):
    path.write_text('\n'.join(rows) + '\n')
    return path


def test_every_format_gives_the_same_profile(tmp_path):
    for name, rows in FILES.items():
        profile = read_profile(write(tmp_path / name, rows))
        assert profile.depth == pytest.approx(DEPTH) and profile.speed == pytest.approx(SPEED)


def test_duplicates_upcasts_and_spikes_go_and_a_long_cast_keeps_what_it_needs(tmp_path):
    rows = [(0.5, 1490.0), (0.5, 1490.2), (10.0, 1488.0), (12.0, 0.0), (5.0, 1489.0), *ROWS[2:]]
    path = write(tmp_path / 'a.asvp', ['( SoundVelocity )', *lines(rows + UP), '22 nan', 'x y'])
    profile = read_profile(path)
    assert profile.depth == pytest.approx([0.5, 5.0, 10.0, 20.0, 35.0])
    assert profile.speed == pytest.approx([1490.1, 1489.0, 1488.0, 1485.5, 1480.2])
    depth = np.linspace(0.0, 400.0, 4001)
    speed = 1480.0 + 20.0 * np.exp(-depth / 30.0) + 0.01 * depth
    profile = read_profile(write(tmp_path / 'a.txt', lines(zip(depth, speed))))
    assert len(profile.depth) <= MOST_POINTS
    assert np.abs(profile.at(depth) - speed).max() < 0.02


def test_what_is_no_profile_is_one_sentence(tmp_path):
    for rows, word in (
        (['depth,temperature', '1,8'], 'no column of sound speed'), ([''], 'no column of depth'),
        (['1 2 3', '4 5 6'], 'columns without names'),
        (['depth,speed', '1,15', '2,16'], 'between 1300 and 1700'),
    ):  # fmt: skip
        with pytest.raises(BagError, match=word):
            read_profile(write(tmp_path / 'a.csv', rows))
    with pytest.raises(BagError, match='cannot be read'):
        read_profile(tmp_path / 'absent.svp')


def test_track_takes_the_mean_of_a_profile_for_divers(tmp_path):
    # That of a vertical path: the integral of 1 / (1400 + 20 z) over 10 m.
    straight = Profile(np.array([0.0, 10.0]), np.array([1400.0, 1600.0]))
    assert mean_speed(straight) == pytest.approx(200.0 / np.log(1600.0 / 1400.0), rel=1e-6)
    write_dive(tmp_path / 'bag', count=5)
    path = write(tmp_path / 'a.svp', FILES['caris.svp'])
    speed = parameters_of(tmp_path / 'bag', tmp_path / 'out', '--sound-speed', path)['sound_speed']
    assert speed == pytest.approx(mean_speed(read_profile(path)), abs=1e-3)
    none = ('--sound-speed', tmp_path / 'absent.svp')
    assert run('track', tmp_path / 'bag', tmp_path / 'no', *none) == 2
