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

"""One filter for divers that swim steadily, briskly, turn about or drift, whatever their fixes
state: `model_set: families`.

Four families of models run in one interacting multiple model filter: `steady` and `brisk` (each
the `heading_speed` set, with a speed that is kept or changes within a minute), `lively` (two
constant-velocity models) and `quiet` (one). Inside a family the chain is as ever and learns. From
one family to another it goes rarely (`family_switch_rate`), or the families never separate; a
family that has become improbable is overwritten by the images of the others
(`family_kernels.mix`), and so is there when the diver changes.

The whole filter runs in copies that take the covariances of measurements so many times
(`covariance_scales`). They do not mix: what they say of the measurements weighs them.

Which fix may be a track's is not asked of a chi-square, but of the predictive density of the whole
mixture: it has to be more probable that the diver was seen there than that he was missed and the
fix is false. A name settles whose a fix is, never whether it is good. Two refused fixes in a row
that agree with each other begin the track anew, under its own identity (`reacquired`).

Source: docs/diver.md, 'Families'.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import NamedTuple

from attrs import evolve
import numpy as np

from ...estimation import imm, imm_kernels, jipda, markov
from ...estimation.adaptation import AdaptiveChain, Chain, Form
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import gate_threshold, TENTATIVE
from ...estimation.consider import consider_models
from ...estimation.motion import Motion, white_acceleration
from ...estimation.small_matrices import add_jitter_all
from ...measurements import NOBODY
from . import family_kernels
from .config import DiverConfig
from .coverage import Seen
from .family_kernels import HEADING, HOVER, Mixing, VELOCITY
from .fix_kernels import expected
from .scan import Positions
from .state import cross, DiverState
from .state_space import (
    as_stated,
    headings,
    initial_probabilities,
    Layout,
    LEAST_WEIGHT,
    ModelSet,
    rate_chain,
)

FAMILIES = ('steady', 'brisk', 'lively', 'quiet')

LIVELY, QUIET = (0.05, 0.6), (0.03,)
"""Acceleration noise of the constant velocities, m/s^2 over a reference step."""

LIVELY_STAY = 0.85
"""Probability of keeping the model of the lively family over a reference step."""

PACE_TIME = 60.0
"""Time within which a diver who stands forgets his pace, s, as `brisk` does: else who stands for
minutes is taken for one who swims at a crawl, and keeps to that when he goes on."""

SHARE = 5e-4
"""Share of the weight of the copies that is spread evenly over them with each scan, so that a
sensor which becomes worse is noticed."""

LOST = 0.02
"""A track whose misses in a row were less probable than this may be lost."""

MISTAKEN = 0.02
"""A false fix is expected beside another this often, at most, where two refused fixes that agree
begin a track anew."""

CONFIRMS, ENDS = 0.9, 0.002
"""Probability that a track is a diver above which hits confirm it, and below which it ends."""

REACH = 13.8
"""Mahalanobis distance squared within which a fix is beside another."""


# -- the models ----------------------------------------------------------------------------------


def with_velocities_at_fix(P: FloatArray, models: ModelSet, config: DiverConfig) -> None:
    """Give P (B, K M, n, n) of tracks that begin at a fix the velocities that such a track may
    have, in place."""
    if models.mixing is None:
        return
    moving = np.flatnonzero(np.tile(models.mixing.kind == VELOCITY, models.copies))
    P[:, moving, 2, 2] = P[:, moving, 3, 3] = config.velocity_std_at_fix**2


def families(config: DiverConfig, steady: ModelSet, brisk: ModelSet) -> ModelSet:
    """The four families, of which two are `heading_speed` sets with two noises of the speed."""
    noises = config.acceleration_noise or (*LIVELY, *QUIET)
    count, moving = len(steady.names), len(noises)
    family = np.repeat(np.arange(4), [count, count, len(LIVELY), len(QUIET)])
    M, T = len(family), config.reference_step
    units, _, _ = headings(config)
    place = np.arange(count)
    own = np.where(place < config.directions, HEADING, HOVER)
    kind = np.concatenate([own, own, np.full(moving, VELOCITY)])
    direction = np.where(place < config.directions, place, 0)
    direction = np.concatenate([direction, direction, np.zeros(moving, np.int64)])
    sector = (2.0 * np.pi / config.directions) ** 2 / 12.0
    speed = config.speed_mean, config.speed_std**2
    E = np.zeros((M, 4, 4))
    E[: 2 * count, :, :3] = np.concatenate([steady.E, brisk.E])
    E[2 * count :] = np.eye(4)
    hovers = np.flatnonzero(kind == HOVER)
    # A pace that is forgotten has the spread of `speed_std` in the end, or that of its own noise.
    noise = np.square([config.speed_noise, config.brisk_speed_noise])[: len(hovers)] / T
    forgotten = np.maximum(0.5 * PACE_TIME * noise, speed[1])

    def motion(dt: float) -> Motion:
        F, Q, B = np.zeros((M, 4, 4)), np.zeros((M, 4, 4)), np.zeros((M, 4))
        F[:] = np.eye(4)
        for first, models in ((0, steady), (count, brisk)):
            rows = slice(first, first + count)
            F[rows, :3, :3], Q[rows, :3, :3], _ = models.motion(dt)
        kept = math.exp(-dt / PACE_TIME)
        F[hovers, 2, 2], B[hovers, 2] = kept, (1.0 - kept) * speed[0]
        Q[hovers, 2, 2] = -math.expm1(-2.0 * dt / PACE_TIME) * forgotten
        F[2 * count :, :2, 2:] = dt * np.eye(2)
        for row, noise in enumerate(noises, start=2 * count):
            Q[row] = white_acceleration(noise**2 * T, 0.0, dt)
        return Motion(F, Q, B)

    start_mean, start_variance = np.zeros((M, 2)), np.full((M, 2), config.velocity_std**2)
    start_mean[: 2 * count, 0] = speed[0]
    start_variance[: 2 * count] = speed[1], 1.0
    if config.transition_matrix:
        chain = rate_chain(config, np.eye(M))
    else:
        both, plain = (steady, brisk), evolve(config, transition_matrix=())
        rates = markov.persistent(len(LIVELY), LIVELY_STAY)
        generators = [rate_chain(plain, models.chain.matrix).generator for models in both]
        generators += [markov.RateChain(rates, T).generator, np.zeros((len(QUIET), len(QUIET)))]
        generator = _between(family, generators, config.family_switch_rate)
        chain = markov.RateChain.of_generator(generator, T)
    if config.initial_probabilities:
        initial = initial_probabilities(config, M)
    else:
        initial = 0.25 / np.bincount(family)[family]
    # Copies of the models begin at heights where depth is a state; one thing at a time.
    scales = (1.0,) if config.dimensions == 3 else config.covariance_scales
    least = min(1.0, max(scales))
    stated = tuple(each >= least for each in scales)
    names = [f'{name}_{each}' for name in FAMILIES[:2] for each in steady.names]
    return ModelSet(
        (*names, 'lively_calm', 'lively_sharp', 'quiet'),
        np.tile(E, (len(scales), 1, 1)),
        chain,
        start_mean,
        start_variance,
        initial,
        motion,
        mixing=Mixing(family, kind, direction, units, *speed, sector),
        scales=scales,
        stated=stated,
    )


def _between(family: IntArray, blocks: list[FloatArray], rate: float) -> FloatArray:
    """The generator (M, M) of chains that go from each family to each other one at `rate` / 3,
    evenly to its models; between the first two the place in the family is kept."""
    size = np.bincount(family)
    out = np.asarray(rate / 3.0 / size[family][None] * (family[:, None] != family[None]))
    count = int(size[0])
    for a, b in ((0, 1), (1, 0)):
        kept = slice(a * count, (a + 1) * count), slice(b * count, (b + 1) * count)
        out[kept] = rate / 3.0 * np.eye(count)
    first = 0
    for block in blocks:
        own = slice(first, first + len(block))
        out[own, own] = block
        first += len(block)
    np.fill_diagonal(out, 0.0)
    np.fill_diagonal(out, -out.sum(axis=1))
    return out


class FamilyChain(AdaptiveChain):
    """An `AdaptiveChain` that learns inside each family, never between them."""

    def __init__(self, family: IntArray, chain: Chain, form: Form, **settings: float):
        super().__init__(chain, form, **settings)
        self.family = family

    def transition(self, learnt: FloatArray, dt: float) -> FloatArray:
        found = super().transition(learnt, dt)
        if self.form == 'fixed':
            return found
        return family_kernels.inside_families(found, self.chain.transition(dt), self.family)


# -- copies --------------------------------------------------------------------------------------


def shared(mu: FloatArray, models: ModelSet) -> FloatArray:
    """mu (T, K M) after a little of the weight of the copies is spread over them: over those that
    are `stated`, over the others, and over these two, so that what the stated ones weigh among
    themselves does not depend on the others."""
    if len(models.stated) == 1 or not len(mu):
        return mu
    stated = np.array(models.stated)
    each, weight = _each_copy(mu, len(stated))
    groups = [group for group in (stated, ~stated) if group.any()]
    for group in groups:
        total = weight[:, group].sum(axis=1, keepdims=True)
        after = (1.0 - SHARE) * total + SHARE / len(groups)
        own = (1.0 - SHARE) * weight[:, group] / total + SHARE / group.sum()
        weight[:, group] = after * own
    return np.asarray((each * weight[..., None]).reshape(mu.shape))


def _by_copy(mu: FloatArray, copies: int) -> FloatArray:
    """mu (T, K M) as (T, K, M)."""
    return mu.reshape(len(mu), copies, mu.shape[1] // copies)


def _each_copy(mu: FloatArray, copies: int) -> tuple[FloatArray, FloatArray]:
    """The probabilities (T, K, M) of the models in each copy, and the weights (T, K) of those."""
    mu = _by_copy(mu, copies)
    weight = mu.sum(axis=2)
    return mu / weight[..., None], weight


def scale(mu: FloatArray, models: ModelSet) -> FloatArray:
    """How many times what they state the covariances of measurements are, (T,), as the copies
    tell."""
    mu = as_stated(mu, np.array(models.stated))
    return np.asarray(_by_copy(mu, len(models.scales)).sum(axis=2) @ models.scales)


def positions(now: DiverState, models: ModelSet) -> tuple[FloatArray, FloatArray]:
    """Mean (T, q) and covariance (T, q, q) of what is published: where all copies say, and how far
    off that may be for those that are `stated`.

    Fixes that are better than stated look like fixes whose errors last. If they are as stated, the
    copy that says so is the optimal filter: its error is uncorrelated with all that is computed of
    the data, so that of the mean of all copies has its covariance and the square of how far the
    two are apart. If they are better, this is cautious.
    """
    mean, covariance = now.positions(models.E)
    if not all(models.stated):
        mu = as_stated(now.mu, np.array(models.stated))
        own, covariance = now._replace(mu=mu).positions(models.E)
        off = mean - own
        covariance = covariance + off[:, :, None] * off[:, None, :]
    return mean, covariance


class Densities(NamedTuple):
    """Logarithms of what D fixes are to T tracks: copies (T, K, D) in each copy, whole (T, D) in
    the mixture."""

    copies: FloatArray
    whole: FloatArray


def densities(
    now: DiverState, h: FloatArray, layout: Layout, z: FloatArray, R: FloatArray
) -> Densities:
    """The densities of fixes z (D, 2), R (D, 2, 2); h (T, K M, 2) expected."""
    copies = family_kernels.log_densities(h, layout.H, now.P, now.mu, z, R, layout.scales)
    _, weight = _each_copy(now.mu, len(layout.scales))
    log_weight = np.log(weight)[..., None]
    # Copy by copy: a scan of ten thousand fixes fills the memory otherwise.
    whole = copies[:, 0] + log_weight[:, 0]
    for k in range(1, copies.shape[1]):
        np.logaddexp(whole, copies[:, k] + log_weight[:, k], out=whole)
    return Densities(copies, whole)


def bound(fixes: Positions) -> float:
    """The logarithm of the density from which it is more probable that a diver was seen than that
    he was missed and the fix is false."""
    p = fixes.config.detection_probability
    return math.log(fixes.clutter) + math.log1p(-p) - math.log(p)


def fit(
    now: DiverState,
    fixes: Positions,
    expected: FloatArray,
    H: FloatArray,
    found: Densities | None,
    seen: Seen | None = None,
) -> FloatArray:
    """The log density (T, D) of each fix under each track, -inf where it cannot be its own: by the
    densities found, or by the gate of sets that have none. seen: how much more or less probable
    detections are than anywhere, see `coverage`."""
    ratio = 0.0 if seen is None else seen.log_ratio
    if found is not None:
        fit = found.whole + ratio
        return np.where(fit > bound(fixes), fit, -np.inf)
    threshold = gate_threshold(fixes.config.gate_probability, 2)
    return imm.gate(expected, H, now.P, now.mu, fixes.z, fixes.R, threshold) + ratio


def update(
    now: DiverState,
    fixes: Positions,
    tracks: IndexArray,
    detection: IntArray,
    h: FloatArray,
    layout: Layout,
    of_copies: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, np.ndarray, int]:
    """As `fix_kernels.update`, copy by copy; of_copies (T, K, D) as in `Densities`. The nis is
    that of the whole mixture, and stands in `now.white`."""
    K, t = len(layout.scales), len(tracks)
    M, n = now.x.shape[1] // K, now.x.shape[2]
    each, weight = _each_copy(now.mu[tracks], K)
    innovation = (fixes.z[detection][:, None] - h[tracks]).reshape(t * K, M, 2)
    R = (fixes.R[detection][:, None] * layout.scales[:, None, None]).reshape(t * K, 2, 2)
    x, P = now.x[tracks].reshape(t * K, M, n), now.P[tracks].reshape(t * K, M, n, n)
    mu, H = each.reshape(t * K, M), np.ascontiguousarray(layout.H[:, :M])
    if layout.mask.all():
        x, P, mu, _, _, ok, repaired = imm_kernels.update(x, P, mu, innovation, H, R)
        repairs = int(repaired.sum())
    else:
        x, P, mu, _, ok = consider_models(x, P, mu, innovation, H[0], R, layout.mask)
        repairs = sum(add_jitter_all(covariance) for covariance in P)
    weight = reweighed(weight, of_copies[tracks, :, detection])
    whole = now.x.copy(), now.P.copy(), now.mu.copy()
    for part, new in zip(whole, (x, P, mu.reshape(t, K, M) * weight[..., None])):
        part[tracks] = new.reshape(part[tracks].shape)
    hit = tracks[ok.reshape(t, K).all(axis=1)]
    nis, nis_dof = now.nis.copy(), now.nis_dof.copy()
    nis[hit] += np.square(now.white[hit]).sum(axis=1)
    nis_dof[hit] += np.uint16(2)
    return *whole, nis, nis_dof, repairs


def considered_update(
    now: DiverState,
    fixes: Positions,
    tracks: IndexArray,
    detection: IntArray,
    h: FloatArray,
    layout: Layout,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, np.ndarray, int]:
    """As `fix_kernels.update`, where the state holds constants that are only considered."""
    x, P, mu, nis, nis_dof = (part.copy() for part in (now.x, now.P, now.mu, now.nis, now.nis_dof))
    innovation = fixes.z[detection][:, None, :] - h[tracks]
    x1, P1, mu1, nis1, ok = consider_models(
        x[tracks], P[tracks], mu[tracks], innovation, layout.H[0], fixes.R[detection], layout.mask
    )
    repairs = sum(add_jitter_all(covariance) for covariance in P1)
    x[tracks], P[tracks], mu[tracks] = x1, P1, mu1
    nis[tracks] += np.where(ok, nis1, 0.0)
    nis_dof[tracks] += np.where(ok, 2, 0).astype(np.uint16)
    return x, P, mu, nis, nis_dof, repairs


def update_jointly(
    now: DiverState,
    fixes: Positions,
    h: FloatArray,
    layout: Layout,
    considered: BoolArray,
    beta: FloatArray,
    missed: FloatArray,
    found: Densities,
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """x, P, mu of all tracks and the covariances repaired, after fixes that are theirs with
    probabilities beta (T, D), or none with `missed` (T,): what each copy says of a fix shares that
    between the copies."""
    K = len(layout.scales)
    M = now.x.shape[1] // K
    each, weight = _each_copy(now.mu, K)
    x, P, mu, repairs = now.x.copy(), now.P.copy(), now.mu.copy(), 0
    shared_out = weight[..., None] * np.exp(found.copies - found.whole[:, None])
    for k, factor in enumerate(layout.scales):
        own = slice(k * M, (k + 1) * M)
        of_fixes = np.where(beta > 0.0, beta * shared_out[:, k], 0.0)
        of_none = missed * weight[:, k]
        x[:, own], P[:, own], mu[:, own], repaired = jipda.update(
            np.ascontiguousarray(now.x[:, own]),
            np.ascontiguousarray(now.P[:, own]),
            np.ascontiguousarray(each[:, k]),
            np.ascontiguousarray(h[:, own]),
            np.ascontiguousarray(layout.H[:, own]),
            fixes.z,
            fixes.R * factor,
            of_fixes,
            of_none,
            considered,
        )
        after = np.maximum(of_fixes.sum(axis=1) + of_none, LEAST_WEIGHT)
        mu[:, own] *= after[:, None]
        repairs += repaired
    return x, P, mu / mu.sum(axis=1, keepdims=True), repairs


def reweighed(weight: FloatArray, log_density: FloatArray) -> FloatArray:
    """The weights (t, K) of copies after measurements of `log_density` (t, K) in each."""
    log = np.log(weight) + np.where(np.isfinite(log_density), log_density, -1e300)
    new = np.maximum(np.exp(log - log.max(axis=1, keepdims=True)), LEAST_WEIGHT)
    return np.asarray(new / new.sum(axis=1, keepdims=True))


# -- lost tracks ---------------------------------------------------------------------------------


def reacquired(
    now: DiverState,
    fixes: Positions,
    hit: BoolArray,
    left: BoolArray,
    whole: FloatArray,
    models: ModelSet,
    chain: AdaptiveChain,
    layout: Layout,
    seen: Seen | None,
) -> tuple[DiverState, bool]:
    """What becomes of tracks that were not `hit` (T,) by a group of fixes of which some are `left`
    (D,), and whether one began anew; whole (T, D) as in `Densities`; seen: whoever
    is where the sensor does not see (`Seen.unseen`) may have done anything there.

    A fix that may have been a track's own and was not believed is remembered. One that agrees with
    it, as the next fix of a track that began at the first would, begins the track anew.
    """
    refused = now.refused
    if hit.any():
        refused = refused.copy()
        refused[hit] = np.nan
    begun: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = {}
    for track, row in _refusals(now, fixes, hit, left, whole):
        z, R = fixes.z[row], fixes.R[row]
        parts = None
        hidden = seen is not None and seen.unseen[track]
        lost = _reaches(now, track, z, fixes) if hidden else _may_be_lost(now, track, fixes)
        if np.isfinite(refused[track, 0]) and lost:
            parts = _anew(now, track, refused[track], z, R, fixes, models, chain, layout)
        refused = refused.copy()
        if parts is None:
            refused[track] = now.stamp_ns, *z, R[0, 0], R[0, 1], R[1, 1]
        else:
            begun[track], refused[track] = parts, np.nan
    if begun:
        x, P, mu = now.x.copy(), now.P.copy(), now.mu.copy()
        for track, parts in begun.items():
            x[track], P[track], mu[track] = parts
        now = now._replace(x=x, P=P, mu=mu)
    return now._replace(refused=refused), bool(begun)


def _refusals(
    now: DiverState, fixes: Positions, hit: BoolArray, left: BoolArray, whole: FloatArray
) -> Iterator[tuple[int, int]]:
    """Tracks, each with the fix that may have been its own: by the name, or the nearest of what
    confirmed tracks `left`, each to the track it is nearest to."""
    if fixes.target_id is not None:
        own = now.target_id[:, None] == fixes.target_id[None]
        for track, row in zip(*np.nonzero(own)):
            if not hit[track]:
                yield int(track), int(row)
        return
    waiting = np.flatnonzero(~hit & (now.life.status != TENTATIVE))
    rows = np.flatnonzero(left)
    if not len(waiting) or not len(rows):
        return
    near = whole[np.ix_(waiting, rows)]
    nearest = near.argmax(axis=0)
    for place, track in enumerate(waiting.tolist()):
        own = np.flatnonzero(nearest == place)
        if len(own):
            yield track, int(rows[own[near[place, own].argmax()]])


def _may_be_lost(now: DiverState, track: int, fixes: Positions) -> bool:
    """Whether so many misses in a row are improbable of a track that is where it should be."""
    if fixes.target_id is not None or not fixes.whole:
        return True
    missed = 1.0 - fixes.config.detection_probability
    # Who lives by his existence has no count of misses, but refused a fix before.
    before = max(int(now.life.misses[track]), 1)
    return bool(missed ** (before + 1) <= LOST)


def _reaches(now: DiverState, track: int, z: FloatArray, fixes: Positions) -> bool:
    """Whether the diver of a track may have come to z (2,) since he was seen."""
    mean = now.mu[track] @ now.x[track, :, :2]
    passed = (now.stamp_ns - int(now.life.last_hit_ns[track])) * 1e-9
    fastest = fixes.config.speed_mean + 3.0 * fixes.config.speed_std
    return bool(np.hypot(*(z - mean)) <= fastest * passed)


def _anew(
    now: DiverState,
    track: int,
    refused: FloatArray,
    z: FloatArray,
    R: FloatArray,
    fixes: Positions,
    models: ModelSet,
    chain: AdaptiveChain,
    layout: Layout,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """x, P and mu now of the track, had it begun at the fix that it `refused` (6,); None where the
    fix z (2,), R (2, 2) does not agree, or two false fixes may well do."""
    stamp, px, py, xx, xy, yy = refused.tolist()
    x, P, mu = models.new_tracks(np.array([[px, py]]), np.array([[[xx, xy], [xy, yy]]]))
    with_velocities_at_fix(P, models, fixes.config)
    x, P = layout.widened(x, P)
    row = np.arange(len(now.x)) == track
    alone = now.only(row)._replace(x=x, P=P, mu=mu)
    dt = max((now.stamp_ns - stamp) * 1e-9, 0.0)
    *_, last = cross(models, chain, alone, dt, fixes.config.longest_step)
    alone = alone._replace(x=last.x, P=last.P, mu=last.mu)
    h = expected(alone.x, layout.H)
    if densities(alone, h, layout, z[None], R[None]).whole[0, 0] <= bound(fixes):
        return None
    if fixes.target_id is None and fixes.config.max_tracks > 1:
        _, covariance = imm_kernels.combine(alone.x, alone.P, alone.mu, layout.H[0])
        area = math.pi * REACH * math.sqrt(np.linalg.det(covariance[0] + R))
        if fixes.clutter * area > MISTAKEN:
            return None
    return last.x[0], last.P[0], last.mu[0]


def doubtful(now: DiverState, config: DiverConfig) -> tuple[BoolArray, BoolArray]:
    """Which tentative tracks (T,) explain their fixes no better than clutter does, so that their
    hits do not confirm them, and which so badly that they end.

    A copy with large covariances takes what lies far away, so that hits alone mean little. The
    odds of a track are those of a new diver against a false fix, and what its fixes made of them.
    """
    odds = now.score + math.log(config.birth_density / config.usual_clutter)
    open_ = (now.life.status == TENTATIVE) & (now.target_id == NOBODY) & np.isnan(now.existence)
    return open_ & (odds < _log_odds(CONFIRMS)), open_ & (odds < _log_odds(ENDS))


def _log_odds(probability: float) -> float:
    return math.log(probability) - math.log1p(-probability)


def columns(mu: FloatArray, models: ModelSet) -> dict[str, FloatArray]:
    """What is published of families beside the probabilities of their models."""
    if models.mixing is None:
        return {}
    each = models.by_model(mu)
    family = np.eye(len(FAMILIES))[models.mixing.family]
    out = {f'family_{name}': each @ family[:, k] for k, name in enumerate(FAMILIES)}
    out['hover'] = each @ (models.mixing.kind == HOVER)
    out['covariance_scale'] = scale(mu, models)
    return out
