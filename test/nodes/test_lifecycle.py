# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that a lifecycle manager starts, by real clients of `lifecycle_msgs`."""

import math
import sys

from diagnostic_msgs.msg import DiagnosticArray
from helpers.node_bench import a_fix, FIX, Held
from helpers.walker import WalkerTracker
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import PointCloud2

from msg_adapters.estimates import read_estimate
from sonar_imm.measurements import Arrivals, Fix, Navigation
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.managed import Warming
from sonar_imm.nodes.messages import message_class
from sonar_imm.nodes.qos import output_qos
from sonar_imm.parameters import ConfigError

pytestmark = pytest.mark.usefixtures('walker')
CONFIGURED = Transition.TRANSITION_ON_CONFIGURE_SUCCESS


class Manager:
    """What a lifecycle manager does, asks for transitions one after the other; and a sender."""

    def __init__(self, bench):
        self.bench, self.node = bench, bench.start(TrackerNode, 'walker')
        self.reports = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
        self.estimates = bench.listen(PointCloud2, '/walker/estimate')
        self.fix = bench.peer.create_publisher(message_class(FIX), '/fix', output_qos())

    def state(self):
        found = self.bench.call(GetState, '/walker/get_state', GetState.Request())
        return found.current_state.label

    def available(self):
        name = '/walker/get_available_transitions'
        found = self.bench.call(GetAvailableTransitions, name, GetAvailableTransitions.Request())
        return {each.transition.label for each in found.available_transitions}

    def ask(self, *wanted):
        """Whether all these transitions were done, told by their label or number."""
        for each in wanted:
            each = {'label': each} if isinstance(each, str) else {'id': each}
            request = ChangeState.Request(transition=Transition(**each))
            if not self.bench.call(ChangeState, '/walker/change_state', request).success:
                return False
        return True

    def send(self, *fix):
        """Send one fix and wait for its estimate: the place."""
        before = len(self.estimates)
        self.bench.spin_until(lambda: self.fix.get_subscription_count() == 1)
        self.fix.publish(a_fix(*fix))
        self.bench.spin_until(lambda: len(self.estimates) > before)
        return read_estimate(self.estimates[-1]).state[0, :2].tolist()

    def wait_until_said(self, words):
        self.bench.spin_until(lambda: self.reports and words in self.reports[-1].status[0].message)


@pytest.fixture
def manage(make_bench):
    """A manager of a node that does not start by itself, with these parameters."""
    return lambda *parameters: Manager(make_bench(p=['autostart:=false', *parameters]))


def test_a_node_starts_by_itself_unless_it_is_told_not_to(make_bench):
    bench = make_bench()
    events = bench.listen(TransitionEvent, '/walker/transition_event')
    manager = Manager(bench)
    bench.spin_until(lambda: manager.state() == 'active')
    assert manager.available() == {'deactivate', 'shutdown'}
    assert manager.ask('deactivate')
    bench.spin_until(lambda: events and events[-1].goal_state.label == 'inactive')
    assert events[-1].start_state.id == State.TRANSITION_STATE_DEACTIVATING


@pytest.mark.usefixtures('quick')
def test_the_life_of_a_managed_node(manage):
    manager = manage()
    bench, node, fix = manager.bench, manager.node, manager.fix
    assert manager.available() == {'configure', 'shutdown'}
    assert not node.count_publishers('/walker/estimate') and not node.count_subscribers('/fix')
    manager.wait_until_said('the node is unconfigured')
    assert manager.ask('configure') and manager.state() == 'inactive'
    assert node.count_publishers('/walker/estimate') and not node.count_subscribers('/fix')
    assert manager.ask(Transition.TRANSITION_ACTIVATE) and manager.state() == 'active'
    assert manager.send(1.0, 0.0, 0.0) == [0.0, 0.0]

    assert manager.ask('deactivate') and manager.state() == 'inactive'
    bench.spin_until(lambda: fix.get_subscription_count() == 0)
    manager.wait_until_said('the node is inactive')
    assert manager.ask('activate')  # it goes on with what it knew
    assert manager.send(2.0, 4.0, 2.0) == [2.0, 1.0]

    assert manager.ask('deactivate', 'cleanup') and manager.state() == 'unconfigured'
    bench.spin_until(lambda: not bench.peer.count_publishers('/walker/estimate'))
    assert manager.ask('configure', 'activate')  # and now it begins anew
    assert manager.send(3.0, 5.0, 5.0) == [5.0, 5.0]
    assert manager.ask('shutdown') and manager.state() == 'finalized'
    bench.spin_until(lambda: fix.get_subscription_count() == 0)
    assert not manager.available()


def test_a_transition_that_the_state_does_not_have_is_refused_and_survived(manage, capfd):
    manager = manage()
    assert not any(map(manager.ask, ('activate', 77, 'dance', CONFIGURED)))
    assert manager.state() == 'unconfigured'
    assert "no transition 'activate' from unconfigured" in capfd.readouterr().err
    assert manager.ask('configure')
    assert not manager.ask('configure') and manager.state() == 'inactive'


@pytest.mark.usefixtures('quick')
def test_while_it_configures_the_node_answers_and_refuses_other_transitions(manage, monkeypatch):
    held = Held()
    monkeypatch.setattr(WalkerTracker, 'warm', lambda self, inputs=None: held())
    manager = manage()
    bench, reports = manager.bench, manager.reports
    client = bench.peer.create_client(ChangeState, '/walker/change_state')
    bench.spin_until(client.service_is_ready)
    asked = client.call_async(ChangeState.Request(transition=Transition(label='configure')))
    try:
        bench.spin_until(held.begun.is_set)
        assert manager.state() == 'configuring'
        assert not any(map(manager.ask, ('activate', 'shutdown', CONFIGURED)))
        request = GetParameters.Request(names=['sound_speed'])
        answer = bench.call(GetParameters, '/walker/get_parameters', request)
        assert answer.values[0].double_value == 1500.0
        manager.wait_until_said('loading kernels')
        assert reports[-1].status[0].message == reports[-1].status[1].message
        assert not asked.done() and not manager.node.get_subscriptions_info_by_topic('/fix')
    finally:
        held.let_go.set()
    bench.spin_until(asked.done)
    assert asked.result().success and manager.state() == 'inactive'


def test_what_fails_while_configuring_is_tried_again_and_the_state_is_kept(
    manage, tmp_path, capfd
):
    manager = manage(f'state_file:={tmp_path / "folder" / "state"}')
    assert not manager.ask('configure') and manager.state() == 'unconfigured'
    assert 'there is no folder' in capfd.readouterr().err
    (tmp_path / 'folder').mkdir()
    assert manager.ask('configure') and manager.state() == 'inactive' and manager.ask('activate')
    manager.send(1.0, 0.0, 0.0)  # the state is saved by cleanup and loaded by configure
    assert manager.ask('deactivate', 'cleanup') and (tmp_path / 'folder' / 'state').is_file()
    assert manager.ask('configure', 'activate')
    assert manager.send(2.0, 4.0, 2.0) == [2.0, 1.0]


def test_kernels_that_cannot_be_loaded_leave_a_node_unconfigured_or_end_it(
    manage, make_bench, monkeypatch, capfd
):
    errors = [ConfigError('compiled kernels cannot be read'), ZeroDivisionError('a bug')]

    def fails(self, inputs):
        raise errors.pop()

    monkeypatch.setattr(WalkerTracker, 'warm', fails)
    manager = manage()
    assert not manager.ask('configure') and manager.state() == 'unconfigured'
    assert 'ZeroDivisionError: a bug' in capfd.readouterr().err
    assert not manager.node.count_publishers('/walker/estimate')
    bench = make_bench()
    bench.start(TrackerNode, 'walker')
    with pytest.raises(ConfigError, match='cannot be read'):
        bench.spin_until(lambda: False)


def test_an_input_that_cannot_be_heard_leaves_the_node_inactive(manage, capfd):
    manager = manage('qos_overrides./fixes.subscription.depth:=many')
    assert manager.ask('configure') and not manager.ask('activate')
    assert manager.state() == 'inactive' and 'depth' in capfd.readouterr().err
    assert not manager.node.count_subscribers('/fix')


def test_a_program_can_use_the_verbs_of_rclpy(manage):
    node = manage().node
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS and node.state == 'active'
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS


# -- A node while its kernels are compiled --


def test_the_thread_says_when_it_begins_and_what_it_did(monkeypatch):
    held, log = Held(), []
    monkeypatch.setitem(sys.modules, 'numba', math)
    warming = Warming(held, log.append)
    assert held.begun.wait(240.0) and warming.is_alive()
    assert log == [
        'loading kernels, no input is heard until then; the first time on a machine '
        'they are compiled'
    ]
    held.let_go.set()
    warming.join()
    warming.trouble()
    assert log[1:] == ['2 kernels loaded']
    monkeypatch.delitem(sys.modules, 'numba')  # without it nothing is said
    Warming(lambda: '', log.append).join()
    assert len(log) == 2


def test_a_node_gets_warm_for_its_inputs(make_bench, monkeypatch):
    asked = []
    monkeypatch.setattr(WalkerTracker, 'warm', lambda self, inputs: asked.append(inputs))
    bench = make_bench()
    node = bench.start(TrackerNode, 'walker')
    bench.spin_until(lambda: node.state == 'active')
    (inputs,) = asked
    assert {Fix, Arrivals} <= inputs and Navigation not in inputs
