# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Real nodes without launch: start one, play a bag to it in lock-step, take its estimates.

``sonar-imm check`` compares the estimates with those of the offline tracker, bit by bit;
``sonar-imm bench`` reads the delays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import os
from pathlib import Path
import random
import signal
import socket
import subprocess
import sys
import tempfile
from typing import Any

from attrs import evolve, frozen
import numpy as np

from msg_adapters.inputs import FEEDERS, InputTopic
from sonar_imm.estimates import Estimate
from sonar_imm.files import lock
from sonar_imm.nodes.stopping import ENDING
from sonar_imm.trackers import SYSTEMS

from ..recordings.measurements import fitting_topics
from ..recordings.reader import BagReader
from .link import Link, LinkError
from .lockstep import Chain, Counts, FirstStep, LockStep, Recorder
from .player import NAME, Player, PlayOptions

START_LIMIT = 300.0
"""Seconds a node may take to appear, with nothing compiled yet, on a slow or busy machine."""
_STOP_LIMIT = 10.0
_LOG_TAIL = 12
_SHARED_MEMORY = Path('/dev/shm')
_RESERVED = 22119
"""A port that listens, less the domain it reserves."""


@frozen(eq=False)
class LockstepResult:
    """What a live node made of a recording.

    estimates: all it published, in order; counts: messages it took and refused, and estimates it
    published; delays: seconds from sending a message to its last estimate, one for each message
    that brought an estimate; exit_code and log: of the node's process, after SIGINT; problems:
    sentences about the recording.
    """

    estimates: list[Estimate]
    counts: Counts
    delays: tuple[float, ...]
    exit_code: int
    log: str
    problems: tuple[str, ...]

    def latency_ms(self) -> dict[str, float]:
        """Percentiles of the delays in milliseconds: ``p50`` and ``p99``; NaN without any."""
        values = np.percentile(self.delays, (50, 99)) if self.delays else (np.nan, np.nan)
        return {'p50': 1e3 * float(values[0]), 'p99': 1e3 * float(values[1])}


def run_lockstep(
    path: Path | str,
    system: str,
    *,
    params_file: Path | str | None = None,
    settings: Mapping[str, Any] | None = None,
    topics: Mapping[str, str] | None = None,
    progress: Callable[[int], None] = lambda count: None,
) -> LockstepResult:
    """Start the node of `system` as a process and play the bag at `path` to it in lock-step.

    settings: parameters of the tracker, where `params_file` names tags or sensors, which have
    topics of their own. topics: recorded topic names to input names, as in `fitting_topics`; by
    default those that fit. Node and player meet in a ROS domain of their own on this machine.
    Raises `BagError` for the bag and `LinkError` when the node ends, does not answer or refuses
    its parameters.
    """
    with contextlib.ExitStack() as stack:
        bag = stack.enter_context(BagReader(path))
        inputs = {
            name: evolve(entry, name=entry.instance(name, settings or {}))
            for name, entry in fitting_topics(bag, system, topics).items()
            if entry.wanted(settings or {})
        }
        fed = {topic: entry for topic, entry in inputs.items() if entry.makes}
        direct = {topic: entry for topic, entry in inputs.items() if not entry.makes}
        domain = stack.enter_context(reserved_domain_id())
        stack.enter_context(local_discovery())
        arguments = _arguments(bag, system, direct, params_file)
        arguments += _losing_nothing(f'/{system}/estimate.publisher')
        arguments += ['-p', 'max_wait:=0.0', '-p', 'max_revisions:=1000000']
        for entry in fed.values():
            arguments += _losing_nothing(f'{entry.makes}.subscription')
        node = stack.enter_context(NodeProcess(system, domain_id=domain, arguments=arguments))
        link = stack.enter_context(Link(NAME, domain_id=domain))
        recorder = Recorder(link, f'/{system}')
        last = LockStep(link, f'/{system}', recorder=recorder, trouble=node.trouble)
        lockstep: LockStep | Chain = last
        before: NodeProcess | None = None
        if fed:
            name = FEEDERS[system]
            arguments = _arguments(bag, name, fed, params_file)
            for entry in fed.values():
                arguments += _losing_nothing(f'{entry.makes}.publisher')
            process = NodeProcess(
                name, domain_id=domain, arguments=arguments, module=f'sonar_imm.nodes.{name}'
            )
            before = stack.enter_context(process)
            first = FirstStep(link, f'/{name}', trouble=before.trouble)
            lockstep = Chain(first, last, {f'/{entry.name}' for entry in fed.values()})
        remap = {name: entry.full_name(system) for name, entry in inputs.items()}
        options = PlayOptions(topics=tuple(inputs), lockstep=f'/{system}', remap=remap)
        player = Player(bag, link, options, lockstep)
        player.run(progress, START_LIMIT)
        exit_code, log = node.stop(), node.log()
        if before is not None:
            exit_code, log = before.stop() or exit_code, log + before.log()
        played, made = player.result(), (recorder.estimates(), lockstep.counts)
        return LockstepResult(*made, played.delays, exit_code, log, played.problems)


class NodeProcess:
    """A node of this package as a process of its own; stopped at the end of ``with``."""

    def __init__(
        self, system: str, *, domain_id: int, arguments: Sequence[str] = (), module: str = ''
    ):
        """Start it. `arguments` follow ``--ros-args``; `module` is where its ``main`` is."""
        self.system = system
        root = str(Path(__file__).resolve().parents[2])
        environment = dict(
            os.environ,
            ROS_DOMAIN_ID=str(domain_id),
            PYTHONUNBUFFERED='1',
            RCUTILS_COLORIZED_OUTPUT='0',
            PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get('PYTHONPATH')])),
        )
        self._log = tempfile.NamedTemporaryFile(mode='ab', prefix=f'sonar_imm_{system}_')
        # A signal that unwinds this program must not come before it knows the process. The node
        # inherits the mask, and lifts it when it takes its signals.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        try:
            command = [sys.executable, '-m', module or SYSTEMS[system].node]
            command += ['--ros-args', '-r', f'__node:={system}', *arguments]
            self.process = subprocess.Popen(
                command, env=environment, stdout=self._log, stderr=subprocess.STDOUT
            )
        finally:
            try:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            except BaseException:  # what the signal raised
                if hasattr(self, 'process'):
                    self.stop()
                raise

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._log.close()

    def log(self) -> str:
        """Give what the node wrote so far."""
        return Path(self._log.name).read_text(encoding='utf-8', errors='replace')

    def trouble(self) -> str | None:
        """Say how the node ended; None while it runs."""
        code = self.process.poll()
        if code is None:
            return None
        tail = ' | '.join(self.log().splitlines()[-_LOG_TAIL:])
        return f"node '/{self.system}' ended with exit code {code}: {tail or 'no word'}"

    def stop(self) -> int:
        """Ask the node to stop, then insist; gives its exit code."""
        for request in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if self.process.poll() is None:
                self.process.send_signal(request)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.process.wait(_STOP_LIMIT)
        return self.process.returncode


@contextlib.contextmanager
def reserved_domain_id() -> Iterator[int]:
    """Reserve a ROS domain on this machine, so that checks neither meddle nor are meddled with.

    A listening port stands for the domain, as in the isolation of launch_testing. What ended
    processes left of the domain's shared memory is removed, for Fast DDS 2.14 may not get over it;
    a domain where a process of somebody else lives comes last. Raises `LinkError` when all are
    taken.
    """
    candidates = list(range(1, 101))
    random.SystemRandom().shuffle(candidates)
    for living in (False, True):
        for domain_id in candidates:
            with socket.socket() as claim:
                try:
                    claim.bind(('127.0.0.1', _RESERVED + domain_id))
                except OSError:
                    continue
                if _swept(domain_id) or living:
                    yield domain_id
                    return
    raise LinkError('no free ROS domain on this machine')


def _swept(domain_id: int) -> bool:
    """Remove the ports of shared memory that nobody has any more from a domain; whether none is
    left. Who has one holds a lock; the names are those of Fast DDS."""
    first = 7400 + 250 * domain_id
    living = False
    for port in _SHARED_MEMORY.glob('fastrtps_port*'):
        number = port.name.removeprefix('fastrtps_port')
        if not number.isdecimal() or not first <= int(number) < first + 250:
            continue
        beside = [port.with_name(f'{port.name}_{kind}') for kind in ('el', 'sl')]
        try:
            with contextlib.ExitStack() as held:
                for path in beside:
                    if path.exists():
                        lock(held.enter_context(path.open('ab')).fileno())
                for path in (*beside, port.with_name(f'sem.{port.name}_mutex'), port):
                    path.unlink(missing_ok=True)
        except OSError:
            living = True
    return not living


@contextlib.contextmanager
def local_discovery() -> Iterator[None]:
    """Let what is started meanwhile, nodes and links, find others on this machine only."""
    names = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOCALHOST_ONLY'
    before = {name: os.environ.pop(name) for name in names if name in os.environ}
    os.environ[names[0]] = 'LOCALHOST'
    try:
        yield
    finally:
        os.environ.pop(names[0], None)
        os.environ.update(before)


def _losing_nothing(endpoint: str) -> list[str]:
    """ROS arguments for an endpoint, e.g. ``detections.publisher``, that drops nothing."""
    name = f'qos_overrides./{endpoint.removeprefix("/")}'
    return ['-p', f'{name}.history:=keep_all', '-p', f'{name}.reliability:=reliable']


def _arguments(
    bag: BagReader, node: str, inputs: Mapping[str, InputTopic], params_file: Path | str | None
) -> list[str]:
    """Write the ROS arguments of a node that loses no input and expects the types of the bag."""
    expected: dict[str, str] = {}
    inputs_lossless: list[str] = []
    types = {topic.name: topic.type_name for topic in bag.topics}
    for topic, entry in inputs.items():
        inputs_lossless += _losing_nothing(f'{entry.full_name(node)}.subscription')
        if len(entry.readers) == 1:
            continue
        known = expected.setdefault(entry.name.split('/')[-1], types[topic])
        if known != types[topic]:
            raise LinkError(
                f"the input '{entry.name}' would come as {known} and as "
                f'{types[topic]}: a node can hear only one of them'
            )
    arguments = ['--params-file', str(params_file)] if params_file else []
    arguments += inputs_lossless
    if expected:
        chosen = ', '.join(f"'{name}={kind}'" for name, kind in expected.items())
        arguments += ['-p', f'input_types:=[{chosen}]']
    return arguments
