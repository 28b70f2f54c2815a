"""From a snapshot to the likelihood of every bin: what is heard, how loud, and from where.

The engines know nothing of arrays. They are given, for each bin, whether it is `heard` at all
(`acoustics.coherence`) and the coefficients of its likelihood over directions
(`acoustics.laplace`, or `acoustics.interference` when multipath is expected).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...acoustics import coherence, interference, laplace, likelihood_kernels, variances
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray
from ...measurements import Snapshot
from .config import BathymetryConfig
from .kernels import Geometry, PingLikelihood
from .swath import Swath

WATER_COLUMN = 0.8
"""Bins nearer than this share of the sonar's height, or of the first return, hold no echo of the
floor."""
FEWEST_QUIET_BINS = 16


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


def ping_likelihood(
    snapshot: Snapshot, config: BathymetryConfig, swath: Swath, floor_below: float
) -> PingLikelihood:
    """The likelihood of every bin of a snapshot under `config`. floor_below: how far below the
    array the floor is said to be, m."""
    ranges, spacing = swath.ranges, swath.geometry.spacing
    iq = np.where(snapshot.usable[:, None], snapshot.iq, 0.0)
    first = 0
    if config.sonar_height_std > 0.0:
        gamma = coherence.coherence(iq, abs(spacing))[0]
        first = coherence.first_return(
            gamma, snapshot.staves, spacing=abs(spacing), false_alarm=config.gate_false_alarm
        )
        floor_below = float(ranges[first])
    noise = _noise(snapshot, ranges, config, floor_below)
    make = _beside_surface if config.multipath else _in_white_noise
    parts = make(snapshot, iq, swath, floor_below, noise, config)
    P = snapshot.staves
    laplacian = config.likelihood == 'laplace'
    constant = laplace.log_constant if laplacian else laplace.gaussian_log_constant
    heard = _heard(snapshot.usable, parts.coherence, P, abs(spacing), config)
    heard[:first] = False
    return PingLikelihood(
        ranges=ranges,
        heard=heard,
        form=np.ascontiguousarray(parts.form),
        base=np.ascontiguousarray(parts.base),
        spread=np.ascontiguousarray(parts.spread),
        signal=np.ascontiguousarray(parts.signal),
        noise=np.ascontiguousarray(noise),
        constant=np.ascontiguousarray(constant(P, parts.log_determinant)),
        table=likelihood_kernels.likelihood_table(P, config.likelihood),
        geometry=_drifting(swath.geometry, heard, config),
    )


def _drifting(geometry: Geometry, heard: BoolArray, config: BathymetryConfig) -> Geometry:
    """With `angle_drift` angles go on at constant height after the first bin with an echo, for
    which the start is stated."""
    if geometry.of_heights or not config.angle_drift or not heard.any():
        return geometry
    return geometry._replace(drift_from=int(np.argmax(heard)) + 1)


class _Parts(NamedTuple):
    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    log_determinant: FloatArray
    coherence: FloatArray


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
    signal = _signal(snapshot, noise, np.ones(T))
    return _Parts(
        form=laplace.form_coefficients(iq, signal, noise),
        base=np.zeros(T),
        spread=np.empty((T, 0), np.complex128),
        signal=signal,
        log_determinant=P * np.log(noise) + np.log1p(P * signal / noise),
        coherence=coherence.coherence(iq, abs(spacing))[0] if config.shadow_gate else np.ones(T),
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
    step = 2.0 * math.pi * spacing
    R = interference.noise_covariance(sines, level * signal[:, None], noise, P, step)
    form = interference.interference_form(iq, R)
    return _Parts(
        form=-signal[:, None] * form.beam,
        base=form.base,
        spread=form.spread,
        signal=signal,
        log_determinant=form.log_determinant,
        coherence=interference.coherence_beside(form, abs(spacing)),
    )


def _heard(
    usable: BoolArray, gamma: FloatArray, staves: int, spacing: float, config: BathymetryConfig
) -> BoolArray:
    if not config.shadow_gate:
        return np.array(usable)
    false_alarm = config.gate_false_alarm
    silent = coherence.silent_bins(gamma, staves, spacing=spacing, false_alarm=false_alarm)
    return usable & ~silent


def _noise(
    snapshot: Snapshot, ranges: FloatArray, config: BathymetryConfig, floor_below: float
) -> FloatArray:
    """Noise variance (T,) at a stave: from the snapshot, the config, the water column, or from
    what is not coherent."""
    given = snapshot.noise_variance
    if given is not None and np.isfinite(given).all():
        return np.array(given)
    level = config.noise_variance
    if not level > 0.0:
        quiet = (ranges < WATER_COLUMN * floor_below) & snapshot.usable
        if quiet.sum() >= FEWEST_QUIET_BINS:
            level = variances.noise_variance(snapshot.iq, quiet)
        else:
            level = variances.blind_noise_variance(snapshot.iq)
    if not level > 0.0:
        # Too few bins to tell noise from echo: suppose the 20 dB of a usual swath.
        level = 0.01 * float(np.mean(variances.mean_power(snapshot.iq[snapshot.usable])))
    noise = np.full(len(snapshot), level)
    return noise if given is None else np.where(np.isfinite(given), given, noise)


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
