# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Draw the pictures of docs/obstacle.md from runs: python docs/draw_obstacle.py

obstacle_offset.png   the offset while the range closes, and the deferred estimate
obstacle_fig3.png     the paper's Figure 3, with its altitude
obstacle_fig4.png     Figure 4: the diagram of the large obstacle and its image
obstacle_fig5.png     Figure 5 from our scenes; the distributions are those of
                      docs/results/obstacle_paper.json (benchmarks.obstacle_paper)
obstacle_calibration.png   stated against happened collisions (benchmarks.obstacle_accuracy)

Needs matplotlib, which nothing else here does. Run it from the project root.
"""

from __future__ import annotations

import json
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
from benchmarks.obstacle_paper import (  # noqa: E402
    deferred,
    echoes,
    encounter,
    EXACT,
    OFFSETS,
    read,
)
from benchmarks.study import truths  # noqa: E402
from sonar_imm.acoustics import geometry  # noqa: E402
from sonar_imm.acoustics.geometry import Pose  # noqa: E402
from sonar_imm.measurements import Altitude, SonarImage  # noqa: E402
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig  # noqa: E402
from sonar_imm_tools.simulation.obstacle.images import ImageSonar  # noqa: E402
from sonar_imm_tools.simulation.obstacle.simulator import (  # noqa: E402
    scenario,
    simulate,
    TrueObstacle,
)

OUT = ROOT / 'docs' / 'images'
CALIBRATION = ROOT / 'docs' / 'results' / 'obstacle_accuracy.json'
PAPER = ROOT / 'docs' / 'results' / 'obstacle_paper.json'
BLUE, RED, GREEN, INK = '#0072B2', '#D55E00', '#009E73', '#1b2733'
COLOURS = (BLUE, RED, '#CC79A7', '#E69F00', GREEN, '#56B4E9')
SEED = 3


def main() -> None:
    plt.rcParams.update({'font.size': 9, 'axes.spines.top': False, 'axes.spines.right': False})
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.4), layout='constrained')
    draw_band(axes[0], 'approach', '3 m below, roll 1.5 deg rms')
    draw_band(axes[1], 'calm', 'calm: roll 0.3 deg rms')
    axes[0].set_ylabel('vertical offset, m below the sonar')
    draw_curves(axes[2])
    figure.savefig(OUT / 'obstacle_offset.png', dpi=130)
    draw_figure_3()
    draw_figure_4()
    draw_figure_5()
    draw_calibration()


def draw_calibration() -> None:
    """Reliability diagrams, two standard errors to either side of what happened."""
    found = json.loads(CALIBRATION.read_text(encoding='utf-8'))
    table = {misses: found[misses]['within 8 m'] for misses in ('ignored', 'evidence')}
    names = {'reliability': 'all', 'early': 'at 60 and 45 m', 'late': 'from 30 m on'}
    figure, axes = plt.subplots(
        1, len(names), figsize=(3.4 * len(names), 3.6), layout='constrained', sharey=True
    )
    for ax, (name, title) in zip(axes, names.items()):
        ax.plot([0.0, 1.0], [0.0, 1.0], color=INK, lw=0.8)
        for misses, colour, side in (('ignored', RED, -0.01), ('evidence', BLUE, 0.01)):
            rows = table[misses][name].values()
            stated, happened, error = (
                np.array([row[column] for row in rows])
                for column in ('stated', 'happened', 'error')
            )
            style = {'color': colour, 'capsize': 2, 'label': f'misses: {misses}'}
            ax.errorbar(stated + side, happened, 2.0 * error, fmt='o', ms=4, lw=1, **style)
        ax.set(title=title, xlabel='stated', xlim=(0.0, 1.0), ylim=(0.0, 1.0), aspect='equal')
    axes[0].set_ylabel('happened')
    axes[0].legend(frameon=False, loc='upper left')
    figure.savefig(OUT / 'obstacle_calibration.png', dpi=130)


def draw_band(ax: Axes, name: str, title: str) -> None:
    """What is known of the offset while the range closes."""
    setting = scenario(name)
    scene = simulate(setting, SEED)
    truth = truths(scene, TrueObstacle)[0]
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
    z, poses = echoes(setting, simulate(setting, SEED))
    offsets = np.arange(-12.0, 12.1, 0.25)
    for refit, colour, label in ((False, RED, 'deferred (RMSD)'), (True, GREEN, 'refitted')):
        found = deferred(z, poses, config_of(setting), offsets=offsets, refit=refit)
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


MOORED = {'altitude': 15.5}
"""Figure 3: the vehicle swims 15.5 m above the sea floor, the sphere is on a tether of 15 m."""
MOORED_SEED = 196
"""Of 200 encounters the one whose estimates, by eye and by the detector, are nearest to the truth,
as the paper's were; what they are elsewhere is in the results of section 5."""


def draw_figure_3() -> None:
    """Figure 3 as printed: RMSD against the offset and altitude by ping above, and below the
    points that are predicted for the estimate beside those measured."""
    setting, scene = encounter('sphere', MOORED, MOORED_SEED)
    exact, poses = echoes(setting, scene)
    figure, panels = plt.subplot_mosaic(
        [['curve', 'altitude'], ['points', 'points']], figsize=(9.0, 7.0), layout='constrained'
    )
    for name, colour in (('by eye', BLUE), ('detector', RED)):
        found = deferred(
            read(exact, name, MOORED_SEED), poses, config_of(setting), offsets=OFFSETS
        )
        label = f'{name}: {found.best:.2f} m'
        panels['curve'].plot(found.offset, found.rmsd, color=colour, label=label)
        panels['curve'].plot(found.best, found.least, 'o', color=colour)
    panels['curve'].axvline(
        setting.vertical_offset, color=INK, ls='--', lw=1, label='truth: 0.5 m'
    )
    panels['curve'].set(
        xlabel='offset tried, m below the sonar', ylabel='RMSD, pixels', xlim=(-0.4, 10.0)
    )
    panels['curve'].set_ylim(0.0, 12.0)
    panels['curve'].legend(frameon=False, loc='upper center')
    heights = [item.measurement for item in scene.measurements]
    altitude = [item.altitude for item in heights if isinstance(item, Altitude)][: len(exact)]
    panels['altitude'].plot(altitude, color=INK, lw=1)
    panels['altitude'].set(xlabel='ping', ylabel='altitude of the sonar, m', ylim=(0.0, 20.0))
    z = read(exact, 'detector', MOORED_SEED)
    offset = deferred(z, poses, config_of(setting), offsets=OFFSETS).best
    first = Pose(poses.position[0], poses.R[0])
    m = geometry.to_world(first, geometry.reconstruct(z[0, 0], z[0, 1], offset, first.R))
    predicted = np.column_stack(geometry.project(geometry.to_body(poses, m)))
    for each, marker, colour, label in (
        (z, '.', BLUE, 'measured by the detector'),
        (predicted, '+', GREEN, f'predicted from the first echo, {offset:.1f} m below the sonar'),
    ):
        panels['points'].plot(
            np.degrees(each[:, 1]), each[:, 0], marker, color=colour, ms=5, label=label
        )
    panels['points'].set(xlabel='azimuth, deg to starboard', ylabel='range, m')
    panels['points'].legend(frameon=False)
    figure.savefig(OUT / 'obstacle_fig3.png', dpi=130)


FLOATS = (-5.0, 0.0, 5.0)
"""Figure 4: m to starboard of the middle of the obstacle."""
TOP, BAR = 4.0, 13.0
"""Depth of floats and bar below the sonar, m."""


def large_obstacle(rng: np.random.Generator) -> np.ndarray:
    """Glints (n, 2) of three floats, their chains and a bar: m across, and m below the sonar."""
    ball = rng.normal(size=(8, 2))
    ball *= 0.4 / np.linalg.norm(ball, axis=1, keepdims=True)
    parts = [[side, TOP] + ball for side in FLOATS]
    links = np.arange(TOP + 1.0, BAR, 0.75)
    parts += [np.column_stack([np.full(len(links), side), links]) for side in FLOATS]
    along = np.arange(FLOATS[0], FLOATS[-1] + 0.1, 0.4)
    parts.append(np.column_stack([along, np.full(len(along), BAR)]))
    return np.concatenate(parts)


def draw_figure_4() -> None:
    """Figure 4 as printed: a diagram of the large obstacle, and its image."""
    setting, scene = encounter('large', {}, SEED)
    _, poses = echoes(setting, scene)
    glints = large_obstacle(np.random.default_rng(SEED))
    middle = geometry.flip_world(truths(scene, TrueObstacle)[0].position[0])
    course = np.arctan2(*(poses.position[-1] - poses.position[0])[1::-1])
    across = np.array([-np.sin(course), np.cos(course), 0.0])
    ping = 40
    pose = Pose(poses.position[ping], poses.R[ping])
    level = np.array([middle[0], middle[1], pose.position[2]])
    places = [level + side * across + [0.0, 0.0, down] for side, down in glints]
    looks = scenario(
        'images',
        {
            'target_fading': 'rayleigh',
            'target_snr_db': 18.0,
            'max_range': 100.0,
            'image_beams': 256,
            'image_bins': 600,
            'vertical_fov_deg': EXACT['vertical_fov_deg'],
        },
    )
    sonar = ImageSonar(looks, np.random.default_rng(SEED))
    pixels = sonar.image(pose, places, 1.0)
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7.0, 9.0), layout='constrained', height_ratios=(1.0, 1.3)
    )
    above.plot(FLOATS, np.full(len(FLOATS), TOP), 'o', ms=16, color='#E69F00', label='floats')
    for number, side in enumerate(FLOATS):
        label = 'chains' if number == 0 else None
        above.plot([side, side], [TOP, BAR], color=INK, ls=(0, (1, 1)), lw=2.5, label=label)
    above.plot([FLOATS[0], FLOATS[-1]], [BAR, BAR], color=RED, lw=5, label='bar')
    above.axhline(0.0, color=BLUE, ls='--', lw=1)
    above.text(-9.0, -0.3, 'depth of the sonar', color=BLUE)
    above.set(xlim=(-11.0, 11.0), ylim=(16.0, -2.0), aspect='equal')
    above.set(
        xlabel='m to starboard', ylabel='m below the sonar', title='the obstacle, from ahead'
    )
    above.legend(frameon=False, loc='center right')
    d, azimuth = sonar.range[:, None], -sonar.bearing
    below.pcolormesh(
        d * np.sin(azimuth), d * np.cos(azimuth), np.sqrt(pixels), cmap='Greys', rasterized=True
    )
    image = SonarImage(
        stamp_ns=1, range=sonar.range, bearing=sonar.bearing, amplitude=pixels.astype(float)
    )
    rules = DetectorConfig.from_mapping(looks.feeder_instruments(), ignore_unknown=True)
    echo = detect(image, rules)
    x, y = echo.range * np.sin(-echo.bearing), echo.range * np.cos(echo.bearing)
    below.plot(x, y, 'o', color=RED, mfc='none', ms=12)
    # Where the parts lie in the image: as far as they are, whatever their depth.
    m = geometry.to_body(pose, np.array(places))
    distance, turned = geometry.project(m)
    x, y = distance * np.sin(turned), distance * np.cos(turned)
    below.set(xlim=(x.mean() - 11.0, x.mean() + 11.0), ylim=(y.min() - 5.0, y.max() + 6.0))
    marks = {'float': [*range(4, 4 + 8 * len(FLOATS), 8)], 'bar': [len(glints) - 8]}
    for name, rows in marks.items():
        side = -1.0 if name == 'float' else 1.0
        for row in rows:
            below.annotate(
                name,
                (x[row], y[row] + 0.6 * side),
                xytext=(0, 30 * side),
                textcoords='offset points',
                ha='center',
                color=BLUE,
                arrowprops={'arrowstyle': '-', 'color': BLUE, 'lw': 0.8},
            )
    below.set(xlabel='m to starboard', ylabel='m ahead', aspect='equal')
    below.set_title('in the image; circled: what the detector finds')
    figure.savefig(OUT / 'obstacle_fig4.png', dpi=130)


def draw_figure_5() -> None:
    """Figure 5: RMSD by eye and by a noisy detector, and what a single such number is worth."""
    estimates = json.loads(PAPER.read_text(encoding='utf-8'))['large']['estimates']
    # One encounter that reads as the paper's did: 8 m by eye, 11 m by the detector.
    off = np.abs(np.array(estimates['by eye']) - 8.0) + np.abs(
        np.array(estimates['noisy detector']) - 11.0
    )
    seed = int(np.argmin(off))
    setting, scene = encounter('large', {}, seed)
    z, poses = echoes(setting, scene)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.4), layout='constrained')
    for name, colour in (('by eye', BLUE), ('noisy detector', '#CC79A7')):
        found = deferred(read(z, name, seed), poses, config_of(setting), offsets=OFFSETS)
        left.plot(found.offset, found.rmsd, color=colour, label=f'{name}: {found.best:.1f} m')
        left.plot(found.best, found.least, 'o', color=colour)
    left.axvline(8.0, color=INK, ls='--', lw=1, label='truth: 8 m')
    left.set(
        title=f'one encounter of {len(estimates["by eye"])}, chosen',
        xlabel='offset tried, m below the sonar',
        ylabel='RMSD, pixels',
        ylim=(0.0, None),
    )
    left.legend(frameon=False, loc=(0.42, 0.6))
    for row, values in enumerate(estimates.values()):
        low, middle, high = np.percentile(values, [5.0, 50.0, 95.0])
        spread = np.random.default_rng(row).uniform(-0.25, 0.25, len(values))
        right.plot(values, row + spread, '.', ms=2, color=COLOURS[row], alpha=0.5)
        right.plot([low, high], [row, row], color=COLOURS[row], lw=2)
        right.plot(middle, row, 'o', color=COLOURS[row])
    right.axvline(8.0, color=INK, ls='--', lw=1)
    right.axvline(11.0, color=INK, ls=':', lw=1)
    right.set(
        title='all of them',
        yticks=range(len(estimates)),
        yticklabels=list(estimates),
        xlabel='deferred estimate, m below the sonar',
    )
    right.invert_yaxis()
    figure.savefig(OUT / 'obstacle_fig5.png', dpi=110)


if __name__ == '__main__':
    main()
