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

"""Draw docs/images/diver_paper.png, the paper's Figures 3 and 4: python docs/draw_diver.py

Figure 3: one simulated dive of Table 1 with the tracks of both kinds of models in one picture.
Figure 4: RMSE at each scan over 100 runs of that dive, equation (10). The paper does not print its
path, nor the parameters of its single-direction models; ours are tuned on scenes of other seeds.
Needs matplotlib, which nothing else here does. Run it from the project root.
"""

from __future__ import annotations

from pathlib import Path
import sys

import matplotlib
import numpy as np

matplotlib.use('Agg')
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from matplotlib import pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402

from benchmarks.diver_accuracy import track, tuned  # noqa: E402
from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian  # noqa: E402
from sonar_imm.trackers.diver.tracker import DiverConfig  # noqa: E402
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate  # noqa: E402

OUT = ROOT / 'docs' / 'images' / 'diver_paper.png'
BLUE, RED, INK, PALE = '#0072B2', '#D55E00', '#1b2733', '#b8c0c8'
SEED, RUNS = 1, 100
RANGE_STD, BEARING_STD = 0.1, np.radians(2.0)


def main() -> None:
    plt.rcParams.update({'font.size': 9, 'axes.spines.top': False, 'axes.spines.right': False})
    path = simulate(scenario('table1'), SEED).truth[0].position[:, :2]
    z, R = observe(path)
    trackers = {
        'single direction (IMM CV+CV, tuned)': (RED, tuned('cv_cv', ['table1'])),
        '16 directions (heading_speed)': (BLUE, DiverConfig(model_set='heading_speed')),
    }
    tracks = {
        label: (colour, track(config, z, R)[0][..., :2])
        for label, (colour, config) in trackers.items()
    }
    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 4.2), layout='constrained')
    draw_dive(left, path, z[0], {label: (c, runs[0]) for label, (c, runs) in tracks.items()})
    draw_rmse(right, path, {'fixes': (PALE, z), **tracks})
    figure.savefig(OUT, dpi=130)
    for label, (_, runs) in tracks.items():
        print(f'{label}: {np.sqrt(np.mean(squared(runs, path))):.3f} m over all scans')


def observe(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fixes (RUNS, K, 2) of the path (K, 2), with covariances: Table 1's sonar at the origin."""
    rng = np.random.default_rng(SEED)
    shape = RUNS, len(path)
    ranges = np.hypot(*path.T) + rng.normal(0.0, RANGE_STD, shape)
    bearings = np.arctan2(path[:, 1], path[:, 0]) + rng.normal(0.0, BEARING_STD, shape)
    z, R = unbiased_polar_to_cartesian(
        ranges.ravel(), bearings.ravel(), RANGE_STD**2, BEARING_STD**2
    )
    return z.reshape(*shape, 2), R.reshape(*shape, 2, 2)


def squared(runs: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Squared errors (RUNS, K) of tracks (RUNS, K, 2)."""
    return np.sum((runs - path) ** 2, axis=-1)


def draw_dive(
    ax: Axes, path: np.ndarray, fixes: np.ndarray, tracks: dict[str, tuple[str, np.ndarray]]
) -> None:
    """The first run: path, fixes and both tracks."""
    ax.plot(*fixes.T, '.', color=PALE, ms=4, label='fixes')
    ax.plot(*path.T, color=INK, lw=1, ls='--', label='truth')
    for label, (colour, run) in tracks.items():
        ax.plot(*run.T, color=colour, lw=1.3, label=label)
    ax.set(title='One dive of Table 1 (Figure 3)', xlabel='x, m', ylabel='y, m', aspect='equal')
    ax.legend(frameon=False, fontsize=8)


def draw_rmse(ax: Axes, path: np.ndarray, tracks: dict[str, tuple[str, np.ndarray]]) -> None:
    """RMSE over the runs at each scan."""
    for label, (colour, runs) in tracks.items():
        ax.plot(np.sqrt(squared(runs, path).mean(axis=0)), color=colour, lw=1.3, label=label)
    ax.set(
        title=f'RMSE of position, {RUNS} runs (Figure 4)',
        xlabel='time, s',
        ylabel='RMSE, m',
        ylim=(0.0, None),
    )
    ax.legend(frameon=False, fontsize=8)


if __name__ == '__main__':
    main()
