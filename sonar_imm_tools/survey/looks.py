# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Looks: what one line sees of one cell with one side, and the gradient of the floor from them.

A look is the unit of vote and weight: its soundings share what a line and a ping have in common.
Statistics of looks are all that the adjustment needs of a line, some hundred bytes per look.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math

from attrs import evolve, frozen
import numpy as np

from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray

from .line import BASIS, Line, medians, Rows

MAD = 1.4826
"""Standard deviation of normal errors over their median absolute deviation."""
FLOOR = 0.02**2
"""Variance of a look's height that no number of soundings reduces: terrain inside the cell."""
GRADIENT_STD = 0.2
SLOPE_STD = 0.5
"""Prior of both components of a gradient."""
STEEPEST = 1.0
FURTHEST = 3
"""Cells between which a look's heights are compared: pings may be further apart than cells."""
LOOKS_AT_ONCE = 400_000
"""About so many looks are in memory at once, whatever the survey."""


@frozen(eq=False)
class Looks(Rows):
    """Statistics (m,) of looks, sorted by cell, line and side.

    ix, iy: cell number, whole multiples of `cell`; line, side: numbers; count of members; time:
    mean stamp, s; z: mean height; place (m, 2): mean place less the centre of the cell; noise:
    mean own variance; moments (m, 6): sums of squares and products of x, y, z about their means,
    in the order xx xy yy xz yz zz; basis (m, 9): means of `Line.basis`.
    """

    cell: float
    ix: IntArray
    iy: IntArray
    line: IntArray
    side: IntArray
    count: FloatArray
    time: FloatArray
    z: FloatArray
    place: FloatArray
    noise: FloatArray
    moments: FloatArray
    basis: FloatArray

    def __len__(self) -> int:
        return len(self.z)

    def numbered(self, line: int) -> Looks:
        """The same as looks of line number `line`."""
        return evolve(self, line=np.full(len(self), line, np.int64))

    def heights(self, g: FloatArray) -> FloatArray:
        """Heights (m,) at the centres of the cells, on gradients g (m, 2)."""
        return np.asarray(self.z - (g * self.place).sum(axis=1))

    def variances(self, g: FloatArray) -> FloatArray:
        """Variances (m,) of heights: the larger of own noise and scatter about the plane, of half
        as many soundings, since neighbours along a ping share the errors of the filter; and of the
        way from their mean place to the centre, on a gradient that is known to `GRADIENT_STD`."""
        xx, xy, yy, xz, yz, zz = self.moments.T
        gx, gy = g.T
        squares = zz - 2.0 * (gx * xz + gy * yz) + gx * gx * xx + 2.0 * gx * gy * xy + gy * gy * yy
        scatter = np.maximum(squares, 0.0) / np.maximum(self.count - 1.0, 1.0)
        height = np.maximum(self.noise, scatter) / (0.5 * (self.count + 1.0))
        carried = GRADIENT_STD**2 * np.square(self.place).sum(axis=1)
        return np.asarray(height + FLOOR + carried)


def looks_of(line: Line, cell: float, number: IntArray | int = 0) -> Looks:
    """The looks of a line at cells of `cell` metres; number: of the line, or of each sounding's.

    Members lie within three deviations of the median, by its scatter or their own noise.
    """
    index = np.floor(line.xy / cell).astype(np.int64)
    side = (line.s < 0.0).astype(np.int64)
    of_line = np.broadcast_to(np.asarray(number, np.int64), side.shape)
    order = np.lexsort((line.z, side, of_line, index[:, 1], index[:, 0]))
    starts, counts, group = runs_of(index[order, 0], index[order, 1], of_line[order], side[order])
    z = line.z[order]
    off = np.abs(z - medians(z, starts, counts)[group])
    by_size = np.lexsort((off, group))
    scatter = MAD * medians(off[by_size], starts, counts)[group]
    kept = off <= 3.0 * np.maximum(scatter, np.sqrt(line.noise[order]))
    order = order[kept]
    # The sounding at the median is always a member, so that no group is lost.
    starts, counts, group = runs_of(group[kept])
    first = order[starts] if len(starts) else order[:0]
    n = counts.astype(np.float64)

    def mean(values: FloatArray) -> FloatArray:
        if not len(starts):
            return np.zeros((0, *values.shape[1:]))
        return np.asarray((np.add.reduceat(values, starts, axis=0).T / n).T)

    seconds = np.asarray(line.stamp_ns[order] * 1e-9, np.float64)
    centre = (index[order] + 0.5) * cell
    xyz = np.column_stack([line.xy[order] - centre, line.z[order]])
    middle = mean(xyz)
    dx, dy, dz = (xyz - middle[group]).T
    products = np.column_stack([dx * dx, dx * dy, dy * dy, dx * dz, dy * dz, dz * dz])
    return Looks(
        cell=cell,
        ix=index[first, 0],
        iy=index[first, 1],
        line=of_line[first],
        side=side[first],
        count=n,
        time=mean(seconds),
        z=middle[:, 2],
        place=middle[:, :2],
        noise=mean(line.noise[order]),
        moments=(mean(products).T * n).T,
        basis=mean(line.basis()[order]).reshape(-1, BASIS),
    )


def strips(lines: Sequence[Looks]) -> Iterator[tuple[Looks, BoolArray]]:
    """The floor strip by strip along its longer side: the looks of all lines there, and which of
    them are in the strip and not only near enough for the gradients in it. Each line is taken from
    `lines` for each strip that it meets, so that a sequence may read them from files."""
    ends = np.zeros((len(lines), 2, 2), np.int64)
    sizes = np.zeros(len(lines), np.int64)
    for k, looks in enumerate(lines):
        sizes[k] = len(looks)
        if len(looks):
            ends[k] = [(each.min(), each.max() + 1) for each in (looks.ix, looks.iy)]
    seen = np.flatnonzero(sizes)
    if not len(seen):
        return
    low, high = ends[seen, :, 0].min(axis=0), ends[seen, :, 1].max(axis=0)
    axis = int(np.argmax(high - low))
    count = math.ceil(int(sizes.sum()) / LOOKS_AT_ONCE)
    # Edges at equal shares of all looks, as if those of a line were evenly along it.
    places = np.arange(low[axis], high[axis] + 1)
    first, last = ends[seen, axis].T
    per_cell = np.zeros(len(places))
    density = sizes[seen] / (last - first)
    np.add.at(per_cell, first - low[axis], density)
    np.subtract.at(per_cell, last - low[axis], density)
    total = np.concatenate([[0.0], np.cumsum(np.cumsum(per_cell))[:-1]])
    inner = np.searchsorted(total, total[-1] * np.arange(1, count) / count)
    edges = np.unique([low[axis], *places[inner].tolist(), high[axis]])
    halo = FURTHEST + 1
    for start, end in zip(edges[:-1].tolist(), edges[1:].tolist()):
        near = seen[(first < end + halo) & (last > start - halo)]
        parts = []
        for k in near.tolist():
            looks = lines[k]
            where = (looks.ix, looks.iy)[axis]
            parts.append(looks.chosen((where >= start - halo) & (where < end + halo)))
        together = Looks.joined(parts)
        order = (together.side, together.line, together.iy, together.ix)
        together = together.chosen(np.lexsort(order))
        where = (together.ix, together.iy)[axis]
        yield together, (where >= start) & (where < end)


def gradients(looks: Looks, ix: IntArray, iy: IntArray) -> FloatArray:
    """Gradients (k, 2) of the floor at cells ix, iy (k,), by least squares over 3 x 3 cells.

    Heights are compared within looks, and between a cell and the next one of one line's side only:
    an offset between lines makes no slope. Where little is known the gradient is near zero.
    """
    if not len(looks) or not len(ix):
        return np.zeros((len(ix), 2))
    low = min(looks.ix.min(), ix.min()) - 1, min(looks.iy.min(), iy.min()) - 1
    rows = max(looks.iy.max(), iy.max()) - low[1] + 2
    key = (looks.ix - low[0]) * rows + (looks.iy - low[1])
    cells, inverse = np.unique(key, return_inverse=True)
    # Within looks: soundings of half the count, with their own noise.
    sums = 0.5 * looks.moments[:, :5] / (looks.noise + FLOOR)[:, None]
    pooled = np.zeros((len(cells), 5))
    for k in range(5):
        pooled[:, k] = np.bincount(inverse, sums[:, k], len(cells))
    noise = looks.noise / (0.5 * (looks.count + 1.0)) + FLOOR
    for along, across, axis in ((looks.ix, looks.iy, 0), (looks.iy, looks.ix, 1)):
        order = np.lexsort((along, across, looks.side, looks.line))
        here, there = order[:-1], order[1:]
        apart = along[there] - along[here]
        pairs = (looks.line[there] == looks.line[here]) & (looks.side[there] == looks.side[here])
        pairs &= (across[there] == across[here]) & (apart <= FURTHEST)
        here, there = here[pairs], there[pairs]
        d = looks.place[there] - looks.place[here]
        d[:, axis] += looks.cell * apart[pairs]
        rise = looks.z[there] - looks.z[here]
        weight = 0.5 / (noise[there] + noise[here])
        values = np.column_stack(
            [d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2, d[:, 0] * rise, d[:, 1] * rise]
        )
        for k in range(5):
            for end in (here, there):
                pooled[:, k] += np.bincount(inverse[end], weight * values[:, k], len(cells))
    wanted = (ix - low[0]) * rows + (iy - low[1])
    total = np.zeros((len(ix), 5))
    for shift_x in (-1, 0, 1):
        for shift_y in (-1, 0, 1):
            near = wanted + shift_x * rows + shift_y
            found = np.minimum(np.searchsorted(cells, near), len(cells) - 1)
            total += pooled[found] * (cells[found] == near)[:, None]
    xx, xy, yy, xz, yz = total.T
    xx, yy = xx + 1.0 / SLOPE_STD**2, yy + 1.0 / SLOPE_STD**2
    determinant = xx * yy - xy * xy
    g = np.column_stack([yy * xz - xy * yz, xx * yz - xy * xz]) / determinant[:, None]
    steep = np.hypot(g[:, 0], g[:, 1])
    return np.asarray(g * np.minimum(1.0, STEEPEST / np.maximum(steep, 1e-12))[:, None])


def runs_of(*keys: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Of rows sorted by keys (n,): start and length of groups of equal keys, group of each row."""
    n = len(keys[0])
    fresh = np.zeros(n, bool)
    fresh[:1] = True
    for key in keys:
        fresh[1:] |= key[1:] != key[:-1]
    starts = np.flatnonzero(fresh)
    return starts, np.diff(np.append(starts, n)), np.cumsum(fresh) - 1
