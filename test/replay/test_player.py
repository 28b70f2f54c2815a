# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Playing bags: pace, selection, clock, pause and lock-step, with real publishers."""

import contextlib
import os
import threading
from types import SimpleNamespace

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from helpers.node_bench import COUNT, Ear, START, STEP, write_fixes
import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import get_typestore, Stores
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from msg_adapters.fixes import write_fix
from sonar_imm.files import lock
from sonar_imm.measurements import Fix
from sonar_imm.nodes.qos import profiles_of
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.replay import harness
from sonar_imm_tools.replay import player as player_module
from sonar_imm_tools.replay.harness import LockstepResult, reserved_domain_id, run_lockstep
from sonar_imm_tools.replay.link import Link, LinkError
from sonar_imm_tools.replay.lockstep import Counts
from sonar_imm_tools.replay.player import NAME, Pace, Pause, play, Player, PlayOptions, Ticker


@pytest.fixture
def bag(tmp_path):
    return write_fixes(tmp_path / 'bag')


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """Listeners are waited for, and hear the last message, however busy the machine is."""
    monkeypatch.setattr(player_module, '_FIRST_LISTENER', 60.0)
    monkeypatch.setattr(player_module, '_LAST_MESSAGES', 60.0)


def test_a_bag_is_played_in_order_with_its_stamps(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/fix')
    progress = []
    result = play(bag, PlayOptions(rate=5.0), domain_id=domain, progress=progress.append)
    assert result.published == COUNT + 1 == sum(progress) and result.problems == ()
    positions = ear.positions(COUNT)
    np.testing.assert_array_equal(positions, [np.nan if k == 3 else k for k in range(COUNT)])
    stamp = ear.received[-1].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == START + (COUNT - 1) * STEP


def test_topics_remapping_and_offset(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/usbl')
    options = PlayOptions(topics=('/fix',), remap={'/fix': '/usbl'}, start_offset=0.1)
    assert play(bag, options, domain_id=domain).published == COUNT - 10
    assert ear.positions(COUNT - 10) == list(range(10, COUNT))


def test_a_stretch_without_a_topic_and_with_another_quality_of_service(bag, link, domain):
    ear = Ear(link, PoseWithCovarianceStamped, '/fix')
    qos = profiles_of('/fix: {reliability: reliable, durability: transient_local, depth: 7}')
    stretch = {'start_offset': 0.05, 'playback_duration': 0.1, 'exclude_topics': ('/other',)}
    with BagReader(bag) as reader, Link(NAME, domain_id=domain) as peer:
        player = Player(reader, peer, PlayOptions(rate=100.0, qos=qos, **stretch))
        (publisher,) = player._publishers.values()
        profile = publisher.qos_profile
        assert profile.durability.name == 'TRANSIENT_LOCAL' and profile.depth == 7
        # Both sides have to know of each other, which on a busy machine takes seconds.
        assert peer.wait_for(publisher.get_subscription_count, 60.0)
        assert link.wait_for(ear.subscription.get_publisher_count, 60.0)
        player.run()
        assert player.result().published == 11
    link.wait_for(lambda: len(ear.received) == 11, 60.0)
    assert [round(message.pose.pose.position.x) for message in ear.received] == list(range(5, 16))


def test_the_pace_follows_the_log_times(bag, domain, monkeypatch):
    """By a clock that only waiting moves."""
    clock, due = SimpleNamespace(monotonic=lambda: clock.now, now=1000.0), []

    def wait(seconds):
        clock.now += seconds

    monkeypatch.setattr(player_module, '_FIRST_LISTENER', 0.0)
    monkeypatch.setattr(player_module, 'time', clock)
    with BagReader(bag) as reader, Link(NAME, domain_id=domain) as peer:
        monkeypatch.setattr(peer, 'spin', wait)
        player = Player(reader, peer, PlayOptions(rate=0.5, topics=('/fix',)))
        player.run(lambda _: due.append(clock.now))
    assert len(due) == COUNT and np.diff(due) == pytest.approx(STEP / 1e9 / 0.5)


def test_playing_to_nobody_is_noticed(bag, domain, monkeypatch):
    monkeypatch.setattr(player_module, '_FIRST_LISTENER', 0.2)
    result = play(bag, PlayOptions(rate=10.0), domain_id=domain)
    assert result.published == COUNT + 1
    assert result.problems == ('nobody was listening when playing began',)


def test_pace_maps_both_ways_and_allows_for_pauses(monkeypatch):
    clock = SimpleNamespace(monotonic=lambda: clock.now, now=1000.0)
    monkeypatch.setattr(player_module, 'time', clock)
    pace = Pace(START, rate=2.0)
    assert pace.seconds_until(START + 2 * 10**9) == pytest.approx(1.0)
    pace.postpone(3.0)
    assert pace.seconds_until(START + 2 * 10**9) == pytest.approx(4.0)
    assert pace.now_ns() == START - 6 * 10**9
    clock.now += 1.5
    assert pace.now_ns() == START - 3 * 10**9


def test_the_clock_runs_along_as_often_as_asked(bag, link, domain, monkeypatch):
    ear, fixes = Ear(link, Clock, '/clock'), Ear(link, PoseWithCovarianceStamped, '/fix')
    options = PlayOptions(clock=100.0, topics=('/fix',))
    with BagReader(bag) as reader, Link(NAME, domain_id=domain) as peer:
        player = Player(reader, peer, options)
        assert peer.wait_for(player._clock._publisher.get_subscription_count, 60.0)
        for each in (ear, fixes):
            assert link.wait_for(each.subscription.get_publisher_count, 60.0)
        player.run()
        assert link.wait_for(lambda: len(ear.received) > 1, 60.0)
        clock = SimpleNamespace(monotonic=lambda: clock.now, now=1000.0)
        monkeypatch.setattr(player_module, 'time', clock)
        ticker = Ticker(peer, 0.01)
        assert ticker.until_next() == 0.0
        ticker.tick(START)
        assert ticker.until_next() == pytest.approx(100.0)
    ticks = [tick.clock.sec * 10**9 + tick.clock.nanosec for tick in ear.received]
    assert ticks == sorted(ticks)
    assert START <= ticks[0] <= ticks[-1] <= START + COUNT * STEP


def test_a_loop_starts_over_with_the_recorded_stamps(bag, link, domain):
    class Enough(Exception):
        """Ends a loop from its progress callback."""

    ear, played = Ear(link, PoseWithCovarianceStamped, '/fix'), []

    def progress(count):
        played.append(count)
        # Well beyond what is looked at: what is sent last may be lost when a player breaks off.
        if len(played) == 2 * COUNT:
            raise Enough

    options = PlayOptions(loop=True, topics=('/fix',), rate=10.0)
    with pytest.raises(Enough):
        play(bag, options, domain_id=domain, progress=progress)
    assert ear.positions(COUNT + 4)[COUNT : COUNT + 3] == [0.0, 1.0, 2.0]


def triggered(link, service):
    """The answer of a service."""
    client = link.node.create_client(Trigger, service)
    assert link.wait_for(client.service_is_ready, 120.0)
    future = client.call_async(Trigger.Request())
    assert link.wait_for(future.done, 120.0)
    return future.result()


def test_a_paused_player_waits_for_resume(bag, link, domain):
    ear, results = Ear(link, PoseWithCovarianceStamped, '/fix'), []
    options = PlayOptions(start_paused=True, rate=10.0)
    thread = threading.Thread(target=lambda: results.append(play(bag, options, domain_id=domain)))
    thread.start()
    client = link.node.create_client(Trigger, f'/{NAME}/resume')
    assert link.wait_for(client.service_is_ready, 120.0) and not ear.received
    triggered(link, f'/{NAME}/resume')
    thread.join(120.0)
    assert results[0].published == COUNT + 1 and len(ear.positions(COUNT)) == COUNT


def test_pause_and_resume_are_services(link):
    pause = Pause(link, paused=False)
    for name, paused, words in (('pause', True, 'paused'), ('resume', False, 'playing')):
        assert triggered(link, f'~/{name}').message == words and pause.paused == paused


def test_what_cannot_be_played_is_said(bag, tmp_path, domain):
    with BagWriter(tmp_path / 'empty'):
        pass
    for options, sentence in (
        ({'topics': ('/fxi',)}, r"has no topic '/fxi' \(did you mean '/fix'\?\)"),
        ({'remap': {'/fxi': '/x'}}, "has no topic '/fxi'"),
        ({'rate': 0.0}, 'the rate must be positive, got 0'),
        ({'rate': float('nan')}, 'the rate must be positive, got nan'),
        ({'start_offset': float('nan')}, 'the start_offset must not be negative, got nan'),
        ({'delay': -1.0}, 'the delay must not be negative, got -1'),
        ({'clock': -1.0}, 'the clock must be positive, got -1'),
        ({}, 'nothing to publish'),
    ):
        with pytest.raises((ConfigError, BagError), match=sentence):
            play(bag if options else tmp_path / 'empty', PlayOptions(**options), domain_id=domain)


def test_a_ros_1_bag_is_played_as_ros_2_messages(tmp_path, link, domain):
    types, name = get_typestore(Stores.ROS1_NOETIC), 'geometry_msgs/msg/PointStamped'
    make_of = types.types
    with Writer(tmp_path / 'old.bag') as writer:
        topic = writer.add_connection('/fix', name, typestore=types)
        for k in range(3):
            stamp = make_of['builtin_interfaces/msg/Time'](sec=100 + k, nanosec=5)
            header = make_of['std_msgs/msg/Header'](seq=k, stamp=stamp, frame_id='map')
            point = make_of['geometry_msgs/msg/Point'](x=float(k), y=2.0, z=3.0)
            message = types.serialize_ros1(make_of[name](header=header, point=point), name)
            writer.write(topic, (100 + k) * 10**9, message)
    ear = Ear(link, PointStamped, '/fix')
    assert play(tmp_path / 'old.bag', PlayOptions(rate=100.0), domain_id=domain).published == 3
    assert link.wait_for(lambda: len(ear.received) == 3, 60.0)
    heard = [(m.header.stamp.sec, m.header.frame_id, m.point.x) for m in ear.received]
    assert heard == [(100 + k, 'map', float(k)) for k in range(3)]


# -- The harness around real nodes; what needs a process is tested in test/system --


def test_latency_percentiles_are_milliseconds():
    for delays, p50, p99 in ((np.arange(1, 102) / 1000.0, 51.0, 100.0), ((), np.nan, np.nan)):
        latency = LockstepResult([], Counts(0, 0, 0), tuple(delays), 0, '', ()).latency_ms()
        assert latency == pytest.approx({'p50': p50, 'p99': p99}, nan_ok=True)


def test_reserved_domains_differ_what_was_left_is_removed_and_a_living_one_comes_last(
    tmp_path, monkeypatch
):
    with reserved_domain_id() as first, reserved_domain_id() as second:
        assert first != second and 1 <= first <= 100
    monkeypatch.setattr(harness, '_SHARED_MEMORY', tmp_path)
    monkeypatch.setattr(harness, '_RESERVED', 23119)  # other tests reserve domains meanwhile
    with contextlib.ExitStack() as living:
        for domain in range(1, 101):
            name = f'fastrtps_port{7400 + 250 * domain + 11}'
            for path in (name, f'{name}_el', f'sem.{name}_mutex'):
                (tmp_path / path).touch()
            if domain != 37:
                lock(living.enter_context((tmp_path / f'{name}_el').open('rb')).fileno())
        with reserved_domain_id() as first, reserved_domain_id() as second:
            assert first == 37 != second
        assert not list(tmp_path.glob('*fastrtps_port16661*'))
        assert len(list(tmp_path.iterdir())) == 3 * 99


def test_a_bag_without_an_input_or_with_two_types_of_it_is_refused(tmp_path):
    fix = write_fix(Fix(stamp_ns=10**9, position=(1.0, 2.0, 0.0), frame_id='map'), ros_message)
    point = {'header': fix.header, 'point': fix.pose.pose.position}
    with BagWriter(tmp_path / 'two') as writer, BagWriter(tmp_path / 'none') as none:
        writer.write('/usbl/fix', fix, 10**9)
        writer.write('/gps/fix', ros_message('geometry_msgs/msg/PointStamped', **point), 10**9)
        none.write('/note', ros_message('std_msgs/msg/String', data='x'), 10**9)
    before = dict(os.environ)
    with pytest.raises(LinkError, match="the input 'fix' would come as"):
        run_lockstep(tmp_path / 'two', 'diver')
    with pytest.raises(BagError, match='no topic for the diver tracker'):
        run_lockstep(tmp_path / 'none', 'diver')
    assert dict(os.environ) == before


# -- The words on the command line of ``play``, and its file of qualities of service --


def test_files_of_qualities_of_service_are_checked():
    for text, sentence in (
        ('/fix: {depth: many}', "depth must be a whole number, got 'many'"),
        ('/fix: {reliability: often}', "reliability is one of .*, got 'often'"),
        ('/fix: {deadline: 1}', "'deadline' is none of depth, history"),
        ('/fix: 5', 'a mapping of policies for each topic'),
        ('/fix: 5\n/ping: {depth: 1}', 'a mapping of policies for each topic'),
        ('{[', 'not a YAML file'),
    ):
        with pytest.raises(ConfigError, match=sentence):
            profiles_of(text)


def test_a_file_of_qualities_of_service_says_what_it_says_and_the_rest_is_reliable():
    text = '/all: {history: keep_all}\n/quick: {reliability: best_effort, depth: 3}\n/rest: {}'
    values = {
        topic: (qos.history.name, qos.reliability.name, qos.durability.name, qos.depth)
        for topic, qos in profiles_of(text).items()
    }
    assert values.pop('/all')[:3] == ('KEEP_ALL', 'RELIABLE', 'VOLATILE')
    assert values == {
        '/quick': ('KEEP_LAST', 'BEST_EFFORT', 'VOLATILE', 3),
        '/rest': ('KEEP_LAST', 'RELIABLE', 'VOLATILE', 10),
    }


def test_options_take_several_words_as_those_of_ros2_bag_play(tmp_path, monkeypatch):
    asked = []

    def played(path, options, progress):
        asked.append((options.topics, options.exclude_topics, options.remap))
        return player_module.PlayResult(0, ())

    monkeypatch.setattr(player_module, 'play', played)
    bag = str(tmp_path / 'bag')
    with BagWriter(bag) as writer:
        writer.write('/a', ros_message('std_msgs/msg/String', data='x'), 10**9)
    for words, *wanted in (
        ('--topics /a /b', ('/a', '/b'), (), {}),
        ('--topics /a --topics /b', ('/a', '/b'), (), {}),
        ('--exclude-topics /a /b -l', (), ('/a', '/b'), {}),
        ('-m /a:=/c /b:=/d --rate 2', (), (), {'/a': '/c', '/b': '/d'}),
    ):
        for arguments in ([bag, *words.split()], [*words.split(), bag]):
            assert main(['play', *arguments]) == 0 and asked.pop() == tuple(wanted)
