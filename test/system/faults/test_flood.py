# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Input at ten times what a node can process, at the pace of the clock instead of in lock-step:
sender and node need a processor each, and so a process. How old estimates are then, and in which
words: `nodes/test_base.py`, `nodes/test_diagnostics.py`.
"""

from collections import Counter
import itertools
import time

from helpers.faults.cases import CASES, SECOND
from helpers.faults.figures import long_form
from helpers.faults.rig import Rig
import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2

from sonar_imm.nodes.qos import lockstep_qos

pytestmark = pytest.mark.system

MAX_WAIT = 0.3
USUAL = 20
"""Messages by which it is measured how fast a node is."""


# One sender in Python publishes about a thousand messages in a second: no flood for the others.
@pytest.mark.parametrize('system', ['fathometer', 'bathymetry'] if long_form() else ['fathometer'])
def test_a_flooded_node_answers_soon_counts_what_it_drops_and_recovers(system, figures):
    figures.skip_if_measured(system=system)
    found = flooded(CASES[system], MAX_WAIT, times=10.0, seconds=3.0)
    figures.add({'system': system}, max_wait=MAX_WAIT, **found)
    assert found['rate'] > 5.0 * found['capacity'] and found['warned']
    missed = found['dropped'] + found['lost']
    assert found['sent'] == found['used'] + missed and missed > 0.3 * found['sent']
    work = found['sent'] / found['capacity']  # half a minute: what all of it would take
    # A loaded machine is slow with each message.
    assert found['latency_p50'] < MAX_WAIT + 0.05 * work
    assert max(found['latency_max'], found['recovered']) < 0.3 * work


def flooded(case, max_wait, *, times, seconds):
    """Send messages to the node of `case` for a while, `times` as fast as it can process them.

    capacity, rate: messages per second that can be processed, and that were sent; sent, used,
    dropped, lost: messages, the latter two as /diagnostics counts them; latency_max, latency_p50:
    s, from sending a message to its estimate; recovered: s from the end of the flood until a
    message is answered as quickly as before it; warned: whether /diagnostics said so.
    """
    with Rig(case, ('-p', f'max_wait:={max_wait}'), lossless=False) as rig:
        rig.play(case.messages())
        stream = endless(case)
        start = time.monotonic()
        for entry in itertools.islice(stream, USUAL):
            rig.send(entry)
        usual = (time.monotonic() - start) / USUAL
        many = list(itertools.islice(stream, int(seconds * times / usual) + 1))
        given = Sent(rig)
        before = given.counts()
        start = time.monotonic()
        for k, entry in enumerate(many):
            given.send(entry)
            rig.link.wait_for(lambda: False, start + (k + 1) * usual / times - time.monotonic())
        ended = time.monotonic()
        soon = next(item for item in stream if given.soon(item, 5.0 * usual))
        rig.fresh_diagnostics()
        after = given.counts() - before
        waits = np.array([*given.latency.values()])
        return {
            'capacity': 1.0 / usual, 'rate': len(many) / (ended - start), 'sent': len(given.sent),
            'used': after['received'] - after['dropped'], 'dropped': after['dropped'],
            'lost': after['lost'], 'latency_max': float(waits.max()),
            'latency_p50': float(np.median(waits)), 'recovered': given.sent[soon.stamp_ns] - ended,
            'warned': 'WARN' in rig.diagnostics.levels,
        }  # fmt: skip


class Sent:
    """When messages were sent, and how long it took to hear of each. sent: s of the steady clock,
    latency: s, both by stamp."""

    def __init__(self, rig):
        self._rig = rig
        self.sent: dict[int, float] = {}
        self.latency: dict[int, float] = {}
        topic = f'/{rig.case.system}/estimate'
        rig.link.node.create_subscription(PointCloud2, topic, self._answered, lockstep_qos())
        rig.wait_for(lambda: rig.link.node.count_subscribers(topic) > 1)
        rig.diagnostics.forget()

    def send(self, item):
        self.sent[item.stamp_ns] = time.monotonic()
        self._rig.publishers[item.topic].publish(item.content)

    def soon(self, item, limit):
        """Whether the answer to a message comes within `limit`; waits for that time at least."""
        self.send(item)
        self._rig.link.wait_for(lambda: item.stamp_ns in self.latency, limit)
        return item.stamp_ns in self.latency

    def counts(self):
        """Messages on the primary input so far: received, and of these dropped; lost."""
        self._rig.fresh_diagnostics()
        given, topic = self._rig.diagnostics.counts(), self._rig.case.primary
        return Counter(
            received=given[f'{topic} received'],
            dropped=given[f'{topic} dropped, waited too long'],
            lost=given[f'lost on {topic}'] + given[f'lost on /{topic}'],
        )

    def _answered(self, message):
        stamp = message.header.stamp
        stamp_ns = stamp.sec * SECOND + stamp.nanosec
        if stamp_ns in self.sent:
            self.latency.setdefault(stamp_ns, time.monotonic() - self.sent[stamp_ns])


def endless(case):
    """The messages of a case again and again after they were sent once, their stamps moved on."""
    messages = case.messages()
    length = (messages[-1].stamp_ns - messages[0].stamp_ns) / SECOND + case.period
    for turn in itertools.count(1):
        yield from (message.moved(turn * length) for message in messages)
