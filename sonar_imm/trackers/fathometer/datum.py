# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How wrong the stated depth of the array is, as the reflectors show it together.

An error e_t that is new in each record moves all reflectors by c_t = e_t - e_{t-1}, their mean
change: successive changes then have the covariance -std^2. A slope or a wave adds a part that
stays, whose successive products are positive; of the differences of c_t the same is -4 std^2 and
hardly any slope. A fault of the floor is one change far from the others: such ones are left out,
and the products that touch them. What is slow, or constant, cannot be told from the floor.

Where the error found is more than twice what is told, it is a part of the covariance at least;
with ``heave: auto`` it becomes a state that all reflectors share, and they keep their ids.

Jumps that are farther than slopes reach are counted: of a fault, or of a depth or a window that
changed unsaid.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

from attrs import define, evolve, field
import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from .config import FathometerConfig
from .reflectors import IdArray, Identities, Reflectors
from .slopes import TURN_REACH

CHANGES, LEAST, MOST = 40, 15, 1000.0
_MAD, _FAR, _LEAST_FAR = 1.4826, 4.0, 0.08
_TIMES, _LEAST_ERROR = 2.0, 0.05


@define(eq=False)
class DatumError:
    """Changes (n,) of depth, m, that reflectors of two records have in common. STATE: see
    `trackers.Tracker`. followed: standard deviation with which the error became a state, m;
    _jumps: in how many records all jumped far, and _last, by how many m in the last of them."""

    STATE: ClassVar = ('_changes', 'followed', '_jumps', '_last')

    _changes: Annotated[FloatArray, 'n'] = field(init=False, factory=lambda: np.empty(0))
    followed: float = field(init=False, default=0.0)
    _jumps: int = field(init=False, default=0)
    _last: float = field(init=False, default=0.0)

    def add(self, change: float) -> None:
        """One more record; changes of a depth that is followed say nothing of its error."""
        if not self.followed:
            self._changes = np.append(self._changes[1 - CHANGES :], change)

    def note(
        self,
        known: Identities,
        ids: IdArray,
        found: Reflectors,
        config: FathometerConfig,
        *,
        array: bool,
    ) -> None:
        """Take the reflectors of one more record, with `ids` (K,) those that were `known`; array:
        what moves the floor of a profiler is its ship."""
        before = {e.track_id: e.depth for e in known.reflectors if not e.missed + e.absent}
        moved = [z - before[i] for i, z in zip(ids.tolist(), found.depth) if i in before]
        if abs(found.probable_jump) > TURN_REACH * config.slope_std and len(moved) > 1:
            self._jumps, self._last = self._jumps + 1, found.probable_jump
        if moved and array:
            self.add(float(np.mean(moved)))

    def require(self) -> None:
        """Raise ValueError where the state, which may come from a file, is impossible."""
        good = np.isfinite(self._changes).all() and 0.0 <= self.followed <= MOST
        if not (good and self._jumps >= 0 and math.isfinite(self._last)):
            raise ValueError('no array is as deep as that')

    @property
    def found(self) -> float:
        """Standard deviation, m; 0 while it is not known."""
        if self.followed:
            return self.followed
        return min(found_std(self._changes), MOST) if len(self._changes) >= LEAST else 0.0

    def exceeds(self, config: FathometerConfig) -> bool:
        """Whether the error is far greater than what is told."""
        told = config.array_depth_std
        return told > 0.0 and self.found > max(_TIMES * told, _LEAST_ERROR)

    def effective(self, config: FathometerConfig) -> FathometerConfig:
        """`config` with the heave that is followed now."""
        if config.heave != 'auto':
            return config
        if not self.followed:
            return evolve(config, heave='none')
        return evolve(config, heave='independent', array_depth_std=self.followed)

    def warnings(self, config: FathometerConfig) -> list[str]:
        """What all reflectors do together, in sentences."""
        found = []
        if self._jumps:
            found.append(
                f'all reflectors jumped together in {self._jumps} '
                f'{"record" if self._jumps == 1 else "records"}, by {self._last:+.1f} m in the '
                'last: a fault or a slope, or the depth of the array or the window changed unsaid'
            )
        if config.heave in ('auto', 'none') and self.exceeds(config):
            remedy = 'it is followed as heave' if self.followed else 'heave auto follows it'
            found.append(
                f'the depth of the array is wrong by about {self.found:.2f} m from record to '
                f'record, {config.array_depth_std:g} m told (array_depth_std); {remedy}'
            )
        return found


def found_std(changes: FloatArray) -> float:
    """Standard deviation, m, of an error that is new in each record, from what reflectors change
    by together (n,), m."""
    off = np.abs(changes - np.median(changes))
    usual = off <= max(_FAR * _MAD * float(np.median(off)), _LEAST_FAR)
    variance = -_lagged(changes, usual)
    if variance < 0.0:
        variance = -0.25 * _lagged(np.diff(changes), usual[1:] & usual[:-1])
    return math.sqrt(max(variance, 0.0))


def _lagged(values: FloatArray, usual: BoolArray) -> float:
    """Mean product of successive values (n,), both of them usual."""
    both = usual[1:] & usual[:-1]
    return float(np.mean((values[1:] * values[:-1])[both])) if both.any() else 0.0
