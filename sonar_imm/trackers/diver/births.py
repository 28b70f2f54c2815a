# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""New tracks: their positions and initial states.

A track starts at an unassociated fix, at a position that explains the free rows of a ping, or at a
`Start` message. A start is not a measurement: its track is confirmed at once. Tracks without an ID
that agree with a start end, to avoid duplicates; with a single target, all such tracks end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby, islice, product
import math

from attrs import evolve
import numpy as np

from ...acoustics import multistatic
from ...acoustics.localisation import Localisation, localise
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray, IndexArray
from ...estimation.association import CONFIRMED, gate_threshold, TENTATIVE, TrackRules
from ...estimation.rows import Rows
from ...measurements import Arrivals, NOBODY, Start
from . import depth, links, ranges, sides
from .config import DiverConfig
from .instruments import Layout
from .known import Feature, Known, track_positions, with_velocities_at_fix
from .models import ModelSet, start_depths
from .scan import (
    bearing_variance,
    Birth,
    Group,
    Heights,
    ping_measurements,
    Scan,
    subsample,
    systematic_variance,
    tag_id,
    toa_variance,
)

SEED_PAIRS = 3
"""Number of transmitter-receiver pairs that seed a position. At least one more pair must agree."""

MAX_COMBINATIONS = 200
"""Maximum number of echo combinations per position."""

LOST = 1e-9
"""Probability of a ping below which its track is wrong."""

MOST_FOUND = 10
"""Maximum number of positions from combined echoes of one ping."""


def spawn_at_fixes(known: Known, group: Group) -> Known:
    """Add a birth for each unassociated fix. A stage of the tracker."""
    association = group.association
    assert association is not None
    marks = links.birth_marks(group)
    for d in np.flatnonzero(association.free).tolist():
        existence = math.nan if association.existence is None else float(association.existence[d])
        name = NOBODY if group.target_id is None else int(group.target_id[d])
        height = None if group.heights is None else group.heights.row(d)
        place = group.z[d], group.R[d], None, None, existence, name, True, height
        marked = group.rotation_sensor, group.number, int(marks[d])
        group.births.append(Birth(*place, *marked))
    return known


def births_from_ping(ping: Arrivals, free: BoolArray, config: DiverConfig) -> list[Birth]:
    """Return births from the `free` (n,) rows of a ping.

    With at most one echo per transmitter-receiver pair, this is one fix and its ghosts, which
    later pings resolve. With several echoes, combinations of a few pairs are tried. A position
    that more pairs agree with is accepted, and its echoes are removed.
    """
    rows = np.flatnonzero(free & np.isfinite(ping.toa))
    births: list[Birth] = []
    for _ in range(MOST_FOUND):
        if not len(rows):
            break
        pairs = [rows] if ping.passive else _rows_by_pair(ping, rows)
        if ping.passive or max(len(pair) for pair in pairs) == 1:
            return births + _locate_births(ping, rows, config)[0]
        found, used = _find_best_combination(ping, pairs, config)
        if not found:
            return births
        births += found
        rows = np.setdiff1d(rows, used)
    return births


def _rows_by_pair(ping: Arrivals, rows: IndexArray) -> list[IndexArray]:
    """Return the rows of each transmitter-receiver pair."""
    pair = np.column_stack([ping.tx_id, ping.rx_id])[rows]
    return [rows[(pair == each).all(axis=1)] for each in np.unique(pair, axis=0)]


def _locate_births(
    ping: Arrivals, rows: IndexArray, config: DiverConfig
) -> tuple[list[Birth], IndexArray]:
    """Return births at the fix of `rows` and its alternatives, and the used rows."""
    rows = subsample(rows)
    fix = locate_fix(ping, rows, config)
    if fix is None:
        return [], rows[:0]
    used = rows[fix.used | fix.used_bearing]
    name = tag_id(ping)
    places = [(fix.position, fix.covariance)]
    places += [(place.position, place.covariance) for place in fix.alternatives]
    line = sides.line_of_ping(ping, used, config)
    if line is not None:
        places = sides.without_images(places, line)
    return [Birth(*place, ping, used, target_id=name) for place in places], rows[fix.used]


def _find_best_combination(
    ping: Arrivals, pairs: Sequence[IndexArray], config: DiverConfig
) -> tuple[list[Birth], IndexArray]:
    """Return the births that most pairs agree with, at least one more than the seeds, and their
    rows."""
    best: tuple[list[Birth], IndexArray] = ([], np.empty(0, np.intp))
    if len(pairs) <= SEED_PAIRS:
        return best
    seeding = sorted(pairs, key=len)[:SEED_PAIRS]
    for seed in islice(product(*seeding), MAX_COMBINATIONS):
        for birth in _locate_births(ping, np.array(seed), config)[0]:
            agreeing = _select_agreeing(ping, pairs, birth, config)
            if len(agreeing) > max(SEED_PAIRS, len(best[1])):
                refined = _locate_births(ping, agreeing, config)
                best = refined if len(refined[1]) > len(best[1]) else best
    return best


def _select_agreeing(
    ping: Arrivals, pairs: Sequence[IndexArray], birth: Birth, config: DiverConfig
) -> IndexArray:
    """Return the echo of each pair nearest to the prediction for `birth`, within 3 sigma."""
    position, covariance = birth.position, birth.covariance
    height = float(np.mean(start_depths(config)))
    expected = multistatic.range_sum(position, ping.tx, ping.rx, height)
    slope = multistatic.range_sum_jacobian(position, ping.tx, ping.rx, height)
    variance = config.sound_speed**2 * (
        toa_variance(ping, config) + systematic_variance(ping, config)
    ) + np.einsum('na,ab,nb->n', slope, covariance, slope)
    nis = np.square(config.sound_speed * ping.toa - expected) / variance
    nearest = np.array([rows[np.argmin(nis[rows])] for rows in pairs])
    return nearest[nis[nearest] <= 9.0]


def locate_fix(ping: Arrivals, rows: IndexArray, config: DiverConfig) -> Localisation | None:
    """Return the fix of the `rows` of a ping alone; None without a plausible fix.

    With depth as a state, return the best fix over the start depths.
    """
    variance = toa_variance(ping, config)[rows] + systematic_variance(ping, config)[rows]
    best: Localisation | None = None
    for height in start_depths(config):
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


# -- new tracks ----------------------------------------------------------------------------------


def spawn_stage(
    models: ModelSet,
    config: DiverConfig,
    layouts: Callable[[Known], Layout],
    chain: AdaptiveChain,
    features: Mapping[str, Feature],
    rules: TrackRules,
) -> Callable[[Known, Scan], Known]:
    """Return the stage that starts a tentative track at each birth up to the limit, and a
    confirmed one at each start."""

    def with_tracks(known: Known, found: Sequence[Birth]) -> Known:
        layout = layouts(known)
        for _, group in groupby(found, key=_sensor_of):
            births = list(group)
            columns = {name: feature.birth for name, feature in features.items()}
            columns['learnt'] = chain.initial_counts(len(births))
            existence = np.array([birth.existence for birth in births])
            columns['existence'] = existence
            columns['least_existence'] = np.fmin(columns['least_existence'], existence)
            columns['target_id'] = [birth.target_id for birth in births]
            life = known.life.born(len(births), known.stamp_ns, rules)
            rows = birth_rows(births, models, layout, config)
            known = known.with_tracks(life, rows, columns)
        return known

    def spawn(known: Known, scan: Scan) -> Known:
        marks: dict[int, int] = {}
        found = [birth for group in scan.fixes for birth in group.births] + scan.births
        if found:
            room = max(0, max_total_tracks(config) - len(known))
            new = without_duplicate_ids(found)
            begun = new[:room]
            known = with_tracks(known, begun)
            if left := sum(birth.target_id != NOBODY for birth in new[room:]):
                known = known.add_counts(names_without_track=left)
            ids = known.life.track_id[len(known) - len(begun) :].tolist()
            marks = {birth.mark: each for birth, each in zip(begun, ids) if birth.mark}
        known = links.resolve_links(known, marks)
        for start in scan.starts:
            known, free = make_room(known, start, config, models)
            if free:
                known = confirm_newest(with_tracks(known, [birth_from_start(start, config)]))
        return known

    return spawn


def _sensor_of(birth: Birth) -> tuple[int, str | None]:
    """Return the number of the sensor of a birth, and its name if it has a bearing error."""
    return birth.number, birth.seen_by and birth.seen_by[0]


def max_total_tracks(config: DiverConfig) -> int:
    """Return the maximum number of tracks, including tentative ones."""
    return 10 + 5 * config.max_tracks


def without_duplicate_ids(births: Sequence[Birth]) -> list[Birth]:
    """Return the births without repeated target IDs."""
    names: set[int] = set()
    first = []
    for birth in births:
        if birth.target_id == NOBODY or birth.target_id not in names:
            first.append(birth)
        names.add(birth.target_id)
    return first


def birth_rows(
    births: Sequence[Birth], models: ModelSet, layout: Layout, config: DiverConfig
) -> Rows:
    """Return the rows of new tracks of one sensor."""
    plain = models.height < 0 and layout.size == models.n
    if all(birth.ping is None for birth in births) or (plain and models.bias < 0):
        position = np.array([birth.position for birth in births])
        covariance = np.array([birth.covariance for birth in births])
        # A start is a group of one birth.
        parts = models.initial_states(position, covariance, measured=births[0].measured)
        x, P = layout.with_new_constants(*parts[:2])
        mu, logw = parts[2], np.full(x.shape[:2], -math.log(models.rows_per_track))
    else:
        each = [_birth_states(birth, models, layout, config, plain) for birth in births]
        x, P, mu, logw = (np.concatenate(part) for part in zip(*each))
    for track, birth in enumerate(births):
        if birth.ping is None and birth.measured:
            with_velocities_at_fix(P[track], models, config)
        if models.height >= 0 and birth.height is not None:
            for row in range(x.shape[1]):
                depth.begin_depth(
                    x[track, row],
                    P[track, row],
                    birth.height,
                    birth.covariance,
                    models.height,
                    config,
                )
    rows = models.make_rows(x, P, mu, logw, births[0].number)
    for track, birth in enumerate(births):
        if birth.fit is not None:
            own = ranges.fitted_rows(birth.fit, models, layout, birth.number)
            rows = rows.replace_target(track, own)
        elif birth.ping is not None and birth.rows is not None:
            line = sides.line_of_ping(birth.ping, birth.rows, config)
            if line is not None:
                rows = sides.with_images(rows, track, models, layout, line)
    seen_by = births[0].seen_by
    return (
        rows if seen_by is None else layout.rotate_about_sensor(rows, models, *seen_by, back=True)
    )


def _birth_states(
    birth: Birth, models: ModelSet, layout: Layout, config: DiverConfig, plain: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return x (1, K, M, n), P, mu (1, K, M) and logw (1, K) of one new track."""
    where = birth.position[None]
    logw = np.full((1, models.rows_per_track), -math.log(models.rows_per_track))
    if birth.ping is None or birth.rows is None or plain:
        x, P, mu = models.initial_states(where, birth.covariance[None], birth.ping is None)
        return *layout.with_new_constants(x, P), mu, logw
    from .arrivals import begin_from_ping, FAR

    x, P, mu = models.initial_states(where, np.eye(2)[None] * FAR**2, False)
    x, P = layout.with_new_constants(x, P)
    ping = ping_measurements(birth.ping, birth.rows, config, models, layout)
    # All models of a row start equal: one model of each row is enough.
    begins = np.ascontiguousarray(x[0, :, 0]), np.ascontiguousarray(P[0, :, 0])
    own, covariance, evidence = begin_from_ping(*begins, ping, birth.position, config, layout)
    if np.isfinite(evidence).any():
        share = np.exp(evidence - evidence.max())
        logw = np.log(np.maximum(share / share.sum(), 1e-150))[None]
    at, spread_at = x.copy(), P.copy()
    at[0], spread_at[0] = own[:, None], covariance[:, None]
    if models.families is not None:
        # A ping contains no information about the motion.
        moves = slice(2, 4)
        at[..., moves] = x[..., moves]
        spread_at[..., moves, :] = P[..., moves, :]
        spread_at[..., :, moves] = P[..., :, moves]
    return at, spread_at, mu, logw


def restart_track(
    known: Known,
    ping: Arrivals,
    free: BoolArray,
    models: ModelSet,
    layout: Layout,
    config: DiverConfig,
) -> Known:
    """Restart a track whose update by a ping was far too improbable, with depth as a state.

    The track restarts at the position of the ping alone: the update is nonlinear over such a
    distance, and its depth would be wrong. free: (n,) False for the rows of the track.
    """
    hit, rows = np.flatnonzero(known['nis_dof']), np.flatnonzero(~free)
    if models.height < 0 or len(hit) != 1:
        return known
    track = int(hit[0])
    dof = int(known['nis_dof'][track])
    if dof < SEED_PAIRS or known['nis'][track] <= gate_threshold(1.0 - LOST, dof):
        return known
    mean, covariance = track_positions(known, models)
    birth = Birth(mean[track], covariance[track], ping, rows)
    new = birth_rows([birth], models, layout, config)
    if not all(np.isfinite(part).all() for block in new.blocks for part in block):
        return known
    return depth.count_respread(known.with_rows_of(track, new), track)


# -- starts --------------------------------------------------------------------------------------


def birth_from_start(start: Start, config: DiverConfig) -> Birth:
    """Return the birth of a track at a start message."""
    height = None
    if config.dimensions == 3:
        stated = Heights.from_fixes(start.position[None], start.covariance[None], 1.0)
        height = stated and stated.row(0)
    plane = start.position[:2], start.covariance[:2, :2]
    return Birth(*plane, target_id=start.target_id, measured=False, height=height)


def make_room(
    known: Known, start: Start, config: DiverConfig, models: ModelSet
) -> tuple[Known, bool]:
    """Remove the tracks that give way to `start`.

    Return the state and whether a new track fits.
    """
    going = known['target_id'] == NOBODY
    if config.max_tracks > 1 and len(going):
        going &= _agrees_with_start(known, start, config, models)
    if start.target_id != NOBODY:
        going = going | (known['target_id'] == start.target_id)
    left = known.select(~going)
    if int((left.life.status != TENTATIVE).sum()) < config.max_tracks:
        return left, True
    return known.add_counts(not_started=1), False


def confirm_newest(known: Known) -> Known:
    """Return the state with its newest track confirmed."""
    status = known.life.status.copy()
    status[-1] = CONFIRMED
    return known.replace(life=evolve(known.life, status=status))


def start_warnings(known: Known, config: DiverConfig) -> list[str]:
    """Return warnings about starts and names without a track."""
    found = []
    if count := known.counts.get('not_started', 0):
        found.append(
            f'{count} starts ignored: max_tracks ({config.max_tracks}) tracks are confirmed. '
            'Increase max_tracks'
        )
    if count := known.counts.get('names_without_track', 0):
        found.append(
            f'{count} positions with a name of their own started no track: there are '
            f'{max_total_tracks(config)}. Increase max_tracks, or give names that stay'
        )
    return found


def _agrees_with_start(
    known: Known, start: Start, config: DiverConfig, models: ModelSet
) -> BoolArray:
    """Return which tracks (T,) agree with the start position."""
    mean, covariance = track_positions(known, models)
    apart = start.position[:2] - mean
    squared = np.einsum(
        'ta,ta->t',
        apart,
        np.linalg.solve(covariance + start.covariance[:2, :2], apart[..., None])[..., 0],
    )
    return np.asarray(squared <= gate_threshold(config.gate_probability, 2))
