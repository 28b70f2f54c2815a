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

from collections.abc import Callable, Collection
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
from ..trackers import WarmStep

LOOK = 0.02
"""Seconds between two looks at whether the kernels are there."""
DONE, FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Warming:
    """Compiles or loads kernels in a thread of its own, step by step.

    What the connected publishers call for comes first; when nobody publishes yet, that is
    everything. The rest is compiled after `ready`, beside the first messages. A process of its own
    compiles, so that the node does not keep the memory which that takes; it ends with the last
    step. Where that cannot keep what it compiles, the thread compiles.
    """

    PATIENCE, PERIOD = 3.0, 10.0
    """Seconds after which it is said that this takes long, and between two such sentences."""
    DISCOVERY = 0.5
    """Seconds that publishers have to be found before anything is compiled."""

    def __init__(
        self,
        steps: Callable[[Collection[type] | None], list[WarmStep]],
        connected: Callable[[], Collection[type] | None],
        kernels_of: Callable[[Collection[str]], tuple[int, int]],
        elsewhere: Callable[[], list[WarmStep]] | None = None,
    ):
        """steps: what there is to do for measurements of these classes, None for all. connected:
        the classes that somebody publishes now, None for nobody. kernels_of: what steps need, see
        `trackers.System.kernels_of`. elsewhere: makes the same steps in a process that compiles,
        see `jit.Elsewhere`; None: the thread does."""
        from ..estimation import jit  # and numba, which the tracker has loaded by now

        self._steps, self._connected, self._kernels_of = steps, connected, kernels_of
        self._elsewhere = elsewhere
        self._process: jit.Elsewhere | None = None
        self._jit, self._progress = jit, jit.Progress()
        self._start = time.monotonic()
        self._logged = -self.PERIOD
        self._doing, self._ready = 'what is published', False
        self._stopped = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name='kernels', daemon=True)
        self._thread.start()

    def ready(self) -> bool:
        """Whether what the inputs need is there."""
        return self._ready

    def trouble(self) -> None:
        """Raise what went wrong."""
        if self._error:
            raise self._error

    def done(self) -> bool:
        """Whether everything is there."""
        return not self._thread.is_alive()

    def stop(self, *, wait: bool) -> None:
        """Begin no further step, and no further kernel in the other process."""
        self._stopped.set()
        if process := self._process:
            process.stop()
        if wait:
            self._thread.join()

    def sentence(self) -> str:
        """How far it is; empty when everything is there."""
        if self.done():
            return ''
        waiting = 'messages may wait for it' if self._ready else 'no input is heard until then'
        return f'{self._progress.sentence() or "loading kernels"} ({self._doing}); {waiting}'

    def due_sentence(self) -> str:
        """The same when it is time to say it (again), else empty."""
        now = time.monotonic()
        if now - self._start < self.PATIENCE or now - self._logged < self.PERIOD:
            return ''
        self._logged = now
        return self.sentence()

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:
            self._error = error
        finally:
            if self._process:
                self._process.close()
        self._ready = True

    def _work(self) -> None:
        if not self._jit.kernels:  # the node has just begun: give discovery a moment
            end = time.monotonic() + self.DISCOVERY
            while not self._connected() and time.monotonic() < end:
                self._stopped.wait(LOOK)
        left, done = dict(self._steps(None)), list[str]()
        while left and not self._stopped.is_set():
            called_for = dict(self._steps(self._connected()))
            wanted = [name for name in left if name in called_for]
            self._ready = self._ready or not wanted
            self._progress.needed = self._kernels_of([*done, *(wanted or left)])
            self._doing = (wanted or [*left])[0]
            self._do(self._doing, left.pop(self._doing))
            done.append(self._doing)

    def _do(self, name: str, step: Callable[[], object]) -> None:
        jit = self._jit
        if self._elsewhere is not None:
            if jit.kept(step):
                return
            with jit.Elsewhere.one_at_a_time:
                # Another node of this process may have had it compiled meanwhile.
                if jit.kept(step) or self._stopped.is_set():
                    return
                self._process = self._process or jit.Elsewhere.begin(self._elsewhere)
                if self._process and not self._stopped.is_set():
                    self._process.compile(name)
        if not self._stopped.is_set():
            step()


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
