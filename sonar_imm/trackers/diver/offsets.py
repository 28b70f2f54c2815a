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

"""Whether arrivals miss by the same, ping after ping: a receiver that is not where it is said to
be, a late clock, a wrong sound speed, a diver who is not at the depth he is taken to be at.

A ping of more pairs than the place of the diver has coordinates has something left that no place
explains. With the residuals r (C,) in units of their standard deviations, H (C, k) how they depend
on the place, and N (C, C - k) what is orthogonal to H,

    t = N' r ~ N(N' D b, 1)

whatever the motion of the diver, where b are errors that last and D how they show in r. Summed
over pings, and forgotten, the score ``s = sum w D' N t`` has the covariance
``V = sum w^2 D' N N' D`` if there are none, and ``s' V^-1 s`` is a chi-square (Rao 1948, *Large
sample tests of statistical hypotheses*): the test against any error of each pair that is constant.
What is stated of instruments adds its own covariance to V.

Errors that another place explains as well leave no residual, and no test finds them. So as long as
nothing is stated of the instruments they are taken to be as good as those in the field usually
are (`ASSUMED`). What such errors do to the place that the pairs heard lately give by themselves
is part of the published covariance: with G the gain of that place, ``G D B D' G'``, B their
variances. They are the same in every ping, so that filtering does not lessen it, and no estimate
is moved by it.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Annotated, NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import arrival_paths
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...measurements import Arrivals
from .config import DiverConfig
from .instruments import AT_TRANSMITTER
from .scan import Ping

MEMORY = 100.0
"""Pings over which the evidence is forgotten."""

ENOUGH = 10.0
"""Dimensions of what no place explains from which there is a verdict."""

SIGMAS = 4.0
"""A false alarm has the probability of so many standard deviations, 3e-5, at each look; looks
within `MEMORY` pings are alike."""

MOST_PAIRS = 24
"""Pairs that are looked at: those that are heard first. The evidence grows with their square."""

WILD, CAPPED = 20.0, 3.0
"""Metres beyond which an echo is another's, and the chi2_limit standard deviations of `t`, for each of
its dimensions, that count: an outlier is no evidence of what lasts."""

STEPS, FARTHEST = 2, 30.0
"""Gauss-Newton steps to the place that a ping shows, and how far, m, they may lead."""

DEPTHS, SHARE = (0.25, 0.5, 0.75), 0.7
"""Depths, as shares of the water column, whose paths are compared with those of the depth in use;
the share of all evidence from which a single cause is named."""

SOUND_SPEED = len(DEPTHS)
CAUSES = SOUND_SPEED + 1
"""Places in the score: depths, the sound speed, then the pairs."""

EVERY, DEPTH = 'every', 'target_z (or dimensions: 3)'
STDS = 'receiver_position_std', 'receiver_clock_std', 'sound_speed_std'


ASSUMED = dict(zip(STDS, (0.3, 1e-4, 2.0)))
"""What is assumed of the instruments where nothing is stated: receivers placed by differential
GNSS, clocks set before the dive, a sound speed from a table of temperatures."""

RECENT = 20
"""Pings for which a pair that was heard counts."""

WEAK = 0.05
"""Directions that the pairs show this many times worse than the best one, or worse still, are left
out: how far they are off is in the covariance of the filter."""


class RecentPairs(NamedTuple):
    """The pairs (R,), as (transmitter, receiver), whose echoes tracks took lately: tx (R, 3), NaN
    of tags, rx (R, 3), variance (R,) of the path, m^2, and age (R,) in pings."""

    pairs: tuple[tuple[int, int], ...] = ()
    tx: Annotated[FloatArray, 'p3'] = np.zeros((0, 3))
    rx: Annotated[FloatArray, 'p3'] = np.zeros((0, 3))
    variance: Annotated[FloatArray, 'p'] = np.zeros(0)
    age: Annotated[FloatArray, 'p'] = np.zeros(0)

    def with_ping(self, ping: Ping, taken: BoolArray, ids: IntArray) -> RecentPairs:
        """With the echoes `taken` (C,) of a ping; ids (rows of the message, 2)."""
        rows = {
            pair: (self.tx[k], self.rx[k], self.variance[k], self.age[k] + 1.0)
            for k, pair in enumerate(self.pairs)
            if self.age[k] + 1.0 < RECENT
        }
        for c in np.flatnonzero(taken & ping.echo).tolist():
            a, b = ids[ping.row[c]].tolist()
            if (a, b) in rows or len(rows) < MOST_PAIRS:
                measured = ping.measured
                rows[a, b] = measured.tx[c], measured.rx[c], measured.variance[c], 0.0
        if not rows:
            return RecentPairs()
        pairs = sorted(rows)
        columns = (np.array(column) for column in zip(*(rows[pair] for pair in pairs)))
        return RecentPairs(tuple(pairs), *columns)

    def assumed_covariance(self, place: FloatArray, known: int, sound_speed: float) -> FloatArray:
        """What `ASSUMED` errors do to a place (3,), of whose coordinates the first `known` are
        states: (known, known), m^2."""
        tag = bool(np.isnan(self.tx[0, 0]))
        paths = arrival_paths(place, None if tag else self.tx, self.rx)
        std = np.sqrt(self.variance)
        H = np.column_stack([paths.by_position[:, :known], np.ones((len(std), int(tag)))])
        gain = np.linalg.pinv(H / std[:, None], rcond=WEAK)[:known] / std
        off, late, slow = ASSUMED.values()
        far = np.hypot(*(self.rx - self.tx)[:, :2].T)
        receivers = np.array([pair[1] for pair in self.pairs])
        D = [slow / sound_speed * paths.by_sound_speed]
        for receiver in np.unique(receivers):
            own = receivers == receiver
            D.append(np.where(own, late * sound_speed, 0.0))
            D += list(np.where(own & ~(far <= AT_TRANSMITTER), off * paths.by_offset.T, 0.0))
        moved = gain @ np.stack(D, axis=1)
        return np.asarray(moved @ moved.T)


class BiasTest(NamedTuple):
    """The evidence: pairs (R,), as (transmitter, receiver); score (K,) and variance (K, K) with K
    = `CAUSES` + R: the depths, the sound speed, then the pairs; length (R,): path of each pair, m;
    square and freedom: of all t, and how many there were."""

    pairs: tuple[tuple[int, int], ...] = ()
    score: Annotated[FloatArray, 's'] = np.zeros(CAUSES)
    variance: Annotated[FloatArray, 'ss'] = np.zeros((CAUSES, CAUSES))
    length: Annotated[FloatArray, 'p'] = np.zeros(0)
    square: float = 0.0
    freedom: float = 0.0

    def with_ping(
        self, ping: Ping, echoes: BoolArray, ids: IntArray, x: FloatArray, config: DiverConfig
    ) -> BiasTest:
        """With a ping of a diver at x (2,) or, where depth is a state, (3,): `echoes` (C,) of it
        that may be his, `ids` (rows of the message, 2) of transmitters and receivers."""
        chosen = np.flatnonzero(echoes)
        k = len(x) + int(ping.passive)
        if len(chosen) <= k:
            return self
        named = [(int(a), int(b)) for a, b in ids[ping.row[chosen]]]
        new = [pair for pair in dict.fromkeys(named) if pair not in self.pairs]
        now = self._with_pairs(new[: MOST_PAIRS - len(self.pairs)])
        fitted = _fit_position(ping, chosen, x, config)
        if fitted is None:
            return now
        place, residual, H, length = fitted
        column = np.full(len(chosen), -1)
        D = np.zeros((len(chosen), CAUSES + len(now.pairs)))
        for row, pair in enumerate(named):
            if pair in now.pairs:
                column[row] = now.pairs.index(pair)
                D[row, CAUSES + column[row]] = 1.0
        span = config.depth_max - config.depth_min
        for at, share in enumerate(DEPTHS):
            deep = np.append(place[:2], -config.depth_min - share * span)
            D[:, at] = _path_lengths(ping, chosen, deep) - length
        D[:, SOUND_SPEED] = length
        std = np.sqrt(ping.measured.variance[chosen])
        N = np.linalg.qr(H / std[:, None], mode='complete')[0][:, k:]
        t, shown = N.T @ (residual / std), N.T @ (D / std[:, None])
        t *= min(1.0, CAPPED * math.sqrt(len(t)) / max(float(np.linalg.norm(t)), 1e-12))
        keep = 1.0 - 1.0 / MEMORY
        lengths = now.length.copy()
        lengths[column[column >= 0]] = length[column >= 0]
        return BiasTest(
            now.pairs,
            keep * now.score + shown.T @ t,
            keep**2 * now.variance + shown.T @ shown,
            lengths,
            keep**2 * now.square + float(t @ t),
            keep**2 * now.freedom + len(t),
        )

    def _with_pairs(self, new: list[tuple[int, int]]) -> BiasTest:
        if not new:
            return self
        size, K = len(new), len(self.score)
        variance = np.zeros((K + size, K + size))
        variance[:K, :K] = self.variance
        return self._replace(
            pairs=(*self.pairs, *new),
            score=np.append(self.score, np.zeros(size)),
            variance=variance,
            length=np.append(self.length, np.zeros(size)),
        )

    def evidence(self, config: DiverConfig) -> dict[str, tuple[float, int]]:
        """The statistic, and how many degrees of freedom it has where nothing lasts: of any error
        of each pair, and of causes that may explain all."""
        if self.freedom < ENOUGH:
            return {}
        V, s = self.variance, self.score
        # What is stated of the pairs; of geometric weights, w sums to at chi2_limit twice w^2.
        off = config.receiver_position_std**2
        off += (config.receiver_clock_std * config.sound_speed) ** 2
        stated = off * np.eye(len(self.pairs))
        slow = config.sound_speed_std / config.sound_speed
        stated += slow**2 * np.outer(self.length, self.length)
        V = V + 4.0 * V[:, CAUSES:] @ stated @ V[CAUSES:]
        scale = np.sqrt(np.maximum(np.diag(V), 1e-12))
        z = s / scale
        value, vector = np.linalg.eigh((V / np.outer(scale, scale))[CAUSES:, CAUSES:])
        sure = value > 1e-6 * value[-1]
        every = float(((vector[:, sure].T @ z[CAUSES:]) ** 2 / value[sure]).sum())
        rank = int(sure.sum())
        # Noise that is larger than stated lasts no longer than the ping.
        scatter = max((self.square - every) / max(self.freedom - rank, 1.0), 1.0)
        found = {EVERY: (every / scatter, rank), 'sound_speed': (z[SOUND_SPEED] ** 2 / scatter, 1)}
        if config.dimensions == 2:
            deep = max(float(z[:SOUND_SPEED].max()), 0.0)
            found[DEPTH] = deep**2 / scatter, 1
        return found

    def warnings(self, config: DiverConfig) -> list[str]:
        """A sentence where there is evidence of errors that last and are larger than stated."""
        found = self.evidence(config)
        beyond = [value / chi2_limit(rank) for value, rank in found.values()]
        if not found or max(beyond) <= 1.0:
            return []
        largest = found[EVERY][0]
        likely = [
            name for name, (value, _) in found.items() if name != EVERY and value > SHARE * largest
        ]
        unstated = [f'{name} (now {getattr(config, name):g})' for name in STDS]
        if config.dimensions == 2:
            unstated.insert(0, DEPTH)
        what = f'{" or ".join(likely)} would explain it; else ' if likely else ''
        return [
            'arrivals miss by the same ping after ping, wherever the diver is and by more than is '
            f'stated of the instruments (chi-square {largest:.3g} of {found[EVERY][1]} degrees of '
            f'freedom), so that covariances are too small: {what}state ' + ', '.join(unstated)
        ]


def chi2_limit(rank: int) -> float:
    """What a chi-square of `rank` degrees of freedom stays below but for `SIGMAS`, by the cube
    root of Wilson and Hilferty."""
    spread = 2.0 / (9.0 * rank)
    return rank * (1.0 - spread + SIGMAS * math.sqrt(spread)) ** 3


def accumulate_residuals(
    found: BiasTest,
    recent: RecentPairs,
    places: Mapping[int, FloatArray],
    took: Mapping[int, BoolArray],
    ping: Arrivals,
    seen: Ping,
    config: DiverConfig,
) -> tuple[BiasTest, RecentPairs]:
    """Return the evidence `found` and that of a ping `seen`, of which tracks `took` (C,)
    measurements each, only of those whose places (2 or 3,) are given; and the pairs heard lately.

    Of each pair it is the echo that a track took, else the nearest that is no other track's: where
    an error is large, the echoes that have it are refused.
    """
    taken = np.zeros(len(seen.row), bool)
    for good in took.values():
        taken |= good
    ids = np.column_stack([ping.tx_id, ping.rx_id]).astype(np.int64)
    if ping.passive:
        ids[:, 0] = 0
    recent = recent.with_ping(seen, taken, ids)
    for track, place in places.items():
        good = took[track]
        echo = np.flatnonzero(seen.echo)
        mine = good[echo]
        whole = place if len(place) == 3 else np.append(place, config.target_z)
        late = seen.measured.value[echo] - _path_lengths(seen, echo, whole)
        if ping.passive and mine.any():
            late -= np.median(late[mine])
        off = np.where(mine, -1.0, np.abs(late))
        usable = mine | (~taken[echo] & (off < WILD))
        echoes = np.zeros(len(good), bool)
        for node in np.unique(seen.measured.node[echo[usable]]):
            members = np.flatnonzero(usable & (seen.measured.node[echo] == node))
            echoes[echo[members[off[members].argmin()]]] = True
        found = found.with_ping(seen, echoes, ids, place, config)
    return found, recent


def with_assumed_errors(
    recent: RecentPairs, mean: FloatArray, covariance: FloatArray, config: DiverConfig
) -> FloatArray:
    """Return the covariances (T, q, q) of outputs mean (T, q), position first, with what is
    assumed of the instruments: nothing where something is stated, or fixes say where divers
    are."""
    exact = config.systematic_errors == 'exact'
    if not recent.pairs or exact or any(getattr(config, name) for name in STDS):
        return covariance
    # Depths that are states may be seen by elevations and sensors, which are not among these.
    covariance, known = covariance.copy(), 2
    for t, row in enumerate(mean):
        place = row[:3] if config.dimensions == 3 else np.append(row[:2], config.target_z)
        covariance[t, :known, :known] += recent.assumed_covariance(
            place, known, config.sound_speed
        )
    return covariance


def _fit_position(
    ping: Ping, chosen: IndexArray, x: FloatArray, config: DiverConfig
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Where the echoes `chosen` (C,) put a diver who is near x (2 or 3,): place (3,), residual
    (C,), its derivative H (C, k) by the place, and by the emission of a tag, length (C,); None
    where they put him nowhere near."""
    deep = len(x) == 3
    place = np.array([x[0], x[1], x[2] if deep else config.target_z])
    measured = ping.measured
    value, std = measured.value[chosen], np.sqrt(measured.variance[chosen])
    tx, rx = None if ping.passive else measured.tx[chosen], measured.rx[chosen]
    start, emission = place.copy(), 0.0
    for step in range(STEPS + 1):
        paths = arrival_paths(place, tx, rx)
        H = paths.by_position[:, : len(x)]
        if ping.passive:
            H = np.column_stack([H, np.ones(len(H))])
            if step == 0:
                emission = float(np.median(value - paths.length))
        residual = value - paths.length - emission
        if step == STEPS:
            return place, residual, H, paths.length
        move = np.linalg.lstsq(H / std[:, None], residual / std, rcond=1e-2)[0]
        place[: len(x)] += move[: len(x)]
        emission += move[len(x)] if ping.passive else 0.0
        if not np.linalg.norm(place - start) < FARTHEST:
            break
    return None


def _path_lengths(ping: Ping, chosen: IndexArray, place: FloatArray) -> FloatArray:
    measured = ping.measured
    tx = None if ping.passive else measured.tx[chosen]
    return arrival_paths(place, tx, measured.rx[chosen]).length
