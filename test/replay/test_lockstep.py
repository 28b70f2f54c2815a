# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Lock-step with real nodes: every answer waited for, and what is wrong said; how long a link
waits, told by a clock that the test moves, and which tables are listened to."""

from contextlib import ExitStack
import threading
from types import SimpleNamespace

from geometry_msgs.msg import PoseWithCovarianceStamped
from helpers.node_bench import COUNT, Ear, write_fixes
import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.replay import link as module
from sonar_imm_tools.replay import lockstep as lockstep_module
from sonar_imm_tools.replay.harness import START_LIMIT
from sonar_imm_tools.replay.link import Link, LinkError
from sonar_imm_tools.replay.listening import TableListener
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
    with ExitStack() as started:

        def start(*parameters):
            live = Live(domain, *parameters)
            started.callback(live.end)
            return live

        yield start


@pytest.fixture
def stepping(bag, link, monkeypatch):
    """Make a player in lock-step with the walker, and the recorder of its estimates. The walker
    never hears the other topic of the bag, and nobody waits for that."""
    monkeypatch.setattr(lockstep_module, '_OTHER_INPUTS', 0.0)
    with BagReader(bag) as reader:

        def stepping(**options):
            recorder = Recorder(link, '/walker')
            step = LockStep(link, '/walker', recorder=recorder)
            chosen = PlayOptions(lockstep='/walker', **options)
            return Player(reader, link, chosen, step), step, recorder

        yield stepping


def test_lockstep_gets_the_estimate_of_every_message(start, stepping):
    start(*RELIABLE)
    player, step, recorder = stepping()
    player.run(start_limit=START_LIMIT)
    assert player.result().published == COUNT + 1  # the other topic goes along, unanswered
    assert step.counts == (COUNT, 1, COUNT - 1)
    assert len(player.result().delays) == COUNT - 1
    used = [float(k) for k in range(COUNT) if k != 3]
    means = [np.mean(used[: k + 1]) for k in range(COUNT - 1)]
    made = recorder.estimates()
    assert [each.state[0, 0] for each in made] == pytest.approx(means)
    assert (made[0].frame_id, made[0].model_names) == ('map', ('slow', 'fast'))
    # A second player counts from where the node stands.
    second, step, recorder = stepping(start_offset=0.1)
    second.run(start_limit=START_LIMIT)
    assert step.counts == (COUNT - 10, 0, 0)  # all duplicates: answered without an estimate
    assert len(recorder) == 0


def test_lockstep_finds_the_only_node_and_asks_where_there_are_two(
    bag, start, domain, monkeypatch
):
    options = PlayOptions(lockstep='auto')
    monkeypatch.setattr(lockstep_module, '_OTHER_INPUTS', 0.0)
    start(*RELIABLE)
    assert len(play(bag, options, domain_id=domain).delays) == COUNT - 1
    start('-r', '__node:=other')
    monkeypatch.setattr(lockstep_module, '_SECOND_LOOK', 15.0)
    with pytest.raises(LinkError, match='several nodes run: say which of /other, /walker'):
        play(bag, options, domain_id=domain)


def test_a_row_that_was_lost_is_asked_for_again(link, start, stepping, monkeypatch):
    monkeypatch.setattr(lockstep_module, '_ASKED_AGAIN', 0.1)
    start(*RELIABLE)
    player, step, recorder = stepping()
    lost = step._answers
    link.node.destroy_subscription(lost)  # as if its row never came
    player.run(start_limit=START_LIMIT)
    assert step._answers is not lost and len(recorder) == COUNT - 1


POINTS = "input_types:=['fix=geometry_msgs/msg/PointStamped']"


@pytest.mark.parametrize(
    'node, topic, seconds, said',
    [
        (None, '/fix', 0.3, "no answer from a node '/walker'"),
        (('-p', POINTS), '/fix', START_LIMIT, 'expects geometry_msgs/msg/PointStamped on /fix'),
        ((), '/other', START_LIMIT, r'listens to none of the topics of the bag \(/other\)'),
    ],
)
def test_lockstep_says_which_node_and_input_are_not_there(
    link, start, monkeypatch, stepping, node, topic, seconds, said
):
    monkeypatch.setattr(lockstep_module, 'MATCH_LIMIT', 0.4)
    if node is not None:
        start(*node)
        assert link.wait_for(lambda: link.node.get_subscriptions_info_by_topic('/fix'), 120.0)
    player, *_ = stepping(topics=(topic,))
    with pytest.raises(LinkError, match=said):
        player.run(start_limit=seconds)


def test_lockstep_notices_a_node_that_does_not_answer(start, monkeypatch, stepping):
    monkeypatch.setattr(lockstep_module, 'ANSWER_LIMIT', 0.3)
    live, release = start(*RELIABLE), threading.Event()
    monkeypatch.setattr(live.node.tracker, 'process', lambda m: release.wait(20.0) and [])
    player, *_ = stepping()
    try:
        with pytest.raises(LinkError, match='did not answer message 1 on /fix within 0.3 s'):
            player.run(start_limit=START_LIMIT)
    finally:
        release.set()


def test_lockstep_notices_somebody_else_who_publishes(link, start, stepping):
    start(*RELIABLE)
    other = link.node.create_publisher(PoseWithCovarianceStamped, '/fix', lockstep_qos())
    player, *_ = stepping()
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
    player, step, _ = stepping()
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
    recorder, lengths = [], []
    step = LockStep(link, '/walker', recorder=recorder)

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


def test_of_two_nodes_each_message_counts_once():
    """Seven of the second one's nine messages came from the first; the player sent twelve."""
    first, second = (SimpleNamespace(counts=Counts(*each)) for each in ((10, 1, 7), (9, 2, 6)))
    assert Chain(first, second, ()).counts == (12, 3, 6)


@pytest.fixture
def deaf(monkeypatch):
    """A link that hears nothing; each look at its callbacks takes as long as it may."""
    link, clock = object.__new__(Link), SimpleNamespace(now=1000.0, spun=[])

    def spin(seconds):
        clock.spun.append(seconds)
        clock.now += seconds

    monkeypatch.setattr(module, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    link.spin, link.clock = spin, clock
    return link


def test_what_does_not_come_is_waited_for_as_long_as_is_said_and_what_comes_ends_it(deaf):
    assert deaf.wait_for(lambda: False, 2.25) is False
    assert deaf.clock.now == pytest.approx(1002.25)
    assert max(deaf.clock.spun) <= 0.1 and min(deaf.clock.spun) > 0.0
    assert deaf.wait_for(lambda: deaf.clock.now > 1003.0, 60.0) is True
    assert deaf.clock.now == pytest.approx(1003.1, abs=0.11)


def test_trouble_is_asked_for_ten_times_a_second_and_ends_the_waiting(deaf):
    asked = []

    def trouble():
        asked.append(deaf.clock.now)
        return 'the node ended' if len(asked) == 3 else None

    # Callbacks that come in quick succession.
    deaf.spin = lambda seconds: setattr(deaf.clock, 'now', deaf.clock.now + 0.01)
    with pytest.raises(LinkError, match='the node ended'):
        deaf.wait_for(lambda: False, 60.0, trouble)
    assert asked == pytest.approx([1000.1, 1000.2, 1000.3], abs=0.035)


def test_without_names_every_estimate_is_heard_but_the_truth(link):
    kinds = {'/auv/diver/estimate': PointCloud2, '/truth/estimate': PointCloud2}
    kinds |= {'/other/estimate': Float64, '/estimate/raw': PointCloud2}
    out = {name: link.node.create_publisher(kind, name, 10) for name, kind in kinds.items()}
    listener = TableListener(link)
    for table in listener.tables(120.0):
        if table is not None:
            break
        for publisher, kind in zip(out.values(), kinds.values()):
            publisher.publish(kind())
    assert listener.topics == ['/auv/diver/estimate'] and table.topic == '/auv/diver/estimate'


def test_silence_says_what_was_looked_for(link):
    with pytest.raises(LinkError, match='no topic that ends in /estimate was found within 0.1 s'):
        list(TableListener(link, ()).tables(0.1))
    kinds = {'/diver/estimate': PointCloud2, '/fix': Float64}
    for name, kind in kinds.items():
        link.node.create_publisher(kind, name, 10)
    assert link.wait_for(lambda: all(map(link.node.count_publishers, kinds)), 60.0)
    for wanted, said in (
        (('diver/estimat',), r"nobody publishes /diver/estimat within .* mean '/diver/estimate'"),
        (('diver/estimate',), 'nothing was published on /diver/estimate within 0.1 s'),
        (('fix',), 'std_msgs/msg/Float64 and no table; ros2 topic echo /fix'),
    ):
        with pytest.raises(LinkError, match=said):
            list(TableListener(link, wanted).tables(0.1))
