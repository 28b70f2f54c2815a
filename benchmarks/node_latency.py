# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How long live nodes take from message to estimate, beside a node that only answers.

    python -m benchmarks.node_latency --messages 600
    python -m benchmarks.node_latency --messages 600 --rates 0

The diver node hears scans of four divers in clutter (`simulate diver --scenario crossing --set
clutter=3`), the obstacle node detections of two obstacles with navigation and altitudes
(`simulate obstacle --scenario rolling --set ping_rate=10`), the bathymetry node the pings of the
paper, the fathometer node traces (`--scenario drift_traces`). Each of them goes to the node, and
to a plain rclpy node that answers with a PointCloud2 without fields, of as many bytes as the
estimate had: what is left is the cost of the middleware and of Python. Which of the two is asked
first changes every time. `--rates`: so many such pairs a second, or one after the other (0). Needs
ROS 2. The load is that of the machine in the last minute, jobs that run or wait; with more of them
than cores p99 is mostly waiting for a core.
"""

from __future__ import annotations

import array
from collections.abc import Sequence
from functools import partial
import math
import os
import signal
import subprocess
import sys
import time
from typing import Any, NamedTuple

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from benchmarks.study import Parts, study
from msg_adapters.inputs import inputs_of
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import lockstep_qos, output_qos
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id
from sonar_imm_tools.replay.link import Link, LinkError
from sonar_imm_tools.simulation.bathymetry import simulator as bathymetry
from sonar_imm_tools.simulation.diver import simulator as diver
from sonar_imm_tools.simulation.fathometer import simulator as fathometer
from sonar_imm_tools.simulation.obstacle import simulator as obstacle

LIMIT = 90.0
SETTLED = 20
"""Messages at the start that are not counted: connections and caches are cold."""


class Case(NamedTuple):
    """One node: its parameters, the input that is timed, and all messages with their input."""

    system: str
    options: dict[str, Any]
    timed: str
    messages: list[tuple[str, Any]]


def case_of(system: str, count: int) -> Case:
    """At least `count` messages of the timed input."""
    if system == 'diver':
        scene: Any = diver.scenario('crossing', {'duration': count - 1.0, 'clutter': 3.0})
        simulated, timed = diver.simulate(scene, 0), 'fixes'
    elif system == 'bathymetry':
        scene = bathymetry.scenario('paper', {'pings': count})
        simulated, timed = bathymetry.simulate(scene, 0), 'snapshot'
    elif system == 'fathometer':
        changes = {'records': count, 'appearing': (), 'fading': ()}
        scene = fathometer.scenario('drift_traces', changes)
        simulated, timed = fathometer.simulate(scene, 0), 'trace'
    else:
        # Pings until the range is down to `last_range`: slow enough for as many as are wanted.
        speed = 80.0 / (0.1 * count)
        changes = {'ping_rate': 10.0, 'obstacles': 2, 'speed': speed}
        scene = obstacle.scenario('rolling', changes)
        simulated, timed = obstacle.simulate(scene, 0), 'detections'
    # Of two arrays the first: the other is of the other side.
    entries = {entry.measurement: entry for entry in reversed(inputs_of(system))}
    messages = [
        (entry.name, entry.write(item.measurement, make))
        for item in simulated.measurements
        for entry in [entries[type(item.measurement)]]
    ]
    options = scene.instruments()
    if system == 'diver':
        options['model_set'] = 'heading_speed'
    return Case(system, options, timed, messages)


class Echo(Node):
    """Answers each PointCloud2 with one of as many bytes as its frame_id says."""

    def __init__(self) -> None:
        super().__init__('echo')
        self._answers = self.create_publisher(PointCloud2, '/echo/estimate', output_qos())
        self.create_subscription(PointCloud2, '/echo/input', self._answer, lockstep_qos())

    def _answer(self, message: PointCloud2) -> None:
        size = int(message.header.frame_id)
        self._answers.publish(PointCloud2(data=array.array('B', bytes(size)), row_step=size))


class Peer:
    """Sends to one node and takes its answers. topics: by input."""

    def __init__(self, link: Link, name: str, topics: dict[str, tuple[str, type]]):
        self.link, self.name = link, name
        self.answered = 0.0
        self.last = b''
        self.out = {
            key: link.node.create_publisher(kind, topic, lockstep_qos())
            for key, (topic, kind) in topics.items()
        }
        link.node.create_subscription(
            PointCloud2, f'/{name}/estimate', self._take, lockstep_qos(), raw=True
        )

    def _take(self, raw: bytes) -> None:
        self.answered, self.last = time.perf_counter(), raw

    def ready(self) -> bool:
        there = self.link.node.count_publishers(f'/{self.name}/estimate')
        return bool(there and all(out.get_subscription_count() for out in self.out.values()))

    def ask(self, key: str, message: Any) -> float:
        """Milliseconds from sending to the answer; NaN while the ends have not met."""
        self.answered, begin = 0.0, time.perf_counter()
        self.out[key].publish(message)
        if not self.link.wait_for(lambda: self.answered, LIMIT if self.last else 1.0):
            if not self.last:
                return math.nan
            raise LinkError(f'/{self.name} did not answer')
        return 1e3 * (self.answered - begin)


def latencies(case: Case, rate: float) -> np.ndarray:
    """(K, 2) milliseconds of the node and of the echo, `rate` pairs a second."""
    words = [
        word for name, value in case.options.items() for word in ('-p', _assigned(name, value))
    ]
    kinds = {key: type(message) for key, message in case.messages}
    with reserved_domain_id() as domain:
        environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
        os.environ.update(environment)
        echo = subprocess.Popen(
            [sys.executable, '-m', 'benchmarks.node_latency', '--echo'],
            env={**environment, 'ROS_DOMAIN_ID': str(domain)},
        )
        try:
            remaps = [w for key in kinds for w in ('-r', f'/{key}:=/{case.system}/{key}')]
            with (
                NodeProcess(case.system, domain_id=domain, arguments=[*remaps, *words]),
                Link('bench', domain_id=domain) as link,
            ):
                topics = {key: (f'/{case.system}/{key}', kind) for key, kind in kinds.items()}
                node = Peer(link, case.system, topics)
                other = Peer(link, 'echo', {case.timed: ('/echo/input', PointCloud2)})
                if not link.wait_for(lambda: node.ready() and other.ready(), LIMIT):
                    raise LinkError('the nodes did not appear')
                return _asked(case, node, other, rate)
        finally:
            echo.send_signal(signal.SIGINT)
            echo.wait(10.0)


def _asked(case: Case, node: Peer, other: Peer, rate: float) -> np.ndarray:
    spent: list[tuple[float, float]] = []
    size, due = 0, time.perf_counter()
    for key, message in case.messages:
        if key != case.timed:
            node.out[key].publish(message)
            continue
        due = max(due + 1.0 / rate, time.perf_counter()) if rate else 0.0
        node.link.wait_for(partial(_passed, due), LIMIT)
        frame_id = message.header.frame_id
        pair = [0.0, 0.0]
        for which in (0, 1) if len(spent) % 2 else (1, 0):
            message.header.frame_id = str(size) if which else frame_id
            pair[which] = (other if which else node).ask(key, message)
        size = len(deserialize_message(node.last, PointCloud2).data) if node.last else 0
        spent.append((pair[0], pair[1]))
    return np.array(spent[SETTLED:])


def _passed(due: float) -> bool:
    return time.perf_counter() >= due


def _assigned(name: str, value: Any) -> str:
    return f'{name}:={list(value) if isinstance(value, tuple) else value}'


def main(
    messages: int = 600,
    rates: Sequence[float] = (10.0, 50.0, 200.0),
    system: str | None = None,
    echo: bool = False,
) -> Parts:
    if echo:
        rclpy.init()
        try:
            rclpy.spin(Echo())
        except (KeyboardInterrupt, ExternalShutdownException):
            return
    for name in [system] if system else SYSTEMS:
        for rate in rates:
            spent = latencies(case_of(name, messages), rate)
            node, other = np.percentile(spent, (50, 99), axis=0).T
            row = {'messages': len(spent), 'load': os.getloadavg()[0]}
            for k, point in enumerate(('p50', 'p99')):
                row |= {f'{point} ms': node[k], f'{point} of a node that only answers': other[k]}
                row[f'{point} ratio'] = node[k] / other[k]
            yield {'from message to estimate': {f'{name}, {rate:g} Hz': row}}


if __name__ == '__main__':
    study(
        main,
        digits=2,
        rates={'help': 'messages a second; 0: no pause'},
        system={'choices': tuple(SYSTEMS), 'help': 'only that node'},
        echo={'help': 'be the node that only answers'},
    )
