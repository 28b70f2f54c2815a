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

"""What the staves of an array hear of a floor.

One bin is y = sqrt(z) (s a(u) + n), the observation model of `acoustics.laplace`, or with noise
that does not fade y = sqrt(z) s a(u) + n. Surface echoes fade with a z of their own. A spike is a
strong burst of noise, incoherent across the array. `config` is a `simulator.BathymetryScenario`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sonar_imm.acoustics import array, rays
from sonar_imm.estimation.arrays import ComplexArray, FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.truth import TrueProfile

from .objects import Facets


def snr(config: Any, ranges: FloatArray) -> FloatArray:
    """Signal-to-noise ratio (n,) at one stave, linear."""
    nearest = max(config.first_range, min(config.sonar_height, 0.5 * config.last_range))
    share = np.log(np.maximum(ranges, nearest) / nearest) / math.log(config.last_range / nearest)
    decibels = config.snr_near_db + share * (config.snr_far_db - config.snr_near_db)
    return 10.0 ** (0.1 * decibels)


def hear(
    config: Any, floor: TrueProfile, rng: np.random.Generator, facets: Facets | None = None
) -> Snapshot:
    """The samples of the staves for one ping over a floor, or from its facets."""
    bins = len(floor.range)
    sine = np.nan_to_num(np.sin(floor.angle))
    signal = config.noise_variance * snr(config, floor.range) * floor.valid
    if facets is None:
        y = np.sqrt(signal)[:, None] * _echo(config, sine, rng)
    else:
        y = _of_facets(config, bins, facets, rng)
    noise = math.sqrt(config.noise_variance) * _circular(rng, bins, config.staves)
    fading = np.sqrt(_fading(config, bins, rng))[:, None]
    if facets is not None:
        y = y + noise * fading if config.noise_fades else y + noise
    else:
        y = (y + noise) * fading if config.noise_fades else y * fading + noise
    if config.multipath:
        level = np.sqrt(signal * 10.0 ** (0.1 * config.multipath_level_db))
        depth = config.sonar_height - floor.height
        tilt = math.radians(config.tilt_deg)
        others = array.multipath_sines(depth, floor.range, tilt, config.sonar_depth)
        for other in others.T:
            strength = level * np.sqrt(_fading(config, bins, rng)) * np.isfinite(other)
            y += strength[:, None] * _echo(config, np.nan_to_num(other), rng)
    spikes = rng.uniform(size=bins) < config.spike_probability
    if spikes.any():
        power = (signal + config.noise_variance) * 10.0 ** (0.1 * config.spike_db) * spikes
        y += np.sqrt(power)[:, None] * _circular(rng, bins, config.staves)
    return Snapshot(
        stamp_ns=floor.stamp_ns,
        frame_id='sonar',
        range=floor.range,
        iq=y.astype(np.complex64),
        noise_variance=np.full(bins, config.noise_variance) if config.state_noise else None,
        signal_variance=signal if config.state_signal else None,
        sound_speed=config.sound_speed,
        frequency=config.frequency,
        element_spacing=config.spacing_wavelengths * _speed_at_array(config) / config.frequency,
        sample_rate=0.5 * config.sound_speed / config.bin_width,
    )


def _of_facets(config: Any, bins: int, facets: Facets, rng: np.random.Generator) -> ComplexArray:
    """The echoes (T, P) of facets, each surface of a bin with a texture of its own."""
    texture = np.stack([_fading(config, bins, rng) for _ in range(4)])
    power = config.noise_variance * facets.power * texture[facets.surface, facets.bin]
    echo = np.sqrt(power)[:, None] * _echo(config, np.nan_to_num(facets.sine), rng)
    parts = [np.bincount(facets.bin, stave, bins) for stave in echo.view(np.float64).T]
    return np.column_stack(parts).view(np.complex128)


def _speed_at_array(config: Any) -> float:
    """Sound speed that makes the wavelength at the array, m/s."""
    if not config.sound_speed_profile:
        return config.sound_speed
    return float(rays.profile_of(config.sound_speed_profile).at(config.sonar_depth))


def _echo(config: Any, sine: FloatArray, rng: np.random.Generator) -> ComplexArray:
    """Plane waves (n, P) of unit power from direction sines (n,), less what differs from stave to
    stave."""
    vectors = array.steering(
        sine, config.staves, config.spacing_wavelengths, conjugate=config.conjugate
    )
    share = config.decorrelation
    wave = vectors * _circular(rng, len(sine), 1)
    if not share > 0.0:
        return wave
    own = _circular(rng, len(sine), config.staves)
    return math.sqrt(1.0 - share) * wave + math.sqrt(share) * own


def _fading(config: Any, bins: int, rng: np.random.Generator) -> FloatArray:
    """The power z (n,) of echoes, one on average."""
    if config.law == 'k':
        return rng.gamma(config.texture_shape, 1.0 / config.texture_shape, size=bins)
    return rng.exponential(size=bins) if config.law == 'laplace' else np.ones(bins)


def _circular(rng: np.random.Generator, *shape: int) -> ComplexArray:
    """Circular complex Gaussian numbers of unit variance."""
    return rng.normal(size=(*shape, 2)).view(np.complex128)[..., 0] * math.sqrt(0.5)
