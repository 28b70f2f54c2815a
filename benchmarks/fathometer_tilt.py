# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a tilt of the array costs: peak and depth of one echo, without noise of averaging.

    python -m benchmarks.fathometer_tilt --out docs/results/fathometer_tilt.json

The arrays of ``fathometer_pulse`` above one layer of amplitude 0.35, in surface noise from all
azimuths, ships from the horizontal and noise of the hydrophones. An array that leans by an angle
has its hydrophones h cos(angle) high and h sin(angle) aside, which puts the Bessel function
J0(k distance cos(elevation)) into every integral over the elevation; they are done by
Gauss-Legendre quadrature, and without tilt compared with the closed form. The processor believes
the array to be upright and as long as it is. Printed: the peak against that of the upright array,
and how much too deep it lies.
"""

from __future__ import annotations

import numpy as np
from scipy.special import j0

from benchmarks.fathometer_pulse import ARRAYS
from benchmarks.study import Parts, study
from sonar_imm.acoustics.fathometer import coherence, depth_response, steering
from sonar_imm_tools.simulation.fathometer.field import expected_csdm
from sonar_imm_tools.simulation.fathometer.scenario import Drift, FathometerScenario

AMPLITUDE = 0.35
TILTS = (0.0, 2.0, 5.0, 10.0)
STEP, NEAR = 1.0 / 256.0, 0.5
_SHIP_SPREAD = 0.03
"""As `expected_csdm` has it."""


def tilted_csdm(
    config: FathometerScenario, height: float, frequency: np.ndarray, tilt: float
) -> np.ndarray:
    """R (F, M, M) of an array that leans by `tilt` rad, `height` m above the layer."""
    M, spacing = config.phones, config.element_spacing
    longest = 2.0 * np.pi * frequency[-1] / config.sound_speed
    longest *= 2.0 * (height + spacing * M)
    node, weight = np.polynomial.legendre.leggauss(int(longest) + 100)
    u, weight = 0.5 * (node + 1.0), 0.5 * weight
    lag, i = np.arange(M), np.arange(M)
    total, apart = i[:, None] + i, i[:, None] - i
    R = np.empty((len(frequency), M, M), np.complex128)
    for row, k in enumerate(2.0 * np.pi * frequency / config.sound_speed):
        up, aside = k * spacing * np.cos(tilt), k * spacing * np.sin(tilt)
        J = j0(aside * lag[:, None] * np.sqrt(1.0 - u * u))
        down = (np.exp(1j * up * lag[:, None] * u) * J) @ (2.0 * u * weight)
        # What the layer sends back comes from below.
        down = down + AMPLITUDE**2 * down.conj()
        turn = np.exp(1j * u * (up * np.arange(2 * M - 1)[:, None] + 2.0 * k * height))
        echo = 2.0 * AMPLITUDE * ((turn * (2.0 * u * weight)) @ J.T).real
        R[row] = np.where(apart >= 0, down[abs(apart)], down[abs(apart)].conj())
        R[row] += echo[total, abs(apart)]
        ships = np.exp(-0.5 * np.square(_SHIP_SPREAD * up * lag)) * j0(aside * lag)
        level = config.ship_noise / (1.0 + (frequency[row] / 200.0) ** 2)
        R[row] += level * ships[abs(apart)] + config.phone_noise * np.eye(M)
    return R


def echo_of(
    config: FathometerScenario, R: np.ndarray, frequency: np.ndarray, processor: str, height: float
) -> tuple[float, float]:
    """Peak of the response near the layer, and how much deeper than the layer it lies, m."""
    heights = config.element_spacing * np.arange(config.phones)
    gamma = coherence(R, steering(frequency, heights, config.sound_speed), processor)
    count = int(2.0 * NEAR / STEP) + 1
    lattice = (height - NEAR, STEP, count)
    first, spacing = float(frequency[0]), float(frequency[1] - frequency[0])
    b = depth_response(gamma, first, spacing, lattice, 0.0, config.sound_speed)
    top = int(np.argmax(b))
    return float(b[top]), float(STEP * top - NEAR)


def main() -> Parts:
    for name, (config, height) in ARRAYS.items():
        # Every fourth frequency of a snapshot: the echo comes back within a quarter of it.
        rows = np.arange(config.frequency_min, config.frequency_max + 1.0, 10.0)
        layer = np.array([[height]])
        floor = Drift(layer, np.full((1, 1), AMPLITUDE), layer > 0.0, np.zeros(1), np.zeros(1))
        red = ((rows / 1000.0) ** (0.0 if config.whitened else -1.6))[:, None, None]
        exact = expected_csdm(config, floor, 0, rows) / red
        upright = tilted_csdm(config, height, rows, 0.0)
        if np.abs(upright - exact).max() > 1e-9 * np.abs(exact).max():
            raise SystemExit('the quadrature is not the closed form')
        for processor in ('conventional', 'mvdr'):
            whole = echo_of(config, upright, rows, processor, height)
            for tilt in TILTS[1:]:
                R = tilted_csdm(config, height, rows, np.radians(tilt))
                peak, deeper = echo_of(config, R, rows, processor, height)
                row = {'peak against upright': peak / whole[0], 'too deep, m': deeper - whole[1]}
                yield {'table': {f'{name}, {processor}, {tilt:g} deg': row}}


if __name__ == '__main__':
    study(main)
