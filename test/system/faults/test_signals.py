# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Signals at random moments of a node's life, and the start after them: they end a process."""

from __future__ import annotations

from collections.abc import Callable, Iterable
import contextlib
from pathlib import Path
import signal
import subprocess
import time
from typing import Any

from helpers.faults.cases import CASES
from helpers.faults.figures import count
from helpers.faults.rig import without_shared_memory
from helpers.live import own_words
import numpy as np
import pytest

from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm_tools.replay.harness import (
    local_discovery,
    NodeProcess,
    reserved_domain_id,
    START_LIMIT,
)
from sonar_imm_tools.replay.link import Link
from sonar_imm_tools.replay.lockstep import LockStep

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
        discovery = without_shared_memory if how == signal.SIGKILL else local_discovery
        with Running(SYSTEMS, discovery) as running:
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
            message = [line for line in lines if '[INFO]' not in line]
            unclean += [(system, line) for line in message]
    figures.add(
        {'system': system, 'signal': STARTING},
        tried=moments,
        clean=moments - len(unclean),
        why=unclean,
    )
    assert not unclean and early > 0
    assert ended()


# -- several nodes as processes, without lock-step ------------------------------------------------


END_LIMIT = 120.0
"""Seconds a node may take to end."""


class Running:
    """Nodes in a ROS domain of their own, ready and connected; ended by ``with``."""

    def __init__(
        self,
        systems: Iterable[str],
        discovery: Callable[[], contextlib.AbstractContextManager[None]],
    ):
        """Start them; discovery: how link and nodes find each other."""
        self._stack = contextlib.ExitStack()
        self._discovery = discovery
        self.nodes: dict[str, NodeProcess] = {}
        self._lockstep: dict[str, LockStep] = {}
        self._publishers: dict[tuple[str, str], Any] = {}
        try:
            self._start([*systems])
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Running:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def send(self, system: str, messages: int) -> None:
        """Publish the first messages of a case and wait for none of them."""
        for message in CASES[system].messages()[:messages]:
            self._publishers[system, message.topic].publish(message.content)

    def step(self, system: str) -> None:
        """Send one message, and wait for its answer."""
        item = CASES[system].messages()[0]
        self._lockstep[system].step(self._publishers[system, item.topic], item.content)

    def start_again(self) -> None:
        """Start all nodes anew, under the names of those that were killed, with a new link and in
        another domain: that of before takes them for alive for a while."""
        self._start([*self.nodes])

    def stop(self) -> list[tuple[str, str]]:
        """End all nodes; gives what was wrong with that."""
        for node in self.nodes.values():
            node.process.send_signal(signal.SIGINT)
        return [why for node in self.nodes.values() for why in reason_unclean(node, 0)]

    def _start(self, systems: list[str]) -> None:
        domain = self._stack.enter_context(reserved_domain_id())
        with self._discovery():
            self._link = self._stack.enter_context(Link('rig', domain_id=domain))
        for system in systems:
            for topic, cls in {m.topic: type(m.content) for m in CASES[system].messages()}.items():
                self._publishers[system, topic] = self._link.node.create_publisher(
                    cls, f'/{system}/{topic}', lockstep_qos()
                )
        for system in systems:
            topics = [topic for name, topic in self._publishers if name == system]
            remaps = [f'{topic}:=/{system}/{topic}' for topic in topics]
            qos = [f'qos_overrides./{system}/{topic}.subscription' for topic in topics]
            arguments = [word for remap in remaps for word in ('-r', remap)]
            arguments += [
                word
                for name in qos
                for policy in ('history:=keep_all', 'reliability:=reliable')
                for word in ('-p', f'{name}.{policy}')
            ]
            with self._discovery():
                self.nodes[system] = self._stack.enter_context(
                    NodeProcess(system, domain_id=domain, arguments=arguments)
                )
        for system in systems:
            step = LockStep(self._link, f'/{system}', trouble=self.nodes[system].trouble)
            publishers = [p for (name, _), p in self._publishers.items() if name == system]
            step.connect(publishers, START_LIMIT)
            self._lockstep[system] = step


def reason_unclean(node: NodeProcess, expected: int) -> list[tuple[str, str]]:
    """What was wrong with the end of a node, with its name; nothing where it was clean."""
    try:
        code = node.process.wait(END_LIMIT)
    except subprocess.TimeoutExpired:
        given = f'it did not end within {END_LIMIT:g} s: {_doing(node.process.pid)}, {node.log()}'
        return [(node.system, given[-1000:])]
    if code != expected:
        return [(node.system, f'exit code {code}: {node.log()[-500:]}')]
    message = own_words(node.log())
    words = [word for word in ('Traceback', 'Error', 'terminate called') if word in message]
    return [(node.system, f'{words}: {message[-500:]}')] if words else []


def _doing(pid: int) -> str:
    """State and CPU seconds of each thread: whether a process hangs or only gets no processor."""
    given = []
    for task in Path(f'/proc/{pid}/task').iterdir():
        words = (task / 'stat').read_text().rpartition(')')[2].split()
        given.append(f'{words[0]} {(int(words[11]) + int(words[12])) / 100.0:g} s')
    return ', '.join(given)


def heeds_signals(process: subprocess.Popen[bytes]) -> bool:
    """Whether the process takes SIGTERM itself: Python alone never does."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith('SigCgt'))
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def ended(limit: float = END_LIMIT) -> bool:
    """Whether this process has no children left, zombies not counted."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        if not [pid for pid in _children() if _alive(pid)]:
            return True
        time.sleep(0.05)
    return False


def _children() -> list[int]:
    path = Path('/proc/self/task')
    return [int(pid) for item in path.iterdir() for pid in (item / 'children').read_text().split()]


def _alive(pid: int) -> bool:
    """Whether it runs, and is none of those that multiprocessing keeps for later."""
    try:
        if b'from multiprocessing' in Path(f'/proc/{pid}/cmdline').read_bytes():
            return False
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except FileNotFoundError:
        return False
