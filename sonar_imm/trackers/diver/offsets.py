# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Test for instrument errors in arrivals: receiver positions, clocks, sound speed, assumed depth.

A ping with more pairs than position coordinates has residuals that no position explains. With the
normalised residuals r (C,), H (C, k) their derivative by the position, and N (C, C - k) orthogonal
to H,

    t = N' r ~ N(N' D b, 1)

for any motion, where b are constant errors and D their effect on r. The score ``s = sum w D' N
t``, summed over pings with decaying weights, has the covariance ``V = sum w^2 D' N N' D`` without
errors. Then ``s' V^-1 s`` is a chi-square (Rao 1948, *Large sample tests of statistical
hypotheses*): the test against any constant error of each pair. Configured instrument errors add
their covariance to V.

Errors that another position explains leave no residual and cannot be tested. So without configured
instrument errors, typical errors are assumed (`ASSUMED`). Their effect on a position from the
recent pairs is added to the published covariance: ``G D B D' G'``, with G the gain of this
position and B the error variances. These errors are equal in all pings, so filtering does not
reduce them. Estimates do not change.
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
"""Number of pings over which the evidence decays."""

ENOUGH = 10.0
"""Minimum degrees of freedom for a result."""

SIGMAS = 4.0
"""Significance of a warning in standard deviations: a false alarm probability of 3e-5 per test.
Tests within `MEMORY` pings are correlated."""

MOST_PAIRS = 24
"""Maximum number of pairs in the test, the first received ones. The evidence grows with their
square."""

WILD, CAPPED = 20.0, 3.0
"""Residual, m, beyond which an echo belongs to another target; and the limit of `t` per dimension,
in standard deviations, against outliers."""

STEPS, FARTHEST = 2, 30.0
"""Gauss-Newton steps to the position of a ping, and their maximum total length, m."""

DEPTHS, SHARE = (0.25, 0.5, 0.75), 0.7
"""Depths, as fractions of the water column, that are tested; and the fraction of the evidence
above which a single cause is named."""

SOUND_SPEED = len(DEPTHS)
CAUSES = SOUND_SPEED + 1
"""Indices of the score: depths, sound speed, then pairs."""

EVERY, DEPTH = 'every', 'target_z (or dimensions: 3)'
STDS = 'receiver_position_std', 'receiver_clock_std', 'sound_speed_std'


ASSUMED = dict(zip(STDS, (0.3, 1e-4, 2.0)))
"""Assumed instrument errors: receiver positions from differential GNSS, clocks set before the
dive, sound speed from a temperature table."""

RECENT = 20
"""Number of pings for which a received pair counts."""

WEAK = 0.05
"""Relative singular value below which a direction is ignored: the filter covariance contains its
error."""


class RecentPairs(NamedTuple):
    """R recent pairs (transmitter, receiver) of associated echoes."""

    pairs: tuple[tuple[int, int], ...] = ()
    tx: Annotated[FloatArray, 'p3'] = np.zeros((0, 3))
    """(R, 3) transmitter positions, m; NaN for tags."""
    rx: Annotated[FloatArray, 'p3'] = np.zeros((0, 3))
    """(R, 3) receiver positions, m."""
    variance: Annotated[FloatArray, 'p'] = np.zeros(0)
    """(R,) variance of the path length, m^2."""
    age: Annotated[FloatArray, 'p'] = np.zeros(0)
    """(R,) age in pings."""

    def with_ping(self, ping: Ping, taken: BoolArray, ids: IntArray) -> RecentPairs:
        """Add the echoes `taken` (C,) of a ping. ids: (rows of the message, 2)."""
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
        """Return the covariance (known, known), m^2, of a position (3,) due to `ASSUMED` errors;
        its first `known` coordinates are states."""
        # A track may be heard both by its tag and by its echoes of a transmitter.
        tag = np.isnan(self.tx[:, 0])
        one_way = arrival_paths(place, None, self.rx)
        echo = arrival_paths(place, self.tx, self.rx)
        by_position = np.where(tag[:, None], one_way.by_position, echo.by_position)
        by_sound_speed = np.where(tag, one_way.by_sound_speed, echo.by_sound_speed)
        std = np.sqrt(self.variance)
        emission = tag[:, None].astype(np.float64)[:, : int(tag.any())]
        H = np.column_stack([by_position[:, :known], emission])
        gain = np.linalg.pinv(H / std[:, None], rcond=WEAK)[:known] / std
        off, late, slow = ASSUMED.values()
        far = np.hypot(*(self.rx - self.tx)[:, :2].T)
        receivers = np.array([pair[1] for pair in self.pairs])
        D = [slow / sound_speed * by_sound_speed]
        for receiver in np.unique(receivers):
            own = receivers == receiver
            D.append(np.where(own, late * sound_speed, 0.0))
            D += list(np.where(own & ~(far <= AT_TRANSMITTER), off * one_way.by_offset.T, 0.0))
        moved = gain @ np.stack(D, axis=1)
        return np.asarray(moved @ moved.T)


class BiasTest(NamedTuple):
    """Evidence of constant instrument errors, with K = `CAUSES` + R components."""

    pairs: tuple[tuple[int, int], ...] = ()
    """R pairs (transmitter, receiver)."""
    score: Annotated[FloatArray, 's'] = np.zeros(CAUSES)
    """(K,) score."""
    variance: Annotated[FloatArray, 'ss'] = np.zeros((CAUSES, CAUSES))
    """(K, K) covariance of the score."""
    length: Annotated[FloatArray, 'p'] = np.zeros(0)
    """(R,) last path length of each pair, m."""
    square: float = 0.0
    """Sum of squares of all t."""
    freedom: float = 0.0
    """Number of all t."""

    def with_ping(
        self, ping: Ping, echoes: BoolArray, ids: IntArray, x: FloatArray, config: DiverConfig
    ) -> BiasTest:
        """Add a ping of a target at x (2,), or (3,) with depth as a state.

        :param echoes: (C,) True for echoes that may belong to the target.
        :param ids: (rows of the message, 2) transmitter and receiver IDs.
        """
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
        """Return the test statistic and its degrees of freedom, for any error of each pair and for
        single causes."""
        if self.freedom < ENOUGH:
            return {}
        V, s = self.variance, self.score
        # Configured errors of the pairs. For geometric weights, sum w <= 2 sum w^2.
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
        # Noise above the reported variances is uncorrelated between pings.
        scatter = max((self.square - every) / max(self.freedom - rank, 1.0), 1.0)
        found = {EVERY: (every / scatter, rank), 'sound_speed': (z[SOUND_SPEED] ** 2 / scatter, 1)}
        if config.dimensions == 2:
            deep = max(float(z[:SOUND_SPEED].max()), 0.0)
            found[DEPTH] = deep**2 / scatter, 1
        return found

    def warnings(self, config: DiverConfig) -> list[str]:
        """Return a warning if constant errors are larger than configured."""
        found = self.evidence(config)
        beyond = [value / chi2_limit(rank) for value, rank in found.values()]
        if not found or max(beyond) <= 1.0:
            return []
        largest = found[EVERY][0]
        likely = [
            name for name, (value, _) in found.items() if name != EVERY and value > SHARE * largest
        ]
        unset = [f'{name} (now {getattr(config, name):g})' for name in STDS]
        if config.dimensions == 2:
            unset.insert(0, DEPTH)
        cause = f'Likely cause: {" or ".join(likely)}. ' if likely else ''
        return [
            f'arrival residuals are constant over pings: chi-square {largest:.3g} (expected '
            f'{found[EVERY][1]}), so covariances are too small. {cause}Set ' + ', '.join(unset)
        ]


def chi2_limit(rank: int) -> float:
    """Return the `SIGMAS` limit of a chi-square of `rank` degrees of freedom (Wilson and
    Hilferty)."""
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
    """Return the evidence and the recent pairs after a ping.

    Each pair contributes the echo of the track, or the nearest echo of no other track, because
    echoes with large errors fail the gate.

    :param places: position (2,) or (3,) by track index.
    :param took: (C,) measurements of each track.
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
    recent: RecentPairs, places: FloatArray, covariance: FloatArray, config: DiverConfig
) -> FloatArray:
    """Add the assumed instrument errors to the covariances (T, q, q) of tracks at `places` (T, q).

    No effect if instrument errors are configured or fixes are used.
    """
    exact = config.systematic_errors == 'exact'
    if not recent.pairs or exact or any(getattr(config, name) for name in STDS):
        return covariance
    # Excludes z: elevations and depth sensors also determine a depth state.
    covariance, known = covariance.copy(), 2
    for t, row in enumerate(places):
        place = row[:3] if config.dimensions == 3 else np.append(row[:2], config.target_z)
        covariance[t, :known, :known] += recent.assumed_covariance(
            place, known, config.sound_speed
        )
    return covariance


def _fit_position(
    ping: Ping, chosen: IndexArray, x: FloatArray, config: DiverConfig
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Fit a position near x (2,) or (3,) to the echoes `chosen` (C,).

    :returns: position (3,), residual (C,), H (C, k) by position and tag emission, length (C,);
        None if the position is too far from x.
    """
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
    """Return the path lengths (C,), m, of the echoes `chosen` (C,) for a target at `place`
    (3,)."""
    measured = ping.measured
    tx = None if ping.passive else measured.tx[chosen]
    return arrival_paths(place, tx, measured.rx[chosen]).length
