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

"""From a snapshot to the likelihood of every bin: what is heard, how loud, and from where.

The engines know nothing of arrays. They are given, for each bin, whether it is `heard` at all
(`acoustics.coherence`) and the coefficients of its likelihood over directions
(`acoustics.laplace`, or `acoustics.interference` when multipath is expected).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...acoustics import coherence, interference, laplace, likelihood_kernels, loudness, variances
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray
from ...measurements import Snapshot
from .config import BathymetryConfig
from .kernels import Geometry, PingLikelihood
from .swath import Swath

WATER_COLUMN = 0.8
"""Bins nearer than this share of the sonar's height, or of the first return, hold no echo of the
floor."""
FEWEST_QUIET_BINS = 16
LEAST_NOISE = 1e-12
"""Noise is taken to be at least this share of surface echoes, whose covariance has no inverse
without."""


def spacing_of(
    snapshot: Snapshot, config: BathymetryConfig, at_array: float | None = None
) -> float:
    """Distance between staves in wavelengths, negative for a conjugated array: what the config
    says, else the snapshot, else 0.5. `at_array`: the sound speed there in m/s, where a profile
    says it, which makes the wavelength whatever speed the ranges were made with."""
    stated = snapshot.spacing_wavelengths
    if stated is not None and at_array is not None:
        stated *= (snapshot.sound_speed or at_array) / at_array
    spacing = config.element_spacing_wavelengths or stated or 0.5
    return -spacing if config.conjugate else spacing


class Heard(NamedTuple):
    """The likelihood of a ping, and which bins (T,) stand 20 dB above the noise, or, where that is
    not known, above the quietest tenth of the bins."""

    likelihood: PingLikelihood
    loud: BoolArray


def ping_likelihood(
    snapshot: Snapshot, config: BathymetryConfig, swath: Swath, floor_below: float
) -> Heard:
    """The likelihood of every bin of a snapshot under `config`. floor_below: how far below the
    array the floor is said to be, m."""
    ranges, spacing = swath.ranges, swath.geometry.spacing
    iq = np.where(snapshot.usable[:, None], snapshot.iq, 0.0)
    first = 0
    if config.sonar_height_std > 0.0:
        first = _first_return(snapshot, iq, abs(spacing), config)
        floor_below = float(ranges[first])
    noise, known = _noise(snapshot, ranges, config, floor_below)
    make = _beside_surface if config.multipath else _in_white_noise
    parts = make(snapshot, iq, swath, floor_below, noise, config)
    P = snapshot.staves
    laplacian = config.likelihood == 'laplace'
    constant = laplace.log_constant if laplacian else laplace.gaussian_log_constant
    heard = _heard(snapshot.usable, parts, known, P, abs(spacing), config)
    heard[:first] = False
    likelihood = PingLikelihood(
        ranges=ranges,
        heard=heard,
        form=np.ascontiguousarray(parts.form),
        base=np.ascontiguousarray(parts.base),
        spread=np.ascontiguousarray(parts.spread),
        signal=np.ascontiguousarray(parts.signal),
        noise=np.ascontiguousarray(parts.noise),
        constant=np.ascontiguousarray(constant(P, parts.log_determinant)),
        table=likelihood_kernels.likelihood_table(P, config.likelihood),
        geometry=_drifting(swath.geometry, heard, config),
    )
    quiet = 1.0 if known.all() else float(np.quantile(parts.loudness, 0.1))
    return Heard(likelihood, parts.loudness > loudness.VERY_LOUD * quiet)


def _first_return(
    snapshot: Snapshot, iq: ComplexArray, spacing: float, config: BathymetryConfig
) -> int:
    """The first bin with an echo of the floor. Few staves need a stated noise to tell it from one
    bin."""
    P, false_alarm = snapshot.staves, config.gate_false_alarm
    noise = stated_noise(snapshot, config)
    if P < coherence.FEWEST_STAVES_ALONE and np.isfinite(noise).all():
        ratio = variances.mean_power(iq) / noise
        return coherence.first_of(_loud(ratio, P, false_alarm, snapshot.usable))
    gamma = coherence.coherence(iq, spacing)[0]
    return coherence.first_return(gamma, P, spacing=spacing, false_alarm=false_alarm)


def _drifting(geometry: Geometry, heard: BoolArray, config: BathymetryConfig) -> Geometry:
    """With `angle_drift` angles go on at constant height after the first bin with an echo, for
    which the start is stated."""
    if geometry.of_heights or not config.drift_used or not heard.any():
        return geometry
    return geometry._replace(drift_from=int(np.argmax(heard)) + 1)


class _Parts(NamedTuple):
    """What the likelihood is made of, see `PingLikelihood`; noise (T,) with what of the echo is
    not the same at all staves; loudness (T,): power of a bin in powers of all that is no floor."""

    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    noise: FloatArray
    log_determinant: FloatArray
    coherence: FloatArray
    loudness: FloatArray


def _in_white_noise(
    snapshot: Snapshot,
    iq: ComplexArray,
    swath: Swath,
    floor_below: float,
    noise: FloatArray,
    config: BathymetryConfig,
) -> _Parts:
    T, P = iq.shape
    spacing = swath.geometry.spacing
    above_noise = variances.mean_power(iq) / noise
    signal, noise = _split(_signal(snapshot, noise, np.ones(T)), noise, config)
    return _Parts(
        form=laplace.form_coefficients(iq, signal, noise),
        base=np.zeros(T),
        spread=np.empty((T, 0), np.complex128),
        signal=signal,
        noise=noise,
        log_determinant=P * np.log(noise) + np.log1p(P * signal / noise),
        coherence=coherence.coherence(iq, abs(spacing))[0] if config.gate_used else np.ones(T),
        loudness=above_noise,
    )


def _beside_surface(
    snapshot: Snapshot,
    iq: ComplexArray,
    swath: Swath,
    floor_below: float,
    noise: FloatArray,
    config: BathymetryConfig,
) -> _Parts:
    """With echoes by way of the surface as noise from where a flat floor would send them."""
    T, P = iq.shape
    level = 10.0 ** (0.1 * config.multipath_level_db)
    spacing = swath.geometry.spacing
    sines = swath.surface_sines(floor_below, config.sonar_depth)
    signal = _signal(snapshot, noise, 1.0 + level * np.isfinite(sines).sum(axis=1))
    signal, noise = _split(signal, noise, config)
    noise = np.maximum(noise, LEAST_NOISE * level * signal)
    step = 2.0 * math.pi * spacing
    R = interference.noise_covariance(sines, level * signal[:, None], noise, P, step)
    form = interference.interference_form(iq, R)
    return _Parts(
        form=-signal[:, None] * form.beam,
        base=form.base,
        spread=form.spread,
        signal=signal,
        noise=noise,
        log_determinant=form.log_determinant,
        coherence=interference.coherence_beside(form, abs(spacing)),
        loudness=form.base / P,
    )


def _heard(
    usable: BoolArray,
    parts: _Parts,
    known: BoolArray,
    staves: int,
    spacing: float,
    config: BathymetryConfig,
) -> BoolArray:
    """Bins (T,) with an echo. Many staves tell it by coherence, and by power where a whole stretch
    cannot be noise; few staves by power alone, where the noise is `known` (T,), since noise is
    coherent at two of them too often."""
    if not config.gate_used:
        return np.array(usable)
    false_alarm = config.gate_false_alarm
    silent = coherence.silent_bins(
        parts.coherence, staves, spacing=spacing, false_alarm=false_alarm
    )
    if staves < coherence.FEWEST_STAVES_ALONE:
        return np.where(
            known, _loud(parts.loudness, staves, false_alarm, usable), usable & ~silent
        )
    return usable & ~(silent & ~loudness.diffuse_bins(parts.loudness, silent, usable & known))


def _loud(ratio: FloatArray, staves: int, false_alarm: float, usable: BoolArray) -> BoolArray:
    bins = coherence.GATE_BINS
    level = loudness.loud_level(staves, bins, false_alarm)
    return loudness.loud_bins(ratio, level, bins=bins, usable=usable)


def _split(
    signal: FloatArray, noise: FloatArray, config: BathymetryConfig
) -> tuple[FloatArray, FloatArray]:
    """Signal and noise (T,) when a share of the echo is not the same at all staves, and so acts as
    noise."""
    share = config.decorrelation
    return (signal * (1.0 - share), noise + share * signal) if share > 0.0 else (signal, noise)


def _noise(
    snapshot: Snapshot, ranges: FloatArray, config: BathymetryConfig, floor_below: float
) -> tuple[FloatArray, BoolArray]:
    """Noise variance (T,) at a stave, and where it is known (T,): from the snapshot, the config or
    the water column; else it is taken blindly from what is not coherent."""
    stated = stated_noise(snapshot, config)
    missing = np.isnan(stated)
    if not missing.any():
        return stated, ~missing
    quiet = (ranges < WATER_COLUMN * floor_below) & snapshot.usable
    measured = bool(quiet.sum() >= FEWEST_QUIET_BINS)
    if measured:
        level = variances.noise_variance(snapshot.iq, quiet)
    else:
        level = variances.blind_noise_variance(snapshot.iq)
    if not level > 0.0:
        # Too few bins to tell noise from echo: suppose the 20 dB of a usual swath.
        level = 0.01 * float(np.mean(variances.mean_power(snapshot.iq[snapshot.usable])))
        measured = False
    return np.where(missing, level, stated), ~missing | measured


def stated_noise(snapshot: Snapshot, config: BathymetryConfig) -> FloatArray:
    """Noise variance (T,) that the snapshot or the config states; NaN where neither does."""
    level = config.noise_variance if config.noise_variance > 0.0 else math.nan
    given = snapshot.noise_variance
    if given is None:
        return np.full(len(snapshot), level)
    return np.where(np.isfinite(given), given, level)


def _signal(snapshot: Snapshot, noise: FloatArray, echoes: FloatArray) -> FloatArray:
    """Signal variance (T,) at a stave: from the snapshot, else a moving mean of the power, of
    which the floor has one part in `echoes` (T,)."""
    given = snapshot.signal_variance
    if given is not None and np.isfinite(given).all():
        return np.array(given)
    power = np.where(snapshot.usable, variances.mean_power(snapshot.iq), 0.0)
    signal = variances.signal_variance(power, noise, usable=snapshot.usable) / echoes
    signal = np.fmax(signal, variances.LEAST_SNR * noise)
    return signal if given is None else np.where(np.isfinite(given), given, signal)
