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

"""Where new divers may be: positions that the detections no track took can explain."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice, product
import math
from typing import NamedTuple

import numpy as np

from ...acoustics import multistatic
from ...estimation.arrays import FloatArray, IndexArray
from ...measurements import Arrivals, NOBODY
from .config import DiverConfig
from .sensing import locate, Positions, spread, systematic_variance, toa_variance
from .state_space import heights_of


class Birth(NamedTuple):
    """Where a track may begin: position (2,), covariance (2, 2), and the ping and its rows from
    which it is, None for a fix; the probability that there is a diver, NaN where its hits will
    tell; whose track it is."""

    position: FloatArray
    covariance: FloatArray
    ping: Arrivals | None = None
    rows: IndexArray | None = None
    existence: float = math.nan
    target_id: int = NOBODY


SEED_PAIRS = 3
"""Transmitter-receiver pairs whose echoes are combined to seed a position; others must confirm
it."""

MAX_COMBINATIONS = 200
"""Combinations of echoes tried for one position."""

MOST_FOUND = 10
"""Positions found by combining the echoes of one ping; those of others are found in later ones."""


def births_from_fixes(
    group: Positions, free: np.ndarray, existence: FloatArray | None = None
) -> list[Birth]:
    """Every fix that is `free` (D,) is a place to begin a track; existence: (D,) of those."""
    names = np.full(len(free), NOBODY) if group.target_id is None else group.target_id
    known = np.full(len(free), math.nan) if existence is None else existence
    return [
        Birth(group.z[d], group.R[d], existence=float(known[d]), target_id=int(names[d]))
        for d in np.flatnonzero(free)
    ]


def births_from_ping(
    ping: Arrivals, free: np.ndarray, config: DiverConfig, factor: float
) -> list[Birth]:
    """Positions from the rows (n,) of a ping that are `free`.

    With at most one echo for each transmitter-receiver pair this is one fix, with its ghosts,
    which live until later pings tell them apart. With several, combinations of echoes of a few
    pairs are tried; one that more pairs agree with is a position, and takes its echoes out.
    """
    rows = np.flatnonzero(free & np.isfinite(ping.toa))
    births: list[Birth] = []
    for _ in range(MOST_FOUND):
        if not len(rows):
            break
        pairs = [rows] if ping.passive else _by_pair(ping, rows)
        if ping.passive or max(len(one) for one in pairs) == 1:
            return births + _fix(ping, rows, config, factor)[0]
        found, used = _best_combination(ping, pairs, config, factor)
        if not found:
            return births
        births += found
        rows = np.setdiff1d(rows, used)
    return births


def _by_pair(ping: Arrivals, rows: np.ndarray) -> list[np.ndarray]:
    pair = np.column_stack([ping.tx_id, ping.rx_id])[rows]
    return [rows[(pair == one).all(axis=1)] for one in np.unique(pair, axis=0)]


def _fix(
    ping: Arrivals, rows: np.ndarray, config: DiverConfig, factor: float
) -> tuple[list[Birth], np.ndarray]:
    """The fix of `rows` and its alternatives, and the rows it used."""
    rows = spread(rows)
    fix = locate(ping, rows, config, config.covariance_scale * factor)
    if fix is None:
        return [], rows[:0]
    used = rows[fix.used | fix.used_bearing]
    return [
        Birth(one.position, one.covariance, ping, used) for one in (fix, *fix.alternatives)
    ], rows[fix.used]


def _best_combination(
    ping: Arrivals, pairs: Sequence[np.ndarray], config: DiverConfig, factor: float
) -> tuple[list[Birth], np.ndarray]:
    """The fix that most pairs agree with, at least one more than seeded it."""
    best: tuple[list[Birth], np.ndarray] = ([], np.empty(0, np.intp))
    if len(pairs) <= SEED_PAIRS:
        return best
    seeding = sorted(pairs, key=len)[:SEED_PAIRS]
    for seed in islice(product(*seeding), MAX_COMBINATIONS):
        for birth in _fix(ping, np.array(seed), config, factor)[0]:
            agreeing = _agreeing(ping, pairs, birth, config, factor)
            if len(agreeing) > max(SEED_PAIRS, len(best[1])):
                refined = _fix(ping, agreeing, config, factor)
                best = refined if len(refined[1]) > len(best[1]) else best
    return best


def _agreeing(
    ping: Arrivals, pairs: Sequence[np.ndarray], birth: Birth, config: DiverConfig, factor: float
) -> np.ndarray:
    """Of each pair the echo nearest to what a target at `birth` causes, where within 3 sigma."""
    position, covariance = birth.position, birth.covariance
    height = float(np.mean(heights_of(config)))
    expected = multistatic.range_sum(position, ping.tx, ping.rx, height)
    slope = multistatic.range_sum_jacobian(position, ping.tx, ping.rx, height)
    variance = config.sound_speed**2 * (
        toa_variance(ping, config, config.covariance_scale * factor)
        + systematic_variance(ping, config)
    ) + np.einsum('na,ab,nb->n', slope, covariance, slope)
    nis = np.square(config.sound_speed * ping.toa - expected) / variance
    nearest = np.array([rows[np.argmin(nis[rows])] for rows in pairs])
    return nearest[nis[nearest] <= 9.0]
