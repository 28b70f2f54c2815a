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

"""Several nodes in one process, on one thread: ``ros2 run sonar_imm composed_node``.

Each word is the full name of a node, whose last part says what it is::

    ros2 run sonar_imm composed_node /auv1/diver /auv2/diver --ros-args --params-file fleet.yaml

Parameters come from files with a section for each full name (``/auv1/diver:``), as for any process
with several nodes; ``/**/diver:`` is for all divers. What a node sends and hears is the same as in
a process of its own. numpy, numba and the compiled kernels are in memory once. While one node
computes, the others wait: see docs/ros.md for how long.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

from collections.abc import Iterator, Sequence
from importlib import import_module
import sys
from typing import Any

from rclpy.exceptions import InvalidNamespaceException
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from ..parameters import ConfigError, did_you_mean
from ..trackers import SYSTEMS
from .running import run_all

KINDS = (*SYSTEMS, 'fls_detector')
_HELP = f"""\
usage: composed_node /NAMESPACE/NAME ... [--ros-args [--params-file FILE] ...]

ROS 2 nodes in one process. NAME: {', '.join(KINDS)}. For example
  composed_node /auv1/diver /auv2/diver --ros-args --params-file fleet.yaml"""


def make(full_name: str, **options: Any) -> Node:
    """The node of that full name, e.g. ``/auv1/diver``; `options` go to its class. Raises
    `ConfigError` for a name that is none."""
    namespace, _, kind = full_name.rpartition('/')
    if kind not in KINDS:
        raise ConfigError(f"'{full_name}': there is no node '{kind}'{did_you_mean(kind, KINDS)}")
    name = ''.join(word.capitalize() for word in kind.split('_')) + 'Node'
    node_type = getattr(import_module(f'{__package__}.{kind}'), name)
    try:
        made: Node = node_type(namespace=namespace or '/', **options)
    except InvalidNamespaceException as error:
        raise ConfigError(f"'{full_name}': {str(error).splitlines()[0]}") from None
    except ConfigError as error:
        raise ConfigError(*(f'{full_name}: {problem}' for problem in error.problems)) from None
    return made


def _explain(args: Sequence[str] | None) -> str | None:
    """The help, where it is asked for or no node is named."""
    words = _names(args)
    return _HELP if not words or {'-h', '--help'} & set(words) else None


def _names(args: Sequence[str] | None) -> list[str]:
    words = remove_ros_args(list(sys.argv if args is None else args))[1:]
    return [name for word in words for name in word.split()]  # launch gives a list as one word


def main(args: list[str] | None = None) -> int:
    """Run the nodes until they are told to stop; gives the exit code."""

    def nodes() -> Iterator[Node]:
        names = _names(args)
        if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
            raise ConfigError(f'{", ".join(twice)}: two nodes of one name')
        yield from map(make, names)

    return run_all(nodes, args, _explain)


if __name__ == '__main__':
    sys.exit(stopper.end(main()))
