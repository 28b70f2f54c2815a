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

"""Words on the command line of a node that ROS does not take, or takes in silence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import sys

from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from ..parameters import ConfigError, sections_of

_HELP = """\
usage: {name} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO] ...]

A ROS 2 node: everything it can be told is a ROS argument, e.g.
  {name} --ros-args -p frame_id:=map -r fix:=/usbl/fix
Its parameters: docs/parameters, or ros2 param list and ros2 param describe while it runs."""


def help_text(args: Sequence[str] | None) -> str | None:
    """What to print instead of starting, None to start. Raises `ConfigError` for words that are no
    ROS arguments, which ROS would not look at."""
    words = remove_ros_args(list(sys.argv if args is None else args))[1:]
    if not words:
        return None
    if set(words) & {'-h', '--help'}:
        return _HELP.format(name=Path(sys.argv[0]).stem)
    ros = {'-p', '--param', '-r', '--remap', '--params-file', '--log-level', '--enclave', '-e'}
    if words[0] in ros or ':=' in words[0]:
        raise ConfigError(f"'{words[0]}' has to follow --ros-args")
    raise ConfigError(f"'{words[0]}' is no argument of this node; see --help")


def warn_of_foreign_files(node: Node, args: Sequence[str] | None) -> None:
    """Warn of each parameter file that is for other nodes only: ROS ignores it in silence."""
    words = list(sys.argv if args is None else args)
    for before, word in zip(words, words[1:]):
        if before != '--params-file':
            continue
        names = sections_of(Path(word).read_text(encoding='utf-8'))
        own = node.get_fully_qualified_name()
        if names and not any(
            '*' in name or _full(name) in (own, f'/{node.get_name()}') for name in names
        ):
            node.get_logger().warning(
                f"{word} has no effect: it is for {', '.join(names)}, and this is '{own}'"
            )


def _full(name: str) -> str:
    return f'/{name.strip("/")}'
