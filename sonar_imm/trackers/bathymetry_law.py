"""From a snapshot to the likelihood of every bin: what is heard, how loud, and from where.

The engines know nothing of arrays. They are given, for each bin, whether it is `heard` at all
(`acoustics.coherence`) and the coefficients of its likelihood over directions
(`acoustics.laplace`, or `acoustics.interference` when multipath is expected).
"""

from __future__ import annotations

import math

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from ..acoustics import array, coherence, interference, laplace, law_kernels, variances
from ..measurements import FloatArray, Snapshot
from .bathymetry_config import BathymetryConfig

ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

WATER_COLUMN = 0.8
"""Bins nearer than this share of the sonar's height hold no echo of the floor."""
FEWEST_QUIET_BINS = 16
_CHUNK = 4096


@frozen(eq=False)
class PingLaw:
    """The likelihood of each of T bins; see `law_kernels.log_likelihoods` for form (T, P), base
    (T,), spread (T, P or 0), signal (T,) and table; noise (T,) is the variance it was made for.

    heard (T,): bins that say something; constant (T,): what the kernels leave out of the log
    likelihood; geometry: see `bathymetry_kernels.sines_of`.
    """

    ranges: FloatArray
    heard: BoolArray
    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    noise: FloatArray
    constant: FloatArray
    table: FloatArray
    geometry: FloatArray


def spacing_of(snapshot: Snapshot, config: BathymetryConfig) -> float:
    """Distance between staves in wavelengths, negative for a conjugated array: what the config
    says, else the snapshot, else 0.5."""
    spacing = config.element_spacing_wavelengths or snapshot.spacing_wavelengths or 0.5
    return -spacing if config.conjugate else spacing


def ping_law(snapshot: Snapshot, config: BathymetryConfig) -> PingLaw:
    """The likelihood of every bin of a snapshot under `config`."""
    ranges = snapshot.ranges(config.sound_speed)
    spacing, tilt = spacing_of(snapshot, config), math.radians(config.tilt_deg)
    noise = _noise(snapshot, ranges, config)
    signal = _signal(snapshot, noise)
    laplacian = config.likelihood == 'laplace'
    constant = laplace.log_constant if laplacian else laplace.gaussian_log_constant
    P, T = snapshot.staves, len(snapshot)
    if config.multipath:
        step = 2.0 * math.pi * spacing
        R = interference.noise_covariance(
            array.multipath_sines(
                np.full(T, config.sonar_height), ranges, tilt, config.sonar_depth
            ),
            signal[:, None] * 10.0 ** (0.1 * config.multipath_level_db),
            noise,
            P,
            step,
        )
        parts = interference.interference_form(
            np.where(snapshot.usable[:, None], snapshot.iq, 0.0), R
        )
        form, base, spread = -signal[:, None] * parts.beam, parts.base, parts.spread
        log_determinant = parts.log_determinant
    else:
        form = laplace.form_coefficients(snapshot.iq, signal, noise)
        base, spread = np.zeros(T), np.empty((T, 0), np.complex128)
        log_determinant = P * np.log(noise) + np.log1p(P * signal / noise)
    height = math.nan if config.model_set == 'angle_two_rw' else config.sonar_height
    return PingLaw(
        ranges=np.array(ranges),
        heard=_heard(snapshot, abs(spacing), config),
        form=np.ascontiguousarray(form),
        base=np.ascontiguousarray(base),
        spread=np.ascontiguousarray(spread),
        signal=signal,
        noise=noise,
        constant=constant(P, log_determinant),
        table=law_kernels.law_table(P, config.likelihood),
        geometry=np.array([height, math.cos(tilt), math.sin(tilt), spacing]),
    )


def _heard(snapshot: Snapshot, spacing: float, config: BathymetryConfig) -> BoolArray:
    if not config.shadow_gate:
        return np.array(snapshot.usable)
    gamma = np.concatenate(
        [
            coherence.coherence(snapshot.iq[k : k + _CHUNK], spacing)[0]
            for k in range(0, len(snapshot), _CHUNK)
        ]
    )
    silent = coherence.silent_bins(
        gamma, snapshot.staves, spacing=spacing, false_alarm=config.gate_false_alarm
    )
    return snapshot.usable & ~silent


def _noise(snapshot: Snapshot, ranges: FloatArray, config: BathymetryConfig) -> FloatArray:
    """Noise variance (T,) at a stave: from the snapshot, the config, the water column, or from
    what is not coherent."""
    known = snapshot.noise_variance
    if known is not None and np.isfinite(known).all():
        return np.array(known)
    level = config.noise_variance
    if not level > 0.0:
        quiet = (ranges < WATER_COLUMN * config.sonar_height) & snapshot.usable
        if quiet.sum() >= FEWEST_QUIET_BINS:
            level = variances.noise_variance(snapshot.iq, quiet)
        else:
            level = variances.blind_noise_variance(snapshot.iq)
    if not level > 0.0:
        # Too few bins to tell noise from echo: suppose the 20 dB of a usual swath.
        level = 0.01 * float(np.mean(variances.mean_power(snapshot.iq[snapshot.usable])))
    noise = np.full(len(snapshot), level)
    return noise if known is None else np.where(np.isfinite(known), known, noise)


def _signal(snapshot: Snapshot, noise: FloatArray) -> FloatArray:
    """Signal variance (T,) at a stave: from the snapshot, else a moving mean of the power."""
    known = snapshot.signal_variance
    if known is not None and np.isfinite(known).all():
        return np.array(known)
    power = np.where(snapshot.usable, variances.mean_power(snapshot.iq), 0.0)
    signal = variances.signal_variance(power, noise, usable=snapshot.usable)
    signal = np.fmax(signal, variances.LEAST_SNR * noise)
    return signal if known is None else np.where(np.isfinite(known), known, signal)
