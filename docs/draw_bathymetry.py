# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Draw the figures of docs/bathymetry.md from runs: python docs/draw_bathymetry.py

The pictures of the paper are at the paper's settings, from benchmarks/bathymetry_paper.py. Needs
matplotlib, which nothing else here does. Run it from the project root.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
import sys

import matplotlib
import numpy as np

matplotlib.use('Agg')
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from matplotlib import pyplot as plt  # noqa: E402

from benchmarks import bathymetry_paper as paper  # noqa: E402
from sonar_imm.acoustics import array, spatial  # noqa: E402
from sonar_imm.trackers.bathymetry.ping import Ping, run_particles  # noqa: E402
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker  # noqa: E402
from sonar_imm_tools.simulation.bathymetry.objects import facets_of, surfaces_of  # noqa: E402
from sonar_imm_tools.simulation.bathymetry.simulator import (  # noqa: E402
    scenario,
    simulate,
    snr,  # noqa: E402
)

IMAGES = ROOT / 'docs' / 'images'
BLUE, RED, AMBER, INK = '#0072B2', '#D55E00', '#E69F00', '#1b2733'
SETS = {
    'height_rw_ncs': {'model_set': 'height_rw_ncs', 'sigmas': (1.0, 1.0)},
    'height_two_rw': {**paper.WALKS, 'sigmas': (0.01, 0.5)},
    'angle_two_rw': {'model_set': 'angle_two_rw'},
}
AS_PRINTED = {
    'RW and NCS': paper.SETS['height_rw_ncs'](1.0),
    'two RW': paper.SETS['height_two_rw'](1.0),
}
SURFACE_DB = -6.0
"""Power of the echoes by way of the surface, relative to those of the floor."""
SHADOW = (35.0, 36.0)
"""Slant ranges of the discontinuity in the picture of particle clouds, m."""
CLOUDS_AT = (20.0, 35.5, 45.0, 70.0)


def main() -> None:
    plt.rcParams.update({'font.size': 9, 'axes.spines.top': False, 'axes.spines.right': False})
    config = scenario('paper', {'pings': 1})
    scene = simulate(config, 1)
    ping, truth = scene.measurements[0].measurement, scene.truth[0]
    runs = {
        name: BathymetryTracker(BathymetryConfig(**values)).process(ping)[0]
        for name, values in SETS.items()
    }
    printed = {
        name: paper.PrintedTracker(BathymetryConfig(**values)).process(ping)[0]
        for name, values in AS_PRINTED.items()
    }
    angles = paper.PrintedTracker(BathymetryConfig(**paper.ANGLES)).process(ping)[0]
    draw_scene(config, truth)
    draw_spectra(ping, truth, printed, angles)
    draw_multipath()
    with plt.rc_context({'font.size': 12}):
        draw_profile(ping, truth, runs)
        draw_clouds()
    draw_sensitivity()
    draw_ledge()


def save(figure, name: str, *, tight: bool = True, dpi: int = 80) -> None:
    if tight:
        figure.tight_layout()
    figure.savefig(IMAGES / name, dpi=dpi, pil_kwargs={'optimize': True})
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


def draw_spectra(ping, truth, printed, angles) -> None:
    """Figures 2 to 4: pseudo-spectra, what they find alone, what the filter finds, and the
    probabilities of its models, all at the paper's settings."""
    figure, axes = plt.subplots(
        4, 1, figsize=(9, 10), sharex=True, height_ratios=(2, 1, 2, 1), layout='constrained'
    )
    spectrum(axes[0], ping, truth, 'music', printed['RW and NCS'])
    for colour, (name, estimate) in zip((RED, BLUE), printed.items()):
        rough = estimate.probabilities[:, 0 if name == 'RW and NCS' else 1]
        axes[1].plot(ping.range, rough, color=colour, linewidth=0.9, label=name)
    axes[1].set(ylabel='P(rough)', title='heights: the random walk of 1 m')
    spectrum(axes[2], ping, truth, 'capon', angles)
    for model, colour, name in ((0, BLUE, '0.1 deg'), (1, RED, '0.1 to 2 deg')):
        axes[3].plot(
            ping.range, angles.probabilities[:, model], color=colour, linewidth=0.9, label=name
        )
    axes[3].set(ylabel='probability', title='angles: both random walks')
    for axis in (axes[1], axes[3]):
        axis.axvspan(40, 50, color=AMBER, alpha=0.15)
        axis.legend(loc='upper right', fontsize=8)
    axes[-1].set_xlabel('slant range [m]')
    save(figure, 'bathymetry_spectra.png', tight=False)


def spectrum(axis, ping, truth, method, estimate) -> None:
    largest = array.largest_sine(0.5)
    grid = np.linspace(-largest, largest, 361)
    degrees = np.degrees(np.arcsin(grid))
    power = spatial.ping_spectrum(ping.iq, grid, 0.5, method=method)
    decibels = 10 * np.log10(power / power.max(axis=1, keepdims=True))
    axis.pcolormesh(
        ping.range, degrees, decibels.T, vmin=-25, vmax=0, cmap='Greys_r', rasterized=True
    )
    alone = np.degrees(np.arcsin(spatial.peak_sines(power, grid)))
    axis.plot(ping.range, alone, '.', color=AMBER, markersize=2, label=f'{method} alone')
    axis.plot(truth.range, np.degrees(truth.angle), color='white', linewidth=0.6, label='truth')
    found = columns(estimate)['angle']
    axis.plot(ping.range, np.degrees(found), color=RED, linewidth=1.0, label='particle filter')
    axis.set(ylim=(-30, 35), ylabel='angle [deg]', title=method)
    axis.legend(loc='upper right', fontsize=8, facecolor='0.85')


def draw_multipath() -> None:
    """Figure 3 with what it is about: echoes by way of a calm surface in the Capon spectrum, and
    the estimate that goes through them, as printed and with `multipath`."""
    config = scenario('multipath', {'pings': 1, 'multipath_level_db': SURFACE_DB})
    scene = simulate(config, 1)
    ping, truth = scene.measurements[0].measurement, scene.truth[0]
    expected = {
        'model_set': 'angle_two_rw',
        'multipath': True,
        'multipath_level_db': SURFACE_DB,
    }
    depth, tilt = config.sonar_height - truth.height, math.radians(config.tilt_deg)
    surface = array.multipath_sines(depth, truth.range, tilt, config.sonar_depth)
    figure, axes = plt.subplots(2, 1, figsize=(9, 5.5), sharex=True, layout='constrained')
    printed = paper.PrintedTracker(BathymetryConfig(**paper.ANGLES))
    default = BathymetryTracker(BathymetryConfig(**expected))
    for axis, tracker, name in (
        (axes[0], printed, 'as printed'),
        (axes[1], default, 'echoes by way of the surface expected'),
    ):
        estimate = tracker.process(ping)[0]
        spectrum(axis, ping, truth, 'capon', estimate)
        for sine in surface.T:
            angle = np.degrees(np.arcsin(sine))
            axis.plot(ping.range, angle, '--', color=BLUE, linewidth=0.8)
        error = columns(estimate)['angle'] - truth.angle
        rms = math.degrees(math.sqrt(np.mean(np.square(error[truth.valid]))))
        axis.set(title=f'{name}: {rms:.2f} deg RMS', ylim=(-75, 35))
    axes[-1].set_xlabel('slant range [m]')
    save(figure, 'bathymetry_multipath.png', tight=False)


def draw_clouds() -> None:
    """Figure 5: the particles of both models along the ping and at four ranges, and what becomes
    of them at a discontinuity."""
    config = scenario('paper', {'pings': 1, 'shadows': SHADOW})
    scene = simulate(config, 1)
    ping, truth = scene.measurements[0].measurement, scene.truth[0]
    seen = paper.as_printed(Ping(BathymetryConfig(**paper.ANGLES), ping, None))
    clouds = []

    def watch(_bin, particles) -> None:
        clouds.append(np.degrees(particles.x[:, 0].copy()))

    track = run_particles(
        seen.models, seen.likelihood, 100, (0, ping.stamp_ns, 0), resample=True, watch=watch
    )
    x = np.array(clouds)  # (T, 2, 100)
    figure = plt.figure(figsize=(9, 9), layout='constrained')
    rows = figure.add_gridspec(3, 4, height_ratios=(2, 1, 1.3))
    top = figure.add_subplot(rows[0, :])
    names = (('0.1 deg', BLUE), ('0.1 to 2 deg', RED))
    for model, (name, colour) in reversed(list(enumerate(names))):
        place = np.repeat(ping.range[::4], 100)
        top.plot(place, x[::4, model].ravel(), '.', ms=2, color=colour, alpha=0.5, label=name)
    top.plot(truth.range, np.degrees(truth.angle), color=INK, linewidth=0.6, label='truth')
    top.axvspan(*SHADOW, color=AMBER, alpha=0.3)
    top.set(ylabel='angle [deg]', title='particles of both models; no echo from 35 to 36 m')
    for handle in top.legend(loc='upper right').legend_handles:
        handle.set_marker('o')
    middle = figure.add_subplot(rows[1, :], sharex=top)
    for model, (_, colour) in enumerate(names):
        middle.plot(ping.range, track.probability[:, model], color=colour, linewidth=0.9)
    middle.axvspan(*SHADOW, color=AMBER, alpha=0.3)
    middle.set(xlabel='slant range [m]', ylabel='probability', ylim=(-0.03, 1.03))
    for k, where in enumerate(CLOUDS_AT):
        t = int(np.argmin(np.abs(ping.range - where)))
        axis = figure.add_subplot(rows[2, k])
        centre = float(np.degrees(truth.angle[t]))
        width = max(1.0, 1.1 * float(np.abs(x[t] - centre).max()))
        edges = np.linspace(centre - width, centre + width, 31)
        for model, (_, colour) in enumerate(names):
            axis.hist(x[t, model], edges, color=colour, alpha=0.6)
        axis.axvline(centre, color=INK, linewidth=0.8)
        axis.set(title=f'{where:g} m', xlabel='angle [deg]')
    save(figure, 'bathymetry_clouds.png', tight=False, dpi=110)


def draw_sensitivity() -> None:
    """How the labels depend on the noise of the rough walk, from benchmarks/bathymetry_paper."""
    found = json.loads((ROOT / 'docs/results/bathymetry_paper.json').read_text())['cases']
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3))
    for colour, name in ((RED, 'height_rw_ncs'), (BLUE, 'height_two_rw')):
        rows = {
            float(case.split(', ')[1].split()[0]): row
            for case, row in found.items()
            if case.startswith(name)
        }
        left.semilogx(list(rows), [row['overlap'] for row in rows.values()], 'o-', color=colour)
        label = f'{name}, as printed'
        right.semilogx(
            list(rows), [row['all_m'] for row in rows.values()], 'o-', color=colour, label=label
        )
    left.set(xlabel='sigma of the rough walk [m]', ylabel='overlap', ylim=(0, 1))
    right.set(xlabel='sigma of the rough walk [m]', ylabel='RMSE of the height [m]', ylim=(0, 0.4))
    right.legend(fontsize=8)
    save(figure, 'bathymetry_sensitivity.png')


def draw_profile(ping, truth, runs) -> None:
    """Heights with their bands, and the probability of rough floor, of the corrected sets."""
    figure, axes = plt.subplots(len(runs) + 1, 1, figsize=(9, 9.5), sharex=True)
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
    axes[0].legend(loc='upper left', fontsize=10, ncols=3)
    axes[-1].axvspan(40, 50, color=BLUE, alpha=0.1)
    axes[-1].set(xlabel='slant range [m]', ylabel='P(rough)')
    axes[-1].legend(loc='upper right', fontsize=10)
    save(figure, 'bathymetry_profile.png', dpi=110)


def draw_ledge() -> None:
    """A ping over a ledge: its surfaces, and what is made of them, gated and resolved."""
    config = scenario('ledge', {'pings': 1})
    ping = simulate(config, 3).measurements[0].measurement
    facets = facets_of(config, ping.range, snr(config, ping.range))
    power, height = surfaces_of(facets, len(ping))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharex=True, sharey=True)
    for axis, layover in zip(axes, ('gated', 'resolved')):
        table = columns(BathymetryTracker(BathymetryConfig(layover=layover)).process(ping)[0])
        surfaces = np.where(power >= 1.0, height, np.nan)
        axis.plot(ping.range, surfaces, color=INK, linewidth=0.8, label='truth')
        valid, two = table['valid'] > 0, table['surfaces'] == 2
        single = valid & ~two
        axis.plot(
            ping.range[single], table['height'][single], '.', color=BLUE, label='one surface'
        )
        if layover == 'gated':
            axis.plot(ping.range[two], table['height'][two], 'x', color=RED, label='no sounding')
        else:
            bars = {'fmt': '.', 'elinewidth': 0.6}
            pair = (
                ('height', np.sqrt(table['cov_height_height']), AMBER, 'lower of two'),
                ('height_2', table['height_2_std'], RED, 'upper of two'),
            )
            for name, std, colour, label in pair:
                bars |= {'color': colour, 'label': label, 'yerr': 2.0 * std[two]}
                axis.errorbar(ping.range[two], table[name][two], **bars)
        handles = dict(zip(*reversed(axis.get_legend_handles_labels())))
        axis.legend(handles.values(), handles.keys(), loc='lower right', fontsize=8)
        axis.set(xlim=(31.0, 35.0), ylim=(-1.2, 3.2), xlabel='slant range [m]', title=layover)
    axes[0].set(ylabel='height [m]')
    save(figure, 'bathymetry_ledge.png')


def columns(estimate) -> dict[str, np.ndarray]:
    return estimate.columns()


if __name__ == '__main__':
    main()
