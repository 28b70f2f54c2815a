# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A small ROS 2 peer for programs that are no node themselves: the player and the checks."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from sonar_imm.nodes.running import start_trouble

MATCH_LIMIT = 15.0
"""Seconds to wait for peers. Discovery is usually instant but now and then takes three seconds."""
_LOOK = 0.1


class LinkError(RuntimeError):
    """Replay that cannot go on; one sentence for the user."""


class Link:
    """A node in a context of its own, spun only while something waits; ended by ``with``.

    It installs no signal handlers: Ctrl-C stays a KeyboardInterrupt of the calling program.
    """

    def __init__(self, name: str, *, domain_id: int | None = None):
        """Open a node called `name`; `domain_id` None means the one of the environment. Raises
        `LinkError` where ROS does not start."""
        self.context = Context()
        try:
            rclpy.init(
                args=[name],
                context=self.context,
                domain_id=domain_id,
                signal_handler_options=SignalHandlerOptions.NO,
            )
        except RuntimeError as error:
            raise LinkError(start_trouble(error)) from None
        self.node = Node(name, context=self.context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: Any) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def spin(self, seconds: float) -> None:
        """Serve callbacks for at most `seconds`; returns after the first one."""
        self._executor.spin_once(timeout_sec=max(seconds, 0.0))

    def wait_for(
        self,
        predicate: Callable[[], Any],
        limit: float,
        trouble: Callable[[], str | None] = lambda: None,
    ) -> bool:
        """Spin until `predicate()` holds: True, or False after `limit` seconds.

        `trouble` is asked ten times a second; a sentence from it is raised as `LinkError`.
        """
        now = time.monotonic()
        end, next_look = now + limit, now + _LOOK
        while not predicate():
            now = time.monotonic()
            if now >= next_look:
                if sentence := trouble():
                    raise LinkError(sentence)
                next_look = now + _LOOK
            if now >= end:
                return False
            self.spin(min(end - now, 0.1))
        return True
