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

"""What is shown of recordings: order, jumps, definitions, what cannot be shown."""

import json
import shutil

import pytest

from msg_adapters.estimates import read_estimate
from msg_adapters.headers import stamp_ns
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.messages import decode_cdr, ros_message, typestore
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.resources import shared_file
from sonar_imm_tools.viewing.material import Material, opened, Recording

START = 10**18


def text(value):
    return ros_message('std_msgs/msg/String', data=value)


@pytest.fixture
def bags(tmp_path):
    """Two recordings; the topic /both is in each."""
    written = {
        'one': [('/a', 'a0', 0), ('/both', 'one', 1), ('/a', 'a4', 4)],
        'two': [('/b', 'b2', 2), ('/both', 'two', 3), ('/b', 'b6', 6)],
    }
    for name, messages in written.items():
        with BagWriter(tmp_path / name) as writer:
            for topic, value, seconds in messages:
                writer.write(topic, text(value), START + seconds * 10**9)
    return [tmp_path / name for name in written]


@pytest.fixture
def show(bags):
    """Makes the material of both recordings."""
    with BagReader(bags[0]) as item, BagReader(bags[1]) as two:
        yield lambda *topics: Material([Recording(item), Recording(two)], topics)


def shown(material, seconds=None):
    from_ns = None if seconds is None else START + round(seconds * 1e9)
    return [
        (message.topic, (message.log_ns - START) // 10**9, message.raw[8:-1].decode())
        for message in material.messages(from_ns)
    ]


ALL = [('/a', 0, 'a0'), ('/both', 1, 'one'), ('/b', 2, 'b2'), ('/a', 4, 'a4'), ('/b', 6, 'b6')]


def test_recordings_are_merged_and_of_a_topic_the_first_counts(show):
    material = show()
    assert shown(material) == ALL
    assert shown(material) == ALL  # again from the start
    assert (material.first_ns, material.last_ns) == (START, START + 6 * 10**9)
    assert material.problems == []


def test_a_jump_begins_with_the_newest_of_each_topic(show):
    assert shown(show(), 3.5) == ALL
    assert shown(show(), 5) == [ALL[1], ALL[2], ALL[3], ALL[4]]
    assert shown(show(), 99) == [ALL[1], ALL[3], ALL[4]]


def test_channels_have_the_whole_definition(show):
    material = show('/b')
    (channel,) = material.channels.values()
    assert (channel.topic, channel.type_name) == ('/b', 'std_msgs/msg/String')
    assert channel.definition.split() == ['string', 'data']
    assert shown(material) == [ALL[2], ALL[4]]


@pytest.mark.parametrize('topics', [['/nowhere'], ['/a', '/nowhere']])
def test_a_topic_that_is_not_there_is_said(show, topics):
    with pytest.raises(BagError, match="no topic '/nowhere'"):
        show(*topics)


def test_a_recording_without_a_message_is_said(tmp_path):
    with BagWriter(tmp_path / 'empty'):
        pass
    with pytest.raises(BagError, match='nothing to show'), opened(tmp_path / 'empty'):
        pass


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """A shipped recording with a diver, tracked."""
    path = tmp_path_factory.mktemp('view') / 'run'
    assert main(['track', str(shared_file('bags/diver_multistatic')), str(path)]) == 0
    return path


def test_a_run_is_shown_with_its_drawings_and_its_recording(run):
    with opened(run) as (material, problems):
        assert problems == []
        of_the_node = {'/diver/estimate', '/diver/odometry', '/diver/model_probabilities'}
        assert set(material.channels) >= of_the_node | {'/arrivals', '/truth/estimate'}
        messages = list(material.messages())
    with BagReader(run / 'estimate') as bag:
        estimates = [read_estimate(item.message) for item in bag.messages(['/diver/estimate'])]
    drawn = [
        decode_cdr(typestore(), 'nav_msgs/msg/Odometry', message.raw)
        for message in messages
        if message.topic == '/diver/odometry'
    ]
    confirmed = [
        (estimate.stamp_ns, *state[:2])
        for estimate in estimates
        for state in estimate.state[estimate.extras['track_state'] >= 1]
    ]
    places = [item.pose.pose.position for item in drawn]
    assert [(stamp_ns(item), at.x, at.y) for item, at in zip(drawn, places)] == confirmed
    assert len(confirmed) > 50


def test_a_run_whose_recording_is_gone_is_shown_alone(run, tmp_path):
    alone = tmp_path / 'alone'
    shutil.copytree(run, alone)
    content = json.loads((run / 'run.json').read_text())
    (alone / 'run.json').write_text(json.dumps({**content, 'bag': str(tmp_path / 'gone')}))
    with opened(alone) as (material, problems):
        assert problems == [f'{tmp_path / "gone"} is gone: only the estimates are shown']
        assert '/arrivals' not in material.channels and '/diver/odometry' in material.channels


def test_both_sides_of_a_sonar_are_shown_each_below_its_name(tmp_path):
    scene = ['simulate', 'bathymetry', str(tmp_path / 'bag'), '--scenario', 'moving_two_sides']
    small = ['--set', 'pings=2', '--set', 'last_range=20', '--set', 'bin_width=0.2']
    assert main([*scene, *small]) == 0
    given = ['--set', 'particles_per_model=20']
    assert main(['track', str(tmp_path / 'bag'), str(tmp_path / 'run'), *given]) == 0
    with opened(tmp_path / 'run') as (material, problems):
        assert problems == []
        assert any(name.endswith('/bathymetry/estimate') for name in material.channels)
        assert list(material.messages())


def test_runs_of_several_recordings_are_not_mixed(run, tmp_path):
    bags = [str(shared_file(f'bags/{name}')) for name in ('diver_table1', 'diver_multistatic')]
    assert main(['track', *bags, str(tmp_path / 'out')]) == 0
    with pytest.raises(BagError, match='holds runs of 2 recordings'), opened(tmp_path / 'out'):
        pass
    for path in (tmp_path / 'out').glob('*/run.json'):  # now two instruments of the same one
        path.write_text(json.dumps({**json.loads(path.read_text()), 'bag': bags[0]}))
    with opened(tmp_path / 'out') as (material, _):
        names = {name for name in material.channels if name.endswith('/diver/odometry')}
        assert names == {f'/diver_{name}/diver/odometry' for name in ('table1', 'multistatic')}
