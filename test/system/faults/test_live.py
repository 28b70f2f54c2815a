# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that cannot keep up says how old its estimates are, and is live again when it can."""

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


class Live:
    """Sends fixes of a diver to a node, each with the stamp of now."""

    def __init__(self, rig):
        self._rig = rig
        # A copy, because all tests of a process share the messages of a case.
        self._fix = copy.deepcopy(
            next(item.content for item in rig.case.messages() if item.primary)
        )
        place, covariance = self._fix.pose.pose.position, self._fix.pose.covariance
        self._at, self._std = (place.x, place.y), np.sqrt(covariance[[0, 7]])
        self._errors = np.random.default_rng(0)

    def send(self, count):
        """So many fixes at once, of one that does not move."""
        publisher = self._rig.publishers[self._rig.case.primary]
        stamp, place = self._fix.header.stamp, self._fix.pose.pose.position
        for _ in range(count):
            place.x, place.y = self._errors.normal(self._at, self._std)
            stamp.sec, stamp.nanosec = divmod(time.time_ns(), SECOND)
            publisher.publish(serialize_message(self._fix))

    def until(self, told, count, every):
        """Send `count` fixes each `every` seconds until `told` holds."""
        due = time.monotonic()

        def looked():
            nonlocal due
            if time.monotonic() >= due:
                self.send(count)
                due = time.monotonic() + every
            return told()

        self._rig.diagnostics.forget()
        assert self._rig.wait_for(looked), self._rig.diagnostics.words

    def until_said(self, pattern, count, every):
        """The same until /diagnostics says something that has the pattern."""

        def said():
            return next(filter(None, (re.search(pattern, each) for each in words)), None)

        words = self._rig.diagnostics.words
        self.until(said, count, every)
        return said()


def test_a_flooded_diver_node_that_drops_nothing_says_how_old_its_estimates_are():
    words = ('max_wait:=0.0', 'max_age:=0.2', 'qos_overrides./fix.subscription.depth:=2000')
    arguments = [word for each in words for word in ('-p', each)]
    with Rig(CASES['diver'], arguments, lossless=False) as rig:
        sentence = r'estimates are ([\d.]+) s old: input comes faster than it can be processed'
        sentence = rf'^WARN: .*{sentence}; [\d,]+ of [\d,]+ messages lost'
        assert float(Live(rig).until_said(sentence, *FLOOD)[1]) >= 0.2


@contextlib.contextmanager
def stalled(rig):
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

        def live_again():
            if any('faster than it can' in words for words in told.words):
                told.forget()
            return bool(told.words) and float(told.values[AGE]) < 1.0

        live.until(live_again, 1, 0.05)
