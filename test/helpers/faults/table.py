# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The faults that every node is tried with, and what is promised of each.

A fault is a function of the messages before, during and after it: it gives what is sent instead,
in two lists, the disturbed part and the rest. `Rig` sends both in lock-step to a node that runs as
a process and compares what it publishes in the rest with an undisturbed run. To add a fault, write
that function and a line of the table.
"""

from collections.abc import Callable, Sequence
import functools

from attrs import frozen
import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy

from msg_adapters.table import decode_table, encode_table
from sonar_imm.nodes.messages import make

from .cases import CASES, Message, SECOND, Step
from .rig import Rig

Parts = tuple[list[Step], list[Step]]
Disturbance = Callable[[list[Message], list[Message], list[Message]], Parts]


def middle(change):
    """Make a disturbance of a function of the messages during it; what it was given else stays."""

    def disturbance(*arguments):
        def disturb(before, during, after):
            return [*before, *change(during, *arguments)], list(after)

        return disturb

    return functools.wraps(change)(disturbance)


# -- what is sent: messages lost, repeated, moved in time or spoilt -------------------------------


@middle
def each(during, change):
    """Every message on the primary input changed."""
    return [change(step) if step.primary else step for step in during]


@middle
def dropped(during, topic):
    """An input that is silent for a while."""
    return [step for step in during if step.topic != topic]


@middle
def twice(during):
    """Every message comes two times."""
    return [step for step in during for _ in range(2)]


@middle
def late(during, places=3):
    """Every fourth message on the primary input comes `places` of them later."""
    held, sent, count = [], [], 0
    for step in during:
        count += step.primary
        if step.primary and count % 4 == 0:
            held.append((count + places, step))
        else:
            sent.append(step)
        sent += [message for due, message in held if due <= count]
        held = [(due, message) for due, message in held if due > count]
    return sent + [message for _, message in held]


@middle
def shuffled(during, size=4):
    """Messages in any order inside of blocks with `size` of the primary input each."""
    rng = np.random.default_rng(5)
    blocks = [[]]
    for step in during:
        if sum(message.primary for message in blocks[-1]) == size:
            blocks.append([])
        blocks[-1].append(step)
    return [block[k] for block in blocks for k in rng.permutation(len(block))]


def clock_set(seconds):
    """The clock of the sensors is set anew after the first third."""

    def disturb(before, during, after):
        return list(before), [step.moved(seconds) for step in [*during, *after]]

    return disturb


def looped(before, during, after):
    """The recording is played again from its beginning."""
    whole = [*before, *during, *after]
    return list(whole), list(whole)


@middle
def second_publisher(during, seconds):
    """Every message comes again from a sender whose clock is late."""
    return [step for item in during for step in (item, item.moved(-seconds))]


def frame(name):
    """Another frame_id."""
    return lambda item: item.changed(lambda content: setattr(content.header, 'frame_id', name))


def columns(**factors):
    """Columns of a table in another unit."""

    def change(content):
        table = dict(decode_table(content))
        for name, factor in factors.items():
            table[name] = (table[name] * factor).astype(table[name].dtype)
        stamp = content.header.stamp
        stamp_ns = stamp.sec * SECOND + stamp.nanosec
        made = encode_table(table, stamp_ns=stamp_ns, frame_id=content.header.frame_id, make=make)
        content.fields, content.data = made.fields, made.data
        content.point_step, content.row_step = made.point_step, made.row_step

    return lambda item: item.changed(change)


# -- what is done to a node between its messages --------------------------------------------------


@middle
def burst(during):
    """All messages at once, as after a stall of the network."""
    return [lambda rig: rig.send_at_once(during)]


@middle
def sensor_restarted(during):
    """A driver ends, and another process of it begins after a while."""
    third = len(during) // 3
    return [*during[:third], Rig.new_publishers, *during[2 * third :]]


@middle
def node_reset(during):
    """The service ~/reset in the middle of the stream."""
    return [*during[:-1], Rig.reset, during[-1]]


@middle
def disabled(during):
    """Input is not used for a while: ~/enable with false, then with true."""
    return [lambda rig: rig.enable(False), *during, lambda rig: rig.enable(True)]


@middle
def parameter_storm(during):
    """Good, bad and mixed changes of parameters between all messages."""

    def storm(rig):
        assert rig.set_parameters(stale_after=11.0, max_wait=-1.0) == [True, False]
        for wrong in (float('nan'), 'soon', 1e30, True):
            assert rig.set_parameters(max_wait=wrong, stale_after=10.0) == [False, True]

    return [step for item in during for step in ([item, storm] if item.primary else [item])]


@middle
def unheard_publisher(during, qos):
    """One more publisher on the input, whose quality of service does not fit."""

    def publish(rig):
        peer = rig.peer(rig.case.primary, qos)
        try:
            for step in during:
                if step.primary:
                    peer.publish(step.moved(0.001).content)
            rig.warned_of('quality of service')
        finally:
            rig.link.node.destroy_publisher(peer)

    return [publish, *during]


def simulated_clock(seconds):
    """/clock follows the stamps, and jumps with them after the first third."""

    def split(message):
        return [lambda rig: rig.tell_clock(message.stamp_ns), message]

    def disturb(before, during, after):
        rest = [step.moved(seconds) for step in [*during, *after]]
        start, end = ([step for item in part for step in split(item)] for part in (before, rest))
        return start, [lambda rig: rig.wait_for_clock(rest[0].stamp_ns, back=seconds < 0.0), *end]

    return disturb


@middle
def long_enough(during):
    """Nothing but time, until the node says that it cannot save its state."""
    return [*during, lambda rig: rig.warned_of('the state cannot be saved')]


# -- the table ------------------------------------------------------------------------------------


HOUR = 3600.0


@frozen
class Fault:
    """One thing that goes wrong.

    disturb: the disturbance. counted: reasons of losses in /diagnostics, one of
    which must be there, patterns; empty: nothing may be lost. level: what the worst level of
    /diagnostics must at least be. says: what /diagnostics or the log must say, a pattern. settle:
    messages within which estimates must be as if nothing had been, None for those of a tracker
    that lost all it knew (`Case.settle`). systems: those it concerns. arguments: of the node.
    """

    name: str
    disturb: Disturbance
    counted: Sequence[str] = ()
    level: str = 'OK'
    says: str = ''
    settle: int | None = None
    systems: Sequence[str] = tuple(CASES)
    arguments: Sequence[str] = ()


ANY_ORDER = ('diver', 'obstacle', 'bathymetry')
ONCE = ('fathometer',)
IN_ORDER = ('diver', 'obstacle', 'fathometer')
SIMULATED = ('-p', 'use_sim_time:=true')
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def in_another_unit(name, systems, **factors):
    """Columns in a unit that no reader takes."""
    disturb, refused = each(columns(**factors)), ['refused: out_of_range']
    return Fault(name, disturb, refused, 'WARN', 'out_of_range', systems=systems)


FAULTS = (
    Fault('sensor restarted', sensor_restarted()),
    Fault('input disabled, then enabled', disabled(), ['ignored_while_disabled'], says='ignored'),
    Fault('~/reset', node_reset(), says='reset on request'),
    Fault('every message twice', twice(), ['duplicate', 'repeated'], settle=0, systems=IN_ORDER),
    Fault('every ping twice, no ping needs another', twice(), settle=0, systems=['bathymetry']),
    Fault('late messages, inside the window', late(), settle=0, systems=ANY_ORDER),
    Fault('late messages, no window', late(), ['too_late'], systems=ONCE),
    Fault('shuffled inside the window', shuffled(), settle=0, systems=ANY_ORDER),
    Fault('shuffled, no window', shuffled(), ['too_late'], systems=ONCE),
    Fault('a burst', burst(), settle=0),
    Fault('sensor clock two hours ahead', clock_set(2.0 * HOUR)),
    Fault('sensor clock two hours back', clock_set(-2.0 * HOUR)),
    Fault('/clock and stamps an hour back', simulated_clock(-HOUR), (), 'OK', '/clock is back',
          arguments=SIMULATED),
    Fault('/clock and stamps an hour ahead', simulated_clock(HOUR), arguments=SIMULATED),
    Fault('looped recording', looped),
    Fault('no navigation for a while', dropped('nav'), systems=['obstacle']),
    Fault('another frame for a while', each(frame('elsewhere')),
          ['refused: frame', 'other_frame'], 'WARN', 'frame'),
    *(
        Fault('a second publisher, its clock late', second_publisher(CASES[system].window + 3.0),
              ['too_late'], 'WARN', 'not used: too_late', 0, [system])
        for system in ('diver', 'obstacle')
    ),
    # Four messages, which are too few for a warning.
    Fault('a second publisher, its clock late', second_publisher(3.0), ['too_late'], settle=0,
          systems=['fathometer']),
    in_another_unit('bearings in degrees', ['obstacle'], bearing=57.29578),
    in_another_unit('ranges in millimetres', ['obstacle', 'bathymetry'], range=1000.0),
    in_another_unit('sound speed in feet per second', ['bathymetry'], sound_speed=3.28084),
    Fault('depths in feet', each(columns(depth=3.28084)), ['other_depths'], 'WARN',
          'not used: other_depths', systems=['fathometer']),
    in_another_unit('depths in millimetres', ['fathometer'], depth=1000.0),
    Fault('a publisher that cannot be heard (QoS)', unheard_publisher(BEST_EFFORT), (), 'WARN',
          'quality of service', 0),
    Fault('storm of parameters', parameter_storm(), says='parameters changed', settle=0),
    Fault('the state cannot be saved (read-only disk)', long_enough(), (), 'WARN',
          'the state cannot be saved', 0, arguments=('-p', 'state_file:=/sys/sonar_imm_state')),
)  # fmt: skip
