# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import math

import numpy as np
import pytest

from sonar_imm.acoustics import array, spatial
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

TILT, HEIGHT = math.radians(30.0), 15.0
GRID = np.linspace(-0.9, 0.9, 361)


@pytest.fixture(scope='module')
def pings():
    scene = simulate(scenario('paper', {'pings': 24}), 11)
    return [(entry.measurement, true) for entry, true in zip(scene.measurements, scene.truth)]


def plane_waves(u, staves=8, spacing=0.5, noise=0.01, conjugate=False, seed=0):
    rng = np.random.default_rng(seed)
    phase = np.exp(2j * np.pi * rng.uniform(size=(len(u), 1)))
    y = phase * array.steering(u, staves, spacing, conjugate=conjugate)
    return y + noise * (rng.normal(size=y.shape) + 1j * rng.normal(size=y.shape))


@pytest.mark.parametrize('conjugate', [False, True])
@pytest.mark.parametrize('method', sorted(spatial.SPECTRA))
def test_a_lone_wave_is_found(method, conjugate):
    for u in (-0.71, 0.003, 0.42):
        iq = plane_waves(np.full(30, u), conjugate=conjugate)
        spectrum = spatial.ping_spectrum(iq, GRID, 0.5, method=method, conjugate=conjugate)
        assert spectrum.shape == (30, len(GRID))
        assert np.abs(spatial.peak_sines(spectrum, GRID) - u).max() < 2e-3


def test_two_waves_closer_than_a_beam_are_told_apart():
    rng = np.random.default_rng(1)
    waves = [array.steering(u, 8, 0.5) for u in (0.1, 0.25)]
    s = rng.normal(size=(200, 2)) + 1j * rng.normal(size=(200, 2))
    iq = s @ np.array(waves) + 0.05 * (rng.normal(size=(200, 8)) + 1j * rng.normal(size=(200, 8)))
    covariance = spatial.sample_covariance(iq, 200)[:1]
    vectors = array.steering(GRID, 8, 0.5)
    for spectrum, peaks in (
        (spatial.music_spectrum(covariance, vectors, sources=2)[0], 2),
        (spatial.capon_spectrum(covariance, vectors)[0], 2),
        (spatial.bartlett_spectrum(covariance, vectors)[0], 1),
    ):
        top = (spectrum[1:-1] > spectrum[:-2]) & (spectrum[1:-1] > spectrum[2:])
        found = GRID[1:-1][top & (spectrum[1:-1] > 0.3 * spectrum.max())]
        assert len(found) == peaks
        if peaks == 2:
            assert found == pytest.approx([0.1, 0.25], abs=0.01)


def test_spectra_are_what_their_definitions_say():
    iq = plane_waves(np.linspace(-0.5, 0.5, 12), staves=5, noise=0.5)
    covariance = spatial.sample_covariance(iq, 4)
    assert np.allclose(covariance[0], sum(np.outer(y, y.conj()) for y in iq[:5]) / 5)
    a = array.steering(0.3, 5, 0.5)
    R = covariance[6]
    loaded = R + spatial.LOADING * np.trace(R).real / 5 * np.eye(5)
    noise = np.linalg.eigh(R)[1][:, :-1]
    expected = {
        'bartlett': (a.conj() @ R @ a).real / (5 * np.trace(R).real),
        'capon': 1.0 / (a.conj() @ np.linalg.solve(loaded, a)).real,
        'music': 1.0 / np.linalg.norm(noise.conj().T @ a) ** 2,
    }
    for name, value in expected.items():
        assert spatial.SPECTRA[name](covariance, a[None])[6, 0] == pytest.approx(value)
    with pytest.raises(ValueError, match='not 5'):
        spatial.music_spectrum(covariance, a[None], sources=5)


def test_phase_difference_of_any_pair():
    u = np.linspace(-0.4, 0.4, 25)
    for pair, spacing, conjugate in (((0, 1), 0.5, False), ((3, 5), 0.3, True)):
        iq = plane_waves(u, spacing=spacing, noise=1e-6, conjugate=conjugate)
        sines = spatial.phase_difference_sines(
            iq, spacing, pair=pair, half_width=0, conjugate=conjugate
        )
        assert np.allclose(sines, u, atol=1e-4)


def test_spoilt_bins_are_left_out():
    iq = plane_waves(np.full(40, 0.2))
    iq[10:15, 2], iq[30] = np.nan, 0.0
    sines = spatial.phase_difference_sines(iq, 0.5, half_width=3)
    assert np.isfinite(sines).all() and np.abs(sines - 0.2).max() < 0.02
    for method in spatial.SPECTRA:
        spectrum = spatial.ping_spectrum(iq, GRID, 0.5, method=method, half_width=3)
        assert np.abs(spatial.peak_sines(spectrum, GRID) - 0.2).max() < 0.01
    iq[:] = np.nan
    assert np.isnan(spatial.phase_difference_sines(iq, 0.5)).all()
    assert spatial.ping_spectrum(iq, GRID, 0.5, method='capon').shape == (40, 361)


# What is attainable on the scene of the paper: RMSE of the height on smooth floor, in the patch,
# and over all, in metres, and of the angle in degrees. From an independent prototype.
ATTAINABLE = {
    'phase': (1.71, 0.98, 1.61, 1.51),
    'capon': (0.258, 0.529, 0.320, 0.37),
    'music': (0.186, 0.527, 0.274, 0.34),
}


@pytest.mark.parametrize('method', sorted(ATTAINABLE))
def test_errors_are_what_is_attainable(pings, method):
    squares = []
    for ping, true in pings:
        if method == 'phase':
            sine = spatial.phase_difference_sines(ping.iq, 0.5)
        else:
            sine = spatial.peak_sines(
                spatial.ping_spectrum(ping.iq, GRID, 0.5, method=method), GRID
            )
        angle = np.arcsin(np.clip(sine, -1.0, 1.0))
        height = HEIGHT - array.depth_of_angle(angle, ping.range, TILT)
        error = np.square(height - true.height)
        turn = np.square(np.degrees(angle - true.angle))
        squares.append(
            [error[~true.patch].mean(), error[true.patch].mean(), error.mean(), turn.mean()]
        )
    rms = np.sqrt(np.mean(squares, axis=0))
    assert rms == pytest.approx(ATTAINABLE[method], rel=0.06)
