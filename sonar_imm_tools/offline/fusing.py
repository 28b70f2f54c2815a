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

"""The tracks of two nodes that watch the same water, as those of one.

Two estimates of one diver cannot be combined as two measurements could: both nodes believe the
same things of how divers move, and may have shared a sensor, a clock or a survey of their
positions, so that their errors are correlated, and nobody knows how much. Covariance intersection
(Julier and Uhlmann 1997) needs not to know:

    P^-1 = w A^-1 + (1 - w) B^-1,    x = P (w A^-1 a + (1 - w) B^-1 b),    0 <= w <= 1,

is consistent for every correlation when A and B are, whatever w is; w is chosen so that det P is
least. With f(l) = sum log(w l + 1 - w) over the eigenvalues l of B A^-1 this is the largest f, and
f is concave, so that the best w is where its derivative changes its sign.

Which track of one run is the same diver as which of the other is decided at every stamp, by the
distance that they keep: the square of their Mahalanobis distance, averaged over some ten scans.
Pairs stay together while they fit. Names that both know settle it. What has no partner goes on as
it is. An estimate is carried on to the stamp of the other run's by its velocity, which fades in
the covariance as fast as divers turn.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, KeysView, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from attrs import evolve
import numpy as np
from scipy.optimize import linear_sum_assignment

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate, PLACES
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.motion import white_acceleration
from sonar_imm.measurements import NOBODY

from ..recordings.reader import BagError
from .run_folder import RUN, run_record, RunFolder

K = TypeVar('K')
V = TypeVar('V')

GATE = 13.8
"""Mahalanobis distance squared of two positions beyond which two tracks are no pair: .1 % of the
pairs whose errors are independent."""

MEMORY = 0.8
"""Share that the last distance of a pair has of the one before it."""

REMEMBERED = 10_000
"""Tracks and pairs of tracks that are remembered, many times what is there at a time, since nodes
may run for years. The oldest are forgotten for more."""

STAYS = 4.0
"""By so much another partner must fit better, distance squared, than the one of now."""

MANY_LATE = 20
"""Estimates in a row that come too late where clocks were set back."""


class Intersection(NamedTuple):
    """What covariance intersection makes of two estimates: x (n,), P (n, n), and the weight of the
    first."""

    x: FloatArray
    P: FloatArray
    weight: float


def covariance_intersection(
    a: FloatArray, A: FloatArray, b: FloatArray, B: FloatArray, weight: float | None = None
) -> Intersection:
    """Estimates a, b (n,) with positive definite A, B (n, n) as one; weight: of the first, None
    for the best. Raises numpy.linalg.LinAlgError where a covariance is not positive definite."""
    root = np.linalg.cholesky(A)
    np.linalg.cholesky(B)
    half = np.linalg.solve(root, B)
    ratio = np.linalg.eigvalsh(np.linalg.solve(root, half.T))
    w = best_weight(ratio) if weight is None else weight
    information_a, information_b = np.linalg.inv(A), np.linalg.inv(B)
    P = np.linalg.inv(w * information_a + (1.0 - w) * information_b)
    P = 0.5 * (P + P.T)
    return Intersection(P @ (w * information_a @ a + (1.0 - w) * information_b @ b), P, w)


def best_weight(ratio: FloatArray) -> float:
    """The weight in [0, 1] with the largest sum of log(w l + 1 - w) over l of `ratio` (n,)."""

    def slope(w: float) -> float:
        return float(((ratio - 1.0) / (w * (ratio - 1.0) + 1.0)).sum())

    if slope(0.0) <= 0.0 and slope(1.0) >= 0.0:
        return 0.5  # the same covariance twice
    if slope(0.0) <= 0.0 or slope(1.0) >= 0.0:
        return 0.0 if slope(0.0) <= 0.0 else 1.0
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slope(middle) > 0.0 else (low, middle)
    return 0.5 * (low + high)


def _remember(known: dict[K, V], key: K, value: V) -> None:
    known.pop(key, None)
    known[key] = value
    if len(known) > REMEMBERED:
        del known[next(iter(known))]


class Fuser:
    """Puts the estimates of two runs together, stamp by stamp in order."""

    def __init__(self, noise: float):
        """noise: how fast velocities change, m/s^1.5 on each axis."""
        self._noise = noise
        self._distance: dict[tuple[int, int], float] = {}
        self._partner: dict[int, int] = {}
        self._ids: tuple[dict[int, int], dict[int, int]] = ({}, {})
        self._next = 1
        self._pairs: dict[tuple[int, int], None] = {}
        self.rows, self.fused_rows = 0, 0

    @property
    def pairs(self) -> KeysView[tuple[int, int]]:
        """The tracks of both that were one."""
        return self._pairs.keys()

    def fuse(self, first: Estimate | None, second: Estimate | None, stamp_ns: int) -> Estimate:
        """The confirmed tracks of both at `stamp_ns`, each carried on to it."""
        both = [self._at(each, stamp_ns) for each in (first, second) if each is not None]
        if len(both) == 1:
            a = b = both[0]
            every = list(range(len(a)))
            pairs, only = [], [every, []] if first is not None else [[], every]
        else:
            a, b = both
            pairs = self._paired(a, b)
            only = [
                sorted(set(range(len(each))) - {pair[side] for pair in pairs})
                for side, each in enumerate((a, b))
            ]
        rows: list[dict[str, Any]] = []
        for i, j in pairs:
            merged = covariance_intersection(
                a.state[i], a.covariance[i], b.state[j], b.covariance[j]
            )
            known = [each.extras['target_id'][k] for each, k in ((a, i), (b, j))]
            row = self._row(a, i, merged, max(known))
            row['track_state'] = min(row['track_state'], b.extras['track_state'][j])
            row['existence'] = np.fmax(row['existence'], b.extras['existence'][j])
            row['z'] = merged.weight * a.xyz[i, 2] + (1.0 - merged.weight) * b.xyz[j, 2]
            pair = int(a.extras['track_id'][i]), int(b.extras['track_id'][j])
            _remember(self._pairs, pair, None)
            rows.append(row | {'ids': pair})
        for side, each in enumerate((a, b)):
            for k in only[side]:
                own = Intersection(each.state[k], each.covariance[k], 1.0 - side)
                track = int(each.extras['track_id'][k])
                row = self._row(each, k, own, each.extras['target_id'][k])
                rows.append(row | {'ids': (track, None) if side == 0 else (None, track)})
        self.rows += len(rows)
        self.fused_rows += len(pairs)
        self._identify(rows)
        rows.sort(key=lambda row: row['track_id'])
        return _estimate(stamp_ns, a, rows)

    def _at(self, estimate: Estimate, stamp_ns: int) -> Estimate:
        """The confirmed tracks of an estimate, carried on to a stamp."""
        extras, count = estimate.extras, len(estimate)
        usable = np.asarray(extras['track_state']) > 0
        usable &= np.isfinite(estimate.covariance).all(axis=(1, 2))
        dt = (stamp_ns - estimate.stamp_ns) * 1e-9
        names = estimate.state_names
        F, Q = np.eye(len(names)), np.zeros((len(names), len(names)))
        for axis in 'xyz':
            if f'p{axis}' in names and f'v{axis}' in names:
                own = names.index(f'p{axis}'), names.index(f'v{axis}')
                F[own] = dt
                step = white_acceleration(self._noise**2, 0.0, dt)
                Q[np.ix_(own, own)] = step[np.ix_((0, 2), (0, 2))]
        state = estimate.state @ F.T
        xyz = np.array(estimate.xyz, float)
        for column, name in enumerate(PLACES):
            if name in names:
                xyz[:, column] = state[:, names.index(name)]
        missing = {
            'existence': np.full(count, np.nan),
            'target_id': np.full(count, NOBODY, np.int32),
        }
        kept = {
            name: np.asarray(extras.get(name, missing.get(name)))[usable]
            for name in ('track_id', 'track_state', 'existence', 'target_id')
        }
        return Estimate(
            stamp_ns=stamp_ns,
            frame_id=estimate.frame_id,
            xyz=xyz[usable],
            state_names=names,
            state=state[usable],
            covariance=(F @ estimate.covariance @ F.T + Q)[usable],
            extras=kept,
        )

    def _paired(self, a: Estimate, b: Estimate) -> list[tuple[int, int]]:
        """Rows of one diver in both."""
        cost = np.zeros((len(a), len(b)))
        ids = [each.extras['track_id'].tolist() for each in (a, b)]
        for i, first in enumerate(ids[0]):
            for j, second in enumerate(ids[1]):
                apart = a.state[i, :2] - b.state[j, :2]
                S = a.covariance[i, :2, :2] + b.covariance[j, :2, :2]
                now = min(float(apart @ np.linalg.solve(S, apart)), 10.0 * GATE)
                before = self._distance.get((first, second), now)
                mean = MEMORY * before + (1.0 - MEMORY) * now
                _remember(self._distance, (first, second), mean)
                names = int(a.extras['target_id'][i]), int(b.extras['target_id'][j])
                cost[i, j] = min(mean - GATE, 0.0)
                if cost[i, j] < 0.0 and self._partner.get(first) == second:
                    cost[i, j] -= STAYS
                if NOBODY not in names:
                    cost[i, j] = 0.0 if names[0] != names[1] else cost[i, j] - 100.0 * GATE
        pairs = [
            (int(i), int(j)) for i, j in zip(*linear_sum_assignment(cost)) if cost[i, j] < 0.0
        ]
        for i, j in pairs:
            _remember(self._partner, ids[0][i], ids[1][j])
        return pairs

    def _identify(self, rows: list[dict[str, Any]]) -> None:
        """Give each row an identity: that of its tracks, of two the older one."""
        taken: set[int] = set()
        for row in rows:
            known = [
                self._ids[side][track]
                for side, track in enumerate(row['ids'])
                if track is not None and track in self._ids[side]
            ]
            free = sorted(set(known) - taken)
            number = free[0] if free else self._next
            self._next += not free
            taken.add(number)
            for side, track in enumerate(row['ids']):
                if track is not None:
                    _remember(self._ids[side], track, number)
            row['track_id'] = number

    @staticmethod
    def _row(source: Estimate, k: int, merged: Intersection, name: int) -> dict[str, Any]:
        return {
            'z': source.xyz[k, 2],
            'state': merged.x,
            'covariance': merged.P,
            'track_state': source.extras['track_state'][k],
            'existence': source.extras['existence'][k],
            'target_id': name,
            'weight': merged.weight,
        }


def _estimate(stamp_ns: int, like: Estimate, rows: list[dict[str, Any]]) -> Estimate:
    n, names = len(like.state_names), like.state_names
    state = np.array([row['state'] for row in rows]).reshape(-1, n)
    xyz = np.column_stack([state[:, :2], [row['z'] for row in rows]])
    if 'pz' in names:
        xyz[:, 2] = state[:, names.index('pz')]
    count = len(rows)

    def column(name: str, kind: Any) -> np.ndarray:
        return np.array([row[name] for row in rows], kind)

    return Estimate(
        stamp_ns=stamp_ns,
        frame_id=like.frame_id,
        xyz=xyz,
        state_names=names,
        state=state,
        covariance=np.array([row['covariance'] for row in rows]).reshape(-1, n, n),
        probabilities=np.empty((count, 0)),
        extras={
            'track_id': column('track_id', np.uint32),
            'track_state': column('track_state', np.uint8),
            'nis': np.full(count, np.nan),
            'nis_dof': np.zeros(count, np.uint16),
            'existence': column('existence', np.float64),
            'target_id': column('target_id', np.int32),
            'first_weight': column('weight', np.float64),
        },
    )


class Joined:
    """Two streams of estimates as one, stamp by stamp in order; max_age: seconds for which an
    estimate is carried on."""

    def __init__(self, fuser: Fuser, max_age: float):
        self.fuser, self._most_ns = fuser, max_age * 1e9
        self.newest: dict[int, Estimate] = {}

    def at(self, stamp_ns: int, heard: Mapping[int, Estimate]) -> Estimate:
        """At the stamp of what was `heard`, by stream (0 or 1)."""
        self.newest.update(heard)
        young = {
            side: each
            for side, each in self.newest.items()
            if stamp_ns - each.stamp_ns <= self._most_ns
        }
        return self.fuser.fuse(young.get(0), young.get(1), stamp_ns)


def fused(
    first: Sequence[Estimate], second: Sequence[Estimate], fuser: Fuser, max_age: float
) -> Iterator[Estimate]:
    """The estimates of two runs as those of one, at every stamp of either; max_age as above."""
    heard: dict[int, dict[int, Estimate]] = {}
    for side, run in enumerate((first, second)):
        for each in run:
            heard.setdefault(each.stamp_ns, {})[side] = each
    joined = Joined(fuser, max_age)
    for stamp_ns in sorted(heard):
        yield joined.at(stamp_ns, heard[stamp_ns])


class LiveFusion:
    """Estimates of two nodes, fused as they come. Each waits until the other node has come as far,
    `wait` seconds at most; what comes after its stamp was passed is left out, and counted as
    `late`. `MANY_LATE` of them in a row are clocks that were set back: all begins anew."""

    def __init__(self, noise: float, max_age: float, wait: float):
        self._settings, self._wait, self.late = (noise, max_age), wait, 0
        self._begin()

    def _begin(self) -> None:
        noise, max_age = self._settings
        self._joined = Joined(Fuser(noise), max_age)
        self._waiting: dict[int, tuple[float, dict[int, Estimate]]] = {}
        self._reached, self._passed, self._in_a_row = [-1, -1], -1, 0

    @property
    def pairs(self) -> KeysView[tuple[int, int]]:
        """The tracks of both that were one."""
        return self._joined.fuser.pairs

    def take(self, side: int, estimate: Estimate, now: float) -> None:
        """An estimate of a node (0 or 1) that came at the time `now`, s. Raises `BagError` for one
        that does not fit the other's."""
        for other in self._joined.newest.values():
            if len(other) and len(estimate) and other.frame_id != estimate.frame_id:
                raise BagError(
                    f'the nodes are in different frames ({other.frame_id} and {estimate.frame_id})'
                )
            if other.state_names != estimate.state_names:
                raise BagError('one node estimates depth and the other does not')
        late = estimate.stamp_ns <= self._passed
        self.late += late
        self._in_a_row = self._in_a_row + 1 if late else 0
        if self._in_a_row >= MANY_LATE:
            self._begin()
        elif late:
            return
        self._waiting.setdefault(estimate.stamp_ns, (now, {}))[1][side] = estimate
        self._reached[side] = max(self._reached[side], estimate.stamp_ns)

    def ready(self, now: float) -> Iterator[Estimate]:
        """What need not wait any longer."""
        for stamp_ns in sorted(self._waiting):
            since, heard = self._waiting[stamp_ns]
            if stamp_ns > min(self._reached) and now - since < self._wait:
                return
            del self._waiting[stamp_ns]
            self._passed = stamp_ns
            yield self._joined.at(stamp_ns, heard)


def write_fused(
    runs: tuple[RunFolder, RunFolder], folder: RunFolder, *, max_age: float, noise: float
) -> dict[str, Any]:
    """Fuse two runs into a fresh folder; gives the content of its run.json. Raises `BagError`
    where they do not fit together."""
    records = [run.read_run() for run in runs]
    for run, record in zip(runs, records):
        if record['system'] != 'diver':
            raise BagError(f'{run.path} is a run of the {record["system"]} tracker, not of divers')
    estimates = [run.read_estimates() for run in runs]
    _require_one_frame(runs, records, estimates)
    fuser = Fuser(noise)
    made = fused(estimates[0], estimates[1], fuser, max_age)
    origin = {'origin': records[0]['origin']} if 'origin' in records[0] else {}
    if origin:
        made = _on_earth(made, Origin(**origin['origin']))
    written = folder.write_estimates(made, 'diver')
    record = run_record(
        bag=records[0]['bag'],
        system='diver',
        topics=records[0]['topics'],
        parameters=records[0]['parameters'],
        world_frame=records[0].get('world_frame', 'enu'),
        fused={
            'runs': [str(run.path.resolve()) for run in runs],
            'max_age_s': max_age,
            'noise': noise,
            'pairs': sorted(map(list, fuser.pairs)),
            'rows': fuser.rows,
            'fused_rows': fuser.fused_rows,
        },
        **written,
        **origin,
    )
    folder.write_json(RUN, record)
    return record


def _on_earth(estimates: Iterable[Estimate], origin: Origin) -> Iterator[Estimate]:
    """Estimates with the columns latitude and longitude."""
    for each in estimates:
        place = origin.geodetic(np.asarray(each.xyz, np.float64))
        columns = {'latitude': place[:, 0], 'longitude': place[:, 1]}
        yield evolve(each, extras={**each.extras, **columns})


def _require_one_frame(
    runs: tuple[RunFolder, RunFolder],
    records: Sequence[dict[str, Any]],
    estimates: Sequence[Sequence[Estimate]],
) -> None:
    """Raise `BagError` for estimates that are not in the same frame, or not of the same states."""
    for run, found in zip(runs, estimates):
        if not found:
            raise BagError(f'{run.path} has no estimates')
    frames = [sorted({each.frame_id for each in found if len(each)}) for found in estimates]
    if frames[0] and frames[1] and frames[0] != frames[1]:
        names = ' and '.join(', '.join(each) for each in frames)
        raise BagError(f'the runs are in different frames ({names}): track them in one')
    states = [{each.state_names for each in found} for found in estimates]
    if states[0] != states[1]:
        raise BagError('one run estimates depth and the other does not: track both alike')
    origins = [record.get('origin') for record in records]
    if all(isinstance(each, dict) for each in origins) and origins[0] != origins[1]:
        raise BagError(
            'the frames of the runs have different origins: track both with the same '
            'origin_latitude and origin_longitude'
        )
