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

"""Parameters of a sonar at sea: how it is mounted on a ship that moves, how sound bends, and how
well all that is known."""

from __future__ import annotations

from functools import partial
import math
from typing import TypeVar

from attrs import evolve, frozen

from ...acoustics.rays import profile_problem
from ...acoustics.sounding import ErrorBudget
from ...parameters import parameter as fixed_parameter
from ..shared_parameters import MountingParameters

parameter = partial(fixed_parameter, read_only=False)

S = TypeVar('S', bound='SeaParameters')

NAVIGATION = ('auto', 'required', 'ignored')


@frozen(kw_only=True, slots=False)
class SeaParameters(MountingParameters):
    """What the bathymetry tracker has to know of the ship and of the water."""

    # -- the ship --------------------------------------------------------------------------------
    navigation: str = parameter(
        'auto',
        'use of nav: auto (from its first message on; a recording that has it: required), '
        'required (pings wait for it), ignored (a level sonar at rest)',
        choices=NAVIGATION,
    )
    sonar_lever: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        'from the navigation reference to the array, x forward, y port, z up (vehicle FLU)',
        unit='m',
        low=-100.0,
        high=100.0,
    )
    sonar_mount_rpy_deg: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        'roll, pitch, yaw of the array in the vehicle (FLU: pitch positive nose down), besides '
        'side and tilt_deg',
        unit='deg',
        low=-180.0,
        high=180.0,
    )
    max_gap: float = parameter(
        1.0,
        'longest time between two poses over which is interpolated; pings in a longer gap are '
        'skipped and counted',
        unit='s',
        low=0.01,
        high=60.0,
    )
    max_extrapolation: float = parameter(
        0.0,
        'a ping is processed when its last bin lies no further than this beyond the newest pose, '
        'else it waits',
        unit='s',
        low=0.0,
        high=10.0,
    )

    # -- the water -------------------------------------------------------------------------------
    sound_speed_profile: tuple[float, ...] = parameter(
        (),
        'depth in m and sound speed in m/s in turn, linear between and constant beyond; empty: '
        'sound goes straight; needs navigation',
        kind='float[]',
        low=-100.0,
        high=12000.0,
    )
    water_level: float = parameter(
        0.0,
        'z of the water line in the world: depth in the profile is water_level - z',
        unit='m',
        low=-12000.0,
        high=12000.0,
    )

    # -- how well it is known --------------------------------------------------------------------
    sonar_height_std: float = parameter(
        0.0,
        'standard deviation of sonar_height; then the filter starts at the first return; 0: '
        'sonar_height is right, see initial_std',
        unit='m',
        low=0.0,
        high=1000.0,
    )
    attitude_std_deg: float = parameter(
        0.05, 'standard deviation of roll and pitch in nav', unit='deg', low=0.0, high=45.0
    )
    heading_std_deg: float = parameter(
        0.1, 'standard deviation of the heading in nav', unit='deg', low=0.0, high=180.0
    )
    heave_std: float = parameter(
        0.05, 'standard deviation of z in nav', unit='m', low=0.0, high=100.0
    )
    position_std: float = parameter(
        0.1, 'standard deviation of x and of y in nav', unit='m', low=0.0, high=10_000.0
    )
    sound_speed_std: float = parameter(
        0.5, 'standard deviation of the sound speed', unit='m/s', low=0.0, high=100.0
    )

    def for_inputs(self: S, inputs: frozenset[str]) -> S:
        """A recording says whether there is navigation: its first pings wait for it, too."""
        if self.navigation != 'auto':
            return self
        return evolve(self, navigation='required' if 'nav' in inputs else 'ignored')

    def check(self) -> list[str]:
        problems = super().check()
        problems += [
            f'{name} needs three values, got {len(getattr(self, name))}'
            for name in ('sonar_lever', 'sonar_mount_rpy_deg')
            if len(getattr(self, name)) != 3
        ]
        if self.sound_speed_profile:
            if problem := profile_problem(self.sound_speed_profile):
                problems.append(f'sound_speed_profile {problem}')
            if self.navigation == 'ignored':
                problems.append(
                    'sound_speed_profile needs navigation: the depth of the sonar follows from it'
                )
        return problems

    def budget(self) -> ErrorBudget:
        """What soundings add to the variance of the filter."""
        return ErrorBudget(
            attitude=math.radians(self.attitude_std_deg),
            heading=math.radians(self.heading_std_deg),
            heave=self.heave_std,
            position=self.position_std,
            sound_speed=self.sound_speed_std,
        )
