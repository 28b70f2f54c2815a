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

"""Faults of what is done to a node between its messages."""

from __future__ import annotations

from typing import Any

from rclpy.qos import QoSProfile

from .cases import Action, Message, Step
from .streams import Disturbance, middle, Parts


@middle
def burst(during: list[Message]) -> list[Step]:
    """All messages at once, as after a stall of the network."""
    return [Action(lambda rig: rig.send_at_once(during))]


@middle
def sensor_restarted(during: list[Message]) -> list[Step]:
    """A driver ends, and another process of it begins after a while."""
    third = len(during) // 3
    return [*during[:third], Action(lambda rig: rig.new_publishers()), *during[2 * third :]]


@middle
def node_reset(during: list[Message]) -> list[Step]:
    """The service ~/reset in the middle of the stream."""
    return [*during[:-1], Action(lambda rig: rig.reset()), during[-1]]


@middle
def disabled(during: list[Message]) -> list[Step]:
    """Input is not used for a while: ~/enable with false, then with true."""
    return [
        Action(lambda rig: rig.enable(False)),
        *during,
        Action(lambda rig: rig.enable(True)),
    ]


@middle
def parameter_storm(during: list[Message]) -> list[Step]:
    """Good, bad and mixed changes of parameters between all messages."""

    def storm(rig: Any) -> None:
        before = rig.parameters('stale_after', 'max_wait')
        good, bad = rig.set_parameters(stale_after=before[0] + 1.0, max_wait=-1.0)
        assert good.successful and not bad.successful and 'max_wait' in bad.reason
        both = {'stale_after': before[0] + 2.0, 'max_wait': -1.0}
        (mixed,) = rig.set_parameters(atomically=True, **both)
        assert not mixed.successful
        assert rig.parameters('stale_after', 'max_wait') == [before[0] + 1.0, before[1]]
        for wrong in (float('nan'), 'soon', 10**30 * 1.0, True):
            assert not rig.set_parameters(max_wait=wrong)[0].successful
        (back,) = rig.set_parameters(atomically=True, stale_after=before[0], max_wait=before[1])
        assert back.successful

    return [step for one in during for step in ([one, Action(storm)] if one.primary else [one])]


@middle
def unheard_publisher(during: list[Message], qos: QoSProfile) -> list[Step]:
    """One more publisher on the input, whose quality of service does not fit."""

    def publish(rig: Any) -> None:
        peer = rig.peer(rig.case.primary, qos)
        try:
            for one in during:
                if one.primary:
                    peer.publish(one.moved(0.001).content)
            rig.heard_of('quality of service')
        finally:
            rig.link.node.destroy_publisher(peer)

    return [Action(publish), *during]


def simulated_clock(seconds: float) -> Disturbance:
    """/clock follows the stamps, and jumps with them after the first third."""

    def told(message: Message) -> list[Step]:
        return [Action(lambda rig: rig.tell_clock(message.stamp_ns)), message]

    def disturb(before: list[Message], during: list[Message], after: list[Message]) -> Parts:
        rest = [one.moved(seconds) for one in [*during, *after]]
        first = Action(lambda rig: rig.wait_for_clock(rest[0].stamp_ns, back=seconds < 0.0))
        return (
            [step for one in before for step in told(one)],
            [first, *(step for one in rest for step in told(one))],
        )

    return disturb


@middle
def long_enough(during: list[Message]) -> list[Step]:
    """Nothing but time, until the node says that it cannot save its state."""
    return [*during, Action(lambda rig: rig.heard_of('the state cannot be saved'))]
