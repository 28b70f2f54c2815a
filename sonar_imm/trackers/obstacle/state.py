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

"""All that the obstacle tracker knows, as values.

`Known` is what is known after a ping. Its obstacles are a table, `Obstacles`: each column, or
table in it, holds one row for each, in the order of `Known.life`; `estimation.arrays` takes,
appends and replaces rows of all columns alike. No array is ever written again.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

from attrs import frozen
import numpy as np

from ...acoustics.geometry import Pose
from ...estimation.arrays import append, BoolArray, FloatArray, take
from ...estimation.association import TENTATIVE, TrackRules, Tracks
from ...estimation.consistency import NisMemory
from .beam import MissEvidence
from .bodies import Bodies
from .filters import DepthSlices, Mixture, Sonar
from .memory import Existence, Memory
from .pings import Inbox


class Obstacles(NamedTuple):
    """T obstacles in view: mixture over depth and behaviour; nis (T,), NaN without an echo;
    bodies: how far their echoes wander; misses: pings that did not show them, and what that says;
    existence: how sure it is that they are there."""

    mixture: Mixture
    nis: Annotated[FloatArray, 'T']
    bodies: Bodies
    misses: MissEvidence
    existence: Existence


class Known(NamedTuple):
    """What is known after a ping: the obstacles in view and their tracks, `life`; memory: those
    that are not in view any more; repairs: covariances repaired so far; broken: tracks ended so
    far because their numbers were not finite; alike: whether most obstacles move alike
    (`filters.moving_alike`), pings_alike: pings so far in which they did; innovations: of
    confirmed obstacles."""

    stamp_ns: int
    sonar: Sonar
    life: Tracks
    obstacles: Obstacles
    memory: Memory = ()
    repairs: int = 0
    broken: int = 0
    alike: bool = False
    pings_alike: int = 0
    innovations: NisMemory = NisMemory()

    @classmethod
    def nothing(cls, filter_: DepthSlices, rules: TrackRules) -> Known:
        """Return what is known before the first ping."""
        K, n = filter_.K, filter_.n
        mixture = Mixture(np.empty((0, K, n)), np.empty((0, K, n, n)), np.empty((0, K)))
        sonar = Sonar(Pose(np.zeros(3), np.eye(3)))
        return cls(0, sonar, Tracks.none(rules), _begun(mixture, Bodies.unknown(0), 0.0, False))

    @property
    def confirmed(self) -> BoolArray:
        """(T,) Which tracks are confirmed, coasting ones included."""
        return self.life.status != TENTATIVE

    def with_columns(self, **columns: Any) -> Known:
        """Return the same with other columns of the obstacles."""
        return self._replace(obstacles=self.obstacles._replace(**columns))

    def only(self, kept: BoolArray) -> Known:
        """Return the same with the obstacles where `kept` (T,) is True."""
        if kept.all():
            return self
        return self._replace(life=self.life.only(kept), obstacles=take(self.obstacles, kept))

    def joined(
        self,
        life: Tracks,
        mixture: Mixture,
        bodies: Bodies,
        log_odds: float = 0.0,
        silent: bool = False,
    ) -> Known:
        """Return the same with more obstacles, which `life` has already; log_odds: of their
        existence; silent: they gave no echo."""
        new = _begun(mixture, bodies, log_odds, silent)
        return self._replace(life=life, obstacles=append(self.obstacles, new))


def _begun(mixture: Mixture, bodies: Bodies, log_odds: float, silent: bool) -> Obstacles:
    T = len(mixture.mu)
    misses = MissEvidence.first(mixture, silent)
    existence = Existence.of(np.full(T, log_odds))
    return Obstacles(mixture, np.full(T, np.nan), bodies, misses, existence)


@frozen(eq=False)
class ObstacleState:
    """All that is known at a stamp. done: what was known after each ping that this step
    completed."""

    known: Known
    inbox: Inbox = Inbox()
    done: tuple[Known, ...] = ()
