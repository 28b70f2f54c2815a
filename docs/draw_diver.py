# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Draw the pictures of the diver: python docs/draw_diver.py

diver_paper.png   the paper's Figures 3 and 4, and diver_multistatic.png its Figures 6 and 7

Figures 3 and 6: one simulated dive, of Table 1 and before a multistatic sonar, with the tracks of
both kinds of models in one picture. Figures 4 and 7: RMSE at each scan over several runs of that
dive, equation (10). The paper does not print its paths, nor the parameters of its single-direction
models; ours are tuned on scenes of other seeds. Its Figures 6 and 7 are of one dive at sea, whose
data are not public: these are simulated fixes of each ping of one transmitter and four receivers.
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

from benchmarks.diver_paper import track, tuned  # noqa: E402
from sonar_imm.acoustics.localisation import localise  # noqa: E402
from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian  # noqa: E402
from sonar_imm.trackers.diver.tracker import DiverConfig  # noqa: E402
from sonar_imm_tools.simulation.diver.simulator import (  # noqa: E402
    RECEIVERS,
    scenario,
    simulate,
    TRANSMITTER,
)

IMAGES = ROOT / 'docs' / 'images'
DIVES = {
    'of Table 1': ('table1', 100, 'diver_paper.png', 3),
    'before a multistatic sonar': ('multistatic_fixes', 20, 'diver_multistatic.png', 6),
}
"""Scenario, runs, picture and its number in the paper. A fix of a ping takes long to compute."""
BLUE, RED, INK, PALE, GREY = '#0072B2', '#D55E00', '#1b2733', '#b8c0c8', '#8593a1'
SEED = 1
RANGE_STD, BEARING_STD = 0.1, np.radians(2.0)


def main() -> None:
    plt.rcParams.update({'font.size': 11, 'axes.spines.top': False, 'axes.spines.right': False})
    for name, (at, count, file, picture) in DIVES.items():
        path = simulate(scenario(at), SEED).truth[0].position[:, :2]
        z, R = OBSERVE[at](path, count)
        trackers = {
            'single direction (IMM CV+CV, tuned)': (RED, tuned('bench_cv_cv', [at], count)),
            '16 directions (heading_speed)': (BLUE, DiverConfig(model_set='heading_speed')),
        }
        tracks = {
            label: (colour, track(config, z, R)[0][..., :2])
            for label, (colour, config) in trackers.items()
        }
        figure, (top, bottom) = plt.subplots(2, 1, figsize=(9.0, 7.6), layout='constrained')
        draw_dive(top, path, z[0], {label: (c, runs[0]) for label, (c, runs) in tracks.items()})
        draw_rmse(bottom, path, {'fixes': (PALE, z), **tracks})
        top.set(title=f'One dive {name} (Figure {picture})')
        bottom.set(title=f'RMSE of position, {count} runs (Figure {picture + 1})')
        figure.savefig(IMAGES / file, dpi=110)


def observe(path: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Fixes (count, K, 2) of the path (K, 2), with covariances: Table 1's sonar at the origin."""
    rng = np.random.default_rng(SEED)
    shape = count, len(path)
    ranges = np.hypot(*path.T) + rng.normal(0.0, RANGE_STD, shape)
    bearings = np.arctan2(path[:, 1], path[:, 0]) + rng.normal(0.0, BEARING_STD, shape)
    z, R = unbiased_polar_to_cartesian(
        ranges.ravel(), bearings.ravel(), RANGE_STD**2, BEARING_STD**2
    )
    return z.reshape(*shape, 2), R.reshape(*shape, 2, 2)


def multistatic(path: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Fixes (count, K, 2) of the path (K, 2), with covariances: each from the arrivals of one ping
    at all receivers."""
    setting = scenario('multistatic_fixes')
    std, speed = setting.toa_std, setting.sound_speed
    variance = np.full(len(RECEIVERS), std**2)
    rng = np.random.default_rng(SEED)
    tx = np.broadcast_to(TRANSMITTER, RECEIVERS.shape)
    z, R = np.empty((count, len(path), 2)), np.empty((count, len(path), 2, 2))
    for k, (x, y) in enumerate(path):
        at = np.array([x, y, 0.0])
        length = np.linalg.norm(at - RECEIVERS, axis=1) + np.linalg.norm(at - TRANSMITTER)
        for run in range(count):
            toa = length / speed + std * rng.normal(size=len(RECEIVERS))
            fix = localise(RECEIVERS, toa, variance, tx=tx, sound_speed=speed)
            z[run, k], R[run, k] = fix.position, fix.covariance
    return z, R


OBSERVE = {'table1': observe, 'multistatic_fixes': multistatic}


def squared(runs: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Squared errors (count, K) of tracks (count, K, 2)."""
    return np.sum((runs - path) ** 2, axis=-1)


def draw_dive(
    ax: Axes, path: np.ndarray, fixes: np.ndarray, tracks: dict[str, tuple[str, np.ndarray]]
) -> None:
    """The first run: path, fixes and both tracks."""
    ax.plot(*fixes.T, '.', color=PALE, ms=4, label='fixes')
    ax.plot(*path.T, color=INK, lw=1, ls='--', label='truth')
    for label, (colour, run) in tracks.items():
        ax.plot(*run.T, color=colour, lw=1.3, label=label)
    ax.set(xlabel='x, m', ylabel='y, m', aspect='equal', adjustable='datalim')
    ax.legend(frameon=False, fontsize=10)


def draw_rmse(ax: Axes, path: np.ndarray, tracks: dict[str, tuple[str, np.ndarray]]) -> None:
    """RMSE over the runs at each scan."""
    for label, (colour, runs) in tracks.items():
        ax.plot(np.sqrt(squared(runs, path).mean(axis=0)), color=colour, lw=1.3, label=label)
    ax.set(xlabel='time, s', ylabel='RMSE, m', ylim=(0.0, None))
    ax.legend(frameon=False, fontsize=10)


if __name__ == '__main__':
    main()
