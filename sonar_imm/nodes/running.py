# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Running a node as a program: its command line, its executor, and a clean end.

rclpy asks everything it could wait for, one after the other in Python, before and after each
message. Half of what a node of this package has are events of quality of service, two or three for
each topic, and they would take a third of the time from a message to its estimate. They are rare
and nothing waits for them, so `MessagesFirst` looks at them a few times a second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from pathlib import Path
import sys
import time
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ..parameters import ConfigError, sections_of, small_text
from .stopping import START_PATIENCE, stopper

EVENT_PERIOD = 0.25
"""Least seconds between two looks at events; a node that hears nothing wakes for its diagnostics
and looks then."""
_HELP = """\
usage: {name} [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO] ...]

A ROS 2 node: everything it can be told is a ROS argument, e.g.
  {name} --ros-args -p frame_id:=map -r fix:=/usbl/fix
Its parameters: docs/parameters, or ros2 param list and ros2 param describe while it runs."""


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin a node until SIGINT, SIGTERM or SIGHUP. Gives the exit code: 0 done, 2 unusable
    parameters.

    The order of things matters: the textbook version fails on every tenth signal, because the
    context can vanish inside any call, the constructor included.
    """
    first = stopper.listen()
    node: Node | None = None
    try:
        _init(args)
        if text := help_text(args):
            print(text)
            return 0
        stopper.on_stop(rclpy.try_shutdown, START_PATIENCE)
        executor = MessagesFirst()
        node = make_node()
        executor.add_node(node)
        warn_of_foreign_files(node, args)
        stopper.on_stop(rclpy.try_shutdown)
        executor.spin()
    except ExternalShutdownException:
        pass
    except ConfigError as error:
        print(f'{Path(sys.argv[0]).stem}: {error}', file=sys.stderr)
        return 2
    except Exception:  # of many kinds, when the context vanished in the middle of a call
        if rclpy.ok():
            raise
    finally:
        with contextlib.suppress(*([Exception] if stopper.asked else [])):
            if node is not None:
                node.destroy_node()
        rclpy.try_shutdown()
        stopper.release() if first else stopper.ignore()
    return 0


def _init(args: list[str] | None) -> None:
    try:
        # Where signals cannot be taken here, they remain with whoever has them.
        mine = SignalHandlerOptions.NO if stopper.listening else None
        rclpy.init(args=args, signal_handler_options=mine)
    except RuntimeError as error:  # a parameter file or a ROS argument that rcl cannot parse
        raise ConfigError(start_trouble(error)) from None


def start_trouble(error: RuntimeError) -> str:
    """Why ROS does not start, in one sentence."""
    text = ' '.join(str(error).split())
    if 'initialize logging' in text:
        return (
            f'ROS cannot keep its log, as without a HOME that can be written to ({text}): set '
            'ROS_LOG_DIR to a folder that can be written to'
        )
    return text


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
        names = sections_of(small_text(Path(word)))
        full = node.get_fully_qualified_name()
        own = {full, f'/{node.get_name()}'}
        if names and not any('*' in name or _full(name) in own for name in names):
            node.get_logger().warning(
                f"{word} has no effect: it is for {', '.join(names)}, and this is '{full}'"
            )


def _full(name: str) -> str:
    return f'/{name.strip("/")}'


class MessagesFirst(SingleThreadedExecutor):
    """One thread, in which messages, timers and services do not wait for events."""

    def __init__(self, *, context: Context | None = None):
        super().__init__(context=context)
        self._events, self._next_look = False, 0.0

    def can_execute(self, entity: Any) -> bool:
        return isinstance(entity, EventHandler) == self._events and super().can_execute(entity)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        now = time.monotonic()
        if now >= self._next_look:
            self._next_look = now + EVENT_PERIOD
            self._look_at_events()
        super().spin_once(timeout_sec)

    def _look_at_events(self) -> None:
        self._events = True
        try:
            while True:
                handler, _, _ = self.wait_for_ready_callbacks(0.0)
                handler()
                if (error := handler.exception()) is not None:
                    raise error
        except (ShutdownException, TimeoutException):
            pass  # none is left, or `spin_once` will say so
        finally:
            self._events = False
