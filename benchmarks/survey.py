# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Charts: how near to the truth, and whether two stated standard deviations hold it.

    python -m benchmarks.survey --out docs/results/survey.json

`one_run`: a line of 200 m, five pings per second, over floors without false echoes, with errors as
stated. The plain mean
is that by one over the variance; its uncertainty is that of soundings whose pings err apart, which
`export` stated before.

`adjustment`: the scene `survey`, twelve lines and three across with biases, tides, an error of the
sound speed, fish and false echoes: errors of the corrections, and as multiples of their stated
standard deviations. `grid`: the charts of it in 1 m cells over the middle, about the median of
their errors, since no crossing tells the level: `level_inside` is the share within two stated
deviations less that of the level (`Adjustment.levels`), `inside` with the level. `walls`: the
sides of the wreck, 40 x 8 x 4 m, in 1 m cells with the true corrections.

`cost`: of `sonar-imm survey --adjust` in one process on `lines` lines of 100 m, groups of fifty
beside each other on a slope, each group the same soundings moved aside, so that lines overlap
their neighbours throughout: seconds of CPU by stage, and per million soundings; the peak of its
memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import resource
import tempfile
import time

from attrs import evolve
import numpy as np
import pyarrow
import pyarrow.parquet

from benchmarks.study import in_fresh_process, mean_of, Parts, rms, study
from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm_tools.offline.jobs import workers
from sonar_imm_tools.recordings.export.points import Points
from sonar_imm_tools.simulation.survey import budget, Floor, scenario, simulate
from sonar_imm_tools.survey.adjustment import adjust
from sonar_imm_tools.survey.chart import chart_of
from sonar_imm_tools.survey.grid import grid_of_looks, Soundings
from sonar_imm_tools.survey.jobs import Options
from sonar_imm_tools.survey.line import Line, line_of
from sonar_imm_tools.survey.looks import Looks, looks_of, runs_of
from sonar_imm_tools.survey.making import make, Progress, sources_of
from sonar_imm_tools.survey.products import folder_of, write

MIDDLE = (140, 300)
"""First and last column, and row, of the cells that are scored."""
FLOORS = {
    'flat, 1 m': ('flat', 0.0, 1.0),
    'flat, 5 m': ('flat', 0.0, 5.0),
    'slope .1, 1 m': ('slope', 0.1, 1.0),
    'slope .1, 5 m': ('slope', 0.1, 5.0),
}
GROUP, SPACING = 50, 40.0
PARTS = ('one_run', 'walls', 'survey', 'cost')
WRECK: dict[str, float] = {
    'lines': 4,
    'cross_lines': 2,
    'length': 160.0,
    'ping_interval': 0.5,
    'ghost': False,
    'fish': False,
}
"""The wreck lies at .55 of the length and .35 of the width of the parallel lines."""


def main(
    runs: int = 6,
    first: int = 10,
    interval: float = 1.0,
    lines: int = 1000,
    parts: Sequence[str] = PARTS,
) -> Parts:
    seeds = range(first, first + runs)
    yield {'runs': runs, 'first_seed': first, 'ping_interval': interval}
    for name, (terrain, slope, cell) in FLOORS.items() if 'one_run' in parts else ():
        rows = [one_run(terrain, slope, cell, seed) for seed in seeds]
        worst = {
            f'worst_{way}': min(row[f'inside_{way}'] for row in rows) for way in ('mean', 'looks')
        }
        yield {'one_run': {name: {**mean_of(rows), **worst}}}
    if 'walls' in parts:
        yield {'walls': {'as it is': mean_of([walls(seed) for seed in seeds[:2]])}}
    if 'cost' in parts:
        yield {'cost': in_fresh_process(cost, lines)}
    adjusted: list[dict[str, float]] = []
    charts: dict[str, list[dict[str, float]]] = {}
    for seed in seeds if 'survey' in parts else ():
        corrections, made = survey(seed, interval)
        adjusted.append(corrections)
        for name, row in made.items():
            charts.setdefault(name, []).append(row)
        errors = {name: {'rms': rms([row[name] for row in adjusted])} for name in corrections}
        # What is known after each survey; the last one's stays.
        yield {
            'surveys': len(adjusted),
            'adjustment': errors,
            'grid': {name: mean_of(rows) for name, rows in charts.items()},
        }


def survey(seed: int, interval: float) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Errors of the corrections of a scene, and scores of its charts."""
    scene = simulate(scenario('survey', {'ping_interval': interval}), seed)
    lines = [line_of(points, budget()) for points in scene.points]

    def statistics(corrections: FloatArray) -> list[Looks]:
        return [
            looks_of(line.corrected(c), 2.0).numbered(k)
            for k, (line, c) in enumerate(zip(lines, corrections))
        ]

    found = adjust(statistics, len(lines), budget())
    error = found.corrections - scene.corrections
    level = error[:, 3].mean()
    of_offset = found.kind == 3
    n = len(lines)
    about = np.eye(n) - 1.0 / n
    offset_std = np.sqrt(np.diag(about @ found.covariance[np.ix_(of_offset, of_offset)] @ about))
    speed = error[:, 4]
    units = np.degrees(found.value[:3]) - np.array([1.0, 0.0, 0.0])
    stated = np.degrees(found.std[:3])
    corrections = dict(zip(('roll', 'pitch', 'heading'), units.tolist()))
    corrections |= {
        'offset': rms(error[:, 3] - level),
        'sound_speed': rms(speed),
        **{f'{name}_stated': e / s for name, e, s in zip(corrections, units, stated)},
        'offset_stated': rms((error[:, 3] - level) / offset_std),
        'sound_speed_stated': rms(speed / found.std[found.kind == 4]),
    }
    charts = {}
    own = evolve(budget(), sound_speed=0.0)
    stated_variance = np.concatenate(
        [p['vertical_uncertainty'][np.lexsort((p['y'], p['x'], p.stamp_ns))] for p in scene.points]
    )
    true = [line.corrected(c) for line, c in zip(lines, scene.corrections)]
    moved = [line.corrected(c) for line, c in zip(lines, found.corrections)]
    covariance = found.of_lines(range(n))
    (_, common), *_ = found.levels()
    corrections['level_stated'] = float(level / common)
    for name, parts, C, left, level_std in (
        ('adjusted', moved, covariance, 0.0, common),
        ('truth applied', true, None, 0.0, 0.0),
        ('not adjusted', lines, None, found.rms[0], 0.0),
    ):
        number = np.concatenate([np.full(len(part), k) for k, part in enumerate(parts)])
        soundings = Soundings(Line.joined(parts), number)
        charts[f'looks, {name}'] = looks_scores(scene.floor, soundings, own, C, left, level_std)
        whole = soundings.line
        x, y = whole.xy.T
        points = Points(whole.stamp_ns, {'x': x, 'y': y, 'z': whole.z})
        points.columns['vertical_uncertainty'] = stated_variance
        place, z, sd = plain_mean(points, 1.0)
        inside = np.all((place > MIDDLE[0]) & (place < MIDDLE[1]), axis=1)
        charts[f'mean, {name}'] = about_level(scene.floor, place[inside], z[inside], sd[inside])
    return corrections, charts


def looks_scores(
    floor: Floor,
    soundings: Soundings,
    errors: ErrorBudget,
    covariance: FloatArray | None,
    crossing_rms: float,
    level_std: float,
) -> dict[str, float]:
    """Of the grid of looks over the middle."""
    first, last = MIDDLE
    box = (first, first, last - first, last - first)
    nodes = grid_of_looks(soundings, 1.0, box, errors, covariance, crossing_rms)
    place = np.asarray(np.column_stack([nodes.ix, nodes.iy]) + 0.5, np.float64)
    return about_level(floor, place, nodes.z, nodes.sd, level_std)


def about_level(
    floor: Floor, place: FloatArray, z: FloatArray, sd: FloatArray, level_std: float = 0.0
) -> dict[str, float]:
    """As `scores`, errors about their median; `inside` with the level, `level_inside` about it."""
    relative = np.sqrt(np.maximum(np.square(sd) - level_std**2, 0.0))
    error = z - floor.at(place[:, 0], place[:, 1])
    off = error - np.median(error)
    return {
        'rmse': rms(off),
        'inside': float(np.mean(np.abs(error) < 2.0 * sd)),
        'level_inside': float(np.mean(np.abs(off) < 2.0 * relative)),
        'sd': float(np.median(sd)),
    }


def walls(seed: int) -> dict[str, float]:
    """Errors about their median on the sides of the wreck."""
    scene = simulate(scenario('survey', WRECK), seed)
    parts = [
        line_of(points, budget()).corrected(c)
        for points, c in zip(scene.points, scene.corrections)
    ]
    number = np.concatenate([np.full(len(part), k) for k, part in enumerate(parts)])
    own = evolve(budget(), sound_speed=0.0)
    nodes = grid_of_looks(Soundings(Line.joined(parts), number), 1.0, (20, 0, 120, 120), own)
    x, y = np.asarray(np.column_stack([nodes.ix, nodes.iy]) + 0.5, np.float64).T
    error = nodes.z - scene.floor.at(x, y)
    off = np.abs(error - np.median(error))
    along, across = x - 0.55 * WRECK['length'], y - 0.35 * 120.0
    out = np.hypot(along / 20.0, across / 4.0)
    side = (out > 0.8) & (np.abs(along) < 22.0) & (np.abs(across) < 6.0)
    return {
        'rms': rms(off[side]),
        'inside': float(np.mean(off[side] < 2.0 * nodes.sd[side])),
    }


def cost(lines: int) -> dict[str, float]:
    """CPU seconds of the stages, and the peak of the memory of this process, MB."""
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder) / 'lines'
        soundings = write_lines(runs, lines)
        found: dict[str, float] = {'lines': lines, 'soundings': soundings}
        stage, begun = '', 0.0

        def begin(what: str, total: int) -> Callable[[int], None]:
            nonlocal stage, begun
            now = time.process_time()
            if stage:
                name = f'{stage}, s'
                found[name] = found.get(name, 0.0) + now - begun
            stage, begun = what, now

            def advance(count: int) -> None:
                nonlocal total
                total -= count
                if what == 'statistics' and total == 0:
                    begin('adjustment', 0)  # what the command does between two rounds

            return advance

        progress = Progress(begin=begin, say=lambda text: None, warn=lambda text: None)
        options = Options(adjusted=True)
        with folder_of(Path(folder) / 'chart', options, runs) as place, workers(1) as run:
            made = make(sources_of(runs), place, options, run, progress)
            begin('products', 0)
            write(made, place)
            begin('', 0)
    per_million = {
        f'{name} per million': value / soundings * 1e6
        for name, value in found.items()
        if name.endswith(', s')
    }
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return {**found, **per_million, 'peak, MB': peak}


def write_lines(place: Path, lines: int) -> int:
    """Lines as soundings.parquet below `place`; how many soundings."""
    settings = {'lines': min(GROUP, lines), 'cross_lines': 0, 'terrain': 'slope', 'length': 100.0}
    scene = simulate(scenario('survey', {**settings, 'fish': False, 'ghost': False}), 1)
    for k in range(lines):
        moved = scene.points[k % GROUP].moved((0.0, k // GROUP * GROUP * SPACING, 0.0))
        folder = place / f'line_{k:05d}'
        folder.mkdir(parents=True)
        columns = {'stamp_ns': moved.stamp_ns, **moved.columns}
        columns |= {f'p{name}': moved[name] for name in 'xyz'}
        pyarrow.parquet.write_table(pyarrow.table(columns), folder / 'soundings.parquet')
    return sum(len(scene.points[k % GROUP]) for k in range(lines))


def one_run(terrain: str, slope: float, cell: float, seed: int) -> dict[str, float]:
    """RMSE and share inside two sigma of the plain mean and of the grid of looks."""
    line = {'length': 200.0, 'ping_interval': 0.2}
    config = scenario('flat', {'terrain': terrain, 'slope': slope, **line})
    scene = simulate(config, seed)
    points = scene.points[0]
    place, z, sd = plain_mean(points, cell)
    mean = scores(scene.floor, place, z, sd)
    chart = chart_of(points, cell, budget(), 1500.0)
    rows, columns = np.nonzero(np.isfinite(chart.bands['depth']))
    place = np.column_stack(
        [chart.west + cell * (columns + 0.5), chart.north - cell * (rows + 0.5)]
    )
    depth, sd = chart.bands['depth'][rows, columns], chart.bands['uncertainty'][rows, columns]
    looks = scores(scene.floor, place, -depth, sd)
    return {
        **{f'{key}_mean': value for key, value in mean.items()},
        **{f'{key}_looks': value for key, value in looks.items()},
    }


def plain_mean(points: Points, cell: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (k, 2), weighted means and their standard deviations, as if pings erred apart."""
    index = np.floor(np.column_stack([points['x'], points['y']]) / cell).astype(np.int64)
    order = np.lexsort((points.stamp_ns, index[:, 1], index[:, 0]))
    index, stamp = index[order], points.stamp_ns[order]
    starts, n, group = runs_of(index[:, 0], index[:, 1])
    z, v = points['z'][order], points['vertical_uncertainty'][order]
    mean = np.add.reduceat(z / v, starts) / np.add.reduceat(1.0 / v, starts)
    scatter = np.add.reduceat(np.square(z - mean[group]), starts) / np.maximum(n - 1, 1)
    _, _, ping = runs_of(group, stamp)
    pings = np.append(ping[starts[1:]], ping[-1] + 1) - ping[starts]
    least = np.minimum.reduceat(v, starts)
    return (
        np.asarray(cell * (index[starts] + 0.5), np.float64),
        mean,
        np.asarray(np.sqrt(np.maximum(least / pings, scatter / n)), np.float64),
    )


def scores(floor: Floor, place: FloatArray, z: FloatArray, sd: FloatArray) -> dict[str, float]:
    """Of heights at places (k, 2), beside the true floor."""
    error = z - floor.at(place[:, 0], place[:, 1])
    return {'rmse': rms(error), 'inside': float(np.mean(np.abs(error) < 2.0 * sd))}


if __name__ == '__main__':
    study(main, parts={'choices': PARTS})
