# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node around a tracker, with real publishers and subscriptions in one process."""

import itertools
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray
from helpers.node_bench import a_fix, FIX, Rig
import pytest
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from msg_adapters.estimates import read_estimate
from sonar_imm.nodes import base
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import output_qos

POINT = 'geometry_msgs/msg/PointStamped'
SECOND = 10**9

pytestmark = pytest.mark.usefixtures('walker')


def a_point(seconds, x=1.0, y=2.0):
    fix = a_fix(seconds, x, y)
    return make(POINT, header=fix.header, point=fix.pose.pose.position)


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


def test_every_message_is_answered_also_without_an_estimate(rig):
    rig.send(a_fix(1.0), a_fix(1.0), nan_fix(2.0), a_fix(3.0))
    assert rig.answer == (4, 1, 2)


def nan_fix(seconds):
    message = a_fix(seconds)
    message.pose.pose.position.x = float('nan')
    return message


def test_late_input_revises_and_the_newest_comes_last(rig):
    rig.send(a_fix(1.0, 0.0, 0.0), a_fix(3.0, 4.0, 4.0), a_fix(2.0, 2.0, 8.0))
    assert rig.means()[2:] == [(2.0, 1.0, 4.0), (3.0, 2.0, 4.0)]


def test_revisions_can_be_left_out(rig):
    rig.node.set_parameters([Parameter('max_revisions', value=0)])
    rig.send(a_fix(1.0, 0.0, 0.0), a_fix(3.0, 4.0, 4.0), a_fix(2.0, 2.0, 8.0))
    assert rig.means()[2:] == [(3.0, 2.0, 4.0)]


def test_revisions_are_bounded_and_counted(rig):
    rig.node.set_parameters([Parameter('max_revisions', value=2)])
    rig.send(*[a_fix(seconds, seconds, 0.0) for seconds in (1.0, 3.0, 4.0, 5.0, 6.0, 2.0)])
    assert [mean[0] for mean in rig.means()[5:]] == [4.0, 5.0, 6.0]
    assert rig.answer == (6, 0, 8)
    assert rig.node._withheld == 2


def hostile():
    """Messages that a listener to a live topic meets sooner or later."""
    yield 'not a number', nan_fix(5.0)
    unstamped = a_fix(5.0)
    unstamped.header.stamp.sec = unstamped.header.stamp.nanosec = 0
    yield 'no stamp', unstamped
    early = a_fix(5.0)
    early.header.stamp.sec = -5
    yield 'negative stamp', early
    overfull = a_fix(5.0)
    overfull.header.stamp.nanosec = 2**32 - 1
    yield 'too many nanoseconds', overfull
    indefinite = a_fix(5.0)
    indefinite.pose.covariance[1] = indefinite.pose.covariance[6] = 1e3
    yield 'indefinite covariance', indefinite
    yield 'far away', a_fix_at(1e12)
    yield 'other frame', a_fix(5.0, frame_id='odom')


def a_fix_at(x):
    message = a_fix(5.0)
    message.pose.pose.position.x = x
    return message


def test_hostile_messages_are_refused_counted_and_survived(rig, capfd):
    cases = list(hostile())
    rig.send(a_fix(1.0), *(message for _, message in cases), a_fix(6.0, 3.0, 4.0))
    assert rig.answer == (len(cases) + 2, len(cases), 2)
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
    tracker = received[-1].status[1]
    counts = {pair.key: pair.value for pair in tracker.values}
    assert counts['count: revisions_withheld'] == '1'
    assert counts['count: ignored_while_disabled'] == '2'
    assert counts['count: internal_error'] == '3'
    assert counts['count: used'] == '4'
    assert 'an internal error was caught' in tracker.message


def test_what_waited_too_long_is_answered_and_counted_but_not_used(make_bench, monkeypatch, capfd):
    rig = Rig(make_bench('-p', 'max_wait:=50.0'))
    late_s = 40

    def time_ns():
        return time.time_ns() + late_s * SECOND

    clock = SimpleNamespace(time_ns=time_ns, monotonic=time.monotonic)
    monkeypatch.setattr(base, 'time', clock)
    rig.send(a_fix(1.0))
    late_s = 60
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

    def time_ns():
        return time.time_ns() + 40 * SECOND

    clock = SimpleNamespace(time_ns=time_ns, monotonic=time.monotonic)
    monkeypatch.setattr(base, 'time', clock)
    now = rig.node.get_clock().now().nanoseconds * 1e-9
    rig.send(*(a_fix(now - 41.0 + 0.1 * k) for k in range(6)))
    bench.spin_until(lambda: any('s old: input' in item.status[1].message for item in received))
    values = {pair.key: float(pair.value) for pair in received[-1].status[1].values}
    waited = values['waited in the queue p50 [s]']
    assert 40.0 <= waited < 70.0  # the rest is the machine's
    assert values['age of estimates p50 [s]'] == pytest.approx(waited + 1.0, abs=1.0)


def test_best_effort_publishers_are_heard(make_bench):
    rig = Rig(make_bench(), qos=qos_profile_sensor_data)
    rig.send(a_fix(1.0))
    assert rig.answer == (1, 0, 1)


def test_points_are_heard_when_asked_for(make_bench):
    rig = Rig(make_bench('-p', f"input_types:=['fix={POINT}']"), publish=POINT)
    rig.send(a_point(1.0, 1.0, 2.0))
    assert rig.means() == [(1.0, 1.0, 2.0)]


def test_north_east_down_input_comes_out_as_east_north_up(make_bench):
    rig = Rig(make_bench('-p', 'world_frame_convention:=ned'))
    rig.send(a_fix(1.0, 1.0, 2.0, frame_id='map_ned'))
    assert rig.means() == [(1.0, 2.0, 1.0)]
    assert rig.estimates[0].header.frame_id == 'map'


def test_namespaces_and_names_move_everything(make_bench):
    rig = Rig(make_bench('-r', '__ns:=/auv1', '-r', '__node:=bow'), prefix='/auv1', name='bow')
    rig.send(a_fix(1.0))
    assert rig.answer == (1, 0, 1)


def test_inputs_can_be_remapped(make_bench):
    bench = make_bench('-r', 'fix:=/usbl/position')
    node = bench.add(TrackerNode('walker', context=bench.context))
    publisher = bench.peer.create_publisher(message_class(FIX), '/usbl/position', 10)
    bench.spin_until(publisher.get_subscription_count)
    publisher.publish(a_fix(1.0))
    bench.spin_until(lambda: node.tracker.counts['used'] == 1)


def test_qos_overrides_reach_the_endpoints(make_bench):
    bench = make_bench(
        '-p', 'qos_overrides./fix.subscription.reliability:=reliable', '-p',
        'qos_overrides./fix.subscription.history:=keep_all', '-p',
        'qos_overrides./walker/estimate.publisher.depth:=3',
    )  # fmt: skip
    node = bench.add(TrackerNode('walker', context=bench.context))
    bench.spin_until(lambda: node.get_subscriptions_info_by_topic('/fix'))
    inputs = {s.topic_name: s.qos_profile for s in node.subscriptions}
    outputs = {p.topic_name: p.qos_profile for p in node.publishers}
    assert inputs['/fix'].reliability.name == 'RELIABLE'
    assert inputs['/fix'].history.name == 'KEEP_ALL'
    assert inputs['/arrivals'].reliability.name == 'BEST_EFFORT'
    assert inputs['/arrivals'].depth == 50
    assert outputs['/walker/estimate'].depth == 3


@pytest.mark.usefixtures('quick')
def test_an_incompatible_publisher_is_named(make_bench, capfd):
    bench = make_bench('-p', 'qos_overrides./fix.subscription.reliability:=reliable')
    received = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    node = bench.add(TrackerNode('walker', context=bench.context))
    bench.peer.create_publisher(message_class(FIX), '/fix', qos_profile_sensor_data)
    bench.spin_until(lambda: node._endpoints.incompatible)
    assert node._endpoints.incompatible == {'fix': 'RELIABILITY'}
    errors = capfd.readouterr().err
    assert "a peer on '/fix' cannot be heard: its RELIABILITY" in errors
    assert '-p qos_overrides./fix.subscription.reliability' in errors

    def values():
        """Of the newest report; one may have been on its way."""
        return {pair.key: pair.value for pair in received[-1].status[0].values} if received else {}

    bench.spin_until(lambda: 'incompatible peer on fix' in values())
    assert values()['incompatible peer on fix'] == 'RELIABILITY'


def test_a_quality_of_service_of_a_remapped_topic_is_told_its_name(make_bench, capfd):
    bench = make_bench(
        '-r', 'fix:=/usbl/fix', '-p', 'qos_overrides./fix.subscription.reliability:=reliable'
    )
    node = bench.add(TrackerNode('walker', context=bench.context))
    bench.spin_until(lambda: node.get_subscriptions_info_by_topic('/usbl/fix'))
    given = "remapped: write 'qos_overrides./usbl/fix.subscription.reliability'"
    assert given in capfd.readouterr().err


def test_accepted_changes_are_said_on_rosout(make_bench):
    # A name of its own: a node of an earlier test that is only now collected takes the publisher
    # of its name along. A late subscriber gets what was logged before: it may be known here and
    # not yet matched.
    rig = Rig(make_bench('-r', '__ns:=/talker'), prefix='/talker')
    lasting = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    received = rig.bench.listen(Log, '/rosout', lasting)
    times = itertools.cycle((3.5, 4.5))

    def said():
        # again and again: the first words may be lost before the two have met
        rig.node.set_parameters([Parameter('stale_after', value=next(times))])
        return any('stale_after is ' in item.msg for item in received)

    rig.bench.spin_until(said)


def test_a_clock_that_goes_back_resets_and_its_first_tick_does_not(make_bench):
    rig = Rig(make_bench('-p', 'use_sim_time:=true'))
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


def test_two_nodes_of_one_name_space_do_not_meddle(make_bench):
    bench = make_bench()
    left = bench.add(TrackerNode('walker', context=bench.context, namespace='left'))
    right = bench.add(TrackerNode('walker', context=bench.context, namespace='right'))
    publisher = bench.peer.create_publisher(message_class(FIX), '/left/fix', 10)
    bench.spin_until(publisher.get_subscription_count)
    publisher.publish(a_fix(1.0))
    bench.spin_until(lambda: left.tracker.counts['used'])
    assert not right.tracker.counts


def test_a_covariance_of_zeros_is_used_as_unknown_and_said_once(rig, capfd):
    blank = a_fix(1.0)
    blank.pose.covariance[:] = 0.0
    again = a_fix(2.0)
    again.pose.covariance[:] = 0.0
    rig.send(blank, again)
    assert rig.answer == (2, 0, 2)
    assert capfd.readouterr().err.count('zero_covariance') == 1
