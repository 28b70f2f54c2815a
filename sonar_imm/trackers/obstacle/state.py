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


"""All that the obstacle tracker knows at a stamp, as values."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from attrs import frozen
import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.association import Tracks
from ...estimation.consistency import NisMemory
from ...measurements import Altitude, Detections
from ..navigation import NavigationBuffer
from .bodies import Bodies
from .filters import Mixture, Sonar
from .ground import GroundMap
from .looks import Looks
from .memory import Existence, Memory


class PingState(NamedTuple):
    """T obstacles after a ping: nis (T,), NaN without a hit; repairs: covariances repaired;
    alike: whether most obstacles move alike (`behaviours.moving_alike`); bodies: how far their
    echoes wander; looks: pings that did not show them, and what that says; existence: how sure it
    is that they are there; memory: those that are not in view any more."""

    stamp_ns: int
    sonar: Sonar
    life: Tracks
    mixture: Mixture
    nis: Annotated[FloatArray, 'T']
    bodies: Bodies
    looks: Looks
    existence: Existence
    memory: Memory = ()
    repairs: int = 0
    alike: bool = False

    def rows(self, kept: np.ndarray) -> PingState:
        """The obstacles where `kept` (T,) is True; `life` is left to the caller."""
        if np.count_nonzero(kept) == len(kept):
            return self
        return self._replace(
            mixture=self.mixture.rows(kept),
            nis=self.nis[kept],
            bodies=self.bodies.rows(kept),
            looks=self.looks.rows(kept),
            existence=self.existence.rows(kept),
        )

    def only(self, kept: np.ndarray) -> PingState:
        """The obstacles where `kept` (T,) is True."""
        if np.count_nonzero(kept) == len(kept):
            return self
        return self.rows(kept)._replace(life=self.life.only(kept))


@frozen(eq=False, kw_only=True)
class ObstacleState:
    """All that is known at a stamp. last: after the newest ping used, None before the first; done:
    the pings this step completed; waiting: pings without a pose yet, each with the altitude then;
    ground: soundings so far;
    skipped: pings so far for which navigation had a gap; missing: pings so far that were given up
    because too many waited; broken: tracks ended so far because their numbers were not finite;
    alike: pings so far in which most obstacles moved alike; innovations: of confirmed ones."""

    last: PingState | None = None
    done: tuple[PingState, ...] = ()
    navigation: NavigationBuffer = NavigationBuffer()
    altitude: Altitude | None = None
    ground: GroundMap = GroundMap()
    waiting: tuple[tuple[Detections, Altitude | None], ...] = ()
    skipped: int = 0
    missing: int = 0
    broken: int = 0
    alike: int = 0
    innovations: NisMemory = NisMemory()
