# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How old a node says that its estimates are: slow publishers, and clocks that are off."""

import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from helpers.rig import a_fix, Rig
import pytest

from sonar_imm.nodes import base
from sonar_imm.nodes.ages import Ages
from sonar_imm.nodes.diagnostics import RISE
from sonar_imm.nodes.qos import output_qos

pytestmark = pytest.mark.usefixtures('walker')


@pytest.fixture
def told(make_bench, monkeypatch, quick):
    """What a node says of itself when it hears a dozen messages, one each `period` seconds of its
    steady clock, with stamps `age` seconds before its time: the status of the tracker at the
    end."""
    later = 0.0
    clock = SimpleNamespace(time_ns=time.time_ns, monotonic=lambda: time.monotonic() + later)
    monkeypatch.setattr(base, 'time', clock)

    def told(period, age):
        nonlocal later
        rig = Rig(make_bench())
        received = rig.bench.listen(DiagnosticArray, '/diagnostics', output_qos())
        rig.bench.spin_until(lambda: rig.node.count_subscribers('/diagnostics'))
        for _ in range(12):
            rig.send(a_fix(rig.node.get_clock().now().nanoseconds * 1e-9 - age))
            later += period
        received.clear()
        rig.bench.spin_until(lambda: len(received) > RISE)
        return received[-1].status[1]

    return told


def test_a_slow_publisher_is_no_warning(told):
    """Six seconds of delay are little beside a fix each 8 s."""
    status = told(8.0, 6.0)
    assert (status.level, status.message) == (DiagnosticStatus.OK, 'tracking')


def test_the_same_delay_of_a_quick_publisher_is_one(told):
    status = told(0.2, 6.0)
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith('estimates are 6.')
    assert status.message.endswith('because their messages arrive that late')


@pytest.mark.parametrize(('age', 'way'), [(3600.0, 'behind'), (-3600.0, 'ahead of')])
def test_a_clock_that_is_an_hour_off_is_said_as_a_clock(told, age, way):
    status = told(0.2, age)
    assert status.level == DiagnosticStatus.OK
    assert status.message == f'stamps are 3600 s {way} the clock of this computer: one is off'
    values = {pair.key: pair.value for pair in status.values}
    assert float(values['age of estimates p50 [s]']) == pytest.approx(age, abs=30.0)


@pytest.mark.parametrize(
    ('age', 'wait', 'said'),
    [
        (3602.0, 2.0, ('estimates are 2.0 s old', 'stamps are 3600 s behind')),
        (-3598.0, 2.0, ('estimates are 2.0 s old', 'stamps are 3600 s ahead of')),
        (100.0, 100.0, ('estimates are 100.0 s old', '')),
        (3600.0, 0.0, ('', 'stamps are 3600 s behind')),
        (0.2, 0.1, ('', '')),
    ],
)
def test_what_waits_in_the_node_is_no_clock_and_hides_none(age, wait, said):
    ages = Ages()
    for k in range(12):
        ages.published(0.1 * k, age, wait)
    report = ages.report(1.2)
    assert (report.slow.partition(':')[0], report.clock.partition(' the clock')[0]) == said
