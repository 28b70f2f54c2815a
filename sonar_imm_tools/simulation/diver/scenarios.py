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

"""Parameters of a diver scene, and the scenes that have a name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.parameters import parameter

from ..scenario import Scenario
from .afloat import GEODETIC, instruments_of_places, USBL
from .crossing import CROSSING, instruments_of_scans

MOTIONS = ('legs', 'straight', 'circle', 'zigzag', 'stop_and_go', 'still', 'crossing')
SENSORS = (
    'polar',
    'positions',
    'multistatic_fixes',
    'arrivals',
    'scans',
    'geodetic',
    'usbl',
)

TRANSMITTER = np.array([0.0, 0.0, 0.0])
RECEIVERS = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])
"""One transmitter that also listens, and three receivers, metres."""

FIRST_STAMP_NS = 1_700_000_000_000_000_000


@frozen(kw_only=True)
class DiverScenario(Scenario):
    """Parameters of a diver scene; the defaults are Table 1 of the paper."""

    # fmt: off
    motion: str = parameter('legs', '', 'how the divers move', choices=MOTIONS)
    speed: float = parameter(1.0, 'm/s', 'swimming speed of the divers', range=(0.0, 10.0))
    start: tuple[float, ...] = parameter((-40.0, 40.0), 'm', 'first position of the first diver')
    heading_deg: float = parameter(0.0, 'deg', 'general heading, counter-clockwise from +x')
    random_rotation: bool = parameter(False, '',
        'turn the scene, start and heading, about the sonar by an angle drawn at random')
    turn_deg: float = parameter(85.0, 'deg',
        'largest angle between a leg and the general heading', range=(0.0, 180.0))
    leg_min: float = parameter(7.0, 's', 'duration of the shortest leg', range=(0.1, None))
    leg_max: float = parameter(15.0, 's', 'duration of the longest leg', range=(0.1, None))
    duration: float = parameter(100.0, 's', 'length of the scene', range=(1.0, 1e6))
    step: float = parameter(1.0, 's', 'time between scans', range=(1e-3, 1e4))
    step_jitter: float = parameter(0.0, '',
        'share of a step by which scan times vary, uniformly', range=(0.0, 0.9))
    divers: int = parameter(1, '', 'number of divers', range=(1, 2000))
    spacing: float = parameter(15.0, 'm',
        'distance between the starts of several divers', range=(0.0, None))
    sensor: str = parameter('polar', '', 'what sees the divers', choices=SENSORS)
    range_std: float = parameter(0.1, 'm',
        'standard deviation of ranges of the sensors polar and usbl', range=(1e-6, None))
    bearing_std_deg: float = parameter(2.0, 'deg',
        'standard deviation of bearings of the sensors polar and usbl', range=(1e-6, None))
    toa_std: float = parameter(2e-4, 's',
        'standard deviation of arrival times of the multistatic sonar', range=(1e-9, None))
    sound_speed: float = parameter(1500.0, 'm/s',
        'speed of sound in the water', range=(1300.0, 1700.0))
    detection_probability: float = parameter(1.0, '',
        'probability that a sensor sees a diver in a scan', range=(0.0, 1.0))
    outlier_probability: float = parameter(0.0, '',
        'probability that a detection is an outlier', range=(0.0, 1.0))
    depth: tuple[float, ...] = parameter((0.0, 0.0), 'm',
        'least and greatest depth of divers, drawn between')
    swell_height: float = parameter(0.0, 'm',
        'amplitude with which a diver moves up and down in the swell', range=(0.0, 20.0))
    swell_period: float = parameter(60.0, 's', 'period of the swell', range=(0.1, None))
    receiver_depths: tuple[float, ...] = parameter((0.0, 0.0, 0.0, 0.0), 'm',
        'depths of the four receivers; the transmitter is at the first')
    depth_std: float = parameter(0.0, 'm',
        "standard deviation of the diver's own depth report, beside arrivals; 0: no report",
        range=(0.0, None))
    receiver_position_std: float = parameter(0.0, 'm',
        'standard deviation on each axis of the error of the stated positions of receivers, '
        'except the first', range=(0.0, None))
    receiver_clock_std: float = parameter(0.0, 's',
        'standard deviation of the errors of the clocks of the receivers', range=(0.0, None))
    sound_speed_std: float = parameter(0.0, 'm/s',
        'standard deviation of the error of the stated sound speed', range=(0.0, None))
    bearing_bias_std_deg: float = parameter(0.0, 'deg',
        'standard deviation of the error of all bearings of the sensors polar and usbl, drawn '
        'once', range=(0.0, 45.0))
    fix_std: float = parameter(1.0, 'm',
        'standard deviation on each axis of the white error of the sensors positions, scans and '
        'geodetic', range=(1e-6, None))
    fix_height_std: float = parameter(0.0, 'm',
        'standard deviation of the height of a fix of the sensor positions, stated then; 0: '
        'no height is', range=(0.0, None))
    fix_bias_std: float = parameter(0.0, 'm',
        'standard deviation on each axis of the lasting error of the sensor positions',
        range=(0.0, None))
    fix_bias_time: float = parameter(60.0, 's',
        'time over which the lasting error of the sensor positions (fix_bias_std) is correlated',
        range=(1e-3, None))
    clutter: float = parameter(0.0, '',
        'mean number of false detections in a scan', range=(0.0, 1e4))
    clutter_range: float = parameter(100.0, 'm',
        'half width of the square in which false detections fall', range=(1.0, None))
    late_fraction: float = parameter(0.0, '', 'share of scans received late', range=(0.0, 1.0))
    late_delay: float = parameter(3.0, 's',
        'largest delay of a scan that is received late', range=(0.0, None))
    # fmt: on

    def check(self) -> list[str]:
        problems = []
        if len(self.start) != 2:
            problems.append('start needs two values, x and y')
        if len(self.depth) != 2 or self.depth[0] > self.depth[1]:
            problems.append('depth needs two values, the least and the greatest')
        if len(self.receiver_depths) != len(RECEIVERS):
            problems.append(f'receiver_depths needs {len(RECEIVERS)} values')
        if self.leg_min > self.leg_max:
            problems.append('leg_min cannot exceed leg_max')
        return problems

    def instruments(self) -> dict[str, Any]:
        if self.sensor in ('geodetic', 'usbl'):
            return instruments_of_places(self)
        return instruments_of_scans(self) if self.sensor == 'scans' else super().instruments()


MULTISTATIC = {
    'sensor': 'arrivals',
    'speed': 0.75,
    'detection_probability': 0.7,
    'outlier_probability': 0.02,
    'random_rotation': True,
}

SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    'table1': ('zigzag legs at 1 m/s, polar sonar: Table 1 of the paper', {}),
    'random_heading': (
        'table1 turned about the sonar by a random angle: no heading is a model',
        {'random_rotation': True},
    ),
    'legs_slow': ('table1 at 0.5 m/s', {'speed': 0.5}),
    'straight': (
        'a straight cruise, turned at random',
        {'motion': 'straight', 'random_rotation': True},
    ),
    'circle': ('a circle once every 80 s at 0.75 m/s', {'motion': 'circle', 'speed': 0.75}),
    'zigzag': (
        '60 degrees to either side in turn, every 10 s',
        {
            'motion': 'zigzag',
            'turn_deg': 60.0,
            'leg_min': 10.0,
            'leg_max': 10.0,
            'speed': 0.75,
            'random_rotation': True,
        },
    ),
    'stop_and_go': (
        'legs with rests between',
        {'motion': 'stop_and_go', 'speed': 0.75, 'random_rotation': True},
    ),
    'still': ('a diver that does not move', {'motion': 'still'}),
    'irregular': (
        'table1, irregular scans, a quarter of them late',
        {'step_jitter': 0.4, 'late_fraction': 0.25, 'detection_probability': 0.9},
    ),
    'multistatic': (
        'raw arrival times at four receivers, some missing, some outliers',
        MULTISTATIC,
    ),
    'multistatic_fixes': (
        'fixes computed ping by ping from four receivers',
        {'sensor': 'multistatic_fixes', 'speed': 0.75, 'random_rotation': True},
    ),
    'at_depth': (
        'raw arrivals of a diver somewhere in 20 m of water, up and down with the swell',
        {
            **MULTISTATIC,
            'depth': (1.0, 19.0),
            'swell_height': 1.0,
            'receiver_depths': (2.0, 5.0, 8.0, 12.0),
        },
    ),
    'misplaced_receivers': (
        'raw arrivals at receivers a metre off, with clocks and sound speed wrong too',
        {
            **MULTISTATIC,
            'receiver_position_std': 1.0,
            'receiver_clock_std': 5e-4,
            'sound_speed_std': 5.0,
        },
    ),
    'lasting_errors': (
        'fixes whose errors last for a minute, as those of a filtered position source',
        {
            'sensor': 'positions',
            'speed': 0.75,
            'random_rotation': True,
            'duration': 299.0,
            'fix_std': 0.5,
            'fix_bias_std': 1.0,
        },
    ),
    'several': (
        'four divers, missed detections and clutter',
        {
            'divers': 4,
            'detection_probability': 0.9,
            'clutter': 2.0,
            'random_rotation': True,
            'speed': 0.75,
        },
    ),
    'crossing': CROSSING,
    'usbl': USBL,
    'geodetic': GEODETIC,
}
"""Name: (what it is, what differs from the defaults of `DiverScenario`)."""


def scenario(name: str, overrides: Mapping[str, Any] | None = None) -> DiverScenario:
    """The scenario `name` with some values replaced. Raises `ConfigError` naming mistakes."""
    return DiverScenario.named(name, SCENARIOS, overrides)
