# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Draw the four pictures of README.md: python docs/draw_front.py

One shipped bag for each system, whose seed is typical, tracked with the defaults: truth, estimate
and uncertainty. front_diver.png, front_obstacle.png, front_bathymetry.png, front_fathometer.png.
Needs matplotlib, which nothing else here does. Run it from the project root.
"""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys
import tempfile
from typing import Any

import matplotlib
import numpy as np

matplotlib.use('Agg')
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from matplotlib import pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402

from sonar_imm.measurements import Fix, Trace  # noqa: E402
from sonar_imm_tools.evaluation.columns import read_columns  # noqa: E402
from sonar_imm_tools.offline.run_folder import read_measurements, read_truth  # noqa: E402

BAGS = {
    'diver': ('diver_table1', '--set', 'model_set=families'),  # the default; the bag names another
    'obstacle': ('obstacle_tethers',),
    'bathymetry': ('bathymetry_paper',),
    'fathometer': ('fathometer_drift',),
}
LEGEND = {
    'diver': 'lower left',
    'obstacle': 'upper right',
    'bathymetry': 'upper center',
    'fathometer': 'lower left',
}
BLUE, RED, INK, GREY = '#0072B2', '#D55E00', '#1b2733', '#98a4af'


def main() -> None:
    plt.rcParams.update({'font.size': 13, 'axes.spines.top': False, 'axes.spines.right': False})
    for system, (bag, *options) in BAGS.items():
        figure, ax = plt.subplots(figsize=(4.0, 3.6), layout='constrained')
        with tempfile.TemporaryDirectory() as folder:
            command = [Path(sys.executable).with_name('sonar-imm'), 'track', f'bags/{bag}']
            subprocess.run([*command, f'{folder}/out', *options], check=True, cwd=ROOT)
            rows = np.genfromtxt(f'{folder}/out/estimate.csv', delimiter=',', names=True)
            DRAW[system](ax, json.loads(Path(f'{folder}/out/run.json').read_text()), rows)
        columns = 2 if system == 'bathymetry' else 1
        ax.legend(frameon=False, fontsize=11, ncols=columns, loc=LEGEND[system])
        figure.savefig(ROOT / 'docs' / 'images' / f'front_{system}.png', dpi=130)


def draw_dive(ax: Axes, run: dict[str, Any], rows: np.ndarray) -> None:
    fixes = np.array([fix.position[:2] for fix in measured(run, Fix)])
    ax.plot(*fixes.T, 'x', color=GREY, ms=5, mew=1.1, label='fixes')
    turn = np.linspace(0.0, 2.0 * np.pi, 40)
    circle = 2.4477 * np.stack([np.cos(turn), np.sin(turn)])  # of the chi-square, 95 %
    for row in rows[2:]:
        P = [[row['cov_px_px'], row['cov_px_py']], [row['cov_px_py'], row['cov_py_py']]]
        x, y = np.linalg.cholesky(P) @ circle
        ax.fill(x + row['px'], y + row['py'], color=BLUE, alpha=0.12, lw=0)
    ax.plot(rows['px'], rows['py'], color=BLUE, lw=2, label='track, 95 % ellipses')
    true = table(run, ('px', 'py'))
    ax.plot(true['px'], true['py'], color=INK, lw=1.3, ls='--', label='truth')
    ax.set(xlabel='east, m', ylabel='north, m', aspect='equal', adjustable='datalim')


def draw_height(ax: Axes, run: dict[str, Any], rows: np.ndarray) -> None:
    rows = rows[rows['track_id'] == rows['track_id'][0]]
    true = table(run, ('range', 'bearing', 'vertical_offset', 'track_id'))
    apart = np.abs(true['range'] - rows['range'][40]) + 50.0 * np.abs(
        true['bearing'] - rows['bearing'][40]
    )
    near = true['track_id'][np.argmin(apart)]
    path = {name: values[true['track_id'] == near] for name, values in true.items()}
    band = (-rows['vertical_offset_lo'], -rows['vertical_offset_hi'])
    ax.fill_between(rows['range'], *band, color=BLUE, alpha=0.2, lw=0, label='90 % band')
    ax.plot(rows['range'], -rows['vertical_offset'], color=BLUE, lw=2, label='estimate')
    ax.plot(path['range'], -path['vertical_offset'], color=INK, lw=1.3, ls='--', label='truth')
    ax.set(xlabel='range, m (vehicle approaches)', ylabel='height above the sonar, m')
    ax.invert_xaxis()


def draw_swath(ax: Axes, run: dict[str, Any], rows: np.ndarray) -> None:
    true = table(run, ('range', 'height', 'patch'), ping=4)
    stamps = np.unique(rows['stamp_ns'])
    rows = rows[(rows['stamp_ns'] == stamps[4]) & (rows['valid'] > 0)]
    rough = true['patch'] > 0
    ends = np.flatnonzero(np.diff(np.concatenate([[False], rough, [False]])))
    for first, last in ends.reshape(-1, 2):
        ax.axvspan(true['range'][first], true['range'][last - 1], color='#f3e3d3')
    std = np.sqrt(rows['cov_height_height'])
    band = (rows['height'] - 2.0 * std, rows['height'] + 2.0 * std)
    ax.fill_between(rows['range'], *band, color=BLUE, alpha=0.25, lw=0, label='2 std')
    ax.plot(rows['range'], rows['height'], color=BLUE, lw=1.4, label='estimate')
    ax.plot(true['range'], true['height'], color=INK, lw=0.9, ls='--', label='truth')
    ax.set(xlabel='slant range, m', ylabel='height of the floor, m')
    ax.set(xlim=(37.0, 53.0), ylim=(-3.7, 4.2), yticks=[-1, 0, 1])
    low = ax.inset_axes((0.0, 0.0, 1.0, 0.22), sharex=ax)
    low.fill_between(rows['range'], rows['rough'], color=RED, alpha=0.7, lw=0, step='mid')
    low.set(ylim=(0.0, 1.3), yticks=[])
    low.set_title('probability of rough floor', fontsize=11, color=RED, pad=2)


def draw_layers(ax: Axes, run: dict[str, Any], rows: np.ndarray) -> None:
    stamps = np.unique(rows['stamp_ns'])
    traces = measured(run, Trace)
    image = np.abs([trace.amplitude for trace in traces]).T
    ax.pcolormesh(
        np.arange(len(traces)), traces[0].depth, image, cmap='Greys', vmax=0.7 * image.max()
    )
    true = table(run, ('stamp_ns', 'depth', 'track_id'))
    for number in np.unique(true['track_id']):
        path = true['track_id'] == number
        record = np.searchsorted(stamps, true['stamp_ns'][path])
        label = 'truth' if number == true['track_id'][0] else None
        ax.plot(record, true['depth'][path], color=INK, lw=1.3, ls='--', label=label, zorder=3)
    for number in np.unique(rows['track_id'][rows['existence'] > 0.5]):
        track = rows[(rows['track_id'] == number) & (rows['existence'] > 0.5)]
        record = np.searchsorted(stamps, track['stamp_ns'])
        std = 2.0 * np.sqrt(track['cov_depth_depth'])
        band = (track['depth'] - std, track['depth'] + std)
        first = number == rows['track_id'][0]
        ax.fill_between(record, *band, color=BLUE, alpha=0.25, lw=0)
        ax.plot(
            record, track['depth'], color=BLUE, lw=2, label='estimate, 2 std' if first else None
        )
    ax.set(xlabel='record', ylabel='depth, m', ylim=(166.0, 151.0))


def table(
    run: dict[str, Any], names: tuple[str, ...], ping: int | None = None
) -> dict[str, np.ndarray]:
    """Columns of the truth by name, of all stamps or of one."""
    tables = read_truth(run) or []
    tables = tables if ping is None else tables[ping : ping + 1]
    found = [read_columns(each, set(names) - {'stamp_ns'}, 'no column') for each in tables]
    for each, columns in zip(tables, found):
        columns['stamp_ns'] = np.full(len(each.state), each.stamp_ns)
    return {name: np.concatenate([columns[name] for columns in found]) for name in names}


def measured(run: dict[str, Any], kind: type) -> list[Any]:
    return [item for item in read_measurements(run) if isinstance(item, kind)]


DRAW = {
    'diver': draw_dive,
    'obstacle': draw_height,
    'bathymetry': draw_swath,
    'fathometer': draw_layers,
}

if __name__ == '__main__':
    main()
