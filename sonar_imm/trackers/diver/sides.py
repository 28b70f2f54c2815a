# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sides of a line of instruments.

Arrivals at instruments on one line are the same from both sides of it. So a track has the mirror
image of each of its rows as a row of equal weight from the start. Its rows are told apart by the
key ``side``. Later, a side that comes near the line gets its image again. With distance d and
standard deviation s of the side across the line, the weights of a place and of its image are as
``exp(-(d - d)^2 / 2 s^2) : exp(-(d + d)^2 / 2 s^2)``: the likelihood of the arrivals is the same.

Otherwise a ping of such instruments does not change the weights of the sides. Everything else
does: a receiver off the line, a bearing, a fix. A side ends when its weight is negligible, or when
these bring two sides together.

The image of a heading lies between two headings in general. It is shared between these two, in
proportion to the angles.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

from attrs import evolve
import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import TENTATIVE
from ...estimation.rows import log_sum, ROW_LOST, Rows
from ...measurements import Arrivals
from .config import DiverConfig
from .instruments import Layout
from .known import Feature, Known, row_outputs
from .models import HEADING, ModelSet
from .offsets import ASSUMED
from .scan import systematic_variance, toa_variance

FEATURES = {'doubts': Feature(0, kind=np.int64)}
"""doubts: number of pings since the track was last on one side."""

COLLINEAR = 0.02
"""Ratio of the second to the first singular value of instrument positions below which they lie on
a line."""

SAME = 9.0
"""Squared Mahalanobis distance within which a position is the image of another."""

TOGETHER = 1.0
"""Squared Mahalanobis distance, in position and velocity, within which two sides are one."""

MOST_SIDES = 4
"""Maximum number of sides of a track."""

LASTING = 5
"""Number of pings after which a doubt is said."""

NOT_TOLD = (
    'two receivers do not tell on which side of their line the target is: side_probability is the '
    'probability of the more probable side, mirror_x and mirror_y are the other'
)
"""Warning while a confirmed track is in doubt."""


class Line(NamedTuple):
    """A line of instruments."""

    point: FloatArray
    """(2,) a point on it, m."""
    along: FloatArray
    """(2,) its unit vector."""
    tells_nothing: bool = True
    """False if the instruments are so far off the line that a ping may tell the side."""

    @property
    def across(self) -> FloatArray:
        """Unit normal (2,)."""
        return np.array([-self.along[1], self.along[0]])

    @property
    def matrix(self) -> FloatArray:
        """Reflection (2, 2) of vectors."""
        return 2.0 * np.outer(self.along, self.along) - np.eye(2)

    def image(self, position: FloatArray) -> FloatArray:
        """Return the mirror images of positions (..., 2)."""
        return np.asarray(self.point + (position - self.point) @ self.matrix)


def line_through(points: FloatArray, noise: float) -> Line | None:
    """Return the line on which all `points` (k, 2) lie; None for another shape, or for one place.

    noise: standard deviation of a path length, m.
    """
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    _, size, axes = np.linalg.svd(points - middle, full_matrices=False)
    if len(size) < 2 or size[0] <= noise:
        return None
    middle = points.mean(axis=0)
    off = np.abs((points - middle) @ axes[1]).max()
    if size[1] > COLLINEAR * size[0] and off > noise:
        return None
    return Line(middle, axes[0], bool(off <= noise))


def line_of_ping(ping: Arrivals, rows: IndexArray, config: DiverConfig) -> Line | None:
    """Return the line of all instruments of the `rows` of a ping; None if these tell the side."""
    used = rows[np.isfinite(ping.toa[rows])]
    if not ping.passive:
        used = used[np.isfinite(ping.tx[used]).all(axis=1)]
    if not len(used) or np.isfinite(ping.bearing[used]).any():
        return None
    points = ping.rx[used, :2]
    if not ping.passive:
        points = np.concatenate([ping.tx[used, :2], points])
    return line_through(points, path_noise(ping, used, config))


def path_noise(ping: Arrivals, rows: IndexArray, config: DiverConfig) -> float:
    """Return the standard deviation of the path lengths of `rows`, m, at least that of the assumed
    positions of receivers."""
    variance = (toa_variance(ping, config) + systematic_variance(ping, config))[rows].mean()
    noise = config.sound_speed * math.sqrt(variance)
    if config.systematic_errors != 'exact' and not config.receiver_position_std:
        noise = max(noise, ASSUMED['receiver_position_std'])
    return noise


# -- images --------------------------------------------------------------------------------------


def mirror_rows(rows: Rows, models: ModelSet, layout: Layout, line: Line) -> Rows:
    """Return the mirror image of each row."""
    x, P = models.to_common(rows.blocks)
    share, T = mirror_models(models, layout, line)
    T = T[:, : x.shape[-1], : x.shape[-1]]
    x = x.copy()
    x[..., :2] -= line.point
    moved = np.einsum('jab,Njb->Nja', T, x)
    P = T @ P @ np.swapaxes(T, 1, 2)
    # The weight of model i in the image k; equal where no model of the image is possible.
    weight = np.maximum(rows.mu, 1e-300)[:, :, None] * share
    mu = (rows.mu[:, :, None] * share).sum(axis=1)
    total = weight.sum(axis=1)
    weight = weight / np.where(total > 0.0, total, 1.0)[:, None]
    empty = total <= 0.0  # no image has this model: it keeps its own
    weight[np.nonzero(empty)[0], np.nonzero(empty)[1], np.nonzero(empty)[1]] = 1.0
    mean = np.einsum('Njk,Nja->Nka', weight, moved)
    after = np.einsum('Njk,Njab->Nkab', weight, P)
    for j in range(len(models.names)):
        to = np.flatnonzero(share[j])
        if len(to) > 1 or (weight[:, j, to] < 1.0).any():
            apart = moved[:, j, None] - mean[:, to]
            spread = apart[..., :, None] * apart[..., None, :]
            after[:, to] += weight[:, j, to, None, None] * spread
    mean[..., :2] += line.point
    blocks = models.to_blocks(mean, 0.5 * (after + np.swapaxes(after, -1, -2)))
    return rows.replace(blocks=blocks, mu=mu)


def mirror_models(models: ModelSet, layout: Layout, line: Line) -> tuple[FloatArray, FloatArray]:
    """Return which share (M, M) of a model becomes which model in the mirror, and the maps (M, n +
    q, n + q) of its components about a point on the line.

    Components that are neither position, velocity nor offset of a receiver stay as they are.
    """
    M, n, matrix = len(models.names), models.n, line.matrix
    velocity = [models.outputs.index(name) for name in ('vx', 'vy')]
    V = models.E[:, velocity, 2:]
    share, T = np.eye(M), np.tile(np.eye(layout.size), (M, 1, 1))
    T[:, :2, :2] = matrix
    for place in layout.offsets.values():
        T[:, place : place + 2, place : place + 2] = matrix
    heading, families = _headings(models, V)
    for j in range(M):
        target = j
        if np.isfinite(heading[j]).all():
            others = np.flatnonzero(np.isfinite(heading).all(axis=1) & (families == families[j]))
            share[j] = _shared(matrix @ heading[j], heading, others, M)
            target = int(share[j].argmax())
        used = np.flatnonzero(np.abs(V[j]).sum(axis=0) > 0.0)
        if len(used):
            inner = np.linalg.pinv(V[target][:, used]) @ matrix @ V[j][:, used]
            left, _, right = np.linalg.svd(inner)
            T[j][np.ix_(2 + used, 2 + used)] = left @ right
    return share, T[:, : n + len(layout.variances), : n + len(layout.variances)]


def _headings(models: ModelSet, V: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the unit vectors (M, 2) of models with a heading, NaN for others, and the family (M,)
    of each model. V: (M, 2, n - 2) velocities."""
    kinds = models.families
    if kinds is not None:
        units = np.where((kinds.kind == HEADING)[:, None], kinds.units, np.nan)
        return units, kinds.family
    found = np.full((len(V), 2), np.nan)
    moving = np.flatnonzero(np.abs(V).sum(axis=(1, 2)) > 0.0)
    if len(moving) and (V[moving] != V[moving[0]]).any():
        first = [V[j][:, np.flatnonzero(np.abs(V[j]).sum(axis=0))[0]] for j in moving.tolist()]
        found[moving] = first / np.linalg.norm(first, axis=1, keepdims=True)
    return found, np.zeros(len(V), np.int64)


def _shared(u: FloatArray, heading: FloatArray, others: IndexArray, M: int) -> FloatArray:
    """Return the shares (M,) of the two `others` whose headings are nearest to u (2,)."""
    share = np.zeros(M)
    angle = np.arccos(np.clip(heading[others] @ u, -1.0, 1.0))
    near = np.argsort(angle, kind='stable')[:2]
    total = angle[near].sum()
    if len(near) < 2 or total <= 0.0 or angle[near[0]] < 1e-9:
        share[others[near[0]]] = 1.0
    else:
        share[others[near]] = angle[near[::-1]] / total
    return share


# -- sides of tracks -----------------------------------------------------------------------------


def with_images(rows: Rows, target: int, models: ModelSet, layout: Layout, line: Line) -> Rows:
    """Return the rows of new tracks with the image of each row of one, half the weight each."""
    own = rows.target == target
    halved = evolve(rows, logw=rows.logw - np.where(own, math.log(2.0), 0.0))
    image = mirror_rows(halved.select(np.flatnonzero(own)), models, layout, line)
    parent = np.full(len(image), -1)
    key = {**image.key, 'side': image.key['side'] + 1}
    return halved.append(evolve(image, key=key, parent=parent))


def in_doubt(rows: Rows) -> BoolArray:
    """Return which targets (T,) have more than one side."""
    if not len(rows):
        return np.zeros(0, np.bool_)
    side, first = rows.key['side'], rows.first
    apart = np.maximum.reduceat(side, first) != np.minimum.reduceat(side, first)
    return np.asarray(apart)


class Side(NamedTuple):
    """One side of a track."""

    rows: IndexArray
    """Row indices."""
    weight: float
    """Its probability."""
    mean: FloatArray
    """(4,) position and velocity; (2,) of a position alone."""
    covariance: FloatArray
    """Its covariance."""


def sides_of(known: Known, track: int, models: ModelSet) -> list[Side]:
    """Return the sides of a track, the most probable first."""
    own = known.row_indices(track)
    rows = known.track_rows(track)
    plane = [models.outputs.index(name) for name in ('px', 'py', 'vx', 'vy')]
    mean, covariance = row_outputs(rows, tuple(part.outputs[plane] for part in models.parts))
    found = []
    for side in np.unique(rows.key['side']):
        mine = np.flatnonzero(rows.key['side'] == side)
        weight = rows.weight[mine]
        total = float(weight.sum())
        share = weight / total if total > 0.0 else np.full(len(mine), 1.0 / len(mine))
        centre = share @ mean[mine]
        apart = mean[mine] - centre
        inside = covariance[mine] + apart[:, :, None] * apart[:, None]
        whole = np.einsum('k,kab->ab', share, inside)
        found.append(Side(own[mine], total, centre, whole))
    return sorted(found, key=lambda side: -side.weight)


def doubt_near_line(known: Known, models: ModelSet, layout: Layout, line: Line | None) -> Known:
    """Give each side that lies near the line, if there is one, its image.

    An image that is already a side of the track is replaced.
    """
    if line is None:
        return known
    kept, logw = np.ones(len(known.rows), np.bool_), known.rows.logw.copy()
    new: list[Rows] = []
    for track in range(len(known)):
        sides = sides_of(known, track, models)
        count, label = len(sides), int(known.rows.key['side'][known.row_indices(track)].max())
        while sides:
            side = sides.pop(0)
            share = crossed_share(side, line)
            if share < ROW_LOST or side.weight <= 0.0:
                continue
            image, other = line.image(side.mean[:2]), 0.0
            twin = next((each for each in sides if _is_at(each, image, side)), None)
            if twin is not None:
                sides.remove(twin)
                kept[twin.rows] = False
                other = twin.weight
            elif count == MOST_SIDES:
                continue
            count, label = count + (twin is None), label + 1
            mirrored = mirror_rows(known.rows.select(side.rows), models, layout, line)
            key = {**mirrored.key, 'side': np.full(len(mirrored), label)}
            stays = (1.0 - share) * side.weight + share * other
            beyond = share * side.weight + (1.0 - share) * other
            image_logw = logw[side.rows] + math.log(beyond / side.weight)
            logw[side.rows] += math.log(stays / side.weight)
            parent = np.full(len(mirrored), -1)
            new.append(evolve(mirrored, logw=image_logw, key=key, parent=parent))
    if not new:
        return known
    left = np.flatnonzero(kept)
    rows = evolve(known.rows, logw=logw).select(left)
    rows = evolve(rows, parent=known.rows.parent[left])
    for images in new:
        rows = rows.append(images)
    return known.replace(rows=rows)


def crossed_share(side: Side, line: Line) -> float:
    """Return which share of a side lies beyond the line, at its image: see the module."""
    across = line.across
    distance = float(across @ (side.mean[:2] - line.point))
    variance = float(across @ side.covariance[:2, :2] @ across)
    if not variance > 0.0:
        return 0.0
    return 1.0 / (1.0 + math.exp(min(2.0 * distance**2 / variance, 700.0)))


def _is_at(side: Side, place: FloatArray, other: Side) -> bool:
    """Return whether a side lies at a place (2,), the image of `other`."""
    apart = side.mean[:2] - place
    spread = (side.covariance + other.covariance)[:2, :2]
    return bool(apart @ np.linalg.solve(spread, apart) < SAME)


def hold_sides(before: FloatArray, after: FloatArray, side: IntArray) -> FloatArray:
    """Return log weights `after` (k,) of the rows of a track, with the shares of the sides as they
    were `before`."""
    held, every = after.copy(), np.zeros(len(after), np.int64)

    def growth(own: BoolArray) -> float:
        return float(log_sum(after[own], every[own])[0] - log_sum(before[own], every[own])[0])

    whole = growth(every == 0)
    for each in np.unique(side):
        own = side == each
        held[own] += whole - growth(own)
    return held


def with_sides_of(before: Rows, after: Rows) -> Rows:
    """Return the rows `after`, the same rows as `before`, with the side weights of `before`."""
    logw = after.logw.copy()
    for target in np.flatnonzero(in_doubt(before)).tolist():
        own = before.target == target
        logw[own] = hold_sides(before.logw[own], after.logw[own], before.key['side'][own])
    return after.replace(logw=logw)


def drop_sides(known: Known, models: ModelSet, line: Line | None = None) -> Known:
    """End the sides of negligible weight, and the lighter of two that came together; none after a
    ping of a `line` that tells nothing."""
    rows = known.rows
    doubtful = in_doubt(rows)
    if not doubtful.any() or line is not None and line.tells_nothing:
        return known
    kept, logw = np.ones(len(rows), np.bool_), rows.logw.copy()
    for track in np.flatnonzero(doubtful).tolist():
        left: list[Side] = []
        for side in sides_of(known, track, models):
            heavier = next((other for other in left if _are_together(side, other)), None)
            if heavier is None and side.weight >= ROW_LOST:
                left.append(side)
                continue
            kept[side.rows] = False
            if heavier is not None:
                logw[heavier.rows] += math.log1p(side.weight / heavier.weight)
    if kept.all():
        return known
    index = np.flatnonzero(kept)
    rows = evolve(evolve(rows, logw=logw).select(index), parent=rows.parent[index])
    label = np.where(in_doubt(rows)[rows.target], rows.key['side'], 0)
    return known.replace(rows=rows.replace(key={**rows.key, 'side': label}))


def _are_together(side: Side, other: Side) -> bool:
    """Return whether two sides are at one place, with one velocity."""
    apart = side.mean - other.mean
    spread = side.covariance + other.covariance
    return bool(apart @ np.linalg.solve(spread, apart) < TOGETHER)


def without_images(
    places: Sequence[tuple[FloatArray, FloatArray]], line: Line
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the places, position (2,) and covariance (2, 2), that are no image of an earlier
    one."""
    left: list[Side] = []
    none = np.empty(0, np.intp)
    for position, covariance in places:
        place = Side(none, 1.0, position, covariance)
        if not any(_is_at(place, line.image(other.mean), other) for other in left):
            left.append(place)
    return [(place.mean, place.covariance) for place in left]


def count_doubts(known: Known) -> Known:
    """Return the state with the number of pings in doubt."""
    doubts = np.where(in_doubt(known.rows), known['doubts'] + 1, 0)
    return known.with_columns(doubts=doubts)


# -- what is published ---------------------------------------------------------------------------


def likely_positions(known: Known, models: ModelSet, mean: FloatArray) -> FloatArray:
    """Return `mean` (T, q) with the positions of tracks in doubt on their most probable side."""
    if not in_doubt(known.rows).any():
        return mean
    place = mean.copy()
    for track in np.flatnonzero(in_doubt(known.rows)).tolist():
        place[track, :2] = sides_of(known, track, models)[0].mean[:2]
    return place


def side_columns(known: Known, models: ModelSet) -> dict[str, FloatArray]:
    """Return the published columns: the probability of the most probable side, and the position of
    the next."""
    out = {name: np.full(len(known), np.nan) for name in ('side_probability', 'mirror_x')}
    out['mirror_y'] = out['mirror_x'].copy()
    for track in np.flatnonzero(in_doubt(known.rows)).tolist():
        first, second, *_ = sides_of(known, track, models)
        out['side_probability'][track] = first.weight
        out['mirror_x'][track], out['mirror_y'][track] = second.mean[:2]
    return out


def warnings(known: Known, models: ModelSet) -> list[str]:
    """Return the warning while a confirmed track may be at two places."""
    doubtful = in_doubt(known.rows) & (known['doubts'] >= LASTING)
    for track in np.flatnonzero(doubtful & (known.life.status != TENTATIVE)).tolist():
        first, *others = sides_of(known, track, models)
        if not all(_is_at(other, first.mean[:2], first) for other in others):
            return [NOT_TOLD]
    return []
