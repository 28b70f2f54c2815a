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

"""How many false fixes a sensor shows, learnt from those that nobody took: `clutter_density: 0`.

The density is a number per scan divided by an area. The number is that of the fixes that are no
track's, each with the probability of that. The first fix of a diver is nobody's either: it is
taken back once his track is confirmed. The area is that of a rectangle in which fixes spread as
the false ones did, `12 sqrt(det C)` of their covariance C (a disc has `4 pi sqrt(det C)`), so that
it needs not be stated, and a sensor that moves takes it along.

Before anything was seen there are `PRIOR_SCANS` scans of `PRIOR_AREA` with the density
`CLUTTER`. A tenth of that is the least that is believed: a sensor without a false fix so far may
show some.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.association import TENTATIVE
from ...measurements import NOBODY
from .config import CLUTTER, DiverConfig

if TYPE_CHECKING:
    from .known import Known
    from .scan import Group, Scan

MOST = 1e-2
"""The greatest that is believed, per square metre: one within the usual gate of a fix good to a
metre in every other scan. Whoever has more has to state it."""

LEAST = 0.1 * CLUTTER
"""The least that is believed."""

PRIOR_SCANS, PRIOR_AREA = 5.0, 4e4
"""Scans, and m^2, that what is known at first is worth."""

ENOUGH, EVIDENT = 20.0, 0.5
"""Scans, and false fixes in each, from which `gnn` says that it should not ignore them."""

ALL = 0.9
"""False fixes in each scan that are all of them, where there is no track."""

MOST_SENSORS = 20
"""Sensors that are remembered, those that showed a scan last."""

MEMORY = 100.0
"""Scans after which what was seen counts for 1/e."""


class Clutter(NamedTuple):
    """What a sensor showed, older scans counting for less: scans; false: expected number of false
    fixes in them; placed: the number whose mean (x, y) and scatter (xx, xy, yy) is known."""

    scans: float = 0.0
    false: float = 0.0
    placed: float = 0.0
    x: float = 0.0
    y: float = 0.0
    xx: float = 0.0
    xy: float = 0.0
    yy: float = 0.0

    @property
    def area(self) -> float:
        """m^2 in which false fixes lie."""
        prior, number = PRIOR_AREA / 12.0, 1.0 + self.placed
        a, b = (prior + self.xx) / number, (prior + self.yy) / number
        return 12.0 * math.sqrt(max(a * b - (self.xy / number) ** 2, 0.0)) + 1.0

    @property
    def density(self) -> float:
        """Of false fixes, per square metre and scan."""
        number = CLUTTER * PRIOR_SCANS * PRIOR_AREA + max(self.false, 0.0)
        found = number / ((PRIOR_SCANS + self.scans) * self.area)
        return min(max(found, LEAST), MOST)

    def with_scan(self, z: FloatArray, false: FloatArray) -> Clutter:
        """With a scan of fixes z (D, 2), each false with a probability (D,)."""
        kept = math.exp(-1.0 / MEMORY)
        added, old = float(false.sum()), kept * self.placed
        total = old + added
        mean = false @ z / added if added > 0.0 else np.array([self.x, self.y])
        share = added / total if added > 0.0 else 0.0
        apart, gap = z - mean, mean - (self.x, self.y)
        own = apart.T @ (false[:, None] * apart)
        own = own + old * share * np.outer(gap, gap)
        return Clutter(
            kept * self.scans + 1.0,
            kept * self.false + added,
            total,
            self.x + share * float(gap[0]),
            self.y + share * float(gap[1]),
            kept * self.xx + float(own[0, 0]),
            kept * self.xy + float(own[0, 1]),
            kept * self.yy + float(own[1, 1]),
        )

    @property
    def evident(self) -> bool:
        """Whether there are many more false fixes than where nobody says how many."""
        many = self.false > EVIDENT * self.scans and self.density > 10.0 * CLUTTER
        return self.scans >= ENOUGH and many


class Clutters(NamedTuple):
    """What is known of each sensor that showed scans, `by_sensor`, the one heard last at the
    end."""

    by_sensor: tuple[tuple[str, Clutter], ...] = ()

    def get(self, sensor: str) -> Clutter | None:
        """Return what is known of a sensor, None for nothing."""
        return dict(self.by_sensor).get(sensor)

    def with_sensor(self, sensor: str, clutter: Clutter) -> Clutters:
        """Return this with what is known of `sensor` now; the sensor silent for longest makes
        room for it."""
        others = [item for item in self.by_sensor if item[0] != sensor]
        return Clutters((*others, (sensor, clutter))[-MOST_SENSORS:])


def count_clutter(known: Known, group: Group) -> Known:
    """Take in the false ones of a scan. A stage of the tracker."""
    if group.config.clutter_density or group.target_id is not None or not group.is_complete:
        return known
    clutters: Clutters = known.memory['clutter']
    before = clutters.get(group.sensor) or Clutter()
    assert group.association is not None
    after = before.with_scan(group.z, np.clip(1.0 - group.association.claimed, 0.0, 1.0))
    return known.with_memory(clutter=clutters.with_sensor(group.sensor, after))


def remove_first_fixes(known: Known, scan: Scan) -> Known:
    """Take back the first fixes of tracks that this scan confirmed, which were counted as false
    ones. A stage of the tracker."""
    clutters: Clutters = known.memory['clutter']
    sensor = next((group.sensor for group in scan.fixes if clutters.get(group.sensor)), None)
    own = None if sensor is None else clutters.get(sensor)
    if sensor is None or own is None:
        return known
    life, before = known.life, scan.previous.life
    firm = life.track_id[(life.status != TENTATIVE) & (known['target_id'] == NOBODY)]
    new = len(set(firm.tolist()) - set(before.track_id[before.status != TENTATIVE].tolist()))
    if not new:
        return known
    after = own._replace(false=max(own.false - new, 0.0))
    return known.with_memory(clutter=clutters.with_sensor(sensor, after))


def warnings(known: Clutters, config: DiverConfig, tracked: bool) -> list[str]:
    """Sentences on fixes that no track takes, where nobody is `tracked`, and on false ones that
    the association does not expect."""
    if not tracked and any(
        clutter.scans >= ENOUGH and clutter.false > ALL * clutter.scans
        for _, clutter in known.by_sensor
    ):
        return [
            'no track takes the fixes: nobody is there, or they are further apart than a diver '
            'gets; check units and stated covariances, or state target (boat, ship)'
        ]
    if config.pairing != 'gnn':
        return []
    found = [clutter for _, clutter in known.by_sensor if clutter.evident]
    return [
        f'{clutter.false / clutter.scans:.2g} fixes or more of each scan are of no diver '
        f'({clutter.density:.1g} for each square metre), and association gnn expects '
        f'{CLUTTER:g}: use association jipda, which learns this, or state clutter_density'
        for clutter in found[:1]
    ]
