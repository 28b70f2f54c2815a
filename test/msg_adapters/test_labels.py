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

"""Names of tags and sensors, from topics and frames."""

import numpy as np

from msg_adapters.inputs import inputs_of
from msg_adapters.inputs.topic import Labels, tag_numbers
from sonar_imm.measurements import Fix, Fixes, NOBODY

BOTH = ('tags', 'sensors')


def fix(frame_id='map', **values):
    return Fix(stamp_ns=5, position=(1.0, 2.0, 0.0), frame_id=frame_id, **values)


def label(topic, measurement, **settings):
    labels = Labels.of(topic, settings, BOTH)
    return measurement if labels is None else labels(measurement)


def test_tags_are_numbers_or_their_place_in_the_list():
    assert tag_numbers(['12', '7']) == {'12': 12, '7': 7}
    assert tag_numbers(['amy', '7']) == {'amy': 1, '7': 2}
    assert tag_numbers(['amy', 'bob', 'amy']) == {'amy': 1, 'bob': 2}
    assert tag_numbers([]) == {}


def test_a_part_of_the_topic_is_a_name_and_a_part_of_that_is_none():
    tags = {'tags': ['amy', 'bob']}
    assert label('/divers/bob/fix', fix(), **tags).target_id == 2
    assert label('/divers/bobby/fix', fix(), **tags).target_id == NOBODY
    assert label('bob/fix', fix(), **tags).target_id == 2


def test_a_frame_is_a_name_and_then_the_frame_is_the_map():
    named = label('/fix', fix('amy'), tags=['amy'], map_frame='odom')
    assert (named.target_id, named.frame_id) == (1, 'odom')
    other = label('/fix', fix('map'), tags=['amy'])
    assert (other.target_id, other.frame_id) == (NOBODY, 'map')


def test_what_a_message_says_itself_stays():
    assert label('/bob/fix', fix(target_id=40), tags=['bob']).target_id == 40


def test_sensors_are_labelled_and_scans_are_no_tags():
    scan = Fixes(stamp_ns=5, position=np.empty((0, 3)))
    labels = Labels.of('/radar/fixes', {'sensors': ['radar'], 'tags': ['amy']}, ('sensors',))
    assert labels(scan).sensor == 'radar'
    assert label('/radar/fix', fix(), sensors=['radar']).sensor == 'radar'


def test_without_names_nothing_is_labelled():
    assert Labels.of('/bob/fix', {'tags': [], 'sensors': []}, BOTH) is None


def test_each_name_has_a_topic_of_its_own():
    by_name = {entry.name: entry for entry in inputs_of('diver')}
    settings = {'tags': ['amy'], 'sensors': ['radar']}
    assert by_name['fix'].instances(settings) == ('fix', 'amy/fix', 'radar/fix')
    assert by_name['fixes'].instances(settings) == ('fixes', 'radar/fixes')
    assert by_name['nav'].instances(settings) == ('nav',)
