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

from contextlib import ExitStack
import threading
import time

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Fix
from sonar_imm.nodes import lockstep as lockstep_module
from sonar_imm.nodes import player as player_module
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.harness import reserved_domain_id
from sonar_imm.nodes.link import Link, LinkError
from sonar_imm.nodes.lockstep import LockStep, Recorder
from sonar_imm.nodes.player import NAME, Pace, play, Player, PlayOptions
from sonar_imm.nodes.qos import lockstep_qos, profiles_of
from sonar_imm.parameters import ConfigError
from sonar_imm.recordings.messages import ros_message
from sonar_imm.recordings.reader import BagError, BagReader
from sonar_imm.recordings.writer import BagWriter

START = 1_700_000_000 * 10**9
STEP = 10**7
COUNT = 20


@pytest.fixture
def domain(monkeypatch):
    """A ROS domain of this test's own: a player brings a context of its own."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with reserved_domain_id() as domain_id:
        yield domain_id


@pytest.fixture
def bag(tmp_path):
    """Twenty fixes 10 ms apart, the fourth not a number, and a second topic with one message."""
    path = tmp_path / 'bag'
    with BagWriter(path) as writer:
        for k in range(COUNT):
            message = write_fix(
                Fix(
                    stamp_ns=START + k * STEP,
                    position=(float(k), 0.0, 0.0),
                    covariance=np.eye(2),
                    frame_id='map',
                ),
                ros_message,
            )
            if k == 3:
                message.pose.pose.position.x = float('nan')
            writer.write('/fix', message, START + k * STEP)
        writer.write('/other', ros_message('std_msgs/msg/Float64', data=1.5), START)
    return path


class Ear:
    """Hears everything on a topic, though it only listens when asked."""

    def __init__(self, link, message_type, topic):
        self.link, self.heard = link, []
        link.node.create_subscription(message_type, topic, self.heard.append, lockstep_qos())

    def positions(self, count):
        assert self.link.wait_for(lambda: len(self.heard) >= count, 10.0)
        return [message.pose.pose.position.x for message in self.heard]


@pytest.fixture
def link(domain):
    with Link('listener', domain_id=domain) as link:
        yield link


def test_a_bag_is_played_in_order_with_its_stamps(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/fix')
    progress = []
    result = play(bag, PlayOptions(rate=5.0), domain_id=domain, progress=progress.append)
    assert result.published == COUNT + 1 == sum(progress)
    assert result.problems == ()
    positions = ear.positions(COUNT)
    np.testing.assert_array_equal(positions, [np.nan if k == 3 else k for k in range(COUNT)])
    stamp = ear.heard[-1].header.stamp
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
        (profile,) = (one.qos_profile for one in player._publishers.values())
        assert profile.durability.name == 'TRANSIENT_LOCAL' and profile.depth == 7
        player.run()
        assert player.result().published == 11
    link.wait_for(lambda: len(ear.heard) == 11, 5.0)
    assert [round(one.pose.pose.position.x) for one in ear.heard] == list(range(5, 16))


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
    link.wait_for(lambda: len(ear.heard) >= 5, 10.0)
    ticks = [tick.clock.sec * 10**9 + tick.clock.nanosec for tick in ear.heard]
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
    assert link.wait_for(client.service_is_ready, 15.0)
    assert not ear.heard
    future = client.call_async(Trigger.Request())
    assert link.wait_for(future.done, 15.0)
    thread.join(15.0)
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


class Live:
    """A walker node that runs in a thread, as if it were a process of its own."""

    def __init__(self, domain_id, *arguments):
        self.link = Link(f'beside_{len(arguments)}', domain_id=domain_id)
        self.node = TrackerNode(
            'walker', context=self.link.context, cli_args=['--ros-args', *arguments]
        )
        self.executor = SingleThreadedExecutor(context=self.link.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin)
        self.thread.start()

    def end(self):
        self.executor.shutdown()
        self.thread.join(10.0)
        self.node.destroy_node()
        self.link.__exit__()


RELIABLE = (
    '-p',
    'qos_overrides./fix.subscription.reliability:=reliable',
    '-p',
    'qos_overrides./fix.subscription.history:=keep_all',
)


@pytest.fixture
def start(walker, domain):
    """Start live walkers, all ended with the test."""
    started = []

    def start(*parameters):
        started.append(Live(domain, *parameters))
        return started[-1]

    yield start
    for live in started:
        live.end()


@pytest.fixture
def stepping(bag, link):
    """Make a player in lock-step with the walker, and the recorder of its estimates."""
    with ExitStack() as stack:

        def stepping(**options):
            reader = stack.enter_context(BagReader(bag))
            recorder = Recorder(link, '/walker')
            step = LockStep(link, '/walker', recorder=recorder)
            chosen = PlayOptions(lockstep='/walker', **options)
            return Player(reader, link, chosen, step), recorder, step

        yield stepping


def test_lockstep_gets_the_estimate_of_every_message(link, start, stepping):
    start(*RELIABLE)
    player, recorder, step = stepping()
    player.run()
    assert player.result().published == COUNT + 1  # the other topic goes along, unanswered
    assert step.counts == (COUNT, 1, COUNT - 1)
    assert len(player.result().delays) == COUNT - 1
    used = [float(k) for k in range(COUNT) if k != 3]
    assert [e.state[0, 0] for e in recorder.estimates()] == [
        pytest.approx(np.mean(used[: k + 1])) for k in range(COUNT - 1)
    ]


def test_a_second_player_counts_from_where_the_node_stands(link, start, stepping):
    start(*RELIABLE)
    first, _, _ = stepping()
    first.run()
    second, recorder, step = stepping(start_offset=0.1)
    second.run()
    assert step.counts == (COUNT - 10, 0, 0)  # all duplicates: answered without an estimate
    assert len(recorder) == 0


def test_lockstep_finds_the_only_node_and_asks_where_there_are_two(
    bag, start, domain, monkeypatch
):
    start(*RELIABLE)
    result = play(bag, PlayOptions(lockstep='auto'), domain_id=domain)
    assert len(result.delays) == COUNT - 1
    start('-r', '__node:=other')
    monkeypatch.setattr(lockstep_module, '_SECOND_LOOK', 15.0)
    with pytest.raises(LinkError, match='several nodes run: say which of /other, /walker'):
        play(bag, PlayOptions(lockstep='auto'), domain_id=domain)


def test_lockstep_without_a_node_says_so(link, stepping):
    player, _, _ = stepping()
    with pytest.raises(LinkError, match="no answer from a node '/walker'"):
        player.run(start_limit=0.3)


def test_lockstep_names_the_type_the_node_expects(link, start, monkeypatch, stepping):
    monkeypatch.setattr(lockstep_module, 'MATCH_LIMIT', 3.0)
    start('-p', 'fix_type:=geometry_msgs/msg/PointStamped')
    player, _, _ = stepping(topics=('/fix',))
    with pytest.raises(LinkError, match='expects geometry_msgs/msg/PointStamped on /fix'):
        player.run()


def test_lockstep_says_when_no_topic_fits(link, start, monkeypatch, stepping):
    monkeypatch.setattr(lockstep_module, 'MATCH_LIMIT', 0.5)
    start()
    player, _, _ = stepping(topics=('/other',))
    with pytest.raises(LinkError, match=r'listens to none of the topics of the bag \(/other\)'):
        player.run()


def test_lockstep_notices_a_node_that_does_not_answer(link, start, monkeypatch, stepping):
    monkeypatch.setattr(lockstep_module, 'ANSWER_LIMIT', 0.3)
    live = start(*RELIABLE)
    release = threading.Event()
    monkeypatch.setattr(live.node.tracker, 'process', lambda m: release.wait(20.0) and [])
    player, _, _ = stepping()
    try:
        with pytest.raises(LinkError, match='did not answer message 1 on /fix within 0.3 s'):
            player.run()
    finally:
        release.set()


def test_lockstep_notices_somebody_else_who_publishes(link, start, stepping):
    start(*RELIABLE)
    other = link.node.create_publisher(PoseWithCovarianceStamped, '/fix', lockstep_qos())
    player, _, _ = stepping()
    link.wait_for(other.get_subscription_count, 15.0)

    def meddle(count):
        other.publish(PoseWithCovarianceStamped())

    with pytest.raises(LinkError, match="something else publishes to the node '/walker'"):
        player.run(meddle)


def test_recorded_estimates_read_back(link, start, stepping):
    start(*RELIABLE)
    player, recorder, _ = stepping(topics=('/fix',))
    player.run()
    estimate = recorder.estimates()[0]
    assert estimate.frame_id == 'map'
    assert estimate.model_names == ('slow', 'fast')


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
    assert link.wait_for(lambda: len(ear.heard) == 3, 10.0)
    assert [(m.header.stamp.sec, m.header.frame_id, m.point.x) for m in ear.heard] == [
        (100, 'map', 0.0),
        (101, 'map', 1.0),
        (102, 'map', 2.0),
    ]
