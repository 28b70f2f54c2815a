# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The grid of looks: one depth per cell, how sure it is, and what competes with it.

Soundings within three quarters of a cell of a node are carried to it along the gradient of the
floor, sorted by height and cut where a gap is wider than the errors: the hypotheses. In each, a
line's soundings are one *look*. The own noise of soundings averages within a look; what a line or
a ping has in common (attitude, heave, sound speed: the error budget) does not. Looks, not
soundings, vote: many echoes of fish in one line lose to two lines that saw the floor, and stay
visible as the competing depth. Nothing depends on the order of lines or soundings.

Source: the design is compared with CUBE (Calder and Mayer 2003) in docs/results/survey.md.
"""

from __future__ import annotations

from collections.abc import Iterator

from attrs import frozen
import numpy as np

from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray

from .line import common_variance, Line, medians, PARAMETERS, partials
from .looks import gradients, looks_of, MAD, runs_of

REACH = 0.75
"""Cells from a node to the furthest sounding that it uses."""
FEW, FAR = 5, 1.5
"""A node with fewer soundings than this in reach, one or more, uses those within so many cells:
an outlier that is alone has no other depth beside it."""
HALO = 6
"""Cells around a tile whose soundings its nodes need."""
LEAST_GAP = 0.25
Box = tuple[int, int, int, int]
"""First column and row, columns and rows of cells."""


@frozen(eq=False)
class Soundings:
    """Soundings of several lines, sorted by line, stamp, x and y; number (n,): of their lines."""

    line: Line
    number: IntArray

    def __len__(self) -> int:
        return len(self.number)

    def chosen(self, rows: BoolArray | IntArray) -> Soundings:
        """Some of the soundings."""
        return Soundings(self.line.chosen(rows), self.number[rows])


@frozen(eq=False)
class Nodes:
    """Nodes that saw anything, by column ix and row iy (k,): node at (ix + .5, iy + .5) cells.

    z, sd, competing_z, competing_sd (k,) m; odds (k,) logarithm; NaN where nothing competes.
    count, lines, competing_count, label (k,); hypotheses (k,): of two soundings or more, or 1.
    seen (p,): which looks made the depths, by node (an index into the others), line number, count
    of soundings and residual (look less node, m), sorted by node and line.
    """

    ix: IntArray
    iy: IntArray
    z: FloatArray
    sd: FloatArray
    count: IntArray
    lines: IntArray
    hypotheses: IntArray
    odds: FloatArray
    competing_z: FloatArray
    competing_sd: FloatArray
    competing_count: FloatArray
    label: IntArray
    seen_node: IntArray
    seen_line: IntArray
    seen_count: IntArray
    seen_residual: FloatArray


@frozen(eq=False)
class _Hypotheses:
    """Hypotheses (h,) sorted by node, and their looks (m,)."""

    node: IntArray
    z: FloatArray
    variance: FloatArray
    count: IntArray
    lines: IntArray
    label: IntArray
    score: FloatArray
    look_hypothesis: IntArray
    look_line: IntArray
    look_count: FloatArray
    look_z: FloatArray
    look_weight: FloatArray
    look_partials: FloatArray


def grid_of_looks(
    soundings: Soundings,
    cell: float,
    box: Box,
    budget: ErrorBudget,
    covariance: FloatArray | None = None,
    crossing_rms: float = 0.0,
) -> Nodes:
    """The nodes of a box (first column, first row, columns, rows) of cells of `cell` metres.

    soundings: all of the box and of `HALO` cells around it. covariance (L, 6, L, 6): of the total
    corrections that were applied, by line number and `PARAMETERS`. crossing_rms: added to the
    uncertainty without them, m.
    """
    x0, y0, columns, rows = box
    # Nodes around the box are needed for the medians of the second pass.
    around = (x0 - 2, y0 - 2, columns + 4, rows + 4)
    near, low = soundings.line.xy / cell, np.array([x0, y0]) - HALO
    high = np.array([x0 + columns, y0 + rows]) + HALO
    within = np.all((near >= low) & (near < high), axis=1)
    if not within.all():
        soundings = soundings.chosen(within)
    which, node, d = _pairs(soundings.line.xy, cell, around)
    keys, node = np.unique(node, return_inverse=True)
    ix, iy = keys // around[3] + around[0], keys % around[3] + around[1]
    g = gradients(looks_of(soundings.line, cell, soundings.number), ix, iy)
    found = _hypotheses(soundings, which, node, d, g, cell, budget)
    top, second, odds = _ranked(found, len(keys), found.score)
    surface = np.full((around[2], around[3]), np.nan)
    surface[ix - around[0], iy - around[1]] = found.z[top]
    middle, spread = _neighbourhood(surface)
    m, s = middle[ix - around[0], iy - around[1]], spread[ix - around[0], iy - around[1]]
    off = np.square(found.z - m[found.node])
    wide = np.square(s[found.node]) + found.variance
    top, second, odds = _ranked(found, len(keys), found.score - 2.0 * np.log1p(off / (3.0 * wide)))
    inside = (ix >= x0) & (ix < x0 + columns) & (iy >= y0) & (iy < y0 + rows)
    variance = found.variance + crossing_rms**2
    if covariance is not None:
        variance = variance + _of_corrections(found, covariance)
    return _nodes(found, ix, iy, inside, top, second, odds, np.sqrt(variance))


def tiles_of(soundings: Soundings, cell: float) -> Iterator[tuple[Box, Soundings]]:
    """Boxes of 256 x 256 cells that hold soundings, each with those it needs."""
    size = 256
    index = np.floor(soundings.line.xy / cell).astype(np.int64)
    order = np.argsort(index[:, 0], kind='stable')
    column = index[order, 0]
    tiles = np.unique(index // size, axis=0)
    for tx in np.unique(tiles[:, 0]).tolist():
        ends = tx * size - HALO, (tx + 1) * size + HALO
        first, last = np.searchsorted(column, ends, side='left')
        strip = np.sort(order[first:last])
        row = index[strip, 1]
        for ty in tiles[tiles[:, 0] == tx, 1].tolist():
            near = (row >= ty * size - HALO) & (row < (ty + 1) * size + HALO)
            yield (tx * size, ty * size, size, size), soundings.chosen(strip[near])


def _pairs(xy: FloatArray, cell: float, box: Box) -> tuple[IntArray, IntArray, FloatArray]:
    """Soundings and nodes that are in reach of each other: number of the sounding, key of the node
    in the box, place less the node's (p, 2)."""
    x0, y0, columns, rows = box
    index = np.floor(xy / cell).astype(np.int64)
    inside = xy / cell - index - 0.5
    column, row = index[:, 0] - x0, index[:, 1] - y0

    def ring(
        wide: int, least: float, most: float, wanted: BoolArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Pairs between so many cells, of the nodes that are wanted (columns * rows,)."""
        which, keys, places = [], [], []
        for shift_x in range(-wide, wide + 1):
            for shift_y in range(-wide, wide + 1):
                d = inside - np.array([shift_x, shift_y], np.float64)
                squared = np.square(d).sum(axis=1)
                i, j = column + shift_x, row + shift_y
                near = (squared > least) & (squared <= most)
                near &= (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
                picked = np.flatnonzero(near)
                key = i[picked] * rows + j[picked]
                picked, key = picked[wanted[key]], key[wanted[key]]
                which.append(picked)
                keys.append(key)
                places.append(d[picked] * cell)
        return np.concatenate(which), np.concatenate(keys), np.concatenate(places)

    first = ring(1, -1.0, REACH**2, np.ones(columns * rows, bool))
    count = np.bincount(first[1], minlength=columns * rows)
    few = (count > 0) & (count < FEW)
    if not few.any():
        return first
    second = ring(2, REACH**2, FAR**2, few)
    which, keys, places = (np.concatenate(pair) for pair in zip(first, second))
    return which, keys, places


def _hypotheses(
    soundings: Soundings,
    which: IntArray,
    node: IntArray,
    d: FloatArray,
    g: FloatArray,
    cell: float,
    budget: ErrorBudget,
) -> _Hypotheses:
    """All hypotheses of all nodes, before the votes of neighbours; g (k, 2) by node."""
    line, reach = soundings.line, REACH * cell
    slope = g[node]
    h = line.z[which] - (slope * d).sum(axis=1)
    far = np.square(d).sum(axis=1) / reach**2
    steep = 0.05 + 0.25 * np.hypot(slope[:, 0], slope[:, 1]) * cell
    v = line.noise[which] * (1.0 + far) + np.square(steep) * far
    basis = line.basis()[which]
    common = common_variance(basis, slope, budget, line.sound_speed) + line.geometry[which]
    # Soundings come by line, stamp, x and y: ties keep that order.
    order = np.lexsort((which, h, node))
    which, node, h, v = which[order], node[order], h[order], v[order]
    basis, slope, common = basis[order], slope[order], common[order]
    both = v + common
    gap = np.zeros(len(h), np.int64)
    gap[1:] = np.diff(h) > np.maximum(2.0 * np.sqrt(both[1:] + both[:-1]), LEAST_GAP)
    starts, counts, group = runs_of(node, np.cumsum(gap))
    middle = medians(h, starts, counts)[group]
    off = np.abs(h - middle)
    scatter = MAD * medians(off[np.lexsort((off, group))], starts, counts)[group]
    kept = off <= 3.0 * np.maximum(scatter, np.sqrt(both))
    of_node, size = node[starts], counts
    share = size / np.bincount(node, minlength=len(g))[of_node]

    number = soundings.number[which]
    by_look = np.flatnonzero(kept)
    by_look = by_look[np.lexsort((number[by_look], group[by_look]))]
    firsts, n, look = runs_of(group[by_look], number[by_look])

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values[by_look], firsts, axis=0))

    weight = total(1.0 / v)
    z = total(h / v) / weight
    chi2 = np.add.reduceat(np.square(h[by_look] - z[look]) / v[by_look], firsts)
    count = n.astype(np.float64)
    inflated = np.maximum(1.0, chi2 / np.maximum(count - 1.0, 1.0))
    variance = count / weight * inflated / (0.5 * (count + 1.0)) + total(common) / count
    mean_basis = (total(basis).T / count).T
    hypothesis, look_line = group[by_look][firsts], number[by_look][firsts]
    look_partials = partials(mean_basis, slope[by_look][firsts], line.sound_speed)

    first_look, looks, owner = runs_of(hypothesis)
    weights = np.add.reduceat(1.0 / variance, first_look)
    mean = np.add.reduceat(z / variance, first_look) / weights
    chi2 = np.add.reduceat(np.square(z - mean[owner]) / variance, first_look)
    spread = np.maximum(1.0, chi2 / np.maximum(looks - 1.0, 1.0)) / weights
    votes = np.add.reduceat(1.0 - np.exp(-count / 3.0), first_look)
    label = line.label[which]
    return _Hypotheses(
        node=of_node,
        z=mean,
        variance=spread,
        count=np.add.reduceat(n, first_look),
        lines=looks,
        label=_commonest(owner[look], label[by_look], len(mean)),
        score=2.0 * votes + np.log(share),
        look_hypothesis=owner,
        look_line=look_line,
        look_count=count,
        look_z=z,
        look_weight=1.0 / variance / weights[owner],
        look_partials=look_partials,
    )


def _ranked(
    found: _Hypotheses, nodes: int, score: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Of each node the best hypothesis, the runner-up (-1: none) and how much better (NaN)."""
    order = np.lexsort((found.z, -score, found.node))
    starts, counts, _ = runs_of(found.node[order])
    top = order[starts]
    several = counts > 1
    second = np.full(nodes, -1, np.int64)
    second[several] = order[starts[several] + 1]
    odds = np.full(nodes, np.nan)
    odds[several] = score[top[several]] - score[second[several]]
    return top, second, odds


def _neighbourhood(surface: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Median of 5 x 5 nodes, and their scatter by it."""
    padded = np.pad(surface, 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(-1, 25)
    seen = np.isfinite(surface).ravel()
    middle, spread = np.full(seen.size, np.nan), np.full(seen.size, np.nan)
    middle[seen] = _median_of_rows(windows[seen])
    spread[seen] = MAD * _median_of_rows(np.abs(windows[seen] - middle[seen, None]))
    return middle.reshape(surface.shape), spread.reshape(surface.shape)


def _median_of_rows(values: FloatArray) -> FloatArray:
    """Median of each row (n, 25) without its NaN, of which not all are."""
    ordered = np.sort(values, axis=1)  # NaN last
    n = np.isfinite(ordered).sum(axis=1)
    row = np.arange(len(ordered))
    return np.asarray(0.5 * (ordered[row, (n - 1) // 2] + ordered[row, n // 2]))


def _of_corrections(found: _Hypotheses, covariance: FloatArray) -> FloatArray:
    """a' C a (h,): variance of each hypothesis by what is not known of the corrections."""
    from scipy.sparse import csr_array

    L, K = covariance.shape[0], len(PARAMETERS)
    values = found.look_weight[:, None] * found.look_partials
    columns = found.look_line[:, None] * K + np.arange(K)
    rows = np.repeat(found.look_hypothesis, K)
    a = csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(found.z), L * K))
    half = a @ covariance.reshape(L * K, L * K)
    return np.asarray(np.maximum((a.multiply(half)).sum(axis=1), 0.0)).ravel()


def _nodes(
    found: _Hypotheses,
    ix: IntArray,
    iy: IntArray,
    inside: BoolArray,
    top: IntArray,
    second: IntArray,
    odds: FloatArray,
    sd: FloatArray,
) -> Nodes:
    """What is published of the nodes inside the box."""
    competes = second >= 0

    def competing(values: FloatArray) -> FloatArray:
        return np.asarray(np.where(competes, values[second], np.nan)[inside])

    number = np.full(len(found.z), -1, np.int64)
    number[top[inside]] = np.arange(int(inside.sum()))
    seen = np.flatnonzero(number[found.look_hypothesis] >= 0)
    several = np.bincount(found.node[found.count > 1], minlength=len(ix))
    node = number[found.look_hypothesis[seen]]
    hypothesis = found.look_hypothesis[seen]
    return Nodes(
        ix=ix[inside],
        iy=iy[inside],
        z=found.z[top][inside],
        sd=sd[top][inside],
        count=found.count[top][inside],
        lines=found.lines[top][inside],
        hypotheses=np.maximum(several, 1)[inside],
        odds=odds[inside],
        competing_z=competing(found.z),
        competing_sd=competing(sd),
        competing_count=competing(found.count.astype(np.float64)),
        label=found.label[top][inside],
        seen_node=node,
        seen_line=found.look_line[seen],
        seen_count=found.look_count[seen].astype(np.int64),
        seen_residual=found.look_z[seen] - found.z[hypothesis],
    )


def _commonest(group: IntArray, label: IntArray, groups: int) -> IntArray:
    """The commonest label (g,) of each group, the smaller one of equals."""
    kinds = int(label.max(initial=0)) + 1
    votes = np.bincount(group * kinds + label, minlength=groups * kinds).reshape(groups, kinds)
    return np.asarray(votes.argmax(axis=1), np.int64)
