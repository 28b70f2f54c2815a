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

"""Playing bags: pace, selection, clock, pause and lock-step, with real publishers."""

import threading
import time

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from helpers.fix_bags import COUNT, Ear, START, STEP, write_fixes
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from sonar_imm.nodes.qos import profiles_of
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.replay import player as player_module
from sonar_imm_tools.replay.link import Link
from sonar_imm_tools.replay.player import NAME, Pace, play, Player, PlayOptions


@pytest.fixture
def bag(tmp_path):
    return write_fixes(tmp_path / 'bag')


def test_a_bag_is_played_in_order_with_its_stamps(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/fix')
    progress = []
    result = play(bag, PlayOptions(rate=5.0), domain_id=domain, progress=progress.append)
    assert result.published == COUNT + 1 == sum(progress)
    assert result.problems == ()
    positions = ear.positions(COUNT)
    np.testing.assert_array_equal(positions, [np.nan if k == 3 else k for k in range(COUNT)])
    stamp = ear.received[-1].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == START + (COUNT - 1) * STEP


def test_topics_remapping_and_offset(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/usbl')
    result = play(
        bag,
        PlayOptions(topics=('/fix',), remap={'/fix': '/usbl'}, start_offset=0.1),
        domain_id=domain,
    )
    assert result.published == COUNT - 10
    assert ear.positions(COUNT - 10) == list(range(10, COUNT))


def test_a_stretch_without_a_topic_and_with_another_quality_of_service(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/fix')
    text = '/fix:\n  reliability: reliable\n  durability: transient_local\n  depth: 7\n'
    options = PlayOptions(
        rate=100.0,
        start_offset=0.05,
        playback_duration=0.1,
        exclude_topics=('/other',),
        qos=profiles_of(text),
    )
    with BagReader(bag) as reader, Link(NAME, domain_id=domain) as peer:
        player = Player(reader, peer, options)
        (publisher,) = player._publishers.values()
        profile = publisher.qos_profile
        assert profile.durability.name == 'TRANSIENT_LOCAL' and profile.depth == 7
        # Both sides have to know of each other, which on a busy machine takes seconds.
        assert peer.wait_for(publisher.get_subscription_count, 60.0)
        assert link.wait_for(ear.subscription.get_publisher_count, 60.0)
        player.run()
        assert player.result().published == 11
    link.wait_for(lambda: len(ear.received) == 11, 5.0)
    assert [round(message.pose.pose.position.x) for message in ear.received] == list(range(5, 16))


def test_the_pace_follows_the_log_times(bag, link, domain):
    Ear(link, PoseWithCovarianceStamped, '/fix')
    start = time.monotonic()
    play(bag, PlayOptions(rate=0.5, topics=('/fix',)), domain_id=domain)
    assert time.monotonic() - start >= (COUNT - 1) * STEP / 1e9 / 0.5


def test_playing_to_nobody_is_noticed(bag, domain, monkeypatch):
    monkeypatch.setattr(player_module, '_FIRST_LISTENER', 0.2)
    result = play(bag, PlayOptions(rate=10.0), domain_id=domain)
    assert result.published == COUNT + 1
    assert result.problems == ('nobody was listening when playing began',)


def test_pace_maps_both_ways_and_allows_for_pauses():
    pace = Pace(START, rate=2.0)
    assert pace.seconds_until(START + 2 * 10**9) == pytest.approx(1.0, abs=0.05)
    pace.postpone(3.0)
    assert pace.seconds_until(START + 2 * 10**9) == pytest.approx(4.0, abs=0.05)
    assert pace.now_ns() == pytest.approx(START - 6 * 10**9, abs=10**8)


def test_the_clock_runs_along(bag, link, domain):
    ear = Ear(link, Clock, '/clock')
    Ear(link, PoseWithCovarianceStamped, '/fix')
    play(bag, PlayOptions(clock=100.0, topics=('/fix',)), domain_id=domain)
    link.wait_for(lambda: len(ear.received) >= 5, 10.0)
    ticks = [tick.clock.sec * 10**9 + tick.clock.nanosec for tick in ear.received]
    assert ticks == sorted(ticks)
    assert START <= ticks[0] <= ticks[-1] <= START + COUNT * STEP


class Enough(Exception):
    """Ends a loop from its progress callback."""


def test_a_loop_starts_over_with_the_recorded_stamps(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/fix')
    played = []

    def progress(count):
        played.append(count)
        # Well beyond what is looked at: what is sent last may be lost when a player breaks off.
        if len(played) == 2 * COUNT:
            raise Enough

    with pytest.raises(Enough):
        play(
            bag,
            PlayOptions(loop=True, topics=('/fix',), rate=10.0),
            domain_id=domain,
            progress=progress,
        )
    assert ear.positions(COUNT + 4)[COUNT : COUNT + 3] == [0.0, 1.0, 2.0]


def test_a_paused_player_waits_for_resume(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/fix')
    results = []
    thread = threading.Thread(
        target=lambda: results.append(
            play(bag, PlayOptions(start_paused=True, rate=10.0), domain_id=domain)
        )
    )
    thread.start()
    client = link.node.create_client(Trigger, f'/{NAME}/resume')
    assert link.wait_for(client.service_is_ready, 120.0)
    assert not ear.received
    future = client.call_async(Trigger.Request())
    assert link.wait_for(future.done, 120.0)
    thread.join(120.0)
    assert results[0].published == COUNT + 1
    assert len(ear.positions(COUNT)) == COUNT


@pytest.mark.parametrize(
    'options, sentence',
    [
        ({'topics': ('/fxi',)}, r"has no topic '/fxi' \(did you mean '/fix'\?\)"),
        ({'remap': {'/fxi': '/x'}}, "has no topic '/fxi'"),
        ({'rate': 0.0}, 'the rate must be positive, got 0'),
        ({'rate': float('nan')}, 'the rate must be positive, got nan'),
        ({'start_offset': float('nan')}, 'the start_offset must not be negative, got nan'),
        ({'delay': -1.0}, 'the delay must not be negative, got -1'),
        ({'clock': -1.0}, 'the clock must be positive, got -1'),
    ],
)
def test_what_cannot_be_played_is_said(bag, domain, options, sentence):
    with pytest.raises(ConfigError, match=sentence):
        play(bag, PlayOptions(**options), domain_id=domain)


def test_a_bag_without_messages_is_said(tmp_path, domain):
    with BagWriter(tmp_path / 'empty'):
        pass
    with pytest.raises(BagError, match='nothing to publish'):
        play(tmp_path / 'empty', PlayOptions(), domain_id=domain)


def test_a_ros_1_bag_is_played_as_ros_2_messages(tmp_path, link, domain):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import get_typestore, Stores

    types = get_typestore(Stores.ROS1_NOETIC)
    make_of = types.types
    with Writer(tmp_path / 'old.bag') as writer:
        name = 'geometry_msgs/msg/PointStamped'
        topic = writer.add_connection('/fix', name, typestore=types)
        for k in range(3):
            stamp = make_of['builtin_interfaces/msg/Time'](sec=100 + k, nanosec=5)
            header = make_of['std_msgs/msg/Header'](seq=k, stamp=stamp, frame_id='map')
            point = make_of['geometry_msgs/msg/Point'](x=float(k), y=2.0, z=3.0)
            message = make_of[name](header=header, point=point)
            writer.write(topic, (100 + k) * 10**9, types.serialize_ros1(message, name))
    ear = Ear(link, PointStamped, '/fix')
    assert play(tmp_path / 'old.bag', PlayOptions(rate=100.0), domain_id=domain).published == 3
    assert link.wait_for(lambda: len(ear.received) == 3, 10.0)
    assert [(m.header.stamp.sec, m.header.frame_id, m.point.x) for m in ear.received] == [
        (100, 'map', 0.0),
        (101, 'map', 1.0),
        (102, 'map', 2.0),
    ]
