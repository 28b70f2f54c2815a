"""Draw the figures of docs/bathymetry.md from a run: python docs/draw_bathymetry.py

Needs matplotlib, which nothing else here does. Run it from the project root.
"""

from __future__ import annotations

import math
from pathlib import Path
import sys

import matplotlib
import numpy as np

matplotlib.use('Agg')
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from matplotlib import pyplot as plt  # noqa: E402

from sonar_imm.acoustics import array, spatial  # noqa: E402
from sonar_imm.simulation.bathymetry.simulator import scenario, simulate, snr  # noqa: E402
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker  # noqa: E402

IMAGES = ROOT / 'docs' / 'images'
BLUE, RED, AMBER, INK = '#0072B2', '#D55E00', '#E69F00', '#1b2733'
SETS = {
    'height_rw_ncs': {'model_set': 'height_rw_ncs', 'sigmas': (1.0, 1.0)},
    'height_two_rw': {'sigmas': (0.01, 0.5)},
    'angle_two_rw': {'model_set': 'angle_two_rw'},
}


def main() -> None:
    plt.rcParams.update({'font.size': 9, 'axes.spines.top': False, 'axes.spines.right': False})
    config = scenario('paper', {'pings': 1})
    scene = simulate(config, 1)
    ping, truth = scene.measurements[0].measurement, scene.truth[0]
    runs = {
        name: BathymetryTracker(BathymetryConfig(**values)).process(ping)[0]
        for name, values in SETS.items()
    }
    draw_scene(config, truth)
    draw_spectra(ping, truth, runs['height_two_rw'])
    draw_profile(ping, truth, runs)


def save(figure, name: str) -> None:
    figure.tight_layout()
    figure.savefig(IMAGES / name, dpi=80, pil_kwargs={'optimize': True})
    print(IMAGES / name)


def draw_scene(config, truth) -> None:
    """Figure 1: the floor and the signal-to-noise ratio."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 2.6), width_ratios=(2, 1))
    across = -truth.xyz[:, 1]
    left.plot(across, truth.xyz[:, 2], color=INK, linewidth=0.7)
    left.plot(0, 0, 'v', color=BLUE, markersize=9)
    tilt = math.radians(config.tilt_deg)
    left.arrow(0, 0, 12 * math.cos(tilt), -12 * math.sin(tilt), color=BLUE, head_width=0.8)
    left.set(xlabel='across track [m]', ylabel='height below the sonar [m]')
    left.set_ylim(-18, 2)
    right.plot(truth.range, 10 * np.log10(snr(config, truth.range)), color=BLUE)
    right.set(xlabel='slant range [m]', ylabel='signal to noise, one stave [dB]')
    save(figure, 'bathymetry_scene.png')


def draw_spectra(ping, truth, estimate) -> None:
    """Figures 2 and 3: pseudo-spectra, what they find alone, and what the filter finds."""
    figure, axes = plt.subplots(2, 1, figsize=(9, 6.4), sharex=True)
    largest = array.largest_sine(0.5)
    grid = np.linspace(-largest, largest, 361)
    degrees = np.degrees(np.arcsin(grid))
    for axis, method in zip(axes, ('music', 'capon')):
        power = spatial.ping_spectrum(ping.iq, grid, 0.5, method=method)
        decibels = 10 * np.log10(power / power.max(axis=1, keepdims=True))
        axis.pcolormesh(
            ping.range, degrees, decibels.T, vmin=-25, vmax=0, cmap='Greys_r', rasterized=True
        )
        alone = np.degrees(np.arcsin(spatial.peak_sines(power, grid)))
        axis.plot(ping.range, alone, '.', color=AMBER, markersize=2, label=f'{method} alone')
        axis.plot(
            truth.range, np.degrees(truth.angle), color='white', linewidth=0.6, label='truth'
        )
        axis.plot(
            ping.range,
            np.degrees(estimate.extras['angle']),
            color=RED,
            linewidth=1.0,
            label='IMM particle filter',
        )
        axis.set(ylim=(-30, 35), ylabel='angle from broadside [deg]')
        axis.legend(loc='upper right', fontsize=8, facecolor='0.85')
    axes[-1].set_xlabel('slant range [m]')
    save(figure, 'bathymetry_spectra.png')


def draw_profile(ping, truth, runs) -> None:
    """Figures 4 and 5: heights with their bands, and the probability of the rough model."""
    figure, axes = plt.subplots(len(runs) + 1, 1, figsize=(9, 7.2), sharex=True)
    for axis, (name, estimate) in zip(axes, runs.items()):
        height = columns(estimate)['height']
        std = np.sqrt(estimate.covariance[:, 0, 0])
        if estimate.state_names[0] == 'angle':
            std = std * np.abs(estimate.xyz[:, 1])
        axis.fill_between(
            ping.range,
            height - 2 * std,
            height + 2 * std,
            color=AMBER,
            alpha=0.35,
            linewidth=0,
            label='two standard deviations',
        )
        axis.plot(truth.range, truth.height, color=INK, linewidth=0.5, label='truth')
        axis.plot(ping.range, height, color=BLUE, linewidth=0.9, label='estimate')
        axis.set(ylim=(-2, 2), ylabel='height [m]', title=name)
        rough = estimate.probabilities[:, 0 if name == 'height_rw_ncs' else 1]
        axes[-1].plot(ping.range, rough, linewidth=0.9, label=name)
    axes[0].legend(loc='upper left', fontsize=8, ncols=3)
    axes[-1].axvspan(40, 50, color=BLUE, alpha=0.1)
    axes[-1].set(xlabel='slant range [m]', ylabel='P(rough)')
    axes[-1].legend(loc='upper left', fontsize=8)
    save(figure, 'bathymetry_profile.png')


def columns(estimate) -> dict[str, np.ndarray]:
    return estimate.columns()


if __name__ == '__main__':
    main()
