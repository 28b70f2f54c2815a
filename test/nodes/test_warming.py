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

"""A node while its kernels are compiled."""

from functools import partial
import pickle
import time

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from helpers.node_bench import Steps  # noqa: E402
from helpers.walker import WalkerTracker  # noqa: E402
from rcl_interfaces.srv import GetParameters  # noqa: E402

from sonar_imm.estimation import jit  # noqa: E402
from sonar_imm.measurements import Arrivals, Fix  # noqa: E402
from sonar_imm.nodes.base import TrackerNode  # noqa: E402
from sonar_imm.nodes.fls_detector import warm_steps as image_steps  # noqa: E402
from sonar_imm.nodes.managed import Warming  # noqa: E402
from sonar_imm.nodes.qos import output_qos  # noqa: E402
from sonar_imm.trackers import SYSTEMS  # noqa: E402
from sonar_imm.trackers.obstacle.detector import DetectorConfig  # noqa: E402

pytestmark = pytest.mark.usefixtures('walker')


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


def test_a_node_answers_and_reports_while_it_compiles(make_bench, monkeypatch):
    steps = Steps(fixes=Fix)
    monkeypatch.setattr(WalkerTracker, 'warm_steps', lambda self, inputs=None: steps(inputs))
    bench = make_bench('-p', 'diagnostics_period:=0.05')
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
