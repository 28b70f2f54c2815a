# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Draw the figures of docs/fathometer.md from runs: python docs/draw_fathometer.py

Needs matplotlib, which nothing else here does, and for the real lines segyio and the recordings
(SONAR_IMM_DATA). Run it from the project root.
"""

from __future__ import annotations

from pathlib import Path
import sys
import tempfile

import matplotlib
import numpy as np
import yaml

matplotlib.use('Agg')
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from matplotlib import pyplot as plt  # noqa: E402

from benchmarks.fathometer_paper import BOOTSTRAP, ChangedTracker  # noqa: E402
from benchmarks.study import DATA  # noqa: E402
from sonar_imm.acoustics import fathometer  # noqa: E402
from sonar_imm.measurements import Trace  # noqa: E402
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker  # noqa: E402
from sonar_imm_tools.evaluation.fathometer.scoring import records_of  # noqa: E402
from sonar_imm_tools.recordings.convert import convert_segy  # noqa: E402
from sonar_imm_tools.recordings.measurements import measurements_of  # noqa: E402
from sonar_imm_tools.recordings.reader import BagReader  # noqa: E402
from sonar_imm_tools.simulation.fathometer.scenario import (  # noqa: E402
    drift_of,
    FathometerScenario,
    scenario,
)
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, simulate  # noqa: E402

IMAGES = ROOT / 'docs' / 'images'
RECORDED = DATA / 'sbp_chiapas'
LINES = (
    'MET_EW-WE_SBP_L1_WE_20180313165838.seg',
    'MET_EW-WE_SBP_L2_EW_20180313171011.seg',
    'MET_EW-WE_SBP_L3_WE_20180313172145.seg',
    'MET_NS-SN_SBP_L9_SN_20180313161627.seg',
)
BLUE, RED, GREEN, AMBER, INK = '#0072B2', '#D55E00', '#009E73', '#E69F00', '#1b2733'
PASS = (174, 186)
HIGHEST = 4.5  # metres of the depth axis for the largest amplitude
COLOURS = (BLUE, RED, GREEN, '#CC79A7', AMBER, '#56B4E9')


def main() -> None:
    plt.rcParams.update({'font.size': 9, 'axes.spines.top': False, 'axes.spines.right': False})
    draw_conventions()
    processed = drift(3)
    draw_paper(processed)
    draw_orders(processed)
    draw_fixed_orders(processed['mvdr'])
    draw_ship(drift(3, range(150, 206), PASS))
    if RECORDED.exists():
        draw_lines()


def save(figure, name: str) -> None:
    figure.tight_layout()
    figure.savefig(IMAGES / name, dpi=80, pil_kwargs={'optimize': True})
    print(IMAGES / name)


def track(traces, tracker):
    """Records and responses (depths, records) in units of the noise."""
    records, columns = [], []
    for trace in traces:
        records += tracker.process(trace)
        columns.append(tracker.response.amplitude / tracker.response.sigma)
    return records_of(records), np.array(columns).T, tracker.response.depth


def draw_conventions() -> None:
    """The geometry; where the echo lands as implemented and as printed; loading."""
    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(12, 3.6), width_ratios=(0.8, 1.3, 1.3)
    )
    _draw_geometry(left)
    scene = simulate(
        scenario(
            'drift_spectra',
            {
                'records': 1,
                'layers': 1,
                'appearing': (),
                'fading': (),
                'snapshot_seconds': 0.35,
                'snapshots': 256,
                'heave': 0.0,
                'array_depth_std': 0.0,
                'phone_noise': 1e-4,
                'ship_noise': 0.0,
            },
        ),
        1,
    )
    item, H = scene.measurements[0].measurement, float(scene.truth[0].depth[0] - 73.5)
    w = fathometer.steering(item.frequency, 0.18 * np.arange(item.hydrophones), 1500.0)
    csdm = item.csdm.astype(np.complex128)
    comb = float(item.frequency[0]), float(item.frequency[1] - item.frequency[0])
    z = np.linspace(-80.0, 80.0, 6401)

    def response(gamma):
        return fathometer.depth_response(gamma, *comb, (z[0], z[1] - z[0], len(z)), 0.0, 1500.0)

    gamma = fathometer.coherence(csdm, w, 'mvdr')
    time = 2e3 * z / 1500.0
    middle.plot(time, response(gamma), color=BLUE, lw=0.8, label='as implemented')
    middle.plot(
        time, response(gamma.conj()) - 0.1, color=RED, lw=0.8, label='conjugate, as printed'
    )
    middle.axvline(2e3 * H / 1500.0, color=INK, ls=':', lw=1)
    middle.set(xlabel='time [ms]; dotted: +2 H / c', ylabel='response', title='Where the echo is')
    middle.legend(frameon=False, loc='center left')
    loadings = np.geomspace(1e-3, 10.0, 13)
    here = int(np.argmin(np.abs(z - H)))
    right.semilogx(
        loadings,
        [response(fathometer.coherence(csdm, w, 'mvdr', loading=eps))[here] for eps in loadings],
        'o-',
        color=BLUE,
        ms=3,
        label='loaded throughout',
    )
    right.semilogx(
        loadings,
        [response(_unloaded_middle(csdm, w, eps))[here] for eps in loadings],
        'o-',
        color=RED,
        ms=3,
        label='plain R between loaded weights',
    )
    right.axhline(0.0, color=INK, lw=0.6)
    right.set(xlabel='loading', ylabel='response at the layer', title='MVDR: the sign of the echo')
    right.legend(frameon=False)
    save(figure, 'fathometer_conventions.png')


def _unloaded_middle(csdm, w, eps):
    """The same MVDR with the plain matrix between the loaded weights, its sign turned alike."""
    power = np.einsum('fmm->f', csdm).real / csdm.shape[-1]
    loaded = csdm + (eps * power)[:, None, None] * np.eye(csdm.shape[-1])
    solved = np.linalg.solve(loaded, np.stack([w, w.conj()], axis=-1))
    up, down = (
        solved[..., k] / np.einsum('fm,fm->f', v.conj(), solved[..., k])[:, None]
        for k, v in enumerate((w, w.conj()))
    )

    def form(a, b):
        return np.einsum('fm,fmn,fn->f', a.conj(), csdm, b)

    return 1j * form(down, up) / np.sqrt(form(up, up).real * form(down, down).real)


def _draw_geometry(axes) -> None:
    heights = np.linspace(0.0, 3.0, 7)
    axes.plot(np.zeros(7), heights, 'o', color=INK, ms=5)
    axes.axhline(7.0, color=BLUE, lw=2)
    axes.axhline(-5.0, color=AMBER, lw=3)
    axes.annotate('', (0.5, 3.2), (0.5, 6.8), arrowprops={'arrowstyle': '->', 'color': BLUE})
    axes.text(0.6, 5.0, 'noise going down\np = w = exp(+i k h$_m$)', color=BLUE, fontsize=8)
    axes.annotate('', (0.5, -0.3), (0.5, -4.8), arrowprops={'arrowstyle': '->', 'color': RED})
    axes.text(0.6, -3.2, 'echo: a exp(-i k (h$_m$ + 2 H))', color=RED, fontsize=8)
    axes.annotate('', (-0.5, -5.0), (-0.5, 0.0), arrowprops={'arrowstyle': '<->'})
    axes.text(-0.8, -2.6, 'H')
    axes.text(-1.9, -0.3, 'hydrophone 0,\nz$_{ref}$', fontsize=8)
    axes.text(-1.9, 2.6, 'hydrophone M-1', fontsize=8)
    axes.text(-1.9, 7.2, 'surface', color=BLUE, fontsize=8)
    axes.text(-1.9, -5.9, 'layer: z = z$_{ref}$ + c t / 2', color=AMBER, fontsize=8)
    axes.set(xlim=(-2.0, 3.4), ylim=(-6.3, 8.0), title='Depth is positive downwards')
    axes.axis('off')


def _draw_image(axes, value, extent, vmax=12.0) -> None:
    axes.imshow(value, aspect='auto', cmap='gray_r', vmin=0.0, vmax=vmax, extent=extent)


def _draw_found(axes, records, size=2.0, first=0.0) -> None:
    for k, record in enumerate(records):
        axes.scatter(
            np.full(len(record.found), first + k),
            record.found.depth,
            s=size,
            linewidths=0,
            c=[COLOURS[int(i) % len(COLOURS)] for i in record.found.track_id],
        )


def drift(seed, shown=range(300), ship_pass=()):
    """The drift of the paper as cross-spectra, processed twice and tracked: by processor, records,
    responses (depths, records) in units of the noise and depths; and the true numbers.

    shown: the records that are made; ship_pass: the first and the last while a ship passes. A
    quarter of the snapshot with four times as many says as much and is made four times as fast;
    noise is measured in the mirror window, since lags fold earlier.
    """
    config = FathometerScenario(snapshot_seconds=0.35, snapshots=256, ship_pass=ship_pass)
    rng = np.random.default_rng(seed)
    floor = drift_of(config, rng)
    settings = {
        'window': 'rectangular',
        'overlap': 0.0,
        'depth_min': config.depth_min,
        'depth_max': config.depth_max,
        'noise_depth_min': 0.0,
        'noise_depth_max': 0.0,
    }
    low = {'mvdr': 50.0, 'conventional': 200.0}
    trackers = {
        name: FathometerTracker(
            FathometerConfig(**settings, processor=name, frequency_min=low[name])
        )
        for name in low
    }
    records, columns = {name: [] for name in low}, {name: [] for name in low}
    for record in shown:
        spectra = cross_spectra(config, floor, record, floor.array_depth_stated[record], rng)
        for name, tracker in trackers.items():
            records[name] += tracker.process(spectra)
            columns[name].append(tracker.response.amplitude / tracker.response.sigma)
    depth = trackers['mvdr'].response.depth
    return {
        'number': floor.present.sum(axis=1)[shown],
        **{name: (records_of(records[name]), np.array(columns[name]).T, depth) for name in low},
    }


def draw_paper(processed) -> None:
    """As the paper's Figure 1: both processors, the tracks over them, the amplitudes, each drawn
    upwards from where its reflector lies."""
    plt.rcParams['font.size'] = 13
    figure, axes = plt.subplots(3, 2, figsize=(12, 13), sharex=True, sharey=True)
    for name, column in zip(('conventional', 'mvdr'), axes.T):
        records, value, depth = processed[name]
        extent = (-0.5, len(records) - 0.5, depth[-1], depth[0])
        for axis in column[:2]:
            _draw_image(axis, value, extent, 8.0 if name == 'conventional' else 15.0)
        _draw_found(column[1], records)
        column[1].set(ylim=(depth[-1], depth[0]))
        column[0].set(title={'mvdr': 'MVDR, 50-4000 Hz'}.get(name, 'conventional, 200-4000 Hz'))
        strongest = max(r.found.strength.max() for r in records if len(r.found))
        scale = HIGHEST / strongest
        for track_id in sorted({int(i) for r in records for i in r.found.track_id}):
            of_it = [r.found.track_id == track_id for r in records]
            shown = [k for k, mine in enumerate(of_it) if mine.any()]
            strength = [float(records[k].found.strength[of_it[k]][0]) for k in shown]
            depths = [float(records[k].found.depth[of_it[k]][0]) for k in shown]
            base = float(np.median(depths))
            gaps = np.flatnonzero(np.diff(shown) > 1) + 1
            top = base - scale * np.array(strength)
            colour = COLOURS[track_id % len(COLOURS)]
            for there, line in zip(np.split(shown, gaps), np.split(top, gaps)):
                column[2].fill_between(there, base, line, color=colour, alpha=0.25, lw=0)
                column[2].plot(there, line, lw=0.9, color=colour)
        unit = {'conventional': 1.0, 'mvdr': 2.0}[name]
        column[2].plot([6, 6], [170.0, 170.0 - unit * scale], color=INK, lw=3)
        column[2].text(11, 170.0, f'amplitude {unit:g}')
        column[2].set(xlabel='record')
    for axis in axes[:, 0]:
        axis.set_ylabel('depth [m]')
    for axis, letter in zip(axes.ravel(), 'abcdef'):
        axis.set_title(f'({letter})', loc='left')
    save(figure, 'fathometer_paper.png')
    plt.rcParams['font.size'] = 9


def draw_orders(processed) -> None:
    """As the paper's Figure 2: the PMF of the number of reflectors, and where one appears."""
    records = processed['mvdr'][0]
    pmf = np.array([record.pmf for record in records]).T
    figure, axes = plt.subplots(1, 2, figsize=(12, 3.4), width_ratios=(1.7, 1.0))
    for axis, (first, last), letter in zip(axes, ((0, len(records)), (240, 281)), 'ab'):
        axis.imshow(
            pmf[:, first:last],
            aspect='auto',
            cmap='Blues',
            origin='lower',
            vmin=0.0,
            vmax=1.0,
            extent=(first - 0.5, last - 0.5, 0.5, len(pmf) + 0.5),
        )
        shown = range(first, last)
        axis.step(shown, processed['number'][first:last], color=RED, lw=1, where='mid')
        axis.set(xlabel='record', ylim=(4.5, 11.5))
        axis.set_title(f'({letter})', loc='left')
    axes[0].set(ylabel='number of reflectors', title='probability; red: truth')
    save(figure, 'fathometer_orders.png')


def draw_ship(processed) -> None:
    """A ship that passes, as around record 180 of the paper's Figure 1, by both processors: the
    response with the tracks, and the PMF of the number of reflectors."""
    figure, axes = plt.subplots(2, 2, figsize=(12, 6.5), height_ratios=(1.6, 1.0), sharex=True)
    for name, (upper, lower) in zip(('conventional', 'mvdr'), axes.T):
        records, value, depth = processed[name]
        first, last = PASS[0] - 24 - 0.5, PASS[0] - 24 + len(records) - 0.5
        _draw_image(upper, value, (first, last, depth[-1], depth[0]), 8.0 + 7.0 * (name == 'mvdr'))
        _draw_found(upper, records, 5.0, first + 0.5)
        upper.set(title={'mvdr': 'MVDR, 50-4000 Hz'}.get(name, 'conventional, 200-4000 Hz'))
        pmf = np.array([record.pmf for record in records]).T
        shape = {'extent': (first, last, 0.5, len(pmf) + 0.5), 'origin': 'lower'}
        lower.imshow(pmf, aspect='auto', cmap='Blues', vmin=0.0, vmax=1.0, **shape)
        there = np.arange(len(records)) + first + 0.5
        lower.step(there, processed['number'], color=RED, lw=1, where='mid')
        for axis in (upper, lower):
            for edge in (PASS[0] - 0.5, PASS[1] + 0.5):
                axis.axvline(edge, color=AMBER, lw=1.5)
        lower.set(xlabel='record; amber: the ship', ylim=(0.5, 12.5))
    axes[0, 0].set(ylabel='depth [m]')
    axes[1, 0].set(ylabel='number of reflectors')
    save(figure, 'fathometer_ship.png')


def draw_fixed_orders(processed) -> None:
    """As the paper's Figure 3: what a bootstrap filter of a fixed order makes of the same."""
    _, value, depth = processed
    traces = [
        Trace(stamp_ns=(k + 1) * 10**9, depth=depth, amplitude=column, sigma=np.ones(len(depth)))
        for k, column in enumerate(value.T)
    ]
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.8), sharey=True)
    for order, axis in zip((7, 8, 9), axes):
        config = FathometerConfig(order_min=order, order_max=order)
        tracker = ChangedTracker(config, **BOOTSTRAP)
        records, value, depth = track(traces, tracker)
        _draw_image(axis, value, (-0.5, len(records) - 0.5, depth[-1], depth[0]))
        _draw_found(axis, records, 1.5)
        axis.set(xlabel='record', title=f'fixed order {order}, bootstrap')
    axes[0].set_ylabel('depth [m]')
    save(figure, 'fathometer_fixed_order.png')


def draw_lines() -> None:
    """The tracks over all four real lines."""
    figure, axes = plt.subplots(4, 1, figsize=(10, 13))
    for name, axis in zip(LINES, axes):
        with tempfile.TemporaryDirectory() as folder:
            convert_segy(
                RECORDED / name,
                Path(folder) / 'bag',
                sample_spacing=0.376,
                first_sample=12,
                samples=74,
                stack=4,
            )
            own = yaml.safe_load((Path(folder) / 'bag' / 'parameters.yaml').read_text())
            own = {**own['fathometer']['ros__parameters'], 'particles': 5000}
            config = FathometerConfig.from_mapping(own)
            with BagReader(Path(folder) / 'bag') as bag:
                traces = [item.measurement for item in measurements_of(bag, 'fathometer')]
        records, value, depth = track(traces, FathometerTracker(config))
        _draw_image(axis, value, (-0.5, len(records) - 0.5, depth[-1], depth[0]), 20.0)
        _draw_found(axis, records, 4.0)
        axis.set(ylabel='depth [m]', title=name.split('_')[3])
    axes[-1].set_xlabel('trace, four averaged to one')
    save(figure, 'fathometer_chiapas.png')


if __name__ == '__main__':
    main()
