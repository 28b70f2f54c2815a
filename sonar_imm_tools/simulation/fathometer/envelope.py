# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Envelopes as a sub-bottom profiler records them, over a floor that scatters in its volume.

The pressure behind an envelope is complex. Each layer answers with the pulse, in a phase that is
drawn anew for each ping, because the layers are rough. Below the first layer everything scatters:
a complex Gaussian field, seen through the same pulse, whose rms value falls as ``exp(-depth below
/ scatter_decay)``. Where both overlap they interfere, so that an echo comes and goes with the
speckle around it. The magnitude is averaged over `stack` pings, and what lies below three standard
deviations of the receiver's noise is written as zero, as instruments do.
"""

from __future__ import annotations

import numpy as np

from sonar_imm.acoustics.pulse import gaussian_pulse
from sonar_imm.estimation.arrays import FloatArray

from .scenario import Drift, FathometerScenario

_THRESHOLD = 3.0


def envelope(
    config: FathometerScenario,
    drift: Drift,
    record: int,
    depth: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """The stacked envelope (n,) of one record at `depth` (n,) m, evenly spaced."""
    pulse = gaussian_pulse(config.pulse_width)
    n, step = len(depth), config.depth_step
    there = drift.amplitude[record] > 0.0
    place, strength = drift.depth[record, there], drift.amplitude[record, there]
    echo = pulse(depth[:, None] - place) * strength
    below = depth - place.min() if len(place) else np.full(n, -1.0)
    level = config.scatter * np.exp(-np.maximum(below, 0.0) / config.scatter_decay)
    level = np.where(below >= 0.0, level, 0.0)
    reach = int(5.0 * config.pulse_width / step)
    kernel = pulse(step * np.arange(-reach, reach + 1))
    kernel /= np.sqrt(np.sum(np.square(kernel)))
    total = np.zeros(n)
    for _ in range(config.stack):
        phase = np.exp(2j * np.pi * rng.uniform(size=len(place)))
        field = echo @ phase
        field = field + np.convolve(level * _complex_noise(n, rng), kernel, 'same')
        wide = _complex_noise(n + 2 * reach, rng)
        field = field + config.noise_sigma * np.convolve(wide, kernel, 'valid')
        total += np.abs(field)
    return np.asarray(np.maximum(total / config.stack - _THRESHOLD * config.noise_sigma, 0.0))


def _complex_noise(count: int, rng: np.random.Generator) -> FloatArray:
    """Of unit power, (count,) complex."""
    return rng.standard_normal((count, 2)) @ np.array([1.0, 1j]) * np.sqrt(0.5)
