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

"""Tracks whose name is known, and what to do when a diver is also seen without one.

A named track takes its part of the fixes that have no name (`fix_scans`), so that a diver with a
transponder on a sonar is one track. A second track can stand beside it all the same: the sonar may
have seen the diver before the transponder was heard. Two divers that swim together are seen
together, now and then at least; one diver never is. So a nameless track that stays beside a named
one, for so many scans that two divers would have been seen together once but for a probability of
`MISTAKEN`, is the same diver: the confirmed or older of the two goes on, with the name.

A name lasts as long as something says it: after `max_coast` without a fix of its own a track that
still is seen goes on without its name.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math

from attrs import evolve
import numpy as np

from ...estimation import imm_kernels
from ...estimation.arrays import FloatArray
from ...estimation.association import gate_threshold, TrackStatus
from ...measurements import Arrivals, Measurement, NOBODY
from .births import Birth, births_from_ping
from .config import DiverConfig
from .pings import ping_measurements
from .scan import Scan
from .sensing import Positions
from .state import DiverState

BESIDE = 4.0
"""Mahalanobis distance squared within which a nameless track is beside a named one."""

MISTAKEN = 1e-3
"""Probability that two divers side by side are taken for one."""


def patience(detection_probability: float) -> int:
    """Scans after which a track never seen together with the one beside it is the same diver."""
    return math.ceil(math.log(MISTAKEN) / math.log1p(-(detection_probability**2)))


def hear_named(scan: Scan, ping: Arrivals, config: DiverConfig, factor: float) -> list[Birth]:
    """Give a tag's ping to the track of its name; without one it is where one begins."""
    name = int(ping.tx_id[0])
    tracks = np.flatnonzero(scan.before.target_id == name)
    if not len(tracks):
        free = np.ones(len(ping), bool)
        found = births_from_ping(ping, free, config, factor)
        return [birth._replace(target_id=name) for birth in found]
    scan.instruments = scan.instruments.heard(ping, config)
    scan.layout = scan.instruments.layout(config, scan.models.n)
    scan.x, scan.P = scan.layout.widened(scan.x, scan.P)
    whole = config.covariance_scale * factor
    rows = np.arange(len(ping))
    numbers = ping_measurements(ping, rows, config, whole, scan.models, scan.layout)
    if numbers.pairs > 1:
        scan.accept(int(tracks[0]), numbers, whole)
    return []


def pings_of(items: Iterable[Measurement]) -> list[Arrivals]:
    """The pings of a stamp, each with its rows in order; of tags one for each tag."""
    pings: list[Arrivals] = []
    for item in items:
        if isinstance(item, Arrivals):
            ping = item.in_order()
            ids = np.unique(ping.tx_id) if ping.passive else ping.tx_id[:1]
            pings += [ping.only(ping.tx_id == one) for one in ids] if len(ids) > 1 else [ping]
    return pings


def is_named(ping: Arrivals) -> bool:
    """Whether a ping is that of a tag whose number is known."""
    return ping.passive and int(ping.tx_id[0]) != 0


def remembered(
    now: DiverState, before: DiverState, said: Iterable[int], max_coast: float
) -> DiverState:
    """With the names that were said at this stamp, and without those that are said no more."""
    last = dict(before.said)
    last.update((name, now.stamp_ns) for name in said)
    tracked = set(now.target_id.tolist())
    last = {
        name: at
        for name, at in last.items()
        if now.stamp_ns - at <= max_coast * 1e9 and (name in tracked or at == now.stamp_ns)
    }
    if not last and not before.said:
        return now
    known = np.isin(now.target_id, np.array(list(last), np.int64))
    return evolve(now, said=tuple(last.items()), target_id=np.where(known, now.target_id, NOBODY))


def names_said(groups: Sequence[Positions], pings: Sequence[Arrivals]) -> list[int]:
    """The names in the fixes and pings of a stamp."""
    own = [group.target_id for group in groups if group.target_id is not None]
    return [int(name) for names in own for name in names] + [
        int(ping.tx_id[0]) for ping in pings if is_named(ping)
    ]


def merged(
    now: DiverState,
    before: DiverState,
    groups: Sequence[Positions],
    config: DiverConfig,
    E: FloatArray,
) -> DiverState:
    """Without the tracks that are divers with a name once more, and that name where it belongs.

    groups: the fixes of this scan; E (M, 2, n): to the position.
    """
    seen = [group for group in groups if group.target_id is None and group.whole]
    named, nameless = (np.flatnonzero((now.target_id != NOBODY) == one) for one in (True, False))
    if config.named_tracks != 'share' or not seen or not len(named) or not len(nameless):
        return now
    n = E.shape[-1]
    x, P = np.ascontiguousarray(now.x[..., :n]), np.ascontiguousarray(now.P[..., :n, :n])
    mean, covariance = imm_kernels.combine(x, P, now.mu, np.ascontiguousarray(E))
    apart = mean[nameless][:, None] - mean[named][None]
    distance = _squared(apart, covariance[nameless][:, None] + covariance[named][None])
    ids = now.life.track_id.astype(np.int64)
    ago = dict(zip(before.life.track_id.tolist(), zip(before.near_to, before.near_for)))
    limit = max(patience(config.of_sensor(group.sensor).detection_probability) for group in seen)
    near_to, near_for, target_id, existence = (
        one.copy() for one in (now.near_to, now.near_for, now.target_id, now.existence)
    )
    going_on = np.ones(len(ids), bool)
    for row, place in zip(nameless.tolist(), distance.argmin(axis=1).tolist()):
        other = int(named[place])
        if distance[nameless == row, place].min() > BESIDE or not going_on[other]:
            continue
        pair = [row, other]
        if sum(_near(group, mean[pair], covariance[pair], config) for group in seen) > 1:
            continue
        partner, count = ago.get(int(ids[row]), (0, 0))
        near_to[row], near_for[row] = ids[other], 1 + (count if partner == ids[other] else 0)
        if near_for[row] < limit:
            continue
        stays, goes = (row, other) if _prefer(now, row, other) else (other, row)
        target_id[stays], existence[stays], going_on[goes] = target_id[other], math.nan, False
        near_to[stays] = near_for[stays] = 0
    now = evolve(now, near_to=near_to, near_for=near_for, target_id=target_id, existence=existence)
    return now if going_on.all() else evolve(now.rows(going_on), life=now.life.only(going_on))


def _prefer(now: DiverState, row: int, other: int) -> bool:
    """Whether of two tracks of one diver the first goes on: confirmed before tentative, then
    older."""
    tentative = now.life.status == TrackStatus.TENTATIVE
    if tentative[row] != tentative[other]:
        return bool(tentative[other])
    return bool(now.life.track_id[row] < now.life.track_id[other])


def _near(group: Positions, mean: FloatArray, covariance: FloatArray, config: DiverConfig) -> int:
    """How many fixes of a scan are near one of two tracks: mean (2, 2), covariance (2, 2, 2)."""
    apart = group.z[:, None] - mean[None]
    distance = _squared(apart, covariance[None] + group.R[:, None])
    threshold = gate_threshold(config.gate_probability, 2)
    return int((distance.min(axis=1) <= threshold).sum())


def _squared(apart: FloatArray, S: FloatArray) -> FloatArray:
    """Mahalanobis distances squared (...,) of vectors (..., 2) under covariances (..., 2, 2)."""
    return np.einsum('...a,...a->...', apart, np.linalg.solve(S, apart[..., None])[..., 0])
