# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Directions without a tracker, the baseline for tracking.

Each estimator takes the snapshots iq (n, P) of one ping and gives one direction sine per bin, from
the bin and its `half_width` neighbours to either side, which share one sample covariance
R = mean y y^H:

* `phase_difference_sines`: the mean phase step of one pair of staves. Two staves, no array gain.
* `capon_spectrum` (minimum variance, J. Capon 1969): 1 / (a^H R^-1 a).
* `music_spectrum` (R. O. Schmidt 1986): 1 / (a^H E E^H a), E spanning all but the strongest
  eigenvectors of R.
* `bartlett_spectrum`, the conventional beamformer: a^H R a / (P tr R).

Over a rough floor the directions differ within the window, so all of them smooth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..estimation.arrays import ComplexArray, FloatArray
from .array import phase_step, steering
from .coherence import refined_peak
from .variances import moving_mean, usable_bins

HALF_WIDTH = 5
LOADING = 7e-4
"""Share of the mean power added to the diagonal before a sample covariance is inverted: 32 dB
below the echo. Without it 11 bins of 8 staves fail now and then; more of it (1e-2) lowers the
error on a flat floor by a quarter, and gives up the resolution that the method is for."""


def sample_covariance(iq: NDArray, half_width: int = HALF_WIDTH) -> ComplexArray:
    """Covariances (n, P, P) of the usable bins around each bin; NaN where there is none."""
    usable = usable_bins(iq)
    y = np.where(usable[:, None], iq, 0.0).astype(np.complex128)
    covariance: ComplexArray = moving_mean(
        y[:, :, None] * y[:, None, :].conj(), half_width, usable
    )
    return covariance


def bartlett_spectrum(covariance: ComplexArray, vectors: ComplexArray) -> FloatArray:
    """Share (n, m) of the power that beams towards `vectors` (m, P), from `array.steering`,
    get."""
    power = _forms(covariance, vectors)
    total = np.trace(covariance, axis1=1, axis2=2).real
    return power / (vectors.shape[1] * np.where(total > 0.0, total, 1.0))[:, None]


def capon_spectrum(covariance: ComplexArray, vectors: ComplexArray) -> FloatArray:
    """Minimum-variance power (n, m) in the directions of `vectors` (m, P)."""
    staves = vectors.shape[1]
    level = np.trace(covariance, axis1=1, axis2=2).real / staves
    loading = np.where(level > 0.0, LOADING * level, 1.0)[:, None, None]
    loaded: ComplexArray = np.nan_to_num(covariance) + loading * np.eye(staves)
    inverse = np.linalg.inv(loaded)
    return 1.0 / np.maximum(_forms(inverse, vectors), 1e-300)


def music_spectrum(
    covariance: ComplexArray, vectors: ComplexArray, sources: int = 1
) -> FloatArray:
    """MUSIC pseudo-spectrum (n, m) for so many `sources`, at least 1 and fewer than the staves."""
    staves = vectors.shape[1]
    if not 0 < sources < staves:
        raise ValueError(f'{staves} staves tell 1 to {staves - 1} sources apart, not {sources}')
    strongest = np.linalg.eigh(np.nan_to_num(covariance))[1][:, :, -sources:]
    captured = np.square(np.abs(strongest.conj().swapaxes(1, 2) @ vectors.T)).sum(axis=1)
    return 1.0 / np.maximum(staves - captured, 1e-12)


def peak_sines(spectrum: FloatArray, grid: FloatArray) -> FloatArray:
    """Direction sine (n,) of the highest point of each spectrum (n, m), between grid points by a
    parabola through the reciprocal, which is smooth where the spectrum is sharp."""
    return refined_peak(-1.0 / np.maximum(spectrum, 1e-300), grid)[1]


def phase_difference_sines(
    iq: NDArray,
    spacing: float,
    *,
    pair: tuple[int, int] = (0, 1),
    half_width: int = HALF_WIDTH,
    conjugate: bool = False,
) -> FloatArray:
    """Direction sine (n,) from the phase between two staves, averaged over the window.

    NaN where no bin is usable. Beyond `array.largest_sine` of the pair's spacing it is ambiguous:
    the alias nearest to broadside is given; abs(u) > 1 is possible with noise for close staves.
    """
    usable = usable_bins(iq)
    first, second = pair
    product = np.where(usable, iq[:, second] * iq[:, first].conj(), 0.0).astype(np.complex128)
    step = phase_step(spacing, conjugate=conjugate) * (second - first)
    return np.angle(moving_mean(product, half_width, usable)) / step


def ping_spectrum(
    iq: NDArray,
    grid: ArrayLike,
    spacing: float,
    *,
    method: str = 'capon',
    half_width: int = HALF_WIDTH,
    conjugate: bool = False,
) -> FloatArray:
    """Spectrum (n, m) of a whole ping over direction sines `grid` (m,); `method` is bartlett,
    capon or music."""
    vectors = steering(grid, iq.shape[1], spacing, conjugate=conjugate)
    return SPECTRA[method](sample_covariance(iq, half_width), vectors)


def _forms(matrices: NDArray, vectors: ComplexArray) -> FloatArray:
    """a^H M a (n, m) for Hermitian matrices (n, P, P) and vectors (m, P)."""
    return np.einsum('mp,nmp->nm', vectors.conj(), vectors @ np.swapaxes(matrices, 1, 2)).real


SPECTRA = {
    'bartlett': bartlett_spectrum,
    'capon': capon_spectrum,
    'music': music_spectrum,
}
