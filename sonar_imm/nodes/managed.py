# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The life cycle of a node, as ROS 2 knows it for managed nodes, and its kernels meanwhile.

    unconfigured -- configure --> inactive -- activate --> active

and back by deactivate and cleanup; shutdown ends in `finalized`. Services and ``transition_event``
are those of rclpy. Three things are done here, since rclpy (7.1 of Jazzy) does not do them:

- Configuring takes as long as kernels take to compile. The transition ends, and its request is
  answered, when they are there; until then the node answers everything else.
- A transition that the state does not have, or that is asked for during another one, is refused;
  in rclpy the exception ends the node (ros2/rclpy issue 1209).
- What goes wrong in a transition is logged, and the node is in the state of before; rclpy drops
  the exception.
"""

from __future__ import annotations

from collections.abc import Callable
import sys
import threading
import time
import traceback
from typing import Any

from lifecycle_msgs.msg import Transition
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.task import Future

from ..parameters import ConfigError

LOOK = 0.02
"""Seconds between two looks at whether the kernels are there."""
LOADING = 'loading kernels, no input is heard until then'
DONE, FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Warming(threading.Thread):
    """Compile or load kernels while the executor answers everything else.

    numba cannot be stopped: a thread whose node has ended runs on to its end.
    """

    def __init__(self, warm: Callable[[], str], log: Callable[[str], object]):
        """warm: see `trackers.System.warm`; log: takes one sentence at the start and the end."""
        super().__init__(name='kernels', daemon=True)
        self._warm, self._log = warm, log
        self._error: Exception | None = None
        self.start()

    def run(self) -> None:
        if 'numba' in sys.modules:
            self._log(f'{LOADING}; the first time on a machine they are compiled')
        try:
            if done := self._warm():
                self._log(done)
        except Exception as error:
            self._error = error

    def trouble(self) -> None:
        """Raise what went wrong."""
        if self._error:
            raise self._error


class ManagedNode(LifecycleNodeMixin, Node):
    """The transitions of a node. One that derives from it says in `configured`, `activated`,
    `deactivated` and `released` what they do. `raises`: a transition that fails raises, as it
    should while the node starts by itself.
    """

    raises = False

    def __init__(self, name: str, **options: Any):
        """`options` go to `rclpy.node.Node`. Raises `ConfigError` where the middleware cannot do
        what it was asked for, such as security."""
        try:
            Node.__init__(self, name, **options)
        except RuntimeError as error:
            context: Context | None = options.get('context')
            if not (context.ok() if context else rclpy.ok()):
                raise
            raise ConfigError(' '.join(str(error).split())) from None
        # A group of its own: a request that waits for kernels holds up nothing else.
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        answer: Any = self._on_change_state  # rclpy's types know no coroutines
        self._service_change_state.callback = answer
        self._transition: Future | None = None

    @property
    def state(self) -> str:
        """The name of the state, e.g. ``active``."""
        return str(self._state_machine.current_state[1])

    def change(self, transition: int | str) -> Future:
        """Begin a transition, by its number or name; gives whether it succeeded, later for
        `configure`."""
        under_way = Future(executor=self.executor)
        try:
            if self._transition:
                raise RuntimeError('another transition is under way')
            if isinstance(transition, str):
                transition = self._state_machine.get_transition_by_label(transition)
            before = LifecycleState(*reversed(self._state_machine.current_state))
            self._state_machine.trigger_transition_by_id(transition, True)
        except RuntimeError as error:
            if not self.context.ok():
                raise
            reason = str(error).splitlines()[0].partition(', at ')[0]
            self.get_logger().warning(f"no transition '{transition}' from {self.state}: {reason}")
            under_way.set_result(False)
            return under_way
        self._transition = under_way
        outcome = self._callbacks[self._state_machine.current_state[0]](before)
        if outcome is not None:
            self.conclude(outcome)
        return under_way

    def conclude(self, outcome: TransitionCallbackReturn) -> None:
        """End the transition that is under way."""
        under_way, self._transition = self._transition, None
        self._state_machine.trigger_transition_by_label(outcome.to_label(), True)
        if under_way:
            under_way.set_result(outcome == DONE)

    def attempt(self, step: Callable[[], None], undo: Callable[[], None]) -> Any:
        """Do `step`; where it fails, `undo` it and say why, or raise."""
        try:
            step()
        except Exception as error:
            if self.raises or not self.context.ok():
                raise
            undo()
            why = str(error) if isinstance(error, ConfigError) else traceback.format_exc()
            self.get_logger().error(f'the node stays as it was: {why}')
            return FAILED
        return DONE

    def configured(self) -> None:
        """Make what the node works with. Its kernels may follow: who overrides this calls
        `conclude` when they are there."""

    def look(self) -> None:
        """Whether the kernels are there; called again and again while they are compiled."""

    def activated(self) -> None:
        """Hear the inputs."""

    def deactivated(self) -> None:
        """Hear them no more."""

    def released(self) -> None:
        """Undo `configured`, wherever it got to."""

    def trigger_configure(self) -> TransitionCallbackReturn:
        """As that of rclpy: wait until it is done."""
        under_way = self.change(Transition.TRANSITION_CONFIGURE)
        while not under_way.done():
            self.look()
            time.sleep(LOOK)
        return DONE if under_way.result() else FAILED

    def on_configure(self, state: LifecycleState) -> Any:
        """None while kernels are compiled."""
        failed = self.attempt(self.configured, self.released) != DONE
        return FAILED if failed else None

    def on_activate(self, state: LifecycleState) -> Any:
        return self.attempt(self.activated, self.deactivated)

    def on_deactivate(self, state: LifecycleState) -> Any:
        return self.attempt(self.deactivated, lambda: None)

    def on_cleanup(self, state: LifecycleState) -> Any:
        return self.attempt(self.released, lambda: None)

    def on_shutdown(self, state: LifecycleState) -> Any:
        return self.attempt(self._end, lambda: None)

    def _end(self) -> None:
        self.deactivated()
        self.released()

    async def _on_change_state(self, request: Any, response: Any) -> Any:
        asked: Transition = request.transition
        response.success = await self.change(asked.label or asked.id)
        return response
