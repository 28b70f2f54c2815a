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

"""A ping as numbers, and what one diver's models become by it.

Echoes of up to `MOST_SUBSETS` transmitter-receiver pairs are explained by all their inlier and
outlier subsets (`ping_kernels`), more of them by heavy tails (`robust_kernels`). So are the
arrivals of a tag, however few: its time of emission is unknown, so that among three or four
receivers no subset is refuted by the others, and what decides is whether the whole lies where the
ping by itself would put it.

Rows come in the order of their content (`Arrivals.in_order`): the order in which the arrivals of a
ping were sent changes no bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import BEARING, ELEVATION, EMISSION, HEIGHT, ONE_WAY, PATH
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.small_matrices import add_jitter_all
from ...measurements import Arrivals
from .config import DiverConfig
from .expectation_kernels import expect_numbers, expect_residuals, fit_numbers
from .instruments import Layout
from .model_set import heights_of, ModelSet
from .ping_kernels import MOST_EXPLANATIONS, Numbers, subset_ping
from .robust_kernels import DEGREES, student_t_maxima, student_t_ping
from .sensing import bearing_variance, MOST_NUMBERS, spread, toa_variance

MOST_SUBSETS = 6
"""Most transmitter-receiver pairs heard whose subsets are all tried."""

OUTLIER_DENSITY = 1.0 / 50.0
"""Density of a wild path length, 1/m: late by anything up to 50 m."""

EMISSION_STD = 1e3
"""Standard deviation of a tag's emission, m of path, about where the arrivals put it: flat beside
any residual."""

FAR = 1e3
"""Standard deviation, m, of a position of which nothing is known but where the receivers are."""

GOOD_RESIDUAL = 3.0
"""Standard deviations at which an arrival, weighed by heavy tails, is as good as wild."""

OPTIMA = 3
"""Best positions of the ping by itself from which every model starts too."""

DISTINCT = 1.0
"""Metres within which two of them are one."""


class Ping(NamedTuple):
    """The `numbers` of a ping in the order of their content; row (C,): the row of the ping each
    stands in; passive: a tag's; pairs: transmitter-receiver pairs heard."""

    numbers: Numbers
    row: IntArray
    passive: bool
    pairs: int

    def only(self, keep: BoolArray) -> Ping:
        """The numbers `keep` (C,), without those whose parent is not kept."""
        keep = self.kept(keep)
        place = np.cumsum(keep) - 1
        left = Numbers(*(np.ascontiguousarray(column[keep]) for column in self.numbers))
        left = left._replace(parent=np.where(left.parent >= 0, place[left.parent], -1))
        pairs = len(np.unique(left.node[left.kind <= ONE_WAY]))
        return Ping(left, self.row[keep], self.passive, pairs)

    def kept(self, keep: BoolArray) -> BoolArray:
        """`keep` (C,) without those whose parent is not kept."""
        parent = self.numbers.parent
        orphaned = (parent >= 0) & ~keep[parent]
        return np.asarray(keep & ~orphaned)

    def compared(self, keep: BoolArray) -> Ping:
        """As `only`, but at most `MOST_NUMBERS`, evenly chosen."""
        if np.count_nonzero(keep) > MOST_NUMBERS:
            keep = np.isin(np.arange(len(keep)), spread(np.flatnonzero(keep)))
        return self.only(keep)

    @property
    def nodes(self) -> IntArray:
        """Numbers of the pairs heard."""
        return np.unique(self.numbers.node[self.echo])

    @property
    def echo(self) -> BoolArray:
        """(C,) True for path lengths, which are what tells that a diver is there."""
        return np.asarray(self.numbers.kind <= ONE_WAY)


class PingUpdate(NamedTuple):
    """A diver after a ping: x (M, n), P (M, n, n), mu (M,); good (C,): how sure each number is
    this diver's; log_evidence, comparable between divers of the same ping; repairs: covariances
    repaired (`estimation.covariance`)."""

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    good: FloatArray
    log_evidence: float
    repairs: int


def ping_numbers(
    ping: Arrivals,
    rows: IntArray,
    config: DiverConfig,
    factor: float,
    models: ModelSet,
    layout: Layout,
) -> Ping:
    """The usable `rows` of a ping in order as numbers; factor: on the variances of arrival
    times."""
    usable = rows[np.isfinite(ping.toa[rows])]
    if not ping.passive:
        usable = usable[np.isfinite(ping.tx[usable]).all(axis=1)]
    if ping.passive:
        usable = spread(usable[np.argsort(ping.rx_id[usable], kind='stable')])
    speed = config.sound_speed
    first = ping.toa[usable].min(initial=np.inf) if ping.passive else 0.0
    variance = toa_variance(ping, config, factor)[usable] * speed**2
    deep = models.height >= 0
    table: list[tuple[int, int, int, float, float, float, int]] = []
    if deep:
        span = max(config.depth_max - config.depth_min, 1.0)
        for value, noise, row in _depth_reports(ping, usable):
            table.append((0, -1, HEIGHT, -value, noise, 1.0 / span, row))
    pair = np.column_stack([ping.tx_id, ping.rx_id])[usable].astype(np.int64)
    if ping.passive:
        pair[:, 0] = 0
    new = np.ones(len(usable), bool)
    new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    node = np.cumsum(new)
    var_bearing = bearing_variance(ping, config)
    kind = ONE_WAY if ping.passive else PATH
    for at in range(1, int(node[-1]) + 1 if len(node) else 1):
        members = np.flatnonzero(node == at)
        parents = []
        for k in members.tolist():
            parents.append(len(table))
            path = speed * (ping.toa[usable[k]] - first)
            table.append((4 * at, -1, kind, path, variance[k], OUTLIER_DENSITY, int(usable[k])))
        for parent, row in zip(parents, usable[members].tolist()):
            if np.isfinite(ping.bearing[row]):
                entry = (BEARING, ping.bearing[row], var_bearing[row], 0.5 / np.pi)
                table.append((len(table) + 10**6, parent, *entry, row))
            if deep and np.isfinite(ping.elevation[row]) and ping.var_elevation[row] > 0.0:
                entry = (ELEVATION, ping.elevation[row], ping.var_elevation[row], 1.0 / np.pi)
                table.append((len(table) + 10**6, parent, *entry, row))
    columns = [np.array(column) for column in zip(*table)] if table else [np.empty(0)] * 7
    row = columns[6].astype(np.intp)
    numbers = Numbers(
        node=columns[0].astype(np.int64),
        parent=columns[1].astype(np.int64),
        kind=columns[2].astype(np.int64),
        value=columns[3].astype(np.float64),
        variance=columns[4].astype(np.float64),
        density=columns[5].astype(np.float64),
        tx=np.ascontiguousarray(ping.tx[row]),
        rx=np.ascontiguousarray(ping.rx[row]),
        columns=layout.columns(models, ping.rx_id[row], ping.passive),
    )
    return Ping(numbers, row, ping.passive, int(new.sum()))


def _depth_reports(ping: Arrivals, rows: IntArray) -> list[tuple[float, float, int]]:
    """The different depth reports of a ping: depth, variance and the first row of each. The same
    report stands beside every arrival; it is one measurement."""
    told: dict[tuple[float, float], int] = {}
    for row in rows.tolist():
        depth, variance = float(ping.depth[row]), float(ping.var_depth[row])
        if np.isfinite(depth) and variance > 0.0:
            told.setdefault((depth, variance), row)
    return [(*report, told[report]) for report in sorted(told)]


def update_by_ping(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    ping: Ping,
    config: DiverConfig,
    layout: Layout,
) -> PingUpdate | None:
    """One diver, x (M, n + q), P (M, n + q, n + q), mu (M,), updated by all of a ping; None where
    no model can be.

    Of more than `MOST_NUMBERS` those are used that are nearest to what is expected; the others
    are good where they fit what became of the diver.
    """
    if len(ping.row) > MOST_NUMBERS:
        _, nis = fit_numbers(x, P, mu, config.target_z, ping.numbers)
        keep = np.zeros(len(nis), bool)
        keep[np.argsort(nis, kind='stable')[:MOST_NUMBERS]] = True
        keep = ping.kept(keep)
        after = update_by_ping(x, P, mu, ping.only(keep), config, layout)
        if after is None:
            return None
        _, nis = fit_numbers(after.x, after.P, after.mu, config.target_z, ping.numbers)
        good = 1.0 / (1.0 + nis / GOOD_RESIDUAL**2)
        good[keep] = after.good
        return after._replace(good=good)
    n, numbers, mask = x.shape[-1], ping.numbers, layout.mask
    if ping.passive:
        x, P, mask = _with_emission(x, P, mu, ping, mask, config.target_z)
    if ping.passive or ping.pairs > MOST_SUBSETS:
        starts = optima(ping, config)
        after = student_t_ping(x, P, mask, config.target_z, numbers, starts, DEGREES)
        squared = (DEGREES + 1.0) / np.maximum(after[3], 1e-300) - DEGREES
        good = 1.0 / (1.0 + squared / GOOD_RESIDUAL**2)
    else:
        eps = config.outlier_probability
        after = subset_ping(x, P, mask, config.target_z, numbers, eps, MOST_EXPLANATIONS)
        good = after[3]
    with np.errstate(divide='ignore'):
        weight = np.log(mu) + after[2]
    best = weight.max(initial=-np.inf)
    if not np.isfinite(best):
        return None
    share = np.exp(weight - best)
    updated = share / share.sum()
    P = np.ascontiguousarray(after[1][:, :n, :n])
    repairs = add_jitter_all(P)
    return PingUpdate(
        np.ascontiguousarray(after[0][:, :n]),
        P,
        updated,
        updated @ good,
        float(best + np.log(share.sum())),
        repairs,
    )


def begin_from_ping(
    x: FloatArray,
    P: FloatArray,
    ping: Ping,
    position: FloatArray,
    config: DiverConfig,
    layout: Layout,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A new diver near `position` (2,): x (K, n + q), P (K, n + q, n + q), of which nothing is
    known of the position, updated by all the arrivals tell, also how the errors of position,
    depth and instruments go together; and the log-evidence (K,)."""
    n, mask = x.shape[-1], layout.mask
    if ping.passive:
        uniform = np.full(len(x), 1.0 / len(x))
        x, P, mask = _with_emission(x, P, uniform, ping, mask, config.target_z)
    at, covariance, evidence, _ = student_t_ping(
        x, P, mask, config.target_z, ping.numbers, position[None], DEGREES
    )
    covariance = np.ascontiguousarray(covariance[:, :n, :n])
    add_jitter_all(covariance)
    return at[:, :n], covariance, evidence


def residuals(
    x: FloatArray, P: FloatArray, mu: FloatArray, ping: Ping, height: float
) -> tuple[FloatArray, FloatArray, int]:
    """Residuals (C,) of a diver's numbers, the covariance (C, C) expected of them without their
    own variances, and how many of them are independent."""
    if ping.passive:
        x, P, _ = _with_emission(x, P, mu, ping, np.ones(x.shape[-1], bool), height)
    residual, covariance = expect_numbers(x, P, mu, height, ping.numbers)
    return residual, covariance, len(residual) - int(ping.passive)


def optima(ping: Ping, config: DiverConfig) -> FloatArray:
    """The best positions (k, 2) of the ping by itself, with heavy tails and no prior."""
    echo = ping.only(ping.echo).numbers
    columns = np.full_like(echo.columns, -1)
    columns[:, 0], columns[:, 1] = 0, 1
    if ping.passive:
        columns[:, EMISSION] = 2
    numbers = echo._replace(columns=columns)
    starts = _starts(numbers, ping.passive)
    size = 3 if ping.passive else 2
    mean = np.zeros(size)
    mean[:2] = numbers.rx[:, :2].mean(axis=0)
    spread = np.diag([FAR**2, FAR**2, (10.0 * FAR) ** 2][:size])
    height = float(np.mean(heights_of(config)))
    found, value = student_t_maxima(mean, spread, starts, numbers, height, DEGREES)
    kept: list[FloatArray] = []
    for k in np.argsort(-value, kind='stable'):
        place = found[k, :2]
        if all(np.hypot(*(place - one)) > DISTINCT for one in kept):
            kept.append(place)
        if len(kept) == OPTIMA:
            break
    return np.array(kept)


def _starts(numbers: Numbers, passive: bool) -> FloatArray:
    """Eleven positions (11, 2): round the earliest receivers, or round the ellipse of the shortest
    path."""
    order = np.argsort(numbers.value, kind='stable')
    if passive:
        near = numbers.rx[order[[0, min(1, len(order) - 1), min(2, len(order) - 1)]], :2]
        centre = near.mean(axis=0)
        reach = 20.0 + 0.5 * np.hypot(*(near - centre).T).max()
        angle = 2.0 * np.pi * np.arange(7) / 7.0
        ring = centre + reach * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.vstack([near, centre, ring])
    one = order[0]
    baseline = numbers.tx[one, :2] - numbers.rx[one, :2]
    apart = float(np.hypot(*baseline))
    path = max(float(numbers.value[one]), 1.0001 * apart + 1e-3)
    major = baseline / apart if apart > 0.0 else np.array([1.0, 0.0])
    minor = np.array([-major[1], major[0]])
    angle = 2.0 * np.pi * np.arange(11) / 11.0
    middle = 0.5 * (numbers.tx[one, :2] + numbers.rx[one, :2])
    along = 0.5 * path * np.cos(angle)[:, None] * major
    across = 0.5 * np.sqrt(path**2 - apart**2) * np.sin(angle)[:, None] * minor
    return middle + along + across


def _with_emission(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    ping: Ping,
    mask: BoolArray,
    height: float,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """x, P and mask with the emission of a tag as a last component, flat about where the arrivals
    put it."""
    M, n = x.shape
    wide, covariance = np.zeros((M, n + 1)), np.zeros((M, n + 1, n + 1))
    wide[:, :n], covariance[:, :n, :n] = x, P
    residual, _ = expect_residuals(wide, mu, height, ping.numbers)
    wide[:, n] = np.median(residual[ping.echo]) if ping.echo.any() else 0.0
    covariance[:, n, n] = EMISSION_STD**2
    return wide, covariance, np.append(mask, True)
