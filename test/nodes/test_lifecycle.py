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

"""A node that a lifecycle manager starts, by real clients of `lifecycle_msgs`."""

from functools import partial
import pickle
import time

from diagnostic_msgs.msg import DiagnosticArray
from helpers.node_bench import Steps
from helpers.rig import a_fix, FIX
from helpers.walker import WalkerTracker
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.lifecycle import TransitionCallbackReturn

from msg_adapters.estimates import read_estimate
from sonar_imm.estimation import jit  # noqa: E402
from sonar_imm.measurements import (
    Arrivals,  # noqa: E402
    Fix,
)
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.fls_detector import warm_steps as image_steps  # noqa: E402
from sonar_imm.nodes.managed import Warming  # noqa: E402
from sonar_imm.nodes.messages import message_class
from sonar_imm.nodes.qos import output_qos
from sonar_imm.trackers import SYSTEMS  # noqa: E402
from sonar_imm.trackers.obstacle.detector import DetectorConfig  # noqa: E402

pytestmark = pytest.mark.usefixtures('walker')


class Manager:
    """What a lifecycle manager does: asks for transitions, one after the other."""

    def __init__(self, bench, *, autostart=False):
        self.bench = bench
        self.node = bench.add(TrackerNode('walker', context=bench.context))
        assert autostart == (self.state() not in ('unconfigured',))

    def state(self):
        return self.bench.call(
            GetState, '/walker/get_state', GetState.Request()
        ).current_state.label

    def available(self):
        name = '/walker/get_available_transitions'
        found = self.bench.call(GetAvailableTransitions, name, GetAvailableTransitions.Request())
        return {each.transition.label for each in found.available_transitions}

    def ask(self, label='', number=0):
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        return self.bench.call(ChangeState, '/walker/change_state', request).success


@pytest.fixture
def manage(make_bench):
    """A manager of a node that does not start by itself, with these parameters."""

    def begin(*parameters):
        words = [word for each in ('autostart:=false', *parameters) for word in ('-p', each)]
        return Manager(make_bench(*words))

    return begin


def fixes(manager):
    return manager.bench.peer.create_publisher(message_class(FIX), '/fix', output_qos())


def send(manager, publisher, message, estimates):
    """Send one fix and wait for its estimate."""
    bench, before = manager.bench, len(estimates)
    bench.spin_until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(message)
    bench.spin_until(lambda: len(estimates) > before)
    return read_estimate(estimates[-1]).state[0, :2].tolist()


def test_a_node_starts_by_itself_unless_it_is_told_not_to(make_bench):
    bench = make_bench()
    events = bench.listen(TransitionEvent, '/walker/transition_event')
    manager = Manager(bench, autostart=True)
    bench.spin_until(lambda: manager.state() == 'active')
    assert manager.available() == {'deactivate', 'shutdown'}
    assert manager.ask('deactivate')
    bench.spin_until(lambda: events and events[-1].goal_state.label == 'inactive')
    assert events[-1].start_state.id == State.TRANSITION_STATE_DEACTIVATING


@pytest.mark.usefixtures('quick')
def test_the_life_of_a_managed_node(manage):
    manager = manage()
    bench, node = manager.bench, manager.node
    estimates = bench.listen(message_class('sensor_msgs/msg/PointCloud2'), '/walker/estimate', 10)
    reports = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    assert manager.available() == {'configure', 'shutdown'}
    assert not node.count_publishers('/walker/estimate') and not node.count_subscribers('/fix')
    bench.spin_until(
        lambda: reports and 'the node is unconfigured' in reports[-1].status[0].message
    )
    assert manager.ask('configure') and manager.state() == 'inactive'
    assert node.count_publishers('/walker/estimate') and not node.count_subscribers('/fix')
    assert manager.ask(number=Transition.TRANSITION_ACTIVATE) and manager.state() == 'active'
    publisher = fixes(manager)
    assert send(manager, publisher, a_fix(1.0, 0.0, 0.0), estimates) == [0.0, 0.0]

    assert manager.ask('deactivate') and manager.state() == 'inactive'
    bench.spin_until(lambda: publisher.get_subscription_count() == 0)
    bench.spin_until(lambda: 'the node is inactive' in reports[-1].status[0].message)
    assert manager.ask('activate')  # it goes on with what it knew
    assert send(manager, publisher, a_fix(2.0, 4.0, 2.0), estimates) == [2.0, 1.0]

    assert manager.ask('deactivate') and manager.ask('cleanup')
    assert manager.state() == 'unconfigured'
    bench.spin_until(lambda: not bench.peer.count_publishers('/walker/estimate'))
    assert manager.ask('configure') and manager.ask('activate')  # and now it begins anew
    assert send(manager, publisher, a_fix(3.0, 5.0, 5.0), estimates) == [5.0, 5.0]
    assert manager.ask('shutdown') and manager.state() == 'finalized'
    bench.spin_until(lambda: publisher.get_subscription_count() == 0)
    assert not manager.available()


def test_a_transition_that_the_state_does_not_have_is_refused_and_survived(manage, capfd):
    manager = manage()
    assert not manager.ask('activate') and not manager.ask(number=77) and not manager.ask('dance')
    assert not manager.ask(number=Transition.TRANSITION_ON_CONFIGURE_SUCCESS)
    assert manager.state() == 'unconfigured'
    assert "no transition 'activate' from unconfigured" in capfd.readouterr().err
    assert manager.ask('configure')
    assert not manager.ask('configure') and manager.state() == 'inactive'


@pytest.mark.usefixtures('quick')
def test_while_it_configures_the_node_answers_and_refuses_other_transitions(manage, monkeypatch):
    steps = Steps(fixes=Fix)
    monkeypatch.setattr(WalkerTracker, 'warm_steps', lambda self, inputs=None: steps(inputs))
    manager = manage()
    bench = manager.bench
    reports = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    client = bench.peer.create_client(ChangeState, '/walker/change_state')
    bench.spin_until(client.service_is_ready)
    asked = client.call_async(ChangeState.Request(transition=Transition(label='configure')))
    try:
        bench.spin_until(steps.begun['fixes'].is_set)
        assert manager.state() == 'configuring'
        assert not manager.ask('activate') and not manager.ask('shutdown')
        assert not manager.ask(number=Transition.TRANSITION_ON_CONFIGURE_SUCCESS)
        request = GetParameters.Request(names=['sound_speed'])
        answer = bench.call(GetParameters, '/walker/get_parameters', request)
        assert answer.values[0].double_value == 1500.0
        bench.spin_until(lambda: reports and 'loading kernels' in reports[-1].status[0].message)
        assert not asked.done()
    finally:
        steps.let_go()
    bench.spin_until(asked.done)
    assert asked.result().success and manager.state() == 'inactive'


def test_what_fails_while_configuring_is_logged_and_can_be_tried_again(manage, tmp_path, capfd):
    manager = manage(f'state_file:={tmp_path / "folder" / "state"}')
    assert not manager.ask('configure') and manager.state() == 'unconfigured'
    assert 'there is no folder' in capfd.readouterr().err
    (tmp_path / 'folder').mkdir()
    assert manager.ask('configure') and manager.state() == 'inactive'


def test_kernels_that_cannot_be_compiled_leave_the_node_unconfigured(manage, monkeypatch, capfd):
    def fails():
        raise ZeroDivisionError('a bug')

    monkeypatch.setattr(WalkerTracker, 'warm_steps', lambda self, inputs=None: [('all', fails)])
    manager = manage()
    assert not manager.ask('configure') and manager.state() == 'unconfigured'
    assert 'ZeroDivisionError: a bug' in capfd.readouterr().err
    assert not manager.node.count_publishers('/walker/estimate')


def test_an_input_that_cannot_be_heard_leaves_the_node_inactive(manage, capfd):
    manager = manage('qos_overrides./fixes.subscription.depth:=many')
    assert manager.ask('configure') and not manager.ask('activate')
    assert manager.state() == 'inactive' and 'depth' in capfd.readouterr().err
    assert not manager.node.count_subscribers('/fix')


def test_the_state_is_saved_by_cleanup_and_loaded_by_configure(manage, tmp_path):
    manager = manage(f'state_file:={tmp_path / "state"}')
    bench = manager.bench
    estimates = bench.listen(message_class('sensor_msgs/msg/PointCloud2'), '/walker/estimate', 10)
    assert manager.ask('configure') and manager.ask('activate')
    publisher = fixes(manager)
    send(manager, publisher, a_fix(1.0, 0.0, 0.0), estimates)
    assert manager.ask('deactivate') and manager.ask('cleanup') and (tmp_path / 'state').is_file()
    assert manager.ask('configure') and manager.ask('activate')
    assert send(manager, publisher, a_fix(2.0, 4.0, 2.0), estimates) == [2.0, 1.0]


def test_a_program_can_use_the_verbs_of_rclpy(manage):
    node = manage().node
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS and node.state == 'active'
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS


# -- A node while its kernels are compiled --


def kernels_of(steps):
    """Three kernels with three lines each for every step."""
    return 3 * len(steps), 9 * len(steps)


def finish(warming, steps):
    steps.let_go()
    warming.stop(wait=True)


def test_what_is_published_comes_first_and_the_rest_after_the_node_is_ready():
    steps = Steps(fixes=Fix, echoes=Arrivals)
    warming = Warming(steps, lambda: {Arrivals}, kernels_of)
    try:
        assert steps.begun['echoes'].wait(240.0) and not warming.ready()
        assert 'kernels (echoes)' in warming.sentence()
        assert 'no input is heard until then' in warming.sentence()
        steps.go['echoes'].set()
        assert steps.begun['fixes'].wait(240.0)
        assert warming.ready() and not warming.done()
        assert 'messages may wait for it' in warming.sentence()
    finally:
        finish(warming, steps)
    assert warming.done() and warming.sentence() == ''


def test_when_nobody_publishes_everything_is_there_before_the_node_is_ready():
    steps = Steps(fixes=Fix, echoes=Arrivals)
    warming = Warming(steps, lambda: None, kernels_of)
    try:
        steps.go['fixes'].set()
        assert steps.begun['echoes'].wait(240.0) and not warming.ready()
    finally:
        finish(warming, steps)
    assert steps.done == ['fixes', 'echoes'] and warming.ready()


def test_the_sentence_counts_the_kernels_of_what_is_published_and_then_of_all(monkeypatch):
    monkeypatch.setattr(jit, 'present', {})
    steps = Steps(fixes=Fix, echoes=Arrivals)
    warming = Warming(steps, lambda: {Fix}, kernels_of)

    def compiled(name):
        jit.present[name] = 3
        jit.kernels['compiled'] += 1
        return warming.sentence()

    try:
        assert steps.begun['fixes'].wait(240.0)
        assert warming.sentence() == 'loading kernels (fixes); no input is heard until then'
        once, end = 'kernels, once for this machine, some 0 s more', 'no input is heard until then'
        assert compiled('first') == f'compiling 2 of 3 {once} (fixes); {end}'
        steps.go['fixes'].set()
        assert steps.begun['echoes'].wait(240.0)
        end = 'messages may wait for it'
        assert compiled('second') == f'compiling 3 of 6 {once} (echoes); {end}'
    finally:
        jit.kernels['compiled'] -= 2
        finish(warming, steps)


def test_what_goes_wrong_is_raised_where_somebody_asks():
    def fails():
        raise ZeroDivisionError('a bug')

    warming = Warming(lambda inputs: [('fixes', fails)], lambda: {Fix}, kernels_of)
    while not warming.done():
        time.sleep(0.01)
    with pytest.raises(ZeroDivisionError):
        warming.trouble()


@pytest.mark.parametrize('system', [*SYSTEMS.values(), None])
def test_the_other_process_finds_the_steps_of_this_one(system):
    """As they are pickled for it; None: of images."""
    if system:
        config = system.config_type()()
        steps, own = partial(system.warm_steps, config), system.build(config).warm_steps()
    else:
        steps, own = partial(image_steps, DetectorConfig()), image_steps(DetectorConfig())
    assert [name for name, _ in pickle.loads(pickle.dumps(steps))()] == [name for name, _ in own]


@pytest.mark.parametrize('kept', [True, False])
def test_a_process_of_its_own_compiles_and_ends(kept, monkeypatch):
    """Where it keeps nothing the thread compiles."""
    there, done = [], []

    class Elsewhere:
        one_at_a_time = jit.Elsewhere.one_at_a_time
        begin = classmethod(lambda cls, steps: cls())
        compile = there.append
        stop = close = lambda self: there.append('ended')

    monkeypatch.setattr(jit, 'Elsewhere', Elsewhere)
    monkeypatch.setattr(jit, 'kept', lambda step: kept and bool(there))
    steps = [(name, lambda name=name: done.append(name)) for name in ('fixes', 'echoes')]
    warming = Warming(lambda inputs: steps, lambda: None, kernels_of, lambda: [])
    warming._thread.join(240.0)
    assert warming.ready() and warming.sentence() == ''
    warming.trouble()
    assert there == (['fixes', 'ended'] if kept else ['fixes', 'echoes', 'ended'])
    assert done == (['fixes'] if kept else ['fixes', 'echoes'])


@pytest.mark.usefixtures('quick')
def test_a_node_answers_and_reports_while_it_compiles(make_bench, monkeypatch):
    steps = Steps(fixes=Fix)
    monkeypatch.setattr(WalkerTracker, 'warm_steps', lambda self, inputs=None: steps(inputs))
    bench = make_bench()
    reports = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    node = bench.add(TrackerNode('walker', context=bench.context))
    try:
        request = GetParameters.Request(names=['sound_speed'])
        answer = bench.call(GetParameters, '/walker/get_parameters', request)
        assert answer.values[0].double_value == 1500.0
        bench.spin_until(lambda: reports and 'kernels' in reports[-1].status[1].message)
        assert reports[-1].status[0].message == reports[-1].status[1].message
        assert not node.get_subscriptions_info_by_topic('/fix')
    finally:
        steps.let_go()
    bench.spin_until(lambda: node.get_subscriptions_info_by_topic('/fix'))
    bench.spin_until(lambda: 'no message yet on' in reports[-1].status[0].message)
