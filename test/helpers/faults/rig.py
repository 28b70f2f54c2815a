# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A real node as a process, what is sent to it and what it says: where faults happen."""

from collections import Counter
import contextlib
import os
from pathlib import Path
import re
import time
from types import SimpleNamespace
from typing import Any
from unittest import mock

from attrs import define, field
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from scipy.stats import chi2
from std_srvs.srv import SetBool, Trigger

from sonar_imm.estimates import Estimate
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm_tools.replay import harness
from sonar_imm_tools.replay.harness import local_discovery, reserved_domain_id
from sonar_imm_tools.replay.link import Link
from sonar_imm_tools.replay.lockstep import LockStep, Recorder

from .cases import Message, SECOND

TESTS = str(Path(__file__).resolve().parents[2])
QUICK_NODE = 'helpers.faults.quick_node'
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
NO_LOSS = re.compile(r'count: (used|late|poses|restarts|bins.*)$|.* received$|doubtful: .*')
"""Counts of what was not lost."""
_PATIENCE = 300.0
"""Seconds of waiting for what comes soon where a machine is not loaded."""
_REPORTS = 12
"""Reports of /diagnostics in a disturbed part, a third or more of which is the fault."""


@define
class Diagnostics:
    """What /diagnostics said: `values` of the newest, and levels and words since `forget`."""

    values: dict[str, str] = field(factory=dict)
    newest_ns: int = 0
    levels: set[str] = field(factory=set)
    words: set[str] = field(factory=set)

    def __call__(self, message, info):
        self.newest_ns = info['source_timestamp']
        for status in message.status:
            self.values |= {pair.key: pair.value for pair in status.values}
            self.levels.add(LEVELS[ord(status.level)])
            self.words.add(f'{LEVELS[ord(status.level)]}: {status.message}')

    def forget(self):
        self.levels.clear()
        self.words.clear()

    def counts(self):
        """All values that count something."""
        counts = Counter()
        for key, value in self.values.items():
            if re.match(r'(count|refused|doubtful|lost|gap|dropped)\b|.*(received|dropped)', key):
                with contextlib.suppress(ValueError):
                    counts[key] = int(float(value))
        return counts


@contextlib.contextmanager
def without_shared_memory():
    """Let what is started meanwhile meet over UDP only: whoever shares memory with a node when it
    is killed may crash when it ends itself, in Fast DDS 2.14 one time in ninety on a busy
    machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')  # LOCALHOST shares it all the same
        yield


class Rig:
    """A node of one system in a ROS domain of its own, in lock-step; ended by ``with``."""

    def __init__(
        self, case, arguments=(), *, lossless=True, connected=True, discovery=local_discovery
    ):
        """Start it. lossless: whether inputs are reliable and of any length, as lock-step needs
        for many messages; else they are as the node has them. connected: whether it is waited
        for; else by `connect`. discovery: how link and node find each other,
        `without_shared_memory` where the node is killed."""
        self.case, self._lossless, self._discovery = case, lossless, discovery
        self._stack = contextlib.ExitStack()
        try:
            self._start([*arguments])
            if connected:
                self.connect()
        except BaseException:
            self._stack.close()
            raise

    def _start(self, arguments):
        case, enter = self.case, self._stack.enter_context
        if self._lossless:
            arguments += ['-p', 'max_wait:=0.0']
        topics = dict.fromkeys(message.topic for message in case.messages())
        ends = [f'{case.system}/estimate.publisher']
        ends += [f'{name}.subscription' for name in topics if self._lossless]
        for end in ends:
            for policy in ('history:=keep_all', 'reliability:=reliable'):
                arguments += ['-p', f'qos_overrides./{end}.{policy}']
        self.domain = enter(reserved_domain_id())
        with self._discovery():
            search = os.pathsep.join(filter(None, [TESTS, os.environ.get('PYTHONPATH')]))
            with mock.patch.dict(os.environ, PYTHONPATH=search):
                process = harness.NodeProcess(
                    case.system, domain_id=self.domain, arguments=arguments, module=QUICK_NODE
                )
            self.node = enter(process)
            self.link = enter(Link('rig', domain_id=self.domain))
        self.recorder = Recorder(self.link, f'/{case.system}')
        self.diagnostics = Diagnostics()
        self.link.node.create_subscription(
            DiagnosticArray, '/diagnostics', self.diagnostics, lockstep_qos()
        )
        self.clock = self.link.node.create_publisher(Clock, '/clock', 10)
        self._classes = {message.topic: type(message.content) for message in case.messages()}
        self.lockstep = LockStep(
            self.link, f'/{case.system}', recorder=self.recorder, trouble=self.node.trouble
        )
        self.publishers: dict[str, Any] = {}
        self._advertise()

    def connect(self):
        """Wait until the node hears."""
        self.lockstep.connect(self.publishers.values(), harness.START_LIMIT)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()

    def wait_for(self, predicate):
        """Serve the link until `predicate` holds; False when it never does."""
        return self.lockstep.wait_for(predicate, _PATIENCE)

    # -- what a fault may do ---------------------------------------------------------------------

    def send(self, message):
        """Send one message, and wait for its answer."""
        self.lockstep.step(self.publishers[message.topic], message.content)

    def send_at_once(self, messages):
        """Send messages without waiting, and then wait for all answers."""
        sent = time.monotonic()
        for message in messages:
            self.publishers[message.topic].publish(message.content)
        self.lockstep.follow(len(messages), 'all', sent)

    def new_publishers(self):
        """Other publishers instead of those so far, as of a driver that was started anew."""
        for publisher in self.publishers.values():
            self.link.node.destroy_publisher(publisher)
        self._advertise()

    def peer(self, topic, qos):
        """One more publisher on an input."""
        return self.link.node.create_publisher(self._classes[topic], f'/{topic}', qos)

    def reset(self):
        assert self.call(Trigger, 'reset').success

    def enable(self, on):
        assert self.call(SetBool, 'enable', data=on).success

    def tell_clock(self, stamp_ns):
        """Publish on /clock."""
        seconds, nanoseconds = divmod(stamp_ns, SECOND)
        self.clock.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))

    def wait_for_clock(self, stamp_ns, *, back):
        """Publish on /clock until the node lives at that time; back: until it said so."""
        logged = self.node.log().count('/clock is back') + back

        def there():
            self.tell_clock(stamp_ns)
            return self.node.log().count('/clock is back') >= logged

        assert self.wait_for(there)

    def set_parameters(self, **values):
        """Set parameters from outside: whether each was taken."""
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        results = self.call(SetParameters, 'set_parameters', parameters=given).results
        return [each.successful for each in results]

    def call(self, service, name, **request):
        """Call a service of the node."""
        client = self.link.node.create_client(service, f'/{self.case.system}/{name}')
        try:
            assert self.wait_for(client.service_is_ready)
            future = client.call_async(service.Request(**request))
            assert self.wait_for(future.done)
            return future.result()
        finally:
            self.link.node.destroy_client(client)

    def fresh_diagnostics(self):
        """Wait for a report of what is so now."""
        now_ns = time.time_ns()
        assert self.wait_for(lambda: self.diagnostics.newest_ns > now_ns)

    def warned_of(self, words):
        """Wait until /diagnostics says `words`."""
        assert self.wait_for(lambda: words in ' '.join(self.diagnostics.words))

    # -- a whole run -----------------------------------------------------------------------------

    def play(self, steps, reports=0):
        """Send messages and do actions; gives the estimates that were published meanwhile.
        reports: how many of /diagnostics are waited for on the way: a level rises when a finding
        is there in two periods, and lock-step may be done in less."""
        start = len(self.recorder)
        every = len(steps) // reports + 1 if reports else len(steps) + 1
        for number, step in enumerate(steps, start=1):
            if isinstance(step, Message):
                self.send(step)
            else:
                step(self)
            if number % every == 0:
                self.fresh_diagnostics()
        return self.recorder.estimates(start)

    def undisturbed(self):
        """What a fresh node makes of the recording: the first word for each stamp."""
        self.reset()
        return first_words(self.play(self.case.messages()))

    def suffer(self, disturb, expected):
        """Let a fault happen to the node, and see how long it is felt. expected: `undisturbed`.

        Gives recovered: messages on the primary input until all later estimates agree with the
        undisturbed run, None for never; estimates: in the rest, of how many; losses: counted in
        /diagnostics, by reason; levels, words: of /diagnostics meanwhile, and of the log;
        answered: whether the node goes on answering messages.
        """
        self.reset()
        self.enable(True)
        self.fresh_diagnostics()
        before = self.diagnostics.counts()
        messages = self.lockstep.counts.messages
        self.diagnostics.forget()
        disturbed, rest = disturb(*self.case.thirds())
        self.play(disturbed, reports=_REPORTS)
        self.fresh_diagnostics()
        found = first_words(self.play(rest))
        self.fresh_diagnostics()
        sent = [step for step in rest if isinstance(step, Message) and step.primary]
        origins = {step.stamp_ns: step.origin_ns for step in sent}
        held = [
            stamp in found and agrees(found[stamp], expected[origin])
            for stamp, origin in origins.items()
            if origin in expected
        ]
        answered = sum(stamp in found for stamp in origins)
        lost = self.diagnostics.counts()
        lost.subtract({key: n for key, n in before.items() if lost[key] >= n})
        return SimpleNamespace(
            recovered=_until_held(held),
            estimates=(answered, len(held)),
            losses={k: n for k, n in sorted(lost.items()) if n > 0 and not NO_LOSS.match(k)},
            levels={*self.diagnostics.levels},
            words='\n'.join([*sorted(self.diagnostics.words), self.node.log()]),
            answered=self.lockstep.counts.messages > messages,
        )

    def _advertise(self):
        self.publishers = {topic: self.peer(topic, lockstep_qos()) for topic in self._classes}
        if self.lockstep.counts.messages:
            made = self.publishers.values()
            assert self.wait_for(lambda: all(each.get_subscription_count() for each in made))


def first_words(estimates):
    """What was published first for each stamp: what somebody at sea acts upon."""
    found = {}
    for estimate in estimates:
        found.setdefault(estimate.stamp_ns, estimate)
    return found


def _until_held(held):
    """How many messages until all later ones are good; None when the last one is not."""
    if not held or not held[-1]:
        return None
    return len(held) - int(np.argmin([*held[::-1], False]))


# -- whether two estimates of one stamp agree as far as they say that they know -------------------


GATE, SHARE = 0.99, 0.9
"""A row agrees inside this probability; estimates agree where this share of rows does."""
WIDER = 2.0
"""A standard deviation this many times the expected one is not yet as good."""
SLOW = ('vertical_offset',)
"""States that take a whole approach to learn: as sure as before is not asked of them."""


def agrees(found, expected):
    """Whether nearly every row of each has its like in the other: inside of what both say of their
    errors, and what is found is as sure of itself as what was expected, or nearly so. Rows that
    nobody would use yet, as tentative tracks, do not count."""
    a, b = (_certain(item) for item in (found, expected))
    if not len(a.state) or not len(b.state):
        return len(a.state) == len(b.state)
    near = _near(a, b)
    return bool(near.any(axis=1).mean() >= SHARE and near.any(axis=0).mean() >= SHARE)


def _near(a, b):
    """(rows of a, rows of b): which rows agree."""
    apart = a.state[:, None] - b.state[None]
    covariance = a.covariance[:, None] + b.covariance[None]
    n = apart.shape[-1]
    weighed = np.linalg.solve(covariance + 1e-12 * np.eye(n), apart[..., None])[..., 0]
    inside = np.einsum('...i,...i->...', apart, weighed) <= chi2.ppf(GATE, n)
    spread_a, spread_b = (np.diagonal(item.covariance, axis1=1, axis2=2) for item in (a, b))
    quick = [k for k, name in enumerate(a.state_names) if name not in SLOW]
    sure = (spread_a[:, None] <= WIDER**2 * spread_b[None] + 1e-12)[..., quick].all(axis=2)
    near = inside & sure
    if 'range' in a.extras:  # a bin of a swath is itself, whichever other one is like it
        near &= a.extras['range'][:, None] == b.extras['range'][None]
    return near


def _certain(estimate):
    """The rows that somebody would use."""
    extras, keep = estimate.extras, np.ones(len(estimate), bool)
    for name, least in (('track_state', 0.0), ('existence', 0.5), ('valid', 0.0)):
        if name in extras:
            keep &= ~(extras[name] <= least)  # NaN where it is not estimated
    return Estimate(
        stamp_ns=estimate.stamp_ns, frame_id=estimate.frame_id, xyz=estimate.xyz[keep],
        state_names=estimate.state_names, state=estimate.state[keep],
        covariance=estimate.covariance[keep],
        extras={name: column[keep] for name, column in extras.items()},
    )  # fmt: skip


def wait_until_ready(nodes, limit=300.0):
    """Wait until each NodeProcess says that it hears its inputs; seconds."""
    end = time.monotonic() + limit
    while not all('ready, hears' in node.log() for node in nodes):
        assert all(node.process.poll() is None for node in nodes)
        assert time.monotonic() < end, [node.log() for node in nodes]
        time.sleep(0.02)


def own_words(log):
    """What a node wrote itself: Fast DDS also tells, in red, of shared memory that processes of
    other ROS domains on this machine reach for in the same moment, and goes on without it."""
    return '\n'.join(line for line in log.splitlines() if 'RTPS_TRANSPORT_SHM' not in line)
