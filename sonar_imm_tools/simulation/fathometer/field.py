# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The sound field at the array: its cross-spectra, and pressure drawn from them.

Pressure is drawn from the cross-spectral model over a whole record: at each frequency of the
record's own transform C n, with R = C C^H and n standard complex normal, and all of it transformed
back. Every angle, the exact delays and what is lost of long lags come by themselves; plane waves
summed up at some angles put echoes too shallow, make them weaker and leave peaks beside them.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sonar_imm.acoustics.ambient import horizontal_noise_csdm, surface_noise_csdm
from sonar_imm.estimation.arrays import ComplexArray, FloatArray

from .scenario import Drift, FathometerScenario

_AT_ONCE = 2048
"""Frequencies whose matrices are in memory together."""


def expected_csdm(
    config: FathometerScenario, drift: Drift, record: int, frequency: FloatArray
) -> ComplexArray:
    """R (F, M, M) of a record at `frequency` (F,) Hz."""
    there = drift.amplitude[record] != 0.0
    array = config.phones, config.element_spacing
    R = surface_noise_csdm(
        frequency,
        *array,
        drift.depth[record, there] - drift.array_depth[record],
        drift.amplitude[record, there],
        config.sound_speed,
    )
    passing = config.ship_pass and config.ship_pass[0] <= record <= config.ship_pass[1]
    ships = (100.0 if passing else 1.0) * config.ship_noise / (1.0 + (frequency / 200.0) ** 2)
    R += ships[:, None, None] * horizontal_noise_csdm(frequency, *array, 0.03, config.sound_speed)
    R += config.phone_noise * np.eye(config.phones)
    if not config.whitened:
        # Surface noise is red: it falls by 5 dB per octave.
        R *= ((frequency / 1000.0) ** -1.6)[:, None, None]
    return R


def pressure_field(
    config: FathometerScenario, drift: Drift, record: int, rng: Generator
) -> NDArray[np.float32]:
    """Pressure (n, M) of one record; a two-sided spectrum of R."""
    length = round(config.record_seconds * config.sample_rate)
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / config.sample_rate), np.float64)
    low, high = 0.5 * config.frequency_min, 1.2 * config.frequency_max
    inside = np.flatnonzero((frequency >= low) & (frequency <= high))
    spectra = np.zeros((len(frequency), config.phones), np.complex64)
    for rows in np.split(inside, range(_AT_ONCE, len(inside), _AT_ONCE)):
        root = np.linalg.cholesky(expected_csdm(config, drift, record, frequency[rows]))
        noise = rng.standard_normal((len(rows), config.phones, 2)) @ np.array([1.0, 1j])
        spectra[rows] = np.sqrt(0.5) * (root @ noise[..., None])[..., 0]
    pressure = np.fft.irfft(spectra, length, axis=0) * np.sqrt(length)
    return pressure.astype(np.float32)
