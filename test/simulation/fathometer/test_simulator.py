# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scenes of the fathometer: what they promise, and that they are the same each time."""

from attrs import evolve
from helpers.scenes import smaller_scene
import numpy as np
import pytest
from scipy.signal import csd

from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.simulation.fathometer import simulator
from sonar_imm_tools.simulation.fathometer.scenario import Drift, drift_of
from sonar_imm_tools.simulation.fathometer.simulator import scenario, SCENARIOS, simulate


@pytest.mark.parametrize('name', SCENARIOS)
def test_every_scenario_can_be_made_small(name):
    config, scene = smaller_scene(SYSTEMS['fathometer'], name, 1)
    assert len(scene.truth) == config.records <= 2
    assert scene.truth[-1].stamp_ns == scene.measurements[-1].measurement.stamp_ns
    kinds = {type(item.measurement) for item in scene.measurements}
    assert kinds <= {CrossSpectra, Trace, Pressure, ArrayDepth}


def made(name='drift', seed=0, **changes):
    return simulate(scenario(name, changes), seed)


def drifted(seed, name='drift', **changes):
    return drift_of(scenario(name, changes), np.random.default_rng(seed))


def test_layers_fade_and_appear_as_told():
    drift = drifted(0, appearing=(10, 50), fading=(30,), records=100)
    assert drift.present.sum(axis=1)[[0, 20, 45, 99]].tolist() == [8, 9, 8, 9]
    assert drift.present[:, 0].all() and (drift.amplitude[:, 0] > 0.2).all()
    left = drifted(0, appearing=(), fading=(30, 40, 50), records=100).present[99]
    assert np.flatnonzero(~left).tolist() == [3, 5, 7]  # no neighbours


def test_traces_hold_the_pulse_of_each_layer_and_noise_as_stated():
    still = {'layers': 1, 'appearing': (), 'fading': (), 'array_depth_std': 0.0}
    scene, noise = made('drift_traces', records=50, **still), []
    wave = band_pulse(50.0, 4000.0, 1500.0)
    for received, truth in zip(scene.measurements, scene.truth):
        trace = received.measurement
        pulse = wave(trace.depth - truth.depth[0])
        amplitude = trace.amplitude @ pulse / (pulse @ pulse)
        noise.append(trace.amplitude - amplitude * pulse)
        assert amplitude > 0.01
    assert np.std(noise) == pytest.approx(1.3e-3, rel=0.05)
    # The noise is as correlated as the pulse.
    noise = np.array(noise)
    seen = np.mean(noise[:, 3:] * noise[:, :-3]) / np.var(noise)
    assert seen == pytest.approx(wave(3.0 / 32.0), abs=0.05)


def test_scenes_that_cannot_be():
    for overrides, word in (
        ({'frequency_min': 5000.0}, 'frequency_max'),
        ({'ship_pass': (3,)}, 'ship_pass'),
        ({'level': 'pressure'}, '600 s'),
        ({'level': 'pressure', 'frequency_max': 6001.0, 'sample_rate': 12000.0}, 'half the'),
        ({'layers': 1}, 'no layer'),
        ({'level': 'csdm'}, '13.6 GB'),
        ({'records': 0}, 'records'),
    ):
        with pytest.raises(ConfigError, match=word):
            scenario('drift', overrides)


def test_pressure_in_whole_numbers_has_the_steps_it_was_told():
    short = {'records': 1, 'record_seconds': 1.0, 'block_seconds': 0.3}
    coarse, fine = (
        [item.measurement for item in made('pressure', 1, **short, steps_per_sigma=n).measurements]
        for n in (2.5, 0.0)
    )
    a, b = (np.concatenate([item.pressure for item in each]) for each in (coarse, fine))
    (scale,) = {item.scale for item in coarse}
    assert [len(item) for item in coarse] == [1800, 1800, 1800, 600]
    assert scale == pytest.approx(b.std() / 2.5, rel=1e-3)
    assert np.abs(a - b).max() <= 0.5001 * scale
    assert np.abs(a / scale - np.round(a / scale)).max() < 1e-4
    assert {item.scale for item in fine} == {0.0}
    # The tracker is left to choose its snapshots.
    given = scenario('pressure').instruments()
    assert 'snapshot_seconds' not in given
    assert (given['depth_min'], given['depth_max']) == (42.0, 74.0)
    assert scenario('small').instruments()['window'] == 'rectangular'


def test_whitened_spectra_are_even():
    changes, ratio = {'records': 1, 'snapshots': 400, 'ship_noise': 0.0}, []
    for white in (False, True):
        spectra = made('small', 1, **changes, whitened=white).measurements[-1].measurement
        power = np.einsum('fmm->f', spectra.csdm).real
        ratio.append(power[10] / power[-10])
    assert ratio[0] > 20.0 and 0.5 < ratio[1] < 2.0


# -- cross-spectra of a layered floor, summed up from plane waves in place of closed forms --------


ODD = {
    'level': 'csdm', 'records': 1, 'phones': 5, 'element_spacing': 0.31, 'sound_speed': 1480.0,
    'snapshot_seconds': 0.05, 'frequency_min': 150.0, 'frequency_max': 900.0, 'phone_noise': 0.02,
    'ship_noise': 1.7,
}  # fmt: skip
LAYERS = np.array([9.0, 12.5]), np.array([0.4, 0.2])
"""Heights of the lowest hydrophone above the layers, m, and their amplitudes."""


def floor(heights, amplitudes, array_depth=60.0):
    item = np.array([array_depth])
    return Drift(array_depth + heights[None], amplitudes[None], amplitudes[None] > 0.0, item, item)


def expected(frequency, config, heights, amplitudes, ships=True):
    """R (F, M, M): plane waves of power 2 u du that come down at the angle of sine u and go up
    again from each layer, by Gauss-Legendre; then ships from near the horizon, noise of the
    hydrophones and the colour of all."""
    nodes, weights = np.polynomial.legendre.leggauss(400)
    u, power = 0.5 * (nodes + 1.0), 0.5 * weights * (nodes + 1.0)
    up = config.element_spacing * np.arange(config.phones)
    R = []
    for f in frequency:
        k = 2.0 * np.pi * f / config.sound_speed
        wave = np.exp(1j * k * np.outer(u, up))
        for height, amplitude in zip(heights, amplitudes):
            wave = wave + amplitude * np.exp(-1j * k * np.outer(u, up + 2.0 * height))
        total = np.einsum('u,ui,uj->ij', power, wave, wave.conj())
        total = total + config.phone_noise * np.eye(config.phones)
        if ships:
            slant = np.linspace(-0.2, 0.2, 2001)
            density = np.exp(-0.5 * (slant / 0.03) ** 2)
            wave = np.exp(1j * k * np.outer(slant, up))
            share = config.ship_noise / (1.0 + (f / 200.0) ** 2) * density / density.sum()
            total = total + np.einsum('u,ui,uj->ij', share, wave, wave.conj())
        R.append(total * (f / 1000.0) ** -1.6)
    return np.array(R)


def drawn(snapshots, seed=1, **overrides):
    config = scenario('drift', {**ODD, 'snapshots': snapshots, **overrides})
    spectra = simulator.cross_spectra(config, floor(*LAYERS), 0, None, np.random.default_rng(seed))
    return config, spectra


def relative(csdm, R):
    """Deviation of each element in units of the root of the product of its hydrophones' powers."""
    power = np.sqrt(np.einsum('fii->fi', R).real)
    return (csdm - R) / power[:, :, None] / power[:, None, :]


def test_the_expectation_is_the_sum_of_plane_waves_and_a_ship_that_passes_is_louder():
    config, spectra = drawn(100_000)
    assert spectra.frequency == pytest.approx(np.arange(160.0, 901.0, 20.0))
    R = expected(spectra.frequency, config, *LAYERS)
    # Each element has a standard deviation of 1 / sqrt(100,000) = 0.0032.
    assert np.abs(relative(spectra.csdm, R)).max() < 5.0 * 0.0032
    without = expected(spectra.frequency, config, LAYERS[0] + 1.0, LAYERS[1])
    assert np.abs(relative(spectra.csdm, without)).max() > 10.0 * 0.0032
    _, loud = drawn(100_000, ship_pass=(0, 3))  # a hundred times
    R = expected(spectra.frequency, config, *LAYERS, ships=False)
    ratio = np.mean(np.abs(loud.csdm - R)) / np.mean(np.abs(spectra.csdm - R))
    assert ratio == pytest.approx(100.0, rel=0.03)


@pytest.mark.parametrize('snapshots', [3, 5, 64])
def test_a_draw_scatters_as_an_average_of_that_many_snapshots(snapshots):
    """E |R_ij - E R_ij|^2 = R_ii R_jj / L for circular Gaussian snapshots."""
    squares, R = [], None
    for seed in range(30):
        config, spectra = drawn(snapshots, seed)
        if R is None:
            R = expected(spectra.frequency, config, *LAYERS)
        squares.append(np.abs(relative(spectra.csdm, R)) ** 2)
        assert spectra.snapshots == snapshots
        assert np.abs(spectra.csdm - spectra.csdm.conj().swapaxes(1, 2)).max() < 1e-4
        if snapshots < config.phones:
            values = np.linalg.eigvalsh(spectra.csdm)
            assert np.abs(values[:, : config.phones - snapshots] / values[:, -1:]).max() < 1e-5
    assert np.mean(squares) * snapshots == pytest.approx(1.0, abs=0.1)


def test_pressure_has_the_spectra_of_the_plane_waves():
    """Estimated by scipy from the time series, from dozens of waves."""
    values = {
        'phones': 4, 'element_spacing': 0.5, 'sample_rate': 4000.0, 'frequency_max': 1000.0,
        'records': 1, 'record_seconds': 9.8, 'whitened': False, 'array_depth_std': 0.0,
        'phone_noise': 0.01, 'first_depth': 45.0, 'layers': 1, 'ship_noise': 0.0,
    }  # fmt: skip
    config = scenario('pressure', values)
    scene = simulate(config, 3)
    p = np.concatenate([item.measurement.pressure for item in scene.measurements])
    assert p.shape == (round(9.8 * 4000.0), 4)
    height = scene.truth[0].depth - scene.measurements[0].measurement.reference_depth
    frequency = np.arange(100.0, 1000.0, 20.0)
    R = expected(frequency, config, height, scene.truth[0].amplitude, ships=False)
    # scipy conjugates the first of the two.
    pairs, how = (p.T[None, :], p.T[:, None]), {'nperseg': 800, 'noverlap': 400, 'detrend': False}
    f, found = csd(*pairs, fs=4000.0, **how)
    found = np.moveaxis(found, -1, 0)[np.searchsorted(f, frequency)]
    # Level: a two-sided spectrum of unit variance has the one-sided density 2 / fs.
    off = relative(found * 4000.0 / 2.0, R)
    # About 70 independent segments: 0.12 in each element.
    assert np.sqrt(np.mean(np.abs(off) ** 2)) < 0.2 and np.abs(off.mean(axis=0)).max() < 0.1


# -- drift ----------------------------------------------------------------------------------------


def test_the_array_heaves_and_its_depth_is_told_with_an_error():
    drift = drifted(1, records=720, heave=4.0, heave_records=90.0, array_depth_std=0.2)
    assert drift.array_depth.mean() == pytest.approx(73.5, abs=1e-6)
    assert np.ptp(drift.array_depth) == pytest.approx(8.0, abs=0.02)
    np.testing.assert_allclose(drift.array_depth[90:], drift.array_depth[:-90], atol=1e-9)
    error = drift.array_depth_stated - drift.array_depth
    assert error.std() == pytest.approx(0.2, rel=0.1) and abs(error.mean()) < 0.03


def test_layers_wander_together_and_alone_as_told():
    alone, together = (
        np.diff(drifted(2, records=4000, appearing=(), depth_walk=d, tilt_walk=t).depth, axis=0)
        for d, t in ((0.03, 0.0), (0.0, 0.05))
    )
    assert alone.std() == pytest.approx(0.03, rel=0.03)
    assert np.abs(np.corrcoef(alone.T) - np.eye(8)).max() < 0.08
    assert together.std() == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(together, together[:, :1] @ np.ones((1, 8)), atol=1e-12)


def test_the_truth_names_what_is_there():
    scene = made('drift_traces', 1, records=40, appearing=(20,), fading=(5,))
    first, middle, last = (scene.truth[k] for k in (0, 15, 39))
    assert first.track_id.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    assert len(middle.track_id) == 7 and set(middle.track_id) < set(first.track_id)
    assert last.track_id[-1] == 9 and len(last.track_id) == 8
    stamps = [item.stamp_ns for item in scene.truth]
    assert stamps == [item.measurement.stamp_ns for item in scene.measurements]
    np.testing.assert_allclose(np.diff(stamps), 89.6e9, atol=1.0)


def test_a_profiler_hears_its_own_noise_alone_where_there_is_no_floor():
    config, drift = scenario('diffuse', {'records': 1}), drifted(0, 'diffuse', records=1)
    bare = evolve(drift, amplitude=np.zeros_like(drift.amplitude))
    heard, silent = (
        simulator._envelope(config, each, 0, np.random.default_rng(1))[0] for each in (drift, bare)
    )
    assert silent.max() < 0.2 * heard.max() and len(silent) == len(heard)
