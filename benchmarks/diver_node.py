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

"""How long the live diver node takes, beside a node that only answers, message by message in turn.

    python -m benchmarks.diver_node --scans 600

Four divers in clutter (`simulate diver --scenario crossing --set clutter=3`), a scan a second.
Each scan goes to ``diver_node``, and then to a plain rclpy node that answers with a PointCloud2
without fields, of as many bytes as the estimate had: what is left is the cost of the middleware
and of Python. Needs ROS 2. The second table is where the node's own time goes, measured in this
process.
"""

from __future__ import annotations

import argparse
import array
import os
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from msg_adapters.estimates import write_estimate
from msg_adapters.scans import doubt_scan, read_scan, write_scan
from sonar_imm.nodes.harness import NodeProcess, reserved_domain_id
from sonar_imm.nodes.link import Link, LinkError
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import lockstep_qos, output_qos
from sonar_imm.simulation.diver.simulator import scenario, simulate
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

LIMIT = 30.0


class Echo(Node):
    """Answers each PointCloud2 with one of as many bytes as its frame_id says."""

    def __init__(self) -> None:
        super().__init__('echo')
        self._answers = self.create_publisher(PointCloud2, '/echo/estimate', output_qos())
        self.create_subscription(PointCloud2, '/echo/fixes', self._answer, lockstep_qos())

    def _answer(self, message: PointCloud2) -> None:
        size = int(message.header.frame_id)
        self._answers.publish(PointCloud2(data=array.array('B', bytes(size)), row_step=size))


class Peer:
    """Sends to one node and takes its answers."""

    def __init__(self, link: Link, name: str):
        self.link, self.name = link, name
        self.answers: list[bytes] = []
        self.out = link.node.create_publisher(PointCloud2, f'/{name}/fixes', lockstep_qos())
        link.node.create_subscription(
            PointCloud2, f'/{name}/estimate', self.answers.append, lockstep_qos(), raw=True
        )

    def ready(self) -> bool:
        there = self.link.node.count_publishers(f'/{self.name}/estimate')
        return bool(there and self.out.get_subscription_count())

    def ask(self, message: PointCloud2) -> float:
        """Milliseconds from sending to the answer."""
        heard, begin = len(self.answers), time.perf_counter()
        self.out.publish(message)
        if not self.link.wait_for(lambda: len(self.answers) > heard, LIMIT):
            raise LinkError(f'/{self.name} did not answer')
        return 1e3 * (time.perf_counter() - begin)


def latencies(messages: list[PointCloud2], options: dict[str, Any]) -> np.ndarray:
    """(K, 2) milliseconds of the diver node and of the echo."""
    words = [word for name, value in options.items() for word in ('-p', f'{name}:={value}')]
    with reserved_domain_id() as domain:
        environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
        os.environ.update(environment)
        echo = subprocess.Popen(
            [sys.executable, '-m', 'benchmarks.diver_node', '--echo'],
            env={**environment, 'ROS_DOMAIN_ID': str(domain)},
        )
        try:
            arguments = ['-r', '/fixes:=/diver/fixes', *words]
            with (
                NodeProcess('diver', domain_id=domain, arguments=arguments),
                Link('bench', domain_id=domain) as link,
            ):
                diver, other = Peer(link, 'diver'), Peer(link, 'echo')
                if not link.wait_for(lambda: diver.ready() and other.ready(), 90.0):
                    raise LinkError('the nodes did not appear')
                spent = []
                for message in messages:
                    one = diver.ask(message)
                    size = len(deserialize_message(diver.answers[-1], PointCloud2).data)
                    message.header.frame_id = str(size)
                    spent.append((one, other.ask(message)))
                    diver.answers.clear(), other.answers.clear()
                return np.array(spent)
        finally:
            echo.send_signal(signal.SIGINT)
            echo.wait(10.0)


def parts(messages: list[PointCloud2], config: DiverConfig) -> dict[str, float]:
    """Median milliseconds of each step of the node, without the middleware."""
    raw = [serialize_message(message) for message in messages]
    tracker = DiverTracker(config)
    tracker.warm()
    spent: dict[str, list[float]] = {}

    def timed(name: str, call: Any, *args: Any) -> Any:
        begin = time.perf_counter()
        result = call(*args)
        spent.setdefault(name, []).append(1e3 * (time.perf_counter() - begin))
        return result

    for one in raw:
        message = timed('deserialise', deserialize_message, one, PointCloud2)
        scan = timed('read', read_scan, message)
        timed('look for doubts', doubt_scan, message)
        estimate = timed('track', tracker.process, scan)[-1]
        answer = timed('write', write_estimate, estimate, make)
        timed('serialise', serialize_message, answer)
    return {name: float(np.median(values)) for name, values in spent.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--scans', type=int, default=600)
    parser.add_argument('--echo', action='store_true', help='be the node that only answers')
    told = parser.parse_args()
    if told.echo:
        rclpy.init()
        try:
            rclpy.spin(Echo())
        except (KeyboardInterrupt, ExternalShutdownException):
            return
    scene = scenario('crossing', {'duration': told.scans - 1.0, 'clutter': 3.0})
    scans = [one.measurement for one in simulate(scene, 0).measurements]
    messages = [write_scan(scan, make) for scan in scans]
    spent = latencies(messages, scene.told())
    p50, p99 = np.percentile(spent, (50, 99), axis=0)
    print('| ms from message to answer | p50 | p99 |\n|---|---|---|')
    for k, name in enumerate(('diver_node', 'a node that only answers')):
        print(f'| {name} | {p50[k]:.2f} | {p99[k]:.2f} |')
    print(f'| ratio | {p50[0] / p50[1]:.2f} | {p99[0] / p99[1]:.2f} |\n')
    print('| step of the node, in one process | median ms |\n|---|---|')
    for name, value in parts(
        [write_scan(scan, make) for scan in scans], DiverConfig(**scene.told())
    ).items():
        print(f'| {name} | {value:.2f} |')


if __name__ == '__main__':
    main()
