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

"""The words on the command line of ``play``, and its file of qualities of service."""

import pytest

from sonar_imm.nodes.qos import profiles_of
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.replay import player as player_module


@pytest.mark.parametrize(
    'text, sentence',
    [
        ('/fix: {depth: many}', "depth must be a whole number, got 'many'"),
        ('/fix: {reliability: often}', "reliability is one of .*, got 'often'"),
        ('/fix: {deadline: 1}', "'deadline' is none of depth, history"),
        ('/fix: 5', 'a mapping of policies for each topic'),
        ('{[', 'not a YAML file'),
    ],
)
def test_files_of_qualities_of_service_are_checked(text, sentence):
    with pytest.raises(ConfigError, match=sentence):
        profiles_of(text)


def test_a_file_of_qualities_of_service_says_what_it_says_and_the_rest_is_reliable():
    lines = (
        '/all: {history: keep_all}',
        '/quick: {reliability: best_effort, depth: 3}',
        '/rest: {}',
    )
    profiles = profiles_of('\n'.join(lines))
    values = {
        topic: (profile.history.name, profile.reliability.name, profile.durability.name)
        for topic, profile in profiles.items()
    }
    assert values == {
        '/all': ('KEEP_ALL', 'RELIABLE', 'VOLATILE'),
        '/quick': ('KEEP_LAST', 'BEST_EFFORT', 'VOLATILE'),
        '/rest': ('KEEP_LAST', 'RELIABLE', 'VOLATILE'),
    }
    assert (profiles['/quick'].depth, profiles['/rest'].depth) == (3, 10)


@pytest.mark.parametrize(
    'words, topics, excluded, remaps',
    [
        (('--topics', '/a', '/b'), ('/a', '/b'), (), {}),
        (('--topics', '/a', '--topics', '/b'), ('/a', '/b'), (), {}),
        (('--exclude-topics', '/a', '/b', '-l'), (), ('/a', '/b'), {}),
        (('-m', '/a:=/c', '/b:=/d', '--rate', '2'), (), (), {'/a': '/c', '/b': '/d'}),
    ],
)
@pytest.mark.parametrize('bag_first', [True, False])
def test_options_take_several_words_as_those_of_ros2_bag_play(
    tmp_path, monkeypatch, words, topics, excluded, remaps, bag_first
):
    asked = []

    def played(path, options, progress):
        asked.append(options)
        return player_module.PlayResult(0, ())

    monkeypatch.setattr(player_module, 'play', played)
    bag = tmp_path / 'bag'
    with BagWriter(bag) as writer:
        writer.write('/a', ros_message('std_msgs/msg/String', data='x'), 10**9)
    arguments = [str(bag), *words] if bag_first else [*words, str(bag)]
    assert main(['play', *arguments]) == 0
    (options,) = asked
    assert (options.topics, options.exclude_topics) == (topics, excluded)
    assert options.remap == remaps
