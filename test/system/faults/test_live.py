# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that cannot keep up says how old its estimates are, and `max_wait` keeps them live."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import copy
import os
import re
import subprocess
import sys
import time

from helpers.faults.cases import CASES, SECOND
from helpers.faults.rig import Rig
import numpy as np
import pytest
from rclpy.serialization import serialize_message

pytestmark = pytest.mark.system

FLOOD = (50, 0.01)
"""Messages, and each so many seconds: more at once are lost on their way, not in the queue."""
AGE = 'age of estimates p50 [s]'
DEPTH = 'qos_overrides./fix.subscription.depth:={}'


class Live:
    """Sends fixes of a diver to a node, each with the stamp of now."""

    def __init__(self, rig: Rig):
        self._rig = rig
        # A copy, because all tests of a process share the messages of a case.
        self._fix = copy.deepcopy(
            next(item.content for item in rig.case.messages() if item.primary)
        )
        place, covariance = self._fix.pose.pose.position, self._fix.pose.covariance
        self._at, self._std = (place.x, place.y), np.sqrt(covariance[[0, 7]])
        self._errors = np.random.default_rng(0)
        self.sent = 0

    def send(self, count: int) -> None:
        """So many fixes at once, of one that does not move."""
        publisher = self._rig.publishers[self._rig.case.primary]
        stamp, place = self._fix.header.stamp, self._fix.pose.pose.position
        for _ in range(count):
            place.x, place.y = self._errors.normal(self._at, self._std)
            stamp.sec, stamp.nanosec = divmod(time.time_ns(), SECOND)
            publisher.publish(serialize_message(self._fix))
        self.sent += count

    def until(self, told: Callable[[], bool], count: int, every: float) -> None:
        """Send `count` fixes each `every` seconds until `told` holds."""
        due = time.monotonic()

        def looked() -> bool:
            nonlocal due
            if time.monotonic() >= due:
                self.send(count)
                due = time.monotonic() + every
            return told()

        self._rig.diagnostics.forget()
        assert self._rig.wait_for(looked), self._rig.diagnostics.words

    def until_said(self, pattern: str, count: int, every: float) -> None:
        """The same until /diagnostics says something that has the pattern."""
        words = self._rig.diagnostics.words
        self.until(lambda: any(re.search(pattern, said) for said in words), count, every)

    def settled(self) -> None:
        """Wait until all that was sent is counted."""
        self._rig.wait_for(lambda: sum(self.counts().values()) == self.sent)
        assert sum(self.counts().values()) == self.sent

    def counts(self) -> dict[str, int]:
        """Fixes that were received and that were lost."""
        given, topic = self._rig.diagnostics.counts(), self._rig.case.primary
        lost = max(given[f'lost on {topic}'], given[f'lost on /{topic}'])
        return {'received': given[f'{topic} received'], 'lost': lost}


def test_estimates_of_a_flooded_diver_node_stay_live_and_losses_are_said():
    with Rig(
        CASES['diver'], ('-p', 'max_wait:=0.3', '-p', DEPTH.format(5000)), lossless=False
    ) as rig:
        live = Live(rig)
        live.until_said('faster than it can be processed: .* messages dropped', *FLOOD)
        values = dict(rig.diagnostics.values)
        live.send(1)
        live.settled()
        dropped = rig.diagnostics.counts()['fix dropped, waited too long']
        assert 0 < dropped < live.sent
        # A loaded machine is slow with each message; none waits for those before it.
        assert float(values['waited in the queue p50 [s]']) < 0.3 + 1.0
        assert float(values[AGE]) < 0.3 + 1.0


def test_a_flooded_diver_node_that_drops_nothing_says_how_old_its_estimates_are():
    words = ('max_wait:=0.0', 'max_age:=0.2', DEPTH.format(2000))
    arguments = [word for each in words for word in ('-p', each)]
    with Rig(CASES['diver'], arguments, lossless=False) as rig:
        sentence = r'estimates are [\d.]+ s old: input comes faster than it can be processed'
        Live(rig).until_said(rf'^WARN: .*{sentence}; [\d,]+ of [\d,]+ messages lost', *FLOOD)
        assert float(rig.diagnostics.values[AGE]) > 0.2


@contextlib.contextmanager
def stalled(rig: Rig) -> Iterator[None]:
    """Let the node have what two busy processes leave of their processor."""
    pid, code = rig.node.process.pid, 'while True: pass'
    everywhere, before = os.sched_getaffinity(pid), os.getpriority(os.PRIO_PROCESS, pid)
    busy = [subprocess.Popen([sys.executable, '-c', code]) for _ in range(2)]
    try:
        for task in os.listdir(f'/proc/{pid}/task'):
            os.setpriority(os.PRIO_PROCESS, int(task), 19)
            os.sched_setaffinity(int(task), {min(everywhere)})
        for each in busy:
            os.sched_setaffinity(each.pid, {min(everywhere)})
        yield
    finally:
        for each in busy:
            each.kill()
            each.wait()
        for task in os.listdir(f'/proc/{pid}/task'):
            os.sched_setaffinity(int(task), everywhere)
            with contextlib.suppress(PermissionError):  # it stays nice, and has no neighbours
                os.setpriority(os.PRIO_PROCESS, int(task), before)


@pytest.mark.skipif(sys.platform != 'linux', reason='processors are chosen as on Linux')
def test_a_node_without_a_processor_says_so_and_is_live_again_with_one():
    with Rig(CASES['diver'], lossless=False) as rig:
        live, told = Live(rig), rig.diagnostics
        live.until_said('OK: receiving', 1, 0.05)
        with stalled(rig):
            live.until_said('faster than it can be processed', 5, 0.05)

        def live_again() -> bool:
            if any('faster than it can' in words for words in told.words):
                told.forget()
            return bool(told.words) and float(told.values[AGE]) < 1.0

        live.until(live_again, 1, 0.05)
