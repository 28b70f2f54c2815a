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

"""The node around a tracker: everything that is the same for all systems.

A message becomes a measurement (`msg_adapters`), the tracker makes estimates of it, estimates
become messages. The only clock the tracker knows is ``header.stamp``; a /clock that jumps back (a
looped bag, a restarted simulation) resets it. One node, one process, one thread: a queue, not
threads, takes up bursts.

Every message is answered: after its estimates, however many, comes one row on ``~/processed``
(latched) with the number of messages taken, refused and of estimates published since the start.
This is what lock-step replay waits for, since a message that is refused, gated or late may rightly
have no estimate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
import contextlib
import functools
from pathlib import Path
import sys
import threading
import time
import traceback
from typing import Any

from attrs import evolve
import rclpy
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from msg_adapters.estimates import write_estimate
from msg_adapters.inputs import DOUBTS, inputs_of, InputTopic, needed

from ..estimates import Estimate
from ..measurements import Rejection
from ..node_config import node_config_type, NodeConfig, type_spec, type_specs
from ..parameters import ConfigError
from ..trackers import SYSTEMS
from .answers import Answers
from .arguments import help_text, warn_of_foreign_files
from .diagnostics import Announcer, Meter, Reporter
from .drawing import Drawing
from .executor import MessagesFirst
from .keeping import StateKeeper
from .messages import make, message_class
from .parameters import NodeParameters
from .qos import Endpoints, explained_overrides, input_qos, latched_qos, output_qos, transforms_qos
from .stopping import START_PATIENCE, stopper
from .tables import TablePublisher

TABLE = 'sensor_msgs/msg/PointCloud2'
_PATIENCE = 3.0


class TrackerNode(Node):
    """One tracker as a ROS 2 node. A system's own node may publish more by `show`."""

    def __init__(self, system: str, **options: Any):
        """Declare, compile, then subscribe: the first message meets a warm tracker.

        `options` go to `rclpy.node.Node`. Raises `ConfigError` for parameters that cannot be used.
        """
        super().__init__(system, **options)
        self._system, self._full_name = system, self.get_fully_qualified_name().lstrip('/')
        self._topics = inputs_of(system)
        config_type = self._config_type = SYSTEMS[system].config_type()
        self._node_config_type = node_config_type(SYSTEMS[system])
        self._settings = NodeParameters(
            self, (config_type, self._node_config_type), type_specs(system)
        )
        config = self._settings[config_type]
        self._guard = FrameGuard(self._node_config.frame_id)
        self._repeats = RepeatGuard(getattr(config, 'repeat_time', 0.0))
        tree = FrameTree()
        guards = (self._guard, self._repeats, tree)
        self._keeper = StateKeeper(self, system, self._node_config, guards)
        self.tracker = self._keeper.begin(config)
        self._door = FrameDoor(self.tracker, self._guard, tree)
        self._warm()

        self._enabled = True
        self._ignored = self._published = self._withheld = 0
        self._errors: Counter[str] = Counter()
        self._meter = Meter()
        self._endpoints = Endpoints(self)
        with explained_overrides(self):
            self._advertise()
            told = {**self.tracker.config.as_dict(), **self._node_config.as_dict()}
            hears = {
                name: self._listen(topic, name)
                for topic in self._topics
                for name in topic.instances(told)
                if topic.wanted(told)
            }
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(SetBool, '~/enable', self._on_enable)
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
            ),
            post_callback=self._on_clock_back,
        )
        required, one_of = needed(self._topics, told)
        self._reporter = Reporter(
            self._full_name, hears, self._meter, required=required, one_of=one_of
        )
        self.create_timer(
            self._node_config.diagnostics_period,
            self._report,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        self._keeper.save_every_now_and_then(lambda: (self.tracker, self._settings[config_type]))
        self._settings.on_change(lambda: self._door.reconfigure(self._settings[config_type]))
        self._settings.warn_of_unknown()
        self._acknowledge(None)
        self.get_logger().info(f'ready, hears {", ".join(hears.values())}')

    def destroy_node(self) -> None:
        """Save the state, then end."""
        self._keeper.save(self.tracker, self._settings[self._config_type], wait=True)
        super().destroy_node()

    def advertise(self, type_name: str, topic: str) -> Any:
        """Offer an output; to be used by `advertise_more`."""
        return self._endpoints.advertise(message_class(type_name), topic, output_qos())

    def advertise_more(self) -> None:
        """Offer what a system's own node publishes besides the displays."""

    def show(self, newest: Estimate) -> None:
        """Publish the newest state for displays."""
        self._drawing.show(newest)

    def show_all(self, estimates: list[Estimate]) -> None:
        """Publish what each of the estimates of one message is to be shown as."""
        self.show(estimates[-1])

    @property
    def _node_config(self) -> NodeConfig:
        return self._settings[self._node_config_type]

    def _warm(self) -> None:
        """Compile or load the kernels, with a word to the user when that takes long."""
        notice = threading.Timer(
            _PATIENCE,
            self.get_logger().info,
            [
                'compiling numerical kernels, which takes up to 20 s at the very first start; '
                'later starts load them from the cache'
            ],
        )
        notice.start()
        try:
            self.tracker.warm()
        finally:
            notice.cancel()

    def _advertise(self) -> None:
        self._estimates = TablePublisher(self.advertise(TABLE, '~/estimate'))
        self._answers = Answers(
            self._endpoints.advertise(message_class(TABLE), '~/processed', latched_qos())
        )
        self._announcer = Announcer(self._endpoints, self._full_name)
        self._drawing = Drawing(self._system, self.advertise)
        self.advertise_more()

    def _listen(self, topic: InputTopic, name: str) -> str:
        """Subscribe to one input on the topic `name`, and give the resolved name of that."""
        spec = type_spec(topic)
        type_name = self._settings.choice(spec.name) if spec else next(iter(topic.readers))
        reader = topic.reader(
            type_name,
            self._node_config.world_frame_convention,
            self.tracker.config.as_dict(),
            name,
        )
        subscription = self._endpoints.subscribe(
            message_class(type_name),
            topic.prefix + name,
            functools.partial(self._receive, evolve(topic, name=name), reader),
            transforms_qos() if topic.latched else input_qos(self._node_config.queue_depth),
        )
        return subscription.topic_name

    def _receive(
        self,
        topic: InputTopic,
        reader: Callable[[Any], Any],
        message: Any,
        info: Mapping[str, Any],
    ) -> None:
        """Take one message all the way; whatever it holds, the node goes on."""
        start = time.monotonic()
        stamp = message.header.stamp if hasattr(message, 'header') else None
        self._meter.arrived(topic.name, start)
        if self._waited_too_long(topic, info):
            self._acknowledge(stamp)
            return
        try:
            if self._enabled:
                self._process(topic, reader, message)
            else:
                self._ignored += 1
        except Rejection as rejection:
            self._refuse(topic, rejection)
        except Exception:
            if not self.context.ok():
                raise  # the middleware went away under our feet: `run` knows
            self._recover(topic)
        self._acknowledge(stamp)
        self._meter.spent(time.monotonic() - start)

    def _waited_too_long(self, topic: InputTopic, info: Mapping[str, Any]) -> bool:
        """Whether a message lay in the queue for more than `max_wait`; counts it."""
        limit, arrived_ns = self._node_config.max_wait, info['received_timestamp']
        # 0: a middleware that does not know. Both times are those of the system's clock.
        if not limit or not arrived_ns or time.time_ns() - arrived_ns <= limit * 1e9:
            return False
        if not self._meter.dropped:
            self.get_logger().warning(
                f"messages on '{topic.name}' come faster than they can be processed: those that "
                f'waited more than {limit:g} s are dropped (said once, counted in /diagnostics)'
            )
        self._meter.dropped[topic.name] += 1
        return True

    def _process(self, topic: InputTopic, reader: Callable[[Any], Any], message: Any) -> None:
        measurement = reader(message)
        doubt = topic.doubt(message, measurement)
        measurement = self._door.admit(measurement)
        if measurement is None:
            return
        rows = self._repeats.rows
        measurement = self._repeats.fresh(measurement)
        if self._repeats.rows > rows:
            self._doubt(topic, 'repeated_rows')
        if doubt is not None:
            self._doubt(topic, doubt)
        if not self._keeper.goes_on(measurement.stamp_ns):
            self._start_afresh()
        self._publish(self.tracker.process(measurement))

    def _publish(self, estimates: list[Estimate]) -> None:
        if not estimates:
            return
        for estimate in self._wanted(estimates):
            self._estimates.publish(write_estimate(estimate, make))
            self._published += 1
        self.show_all(estimates)

    def _wanted(self, estimates: list[Estimate]) -> list[Estimate]:
        """The newest estimate, and before it the newest revised ones, as many as are wanted."""
        if not self._node_config.publish_revisions:
            return estimates[-1:]
        limit = self._node_config.max_revisions or len(estimates)
        self._withheld += max(0, len(estimates) - 1 - limit)
        return estimates[-limit - 1 :]

    def _doubt(self, topic: InputTopic, reason: str) -> None:
        if reason not in self._meter.doubted:
            self.get_logger().warning(
                f"messages on '{topic.name}' {DOUBTS.get(reason, reason)} "
                f"(said once; '{reason}' is counted in /diagnostics)"
            )
        self._meter.doubted[reason] += 1

    def _refuse(self, topic: InputTopic, rejection: Rejection) -> None:
        if rejection.reason not in self._meter.refused:
            self.get_logger().warning(
                f"a message on '{topic.name}' is refused: {rejection.sentence} "
                f"(said once; '{rejection.reason}' is counted in /diagnostics)"
            )
        self._meter.refused[rejection.reason] += 1

    def _recover(self, topic: InputTopic) -> None:
        """Outlive a bug: a node at sea must not end because of one message."""
        self._errors['internal_error'] += 1
        self.get_logger().error(
            f"internal error on a message on '{topic.name}', the tracker "
            f'starts afresh; please report this:\n{traceback.format_exc()}'
        )
        self._start_afresh()

    def _acknowledge(self, stamp: Any) -> None:
        """Say on ~/processed that everything so far is answered; `stamp` is the message's."""
        row = {
            'messages': self._meter.received.total(),
            'refused': self._meter.refused.total(),
            'estimates': self._published,
        }
        self._answers.say(row, stamp)

    def _start_afresh(self) -> None:
        self.tracker.reset()
        self._guard.reset()
        self._repeats.reset()
        self._drawing.forget()

    def _on_reset(self, request: Any, response: Any) -> Any:
        self._start_afresh()
        self.get_logger().info('reset on request')
        response.success, response.message = True, 'all tracks are forgotten'
        return response

    def _on_enable(self, request: Any, response: Any) -> Any:
        self._enabled = bool(request.data)
        response.success = True
        response.message = 'tracking' if self._enabled else 'input is ignored'
        self.get_logger().info(f'{response.message} on request')
        return response

    def _on_clock_back(self, jump: Any) -> None:
        self.get_logger().warning(
            f'/clock is back by {-jump.delta.nanoseconds / 1e9:.3f} s: the tracker starts afresh'
        )
        self._start_afresh()

    def _report(self) -> None:
        counts = Counter(self.tracker.counts) + self._errors
        if self._withheld:
            counts['revisions_withheld'] = self._withheld
        if self._ignored:
            counts['ignored_while_disabled'] = self._ignored
        self._announcer.publish(
            self._reporter.report(
                self.get_clock().now().to_msg(),
                time.monotonic(),
                enabled=self._enabled,
                stale_after=self._node_config.stale_after,
                counts=counts,
                health=self.tracker.health(),
                warnings=[
                    *getattr(self.tracker, 'warnings', list)(),
                    *filter(None, [self._keeper.trouble]),
                ],
                lost=self._endpoints.lost,
                incompatible=self._endpoints.incompatible,
            )
        )


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin a node until SIGINT, SIGTERM or SIGHUP. Gives the exit code: 0 done, 2 unusable
    parameters.

    The order of things matters: the textbook version fails on every tenth signal, because the
    context can vanish inside any call, the constructor included.
    """
    first = stopper.listen()
    node = None
    try:
        _init(args)
        if text := help_text(args):
            print(text)
            return 0
        stopper.on_stop(rclpy.try_shutdown, START_PATIENCE)
        executor = MessagesFirst()
        node = make_node()
        warn_of_foreign_files(node, args)
        stopper.on_stop(rclpy.try_shutdown)
        rclpy.spin(node, executor)
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
        raise ConfigError(' '.join(str(error).split())) from None
