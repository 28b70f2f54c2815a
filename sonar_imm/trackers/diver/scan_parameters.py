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

"""Parameters of scans of fixes: how fixes and tracks are paired, and where fixes are from."""

from __future__ import annotations

import re
from typing import TypeVar

from attrs import evolve, frozen

from ...parameters import Config, parameter

ASSOCIATIONS = ('gnn', 'jipda')
NAMED_TRACKS = ('share', 'alone')


SENSOR_NUMBERS = ('fix_std', 'detection_probability', 'clutter_density')
"""Parameters that may differ from sensor to sensor."""

S = TypeVar('S', bound='ScanParameters')
_WORD = re.compile(r'[A-Za-z0-9_]+')


@frozen(kw_only=True, slots=False)
class ScanParameters(Config):
    """How the fixes of a scan and the tracks find each other."""

    association: str = parameter(
        'gnn',
        'gnn: the one most likely pairing, tracks confirmed by hits; jipda: all pairings weighed, '
        'tracks confirmed by their probability of existence, for divers that cross in clutter',
        choices=ASSOCIATIONS,
    )
    birth_density: float = parameter(
        1.2e-5,
        'jipda: new divers expected in a scan, for each square metre',
        unit='1/m^2',
        low=1e-12,
        high=1.0,
        read_only=False,
    )
    survival_time: float = parameter(
        500.0,
        'jipda: time for which a diver is expected to stay',
        unit='s',
        low=1.0,
        high=1e7,
        read_only=False,
    )

    # -- names -----------------------------------------------------------------------------------
    tags: tuple[str, ...] = parameter(
        (),
        'names of tags or divers: what comes on <name>/fix or <name>/relative, or in a frame of '
        'that name, is theirs and goes to their own track without association',
        kind='str[]',
    )
    named_tracks: str = parameter(
        'share',
        'what a track whose name is known does with fixes that have none: share (it takes its '
        'part, and a track beside it that is never seen together with it is the same diver) or '
        'alone (it takes only its own)',
        choices=NAMED_TRACKS,
    )
    repeat_time: float = parameter(
        5.0,
        'the same numbers again within this time of the first are a repeated poll, which is left '
        'out and counted; 0: use them',
        unit='s',
        low=0.0,
        high=3600.0,
    )

    # -- sensors ---------------------------------------------------------------------------------
    sensors: tuple[str, ...] = parameter(
        (),
        'names of sensors with numbers of their own: what comes on <name>/fix, <name>/fixes or '
        '<name>/relative, or in a frame of that name, is theirs',
        kind='str[]',
    )
    sensor_fix_std: tuple[float, ...] = parameter(
        (),
        'fix_std of each of them; empty: as fix_std',
        kind='float[]',
        unit='m',
        low=1e-4,
        high=1e5,
    )
    sensor_detection_probability: tuple[float, ...] = parameter(
        (),
        'detection_probability of each of them; empty: as detection_probability',
        kind='float[]',
        low=0.01,
        high=0.9999,
    )
    sensor_clutter_density: tuple[float, ...] = parameter(
        (),
        'clutter_density of each of them; empty: as clutter_density',
        kind='float[]',
        unit='1/m^2',
        low=1e-12,
        high=1e4,
    )

    def check(self) -> list[str]:
        problems = super().check()
        for name in SENSOR_NUMBERS:
            given = getattr(self, f'sensor_{name}')
            if len(given) not in (0, len(self.sensors)):
                problems.append(
                    f'sensor_{name} needs one value for each of the {len(self.sensors)} sensors, '
                    f'got {len(given)}'
                )
        for name in ('tags', 'sensors'):
            if bad := [one for one in getattr(self, name) if not _WORD.fullmatch(one)]:
                problems.append(
                    f"{name}: '{bad[0]}' cannot be part of a topic; letters, digits and _ can"
                )
        return problems

    def of_sensor(self: S, sensor: str) -> S:
        """These parameters with the numbers of a sensor in place."""
        if sensor not in self.sensors:
            return self
        place = self.sensors.index(sensor)
        return evolve(
            self,
            **{
                name: values[place]
                for name in SENSOR_NUMBERS
                if (values := getattr(self, f'sensor_{name}'))
            },
        )
