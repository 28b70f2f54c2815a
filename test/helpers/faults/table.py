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

"""The faults that every node is tried with, and what is promised of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from attrs import frozen
from rclpy.qos import QoSProfile, ReliabilityPolicy

from . import actions, streams
from .cases import Case, CASES
from .streams import Disturbance

HOUR = 3600.0


@frozen(kw_only=True)
class Fault:
    """One thing that goes wrong.

    disturb: makes the disturbance for a case. counted: reasons of losses in /diagnostics, one of
    which must be there, patterns; empty: nothing may be lost. level: what the worst level of
    /diagnostics must at least be. says: what /diagnostics or the log must say, a pattern. settle:
    messages within which estimates must be as if nothing had been, None for those of a tracker
    that lost all it knew (`Case.settle`). systems: those it concerns. arguments: of the node.
    """

    name: str
    disturb: Callable[[Case], Disturbance]
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

FAULTS = (
    Fault(name='sensor restarted', disturb=lambda case: actions.sensor_restarted()),
    Fault(
        name='input disabled, then enabled',
        disturb=lambda case: actions.disabled(),
        counted=['ignored_while_disabled'],
        says='input is ignored',
    ),
    Fault(name='~/reset', disturb=lambda case: actions.node_reset(), says='reset on request'),
    Fault(
        name='every message twice',
        disturb=lambda case: streams.twice(),
        counted=['duplicate', 'repeated'],
        settle=0,
        systems=IN_ORDER,
    ),
    Fault(
        name='every ping twice, no ping needs another',
        disturb=lambda case: streams.twice(),
        settle=0,
        systems=['bathymetry'],
    ),
    Fault(
        name='late messages, inside the window',
        disturb=lambda case: streams.late(),
        settle=0,
        systems=ANY_ORDER,
    ),
    Fault(
        name='late messages, no window',
        disturb=lambda case: streams.late(),
        counted=['too_late'],
        systems=ONCE,
    ),
    Fault(
        name='shuffled inside the window',
        disturb=lambda case: streams.shuffled(),
        settle=0,
        systems=ANY_ORDER,
    ),
    Fault(
        name='shuffled, no window',
        disturb=lambda case: streams.shuffled(),
        counted=['too_late'],
        systems=ONCE,
    ),
    Fault(name='a burst', disturb=lambda case: actions.burst(), settle=0),
    Fault(
        name='sensor clock two hours ahead',
        disturb=lambda case: streams.clock_set(2.0 * HOUR),
    ),
    Fault(
        name='sensor clock two hours back',
        disturb=lambda case: streams.clock_set(-2.0 * HOUR),
    ),
    Fault(
        name='/clock and stamps an hour back',
        disturb=lambda case: actions.simulated_clock(-HOUR),
        says='/clock is back',
        arguments=SIMULATED,
    ),
    Fault(
        name='/clock and stamps an hour ahead',
        disturb=lambda case: actions.simulated_clock(HOUR),
        arguments=SIMULATED,
    ),
    Fault(name='looped recording', disturb=lambda case: streams.looped),
    Fault(
        name='no navigation for a while',
        disturb=lambda case: streams.dropped('nav'),
        systems=['obstacle'],
    ),
    Fault(
        name='another frame for a while',
        disturb=lambda case: streams.each(streams.frame('elsewhere')),
        counted=['refused: frame', 'other_frame'],
        level='WARN',
        says='frame',
    ),
    Fault(
        name='a second publisher, its clock late',
        disturb=lambda case: streams.second_publisher(case.window + 3.0),
        counted=['too_late'],
        level='WARN',
        says='not used: too_late',
        settle=0,
        systems=IN_ORDER,
    ),
    Fault(
        name='bearings in degrees',
        disturb=lambda case: streams.each(streams.columns(bearing=57.29578)),
        counted=['refused: out_of_range'],
        level='WARN',
        says='out_of_range',
        systems=['obstacle'],
    ),
    Fault(
        name='ranges in millimetres',
        disturb=lambda case: streams.each(streams.columns(range=1000.0)),
        counted=['refused: out_of_range'],
        level='WARN',
        says='out_of_range',
        systems=['obstacle', 'bathymetry'],
    ),
    Fault(
        name='sound speed in feet per second',
        disturb=lambda case: streams.each(streams.columns(sound_speed=3.28084)),
        counted=['refused: out_of_range'],
        level='WARN',
        says='out_of_range',
        systems=['bathymetry'],
    ),
    Fault(
        name='depths in feet',
        disturb=lambda case: streams.each(streams.columns(depth=3.28084)),
        counted=['other_depths'],
        level='WARN',
        says='not used: other_depths',
        systems=['fathometer'],
    ),
    Fault(
        name='depths in millimetres',
        disturb=lambda case: streams.each(streams.columns(depth=1000.0)),
        counted=['refused: out_of_range'],
        level='WARN',
        says='out_of_range',
        systems=['fathometer'],
    ),
    Fault(
        name='a publisher that cannot be heard (QoS)',
        disturb=lambda case: actions.unheard_publisher(
            QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        ),
        level='WARN',
        says='quality of service',
        settle=0,
    ),
    Fault(
        name='storm of parameters',
        disturb=lambda case: actions.parameter_storm(),
        says='parameters changed',
        settle=0,
    ),
    Fault(
        name='the state cannot be saved (read-only disk)',
        disturb=lambda case: actions.long_enough(),
        level='WARN',
        says='the state cannot be saved',
        settle=0,
        arguments=('-p', 'state_file:=/sys/sonar_imm_state', '-p', 'state_interval:=0.2'),
    ),
)
