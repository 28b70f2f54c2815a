# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What ``ros2 run sonar_imm NAME_node`` starts: the ``main`` of ``sonar_imm/nodes/NAME.py``, in a
process that does algebra in one thread."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
import sys

from ..gone import GONE
from ..threads import one_blas_thread
from . import NO_ROS
from .stopping import stopper

OF_ROS, MESSAGES = ('rclpy', 'std_srvs'), ('_msgs', '_interfaces')
"""Modules of ROS 2 that nodes import, and how those with messages end."""


def main() -> int:
    """Start the node that this program is called after, e.g. ``diver_node``. Gives its exit code,
    2 where a module is not installed or the program was removed."""
    program = Path(sys.argv[0]).stem
    if gone := GONE.get(f'executable {program}'):
        print(f'{program} {gone}', file=sys.stderr)
        return 2
    stopper.listen()
    one_blas_thread()  # before the node's module imports numpy
    try:
        node = import_module(f'{__package__}.{program.removesuffix("_node")}')
    except ModuleNotFoundError as error:
        missing = (error.name or '').partition('.')[0]
        of_ros = missing in OF_ROS or missing.endswith(MESSAGES)
        advice = NO_ROS if of_ros else 'pip install sonar_imm brings it.'
        print(f'{program}: {error.name} is not here. {advice}', file=sys.stderr)
        return stopper.end(2)
    return stopper.end(int(node.main()))
