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

"""Signals at random moments of a node's life, and the start after them."""

import signal
import time

from helpers.faults.cases import CASES
from helpers.faults.figures import count
from helpers.faults.nodes import ended, heeds_signals, reason_unclean, Running
from helpers.live import own_words
import numpy as np
import pytest

from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id

pytestmark = pytest.mark.system

ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SYSTEMS = tuple(CASES)
STARTING = 'while it starts'


@pytest.mark.parametrize('how', [*ASKING, signal.SIGKILL], ids=lambda how: how.name)
def test_a_signal_at_any_moment_ends_a_busy_node_and_it_starts_again(how, figures):
    """All four nodes at once, each while it works on a burst of messages."""
    turns, unclean = count(1, 4), []
    figures.skip_if_measured(turns, system=SYSTEMS[-1], signal=how.name)
    rng = np.random.default_rng(int(how))
    for _ in range(turns):
        with Running(SYSTEMS) as running:
            for system in SYSTEMS:
                running.send(system, int(rng.integers(1, len(CASES[system].messages()))))
            time.sleep(0.2 * rng.random())
            for system in SYSTEMS:
                running.nodes[system].process.send_signal(how)
            for system in SYSTEMS:
                unclean += reason_unclean(running.nodes[system], -9 if how == 9 else 0)
            if how == signal.SIGKILL:
                running.start_again()
                for system in SYSTEMS:
                    running.step(system)
                unclean += running.stop()
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
        with (
            reserved_domain_id() as domain,
            NodeProcess(system, domain_id=domain) as node,
        ):
            while not heeds_signals(node.process):
                assert node.process.poll() is None
                time.sleep(0.001)
            time.sleep(2.0 / moments * (turn + rng.random()) if turn else 0.0)
            early += 'ready, hears' not in node.log()
            node.process.send_signal(ASKING[turn % 3])
            node.process.send_signal(ASKING[turn % 3])  # as launch and a terminal do together
            unclean += reason_unclean(node, 0)
            lines = own_words(node.log()).splitlines()
            said = [line for line in lines if '[INFO]' not in line]
            unclean += [(system, line) for line in said]
    figures.add(
        {'system': system, 'signal': STARTING},
        tried=moments,
        clean=moments - len(unclean),
        why=unclean,
    )
    assert not unclean and early > 0
    assert ended()
