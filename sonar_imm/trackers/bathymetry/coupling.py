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

"""Labels of neighbouring pings lean on each other: a patch of rough floor is wider than a ping.

Each ping is first estimated by itself, smoothed forward-backward. Then it is estimated again with
a prior for each bin from the probability p of rough floor that its neighbours, the ping before and
the ping after, have at the same distance across the track, as neighbours do in an Ising field of
strength J (`ping_coupling`)::

    L = sum over neighbours of log((p + (1 - p) e^-J) / ((1 - p) + p e^-J))

The predicted probability of rough models is multiplied by ``2 / (1 + e^-L)``, that of the others
by ``2 / (1 + e^L)``. p is that of a neighbour by itself, so that nothing goes round in circles:
an estimate depends on three pings and on no others.

Heights are not coupled: soundings of neighbouring pings have to stay independent, since what
makes a chart of them takes them to be.

A ping's estimate is therefore ready when the next one has come: one ping late.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from attrs import frozen
import numpy as np

from ...estimation.arrays import FloatArray
from .kernels import Track
from .ping import floor_of, Look, look, Ping, run

NEIGHBOURS_NS = 5_000_000_000
"""Pings of one side further apart in time are no neighbours."""


@frozen(eq=False)
class Alone:
    """A ping estimated by itself, and its probability `rough` (n,) of rough floor by the distance
    (n,) m from the array, increasing; bins whose place is not known are left out."""

    seen: Look
    track: Track
    distance: FloatArray
    rough: FloatArray

    @classmethod
    def of(cls, seen: Look, track: Track) -> Alone:
        distance = seen.swath.distance(floor_of(seen, track))
        known = np.flatnonzero(np.isfinite(distance))
        order = known[np.argsort(distance[known], kind='stable')]
        rough = track.probability[:, seen.models.rough].sum(axis=1)
        return cls(seen, track, distance[order], np.clip(rough[order], 0.0, 1.0))

    def kept(self) -> Ping:
        """What a saved state has of it: the rest follows from the ping."""
        return self.seen.ping

    @classmethod
    def from_kept(cls, ping: Ping) -> Alone:
        seen = look(ping)
        return cls.of(seen, run(seen))

    @property
    def stamp_ns(self) -> int:
        return self.seen.ping.snapshot.stamp_ns


class Favoured(NamedTuple):
    """A ping to be estimated again, and what its neighbours favour, see `ping.run`; None when it
    has no neighbours, so that its estimate by itself is final."""

    alone: Alone
    favour: FloatArray | None


class Coupling:
    """Holds the newest ping of each side until its next neighbour comes."""

    def __init__(self) -> None:
        self._before: dict[str, Alone] = {}
        self._held: dict[str, Alone] = {}

    def __len__(self) -> int:
        """How many pings are held."""
        return len(self._held)

    def add(self, alone: Alone) -> list[Favoured]:
        """Take the next ping in; gives the one before it, if one was held."""
        side = alone.seen.swath.side
        held = self._held.get(side)
        near = held is not None and 0 < alone.stamp_ns - held.stamp_ns <= NEIGHBOURS_NS
        done = []
        if held is not None:
            done.append(self._favoured(side, held, alone if near else None))
        self._before.pop(side, None)
        if held is not None and near:
            self._before[side] = held
        self._held[side] = alone
        return done

    def finish(self) -> list[Favoured]:
        """The pings still held, oldest first; nothing is held any more."""
        left = sorted(self._held.items(), key=lambda item: item[1].stamp_ns)
        done = [self._favoured(side, alone, None) for side, alone in left]
        self._before, self._held = {}, {}
        return done

    def _favoured(self, side: str, held: Alone, after: Alone | None) -> Favoured:
        around = [one for one in (self._before.get(side), after) if one is not None]
        strength = held.seen.config.ping_coupling
        return Favoured(held, favour_of(held, around, strength) if around else None)


def favour_of(alone: Alone, neighbours: list[Alone], strength: float) -> FloatArray:
    """What favours each model (T, M) in each bin of a ping, see `ping.run`."""
    seen, track = alone.seen, alone.track
    distance = np.nan_to_num(seen.swath.distance(floor_of(seen, track)), nan=-1.0)
    field = np.zeros(len(distance))
    for one in neighbours:
        if len(one.rough):
            p = np.interp(distance, one.distance, one.rough, left=0.5, right=0.5)
            field += _log_ratio(p, strength)
    rough = seen.models.rough
    favour = np.empty(track.probability.shape)
    favour[:, rough] = (2.0 / (1.0 + np.exp(-field)))[:, None]
    favour[:, ~rough] = (2.0 / (1.0 + np.exp(field)))[:, None]
    return favour


def _log_ratio(p: FloatArray, strength: float) -> FloatArray:
    weak = math.exp(-strength)
    return np.asarray(np.log((p + (1.0 - p) * weak) / ((1.0 - p) + p * weak)))
