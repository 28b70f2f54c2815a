# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Write `config/sros2/<node>.xml`: what each node may do on the graph, and nothing else.

Run it with ``python docs/generate_policies.py``; needs ROS 2. Every node is started with its
defaults and asked what it publishes, hears and serves. A test compares the files with the nodes.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
from importlib import import_module
from pathlib import Path
import time
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

FOLDER = Path(__file__).resolve().parents[1] / 'config' / 'sros2'
NODES = {
    'bathymetry': 'BathymetryNode',
    'diver': 'DiverNode',
    'fathometer': 'FathometerNode',
    'fls_detector': 'FlsDetectorNode',
    'obstacle': 'ObstacleNode',
}
# So that the node starts where messages of others are not installed.
EXTRA = {'fls_detector': ['-p', "input_types:=['image=sensor_msgs/msg/Image']"]}
RULES = (
    ('topics', 'publish', 'topic'),
    ('topics', 'subscribe', 'topic'),
    ('services', 'reply', 'service'),
    ('services', 'request', 'service'),
)
HEAD = """\
<?xml version="1.0" encoding="UTF-8"?>
<!-- What {name}_node does on the graph with its defaults, and nothing else: see docs/ros.md.
     Inputs that are remapped, tags and further sensors have to be changed here, too.
     Written by docs/generate_policies.py. -->
<policy version="0.2.0">
  <enclaves>
    <enclave path="/sonar_imm/{name}">
      <profiles>
        <profile ns="/" node="{name}">
"""
TAIL = """\
        </profile>
      </profiles>
    </enclave>
  </enclaves>
</policy>
"""


@contextlib.contextmanager
def started(name: str) -> Iterator[Any]:
    """A node with its defaults, in a context of its own; with simulated time, which needs one more
    topic than the clock of the machine."""
    context = rclpy.Context()
    words = ['-p', 'use_sim_time:=true', *EXTRA.get(name, [])]
    rclpy.init(args=[name, '--ros-args', *words], context=context)
    node = getattr(import_module(f'sonar_imm.nodes.{name}'), NODES[name])(context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def used_by(node: Any) -> dict[tuple[str, str, str], list[str]]:
    """What the graph says of a node: names by rule, private ones with ``~``."""
    name, space = node.get_name(), node.get_namespace()
    asked = (
        node.get_publisher_names_and_types_by_node,
        node.get_subscriber_names_and_types_by_node,
        node.get_service_names_and_types_by_node,
        node.get_client_names_and_types_by_node,
    )
    return {
        rule: sorted(_written(found, name) for found, _ in ask(name, space))
        for rule, ask in zip(RULES, asked)
    }


def _written(found: str, node: str) -> str:
    return f'~{found[len(node) + 1 :]}' if found.startswith(f'/{node}/') else found


def policy(name: str, used: dict[tuple[str, str, str], list[str]]) -> str:
    """The text of a policy file."""
    lines = []
    for (kind, rule, item), names in used.items():
        if names:
            lines.append(f'<{kind} {rule}="ALLOW">')
            lines += [f'  <{item}>{name}</{item}>' for name in names]
            lines.append(f'</{kind}>')
    body = ''.join(f'          {line}\n' for line in lines)
    return HEAD.format(name=name) + body + TAIL


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name in NODES:
        with started(name) as node:
            executor = SingleThreadedExecutor(context=node.context)
            executor.add_node(node)
            while node.state != 'active':
                executor.spin_once()
            time.sleep(2.0)  # the graph hears of a node's own endpoints a little later
            text = policy(name, used_by(node))
        (FOLDER / f'{name}.xml').write_text(text, encoding='utf-8')
        print(f'config/sros2/{name}.xml')


if __name__ == '__main__':
    main()
