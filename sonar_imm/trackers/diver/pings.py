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

"""What becomes of the divers by a ping: which measurements are whose, and the update by them.

Echoes of up to `MOST_SUBSETS` transmitter-receiver pairs are explained by all their inlier and
outlier subsets (`explanations`), more of them by `heavy_tails`. So are the arrivals of a tag,
however few: its time of emission is unknown, so that among three or four receivers no subset is
refuted by the others, and what decides is whether the whole lies where the ping by itself would
put it.

A track takes the measurements that its best explanation calls good. So association and update are
one step here: an `Explanation` says what each track that takes part becomes, and
`with_takings` is the state in which that has happened.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import EMISSION
from ...acoustics.multistatic import difference_projection
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import assign, association_cost, gate_threshold, TENTATIVE
from ...estimation.covariance import add_jitter, is_psd
from ...measurements import Arrivals, NOBODY
from . import coverage, offsets
from .config import DiverConfig
from .explanations import (
    expect_measurements,
    expect_residuals,
    fit_each,
    fit_measurements,
    MOST_EXPLANATIONS,
    PingMeasurements,
    subset_ping,
)
from .heavy_tails import DEGREES, student_t_maxima, student_t_ping
from .heights import spread
from .scan import MOST_MEASUREMENTS, name_of, Ping, ping_measurements
from .state import ARRIVALS, DiverState, learnt_scale
from .state_space import as_stated, each_kept, heights_of, Layout, ModelSet

MOST_SUBSETS = 6
"""Most transmitter-receiver pairs heard whose subsets are all tried."""

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
"""Metres within which two of them are the same."""

NEAR = 28.0
"""NIS of an echo that may be a track's: beyond, it weighs less than the least explanation kept by
`explanations`."""

TAKEN = 0.5
"""Probability of being good from which a measurement counts as a track's."""

EVERYWHERE: Mapping[str, coverage.Coverage] = {}
"""Nothing is stated of what a sensor covers."""

EXCLUDED = -1
"""Rank of a track that takes no part in a message."""

Mixture = tuple[FloatArray, FloatArray, FloatArray]
"""x (M, n), P (M, n, n) and mu (M,) of one diver."""


class PingUpdate(NamedTuple):
    """A diver after a ping: x (M, n), P (M, n, n), mu (M,); good (C,): how sure each measurement
    is this diver's; log_evidence, comparable between divers of the same ping; repairs: covariances
    repaired (`estimation.covariance`)."""

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    good: FloatArray
    log_evidence: float
    repairs: int


class Taking(NamedTuple):
    """What a track becomes by the measurements of a ping that it takes: after; good (C,): those;
    nis of dof of them, 0 for too few; residual (m,), covariance and stated (m, m): of the
    arrivals, to learn their scale, None where that is not asked."""

    after: PingUpdate
    good: BoolArray
    nis: float
    dof: int
    scale: tuple[FloatArray, FloatArray, FloatArray] | None


class Explanation(NamedTuple):
    """What a ping is to the tracks: takings by track, in the order in which they chose; taken
    (C,): the measurements that are a track's; score (T,)."""

    takings: dict[int, Taking]
    taken: BoolArray
    score: FloatArray


# -- all tracks ----------------------------------------------------------------------------------


def associate_and_update(
    now: DiverState,
    ping: Arrivals,
    config: DiverConfig,
    factor: float,
    models: ModelSet,
    covered: Mapping[str, coverage.Coverage] = EVERYWHERE,
) -> tuple[DiverState, BoolArray]:
    """The tracks after a ping, `factor` on the variances of its arrival times, and the rows (n,)
    that are no track's; covered: what is stated of sensors. A tag whose name is known has a track
    of its own or begins one."""
    before, seen = now.nis_dof, coverage.detectable(covered, '', now, config)
    now, free = _by_ping(now, ping, config, factor, models, seen)
    if covered and config.fixes_are_scans and name_of(ping) == NOBODY:
        share = (now.nis_dof == before) & (now.target_id == NOBODY)
        mask = now.instruments.layout(config, models).mask
        now = coverage.missed(now, seen, share.astype(np.float64), mask)
    return now, free


def _by_ping(
    now: DiverState,
    ping: Arrivals,
    config: DiverConfig,
    factor: float,
    models: ModelSet,
    detected: coverage.Seen | None,
) -> tuple[DiverState, BoolArray]:
    """`associate_and_update` of what was heard; detected: None where that is equally probable."""
    name, rows, free = name_of(ping), np.arange(len(ping)), np.ones(len(ping), bool)
    own = np.flatnonzero(now.target_id == name) if name != NOBODY else rows[:0]
    if name != NOBODY and not len(own):
        return now, free
    instruments = now.instruments.with_receivers(ping, config)
    layout = instruments.layout(config, models)
    x, P = layout.widened(now.x, now.P)
    now = now._replace(x=x, P=P, instruments=instruments)
    seen = ping_measurements(ping, rows, config, factor, models, layout)
    if not len(x) or seen.pairs <= int(ping.passive):
        return now, free & (name == NOBODY)
    now = spread(now, seen, layout, models)
    if name != NOBODY:
        taking = _taking(now, int(own[0]), seen, config, layout, factor)
        takings = {} if taking is None else {int(own[0]): taking}
        return _watched(with_takings(now, takings), takings, ping, seen, config, models), ~free
    explain = _explain_tag if ping.passive else _explain_echoes
    takings, taken, score = explain(now, seen, config, layout, factor)
    if detected is not None:
        looks = 1 if ping.passive else len(seen.nodes)
        score = score + looks * (np.log1p(-detected.tracks) - np.log1p(-detected.usual))
    free[seen.row[taken & seen.echo]] = False
    free &= free.all() or not ping.passive  # a tag's are of one track, also those not used
    now = _watched(with_takings(now, takings), takings, ping, seen, config, models)
    return now._replace(score=score), free


def _watched(
    now: DiverState,
    takings: dict[int, Taking],
    ping: Arrivals,
    seen: Ping,
    config: DiverConfig,
    models: ModelSet,
) -> DiverState:
    """With what the ping says of errors that last, by the confirmed tracks that took of it."""
    took = {track: taking.good for track, taking in takings.items() if taking.dof}
    axes = [0, 1] if models.height < 0 else [0, 1, models.height]
    at = {t: now.x[t, now.mu[t].argmax(), axes] for t in took if now.life.status[t] != TENTATIVE}
    return now._replace(offsets=offsets.watched(now.offsets, at, took, ping, seen, config))


def with_takings(now: DiverState, takings: dict[int, Taking]) -> DiverState:
    """The state in which tracks have taken what they take."""
    if not takings:
        return now
    x, P, mu = now.x.copy(), now.P.copy(), now.mu.copy()
    nis, nis_dof, scale, repairs = now.nis.copy(), now.nis_dof.copy(), now.scale, now.repairs
    for track, taking in takings.items():
        x[track], P[track], mu[track] = taking.after.x, taking.after.P, taking.after.mu
        nis[track] += taking.nis
        nis_dof[track] += np.uint16(taking.dof)
        repairs += taking.after.repairs
        if taking.scale is not None:
            scale = learnt_scale(scale, ARRIVALS, *(part[None] for part in taking.scale))
    return now._replace(x=x, P=P, mu=mu, nis=nis, nis_dof=nis_dof, scale=scale, repairs=repairs)


def _mixture(now: DiverState, track: int) -> Mixture:
    return now.x[track], now.P[track], now.mu[track]


def _explain_echoes(
    now: DiverState, ping: Ping, config: DiverConfig, layout: Layout, factor: float
) -> Explanation:
    """Which tracks take which echoes of one transmission.

    Tracks that can explain more of the pairs choose first, and among those the confirmed ones: a
    ghost fits the echoes it was made of, but only those. A track that ends up with fewer than half
    of the pairs is not what the ping shows; for it nothing happened.
    """
    T, M, n = now.x.shape
    each = now.x.reshape(-1, n), now.P.reshape(-1, n, n)
    likelihood, nis = fit_each(*each, config.target_z, ping.measured)
    fit = np.log(np.maximum((now.mu[:, None] @ likelihood.reshape(T, M, -1))[:, 0], 1e-300))
    near = (nis.reshape(T, M, -1).min(axis=1) < NEAR) & ping.echo
    pairs = [np.flatnonzero((ping.measured.node == node) & ping.echo) for node in ping.nodes]
    explained = np.sum([near[:, members].any(axis=1) for members in pairs], axis=0)
    rank = 2 * (len(pairs) - explained) + (now.life.status == TENTATIVE)
    first, hits = _by_rank(now, ping, config, layout, factor, rank, fit, near, pairs)
    doubtful = (hits > 0) & (2 * hits < len(pairs))
    if not doubtful.any():
        return first
    rank = np.where(doubtful, EXCLUDED, rank)
    return _by_rank(now, ping, config, layout, factor, rank, fit, near, pairs)[0]


def _by_rank(
    now: DiverState,
    ping: Ping,
    config: DiverConfig,
    layout: Layout,
    factor: float,
    rank: IntArray,
    fit: FloatArray,
    near: BoolArray,
    pairs: list[IndexArray],
) -> tuple[Explanation, IntArray]:
    """Let the tracks choose by `rank` (T,); also how many pairs each track (T,) took one of."""
    p = config.detection_probability
    taken, hits = np.zeros(len(ping.row), bool), np.zeros(len(rank), np.int64)
    takings: dict[int, Taking] = {}
    score = now.score + len(pairs) * np.log1p(-p)
    gain = np.log(p / (1.0 - p))
    gain -= 0.5 * np.log(config.usual_clutter)
    for turn in np.unique(rank[rank != EXCLUDED]):
        tracks = np.flatnonzero(rank == turn)
        owner = _owners(tracks, fit, near & ~taken, pairs, config)
        found = np.zeros(len(taken), bool)
        for track in tracks.tolist():
            mine = ping.kept(~taken & ~found & ((owner < 0) | (owner == track)))
            index = np.flatnonzero(mine)
            taking = _taking(now, track, ping.only(mine), config, layout, factor)
            if taking is not None:
                index = index[taking.good]
                good = np.zeros(len(taken), bool)
                good[index] = True
                takings[track] = taking._replace(good=good)
                found |= good
                echoes = index[ping.echo[index]]
                hits[track] = len(echoes)
                score[track] += fit[track, echoes].sum() + gain * len(echoes)
        taken |= found
    return Explanation(takings, taken, score), hits


def _owners(
    tracks: IndexArray,
    fit: FloatArray,
    near: BoolArray,
    pairs: list[IndexArray],
    config: DiverConfig,
) -> IntArray:
    """The track each measurement (C,) is kept for, -1 for none: where several tracks choose at
    once, each pair's echoes are assigned from the prediction."""
    owner = np.full(fit.shape[1], -1)
    if len(tracks) > 1:
        for members in pairs:
            inside = near[np.ix_(tracks, members)]
            target, detection = np.nonzero(inside)
            likelihood = fit[np.ix_(tracks, members)][target, detection]
            cost = association_cost(
                likelihood, config.detection_probability, math.sqrt(config.usual_clutter)
            )
            chosen = assign(target, detection, cost, len(tracks), len(members))
            hit = np.flatnonzero(chosen >= 0)
            owner[members[chosen[hit]]] = tracks[hit]
    return owner


def _explain_tag(
    now: DiverState, ping: Ping, config: DiverConfig, layout: Layout, factor: float
) -> Explanation:
    """Which track takes a tag's ping, all of it.

    A single diver known to be there is given every ping. Otherwise it is the track that explains
    the ping best of those that need not jump for it. Confirmed tracks come first; others are asked
    where less than half of the arrivals fit the one chosen.
    """
    score = now.score + np.log1p(-config.detection_probability)
    takings: dict[int, Taking] = {}
    tentative = now.life.status == TENTATIVE
    for turn in (~tentative, tentative):
        best = _best_for_tag(now, np.flatnonzero(turn), ping, config, layout)
        if best is not None:
            track, after = best
            taking = taking_of(_mixture(now, track), after, ping, config, layout, factor)
            takings[track] = taking
            score[track] += float(taking.good.sum())
            if 2 * taking.good.sum() >= len(taking.good):
                return Explanation(takings, np.ones(len(ping.row), bool), score)
    return Explanation(takings, np.zeros(len(ping.row), bool), score)


def _best_for_tag(
    now: DiverState, tracks: IndexArray, ping: Ping, config: DiverConfig, layout: Layout
) -> tuple[int, PingUpdate] | None:
    """Which of `tracks` explains a tag's ping best, and what becomes of it."""
    best: tuple[int, PingUpdate] | None = None
    for track in tracks.tolist():
        before = _mixture(now, track)
        after = update_by_ping(*before, ping, config, layout)
        if after is None or not (config.max_tracks == 1 or _allowed(before, after, config)):
            continue
        if best is None or after.log_evidence > best[1].log_evidence:
            best = track, after
    return best


def _allowed(before: Mixture, after: PingUpdate, config: DiverConfig) -> bool:
    """Whether the diver after a ping is where the prediction allows it to be."""
    (mean, covariance), (there, _) = _place(*before), _place(after.x, after.P, after.mu)
    gap = there - mean
    distance = float(gap @ np.linalg.solve(covariance, gap))
    return distance <= gate_threshold(config.gate_probability, 2)


def _place(x: FloatArray, P: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean (2,) and covariance (2, 2) of the position of a mixture."""
    mean = mu @ x[:, :2]
    apart = x[:, :2] - mean
    return mean, np.tensordot(mu, P[:, :2, :2], 1) + (apart.T * mu) @ apart


# -- one track -----------------------------------------------------------------------------------


def _taking(
    now: DiverState, track: int, ping: Ping, config: DiverConfig, layout: Layout, factor: float
) -> Taking | None:
    """What a track takes of the measurements it may have; None where no model can explain them."""
    before = _mixture(now, track)
    after = update_by_ping(*before, ping, config, layout) if ping.echo.any() else None
    return None if after is None else taking_of(before, after, ping, config, layout, factor)


def taking_of(
    before: Mixture,
    after: PingUpdate,
    ping: Ping,
    config: DiverConfig,
    layout: Layout,
    factor: float,
) -> Taking:
    """What a track takes, `before` it and after."""
    good = np.asarray(after.good > TAKEN)
    nis, dof, scale = 0.0, 0, None
    if (good & ping.echo).sum() > int(ping.passive):
        own = ping.compared(good)
        x, P, mu = before
        mu = as_stated(mu, layout.stated)
        residual, covariance, dof = residuals(x, P, mu, own, config.target_z)
        nis = _joint_nis(residual, covariance, own.measured.variance)
    if config.estimate_covariance_scale and (good & ping.echo).any():
        own = ping.compared(good & ping.echo)
        scale = _for_scale(after, as_stated(after.mu, layout.stated), own, config, factor)
    return Taking(after, good, nis, dof, scale)


def _joint_nis(residual: FloatArray, covariance: FloatArray, variance: FloatArray) -> float:
    """``residual' S^-1 residual``, ``S = covariance + diag(variance)``; variance (C,).

    Beside what is expected of exact arrivals after a long silence their own variances are lost in
    rounding, and S can have no inverse. Its eigenvalues in units of the variances are 1 at least.
    """
    S = covariance + np.diag(variance)
    if is_psd(S) or not np.isfinite(S).all():
        return float(residual @ np.linalg.solve(S, residual))
    weight = 1.0 / np.sqrt(variance)
    values, vectors = np.linalg.eigh(weight[:, None] * covariance * weight)
    whitened = vectors.T @ (weight * residual)
    return float((whitened**2 / (1.0 + np.maximum(values, 0.0))).sum())


def _for_scale(
    after: PingUpdate, mu: FloatArray, ping: Ping, config: DiverConfig, factor: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Residuals of the arrivals that a track took, their covariance and what is stated of it."""
    residual, covariance, dof = residuals(after.x, after.P, mu, ping, config.target_z)
    stated = np.diag(ping.measured.variance / factor)
    if ping.passive and dof:
        # The emission is unknown: differences, whitened by what is stated.
        projection = difference_projection(ping.measured.variance / factor)
        residual, stated = projection @ residual, np.eye(dof)
        covariance = projection @ covariance @ projection.T
    return (residual, covariance, stated) if dof else None


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

    Of more than `MOST_MEASUREMENTS` those are used that are nearest to what is expected; the
    others are good where they fit what became of the diver.
    """
    if len(ping.row) > MOST_MEASUREMENTS:
        _, nis = fit_measurements(x, P, mu, config.target_z, ping.measured)
        keep = np.zeros(len(nis), bool)
        keep[np.argsort(nis, kind='stable')[:MOST_MEASUREMENTS]] = True
        keep = ping.kept(keep)
        after = update_by_ping(x, P, mu, ping.only(keep), config, layout)
        if after is None:
            return None
        _, nis = fit_measurements(after.x, after.P, after.mu, config.target_z, ping.measured)
        good = 1.0 / (1.0 + nis / GOOD_RESIDUAL**2)
        good[keep] = after.good
        return after._replace(good=good)
    n, mask = x.shape[-1], layout.mask
    if ping.passive:
        x, P, mask = _with_emission(x, P, mu, ping, mask, config.target_z)
    measured, scale = _scaled(ping.measured, len(x), layout)
    if ping.passive or ping.pairs > MOST_SUBSETS:
        heavy = measured, optima(ping, config), DEGREES
        x, P, evidence, weights = student_t_ping(x, P, mask, config.target_z, *heavy)
        # The densities of scaled residuals are those of the residuals but for this.
        evidence = evidence - 0.5 * len(ping.row) * np.log(scale)
        squared = (DEGREES + 1.0) / np.maximum(weights, 1e-300) - DEGREES
        good = 1.0 / (1.0 + squared / GOOD_RESIDUAL**2)
    else:
        subsets = measured, config.outlier_probability, MOST_EXPLANATIONS
        x, P, evidence, good = subset_ping(x, P, mask, config.target_z, *subsets)
    with np.errstate(divide='ignore'):
        weight = np.log(mu) + evidence
    best = weight.max(initial=-np.inf)
    if not np.isfinite(best):
        return None
    share = np.exp(weight - best)
    updated = each_kept(weight - best, share / share.sum(), len(layout.scales))
    P, repairs = _repaired(P[:, :n, :n])
    log_evidence = float(best + np.log(share.sum()))
    return PingUpdate(x[:, :n].copy(), P, updated, updated @ good, log_evidence, repairs)


def _scaled(
    measured: PingMeasurements, hypotheses: int, layout: Layout
) -> tuple[PingMeasurements, FloatArray]:
    """Return measurements with the variances that each of the hypotheses, copy by copy, takes
    them to have, and by what each (L,) multiplies them."""
    scale = np.repeat(layout.scales, hypotheses // len(layout.scales))
    if (scale == 1.0).all():
        return measured, scale
    return measured._replace(variance=scale[:, None] * measured.variance), scale


def _repaired(P: FloatArray) -> tuple[FloatArray, int]:
    """Return covariances P (L, n, n) that keep to the limit, and how many did not."""
    out, repaired = add_jitter(P)
    return out, int((repaired & np.isfinite(P).all(axis=(1, 2))).sum())


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
        x, P, mask, config.target_z, ping.measured, position[None], DEGREES
    )
    return at[:, :n], _repaired(covariance[:, :n, :n])[0], evidence


def residuals(
    x: FloatArray, P: FloatArray, mu: FloatArray, ping: Ping, height: float
) -> tuple[FloatArray, FloatArray, int]:
    """Residuals (C,) of a diver's measurements, the covariance (C, C) expected of them without
    their own variances, and how many of them are independent."""
    if ping.passive:
        x, P, _ = _with_emission(x, P, mu, ping, np.ones(x.shape[-1], bool), height)
    residual, covariance = expect_measurements(x, P, mu, height, ping.measured)
    return residual, covariance, len(residual) - int(ping.passive)


def optima(ping: Ping, config: DiverConfig) -> FloatArray:
    """The best positions (k, 2) of the ping by itself, with heavy tails and no prior."""
    echo = ping.only(ping.echo).measured
    columns = np.full_like(echo.columns, -1)
    columns[:, 0], columns[:, 1] = 0, 1
    if ping.passive:
        columns[:, EMISSION] = 2
    measured = echo._replace(columns=columns)
    starts = _starts(measured, ping.passive)
    size = 3 if ping.passive else 2
    mean = np.zeros(size)
    mean[:2] = measured.rx[:, :2].mean(axis=0)
    spread = np.diag([FAR**2, FAR**2, (10.0 * FAR) ** 2][:size])
    height = float(np.mean(heights_of(config)))
    found, value = student_t_maxima(mean, spread, starts, measured, height, DEGREES)
    kept: list[FloatArray] = []
    for k in np.argsort(-value, kind='stable'):
        place = found[k, :2]
        if all(np.hypot(*(place - other)) > DISTINCT for other in kept):
            kept.append(place)
        if len(kept) == OPTIMA:
            break
    return np.array(kept)


def _starts(measured: PingMeasurements, passive: bool) -> FloatArray:
    """Eleven positions (11, 2): round the earliest receivers, or round the ellipse of the shortest
    path."""
    order = np.argsort(measured.value, kind='stable')
    if passive:
        near = measured.rx[order[[0, min(1, len(order) - 1), min(2, len(order) - 1)]], :2]
        centre = near.mean(axis=0)
        reach = 20.0 + 0.5 * np.hypot(*(near - centre).T).max()
        angle = 2.0 * np.pi * np.arange(7) / 7.0
        ring = centre + reach * np.column_stack([np.cos(angle), np.sin(angle)])
        return np.vstack([near, centre, ring])
    early = order[0]
    baseline = measured.tx[early, :2] - measured.rx[early, :2]
    apart = float(np.hypot(*baseline))
    path = max(float(measured.value[early]), 1.0001 * apart + 1e-3)
    major = baseline / apart if apart > 0.0 else np.array([1.0, 0.0])
    minor = np.array([-major[1], major[0]])
    angle = 2.0 * np.pi * np.arange(11) / 11.0
    middle = 0.5 * (measured.tx[early, :2] + measured.rx[early, :2])
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
    residual = expect_residuals(wide, mu, height, ping.measured)
    wide[:, n] = np.median(residual[ping.echo]) if ping.echo.any() else 0.0
    covariance[:, n, n] = EMISSION_STD**2
    return wide, covariance, np.append(mask, True)
