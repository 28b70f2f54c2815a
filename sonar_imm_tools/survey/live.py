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

"""A chart that grows while lines are run: the grid of looks, tile by tile.

Pings are put to the line that is being run; a new one begins after a silence, or when the ship has
turned. Only tiles whose soundings changed are made again. Nothing is adjusted: what a line has in
common with itself is in the uncertainty, what lines differ by makes competing depths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import math

from attrs import define, Factory
import numpy as np

from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import FloatArray, IntArray

from ..recordings.export.points import Points
from .grid import grid_of_looks, HALO, Nodes, Soundings
from .jobs import TILE
from .line import joined_lines, line_of

SILENCE_NS = 30_000_000_000
"""A line ends when no ping comes for so long,"""
TURN = math.cos(math.radians(45.0))
"""or when the direction to port has turned by so much from that at its begin."""
COLUMNS: dict[str, type] = {
    'x': np.float32,
    'y': np.float32,
    'z': np.float32,
    'uncertainty': np.float32,
    'count': np.uint32,
    'lines': np.uint16,
    'hypotheses': np.uint16,
    'competing_z': np.float32,
    'label': np.uint8,
    'px': np.float64,
    'py': np.float64,
}
"""Of the nodes as a table: places m, uncertainty (one standard deviation) m, NaN where nothing
competes; px py: x and y exactly."""


@define(eq=False)
class LiveChart:
    """cell m; budget: errors that a ping or a line has in common; sound_speed m/s: supposed by
    the tracker."""

    cell: float
    budget: ErrorBudget
    sound_speed: float = 1500.0
    lines: int = 0
    _waiting: list[tuple[int, Mapping[str, np.ndarray]]] = Factory(list)
    _parts: dict[tuple[int, int], list[Soundings]] = Factory(dict)
    _nodes: dict[tuple[int, int], Nodes] = Factory(dict)
    _changed: dict[tuple[int, int], None] = Factory(dict)
    _last_ns: int = 0
    _port: FloatArray | None = None

    def add(self, stamp_ns: int, columns: Mapping[str, np.ndarray]) -> None:
        """Take a ping: columns (n,) as in `sonar_imm.soundings.COLUMNS`."""
        if len(columns['x']):
            self._waiting.append((stamp_ns, columns))

    def place(self) -> None:
        """Put the pings that came since to their line and into their tiles."""
        if not self._waiting:
            return
        pings, self._waiting = sorted(self._waiting, key=lambda ping: ping[0]), []
        stamps = np.repeat([stamp for stamp, _ in pings], [len(p['x']) for _, p in pings])
        values = {
            name: np.concatenate([np.asarray(ping[name], np.float64) for _, ping in pings])
            for name in pings[0][1]
        }
        values |= {name: values[f'p{name}'] for name in 'xyz' if f'p{name}' in values}
        points = Points(stamps.astype(np.int64), values)
        line = line_of(points, self.budget, self.sound_speed)
        first = np.flatnonzero(np.diff(line.stamp_ns, prepend=-1))
        number = np.empty(len(first), np.int64)
        for k, row in enumerate(first.tolist()):
            number[k] = self._line_at(int(line.stamp_ns[row]), line.port[row])
        soundings = Soundings(line, np.repeat(number, np.diff(np.append(first, len(line)))))
        tile = np.floor(line.xy / (self.cell * TILE)).astype(np.int64)
        found, of_tile = np.unique(tile, axis=0, return_inverse=True)
        for k, (i, j) in enumerate(found.tolist()):
            part = soundings.chosen(of_tile.ravel() == k)
            self._parts.setdefault((i, j), []).append(part)
            near = np.floor(part.line.xy / self.cell).astype(np.int64)
            low = (near.min(axis=0) - HALO) // TILE
            high = (near.max(axis=0) + HALO) // TILE
            for a in range(int(low[0]), int(high[0]) + 1):
                for b in range(int(low[1]), int(high[1]) + 1):
                    self._changed[a, b] = None

    def _line_at(self, stamp_ns: int, port: FloatArray) -> int:
        """The number of the line that a ping belongs to."""
        silent = abs(stamp_ns - self._last_ns) > SILENCE_NS
        turned = self._port is not None and float(port @ self._port) < TURN
        known = bool(port.any())
        if self.lines == 0 or silent or (turned and known):
            self.lines += 1
            self._port = None
        if self._port is None and known:
            self._port = port
        self._last_ns = stamp_ns
        return self.lines - 1

    def remade(self) -> Iterator[tuple[int, int]]:
        """Make each tile that changed again; gives its column and row, so that a caller may do
        other things between two of them."""
        self.place()
        while self._changed:
            i, j = next(iter(self._changed))
            del self._changed[i, j]
            if (i, j) in self._parts:
                box = i * TILE, j * TILE, TILE, TILE
                near = self._near(i, j)
                self._nodes[i, j] = grid_of_looks(near, self.cell, box, self.budget)
                yield i, j

    def _near(self, i: int, j: int) -> Soundings:
        """The soundings of a tile and of those around it, sorted by line, stamp, x and y."""
        parts = [
            part
            for a in (i - 1, i, i + 1)
            for b in (j - 1, j, j + 1)
            for part in self._parts.get((a, b), ())
        ]
        line = joined_lines([part.line for part in parts])
        number = np.concatenate([part.number for part in parts])
        order = np.lexsort((line.xy[:, 1], line.xy[:, 0], line.stamp_ns, number))
        return Soundings(line.chosen(order), number[order])

    def table(self) -> dict[str, np.ndarray]:
        """All nodes by `COLUMNS`, sorted by tile, column and row."""
        whole = _of([self._nodes[key] for key in sorted(self._nodes)])
        x, y = self.cell * (whole('ix') + 0.5), self.cell * (whole('iy') + 0.5)
        values = {'x': x, 'y': y, 'z': whole('z'), 'uncertainty': whole('sd'), 'px': x, 'py': y}
        for name in ('count', 'lines', 'hypotheses', 'competing_z', 'label'):
            values[name] = whole(name)
        return {name: values[name].astype(kind) for name, kind in COLUMNS.items()}

    def floor(self, tiles: Iterable[tuple[int, int]]) -> tuple[FloatArray, FloatArray]:
        """Places (n, 3) and variances (n,) of the nodes of some tiles, m and m^2."""
        whole = _of([self._nodes[tile] for tile in tiles])
        level = self.cell * (np.column_stack([whole('ix'), whole('iy')]) + 0.5)
        return np.column_stack([level, whole('z')]), np.square(whole('sd'))

    def picture(self) -> tuple[int, int, IntArray]:
        """First column and row, and the cells (rows, columns) from 0, the deepest of them, to 100,
        the shoalest; -1 where nothing is known. What `nav_msgs/OccupancyGrid` holds."""
        tiles = list(self._nodes.values())
        if not any(len(nodes.z) for nodes in tiles):
            return 0, 0, np.zeros((0, 0), np.int64)
        ix, iy = (np.concatenate([getattr(n, name) for n in tiles]) for name in ('ix', 'iy'))
        z = np.concatenate([nodes.z for nodes in tiles])
        cells = np.full((int(np.ptp(iy)) + 1, int(np.ptp(ix)) + 1), -1, np.int64)
        span = max(float(np.ptp(z)), 1e-6)
        cells[iy - iy.min(), ix - ix.min()] = np.rint(100.0 * (z - z.min()) / span)
        return int(ix.min()), int(iy.min()), cells


def _of(tiles: Sequence[Nodes]) -> Callable[[str], FloatArray]:
    """What gives a field of all nodes of tiles."""
    return lambda name: np.concatenate([getattr(nodes, name) for nodes in tiles] or [np.zeros(0)])
