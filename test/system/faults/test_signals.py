# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Signals at random moments of a node's life, and the start after them: what they end is a
process. The short form has one node with and one without kernels, and one signal for each way to
end while they work; while they start all three that ask."""

import contextlib
from pathlib import Path
import signal
import subprocess
import time

from helpers.faults.cases import CASES
from helpers.faults.figures import count, long_form
from helpers.faults.rig import own_words, Rig, without_shared_memory
import numpy as np
import pytest

from sonar_imm_tools.replay.harness import local_discovery, NodeProcess, reserved_domain_id

pytestmark = pytest.mark.system

ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SYSTEMS = tuple(CASES) if long_form() else ('fathometer', 'obstacle')
STARTING = 'while it starts'
END_LIMIT = 300.0
"""Seconds a node may take to end."""


@pytest.mark.parametrize(
    'how', [*ASKING[: 3 if long_form() else 1], signal.SIGKILL], ids=lambda how: how.name
)
def test_a_signal_at_any_moment_ends_a_busy_node_and_it_starts_again(how, figures):
    """All nodes at once, each while it works on a burst of messages."""
    turns, unclean = count(1, 4), []
    figures.skip_if_measured(turns, system=SYSTEMS[-1], signal=how.name)
    rng = np.random.default_rng(int(how))
    discovery = without_shared_memory if how == signal.SIGKILL else local_discovery
    for _ in range(turns):
        with contextlib.ExitStack() as stack:
            rigs = begun(stack, discovery)
            for rig in rigs:
                for message in rig.case.messages()[: int(rng.integers(1, rig.case.count))]:
                    rig.publishers[message.topic].publish(message.content)
            time.sleep(0.2 * rng.random())
            for rig in rigs:
                rig.node.process.send_signal(how)
            for rig in rigs:
                unclean += reason_unclean(rig.node, -9 if how == 9 else 0)
            if how == signal.SIGKILL:
                # Under other domains: those of before take who was killed for alive for a while.
                rigs = begun(stack, discovery)
                for rig in rigs:
                    rig.send(rig.case.messages()[0])
                    rig.node.process.send_signal(signal.SIGINT)
                for rig in rigs:
                    unclean += reason_unclean(rig.node, 0)
    for system in SYSTEMS:
        mine = [why for name, why in unclean if name == system]
        key = {'system': system, 'signal': how.name}
        figures.add(key, tried=turns, clean=turns - len(mine), why=mine)
    assert not unclean


@pytest.mark.parametrize('system', SYSTEMS)
def test_signals_end_a_node_cleanly_at_any_moment_of_its_start(system, figures):
    """The first moment that is not the interpreter's, and others while modules load and kernels
    get warm, which takes two seconds."""
    moments, early, unclean = count(3, 8), 0, []
    figures.skip_if_measured(moments, system=system, signal=STARTING)
    rng = np.random.default_rng(17 + SYSTEMS.index(system))
    for turn in rng.permutation(moments):
        with reserved_domain_id() as domain, NodeProcess(system, domain_id=domain) as node:
            while not heeds_signals(node.process):
                assert node.process.poll() is None
                time.sleep(0.001)
            time.sleep(2.0 / moments * (turn + rng.random()) if turn else 0.0)
            early += 'ready, hears' not in node.log()
            node.process.send_signal(ASKING[turn % 3])
            node.process.send_signal(ASKING[turn % 3])  # as launch and a terminal do together
            unclean += reason_unclean(node, 0)
            lines = own_words(node.log()).splitlines()
            unclean += [(system, line) for line in lines if '[INFO]' not in line]
    key, clean = {'system': system, 'signal': STARTING}, moments - len(unclean)
    figures.add(key, tried=moments, clean=clean, why=unclean)
    assert not unclean and early > 0


def begun(stack, discovery):
    """Nodes that are ready."""
    begin = [Rig(CASES[system], connected=False, discovery=discovery) for system in SYSTEMS]
    rigs = [stack.enter_context(each) for each in begin]
    for rig in rigs:
        rig.connect()
    return rigs


def reason_unclean(node, expected):
    """What was wrong with the end of a node, with its name; nothing where it was clean."""
    try:
        code = node.process.wait(END_LIMIT)
    except subprocess.TimeoutExpired:
        code = f'none within {END_LIMIT:g} s'
    message = own_words(node.log())
    words = [word for word in ('Traceback', 'Error', 'terminate called') if word in message]
    wrong = words or code != expected
    return [(node.system, f'exit code {code}, {words}: {message[-500:]}')] if wrong else []


def heeds_signals(process):
    """Whether the process takes SIGTERM itself: Python alone never does."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith('SigCgt'))
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)
