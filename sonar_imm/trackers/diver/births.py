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

"""Where new divers may be, and how a track begins there.

A track begins at a fix that no track took, at a position that the free rows of a ping can explain,
or where somebody says that a diver is. Such a start is no measurement: it is believed, so its
track is confirmed at once. Tracks without a name that it agrees with give way to it, or the diver
would have two; with a single diver, all do.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice, product
import math
from typing import NamedTuple

from attrs import evolve
import numpy as np

from ...acoustics import multistatic
from ...acoustics.localisation import Localisation, localise
from ...estimation.arrays import BoolArray, FloatArray, IndexArray
from ...estimation.association import CONFIRMED, gate_threshold, TENTATIVE
from ...measurements import Arrivals, NOBODY, Start
from . import families
from .config import DiverConfig
from .heights import begin
from .pings import begin_from_ping, FAR
from .scan import (
    bearing_variance,
    Height,
    name_of,
    ping_measurements,
    Positions,
    spread,
    systematic_variance,
    toa_variance,
)
from .state import DiverState
from .state_space import heights_of, Layout, ModelSet

SEED_PAIRS = 3
"""Transmitter-receiver pairs whose echoes are combined to seed a position; others must confirm
it."""

MAX_COMBINATIONS = 200
"""Combinations of echoes tried for one position."""

LOST = 1e-9
"""A ping as improbable of a track as this says that the track was somewhere else."""

MOST_FOUND = 10
"""Positions found by combining the echoes of one ping; those of others are found in later ones."""


class Birth(NamedTuple):
    """Where a track may begin: position (2,), covariance (2, 2), and the ping and its rows from
    which it is, None for a fix; the probability that there is a diver, NaN where its hits will
    tell; whose track it is; whether it is measured, and no start; what is stated of z there; the
    name and the place (2,) of the sensor, None where it may not be turned."""

    position: FloatArray
    covariance: FloatArray
    ping: Arrivals | None = None
    rows: IndexArray | None = None
    existence: float = math.nan
    target_id: int = NOBODY
    measured: bool = True
    height: Height | None = None
    seen_by: tuple[str, FloatArray] | None = None


def births_from_fixes(
    fixes: Positions, free: BoolArray, existence: FloatArray | None
) -> list[Birth]:
    """Every fix that is `free` (D,) is a place to begin a track; existence (D,): of that track,
    None where its hits will tell."""
    births = []
    for d in np.flatnonzero(free).tolist():
        known = math.nan if existence is None else float(existence[d])
        name = NOBODY if fixes.target_id is None else int(fixes.target_id[d])
        height = None if fixes.heights is None else fixes.heights.row(d)
        births.append(
            Birth(
                fixes.z[d],
                fixes.R[d],
                existence=known,
                target_id=name,
                height=height,
                seen_by=fixes.turned_by,
            )
        )
    return births


def births_from_ping(
    ping: Arrivals, free: BoolArray, config: DiverConfig, factor: float
) -> list[Birth]:
    """Positions from the rows (n,) of a ping that are `free`; factor: on the variances of arrival
    times.

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
        if ping.passive or max(len(pair) for pair in pairs) == 1:
            return births + _fix(ping, rows, config, factor)[0]
        found, used = _best_combination(ping, pairs, config, factor)
        if not found:
            return births
        births += found
        rows = np.setdiff1d(rows, used)
    return births


def _by_pair(ping: Arrivals, rows: IndexArray) -> list[IndexArray]:
    pair = np.column_stack([ping.tx_id, ping.rx_id])[rows]
    return [rows[(pair == each).all(axis=1)] for each in np.unique(pair, axis=0)]


def _fix(
    ping: Arrivals, rows: IndexArray, config: DiverConfig, factor: float
) -> tuple[list[Birth], IndexArray]:
    """The fix of `rows` and its alternatives, and the rows it used."""
    rows = spread(rows)
    fix = locate(ping, rows, config, factor)
    if fix is None:
        return [], rows[:0]
    used = rows[fix.used | fix.used_bearing]
    name = name_of(ping)
    places = [(fix.position, fix.covariance)]
    places += [(place.position, place.covariance) for place in fix.alternatives]
    return [Birth(*place, ping, used, target_id=name) for place in places], rows[fix.used]


def _best_combination(
    ping: Arrivals, pairs: Sequence[IndexArray], config: DiverConfig, factor: float
) -> tuple[list[Birth], IndexArray]:
    """The fix that most pairs agree with, at least one more than seeded it."""
    best: tuple[list[Birth], IndexArray] = ([], np.empty(0, np.intp))
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
    ping: Arrivals, pairs: Sequence[IndexArray], birth: Birth, config: DiverConfig, factor: float
) -> IndexArray:
    """Of each pair the echo nearest to what a target at `birth` causes, where within 3 sigma."""
    position, covariance = birth.position, birth.covariance
    height = float(np.mean(heights_of(config)))
    expected = multistatic.range_sum(position, ping.tx, ping.rx, height)
    slope = multistatic.range_sum_jacobian(position, ping.tx, ping.rx, height)
    variance = config.sound_speed**2 * (
        toa_variance(ping, config, factor) + systematic_variance(ping, config)
    ) + np.einsum('na,ab,nb->n', slope, covariance, slope)
    nis = np.square(config.sound_speed * ping.toa - expected) / variance
    nearest = np.array([rows[np.argmin(nis[rows])] for rows in pairs])
    return nearest[nis[nearest] <= 9.0]


def locate(
    ping: Arrivals, rows: IndexArray, config: DiverConfig, factor: float
) -> Localisation | None:
    """The fix that `rows` of the ping give by themselves, None when they give none to believe.

    With depth as a state it is the best of those at the heights where the models begin.
    """
    variance = toa_variance(ping, config, factor)[rows] + systematic_variance(ping, config)[rows]
    best: Localisation | None = None
    for height in heights_of(config):
        fix = localise(
            ping.rx[rows],
            ping.toa[rows],
            variance,
            tx=ping.tx[rows],
            bearing=ping.bearing[rows],
            var_bearing=bearing_variance(ping, config)[rows]
            + np.radians(config.bearing_bias_std_deg) ** 2,
            target_z=height,
            sound_speed=config.sound_speed,
        )
        if isinstance(fix, Localisation) and (best is None or fix.cost < best.cost):
            best = fix
    return best


# -- tracks that begin ---------------------------------------------------------------------------


def most_tracks(config: DiverConfig) -> int:
    """Tracks there may be, tentative ones and all."""
    return 10 + 5 * config.max_tracks


def each_name_once(births: Sequence[Birth]) -> list[Birth]:
    """Without a second birth of the same name."""
    names: set[int] = set()
    first = []
    for birth in births:
        if birth.target_id == NOBODY or birth.target_id not in names:
            first.append(birth)
        names.add(birth.target_id)
    return first


def new_tracks(
    births: Sequence[Birth], models: ModelSet, layout: Layout, config: DiverConfig
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x (B, M, n + q), P (B, M, n + q, n + q) and mu (B, M) of tracks that begin."""
    x, P, mu = _new_tracks(births, models, layout, config)
    at_fix = np.array([birth.ping is None and birth.measured for birth in births])
    if at_fix.any():
        wide = P[at_fix]
        families.with_velocities_at_fix(wide, models, config)
        P[at_fix] = wide
    for row, birth in enumerate(births):
        if models.height >= 0 and birth.height is not None:
            begin(x[row], P[row], birth.height, birth.covariance, models.height, config)
        if birth.seen_by is not None:
            x[row], P[row] = layout.as_seen(x[row], P[row], *birth.seen_by, back=True)
    return x, P, mu


def _new_tracks(
    births: Sequence[Birth], models: ModelSet, layout: Layout, config: DiverConfig
) -> tuple[FloatArray, FloatArray, FloatArray]:
    plain = models.height < 0 and layout.size == models.n
    if all(birth.ping is None for birth in births) or (plain and models.bias < 0):
        position = np.array([birth.position for birth in births])
        covariance = np.array([birth.covariance for birth in births])
        # A start comes alone.
        x, P, mu = models.new_tracks(position, covariance, measured=births[0].measured)
        return *layout.widened(x, P), mu
    parts = [_new_track(birth, models, layout, config, plain) for birth in births]
    x, P, mu = (np.concatenate(part) for part in zip(*parts))
    return x, P, mu


def _new_track(
    birth: Birth, models: ModelSet, layout: Layout, config: DiverConfig, plain: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x, P and mu of one track, with a row."""
    where = birth.position[None]
    if birth.ping is None or birth.rows is None or plain:
        x, P, mu = models.new_tracks(where, birth.covariance[None], birth.ping is None)
        return *layout.widened(x, P), mu
    x, P, mu = models.new_tracks(where, np.eye(2)[None] * FAR**2, False)
    x, P = layout.widened(x, P)
    factor = config.covariance_scale
    ping = ping_measurements(birth.ping, birth.rows, config, factor, models, layout)
    # All models of a copy begin alike: one of each is enough to ask.
    M = len(models.names)
    begins = np.ascontiguousarray(x[0, ::M]), np.ascontiguousarray(P[0, ::M])
    first = begin_from_ping(*begins, ping, birth.position, config, layout)
    known = np.isfinite(first[2]).any()
    share = np.exp(first[2] - first[2].max()) if known else np.ones(len(first[2]))
    mu = mu * np.repeat(share / share.sum() * len(share), M)
    at, covariance = np.repeat(first[0], M, axis=0)[None], np.repeat(first[1], M, axis=0)[None]
    if models.mixing is not None:
        # But for how it moves, of which a ping says nothing.
        moves = slice(2, 4)
        at[..., moves] = x[..., moves]
        covariance[..., moves, :] = P[..., moves, :]
        covariance[..., :, moves] = P[..., :, moves]
    return at, covariance, mu


def begun_anew(
    now: DiverState,
    ping: Arrivals,
    free: BoolArray,
    models: ModelSet,
    layout: Layout,
    config: DiverConfig,
) -> DiverState:
    """The tracks after a ping, whose rows (n,) are taken but for those that are `free`. With depth
    as a state, a track that took what was all but impossible begins anew where the ping alone puts
    it: an update over such a way is far from linear, and what it makes of the depth is nothing
    known."""
    hit, rows = np.flatnonzero(now.nis_dof), np.flatnonzero(~free)
    if models.height < 0 or len(hit) != 1:
        return now
    (track,) = hit
    dof = int(now.nis_dof[track])
    if dof < SEED_PAIRS or now.nis[track] <= gate_threshold(1.0 - LOST, dof):
        return now
    mean, covariance = now.positions(models.E[:, :2])
    birth = Birth(mean[track], covariance[track], ping, rows)
    parts = zip((now.x, now.P, now.mu), new_tracks([birth], models, layout, config))
    x, P, mu = (np.concatenate([old[:track], new, old[track + 1 :]]) for old, new in parts)
    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        return now
    spreads = now.spreads.copy()
    spreads[track] += 1
    return now._replace(x=x, P=P, mu=mu, spreads=spreads)


# -- starts --------------------------------------------------------------------------------------


def make_room(
    now: DiverState, start: Start, config: DiverConfig, E: FloatArray
) -> tuple[DiverState, bool]:
    """The tracks without those that give way to `start`, and whether there is room for its own; E
    (M, 2, n): to the position."""
    going = now.target_id == NOBODY
    if config.max_tracks > 1 and len(going):
        going &= _agree(now, start, config, E)
    left = now.only(~going)
    if int((left.life.status != TENTATIVE).sum()) < config.max_tracks:
        return left, True
    return now._replace(not_started=now.not_started + 1), False


def confirmed(now: DiverState) -> DiverState:
    """With its newest track confirmed."""
    status = now.life.status.copy()
    status[-1] = CONFIRMED
    return now._replace(life=evolve(now.life, status=status))


def no_room(now: DiverState, config: DiverConfig) -> list[str]:
    """What a user has to know of starts that began no track."""
    if not now.not_started:
        return []
    return [
        f'{now.not_started} starts began no track: there are max_tracks '
        f'({config.max_tracks}) confirmed ones'
    ]


def _agree(now: DiverState, start: Start, config: DiverConfig, E: FloatArray) -> BoolArray:
    """Which tracks (T,) may be where the start is."""
    mean, covariance = now.positions(E)
    apart = start.position[:2] - mean
    squared = np.einsum(
        'ta,ta->t',
        apart,
        np.linalg.solve(covariance + start.covariance[:2, :2], apart[..., None])[..., 0],
    )
    return np.asarray(squared <= gate_threshold(config.gate_probability, 2))
