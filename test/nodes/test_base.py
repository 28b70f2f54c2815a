# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node around a tracker, with real publishers and subscriptions in one process; its executor:
what it leaves for later still comes; how its process ends; robots in domains of their own."""

import os
import subprocess
import sys
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray
from helpers.node_bench import a_fix, FIX, Rig, values_of
import pytest
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Empty
from std_srvs.srv import SetBool, Trigger

from msg_adapters.estimates import read_estimate
from sonar_imm.nodes import base
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import Endpoints, lockstep_qos, output_qos
from sonar_imm.nodes.running import EVENT_PERIOD, help_text, MessagesFirst
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.replay.harness import reserved_domain_id
from sonar_imm_tools.replay.link import Link

POINT = 'geometry_msgs/msg/PointStamped'
BOW = '-r', '__ns:=/auv1', '-r', '__node:=bow'
SECOND = 10**9

pytestmark = pytest.mark.usefixtures('walker')


@pytest.fixture
def rig(make_bench):
    return Rig(make_bench())


def test_a_fix_becomes_an_estimate_with_its_stamp(rig):
    rig.send(a_fix(10.25, 1.0, 2.0), a_fix(11.5, 3.0, 6.0))
    assert rig.means() == [(10.25, 1.0, 2.0), (11.5, 2.0, 4.0)]
    estimate = read_estimate(rig.estimates[-1])
    assert estimate.frame_id == 'map'
    assert estimate.model_names == ('slow', 'fast')
    assert estimate.probabilities[0].tolist() == [0.75, 0.25]
    assert rig.answer == (2, 0, 2)
    assert rig.answers[-1].header.stamp == a_fix(11.5).header.stamp


def nan_fix(seconds):
    message = a_fix(seconds)
    message.pose.pose.position.x = float('nan')
    return message


@pytest.mark.parametrize(
    'most, shown, withheld',
    [(100, [2.0, 3.0, 4.0, 5.0], 0), (2, [3.0, 4.0, 5.0], 1), (0, [5.0], 3)],
)
def test_late_input_revises_the_newest_comes_last_and_what_is_too_much_is_counted(
    rig, most, shown, withheld
):
    rig.node.set_parameters([Parameter('max_revisions', value=most)])
    rig.send(*[a_fix(seconds, seconds, 0.0) for seconds in (1.0, 3.0, 4.0, 5.0, 2.0)])
    assert [mean[0] for mean in rig.means()[4:]] == shown and rig.means()[-1] == (5.0, 3.0, 0.0)
    assert rig.answer == (5, 0, 4 + len(shown)) and rig.node._withheld == withheld


def hostile():
    """Messages that a listener to a live topic meets sooner or later."""
    yield nan_fix(5.0)
    for stamp in ({'sec': 0, 'nanosec': 0}, {'sec': -5}, {'nanosec': 2**32 - 1}):
        message = a_fix(5.0)
        for name, value in stamp.items():
            setattr(message.header.stamp, name, value)
        yield message
    indefinite = a_fix(5.0)
    indefinite.pose.covariance[1] = indefinite.pose.covariance[6] = 1e3
    yield indefinite
    far_away = a_fix(5.0)
    far_away.pose.pose.position.x = 1e12
    yield far_away
    yield a_fix(5.0, frame_id='odom')


def test_hostile_messages_are_refused_counted_and_survived_and_all_are_answered(rig, capfd):
    cases = list(hostile())
    rig.send(a_fix(1.0), a_fix(1.0), *cases, a_fix(6.0, 3.0, 4.0))
    assert rig.answer == (len(cases) + 3, len(cases), 2)
    assert rig.means()[-1] == (6.0, 2.0, 3.0)
    assert sum(rig.node._meter.refused.values()) == len(cases)
    assert 'Traceback' not in capfd.readouterr().err


def test_a_refusal_is_said_once_a_reason(rig, capfd):
    rig.send(nan_fix(1.0), nan_fix(2.0), a_fix(3.0), a_fix(4.0, frame_id='odom'))
    errors = [line for line in capfd.readouterr().err.splitlines() if 'is refused' in line]
    assert len(errors) == 2
    assert "the frame 'odom' is not the frame 'map' of the tracks" in errors[1]


def test_a_bug_in_the_tracker_does_not_end_the_node(rig, capfd):
    rig.send(a_fix(1.0, 9.0, 9.0))
    rig.node.tracker.explode = True
    rig.send(a_fix(2.0))
    rig.node.tracker.explode = False
    rig.send(a_fix(3.0, 1.0, 2.0))
    assert rig.means()[-1] == (3.0, 1.0, 2.0)  # the tracker started afresh
    assert 'ZeroDivisionError' in capfd.readouterr().err


def test_reset_forgets_the_tracks_and_the_frame(rig):
    rig.send(a_fix(1.0, 9.0, 9.0))
    assert rig.bench.call(Trigger, '/walker/reset', Trigger.Request()).success
    rig.send(a_fix(2.0, 1.0, 2.0, frame_id='odom'))
    assert rig.means()[-1] == (2.0, 1.0, 2.0)


@pytest.mark.usefixtures('quick')
def test_what_was_not_used_and_what_went_wrong_is_in_the_diagnostics(make_bench):
    rig = Rig(make_bench())
    received = rig.bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    rig.bench.spin_until(lambda: rig.node.count_subscribers('/diagnostics'))
    rig.node.set_parameters([Parameter('max_revisions', value=1)])
    rig.send(*map(a_fix, (1.0, 3.0, 4.0, 2.0)))
    rig.bench.call(SetBool, '/walker/enable', SetBool.Request(data=False))
    rig.send(a_fix(5.0), a_fix(6.0))
    rig.bench.call(SetBool, '/walker/enable', SetBool.Request(data=True))
    rig.node.tracker.explode = True
    rig.send(a_fix(7.0), a_fix(8.0), a_fix(9.0))
    rig.node._saved_state.trouble = 'the state cannot be saved'
    received.clear()

    rig.bench.spin_until(
        lambda: any('cannot be saved' in item.status[1].message for item in received)
    )
    values, due = values_of(received[-1]), {'revisions_withheld': '1', 'used': '4'}
    due |= {'ignored_while_disabled': '2', 'internal_error': '3'}
    assert {name: values[f'count: {name}'] for name in due} == due
    assert 'an internal error was caught' in received[-1].status[1].message


def late_by(seconds, monkeypatch):
    """Let what the node receives from now on have waited so long in its queue."""

    def time_ns():
        return time.time_ns() + round(seconds * SECOND)

    clock = SimpleNamespace(time_ns=time_ns, monotonic=time.monotonic)
    monkeypatch.setattr(base, 'time', clock)


def test_what_waited_too_long_is_answered_and_counted_but_not_used(make_bench, monkeypatch, capfd):
    rig = Rig(make_bench(p=['max_wait:=50.0']))
    late_by(40.0, monkeypatch)
    rig.send(a_fix(1.0))
    late_by(60.0, monkeypatch)
    rig.send(a_fix(2.0), a_fix(3.0))
    assert rig.answer == (3, 0, 1) and rig.node._meter.dropped == {'fix': 2}
    assert capfd.readouterr().err.count('those that waited more than 50 s are dropped') == 1
    rig.node.set_parameters([Parameter('max_wait', value=0.0)])  # never
    rig.send(a_fix(4.0))
    assert rig.answer == (4, 0, 2)


def test_the_age_of_estimates_is_that_of_their_publication(make_bench, monkeypatch):
    """A message that waited 40 s in the queue, and whose stamp is 41 s old then."""
    bench = make_bench()
    received = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    rig = Rig(bench)
    late_by(40.0, monkeypatch)
    now = rig.node.get_clock().now().nanoseconds * 1e-9
    rig.send(*(a_fix(now - 41.0 + 0.1 * k) for k in range(6)))
    bench.spin_until(lambda: any('s old: input' in item.status[1].message for item in received))
    values = values_of(received[-1])
    waited = float(values['waited in the queue p50 [s]'])
    assert 40.0 <= waited < 70.0  # the rest is the machine's
    assert float(values['age of estimates p50 [s]']) == pytest.approx(waited + 1.0, abs=1.0)


@pytest.mark.parametrize(
    'words, parameters, options, frame_id, place',
    [
        ((), (), {'qos': qos_profile_sensor_data}, 'map', (1.0, 2.0)),
        ((), [f"input_types:=['fix={POINT}']"], {'publish': POINT}, 'map', (1.0, 2.0)),
        ((), ['world_frame_convention:=ned'], {}, 'map_ned', (2.0, 1.0)),
        (BOW, (), {'topic': '/auv1/fix', 'name': '/auv1/bow'}, 'map', (1.0, 2.0)),
        (('-r', 'fix:=/usbl/position'), (), {'topic': '/usbl/position'}, 'map', (1.0, 2.0)),
    ],
    ids=['best effort', 'points', 'north, east, down', 'name and namespace', 'remapped'],
)
def test_what_is_heard_and_where(make_bench, words, parameters, options, frame_id, place):
    rig = Rig(make_bench(*words, p=parameters), **options)
    message = a_fix(1.0, frame_id=frame_id)
    if options.get('publish') == POINT:
        message = make(POINT, header=message.header, point=message.pose.pose.position)
    rig.send(message)
    assert rig.means() == [(1.0, *place)] and rig.estimates[0].header.frame_id == 'map'


def test_qos_overrides_reach_the_endpoints(make_bench):
    given = (
        '/fix.subscription.reliability:=reliable', '/fix.subscription.history:=keep_all',
        '/walker/estimate.publisher.depth:=3',
    )  # fmt: skip
    bench = make_bench(p=[f'qos_overrides.{each}' for each in given])
    node = bench.start(TrackerNode, 'walker')
    bench.spin_until(lambda: node.get_subscriptions_info_by_topic('/fix'))
    inputs = {s.topic_name: s.qos_profile for s in node.subscriptions}
    outputs = {p.topic_name: p.qos_profile for p in node.publishers}
    assert inputs['/fix'].reliability.name == 'RELIABLE'
    assert inputs['/fix'].history.name == 'KEEP_ALL'
    assert inputs['/arrivals'].reliability.name == 'BEST_EFFORT'
    assert inputs['/arrivals'].depth == 50
    assert outputs['/walker/estimate'].depth == 3


@pytest.mark.usefixtures('quick')
def test_an_incompatible_publisher_is_named_and_told_the_name_of_a_remapped_topic(
    make_bench, capfd
):
    bench = make_bench(
        '-r', 'fix:=/usbl/fix', p=['qos_overrides./fix.subscription.reliability:=reliable']
    )
    bench.start(TrackerNode, 'walker')
    given = "remapped: write 'qos_overrides./usbl/fix.subscription.reliability'"
    bench.spin_until(lambda: given in capfd.readouterr().err)
    bench = make_bench(p=['qos_overrides./fix.subscription.reliability:=reliable'])
    received = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    node = bench.start(TrackerNode, 'walker')
    bench.peer.create_publisher(message_class(FIX), '/fix', qos_profile_sensor_data)
    bench.spin_until(lambda: node._endpoints.incompatible)
    assert node._endpoints.incompatible == {'fix': 'RELIABILITY'}
    errors = capfd.readouterr().err
    assert "a peer on '/fix' cannot be heard: its RELIABILITY" in errors
    assert '-p qos_overrides./fix.subscription.reliability' in errors
    received.clear()  # one report may have been on its way
    bench.spin_until(lambda: received and 'incompatible peer on fix' in values_of(received[-1]))
    assert values_of(received[-1])['incompatible peer on fix'] == 'RELIABILITY'


def test_a_clock_that_goes_back_resets_and_its_first_tick_does_not(make_bench):
    rig = Rig(make_bench(p=['use_sim_time:=true']))
    clock = rig.bench.peer.create_publisher(Clock, '/clock', QoSProfile(depth=10))
    rig.bench.spin_until(clock.get_subscription_count)

    def tick(seconds):
        clock.publish(Clock(clock=a_fix(seconds).header.stamp))
        rig.bench.spin_until(
            lambda: rig.node.get_clock().now().nanoseconds == round(seconds * SECOND)
        )

    rig.send(a_fix(100.0, 1.0, 2.0))
    tick(100.0)
    rig.send(a_fix(101.0, 3.0, 2.0))
    assert rig.means()[-1] == (101.0, 2.0, 2.0)
    tick(50.0)
    rig.send(a_fix(51.0, 7.0, 7.0))
    assert rig.means()[-1] == (51.0, 7.0, 7.0)


def test_a_covariance_of_zeros_is_used_as_unknown_and_said_once(rig, capfd):
    blank = [a_fix(1.0), a_fix(2.0)]
    for message in blank:
        message.pose.covariance[:] = 0.0
    rig.send(*blank)
    assert rig.answer == (2, 0, 2)
    assert capfd.readouterr().err.count('zero_covariance') == 1


# -- the executor, and how the process of a node ends --


@pytest.fixture
def hearer(make_bench):
    bench = make_bench()
    node = rclpy.node.Node('hearer', context=bench.context, use_global_arguments=False)
    bench.nodes.append(node)
    return bench, node


def test_messages_come_at_once_and_events_within_their_period(hearer):
    bench, node = hearer
    endpoints, received, ticks = Endpoints(node), [], []
    for name, qos in (('good', output_qos()), ('bad', lockstep_qos())):
        endpoints.subscribe(Empty, name, lambda message, info: received.append(message), qos)
    node.create_timer(0.05, lambda: ticks.append(time.monotonic()))
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    bench.peer.create_publisher(Empty, 'bad', best_effort)
    good = bench.peer.create_publisher(Empty, 'good', lockstep_qos())
    with MessagesFirst(context=bench.context) as executor:
        executor.add_node(node)
        end = time.monotonic() + 240.0
        while not (received and endpoints.incompatible and len(ticks) > 3):
            assert time.monotonic() < end, (received, endpoints.incompatible, ticks)
            good.publish(Empty())
            executor.spin_once(timeout_sec=0.02)
        assert endpoints.incompatible == {'bad': 'RELIABILITY'}


def test_events_are_asked_a_few_times_a_second_only(hearer, monkeypatch):
    bench, node = hearer
    Endpoints(node).subscribe(Empty, 'good', lambda message: None, output_qos())
    with MessagesFirst(context=bench.context) as executor:
        executor.add_node(node)
        looks, begin = [], time.monotonic()
        monkeypatch.setattr(executor, '_look_at_events', lambda: looks.append(time.monotonic()))
        while time.monotonic() < begin + 3 * EVENT_PERIOD or len(looks) < 2:
            executor.spin_once(timeout_sec=0.01)
    assert len(looks) <= 1 + (time.monotonic() - begin) / EVENT_PERIOD
    asked = [waitable for waitable in node.waitables if executor.can_execute(waitable)]
    assert len(list(node.waitables)) >= 3 and not asked


@pytest.mark.parametrize(
    'words, said', [(['-p', 'a:=1.0'], "'-p' has to follow --ros-args"), (['on'], 'see --help')]
)
def test_words_that_are_no_ros_arguments_are_told(words, said):
    with pytest.raises(ConfigError, match=said):
        help_text(['diver', *words])


PROGRAM = """
import atexit, sys
from sonar_imm.nodes.stopping import Stopper
atexit.register(print, 'modules are taken down')
stopper = Stopper()
stopper.asked = {asked}
print('said')
sys.exit(stopper.end(3))
"""


@pytest.mark.parametrize('asked', [True, False])
def test_a_process_that_was_told_to_stop_does_not_take_its_modules_down(asked):
    """That takes seconds on a busy machine, in which no watchdog lives."""
    command = [sys.executable, '-c', PROGRAM.format(asked=asked)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 3 and done.stdout.startswith('said\n') and not done.stderr
    assert ('taken down' in done.stdout) != asked


START = """
import sys
from rclpy.node import Node
from sonar_imm.nodes.running import run
sys.argv = ['diver_node']
sys.exit(run(lambda: Node('walker')))
"""
LINK = f'from {Link.__module__} import Link; Link("peer")'


@pytest.mark.parametrize(
    'folders', [{}, {'HOME': '/dev/null'}, {'ROS_LOG_DIR': '/dev/null/log'}], ids=str
)
def test_without_a_folder_for_its_log_a_node_says_what_to_set(folders):
    usual = {k: v for k, v in os.environ.items() if k not in ('HOME', 'ROS_LOG_DIR', 'ROS_HOME')}
    done = subprocess.run(
        [sys.executable, '-c', START], env={**usual, **folders}, capture_output=True, text=True
    )
    assert done.returncode == 2 and 'Traceback' not in done.stderr
    said = done.stderr.splitlines()[-1]
    assert said.startswith('diver_node: ROS cannot keep its log')
    assert said.endswith('set ROS_LOG_DIR to a folder that can be written to')
    if 'ROS_LOG_DIR' in folders:  # a link says the same; logging is set up once for a process
        link = subprocess.run(
            [sys.executable, '-c', LINK], env={**usual, **folders}, capture_output=True, text=True
        )
        assert 'LinkError: ROS cannot keep its log' in link.stderr


def test_robots_in_domains_of_their_own_do_not_hear_each_other(make_bench, monkeypatch):
    """With the same names on one machine: only the domain is another one."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with reserved_domain_id() as one, reserved_domain_id() as other:
        rigs = [Rig(make_bench(domain_id=domain)) for domain in (one, other)]
        rigs[0].send(*map(a_fix, range(1, 6)))
        assert rigs[0].answer == (5, 0, 5) and not rigs[1].node._meter.received
        for rig in rigs:  # and not two each
            assert rig.fix.get_subscription_count() == rig.node.count_publishers('/fix') == 1
