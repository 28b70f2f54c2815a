# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The nodes: `BaseNode` is the same for all, `TrackerNode` is the node around a tracker.

A message becomes a measurement (`msg_adapters`), passes the `intake`, the tracker makes estimates
of it, estimates become messages. The only clock the tracker knows is ``header.stamp``; a /clock
that jumps back (a looped bag, a restarted simulation) resets it. One thread: a queue, not threads,
takes up bursts.

Every message is answered: after its estimates, however many, comes one row on ``~/processed``
(latched) with the number of messages taken, refused and of estimates published since the start.
This is what lock-step replay waits for, since a message that is refused, gated or late may rightly
have no estimate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
import functools
import math
import sys
import time
import traceback
from typing import Any

from attrs import evolve
from lifecycle_msgs.msg import Transition
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from std_srvs.srv import SetBool, Trigger

from msg_adapters.displays import displays_of
from msg_adapters.estimates import write_estimate
from msg_adapters.inputs import DOUBTS, inputs_of, InputTopic, needed

from ..estimates import Estimate
from ..measurements import Rejection
from ..node_config import chosen_types, node_config_type
from ..parameters import Config
from ..trackers import SYSTEMS
from .diagnostics import Announcer, Meter, Reporter, Stamp, UNUSED_REASONS
from .managed import DONE, FAILED, LOADING, LOOK, ManagedNode, Warming
from .messages import is_installed, make, message_class
from .outputs import DisplayPublisher, ProcessedPublisher, TablePublisher
from .parameters import NodeParameters
from .qos import Endpoints, explained_overrides, input_qos, latched_qos, output_qos, transforms_qos
from .saved_state import SavedState
from .stopping import stopper

TABLE = 'sensor_msgs/msg/PointCloud2'
DIAGNOSTICS_PERIOD = 1.0
"""Seconds between messages on /diagnostics."""
NO_WORK: dict[str, Any] = {'enabled': True, 'counts': {}, 'health': {}}
"""What a node reports before it is configured."""
_UNKNOWN = {'received_timestamp': 0}
"""The info of a message that did not come from the middleware."""


class BaseNode(ManagedNode):
    """Hears the inputs of `inputs_of`, answers each message, and reports on /diagnostics.

    A node that derives from it says in `take` what it does with a message. Its constructor calls
    `begin` at the end, `prepare` offers its outputs. Kernels are then compiled or loaded in a
    thread, while the node answers services and reports. The inputs are heard after that, so that
    the first message meets a warm node.
    """

    _warming: Warming | None = None  # also where a constructor that failed is taken back

    def __init__(self, name: str, config_types: tuple[type[Config], type[Config]], **options: Any):
        """Declare the parameters: those of what works on the messages, and those of the node.

        `options` go to `rclpy.node.Node`. Raises `ConfigError` for parameters that cannot be used.
        """
        super().__init__(name, **options)
        self._settings = NodeParameters(self, config_types)
        self._config_type, self._node_config_type = config_types
        self._node_config: Any = self._settings[self._node_config_type]
        self._types = chosen_types(name, self._settings.values()['input_types'])
        self._name = name
        self._full_name = self.get_fully_qualified_name().lstrip('/')
        self._inputs: dict[str, tuple[InputTopic, str, Callable[[Any], Any]]] = {}
        self._topic_names: dict[str, str] = {}
        self._published = self._received_ns = 0
        self._errors: Counter[str] = Counter()
        self._meter = Meter()
        self._endpoints = Endpoints(self)
        self._hears = self._warned = False
        self._made: set[Any] = set()

    def begin(self) -> None:
        """Report from now on. With `autostart` configure, and hear the inputs as soon as the
        kernels are there; whatever goes wrong until then is raised."""
        with explained_overrides(self):
            self._announcer = Announcer(self._endpoints, self._full_name)
        self._reporter = Reporter(self._full_name, {}, self._meter)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DIAGNOSTICS_PERIOD, self._report, clock=self._steady)
        self._settings.on_change(self._reconfigure)
        if self._node_config.autostart:
            self.raises = True
            self.change(Transition.TRANSITION_CONFIGURE)

    def configured(self) -> None:
        """Offer what every node does; the transition ends when the kernels are there."""
        before = self._entities()
        try:
            self._offer()
        finally:
            self._made = self._entities() - before
        self._warming = Warming(self.warm, self.get_logger().info)
        self._until_warm = self.create_timer(LOOK, self.look, clock=self._steady)

    def look(self) -> None:
        """End configuring once the kernels are there."""
        if self._warming is None or self._warming.is_alive() or self.state != 'configuring':
            return
        self.destroy_timer(self._until_warm)
        if self.attempt(self._warming.trouble, self.released) != DONE:
            self.conclude(FAILED)
            return
        self.conclude(DONE)
        if self.raises:
            self.change(Transition.TRANSITION_ACTIVATE)

    def activated(self) -> None:
        """Hear the inputs."""
        with explained_overrides(self):
            for name in self._inputs:
                self._listen(name)
        self.raises, self._hears = False, True
        if not self._warned:  # those of the inputs' endpoints are known now
            self._settings.warn_of_unknown()
            self._warned = True
        self._acknowledge(None)
        self.get_logger().info(f'ready, hears {", ".join(self._topic_names.values())}')

    def deactivated(self) -> None:
        """Hear nothing."""
        if self._hears:
            self.get_logger().info('inactive, hears nothing')
        self._hears = False
        self._endpoints.unsubscribe()

    def released(self) -> None:
        """Take back what was made since `configured` began."""
        if self._warming is not None:
            self.destroy_timer(self._until_warm)
            self._warming = None
            self.release()
        self._inputs, self._topic_names = {}, {}
        self._reporter = Reporter(self._full_name, {}, self._meter)
        for entity in self._made:
            getattr(self, f'destroy_{type(entity).__name__.lower()}')(entity)
        self._made = set()

    @property
    def refused(self) -> Mapping[str, int]:
        """Messages refused so far, by reason."""
        return self._meter.refused

    def receive(self, name: str, message: Any, info: Mapping[str, Any] = _UNKNOWN) -> None:
        """Take one message of the input `name` all the way; whatever it holds, the node goes on.

        info: as rclpy gives it beside a message.
        """
        start = time.monotonic()
        topic, _, reader = self._inputs[name]
        stamp = message.header.stamp if hasattr(message, 'header') else None
        self._meter.arrived(name, start)
        unused = self.unused()
        self._received_ns = info['received_timestamp']
        waited = self._waited()
        if self._waited_too_long(name, waited):
            self._acknowledge(stamp)
            return
        try:
            self.take(topic, reader, message)
        except Rejection as rejection:
            self._refuse(name, rejection)
            unused = -1
        except Exception:
            if not self.context.ok():
                raise  # the middleware went away under our feet: `run` knows
            self._recover(name)
        if stamp is not None:
            # From its reception on: the wait in a full queue would blur whose stamps are whose.
            arrival = start - (0.0 if math.isnan(waited) else waited)
            age = arrival - (stamp.sec + 1e-9 * stamp.nanosec)
            used = unused == self.unused()
            self._meter.stamped(name, Stamp(age, message.header.frame_id, used))
        self._acknowledge(stamp)
        self._meter.spent(time.monotonic() - start)

    # -- what a node says of itself ------------------------------------------------------------

    def destroy_node(self) -> None:
        """End; a kernel that is being compiled is finished, but not when a signal asked."""
        if self._warming is not None:
            if not stopper.asked:
                self._warming.join()
            self.release()
        super().destroy_node()

    def prepare(self) -> None:
        """Make what works on the messages, and offer its outputs."""

    def release(self) -> None:
        """Let go of what `prepare` made, but for what it offered."""

    def take(self, topic: InputTopic, reader: Callable[[Any], Any], message: Any) -> None:
        """Do with a message what the node is there for. Raises `Rejection`."""
        raise NotImplementedError

    def unused(self) -> int:
        """How many messages were of no use so far."""
        return 0

    def start_afresh(self) -> None:
        """Forget what came so far, after an internal error."""
        raise NotImplementedError

    def reconfigure(self) -> None:
        """Take over parameters that were changed while running."""

    def work_report(self) -> dict[str, Any]:
        """`enabled`, `counts`, `health` and `warnings` for `Reporter.report`."""
        raise NotImplementedError

    def warm(self) -> str:
        """Compile or load kernels; returns how many, in a sentence, '' for none."""
        return ''

    def answer(self) -> dict[str, int]:
        """The row on ``~/processed``."""
        return {
            'messages': self._meter.received.total(),
            'refused': self._meter.refused.total(),
            'estimates': self._published,
        }

    def message_words(self, name: str) -> str:
        """What a message of the input `name` is called in a sentence."""
        return f"a message on '{name}'"

    def error_words(self) -> str:
        """What follows of an internal error, for a sentence about it."""
        return ''

    # -- the same for all ----------------------------------------------------------------------

    def _offer(self) -> None:
        """The outputs, and the inputs that will be heard."""
        settings, topics = self._settings.values(), inputs_of(self._name)
        with explained_overrides(self):
            self.prepare()
            self._processed = ProcessedPublisher(
                self._endpoints.advertise(message_class(TABLE), '~/processed', latched_qos())
            )
            for topic in topics:
                for name in topic.instances(settings) if self._wanted(topic, settings) else ():
                    self._inputs[name] = self._input(topic, name, settings)
        required, one_of = needed(topics, settings)
        self._topic_names = {
            name: self.resolve_topic_name(topic.prefix + name)
            for name, (topic, _, _) in self._inputs.items()
        }
        self._reporter = Reporter(
            self._full_name, self._topic_names, self._meter, required=required, one_of=one_of
        )

    def _wanted(self, topic: InputTopic, settings: Mapping[str, Any]) -> bool:
        """Whether to hear an input. What is latched is heard where its type is installed: PyPI has
        no marine_interfaces. With `sonar_frame` frames have to be."""
        if not topic.wanted(settings):
            return False
        if not topic.latched or settings.get('sonar_frame'):
            return True
        return is_installed(self._type_name(topic))

    def _input(
        self, topic: InputTopic, name: str, settings: Mapping[str, Any]
    ) -> tuple[InputTopic, str, Callable[[Any], Any]]:
        """One input on the topic `name`: that, its message type and what reads its messages."""
        type_name = self._type_name(topic)
        convention = settings.get('world_frame_convention', 'enu')
        reader = topic.reader(type_name, convention, settings, name)
        message_class(type_name)  # ConfigError now where it is not installed
        return evolve(topic, name=name), type_name, reader

    def _type_name(self, topic: InputTopic) -> str:
        """The message type of an input; PyPI has no tf2_msgs, so that the first type of what is
        latched need not be installed."""
        chosen = self._types.get(topic.name, next(iter(topic.readers)))
        if not topic.latched or is_installed(chosen):
            return chosen
        return next(filter(is_installed, topic.readers), chosen)

    def _entities(self) -> set[Any]:
        """All that this node has on the graph now, and its timers."""
        return {*self.publishers, *self.subscriptions, *self.services, *self.timers}

    def _listen(self, name: str) -> None:
        """Subscribe to one input."""
        topic, type_name, _ = self._inputs[name]
        self._endpoints.subscribe(
            message_class(type_name),
            topic.prefix + name,
            functools.partial(self.receive, name),
            transforms_qos() if topic.latched else input_qos(self._node_config.queue_depth),
        )

    def _reconfigure(self) -> None:
        self._node_config = self._settings[self._node_config_type]
        if self._warming is not None:
            self.reconfigure()

    def _waited(self) -> float:
        """Seconds of the system's clock since the message in hand was received; NaN where the
        middleware does not know."""
        return (time.time_ns() - self._received_ns) * 1e-9 if self._received_ns else math.nan

    def _waited_too_long(self, name: str, waited: float) -> bool:
        """Whether a message lay in the queue for more than `max_wait`; counts it."""
        limit = getattr(self._node_config, 'max_wait', 0.0)
        if not limit or not waited > limit:
            return False
        if not self._meter.dropped:
            self.get_logger().warning(
                f"messages on '{name}' come faster than they can be processed: those that "
                f'waited more than {limit:g} s are dropped (said once, counted in /diagnostics)'
            )
        self._meter.dropped[name] += 1
        return True

    def _refuse(self, name: str, rejection: Rejection) -> None:
        if rejection.reason not in self._meter.refused:
            self.get_logger().warning(
                f'{self.message_words(name)} is refused: {rejection.sentence} '
                f"(said once; '{rejection.reason}' is counted in /diagnostics)"
            )
        self._meter.refuse(name, rejection.reason)

    def _recover(self, name: str) -> None:
        """Outlive a bug: a node at sea must not end because of one message."""
        self._errors['internal_error'] += 1
        self.get_logger().error(
            f'internal error on {self.message_words(name)}{self.error_words()}; '
            f'please report this:\n{traceback.format_exc()}'
        )
        self.start_afresh()

    def _acknowledge(self, stamp: Any) -> None:
        """Say on ~/processed that everything so far is answered; `stamp` is the message's. Who
        waits for an answer takes the first one for the node being ready."""
        if self._hears:
            self._processed.publish(self.answer(), stamp)

    def _report(self) -> None:
        self._announcer.publish(
            self._reporter.report(
                self.get_clock().now().to_msg(),
                time.monotonic(),
                stale_after=self._node_config.stale_after,
                max_age=getattr(self._node_config, 'max_age', 0.0),
                starting='' if self._hears else self._why_silent(),
                lost=self._endpoints.lost,
                incompatible=self._endpoints.incompatible,
                publishers=self._publishers_of,
                **(NO_WORK if self._warming is None else self.work_report()),
            )
        )

    def _publishers_of(self, topic: str) -> list[str]:
        """The nodes that publish a topic, once for each publisher."""
        return [
            f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            for info in self.get_publishers_info_by_topic(topic)
        ]

    def _why_silent(self) -> str:
        """Why no input is heard."""
        if self._warming and self.state == 'configuring':
            return LOADING
        return f'no input is heard: the node is {self.state}'


class TrackerNode(BaseNode):
    """One tracker as a ROS 2 node. A system's own node may publish more by `show`."""

    def __init__(self, system: str, **options: Any):
        """Get the tracker ready and begin. As `BaseNode`."""
        config_types = SYSTEMS[system].config_type(), node_config_type(SYSTEMS[system])
        super().__init__(system, config_types, **options)
        self._enabled = True
        self._ignored = self._withheld = 0
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False
            ),
            post_callback=self._on_clock_back,
        )
        self.begin()

    def prepare(self) -> None:
        """Go on from the state file, or begin anew."""
        self._saved_state = SavedState(self, self._name, self._node_config)
        self._intake = self._saved_state.load(self._config)
        self.tracker = self._intake.tracker
        self._estimates = TablePublisher(self.advertise(TABLE, '~/estimate'))
        self._displays = DisplayPublisher(displays_of(self._name), self.advertise)
        self.advertise_more()
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(SetBool, '~/enable', self._on_enable)
        self._saved_state.save_periodically(lambda: self._config)

    def release(self) -> None:
        """Save the state."""
        self._saved_state.save(self._config, wait=True)
        self._saved_state.close()

    def advertise(self, type_name: str, topic: str) -> Any:
        """Offer an output; to be used by `advertise_more`."""
        return self._endpoints.advertise(message_class(type_name), topic, output_qos())

    def advertise_more(self) -> None:
        """Offer what a system's own node publishes besides the displays."""

    def show(self, estimates: list[Estimate]) -> None:
        """Publish for displays what the estimates of one message are to be shown as."""
        self._displays.publish(estimates[-1])

    def take(self, topic: InputTopic, reader: Callable[[Any], Any], message: Any) -> None:
        """Read, admit, process, publish."""
        if not self._enabled:
            self._ignored += 1
            return
        measurement = reader(message)
        doubt = topic.doubt(message, measurement)
        repeated_rows = self._intake.repeats.rows
        measurement = self._intake.admit(measurement)
        if measurement is None:
            return
        if self._intake.repeats.rows > repeated_rows:
            self._doubt(topic.name, 'repeated_rows')
        if doubt is not None:
            self._doubt(topic.name, doubt)
        if not self._saved_state.still_fits(measurement.stamp_ns):
            self.start_afresh()
        estimates = self.tracker.process(measurement)
        if estimates:
            self._publish(estimates)

    def _recover(self, name: str) -> None:
        if not self._gave_up_state():
            super()._recover(name)

    def _gave_up_state(self) -> bool:
        """Whether a state that was loaded is to blame for the exception that is handled; the
        tracker is a new one then."""
        if not self._saved_state.gave_up(self._config, sys.exc_info()[1]):
            return False
        self._intake = self._saved_state.intake
        self.tracker = self._intake.tracker
        self._displays.clear()
        return True

    def unused(self) -> int:
        """How many messages the tracker could not use so far."""
        counts = self.tracker.counts
        return sum(counts[reason] for reason in counts.keys() & UNUSED_REASONS)

    def start_afresh(self) -> None:
        """Forget all measurements and take away what is drawn."""
        self._intake.reset()
        self._displays.clear()

    def reconfigure(self) -> None:
        """Hand the parameters on to the tracker."""
        self._intake.reconfigure(self._config)

    def work_report(self) -> dict[str, Any]:
        """What the tracker says of itself."""
        try:
            health = self.tracker.health()
            warnings = list(getattr(self.tracker, 'warnings', list)())
        except Exception:
            if not self._gave_up_state():
                raise
            health, warnings = self.tracker.health(), []
        counts = Counter(self.tracker.counts) + self._errors
        if self._withheld:
            counts['revisions_withheld'] = self._withheld
        if self._ignored:
            counts['ignored_while_disabled'] = self._ignored
        return {
            'enabled': self._enabled,
            'counts': counts,
            'health': health,
            'warnings': [
                *warnings,
                *filter(None, [self._saved_state.trouble]),
            ],
        }

    def warm(self) -> str:
        """Compile or load what the inputs need."""
        topics = [topic for topic, _, _ in self._inputs.values() if not topic.companion]
        inputs = {measurement for topic in topics for measurement in topic.measurements}
        return SYSTEMS[self._name].warm(self.tracker, inputs)

    def error_words(self) -> str:
        """What follows of an internal error."""
        return ', the tracker starts afresh'

    @property
    def _config(self) -> Any:
        """The parameters of the tracker without what /tf_static says."""
        return self._settings[self._config_type]

    def _publish(self, estimates: list[Estimate]) -> None:
        """Publish the newest estimate, and before it the newest revised ones, as many as are
        wanted."""
        wanted = 1 + self._node_config.max_revisions
        self._withheld += max(0, len(estimates) - wanted)
        for estimate in estimates[-wanted:]:
            self._estimates.publish(write_estimate(estimate, make))
            self._published += 1
        self._note_age(max(estimate.stamp_ns for estimate in estimates))
        self.show(estimates)

    def _note_age(self, stamp_ns: int) -> None:
        """Note how old the newest estimate is, and how long its message waited."""
        age = (self.get_clock().now().nanoseconds - stamp_ns) * 1e-9
        self._meter.estimates.published(time.monotonic(), age, self._waited())

    def _doubt(self, name: str, reason: str) -> None:
        if reason not in self._meter.doubted:
            self.get_logger().warning(
                f"messages on '{name}' {DOUBTS.get(reason, reason)} "
                f"(said once; '{reason}' is counted in /diagnostics)"
            )
        self._meter.doubted[reason] += 1

    def _on_reset(self, request: Any, response: Any) -> Any:
        self.start_afresh()
        self._reporter.unused.forget()
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
        if self._warming is None:
            return
        self.get_logger().warning(
            f'/clock is back by {-jump.delta.nanoseconds / 1e9:.3f} s: the tracker starts afresh'
        )
        self.start_afresh()
