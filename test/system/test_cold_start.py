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

"""A real node that compiles its kernels, with the defaults, is there for others meanwhile."""

import contextlib
import os
from pathlib import Path
import re
import time

from diagnostic_msgs.msg import DiagnosticArray
import pytest
from rcl_interfaces.srv import GetParameters

from sonar_imm.nodes.qos import output_qos
from sonar_imm_tools.replay.harness import local_discovery, NodeProcess, reserved_domain_id
from sonar_imm_tools.replay.link import Link

pytestmark = pytest.mark.system
LIMIT = 240.0
ANSWER = 2.0
"""Seconds in which a service is answered while kernels are compiled."""
FIRST = 5.0
"""CPU seconds of a node until its first answer: 1.5, some more while it loads numba."""


def cpu_seconds(pid):
    """Those of a process, whatever else the machine does."""
    user, system = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf('SC_CLK_TCK')


def test_a_node_answers_and_reports_while_it_compiles(tmp_path, monkeypatch):
    system = 'diver'
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    with contextlib.ExitStack() as stack:
        domain = stack.enter_context(reserved_domain_id())
        stack.enter_context(local_discovery())
        link = stack.enter_context(Link('asks', domain_id=domain))
        reports, answers = [], []
        link.node.create_subscription(
            DiagnosticArray, '/diagnostics', reports.append, output_qos()
        )
        client = link.node.create_client(GetParameters, f'/{system}/get_parameters')
        node = stack.enter_context(NodeProcess(system, domain_id=domain))

        def wait_for(predicate):
            assert link.wait_for(predicate, LIMIT, node.trouble), node.log()

        def compiles():
            sentences = [status.message for report in reports for status in report.status]
            return any(re.match(r'compiling \d+ of \d+ kernels, once', s) for s in sentences)

        def ask():
            request = GetParameters.Request(names=['frame_id'])
            client.call_async(request).add_done_callback(answers.append)
            wait_for(lambda: answers and answers.pop())

        wait_for(client.service_is_ready)
        ask()
        assert cpu_seconds(node.process.pid) < FIRST
        for _ in range(3):
            del reports[:]
            wait_for(compiles)
            begun = time.monotonic()
            ask()
            assert time.monotonic() - begun < ANSWER
        assert 'ready, hears' not in node.log()


def test_a_node_that_had_to_compile_has_the_memory_of_one_that_had_not(tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    memory = []
    with local_discovery(), reserved_domain_id() as domain, Link('asks', domain_id=domain) as link:
        for _ in range(2):
            with NodeProcess('fathometer', domain_id=domain) as node:
                assert link.wait_for(lambda node=node: 'ready, hears' in node.log(), LIMIT)
                status = Path(f'/proc/{node.process.pid}/status').read_text()
                memory.append(int(re.search(r'VmHWM:\s+(\d+) kB', status)[1]))
    assert memory[0] < 1.1 * memory[1]
