# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One chart of many lines: which lines there are, which jobs they take, and in which order.

A job is a line or a tile, see `jobs`. The statistics of lines and the products of tiles are put
together in this process, in the order of names and numbers: which process did what, and when it
ended, changes no byte. In one file, from the first look at the folders to the last tile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
import hashlib
import math
import os
from pathlib import Path
from typing import Any

from attrs import asdict, evolve, frozen
import numpy as np

from sonar_imm import __version__
from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.files import marked
from sonar_imm.parameters import ConfigError

from ..evaluation.numbers import counted
from ..offline.jobs import Calls, Run, Work
from ..offline.run_folder import BAG, CSV, PARQUET, RUN, RunFolder, SOUNDINGS
from ..offline.run_folder import KIND as RESULTS
from ..recordings.export.points import origin_of, TOPIC, topics_of_soundings
from ..recordings.reader import BagReader
from ..recordings.sources import BagError, is_recording
from .adjustment import Adjustment
from .chart import MOST_CELLS
from .grid import HALO, Nodes
from .jobs import (
    import_line,
    kept,
    KeptLooks,
    line_statistics,
    make_tile,
    Options,
    signed,
    Source,
    TILE,
    Tile,
    tile_line,
    TileJob,
    Unit,
)
from .line import budget_of, Rows, unstated
from .looks import Looks
from .resuming import adjust_lines, find_misties, Misties

WORK, SURVEY = '.work', 'survey.json'
_STATED = ('soundings', 'far', 'size', 'mtime_ns', 'sha256', 'bounds')
"""What survey.json says of a line."""
FINEST, COARSEST = 0.25, 16.0
LEAST_SOUNDINGS = 5.0
STATISTICS_CELL = 2.0


def sources_of(runs: Path) -> list[Source]:
    """The lines below a folder, sorted by name: folders with a table of soundings, and recordings
    of `~/soundings` that are not of such a folder. Raises `BagError` for none."""
    if not runs.is_dir():
        raise BagError(f'{runs} is no folder')
    found: dict[Path, Path] = {}
    for name in (SOUNDINGS, PARQUET[SOUNDINGS]):  # the later one is read
        found |= {path.parent: path for path in sorted(runs.rglob(name)) if WORK not in path.parts}
    # Bags, and files of bags that lie alone.
    bags = {path.parent for path in runs.rglob('metadata.yaml')}
    files = (path for path in runs.rglob('*') if is_recording(path) and path.is_file())
    alone = {path for path in files if path.parent not in bags}
    for place in sorted(path for path in bags | alone if WORK not in path.parts):
        # The bag of a run whose table is gone stands for it.
        bag = place if place.is_dir() else place.parent
        folder = bag.parent if bag.name == BAG and _is_results(bag.parent) else place
        known = {folder, place.parent, bag.parent} & found.keys()
        if not known and _has_soundings(place):
            found[folder] = place
    if not found:
        raise BagError(
            f'{runs} holds no line: there is no {SOUNDINGS} or {PARQUET[SOUNDINGS]}, and no '
            f'recording with a topic {TOPIC}; sonar-imm track makes them'
        )
    names = [folder.stem if folder.is_file() else folder.name for folder in found]
    sources = []
    for last, (folder, table) in zip(names, found.items()):
        below = folder.relative_to(runs).as_posix()
        unique = names.count(last) == 1 and below != '.'
        name = last if unique else runs.resolve().name if below == '.' else below
        run, failure = _run_of(folder)
        sources.append(Source(name=name, folder=folder, table=table, run=run, failure=failure))
    return sorted(sources, key=lambda source: source.name)


def _has_soundings(recording: Path) -> bool:
    """Whether a recording is a line; one that cannot be opened may be."""
    try:
        with BagReader(recording) as reader:
            return bool(topics_of_soundings(reader))
    except BagError:
        return True


def _is_results(folder: Path) -> bool:
    """Whether `track` made a folder, which has a run.json then."""
    there = any(os.path.lexists(folder / name) for name in (RUN, CSV, PARQUET[CSV]))
    return there or marked(folder).get('kind') == RESULTS


def _run_of(folder: Path) -> tuple[dict[str, Any] | None, str]:
    """Return the content of run.json, and why the line has to be left out. A table or a recording
    that `track` did not make has none."""
    if not _is_results(folder):
        return None, ''
    try:
        run = RunFolder(folder).read_run()
        if run['system'] != 'bathymetry':
            raise BagError(f'{folder / RUN} is of {run["system"]}, which has no soundings')
        epsg = run.get('epsg') or 0
        if isinstance(epsg, bool) or not isinstance(epsg, int) or not 0 <= epsg < 10**6:
            raise BagError(f"{folder / RUN} cannot be understood: 'epsg' is no number of one")
        budget_of(run)
    except ConfigError as error:
        return None, f'{folder / RUN} cannot be used: {error}'
    except BagError as error:
        return None, str(error)
    return run, ''


def epsg_of(sources: Sequence[Source], given: int) -> int:
    """The coordinate system of all, 0 for none. Raises `BagError` where two disagree."""
    known = [(given, 'the command')] if given else []
    known += [(int(s.run['epsg']), s.name) for s in sources if s.run and s.run.get('epsg')]
    for number, name in known[1:]:
        if number != known[0][0]:
            raise BagError(
                f'{known[0][1]} is in EPSG {known[0][0]} and {name} in EPSG {number}: a chart has '
                'one coordinate system'
            )
    return known[0][0] if known else 0


def frame_of(sources: Sequence[Source]) -> tuple[float, float, float] | None:
    """Return the first origin that a run states, None for none."""
    for source in sources:
        with suppress(BagError):  # of a damaged line, which is left out by name
            if (first := origin_of(source.run, source.name)) is not None:
                return first.latitude, first.longitude, first.height
    return None


@frozen(eq=False)
class _Depths(Rows):
    """What cells of the statistics (m,) say of tiles: number of the cell, depth m, soundings."""

    index: np.ndarray
    depth: FloatArray
    count: FloatArray

    def wanted_cell(self, side: float) -> float:
        """The cell that depths and soundings ask for, m; side: of the cells of the statistics."""
        shoal = max(float(np.quantile(self.depth, 0.1)), 1e-6)
        by_depth = 2.0 ** math.floor(math.log2(0.05 * shoal))
        _, cell = np.unique(self.index, axis=0, return_inverse=True)
        density = float(np.median(np.bincount(cell.ravel(), self.count))) / side**2
        wanted = 0.5 * math.log2(LEAST_SOUNDINGS / (density * math.pi * 0.75**2))
        by_count = 2.0 ** math.ceil(wanted)
        return min(max(by_depth, by_count, FINEST), COARSEST)


def plan_tiles(lines: Sequence[Looks], resolution: float) -> list[Tile]:
    """The tiles that hold soundings, sorted by cell, column and row; resolution 0: cells by depth.

    A tile, from 16 m cells on, is divided in four while the shoalest tenth of its depths asks for
    finer cells, a twentieth of the depth, and half of them would still hold five soundings.
    """
    parts = []
    for looks in lines:
        side = looks.cell
        index = np.column_stack([looks.ix, looks.iy]).astype(np.int32)
        parts.append(_Depths(index, -looks.z, looks.count))
    every = _Depths.joined(parts)
    if resolution > 0.0:
        # A cell of the statistics may lie in several tiles; those without soundings fall away.
        corners = 0.5 + np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * 0.5 * (1.0 - 1e-9)
        cells = np.unique(every.index, axis=0)
        places = side * (cells[:, None] + corners).reshape(-1, 2)
        found = np.unique(np.floor(places / (resolution * TILE)).astype(np.int64), axis=0)
        return [Tile(cell=resolution, i=i, j=j) for i, j in found.tolist()]
    tiles: list[Tile] = []

    def divide(part: _Depths, cell: float) -> None:
        index = np.floor(side * (part.index + 0.5) / (cell * TILE)).astype(np.int64)
        found, inverse = np.unique(index, axis=0, return_inverse=True)
        for k, (i, j) in enumerate(found.tolist()):
            inside = part.chosen(inverse.ravel() == k)
            finer = cell > FINEST and 0.5 * cell * TILE >= side
            if finer and inside.wanted_cell(side) < cell:
                divide(inside, 0.5 * cell)
            else:
                tiles.append(Tile(cell=cell, i=i, j=j))

    divide(every, COARSEST)
    return sorted(tiles, key=lambda tile: (tile.cell, tile.i, tile.j))


def extent_of(tiles: Sequence[Tile]) -> tuple[float, float, float, int, int]:
    """West, north, finest cell, rows, columns of a chart. Raises `BagError` for too many cells."""
    cell = min(tile.cell for tile in tiles)
    corners = np.array([[t.i, t.j, t.i + 1, t.j + 1] for t in tiles]) * TILE
    corners = corners * np.array([[t.cell] for t in tiles])
    low, high = corners[:, :2].min(axis=0).tolist(), corners[:, 2:].max(axis=0).tolist()
    columns, rows = (round((b - a) / cell) for a, b in zip(low, high))
    if rows * columns > MOST_CELLS:
        raise BagError(
            f'a chart of {rows} by {columns} cells is too large; choose larger cells with '
            '--resolution'
        )
    return low[0], high[1], cell, rows, columns


@frozen(kw_only=True)
class Progress:
    """What hears of stages: `begin(what, total)` gives what hears of each that is done."""

    begin: Callable[[str, int], Callable[[int], None]]
    say: Callable[[str], None]
    warn: Callable[[str], None]


@frozen
class _Jobs:
    """What runs jobs and hears of them, and the folder where they keep what they make."""

    run: Run
    progress: Progress
    work: Path

    def all(self, work: Work, calls: Calls, what: str, named: Sequence[Any]) -> list[Any]:
        """What came of all calls, in order. Raises `BagError` naming the first that failed."""
        results: list[Any] = [None] * len(calls)
        failures: dict[int, str] = {}
        advance = self.progress.begin(what, len(calls))
        for k, result, failure in self.run(work, calls):
            results[k] = result
            if failure:
                failures[k] = failure
            advance(1)
        if failures:
            k = min(failures)
            why = f'{failures[k]}; --resume makes what is missing'
            raise BagError(f'{what}: {named[k].name}: {why}')
        return results


@frozen(kw_only=True)
class Survey:
    """What came of the jobs, for `products`. lines: as survey.json has them; tiles: in order, with
    the file of each; before, after: differences of lines where they cross."""

    options: Options
    epsg: int
    lines: list[dict[str, Any]]
    units: Sequence[Unit]
    tiles: Mapping[Tile, Path]
    adjustment: Adjustment | None
    rms_before: float
    before: Misties
    after: Misties
    crossing_cells: int
    warnings: Sequence[str]

    def nodes(self) -> Iterator[tuple[Tile, Nodes]]:
        """The tiles with their nodes, in order; those without any are left out."""
        for tile, file in self.tiles.items():
            with np.load(file, allow_pickle=False) as kept:
                nodes = Nodes(**{name: kept[name] for name in kept.files})
            if len(nodes.z):
                yield tile, nodes


def make(
    sources: Sequence[Source], out: Path, options: Options, run: Run, progress: Progress
) -> Survey:
    """Do all jobs; out: the folder of the survey, whose ``.work`` they fill. Raises `BagError`."""
    jobs = _Jobs(run, progress, out / WORK)
    work = jobs.work
    units, lines, budget = _imported(sources, options, jobs)
    warnings = _unstated(sources, lines)
    for line in lines:
        if far := line['far']:
            says = 'lies far away and is' if far == 1 else 'lie far away and are'
            warnings.append(
                f'{line["name"]}: {counted(far, "sounding")} {says} left out: no ship that sees '
                'the others can have seen them'
            )
    depth = float(np.median([unit.depth for unit in units]))
    coarse = options.resolution or 2.0 ** math.floor(math.log2(max(0.05 * depth, FINEST)))
    cell = max(STATISTICS_CELL, 2.0 * min(coarse, COARSEST))

    def statistics(corrections: FloatArray) -> Sequence[Looks]:
        # Those of a round take the place of those of the round before, not of the reported ones.
        folder = work / ('adjusted' if corrections.any() else 'looks')
        places = [folder / f'{unit.file.stem}.npy' for unit in units]
        calls = [(unit, corrections[unit.number], cell, p) for unit, p in zip(units, places)]
        jobs.all(line_statistics, calls, 'statistics', units)
        return KeptLooks(places, cell)

    made_of: tuple[Any, ...] = ([unit.signature for unit in units], cell)
    none = np.zeros((len(units), 6))
    looks = statistics(none)
    place = work / 'misties.json'
    before, cells, rms = find_misties(looks, made_of, place, rms=not options.adjusted)
    found: Adjustment | None = None
    after: Misties = {}

    def tell(k: int, left: float) -> None:
        progress.say(f'round {k}: misties {left:.3f} m rms')

    if options.adjusted:
        fixed = [unit.number for unit in units if unit.line in options.fixed]
        try:
            place = work / 'adjustment.npz'
            found = adjust_lines(statistics, units, budget, fixed, cell, place, tell)
        except ValueError as error:
            raise BagError(f'the lines cannot be adjusted: {error}') from None
        warnings += _warnings_of(found)
        looks = statistics(found.corrections)
        place, made_of = work / 'adjusted_misties.json', (*made_of, found.corrections)
        after, _, _ = find_misties(looks, made_of, place)
        rms = found.rms[0]
    tiles = plan_tiles(looks, options.resolution)
    extent_of(tiles)
    corrections = none if found is None else found.corrections
    files = _tiled(units, tiles, corrections, found, budget, rms, jobs)
    for sentence in warnings:
        progress.warn(sentence)
    return Survey(
        options=options,
        epsg=options.epsg,
        lines=lines,
        units=units,
        tiles=files,
        adjustment=found,
        rms_before=rms,
        before=before,
        after=after,
        crossing_cells=cells,
        warnings=warnings,
    )


def _imported(
    sources: Sequence[Source], options: Options, jobs: _Jobs
) -> tuple[list[Unit], list[dict[str, Any]], ErrorBudget]:
    work, progress = jobs.work, jobs.progress
    digests = [hashlib.sha256(os.fsencode(source.name)).hexdigest() for source in sources]
    places = [work / 'lines' / digest[:16] for digest in digests]
    for folder in ('lines', 'looks', 'adjusted', 'soundings', 'tiles'):
        (work / folder).mkdir(parents=True, exist_ok=True)
    infos: list[dict[str, Any]] = [{} for _ in sources]
    failures = [source.failure for source in sources]
    todo = [k for k, failure in enumerate(failures) if not failure]
    advance = progress.begin('lines', len(todo))
    calls = [(sources[k], places[k], options) for k in todo]
    for n, info, failure in jobs.run(import_line, calls):
        infos[todo[n]], failures[todo[n]] = info or {}, failure
        advance(1)
    units: list[Unit] = []
    lines, budgets = [], []
    for source, place, info, failure in zip(sources, places, infos, failures):
        if failure:
            progress.warn(f'left out: {source.name}: {failure}')
        stated = {key: info.get(key) for key in _STATED}
        named = {'name': source.name, 'folder': str(source.folder)}
        lines.append({**named, **stated, 'failure': failure})
        made_with = (kept(place.with_suffix('.json')) or {}).get('wanted')
        for piece in range(info.get('pieces', 0)):
            several = f'#{piece + 1}' if info['pieces'] > 1 else ''
            units.append(
                Unit(
                    name=source.name + several,
                    line=source.name,
                    number=len(units),
                    file=place.with_name(f'{place.name}-{piece}.npz'),
                    signature=signed(info['sha256'], piece, made_with),
                    soundings=info['soundings'],
                    depth=info['depth'],
                )
            )
            budgets.append(budget_of(source.run)[0])
    if not units:
        raise BagError(f'no line can be read; the first: {failures[0]}')
    if unknown := set(options.fixed) - {unit.line for unit in units}:
        raise BagError(f'there is no line {sorted(unknown)[0]} to fix')
    widest = {name: max(getattr(each, name) for each in budgets) for name in asdict(budgets[0])}
    return units, lines, ErrorBudget(**widest)


def _tiled(
    units: Sequence[Unit],
    tiles: Sequence[Tile],
    corrections: FloatArray,
    found: Adjustment | None,
    budget: ErrorBudget,
    rms: float,
    jobs: _Jobs,
) -> dict[Tile, Path]:
    """The files of the tiles that hold soundings."""
    work = jobs.work
    places = [work / 'soundings' / f'{unit.file.stem}.npy' for unit in units]
    calls = [(unit, corrections[unit.number], tiles, place) for unit, place in zip(units, places)]
    rows = jobs.all(tile_line, calls, 'sorting', units)
    holders: dict[str, list[int]] = {}
    for k, ranges in enumerate(rows):
        for name in ranges:
            holders.setdefault(name, []).append(k)
    near = _neighbours(tiles)
    tiles = [tile for tile in tiles if tile.name in holders]
    # What is not known of the mean speed of a line is among the corrections then.
    own = budget if found is None else evolve(budget, sound_speed=0.0)
    left = rms if found is None else 0.0
    made = []
    for tile in tiles:
        names = near[tile.name]
        numbers = sorted({k for name in names for k in holders.get(name, ())})
        ranges = [[rows[k][name] for name in names if name in rows[k]] for k in numbers]
        covariance = None if found is None else found.of_lines(numbers)
        lines = [units[k].signature for k in numbers]
        used = lines, ranges, corrections[numbers], asdict(own), covariance, left
        made.append(
            TileJob(
                tile=tile,
                parts=[(k, places[k], each) for k, each in zip(numbers, ranges)],
                signature=signed(__version__, tile.name, *used),
                budget=own,
                covariance=covariance,
                crossing_rms=left,
                place=work / 'tiles' / f'{tile.name}.npz',
            )
        )
    jobs.all(make_tile, [(job,) for job in made], 'tiles', tiles)
    return {job.tile: job.place for job in made}


def _neighbours(tiles: Sequence[Tile]) -> dict[str, list[str]]:
    """Of each tile the names of those that its nodes need, itself among them, in order."""
    cell = np.array([[tile.cell] for tile in tiles])
    low = np.array([[tile.i, tile.j] for tile in tiles]) * TILE * cell
    side = cell * TILE
    names = [tile.name for tile in tiles]
    found = {}
    for k, tile in enumerate(tiles):
        halo = HALO * tile.cell
        meets = np.all((low < low[k] + side[k] + halo) & (low + side > low[k] - halo), axis=1)
        found[tile.name] = [names[n] for n in np.flatnonzero(meets)]
    return found


def _unstated(sources: Sequence[Source], lines: Sequence[Mapping[str, Any]]) -> list[str]:
    lacking: dict[str, list[str]] = {}
    for source, line in zip(sources, lines):
        if not line['failure'] and (missing := unstated(source.run)):
            what = RUN if source.run is None else ', '.join(missing)
            lacking.setdefault(what, []).append(source.name)
    found = []
    for what, names in lacking.items():
        named = ', '.join(names[:3]) + (', ...' if len(names) > 3 else '')
        kind = 'error budget' if what == RUN else 'values'
        found.append(f'{counted(len(names), "line")} without {what} ({named}): default {kind}')
    return found


def _warnings_of(found: Adjustment) -> list[str]:
    warnings = []
    if groups := int(found.group.max()):
        warnings.append(
            f'the lines are {groups + 1} groups that do not overlap: levels between groups are '
            'those of the priors alone'
        )
    speed = found.kind == 4
    value, std = found.value[speed], found.std[speed]
    mean, error = float(value.mean()), float(np.sqrt(np.mean(np.square(std))))
    if abs(mean) > max(3.0 * error, 1.0):
        warnings.append(
            f'all lines ask for {mean:+.1f} m/s of sound speed; that is right for the water below '
            'the array only: where the speed at the array is wrong too, beam angles are as well'
        )
    return warnings
