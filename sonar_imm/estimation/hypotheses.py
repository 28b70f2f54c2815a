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

"""The k best joint hypotheses of which detections were which target's, kept over many scans.

A scan can be paired with the tracks in many ways, and later scans tell which was right. So a track
has several *rows*, each the state after another history of detections, and a *hypothesis* is a set
of rows, at most one of each track. A track without a row in a hypothesis does not exist there.
Tracks that never shared a detection are in *clusters* of their own, each with hypotheses whose
probabilities sum to one.

With each scan a hypothesis branches into joint events, in which each track takes at most one
detection and each detection goes to at most one track (`paired`):

    Pr(event | scans) ~ Pr(hypothesis) prod_assigned r p f / lambda * prod_missed (1 - r p),

with r the probability that the target of a row exists, p that it is detected, f the density that
the row predicts at the detection, and lambda the density of false detections and new targets
together. A row that took a detection exists (r = 1); one that took none has r (1 - p) / (1 - r p).
A detection that no track takes may be a new target: it begins a track of its own, which exists
there with lambda_birth / lambda (`with_births`). This is the multi-Bernoulli mixture of the
Poisson multi-Bernoulli filter (Williams 2015; Garcia-Fernandez et al. 2018) whose density of
undetected targets is kept constant.

The most probable events of all hypotheses of a cluster together are found without the others
(`k_best`; Murty 1968, Cox and Hingorani 1996). What grows is cut back (`settled`): hypotheses
beyond a number, or less probable than a share of the best; rows of a track whose last detections
are the same, whose states are nearly the same too, become one; tracks that compete for none of
their last detections, or have the same row in all hypotheses, are clusters of their own.

All arrays are float64, int64 or bool and C-contiguous.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray, IndexArray, IntArray
from .jit import kernel

SPAN = math.log(1e4)
"""Hypotheses less probable than the best of their cluster by this (logarithm) are dropped."""

CANDIDATES = 12
"""Detections, the likeliest, between which a row chooses."""

MOST_WORK = 10_000_000
"""Elements of tables that `k_best` visits in a cluster before it stops to branch."""

STAYS = 3.0
"""How much more probable another hypothesis must be than the one that is shown to take its place:
where two are nearly equal, what is shown does not go back and forth."""


@kernel
def _assign(
    gain: FloatArray,
    fixed: int,
    prefix: IntArray,
    banned: BoolArray,
    choice: IntArray,
) -> float:
    """The best assignment of rows to columns: `choice` (n,), -1 for none, and the sum of its
    gains; -inf where there is none.

    gain (n, D): of each pair, -inf where forbidden; the first `fixed` rows keep `prefix` (n,); the
    row after those takes no column that is `banned` (D + 1,), the last one standing for none.
    Shortest augmenting paths (Jonker and Volgenant 1987).
    """
    n, D = gain.shape
    left = n - fixed
    columns = D + left
    taken = np.zeros(D, dtype=np.bool_)
    total = 0.0
    for i in range(fixed):
        choice[i] = prefix[i]
        if prefix[i] >= 0:
            taken[prefix[i]] = True
            total += gain[i, prefix[i]]
    u, v = np.zeros(left + 1), np.zeros(columns + 1)
    owner = np.zeros(columns + 1, dtype=np.int64)
    way = np.zeros(columns + 1, dtype=np.int64)
    least, used = np.empty(columns + 1), np.empty(columns + 1, dtype=np.bool_)
    for i in range(1, left + 1):
        owner[0] = i
        for j in range(columns + 1):
            least[j], used[j] = np.inf, False
        at = 0
        while True:
            used[at] = True
            row = owner[at]
            step, following = np.inf, -1
            for j in range(1, columns + 1):
                if used[j]:
                    continue
                cost = np.inf
                if j > D:
                    if j - D == row and not (row == 1 and banned[D]):
                        cost = 0.0
                elif not taken[j - 1] and not (row == 1 and banned[j - 1]):
                    cost = -gain[fixed + row - 1, j - 1]
                if cost < np.inf:
                    reduced = cost - u[row] - v[j]
                    if reduced < least[j]:
                        least[j], way[j] = reduced, at
                if least[j] < step:
                    step, following = least[j], j
            if following < 0:
                return -np.inf
            for j in range(columns + 1):
                if used[j]:
                    u[owner[j]] += step
                    v[j] -= step
                else:
                    least[j] -= step
            at = following
            if owner[at] == 0:
                break
        while at > 0:
            owner[at] = owner[way[at]]
            at = way[at]
    for i in range(fixed, n):
        choice[i] = -1
    for j in range(1, D + 1):
        if owner[j] > 0:
            choice[fixed + owner[j] - 1] = j - 1
    for i in range(fixed, n):
        if choice[i] >= 0:
            total += gain[i, choice[i]]
    return total


@kernel
def k_best(
    prior: FloatArray, gain: FloatArray, most: int, span: float, work: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """The most probable joint events of G hypotheses, best first: parent (K,), the hypothesis of
    each; choice (K, n), the detection of each track, -1 for none; log weight (K,).

    prior (G,): log weight of each hypothesis where all its tracks are missed; gain (G, n, D): what
    a pair adds, -inf where forbidden. At most `most` events, none below the best by more than
    `span`. Murty's partition: what is not the best event differs from it first in some track. No
    more is branched after `work` elements were visited.
    """
    G, n, D = gain.shape
    room = G + most * n
    parent, fixed = np.empty(room, dtype=np.int64), np.zeros(room, dtype=np.int64)
    value, open_ = np.full(room, -np.inf), np.zeros(room, dtype=np.bool_)
    choice = np.empty((room, n), dtype=np.int64)
    banned = np.zeros((room, D + 1), dtype=np.bool_)
    prefix = np.empty(n, dtype=np.int64)
    count, spent = 0, 0
    for g in range(G):
        value[count] = prior[g] + _assign(gain[g], 0, prefix, banned[count], choice[count])
        parent[count], open_[count] = g, True
        count += 1
    order = np.empty(most, dtype=np.int64)
    made, top = 0, -np.inf
    while made < most:
        best = -1
        for k in range(count):
            if open_[k] and (best < 0 or value[k] > value[best]):
                best = k
        if best < 0 or not value[best] >= top - span:
            break
        if made == 0:
            top = value[best]
        open_[best] = False
        order[made] = best
        made += 1
        if made == most:
            break
        g = parent[best]
        for j in range(fixed[best], n):
            if spent > work:
                break
            spent += (n - j) * (n - j) * (D + n - j)
            for d in range(D + 1):
                banned[count, d] = j == fixed[best] and banned[best, d]
            banned[count, choice[best, j] if choice[best, j] >= 0 else D] = True
            total = prior[g] + _assign(gain[g], j, choice[best], banned[count], choice[count])
            if total > -np.inf and total >= top - span:
                parent[count], fixed[count], value[count] = g, j, total
                open_[count] = True
                count += 1
    return parent[order[:made]], choice[order[:made]], value[order[:made]]


class Hypotheses(NamedTuple):
    """G hypotheses over T rows: cluster (G,) of each; log_weight (G,), of which the exponentials
    sum to one in a cluster; shown (G,): one in each cluster; member (G, T): its rows."""

    cluster: Annotated[IntArray, 'h']
    log_weight: Annotated[FloatArray, 'h']
    shown: Annotated[BoolArray, 'h']
    member: Annotated[BoolArray, 'ht']

    @classmethod
    def none(cls) -> Hypotheses:
        return cls(np.empty(0, np.int64), np.empty(0), np.empty(0, bool), np.empty((0, 0), bool))

    @property
    def weight(self) -> FloatArray:
        """(G,) the probability of each, in its cluster."""
        return np.exp(self.log_weight)

    def marginal(self) -> FloatArray:
        """(T,) the probability of each row."""
        return self.weight @ self.member

    def only(self, kept: IndexArray | BoolArray) -> Hypotheses:
        """With the rows `kept`, a mask (T,) or their numbers."""
        if not len(self.cluster):
            return self
        return self._replace(member=self.member[:, kept])

    def with_alone(self, count: int) -> Hypotheses:
        """With so many rows more, each certain and a cluster of its own."""
        G, T = self.member.shape
        member = np.zeros((G + count, T + count), bool)
        member[:G, :T] = self.member
        member[range(G, G + count), range(T, T + count)] = True
        first = int(self.cluster.max(initial=-1)) + 1
        return Hypotheses(
            np.concatenate([self.cluster, np.arange(first, first + count)]),
            np.concatenate([self.log_weight, np.zeros(count)]),
            np.concatenate([self.shown, np.ones(count, bool)]),
            member,
        )


class Paired(NamedTuple):
    """What a scan of D detections made of the rows: source (T',) the row that each new one comes
    from, and its detection (T',), -1 for none; hypotheses over those; used (G', D): which
    detections the tracks of a hypothesis took; claimed (D,): the probability that one is a
    track's; place (D,): the cluster in which each is in question, -1 in none."""

    source: IndexArray
    detection: IntArray
    hypotheses: Hypotheses
    used: BoolArray
    claimed: FloatArray
    place: IntArray


def paired(
    before: Hypotheses,
    track_id: IntArray,
    ratio: FloatArray,
    existence: FloatArray,
    hit: FloatArray,
    missed: FloatArray,
    reserved: BoolArray,
    most: int,
) -> Paired:
    """Branch all hypotheses by a scan, and keep the `most` probable ones of each cluster.

    track_id (T,): of the rows; ratio (T, D): log f / lambda, -inf outside the gate; existence
    (T,); hit (T,): the probability of a detection, and missed (T,): the same where the scan shows
    nothing of a row, 0 when it could not; reserved (T, D): a detection that only this row may take
    in a hypothesis that holds it.
    """
    T, D = ratio.shape
    ratio = _likeliest(ratio)
    inside = np.isfinite(ratio)
    touched = inside | reserved
    none = np.log1p(-existence * missed)
    some = np.log(np.maximum(existence * hit, 1e-300)) - none
    place = np.full(D, -1, np.int64)
    groups = _groups(before, touched)
    quiet = [group[0] for group in groups if len(group) == 1]
    asked = _touched_clusters(before, touched)
    quiet = [number for number in quiet if not asked[number]]
    parts = [_missed(before, np.isin(before.cluster, quiet), none, D)] if quiet else []
    first = int(before.cluster.max(initial=-1)) + 1
    branching = [group for group in groups if len(group) > 1 or asked[group[0]]]
    for number, group in enumerate(branching, start=first):
        log_weight, was_shown, member = _joined(before, group, most)
        rows = np.flatnonzero(member.any(axis=0))
        own = np.flatnonzero(touched[rows].any(axis=0))
        place[own] = number
        columns, column = np.unique(track_id[rows], return_inverse=True)
        row_of = np.full((len(member), len(columns)), -1, np.int64)
        for row, at in zip(rows.tolist(), column.tolist()):
            row_of[member[:, row], at] = row
        there = row_of >= 0
        prior = log_weight + np.where(there, none[row_of], 0.0).sum(axis=1)
        gain = np.where(there[..., None], (ratio[:, own] + some[:, None])[row_of], -np.inf)
        claims = there[..., None] & reserved[:, own][row_of]
        gain = np.where(claims.any(axis=1, keepdims=True) & ~claims, -np.inf, gain)
        parent, choice, value = k_best(
            np.ascontiguousarray(prior), np.ascontiguousarray(gain), most, SPAN, MOST_WORK
        )
        taken = np.zeros((len(parent), D), bool)
        taken_by, who = np.nonzero(choice >= 0)
        taken[taken_by, own[choice[taken_by, who]]] = True
        chosen = np.full(choice.shape, -1, np.int64)
        chosen[taken_by, who] = own[choice[taken_by, who]]
        code = np.where(there[parent], row_of[parent] * (D + 1) + chosen + 1, -1)
        value = value - np.logaddexp.reduce(value)
        parts.append(_Branches(np.full(len(value), number), value, was_shown[parent], taken, code))
    return _gathered(parts, place, D)


class _Branches(NamedTuple):
    """Hypotheses after a scan: what `Paired` and `Hypotheses` say of them, and their rows (n, k)
    as codes of source and detection, -1 for none."""

    cluster: IntArray
    log_weight: FloatArray
    shown: BoolArray
    used: BoolArray
    code: IntArray


def _touched_clusters(now: Hypotheses, touched: BoolArray) -> BoolArray:
    """Which clusters a detection is near to."""
    out = np.zeros(int(now.cluster.max(initial=-1)) + 1, bool)
    out[now.cluster[now.member[:, touched.any(axis=1)].any(axis=1)]] = True
    return out


def _missed(now: Hypotheses, which: BoolArray, none: FloatArray, D: int) -> _Branches:
    """The hypotheses of clusters near which there is no detection."""
    member, cluster = now.member[which], now.cluster[which]
    log_weight = now.log_weight[which] + member @ none
    total = np.full(int(cluster.max(initial=-1)) + 1, -np.inf)
    np.logaddexp.at(total, cluster, log_weight)
    code = np.full((len(member), int(member.sum(axis=1).max(initial=0))), -1, np.int64)
    at, row = np.nonzero(member)
    first = np.cumsum(member.sum(axis=1)) - member.sum(axis=1)
    code[at, np.arange(len(at)) - first[at]] = row * (D + 1)
    used = np.zeros((len(member), D), bool)
    return _Branches(cluster, log_weight - total[cluster], now.shown[which], used, code)


def _gathered(parts: list[_Branches], place: IntArray, D: int) -> Paired:
    """All of them as one."""
    if not parts:
        nothing, empty = np.empty(0, np.int64), np.empty((0, D), bool)
        return Paired(nothing, nothing, Hypotheses.none(), empty, np.zeros(D), place)
    code = np.unique(np.concatenate([part.code.ravel() for part in parts]))
    code = code[code >= 0]
    cluster, log_weight, shown, used = (np.concatenate(each) for each in list(zip(*parts))[:4])
    member = np.zeros((len(cluster), len(code)), bool)
    first = 0
    for part in parts:
        at, who = np.nonzero(part.code >= 0)
        member[first + at, np.searchsorted(code, part.code[at, who])] = True
        first += len(part.code)
    after = Hypotheses(cluster, log_weight, shown, member)
    source, detection = code // (D + 1), code % (D + 1) - 1
    return Paired(source, detection, after, used, after.weight @ used, place)


def with_births(found: Paired, free: IndexArray) -> Hypotheses:
    """The hypotheses with a row more for each of the detections `free` (B,): it is in those in
    which no track took that."""
    now = found.hypotheses.with_alone(len(free))
    G, T = found.hypotheses.member.shape
    member, alone = now.member.copy(), np.ones(len(now.cluster), bool)
    for number, detection in enumerate(free.tolist()):
        if found.place[detection] >= 0:
            own = found.hypotheses.cluster == found.place[detection]
            member[:G, T + number] = own & ~found.used[:, detection]
            alone[G + number] = False
    return Hypotheses(now.cluster[alone], now.log_weight[alone], now.shown[alone], member[alone])


def settled(
    now: Hypotheses, track_id: IntArray, key: IntArray, alive: BoolArray, most: int
) -> tuple[Hypotheses, BoolArray]:
    """What goes on to the next scan, and which rows (T,) that holds.

    key (T, w): numbers of the last detections of a row, and what else tells it from others, 0 for
    none. Rows of one track whose keys are the same become the most probable of them; tracks whose
    rows have no number in common do not depend on each other, and are clusters of their own. alive
    (T,): the others are out of all hypotheses; most: hypotheses of a cluster.
    """
    member = now.member & alive[None]
    marginal = now.marginal()
    together: dict[tuple[int, ...], list[int]] = {}
    for row in np.flatnonzero(member.any(axis=0)).tolist():
        together.setdefault((int(track_id[row]), *key[row].tolist()), []).append(row)
    for rows in together.values():
        if len(rows) > 1:
            rows.sort(key=lambda row: -marginal[row])
            member[:, rows[0]] = member[:, rows].any(axis=1)
            member[:, rows[1:]] = False
    size = np.bincount(now.cluster, minlength=1)
    simple = (size[now.cluster] == 1) & (member.sum(axis=1) == 1)
    parts: list[tuple[FloatArray, BoolArray, BoolArray]] = [
        (np.zeros(1), np.ones(1, bool), row[None]) for row in member[simple]
    ]
    for number in np.unique(now.cluster[~simple]):
        own = np.flatnonzero(now.cluster == number)
        held = np.flatnonzero(member[own].any(axis=0))
        for linked in _linked(track_id, key, held):
            kept = np.zeros_like(member[own])
            kept[:, linked] = member[np.ix_(own, linked)]
            parts += _apart(*_distinct(now.log_weight[own], now.shown[own], kept, most))
    if not parts:
        empty = Hypotheses.none()
        return empty, np.zeros(len(track_id), bool)
    sizes = [len(weight) for weight, _, _ in parts]
    weight, shown, members = (np.concatenate(each) for each in zip(*parts))
    after = Hypotheses(np.repeat(np.arange(len(parts)), sizes), weight, shown, members)
    kept = np.asarray(after.member.any(axis=0))
    return after.only(kept), kept


def _linked(track_id: IntArray, key: IntArray, rows: IndexArray) -> list[IndexArray]:
    """The `rows` of a cluster, those of tracks together that have a number of their keys in
    common: the others do not depend on each other any more."""
    leader: dict[int, int] = {}

    def root(track: int) -> int:
        while leader[track] != track:
            track = leader[track]
        return track

    first: dict[int, int] = {}
    tracks = track_id[rows].tolist()
    for track, numbers in zip(tracks, key[rows].tolist()):
        leader.setdefault(track, track)
        for number in set(numbers) - {0}:
            leader[root(track)] = root(first.setdefault(number, track))
    groups: dict[int, list[int]] = {}
    for track, row in zip(tracks, rows.tolist()):
        groups.setdefault(root(track), []).append(row)
    return [np.array(group) for group in groups.values()]


def _distinct(
    log_weight: FloatArray, shown: BoolArray, member: BoolArray, most: int
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """The different ones of the hypotheses of a cluster, best first, at most so many, and which is
    shown."""
    if len(member) > 1:
        first: dict[bytes, int] = {}
        of = [first.setdefault(row.tobytes(), k) for k, row in enumerate(np.packbits(member, 1))]
        total, was = np.full(len(member), -np.inf), np.zeros(len(member), bool)
        np.logaddexp.at(total, of, log_weight)
        np.logical_or.at(was, of, shown)
        order = np.argsort(-total, kind='stable')[:most]
        order = order[total[order] >= total[order[0]] - SPAN]
        log_weight, shown, member = total[order], was[order], member[order]
    log_weight = log_weight - np.logaddexp.reduce(log_weight)
    place = int(np.argmax(shown)) if shown.any() else 0
    if log_weight[0] > log_weight[place] + math.log(STAYS):
        place = 0
    return log_weight, np.arange(len(shown)) == place, member


def _apart(
    log_weight: FloatArray, shown: BoolArray, member: BoolArray
) -> list[tuple[FloatArray, BoolArray, BoolArray]]:
    """The hypotheses of a cluster as those of several: what is in all of them is alone."""
    certain = np.flatnonzero(member.all(axis=0))
    parts = []
    for row in certain.tolist():
        alone = np.zeros((1, member.shape[1]), bool)
        alone[0, row] = True
        parts.append((np.zeros(1), np.ones(1, bool), alone))
    rest = member.copy()
    rest[:, certain] = False
    if rest.any():
        parts.append((log_weight, shown, rest))
    return parts


def _likeliest(ratio: FloatArray) -> FloatArray:
    """`ratio` (T, D) with at most `CANDIDATES` detections for each row."""
    if ratio.shape[1] <= CANDIDATES:
        return ratio
    bound = np.partition(ratio, -CANDIDATES, axis=1)[:, -CANDIDATES, None]
    return np.where(ratio >= bound, ratio, -np.inf)


def _groups(now: Hypotheses, touched: BoolArray) -> list[list[int]]:
    """The clusters, together where they share a detection."""
    count = int(now.cluster.max(initial=-1)) + 1
    leader = list(range(count))

    def root(number: int) -> int:
        while leader[number] != number:
            number = leader[number]
        return number

    of_row = np.full(now.member.shape[1], -1, np.int64)
    at, row = np.nonzero(now.member)
    of_row[row] = now.cluster[at]
    first: dict[int, int] = {}
    for track, detection in zip(*(part.tolist() for part in np.nonzero(touched))):
        own = root(int(of_row[track]))
        leader[own] = root(first.setdefault(detection, own))
    groups: dict[int, list[int]] = {}
    for number in range(count):
        groups.setdefault(root(number), []).append(number)
    return list(groups.values())


def _joined(
    now: Hypotheses, clusters: list[int], most: int
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """The hypotheses of several clusters as those of one, the most probable ones."""
    joined: tuple[FloatArray, BoolArray, BoolArray] | None = None
    for number in clusters:
        own = now.cluster == number
        weight, shown, member = now.log_weight[own], now.shown[own], now.member[own]
        if joined is not None:
            both = (joined[0][:, None] + weight[None]).ravel()
            order = np.argsort(-both, kind='stable')[: max(most, 1)]
            a, b = np.divmod(order, len(weight))
            weight, shown = both[order], joined[1][a] & shown[b]
            member = joined[2][a] | member[b]
        joined = weight, shown, member
    assert joined is not None
    return joined
