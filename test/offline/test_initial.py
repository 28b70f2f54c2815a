# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Starts of tracks from a file."""

import json

from helpers.dive_bags import write_dive
from helpers.dive_scenes import SECOND, START_NS
import numpy as np
import pytest

from sonar_imm.measurements import NOBODY
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.initial import read_initial
from sonar_imm_tools.offline.tracking import InputOptions, OfflineRun
from sonar_imm_tools.recordings.reader import BagError, BagReader

DIVER = SYSTEMS['diver']
MESSAGE = f"""
header: {{stamp: {{sec: 1700000003, nanosec: 500000000}}, frame_id: map}}
pose:
  pose: {{position: {{x: 2.0, y: -3.5, z: 0.0}}, orientation: {{w: 1.0}}}}
  covariance: [4, 0.5, 0, 0, 0, 0, 0.5, 9, 0, 0, 0, 0, {', '.join(['0'] * 24)}]
"""


def written(tmp_path, text, name='places.yaml'):
    path = tmp_path / name
    path.write_text(text, encoding='utf-8')
    return path


def test_yaml_json_and_the_message_say_the_same(tmp_path):
    place = {
        'position': [2.0, -3.5],
        'covariance': [[4, 0.5], [0.5, 9]],
        'time': 1_700_000_003.5,
        'frame_id': 'map',
    }
    texts = [MESSAGE, json.dumps(place), json.dumps([place])]
    texts += [json.dumps({**place, 'time': '2023-11-14T22:13:23.5Z'})]
    for flat in ([4, 0.5, 0.5, 9], [4, 0.5, 0, 0.5, 9, 0, 0, 0, 1]):
        texts.append(json.dumps({**place, 'covariance': flat}))
    found = [read_initial(written(tmp_path, text)) for text in texts]
    assert all(each == found[0] for each in found)
    start = found[0][0].start(0, {})
    assert start.stamp_ns == 1_700_000_003 * SECOND + SECOND // 2
    assert start.position.tolist() == [2.0, -3.5, 0.0] and start.target_id == NOBODY
    np.testing.assert_allclose(start.covariance[:2, :2], [[4.0, 0.5], [0.5, 9.0]])


@pytest.mark.parametrize(
    'text, words',
    [
        ('', 'the file is empty'),
        ('[]', 'the file is empty'),
        ('3', 'a place needs position and covariance'),
        ('{position: [1, 2]}', 'covariance is missing'),
        ('{covariance: [1, 0, 0, 1]}', 'position is missing'),
        ('{position: [1], covariance: [1, 0, 0, 1]}', 'two or three numbers'),
        ('{position: [1, .nan], covariance: [1, 0, 0, 1]}', 'not finite'),
        ('{position: [1, two], covariance: [1, 0, 0, 1]}', "'two' in place of a number"),
        ('{position: [1, 2], covariance: [1, 0, 0]}', '4, 9 or 36 numbers'),
        ('{position: [1, 2], covariance: [0, 0, 0, 0]}', 'covariance'),
        ('{position: [1, 2], covariance: [1, 5, 5, 1]}', 'covariance'),
        ('{position: [1, 2], covariance: [1, 0, 0, 1], time: noon}', "time 'noon'"),
        ('{position: [1, 2], covariance: [1, 0, 0, 1], where: here}', 'where is not one of'),
        ('[{position: [1, 2], covariance: [1, 0, 0, 1]}, 7]', 'place 2:'),
        ('{position: [1, 2', 'not a YAML file'),
        ('pose: 3', 'pose needs'),
    ],
)
def test_a_bad_file_gets_one_sentence(tmp_path, text, words):
    with pytest.raises(ConfigError, match='--initial') as caught:
        read_initial(written(tmp_path, text))
    assert words in str(caught.value) and '\n' not in str(caught.value)


def test_a_missing_file_gets_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match='No such file'):
        read_initial(tmp_path / 'nothing.yaml')


def tracked(tmp_path, *places, **parameters):
    path = written(tmp_path, json.dumps(list(places)))
    config = DIVER.config_type()(**parameters)
    with BagReader(write_dive(tmp_path / 'dive', count=30)) as bag:
        run = OfflineRun(bag, DIVER, config, InputOptions(initial=read_initial(path)))
        return run, list(run.estimates())


def test_a_track_begins_where_and_when_the_file_says(tmp_path):
    place = {'position': [0.0, 0.0], 'covariance': [4, 0, 0, 4]}
    run, estimates = tracked(tmp_path, place)
    assert estimates[0].stamp_ns == START_NS
    assert (estimates[0].extras['track_state'] == 1).any()
    assert run.recipe()['initial'][0]['position'] == (0.0, 0.0, 0.0)


def test_a_name_of_tags_goes_with_the_start(tmp_path):
    place = {'position': [500.0, 0.0], 'covariance': [4, 0, 0, 4], 'name': 'anna'}
    _, estimates = tracked(tmp_path, place, tags=('bob', 'anna'))
    assert 2 in estimates[0].extras['target_id']


def test_an_unknown_name_is_refused_before_the_run(tmp_path):
    place = {'position': [0.0, 0.0], 'covariance': [4, 0, 0, 4], 'name': 'carl'}
    with pytest.raises(BagError, match="no target is called 'carl': bob are known"):
        tracked(tmp_path, place, tags=('bob',))


def test_a_start_after_the_recording_is_counted_as_refused(tmp_path):
    place = {'position': [0.0, 0.0], 'covariance': [4, 0, 0, 4], 'time': 1_800_000_000}
    run, _ = tracked(tmp_path, place)
    assert run.refusals()['outside']['count'] == 1


def test_the_command_takes_the_file(tmp_path, capsys):
    bag = str(write_dive(tmp_path / 'dive', count=20))
    path = written(tmp_path, '{position: [0, 0], covariance: [4, 0, 0, 4]}')
    assert main(['track', bag, str(tmp_path / 'out'), '--initial', str(path)]) == 0
    run = json.loads((tmp_path / 'out' / 'run.json').read_text(encoding='utf-8'))
    assert run['initial'][0]['covariance'] == [4.0, 0.0, 0.0, 4.0]
    bad = written(tmp_path, '{position: [0, 0]}', 'bad.yaml')
    assert main(['track', bag, str(tmp_path / 'other'), '--initial', str(bad)]) != 0
    assert 'covariance is missing' in capsys.readouterr().err
