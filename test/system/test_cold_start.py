# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Real nodes and their kernels, with the defaults, from an empty folder or a damaged one.

What is compiled or loaded already stays so in a process of tests.
"""

import contextlib
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


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Starts a node that keeps its kernels in a folder of its own; gives it and a link."""
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'kernels'))
    with contextlib.ExitStack() as stack:
        domain = stack.enter_context(reserved_domain_id())
        stack.enter_context(local_discovery())

        def begin(system):
            link = stack.enter_context(Link('asks', domain_id=domain))
            return stack.enter_context(NodeProcess(system, domain_id=domain)), link

        yield begin


def wait_for(node, link, predicate):
    assert link.wait_for(predicate, LIMIT, node.trouble), node.log()


def test_a_node_answers_and_reports_while_it_compiles(start):
    node, link = start('bathymetry')
    reports, answers, longest, begun = [], [], 0.0, time.monotonic()
    link.node.create_subscription(DiagnosticArray, '/diagnostics', reports.append, output_qos())
    client = link.node.create_client(GetParameters, '/bathymetry/get_parameters')

    def compiles():
        sentences = [status.message for report in reports for status in report.status]
        return 'loading kernels, no input is heard until then' in sentences

    wait_for(node, link, client.service_is_ready)
    for _ in range(3):
        del reports[:]
        wait_for(node, link, compiles)
        asked = time.monotonic()
        request = GetParameters.Request(names=['frame_id'])
        client.call_async(request).add_done_callback(answers.append)
        wait_for(node, link, lambda: answers and answers.pop())
        longest = max(longest, time.monotonic() - asked)
    assert 'ready, hears' not in node.log()
    wait_for(node, link, lambda: 'ready, hears' in node.log())
    assert longest < 0.25 * (time.monotonic() - begun)  # however slow the machine is
    assert re.search(r'loading kernels.*\n.*[1-9] kernels compiled, 0 loaded', node.log())


def test_a_damaged_folder_ends_a_node_with_one_sentence(start, tmp_path):
    node, link = start('fathometer')
    wait_for(node, link, lambda: 'ready, hears' in node.log())
    for index in (tmp_path / 'kernels').rglob('*.nbi'):
        index.write_bytes(index.read_bytes()[:-9])
    node, _ = start('fathometer')
    assert node.process.wait(LIMIT) == 2
    folder = re.escape(str(tmp_path / 'kernels'))
    assert re.search(
        f'compiled kernels in {folder} cannot be read or kept .*truncated', node.log()
    )
    assert 'Traceback' not in node.log()


def test_a_node_without_kernels_loads_no_numba(start):
    node, link = start('obstacle')
    wait_for(node, link, lambda: 'ready, hears' in node.log())
    maps = Path(f'/proc/{node.process.pid}/maps').read_text()
    assert 'numpy' in maps and 'llvmlite' not in maps
    assert 'kernels' not in node.log()
