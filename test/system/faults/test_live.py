# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that cannot keep up says so, and is live again when it can: of a processor that others
have, only a process can be short. How old estimates are then: `nodes/test_base.py`."""

import contextlib
import copy
import os
import subprocess
import sys
import time

from helpers.faults.cases import CASES, SECOND
from helpers.faults.rig import Rig
import numpy as np
import pytest
from rclpy.serialization import serialize_message

pytestmark = pytest.mark.system

AGE = 'age of estimates p50 [s]'


class Live:
    """Sends fixes of a diver that does not move to a node, each with the stamp of now."""

    def __init__(self, rig):
        self._rig = rig
        # A copy, because all tests of a process share the messages of a case.
        first = next(item.content for item in rig.case.messages() if item.primary)
        self._fix = copy.deepcopy(first)
        place, covariance = self._fix.pose.pose.position, self._fix.pose.covariance
        self._at, self._std = (place.x, place.y), np.sqrt(covariance[[0, 7]])
        self._errors = np.random.default_rng(0)

    def send(self, count):
        """So many fixes at once."""
        publisher = self._rig.publishers[self._rig.case.primary]
        stamp, place = self._fix.header.stamp, self._fix.pose.pose.position
        for _ in range(count):
            place.x, place.y = self._errors.normal(self._at, self._std)
            stamp.sec, stamp.nanosec = divmod(time.time_ns(), SECOND)
            publisher.publish(serialize_message(self._fix))

    def until(self, told, count):
        """Send `count` fixes twenty times a second until `told` holds of what is reported."""
        due = time.monotonic()

        def looked():
            nonlocal due
            if time.monotonic() >= due:
                self.send(count)
                due = time.monotonic() + 0.05
            return told(self._rig.diagnostics)

        self._rig.diagnostics.forget()
        assert self._rig.wait_for(looked), self._rig.diagnostics.words


def said(words):
    return lambda report: any(words in each for each in report.words)


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
        live = Live(rig)
        live.until(said('OK: receiving'), 1)
        with stalled(rig):
            live.until(said('faster than it can be processed'), 5)

        def live_again(report):
            if said('faster than it can')(report):
                report.forget()
            return bool(report.words) and float(report.values[AGE]) < 1.0

        live.until(live_again, 1)
