# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which echo is whose: the joint events of obstacles and the echoes of a ping.

Each echo in the gate of a track is one hypothesis of it, "none" is another. `compare` gives the
mixture after each of them and its density; the probabilities of all joint events
(`estimation.jipda`) weigh them, with

    g_ti = sum_c w_c s_c V_c N(z_i; h_c, S_c) / lambda(z_i),

V_c the probability that the beam holds component c, s_c what the misses since the last echo leave
of it (`existence`), and lambda the density of false echoes (`clutter`). `updated` matches the
hypotheses of each component in mean and covariance. That a ping has no echo of a track does not
weigh its components: what leaves the beam would excuse its own misses.

Source: docs/obstacle.md, section Tracks; Musicki and Evans 2004.
"""

from __future__ import annotations

import numpy as np

from ...estimation.arrays import (
    BoolArray,
    FloatArray,
    replace_rows,
    take,
)
from ...estimation.association import gate_threshold
from ...estimation.jipda import associate_classes
from . import mixtures
from .config import ObstacleConfig
from .existence import detection
from .filters import DepthSlices, Mixture
from .matches import Compared, Match
from .pings import default_variance, Met, Ping
from .scales import Scales, SURE
from .state import Known, Obstacles


def compare(
    table: Obstacles,
    ping: Ping,
    filter_: DepthSlices,
    met: Met | None,
    widest: tuple[float, float] = (0.0, 0.0),
) -> tuple[Compared, int]:
    """Return each obstacle beside the echoes in its gate, and how many covariances had to be
    repaired; met: in a ping that takes time, where it met these obstacles; widest: see
    `DepthSlices.visible`."""
    mixture, echoes, config = table.mixture, ping.echoes, filter_.config
    h, C = filter_.expected(mixture, ping.sonar, met and met.sonars)
    pose = ping.sonar.pose if met is None else met.poses
    V, ahead = filter_.visible(mixture, pose, widest)
    threshold = gate_threshold(config.gate_probability, 2)
    near = mixtures.gate(h, C, mixture.mu, echoes.z, echoes.R, threshold)
    t, i = np.nonzero(near)
    mine, before = echoes.rows(i), take(mixture, t)
    bodies, R = take(table.bodies, t).with_echoes(
        mine.extended, mine.z, mine.R, default_variance(config)
    )
    r, S = mine.z[:, None] - h[t], C[t] + R[:, None]
    mean, whole, nis = mixtures.innovations(before.mu, r, S)
    given, log, repairs = filter_.update(before, h[t], mine.z, R, ping.sonar)
    given, more = mine.update_height(given, pose if met is None else met.rows(t).poses, config)
    s = table.existence.since_hit(detected(table, filter_))
    held = (s * V).mean(axis=2)
    compared = Compared(
        t,
        i,
        given,
        log + more,
        (given.mu * held[t]).sum(axis=1),
        bodies,
        mean,
        np.diagonal(whole, axis1=1, axis2=2),
        nis,
        V,
        ahead,
    )
    return compared, repairs


def detected(table: Obstacles, filter_: DepthSlices) -> FloatArray:
    """Return the detection probability (T, C) of obstacles in the beam, by class."""
    mu, x = table.mixture.mu, table.mixture.x
    return detection(np.einsum('tk,tk->t', mu, x[..., 0]), filter_.config)


def ratios(compared: Compared, density: FloatArray, T: int) -> FloatArray:
    """Return g (T, D)."""
    g, echo = np.zeros((T, len(density))), compared.echo
    one = np.exp(np.minimum(compared.log, 600.0)) * compared.seen / density[echo]
    g[compared.target, echo] = one
    return g


def associate(
    table: Obstacles, compared: Compared, density: FloatArray, filter_: DepthSlices
) -> Match:
    """Return what the joint events of all tracks and echoes say."""
    T, existence = len(table.nis), table.existence
    g, p = ratios(compared, density, T), detected(table, filter_)
    visible = existence.visible(table.mixture.mu, compared.visible)
    beta, _, classes = associate_classes(g, g > 0.0, existence.classes, p, visible)
    hit = beta.sum(axis=1) > 0.5 * classes.sum(axis=1)
    pair = np.full(T, -1)
    own = beta[compared.target, compared.echo]
    order = np.argsort(own, kind='stable')
    pair[compared.target[order]] = order
    return Match(compared, density, p, beta, classes, hit, pair)


def updated(table: Obstacles, match: Match) -> Obstacles:
    """Return the obstacles after the ping."""
    T, (target, echo, given) = len(table.nis), match.compared[:3]
    existence = table.existence.with_ping(
        match.classes,
        match.beta.sum(axis=1),
        table.mixture.mu,
        match.compared.visible,
        match.detected,
    )
    nis = np.full(T, np.nan)
    hit = np.flatnonzero(match.hit)
    nis[hit] = match.compared.nis[match.pair[hit]]
    table = table._replace(existence=existence, nis=nis)
    if not len(target):
        return table
    share = match.beta[target, echo] / np.maximum(match.classes.sum(axis=1)[target], 1e-300)
    which, place = np.unique(target, return_inverse=True)
    mixture = Mixture(*mixtures.combine(*take(table.mixture, which), given, place, share))
    return table._replace(
        mixture=replace_rows(table.mixture, which, mixture),
        bodies=replace_rows(table.bodies, hit, take(match.compared.bodies, match.pair[hit])),
    )


def claims(
    table: Obstacles, compared: Compared, density: FloatArray, filter_: DepthSlices
) -> FloatArray:
    """Return how much more (D,) echoes are expected where they are than false ones alone."""
    if not len(compared.target):
        return np.zeros(len(density))
    existence, mu = table.existence, table.mixture.mu
    seen = existence.classes * detected(table, filter_)
    missed = 1.0 - (seen * existence.visible(mu, compared.visible)).sum(axis=1)
    odds = seen.sum(axis=1) / np.maximum(missed, 1e-9)
    return np.asarray(odds @ ratios(compared, density, len(seen)))


def learnt(
    known: Known, ping: Ping, moves: BoolArray, config: ObstacleConfig
) -> tuple[FloatArray, Scales]:
    """Return the innovations (T, 2) of hits that are surely the obstacle's, in standard
    deviations, NaN for others, and what they say of the variances."""
    table, match = known.obstacles, ping.match
    last = np.full(table.last.shape, np.nan)
    moving = table.mixture.mu[:, moves].sum(axis=1) > 0.5
    which = np.flatnonzero(match.hit & known.confirmed & ~moving)
    pair, compared = match.pair[which], match.compared
    sure = match.beta[which, compared.echo[pair]] > SURE
    which, pair = which[sure], pair[sure]
    last[which] = compared.innovation[pair] / np.sqrt(compared.variance[pair])
    stated = ping.echoes.stated[compared.echo[pair]]
    return last, known.scales.after(last[which], table.last[which], stated, config)
