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

"""An executor that looks at messages first.

rclpy asks everything it could wait for, one after the other in Python, before and after each
message. Half of what a node of this package has are events of quality of service, two or three for
each topic, and they would take a third of the time from a message to its estimate. They are rare
and nothing waits for them, so they are looked at a few times a second.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import ShutdownException, SingleThreadedExecutor, TimeoutException

EVENT_PERIOD = 0.25
"""Least seconds between two looks at events; a node that hears nothing wakes for its diagnostics
and looks then."""


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
