# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The jobs of a survey: a line or a tile each, with what they keep for the next.

What a job makes is a file below ``.work`` in the folder of the survey, with a signature of all
that it was made from beside it; one with the same signature is kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import hashlib
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from attrs import asdict, astuple, evolve, frozen
import numpy as np

from sonar_imm import __version__
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.files import whole

from ..offline.run_folder import fingerprint, finite
from ..recordings.export.points import origin_of, read_points
from ..recordings.sources import BagError
from ..recordings.writer import naming
from .grid import Box, grid_of_looks, HALO, Soundings
from .line import budget_of, Line, line_of, without_far
from .looks import Looks, looks_of

TILE = 64
"""Cells along the side of a tile."""
LONGEST_SECONDS = 1800.0
"""A longer line has more than one tide."""
_FLOATS = ('D', 'Y', 'noise', 'geometry', 'speed', 'port')
_STORED = dict.fromkeys(_FLOATS, 'f4') | {'s': 'i1', 'label': 'u1'}


@frozen(kw_only=True)
class Options:
    """What is asked for. resolution: cell in m, 0: by depth. epsg: 0 for none. origin (3,): map
    coordinates of the origin of the navigation. frame: latitude, longitude and height of the
    origin that the first line with one states, None for none. fixed: names of lines whose tide is
    known."""

    resolution: float = 0.0
    adjusted: bool = False
    fixed: tuple[str, ...] = ()
    epsg: int = 0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame: tuple[float, float, float] | None = None


@frozen(kw_only=True)
class Source:
    """The table of a line, or its recording.

    name: as the products say. folder: where it is. run: the content of its run.json; None for a
    table or recording without one. failure: why the line is left out; empty when it is not.
    """

    name: str
    folder: Path
    table: Path
    run: Mapping[str, Any] | None
    failure: str = ''


@frozen(kw_only=True)
class Tile:
    """A tile of 64 x 64 cells of `cell` metres, by column i and row j of such tiles."""

    cell: float
    i: int
    j: int

    @property
    def name(self) -> str:
        return f'L{self.cell:g}_{self.i}_{self.j}'

    @property
    def box(self) -> Box:
        """First column and row, columns and rows of its cells."""
        return self.i * TILE, self.j * TILE, TILE, TILE


@frozen(kw_only=True)
class Unit:
    """A line, or half an hour of one: what has corrections of its own. number: its place in the
    order of names; file: its soundings; signature: of their content."""

    name: str
    line: str
    number: int
    file: Path
    signature: str
    soundings: int
    depth: float


def import_line(source: Source, place: Path, options: Options) -> dict[str, Any]:
    """Read a line and keep its soundings at `place` (a path without ending), in pieces of half an
    hour; gives what survey.json says of it. Nothing is read again when size and time, or the
    content, are those of before. Raises `BagError`."""
    table = source.table
    files = [table] if table.is_file() else [item for item in table.rglob('*') if item.is_file()]
    stats = [file.stat() for file in files]
    size, mtime_ns = sum(s.st_size for s in stats), max(s.st_mtime_ns for s in stats)
    budget, sound_speed = budget_of(source.run)
    own, frame = origin_of(source.run, source.name), options.frame
    if own is None and frame and not any(options.origin):
        raise BagError(
            f'other lines state where their frame lies on Earth (origin) and {source.name} does '
            'not: track it with --set origin=[LATITUDE,LONGITUDE,HEIGHT]'
        )
    wanted = {
        'version': __version__,
        'origin': list(options.origin),
        'epsg': options.epsg,
        'frames': [own and list(astuple(own)), frame and list(frame)],
        'budget': [*asdict(budget).values(), sound_speed],
    }
    known = _known_line(place)
    info: dict[str, Any] = {'size': size, 'mtime_ns': mtime_ns}
    if known is not None and known['wanted'] == wanted and known['info']['size'] == info['size']:
        if known['info']['mtime_ns'] == info['mtime_ns']:
            return dict(known['info'])
        if known['info']['sha256'] == fingerprint(source.table)['bag_sha256']:
            return dict(known['info'])
    there = frame and Origin(*frame)
    points = read_points(source.table).placed(own, options.epsg, options.origin, there)
    if not len(points):
        raise BagError(f'{source.table} has no soundings')
    used = ('x', 'y', 'z', 'vertical_uncertainty', 'range', 'beam_angle', 'side')
    if not all(np.isfinite(points[name]).all() for name in used):
        raise BagError(f'{source.table} has soundings that are not finite')
    line = line_of(without_far(points), budget, sound_speed)
    seconds = (line.stamp_ns[-1] - line.stamp_ns[0]) * 1e-9
    count = max(1, math.ceil(seconds / LONGEST_SECONDS))
    edges = line.stamp_ns[0] + (np.arange(1, count) * seconds / count * 1e9).astype(np.int64)
    place.with_suffix('.json').unlink(missing_ok=True)
    pieces = np.split(np.arange(len(line)), np.searchsorted(line.stamp_ns, edges))
    for k, rows in enumerate(pieces):
        piece = {'table': _table(_columns(line.chosen(rows))), 'sound_speed': line.sound_speed}
        save_arrays(place.with_name(f'{place.name}-{k}.npz'), piece)
    info |= {
        'sha256': fingerprint(source.table)['bag_sha256'],
        'soundings': len(line),
        'far': len(points) - len(line),
        'pieces': count,
        'depth': float(np.median(-line.z)),
        'bounds': [*line.xy.min(axis=0).tolist(), *line.xy.max(axis=0).tolist()],
    }
    write_json(place.with_suffix('.json'), {'wanted': wanted, 'info': info})
    return info


def _known_line(place: Path) -> dict[str, Any] | None:
    """Return what an earlier command kept of a line, None where nothing can be used."""
    known = kept(place.with_suffix('.json'))
    info = known.get('info') if isinstance(known, dict) else None
    whole = {'size', 'mtime_ns', 'sha256', 'soundings', 'far', 'pieces', 'depth', 'bounds'}
    return known if isinstance(info, dict) and whole <= info.keys() and 'wanted' in known else None


def line_statistics(unit: Unit, corrections: FloatArray, cell: float, place: Path) -> None:
    """Keep the looks of a unit at corrected places."""
    signature = signed(unit.signature, corrections, cell)
    if kept(place.with_suffix('.json')) == signature:
        return
    looks = looks_of(_load(unit.file).corrected(corrections), cell).numbered(unit.number)
    columns = asdict(looks, recurse=False, filter=lambda field, _: field.name != 'cell')
    _save_table(place, columns)
    write_json(place.with_suffix('.json'), signature)


def tile_line(
    unit: Unit, corrections: FloatArray, tiles: Sequence[Tile], place: Path
) -> dict[str, tuple[int, int]]:
    """Keep the corrected soundings of a unit sorted by tile: first row and end of each tile's."""
    signature = signed(unit.signature, corrections, [tile.name for tile in tiles])
    known = kept(place.with_suffix('.json'))
    if isinstance(known, dict) and known.get('signature') == signature:
        return {name: (a, b) for name, (a, b) in known['rows'].items()}
    line = _load(unit.file).corrected(corrections)
    of_tile = np.full(len(line), len(tiles))
    for cell in sorted({tile.cell for tile in tiles}):
        index = np.floor(line.xy / (cell * TILE)).astype(np.int64)
        number = {(tile.i, tile.j): k for k, tile in enumerate(tiles) if tile.cell == cell}
        found, inverse = np.unique(index, axis=0, return_inverse=True)
        numbers = np.array([number.get((i, j), len(tiles)) for i, j in found.tolist()])
        of_tile = np.minimum(of_tile, numbers[inverse.ravel()])
    order = np.argsort(of_tile, kind='stable')
    line, of_tile = line.chosen(order), of_tile[order]
    _save_table(place, _columns(line))
    rows = {}
    for k in np.unique(of_tile[of_tile < len(tiles)]).tolist():
        rows[tiles[k].name] = tuple(np.searchsorted(of_tile, [k, k + 1]).tolist())
    content = {'signature': signature, 'rows': rows, 'sound_speed': line.sound_speed}
    write_json(place.with_suffix('.json'), content)
    return rows


@frozen(kw_only=True)
class TileJob:
    """What a tile is made from. parts: of each unit that is near, its number, file and the rows to
    read; covariance (L, 6, L, 6) of their corrections, or None; place: without ending."""

    tile: Tile
    parts: Sequence[tuple[int, Path, Sequence[tuple[int, int]]]]
    signature: str
    budget: ErrorBudget
    covariance: FloatArray | None
    crossing_rms: float
    place: Path


def make_tile(job: TileJob) -> None:
    """Keep the nodes of a tile."""
    if kept(job.place.with_suffix('.json')) == job.signature:
        return
    lines, numbers = [], []
    low = (np.array(job.tile.box[:2]) - HALO) * job.tile.cell
    high = (np.array(job.tile.box[:2]) + TILE + HALO) * job.tile.cell
    for k, (_, source, ranges) in enumerate(job.parts):
        table = np.load(source, mmap_mode='r', allow_pickle=False)
        rows = np.concatenate([np.array(table[a:b]) for a, b in ranges])
        rows = rows[np.all((rows['xy'] >= low) & (rows['xy'] < high), axis=1)]
        rows = rows[np.lexsort((rows['xy'][:, 1], rows['xy'][:, 0], rows['stamp_ns']))]
        sound_speed = json.loads(source.with_suffix('.json').read_text())['sound_speed']
        lines.append(_line(rows, sound_speed))
        numbers.append(np.full(len(rows), k))
    soundings = Soundings(Line.joined(lines), np.concatenate(numbers))
    nodes = grid_of_looks(
        soundings, job.tile.cell, job.tile.box, job.budget, job.covariance, job.crossing_rms
    )
    number = np.array([part[0] for part in job.parts])
    nodes = evolve(nodes, seen_line=number[nodes.seen_line])
    job.place.with_suffix('.json').unlink(missing_ok=True)
    save_arrays(job.place, asdict(nodes, recurse=False))
    write_json(job.place.with_suffix('.json'), job.signature)


def _table(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Columns (n, ...) as one array of rows."""
    fields: list[Any] = [(k, v.dtype, v.shape[1:]) for k, v in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), fields)
    for name, values in columns.items():
        table[name] = values
    return table


def _save_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    path.with_suffix('.json').unlink(missing_ok=True)  # no signature beside what it is not of
    with naming(path), whole(path, follow=False) as unfinished, unfinished.open('wb') as file:
        # To a file itself numpy writes in a way that does not say why it failed.
        stream: Any = SimpleNamespace(write=file.write)
        np.save(stream, _table(columns))


def _columns(line: Line) -> dict[str, np.ndarray]:
    columns = {name: getattr(line, name) for name in ('stamp_ns', 'xy', 'z')}
    return columns | {k: getattr(line, k).astype(kind) for k, kind in _STORED.items()}


def _line(table: np.ndarray, sound_speed: float) -> Line:
    columns: dict[str, Any] = {
        name: np.ascontiguousarray(table[name]).astype(
            np.int64 if name in ('stamp_ns', 'label') else np.float64
        )
        for name in table.dtype.names or ()
    }
    return Line(**columns, sound_speed=sound_speed)


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write named arrays as one npz."""
    with whole(path, follow=False) as unfinished, unfinished.open('wb') as file:
        np.savez(file, **arrays)


def _load(path: Path) -> Line:
    with np.load(path, allow_pickle=False) as kept:
        return _line(kept['table'], float(kept['sound_speed']))


class KeptLooks(Sequence[Looks]):
    """The looks of lines, each read from its file when it is asked for."""

    def __init__(self, places: Sequence[Path], cell: float):
        self._places, self._cell = places, cell

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, k: Any) -> Any:
        table = np.load(self._places[k], allow_pickle=False)
        columns = {name: np.ascontiguousarray(table[name]) for name in table.dtype.names}
        return Looks(self._cell, **columns)


def signed(*parts: Any) -> str:
    """A text that differs when any part does."""
    digest = hashlib.sha256()
    for part in parts:
        content = part.tobytes() if isinstance(part, np.ndarray) else json.dumps(part).encode()
        digest.update(str(len(content)).encode() + b':' + content)
    return digest.hexdigest()


def kept(path: Path) -> Any:
    """What a JSON file says, None where there is none that can be read."""
    try:
        return json.loads(path.read_text(encoding='utf-8'))
    except (OSError, ValueError, RecursionError):
        return None


def write_json(path: Path, content: Any) -> None:
    with whole(path, follow=False) as unfinished:
        unfinished.write_text(json.dumps(finite(content), indent=1) + '\n', encoding='utf-8')
