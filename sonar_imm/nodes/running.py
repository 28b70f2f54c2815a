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

"""Running a node as a program: its command line, its executor, and a clean end.

rclpy asks everything it could wait for, one after the other in Python, before and after each
message. Half of what a node of this package has are events of quality of service, two or three for
each topic, and they would take a third of the time from a message to its estimate. They are rare
and nothing waits for them, so `MessagesFirst` looks at them a few times a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import contextlib
from pathlib import Path
import sys
import time
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ..parameters import ConfigError, sections_of
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
    parameters."""
    return run_all(lambda: [make_node()], args)


def run_all(
    make_nodes: Callable[[], Iterable[Node]],
    args: list[str] | None = None,
    explain: Callable[[Sequence[str] | None], str | None] | None = None,
) -> int:
    """Spin several nodes in one executor, as `run` does one; `explain` is in place of `help_text`.

    The order of things matters: the textbook version fails on every tenth signal, because the
    context can vanish inside any call, the constructor included.
    """
    first = stopper.listen()
    nodes: list[Node] = []
    try:
        _init(args)
        if text := (explain or help_text)(args):
            print(text)
            return 0
        stopper.on_stop(rclpy.try_shutdown, START_PATIENCE)
        executor = MessagesFirst()
        for node in make_nodes():
            nodes.append(node)
            executor.add_node(node)
        warn_of_foreign_files(nodes, args)
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
            for node in nodes:
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
        raise ConfigError(' '.join(str(error).split())) from None


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


def warn_of_foreign_files(nodes: Sequence[Node], args: Sequence[str] | None) -> None:
    """Warn of each parameter file that is for other nodes only: ROS ignores it in silence."""
    words = list(sys.argv if args is None else args)
    for before, word in zip(words, words[1:]):
        if before != '--params-file':
            continue
        names = sections_of(Path(word).read_text(encoding='utf-8'))
        full = [node.get_fully_qualified_name() for node in nodes]
        own = {*full, *(f'/{node.get_name()}' for node in nodes)}
        if names and not any('*' in name or _full(name) in own for name in names):
            nodes[0].get_logger().warning(
                f'{word} has no effect: it is for {", ".join(names)}, and this is '
                f"'{', '.join(full)}'"
            )


def _full(name: str) -> str:
    return f'/{name.strip("/")}'


class MessagesFirst(SingleThreadedExecutor):
    """One thread, in which messages, timers and services do not wait for events.

    Messages are waited for, taken and handed on here, with what there is to wait for listed once;
    whatever else is ready, and callbacks that take time, are left to rclpy.
    """

    def __init__(self, *, context: Context | None = None):
        super().__init__(context=context)
        self._events, self._next_look = False, 0.0
        self._waits: _Waits | None = None
        self._stale = True
        # What is not public in rclpy may be another way in another version.
        self._by_itself = all(hasattr(self, f'_{n}') for n in ('tasks', 'cb_iter', 'sigint_gc'))

    def can_execute(self, entity: Any) -> bool:
        return isinstance(entity, EventHandler) == self._events and super().can_execute(entity)

    def wake(self) -> None:
        """As rclpy does when something was made or destroyed."""
        self._stale = True
        super().wake()

    def add_node(self, node: Node) -> bool:
        added = super().add_node(node)
        self._stale = True
        return added

    def remove_node(self, node: Node) -> None:
        super().remove_node(node)
        self._stale = True

    def spin_once(self, timeout_sec: float | None = None) -> None:
        now = time.monotonic()
        if now >= self._next_look:
            self._next_look = now + EVENT_PERIOD
            self._look_at_events()
        if not self._by_itself or self._is_shutdown:
            super().spin_once(timeout_sec)
        elif self._tasks or self._cb_iter is not None:
            self._leave_to_rclpy(timeout_sec if self._cb_iter is None else 0.0)
        else:
            if self._stale or self._waits is None:
                self._stale = False  # before it is looked, since others may add something
                self._waits = _Waits(self.get_nodes(), [self._guard, self._sigint_gc])
            if not self._waits.complete or self._waits.message(timeout_sec, self._context):
                self._leave_to_rclpy(0.0 if self._waits.complete else timeout_sec)

    def _leave_to_rclpy(self, timeout_sec: float | None) -> None:
        """Let rclpy do one thing, and go on with what it has begun until nothing is left."""
        super().spin_once(timeout_sec)
        if self._cb_iter is not None and self._cb_iter.gi_frame is None:
            self._cb_iter = None

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
            self._events, self._cb_iter = False, None


class _Waits:
    """What nodes wait for besides events. complete: whether that is all; a node with other
    waitables, as actions are, is left to rclpy."""

    def __init__(self, nodes: Iterable[Node], guards: Iterable[Any]):
        nodes = list(nodes)
        self._subscriptions = [each for node in nodes for each in node.subscriptions]
        self._guards = [*(each for node in nodes for each in node.guards), *guards]
        self._others = {
            'timer': [each.handle for node in nodes for each in node.timers],
            'client': [each.handle for node in nodes for each in node.clients],
            'service': [each.handle for node in nodes for each in node.services],
        }
        waitables = (each for node in nodes for each in node.waitables)
        self.complete = all(isinstance(each, EventHandler) for each in waitables)
        self._set: Any = None

    def message(self, timeout_sec: float | None, context: Context) -> bool:
        """Wait, and hand on a message of each topic; True when something else is ready."""
        handles = [each.handle for each in (*self._subscriptions, *self._guards)]
        with contextlib.ExitStack() as stack:
            try:
                for handle in (context.handle, *handles, *sum(self._others.values(), [])):
                    stack.enter_context(handle)
            except InvalidHandle:
                return True
            waiting = self._filled(context)
            waiting.wait(-1 if timeout_sec is None else int(timeout_sec * 1e9))
            ready = waiting.get_ready_entities('subscription')
            triggered = waiting.get_ready_entities('guard_condition')
            for guard in self._guards:
                if guard.handle.pointer in triggered:
                    guard._executor_triggered = True
            if triggered or any(waiting.get_ready_entities(kind) for kind in self._others):
                return True
            due = [each for each in self._subscriptions if each.handle.pointer in ready]
        for each in due:  # one of each, so that none has to wait for all of another
            try:
                with each.handle:
                    taken = each.handle.take_message(each.msg_type, each.raw)
            except InvalidHandle:
                continue  # what the one before did away with
            if taken is not None:
                plain = each._callback_type is each.CallbackType.MessageOnly
                each.callback(*(taken[:1] if plain else taken))
        return not due and not context.ok()

    def _filled(self, context: Context) -> Any:
        """The wait set, which a wait empties of what is not ready."""
        if self._set is None:
            counts = (len(self._others[kind]) for kind in ('timer', 'client', 'service'))
            sizes = (len(self._subscriptions), len(self._guards), *counts, 0)
            self._set = _rclpy.WaitSet(*sizes, context.handle)
        waiting = self._set
        waiting.clear_entities()
        for each in self._subscriptions:
            waiting.add_subscription(each.handle)
        for each in self._guards:
            waiting.add_guard_condition(each.handle)
        for kind, handles in self._others.items():
            add = getattr(waiting, f'add_{kind}')
            for handle in handles:
                add(handle)
        return waiting
