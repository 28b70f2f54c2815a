# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Lock-step with real nodes: every answer waited for, and what is wrong said."""

from contextlib import ExitStack
import threading
from types import SimpleNamespace

from geometry_msgs.msg import PoseWithCovarianceStamped
from helpers.node_bench import COUNT, Ear, write_fixes
import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64

from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.replay import lockstep as lockstep_module
from sonar_imm_tools.replay.harness import START_LIMIT
from sonar_imm_tools.replay.link import Link, LinkError
from sonar_imm_tools.replay.lockstep import Chain, Counts, LockStep, Recorder
from sonar_imm_tools.replay.player import play, Player, PlayOptions


@pytest.fixture
def bag(tmp_path):
    return write_fixes(tmp_path / 'bag')


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
        self.thread.join(120.0)
        self.node.destroy_node()
        self.link.__exit__()


QOS = 'qos_overrides./fix.subscription'
RELIABLE = ('-p', f'{QOS}.reliability:=reliable', '-p', f'{QOS}.history:=keep_all')


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
def stepping(bag, link, monkeypatch):
    """Make a player in lock-step with the walker, and the recorder of its estimates. The walker
    never hears the other topic of the bag, and nobody waits for that."""
    monkeypatch.setattr(lockstep_module, '_OTHER_INPUTS', 0.0)
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
    player.run(start_limit=START_LIMIT)
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
    first.run(start_limit=START_LIMIT)
    second, recorder, step = stepping(start_offset=0.1)
    second.run(start_limit=START_LIMIT)
    assert step.counts == (COUNT - 10, 0, 0)  # all duplicates: answered without an estimate
    assert len(recorder) == 0


def test_lockstep_finds_the_only_node_and_asks_where_there_are_two(
    bag, start, domain, monkeypatch
):
    monkeypatch.setattr(lockstep_module, '_OTHER_INPUTS', 0.0)
    start(*RELIABLE)
    result = play(bag, PlayOptions(lockstep='auto'), domain_id=domain)
    assert len(result.delays) == COUNT - 1
    start('-r', '__node:=other')
    monkeypatch.setattr(lockstep_module, '_SECOND_LOOK', 15.0)
    with pytest.raises(LinkError, match='several nodes run: say which of /other, /walker'):
        play(bag, PlayOptions(lockstep='auto'), domain_id=domain)


def test_a_row_that_was_lost_is_asked_for_again(link, start, stepping, monkeypatch):
    monkeypatch.setattr(lockstep_module, '_ASKED_AGAIN', 0.1)
    start(*RELIABLE)
    player, recorder, step = stepping()
    lost = step._answers
    link.node.destroy_subscription(lost)  # as if its row never came
    player.run(start_limit=START_LIMIT)
    assert step._answers is not lost and len(recorder) == COUNT - 1


def test_lockstep_without_a_node_says_so(link, stepping):
    player, _, _ = stepping()
    with pytest.raises(LinkError, match="no answer from a node '/walker'"):
        player.run(start_limit=0.3)


def test_lockstep_names_the_type_the_node_expects(link, start, monkeypatch, stepping):
    monkeypatch.setattr(lockstep_module, 'MATCH_LIMIT', 0.3)
    start('-p', "input_types:=['fix=geometry_msgs/msg/PointStamped']")
    assert link.wait_for(lambda: link.node.get_subscriptions_info_by_topic('/fix'), 120.0)
    player, _, _ = stepping(topics=('/fix',))
    with pytest.raises(LinkError, match='expects geometry_msgs/msg/PointStamped on /fix'):
        player.run(start_limit=START_LIMIT)


def test_lockstep_says_when_no_topic_fits(link, start, monkeypatch, stepping):
    monkeypatch.setattr(lockstep_module, 'MATCH_LIMIT', 0.5)
    start()
    player, _, _ = stepping(topics=('/other',))
    with pytest.raises(LinkError, match=r'listens to none of the topics of the bag \(/other\)'):
        player.run(start_limit=START_LIMIT)


def test_lockstep_notices_a_node_that_does_not_answer(link, start, monkeypatch, stepping):
    monkeypatch.setattr(lockstep_module, 'ANSWER_LIMIT', 0.3)
    live = start(*RELIABLE)
    release = threading.Event()
    monkeypatch.setattr(live.node.tracker, 'process', lambda m: release.wait(20.0) and [])
    player, _, _ = stepping()
    try:
        with pytest.raises(LinkError, match='did not answer message 1 on /fix within 0.3 s'):
            player.run(start_limit=START_LIMIT)
    finally:
        release.set()


def test_lockstep_notices_somebody_else_who_publishes(link, start, stepping):
    start(*RELIABLE)
    other = link.node.create_publisher(PoseWithCovarianceStamped, '/fix', lockstep_qos())
    player, _, _ = stepping()
    link.wait_for(other.get_subscription_count, 120.0)

    def meddle(count):
        other.publish(PoseWithCovarianceStamped())
        assert other.wait_for_all_acked(Duration(seconds=10))  # on a busy machine it comes late

    with pytest.raises(LinkError, match="something else publishes to the node '/walker'"):
        player.run(meddle)


def test_lockstep_waits_for_an_input_that_is_found_late(link, start, stepping, monkeypatch):
    """Discovery tells the inputs of a node one by one; what goes to one that it has not told yet
    would be taken for somebody else's."""
    start(*RELIABLE)
    player, _, step = stepping()
    monkeypatch.setattr(lockstep_module, '_OTHER_INPUTS', 60.0)
    Ear(link, Float64, '/other')
    looks = []

    def subscribed(publishers):
        looks.append(publishers)
        return {p.topic_name for p in publishers if p.topic_name == '/fix' or len(looks) > 5}

    monkeypatch.setattr(step, '_subscribed', subscribed)
    assert player._meet(15.0) == {'/fix', '/other'}


def test_a_step_waits_until_the_estimates_of_the_message_are_here(link):
    """The answer and the estimates come on two topics: which is first, nobody says."""
    recorder = []
    step = LockStep(link, '/walker', recorder=recorder)
    lengths = []

    def spin(seconds):
        lengths.append(len(recorder))
        if len(lengths) == 1:
            step._counts = Counts(messages=1, refused=0, estimates=2)
        else:
            recorder.append(b'an estimate')

    link.spin = spin
    step._lost = lambda: 'the step never ends' if len(lengths) > 9 else None
    step.follow(1, '/fix', 0.0)
    assert lengths == [0, 0, 1] and len(step.delays) == 1


def test_recorded_estimates_read_back(link, start, stepping):
    start(*RELIABLE)
    player, recorder, _ = stepping(topics=('/fix',))
    player.run(start_limit=START_LIMIT)
    estimate = recorder.estimates()[0]
    assert estimate.frame_id == 'map'
    assert estimate.model_names == ('slow', 'fast')


def test_of_two_nodes_each_message_counts_once():
    """Seven of the second one's nine messages came from the first; the player sent twelve."""
    first, second = (SimpleNamespace(counts=Counts(*each)) for each in ((10, 1, 7), (9, 2, 6)))
    assert Chain(first, second, ()).counts == (12, 3, 6)
