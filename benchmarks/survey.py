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

"""Charts: how near to the truth, and whether two stated standard deviations hold it.

    python -m benchmarks.survey --out docs/results/survey.json

`one_run`: a line of 200 m, five pings per second, over floors without false echoes, with errors as
stated. The plain mean
is that by one over the variance; its uncertainty is that of soundings whose pings err apart, which
`export` stated before.
"""

from __future__ import annotations

import numpy as np

from benchmarks.study import mean_of, Parts, rms, study
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm_tools.recordings.export.points import Points
from sonar_imm_tools.simulation.survey import budget, Floor, scenario, simulate
from sonar_imm_tools.survey.chart import chart_of
from sonar_imm_tools.survey.looks import runs_of

FLOORS = {
    'flat, 1 m': ('flat', 0.0, 1.0),
    'flat, 5 m': ('flat', 0.0, 5.0),
    'slope .1, 1 m': ('slope', 0.1, 1.0),
    'slope .1, 5 m': ('slope', 0.1, 5.0),
}


def main(runs: int = 6) -> Parts:
    yield {'runs': runs}
    for name, (terrain, slope, cell) in FLOORS.items():
        rows = [one_run(terrain, slope, cell, seed) for seed in range(runs)]
        worst = {
            f'worst_{way}': min(row[f'inside_{way}'] for row in rows) for way in ('mean', 'looks')
        }
        yield {'one_run': {name: {**mean_of(rows), **worst}}}


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
    study(main)
