"""Draw docs/images/obstacle_offset.png from runs: python docs/draw_obstacle.py

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

from benchmarks.obstacle_accuracy import config_of, track  # noqa: E402
from sonar_imm.acoustics.geometry import Pose  # noqa: E402
from sonar_imm.measurements import Detections, Navigation  # noqa: E402
from sonar_imm.simulation.obstacle.simulator import scenario, simulate  # noqa: E402
from sonar_imm.trackers.obstacle.deferred import deferred, sonar_poses  # noqa: E402

OUT = ROOT / 'docs' / 'images' / 'obstacle_offset.png'
BLUE, RED, GREEN, INK = '#0072B2', '#D55E00', '#009E73', '#1b2733'
SEED = 3


def main() -> None:
    plt.rcParams.update({'font.size': 9, 'axes.spines.top': False, 'axes.spines.right': False})
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.4), layout='constrained')
    draw_band(axes[0], 'approach', '3 m below, roll 1.5 deg rms')
    draw_band(axes[1], 'calm', 'calm: roll 0.3 deg rms')
    axes[0].set_ylabel('vertical offset, m below the sonar')
    draw_curves(axes[2])
    figure.savefig(OUT, dpi=130)


def draw_band(ax: Axes, name: str, title: str) -> None:
    """What is known of the offset while the range closes."""
    setting = scenario(name)
    scene = simulate(setting, SEED)
    truth = scene.truth[0]
    rows = []
    for stamp, estimate in sorted(track(scene, config_of(setting)).items()):
        ping = int(np.flatnonzero(truth.stamp_ns == stamp)[0])
        if len(estimate.state) and estimate.extras['track_state'][0] > 0:
            band = [estimate.extras[f'vertical_offset_{end}'][0] for end in ('lo', 'hi')]
            rows.append([truth.range[ping], estimate.state[0, 2], *band, truth.in_beam[ping]])
    d, offset, low, high, seen = np.transpose(rows)
    ax.fill_between(d, low, high, color=BLUE, alpha=0.2, lw=0, label='90 % band')
    ax.plot(d, offset, color=BLUE, label='estimate')
    ax.plot(truth.range, truth.vertical_offset, color=INK, ls='--', lw=1, label='truth')
    if not seen.all():
        left = d[seen > 0][-1]
        ax.axvline(left, color=RED, lw=0.8)
        ax.text(left, 18.5, 'leaves the beam ', color=RED, ha='right')
    ax.set(title=title, xlabel='range, m', xlim=(90.0, 6.0), ylim=(20.0, -20.0))
    ax.legend(loc='upper right', frameon=False)


def draw_curves(ax: Axes) -> None:
    """The deferred estimate of the same approach: RMSD against the offset that is tried."""
    setting = scenario('approach')
    scene, config = simulate(setting, SEED), config_of(setting)
    pings = [one.measurement for one in scene.measurements]
    pings = [one for one in pings if isinstance(one, Detections) and len(one)]
    echoes = np.array([[one.range[0], -one.bearing[0]] for one in pings])
    poses, known = sonar_poses(
        [one.measurement for one in scene.measurements if isinstance(one.measurement, Navigation)],
        np.array([one.stamp_ns for one in pings]),
        config,
    )
    poses = Pose(poses.position[known], poses.R[known])
    offsets = np.arange(-12.0, 12.1, 0.25)
    for refit, colour, label in ((False, RED, 'deferred (RMSD)'), (True, GREEN, 'refitted')):
        found = deferred(echoes[known], poses, config, offsets=offsets, refit=refit)
        ax.plot(found.offset, found.rmsd, color=colour, label=label)
        ax.plot(found.best, found.least, 'o', color=colour)
    ax.axvline(setting.vertical_offset, color=INK, ls='--', lw=1)
    ax.set(
        title='afterwards, the whole approach',
        xlabel='offset tried, m below the sonar',
        ylabel='RMSD, pixels',
        ylim=(0.0, 8.0),
    )
    ax.legend(frameon=False)


if __name__ == '__main__':
    main()
