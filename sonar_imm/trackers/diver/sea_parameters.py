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

"""Parameters of what the sea does to measurements: wild arrivals, depth, instruments that are not
where they are said to be, fixes whose errors last."""

from __future__ import annotations

from attrs import frozen

from ...parameters import Config, parameter

SYSTEMATIC = ('mixed', 'consider', 'estimate')


@frozen(kw_only=True, slots=False)
class SeaParameters(Config):
    """What the diver tracker can be told of the sea and of the instruments in it."""

    outlier_probability: float = parameter(
        0.02,
        'probability that an arrival is wild, late by a reflection or of something else',
        low=1e-6,
        high=0.5,
        read_only=False,
    )

    # -- depth -----------------------------------------------------------------------------------
    dimensions: int = parameter(
        2, '2: the diver is at target_z; 3: depth is a state, from arrivals', low=2, high=3
    )
    depth_min: float = parameter(
        0.0, 'least depth of a diver, down (dimensions 3)', unit='m', low=-1e3, high=1.1e4
    )
    depth_max: float = parameter(
        20.0, 'greatest depth of a diver, down (dimensions 3)', unit='m', low=-1e3, high=1.1e4
    )
    vertical_speed_std: float = parameter(
        0.1,
        'standard deviation of the vertical speed (dimensions 3)',
        unit='m/s',
        low=1e-4,
        high=10.0,
    )
    vertical_speed_time: float = parameter(
        10.0,
        'time over which the vertical speed is correlated (dimensions 3)',
        unit='s',
        low=1e-2,
        high=1e5,
    )

    # -- systematic errors of instruments --------------------------------------------------------
    receiver_position_std: float = parameter(
        0.0,
        'standard deviation on each horizontal axis of where receivers are said to be; one at the '
        "transmitter's own place has no such error",
        unit='m',
        low=0.0,
        high=1e3,
    )
    receiver_clock_std: float = parameter(
        0.0, "standard deviation of the error of a receiver's clock", unit='s', low=0.0, high=1.0
    )
    sound_speed_std: float = parameter(
        0.0, 'standard deviation of sound_speed', unit='m/s', low=0.0, high=100.0
    )
    systematic_errors: str = parameter(
        'mixed',
        'what is done with the three above: consider (in the covariance, never estimated), '
        'estimate, or mixed (receiver positions considered, clocks and sound speed estimated)',
        choices=SYSTEMATIC,
    )

    # -- errors of fixes that last ---------------------------------------------------------------
    fix_bias_std: float = parameter(
        0.0,
        'standard deviation on each axis of an error of the fixes that lasts, on top of their '
        'covariance',
        unit='m',
        low=0.0,
        high=1e4,
    )
    fix_bias_time: float = parameter(
        60.0, 'time over which that error is correlated', unit='s', low=1e-2, high=1e6
    )

    def check(self) -> list[str]:
        problems = super().check()
        if self.depth_min > self.depth_max:
            problems.append(
                f'depth_min ({self.depth_min:g}) cannot exceed depth_max ({self.depth_max:g})'
            )
        return problems
