# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Association of arrivals with tracks, and the update by a ping.

For up to `MOST_SUBSETS` transmitter-receiver pairs, all inlier and outlier subsets of the echoes
are evaluated (`explanations`); for more pairs, `heavy_tails` is used, and for every ping of a tag:
with the unknown emission time, three or four receivers cannot reject a subset.

A track takes the measurements that its best explanation accepts, so association and update are one
step. All rows of a track are evaluated as one list of hypotheses, each a row and a model; borrowed
assumptions get a row first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import EMISSION
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import assign, association_cost, gate_threshold, TENTATIVE
from ...estimation.covariance import add_jitter
from ...estimation.rows import LEAST_LOG, restore_rows
from ...measurements import Arrivals, NOBODY
from . import coverage, offsets, ranges, sides
from .config import DiverConfig
from .coverage_map import Coverage, DetectionProbability
from .depth import replace_rows, respread_depths
from .explanations import (
    expect_measurements,
    expect_residuals,
    fit_measurements,
    joint_nis,
    MOST_EXPLANATIONS,
    PingMeasurements,
    subset_ping,
)
from .heavy_tails import DEGREES, inlier_probability, student_t_maxima, student_t_ping
from .instruments import Layout
from .known import Known
from .models import ModelSet, start_depths
from .scales import MIN_PUBLISHED_SCALE, scale_of, usual_assumptions
from .scan import MOST_MEASUREMENTS, Ping, ping_measurements, tag_id

MOST_SUBSETS = 6
"""Maximum number of received transmitter-receiver pairs for subsets."""

EMISSION_STD = 1e3
"""Prior standard deviation of a tag emission about the arrivals, m of path."""

FAR = 1e3
"""Standard deviation, m, of an unknown position about the receivers."""

OPTIMA = 3
"""Number of best positions of the ping alone from which models also start."""

DISTINCT = 1.0
"""Distance, m, within which two of these positions are equal."""

NEAR = 28.0
"""Maximum NIS of an echo of a track; beyond, its weight is negligible."""

TAKEN = 0.5
"""Minimum inlier probability of a measurement that a track takes."""

EVERYWHERE: Mapping[str, Coverage] = {}
"""No configured coverage."""

EXCLUDED = -1
"""Rank of a track that is not updated by a ping."""


class Mixture(NamedTuple):
    """L hypotheses of one track."""

    x: FloatArray
    """(L, n) states."""
    P: FloatArray
    """(L, n, n) covariances."""
    mu: FloatArray
    """(L,) probabilities."""
    scale: FloatArray
    """(L,) covariance scales."""

    @property
    def published_weights(self) -> FloatArray:
        """mu (L,), normalised over scales of at least `MIN_PUBLISHED_SCALE`."""
        mu = np.where(self.scale >= MIN_PUBLISHED_SCALE, self.mu, 0.0)
        total = mu.sum()
        return np.asarray(mu / total) if total > 0.0 else self.mu


class PingUpdate(NamedTuple):
    """A track after a ping."""

    after: Mixture
    """Updated hypotheses."""
    log: FloatArray
    """(L,) logarithms of their probabilities."""
    good: FloatArray
    """(C,) inlier probability of each measurement."""
    log_evidence: float
    """Log evidence of the ping, comparable between tracks."""
    repairs: int
    """Number of repaired covariances."""


class TrackUpdate(NamedTuple):
    """A track after its measurements of a ping."""

    after: PingUpdate
    good: BoolArray
    """(C,) True for measurements that the track takes."""
    nis: float
    """NIS of these measurements."""
    dof: int
    """Their degrees of freedom; 0 if there are too few."""


class Explanation(NamedTuple):
    """Association of a ping with T tracks."""

    updates: dict[int, TrackUpdate]
    """Updates by track index, in order of choice."""
    taken: BoolArray
    """(C,) True for measurements of any track."""
    score: FloatArray
    """(T,) new scores."""


# -- all tracks ----------------------------------------------------------------------------------


def associate_and_update(
    known: Known,
    ping: Arrivals,
    config: DiverConfig,
    models: ModelSet,
    covered: Mapping[str, Coverage] = EVERYWHERE,
) -> tuple[Known, BoolArray]:
    """Update the tracks by a ping, and return its free rows (n,). covered: coverage by sensor.

    A tag with an ID updates or starts a track of its own.
    """
    before, seen, where = known['nis_dof'], None, coverage.sensor_coverage(covered, '', config)
    if where is not None:
        seen = coverage.detection_probability(known, models, where, config.detection_probability)
    known, free = _associate_ping(known, ping, config, models, seen)
    if covered and config.fixes_are_scans and tag_id(ping) == NOBODY:
        missed = (known['nis_dof'] == before) & (known['target_id'] == NOBODY)
        all_moves = bool(known.memory['instruments'].layout(config, models).mask.all())
        known = coverage.apply_misses(known, models, seen, missed.astype(np.float64), all_moves)
    return known, free


def _associate_ping(
    known: Known,
    ping: Arrivals,
    config: DiverConfig,
    models: ModelSet,
    detected: DetectionProbability | None,
) -> tuple[Known, BoolArray]:
    """Update the tracks by received arrivals. detected: None for a constant probability."""
    name, rows, free = tag_id(ping), np.arange(len(ping)), np.ones(len(ping), bool)
    own = np.flatnonzero(known['target_id'] == name) if name != NOBODY else rows[:0]
    if name != NOBODY and not len(own):
        return known, free
    instruments = known.memory['instruments'].with_receivers(ping, config)
    layout = instruments.layout(config, models)
    number = known.memory['sensors'].number('')
    can = usual_assumptions(known.rows, known.borrowed, models.row_scales, number)
    table, borrowed = restore_rows(known.rows, known.borrowed, can)
    known = known.replace(rows=layout.rows_with_new_constants(table, models), borrowed=borrowed)
    known = known.with_memory(instruments=instruments)
    known, line = ranges.line_of(known, ping, config)
    seen = ping_measurements(ping, rows, config, models, layout)
    if not len(known) or seen.pairs <= int(ping.passive):
        return known, free & (name == NOBODY)
    known = respread_depths(known, seen, layout, models)
    known = sides.doubt_near_line(known, models, layout, line)
    mixtures = [track_mixture(known, track, models) for track in range(len(known))]
    if name != NOBODY:
        update = _update_track(mixtures[int(own[0])], seen, config, layout)
        updates = {} if update is None else {int(own[0]): update}
        known = apply_updates(known, updates, models, line)
        return _accumulate_residuals(known, updates, ping, seen, config, models), ~free
    explain = _explain_tag if ping.passive else _explain_echoes
    updates, taken, score = explain(known, mixtures, seen, config, layout)
    if detected is not None:
        looks = 1 if ping.passive else len(seen.nodes)
        score = score + looks * (np.log1p(-detected.tracks) - np.log1p(-detected.nominal))
    free[seen.row[taken & seen.echo]] = False
    free &= free.all() or not ping.passive  # all arrivals of a tag belong to one track
    known = apply_updates(known, updates, models, line).with_columns(score=score)
    return _accumulate_residuals(known, updates, ping, seen, config, models), free


def _accumulate_residuals(
    known: Known,
    updates: dict[int, TrackUpdate],
    ping: Arrivals,
    seen: Ping,
    config: DiverConfig,
    models: ModelSet,
) -> Known:
    """Update the test for instrument errors, from confirmed tracks."""
    took = {track: update.good for track, update in updates.items() if update.dof}
    axes = [0, 1] if models.height < 0 else [0, 1, models.height]
    at = {}
    for track in took:
        if known.life.status[track] != TENTATIVE:
            after = updates[track].after.after
            at[track] = after.x[after.mu.argmax(), axes]
    memory = known.memory['offsets'], known.memory['recent']
    found, recent = offsets.accumulate_residuals(*memory, at, took, ping, seen, config)
    return known.with_memory(offsets=found, recent=recent)


def track_mixture(known: Known, track: int, models: ModelSet) -> Mixture:
    """Return the hypotheses of a track, row by row."""
    rows = known.track_rows(track)
    x, P = models.to_common(rows.blocks)
    N, M, n = x.shape
    mu = rows.weight[:, None] * rows.mu
    scale = np.repeat(scale_of(rows.key, known.memory['sensors'].number('')), M)
    return Mixture(x.reshape(N * M, n), P.reshape(N * M, n, n), mu.ravel(), scale)


def apply_updates(
    known: Known, updates: dict[int, TrackUpdate], models: ModelSet, line: sides.Line | None = None
) -> Known:
    """Return the state with the updated tracks. line: that of all instruments, if there is one."""
    if not updates:
        return known
    nis, nis_dof, repairs = known['nis'].copy(), known['nis_dof'].copy(), 0
    rows, M = known.rows, len(models.names)
    for track, update in updates.items():
        after, own = update.after.after, known.row_indices(track)
        # In logarithms: likelihood ratios of rows can exceed e^700.
        n, log = after.x.shape[-1], update.after.log.reshape(-1, M)
        top = log.max(axis=1, keepdims=True)
        inside = np.exp(log - np.where(np.isfinite(top), top, 0.0))
        weight = inside.sum(axis=1, keepdims=True)
        inside = np.where(weight > 0.0, inside / np.where(weight > 0.0, weight, 1.0), rows.mu[own])
        blocks = models.to_blocks(after.x.reshape(-1, M, n), after.P.reshape(-1, M, n, n))
        with np.errstate(divide='ignore'):
            logw = np.maximum((top + np.log(weight))[:, 0], LEAST_LOG)
        rows = replace_rows(rows, own, blocks, inside, logw)
        nis[track] += update.nis
        nis_dof[track] += np.uint16(update.dof)
        repairs += update.after.repairs
    if line is not None and line.tells_nothing:
        rows = sides.with_sides_of(known.rows, rows)
    known = known.replace(rows=rows).with_columns(nis=nis, nis_dof=nis_dof)
    return sides.drop_sides(known.add_counts(repairs=repairs), models, line)


def _explain_echoes(
    known: Known,
    mixtures: Sequence[Mixture],
    ping: Ping,
    config: DiverConfig,
    layout: Layout,
) -> Explanation:
    """Associate the echoes of one transmission with tracks.

    Tracks that explain more pairs choose first, confirmed before tentative ones: a ghost fits only
    its own echoes. A track with fewer than half of the pairs is not updated.
    """
    # Track by track: many arrivals of many tracks at once take much memory.
    fits = [fit_measurements(*each[:3], config.target_z, ping.measured) for each in mixtures]
    fit, nis = (np.array(column) for column in zip(*fits))
    near = (nis < NEAR) & ping.echo
    pairs = [np.flatnonzero((ping.measured.node == node) & ping.echo) for node in ping.nodes]
    explained = np.sum([near[:, members].any(axis=1) for members in pairs], axis=0)
    rank = 2 * (len(pairs) - explained) + (known.life.status == TENTATIVE)
    explained_first, hits = _choose_by_rank(
        known, mixtures, ping, config, layout, rank, fit, near, pairs
    )
    doubtful = (hits > 0) & (2 * hits < len(pairs))
    if not doubtful.any():
        return explained_first
    rank = np.where(doubtful, EXCLUDED, rank)
    return _choose_by_rank(known, mixtures, ping, config, layout, rank, fit, near, pairs)[0]


def _choose_by_rank(
    known: Known,
    mixtures: Sequence[Mixture],
    ping: Ping,
    config: DiverConfig,
    layout: Layout,
    rank: IntArray,
    fit: FloatArray,
    near: BoolArray,
    pairs: list[IndexArray],
) -> tuple[Explanation, IntArray]:
    """Let tracks choose by `rank` (T,). Also return the number of pairs (T,) of each track."""
    p = config.detection_probability
    taken, hits = np.zeros(len(ping.row), bool), np.zeros(len(rank), np.int64)
    updates: dict[int, TrackUpdate] = {}
    score = known['score'] + len(pairs) * np.log1p(-p)
    gain = np.log(p / (1.0 - p)) - 0.5 * np.log(config.usual_clutter)
    for turn in np.unique(rank[rank != EXCLUDED]):
        tracks = np.flatnonzero(rank == turn)
        owner = _assign_owners(tracks, fit, near & ~taken, pairs, config)
        found = np.zeros(len(taken), bool)
        for track in tracks.tolist():
            mine = ping.without_orphans(~taken & ~found & ((owner < 0) | (owner == track)))
            index = np.flatnonzero(mine)
            update = _update_track(mixtures[track], ping.select(mine), config, layout)
            if update is not None:
                index = index[update.good]
                good = np.zeros(len(taken), bool)
                good[index] = True
                updates[track] = update._replace(good=good)
                found |= good
                echoes = index[ping.echo[index]]
                hits[track] = len(echoes)
                score[track] += fit[track, echoes].sum() + gain * len(echoes)
        taken |= found
    return Explanation(updates, taken, score), hits


def _assign_owners(
    tracks: IndexArray,
    fit: FloatArray,
    near: BoolArray,
    pairs: list[IndexArray],
    config: DiverConfig,
) -> IntArray:
    """Assign the echoes of each pair to tracks of equal rank.

    Return the track (C,), -1 for none.
    """
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
    known: Known,
    mixtures: Sequence[Mixture],
    ping: Ping,
    config: DiverConfig,
    layout: Layout,
) -> Explanation:
    """Associate the whole ping of a tag with one track.

    With `max_tracks: 1` the existing track takes every ping. Otherwise the best explanation inside
    the gate does if more than half of the arrivals fit, a confirmed track before a tentative one.
    """
    score = known['score'] + np.log1p(-config.detection_probability)
    tentative = known.life.status == TENTATIVE
    for turn in (~tentative, tentative):
        best = _best_for_tag(mixtures, np.flatnonzero(turn), ping, config, layout)
        if best is None:
            continue
        track, after = best
        update = make_track_update(mixtures[track], after, ping, config)
        fits = 2 * update.good.sum() > len(update.good)
        if fits or config.max_tracks == 1:
            score[track] += float(update.good.sum())
            return Explanation({track: update}, np.full(len(ping.row), fits), score)
    return Explanation({}, np.zeros(len(ping.row), bool), score)


def _best_for_tag(
    mixtures: Sequence[Mixture],
    tracks: IndexArray,
    ping: Ping,
    config: DiverConfig,
    layout: Layout,
) -> tuple[int, PingUpdate] | None:
    """Return the track that explains the ping of a tag best, and its update."""
    best: tuple[int, PingUpdate] | None = None
    for track in tracks.tolist():
        after = update_by_ping(mixtures[track], ping, config, layout)
        if after is None:
            continue
        if not (config.max_tracks == 1 or _is_reachable(mixtures[track], after.after, config)):
            continue
        if best is None or after.log_evidence > best[1].log_evidence:
            best = track, after
    return best


def _is_reachable(before: Mixture, after: Mixture, config: DiverConfig) -> bool:
    """Return whether the updated position is inside the gate of the prediction."""
    mean = before.mu @ before.x[:, :2]
    apart = before.x[:, :2] - mean
    covariance = np.einsum('l,lab->ab', before.mu, before.P[:, :2, :2])
    covariance += np.einsum('l,la,lb->ab', before.mu, apart, apart)
    gap = after.mu @ after.x[:, :2] - mean
    distance = float(gap @ np.linalg.solve(covariance, gap))
    return distance <= gate_threshold(config.gate_probability, 2)


# -- one track -----------------------------------------------------------------------------------


def _update_track(
    before: Mixture, ping: Ping, config: DiverConfig, layout: Layout
) -> TrackUpdate | None:
    """Update a track by its possible measurements; None if no model explains them."""
    after = update_by_ping(before, ping, config, layout) if ping.echo.any() else None
    return None if after is None else make_track_update(before, after, ping, config)


def make_track_update(
    before: Mixture, after: PingUpdate, ping: Ping, config: DiverConfig
) -> TrackUpdate:
    """Return the update of a track with its measurements and their NIS."""
    good = np.asarray(after.good > TAKEN)
    nis, dof = 0.0, 0
    if (good & ping.echo).sum() > int(ping.passive):
        own = ping.subsample(good)
        residual, covariance, dof = expected_residuals(before, own, config.target_z)
        nis = joint_nis(residual, covariance, own.measured.variance)
    return TrackUpdate(after, good, nis, dof)


def update_by_ping(
    before: Mixture, ping: Ping, config: DiverConfig, layout: Layout
) -> PingUpdate | None:
    """Update a track by a whole ping; None if no hypothesis is possible.

    Above `MOST_MEASUREMENTS`, use those nearest to the prediction and test the others.
    """
    if len(ping.row) > MOST_MEASUREMENTS:
        _, nis = fit_measurements(*before[:3], config.target_z, ping.measured)
        keep = np.zeros(len(nis), bool)
        keep[np.argsort(nis, kind='stable')[:MOST_MEASUREMENTS]] = True
        keep = ping.without_orphans(keep)
        found = update_by_ping(before, ping.select(keep), config, layout)
        if found is None:
            return None
        _, nis = fit_measurements(*found.after[:3], config.target_z, ping.measured)
        good = inlier_probability(nis)
        good[keep] = found.good
        return found._replace(good=good)
    x, P, mu, scale = before
    n, mask = x.shape[-1], layout.mask
    if ping.passive:
        x, P, mask = _with_emission(x, P, mu, ping, mask, config.target_z)
    measured = ping.measured
    if not (scale == 1.0).all():
        measured = measured._replace(variance=scale[:, None] * measured.variance)
    if ping.passive or ping.pairs > MOST_SUBSETS:
        heavy = measured, find_optima(ping, config), DEGREES, config.outlier_probability
        x, P, evidence, good = student_t_ping(x, P, mask, config.target_z, *heavy)
        # Jacobian of the scaled residuals.
        evidence = evidence - 0.5 * len(ping.row) * np.log(scale)
    else:
        subsets = config.outlier_probability, MOST_EXPLANATIONS
        x, P, evidence, good = subset_ping(x, P, mask, config.target_z, measured, *subsets)
    with np.errstate(divide='ignore'):
        weight = np.log(mu) + evidence
    best = weight.max(initial=-np.inf)
    if not np.isfinite(best):
        return None
    share = np.exp(weight - best)
    updated = share / share.sum()
    P, repairs = _repair(P[:, :n, :n])
    after = Mixture(x[:, :n].copy(), P, updated, scale)
    log_evidence = float(best + np.log(share.sum()))
    return PingUpdate(after, weight - log_evidence, updated @ good, log_evidence, repairs)


def _repair(P: FloatArray) -> tuple[FloatArray, int]:
    """Return covariances P (L, n, n) within the limits, and the number of repairs."""
    out, spoilt = add_jitter(P)
    return out, int((spoilt & np.isfinite(P).all(axis=(1, 2))).sum())


def begin_from_ping(
    x: FloatArray,
    P: FloatArray,
    ping: Ping,
    position: FloatArray,
    config: DiverConfig,
    layout: Layout,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return x (K, n + q), P (K, n + q, n + q) and log evidence (K,) of a new track near
    `position`.

    The prior of the position (2,) is flat. P includes correlations with depth and instrument
    errors.
    """
    n, mask = x.shape[-1], layout.mask
    if ping.passive:
        uniform = np.full(len(x), 1.0 / len(x))
        x, P, mask = _with_emission(x, P, uniform, ping, mask, config.target_z)
    heavy = ping.measured, position[None], DEGREES, config.outlier_probability
    at, covariance, evidence, _ = student_t_ping(x, P, mask, config.target_z, *heavy)
    return at[:, :n], _repair(covariance[:, :n, :n])[0], evidence


def expected_residuals(
    before: Mixture, ping: Ping, height: float
) -> tuple[FloatArray, FloatArray, int]:
    """Return residuals (C,), their prior covariance (C, C), and the degrees of freedom."""
    x, P, mu = before.x, before.P, before.published_weights
    if ping.passive:
        x, P, _ = _with_emission(x, P, mu, ping, np.ones(x.shape[-1], bool), height)
    residual, covariance = expect_measurements(x, P, mu, height, ping.measured)
    return residual, covariance, len(residual) - int(ping.passive)


def find_optima(ping: Ping, config: DiverConfig) -> FloatArray:
    """Return the best positions (k, 2) of the ping alone, with heavy tails and no prior."""
    echo = ping.select(ping.echo).measured
    columns = np.full_like(echo.columns, -1)
    columns[:, 0], columns[:, 1] = 0, 1
    if ping.passive:
        columns[:, EMISSION] = 2
    measured = echo._replace(columns=columns)
    starts = _start_positions(measured, ping.passive)
    size = 3 if ping.passive else 2
    mean = np.zeros(size)
    mean[:2] = measured.rx[:, :2].mean(axis=0)
    respread_depths = np.diag([FAR**2, FAR**2, (10.0 * FAR) ** 2][:size])
    height = float(np.mean(start_depths(config)))
    found, value = student_t_maxima(mean, respread_depths, starts, measured, height, DEGREES)
    kept: list[FloatArray] = []
    for k in np.argsort(-value, kind='stable'):
        place = found[k, :2]
        if all(np.hypot(*(place - other)) > DISTINCT for other in kept):
            kept.append(place)
        if len(kept) == OPTIMA:
            break
    return np.array(kept)


def _start_positions(measured: PingMeasurements, passive: bool) -> FloatArray:
    """Return (11, 2): around the earliest receivers, or on the ellipse of the shortest path."""
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
    """Append the emission of a tag to x, P and mask, with a flat prior."""
    M, n = x.shape
    wide, covariance = np.zeros((M, n + 1)), np.zeros((M, n + 1, n + 1))
    wide[:, :n], covariance[:, :n, :n] = x, P
    residual = expect_residuals(wide, mu, height, ping.measured)
    wide[:, n] = np.median(residual[ping.echo]) if ping.echo.any() else 0.0
    covariance[:, n, n] = EMISSION_STD**2
    return wide, covariance, np.append(mask, True)
