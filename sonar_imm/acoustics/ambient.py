# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Noise of the sea surface at a vertical line array above a layered floor, exactly.

Sources at the surface radiate as dipoles: what comes down at the angle whose sine is u has the
power 2 u du, and goes past the array as exp(+i u k h). Layer l returns it with the amplitude a_l,
flat in frequency and angle, as a_l exp(-i u k (h + 2 H_l)), H_l below hydrophone 0. Every element
of the cross-spectral density is then a sum of one integral,

    I(x) = 2 int_0^1 u exp(i u x) du
    R_ij = I(k (h_i - h_j)) + sum_lm a_l a_m I(-k (h_i - h_j + 2 (H_l - H_m)))
           + 2 sum_l a_l Re I(k (h_i + h_j + 2 H_l)),

the last of which is what a fathometer measures.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..estimation.arrays import ComplexArray, FloatArray


def noise_integral(x: ArrayLike) -> ComplexArray:
    """I(x), of the shape of x."""
    values = np.asarray(x, np.float64)
    small = np.abs(values) < 1e-3
    over = 1.0 / np.where(small, 1.0, values)
    sine, cosine = np.sin(values), np.cos(values)
    # In real numbers, which takes a third of the time.
    found = np.empty(values.shape, np.complex128)
    found.real = 2.0 * over * (sine + over * (cosine - 1.0))
    found.imag = 2.0 * over * (over * sine - cosine)
    near = values[small]
    found[small] = 1.0 + 2j * near / 3.0 - np.square(near) / 4.0 - 1j * near**3 / 15.0
    return found


def surface_noise_csdm(
    frequency: ArrayLike,
    hydrophones: int,
    spacing: float,
    heights: ArrayLike,
    amplitudes: ArrayLike,
    sound_speed: float,
) -> ComplexArray:
    """R (F, M, M) at `frequency` (F,) Hz of so many `hydrophones`, `spacing` m apart, the deepest
    `heights` (K,) m above layers of `amplitudes` (K,)."""
    k = 2.0 * np.pi * np.asarray(frequency, np.float64)[:, None] / sound_speed
    H, a = np.asarray(heights, np.float64), np.asarray(amplitudes, np.float64)
    x = k * spacing * np.arange(hydrophones)
    down = noise_integral(x) + np.sum(a * a) * noise_integral(-x)
    for m in range(len(a)):
        for n in range(m):
            apart = 2.0 * k * (H[m] - H[n])
            pair = noise_integral(-(x + apart)) + noise_integral(-(x - apart))
            down += a[m] * a[n] * pair
    both = np.zeros((len(k), 2 * hydrophones - 1))
    for height, strength in zip(H, a):
        y = k * (spacing * np.arange(2 * hydrophones - 1) + 2.0 * height)
        both += 2.0 * strength * noise_integral(y).real
    i = np.arange(hydrophones)
    lag = i[:, None] - i[None, :]
    table = np.concatenate([down[:, :0:-1].conj(), down], axis=1)
    return np.asarray(
        table[:, lag + hydrophones - 1] + both[:, i[:, None] + i[None, :]], np.complex128
    )


def horizontal_noise_csdm(
    frequency: ArrayLike, hydrophones: int, spacing: float, spread: float, sound_speed: float
) -> FloatArray:
    """R (F, M, M) of unit power from near the horizontal: the sine of its angle is Gaussian with
    standard deviation `spread`."""
    k = 2.0 * np.pi * np.asarray(frequency, np.float64) / sound_speed
    apart = spacing * (np.arange(hydrophones)[:, None] - np.arange(hydrophones)[None, :])
    return np.exp(-0.5 * np.square(spread * k[:, None, None] * apart))


def sample_csdm(
    csdm: ComplexArray, snapshots: int, rng: np.random.Generator
) -> NDArray[np.complex64]:
    """The average of `snapshots` random snapshots whose expectation is `csdm` (F, M, M).

    Wishart, by Bartlett's decomposition: R = C C^H, the average is (C A)(C A)^H / L with A lower
    triangular, its diagonal the roots of gamma variables, the rest normal. For fewer snapshots
    than hydrophones the snapshots themselves are drawn.
    """
    F, M, _ = csdm.shape
    C = np.linalg.cholesky(csdm).astype(np.complex64)
    columns = min(M, snapshots)
    A = rng.standard_normal((F, M, 2 * columns), np.float32).view(np.complex64)
    A *= np.float32(np.sqrt(0.5))
    if snapshots >= M:
        A = np.tril(A, -1)
        shape = snapshots - np.arange(M, dtype=np.float32)
        A[:, np.arange(M), np.arange(M)] = np.sqrt(rng.standard_gamma(shape, (F, M)))
    X = C @ A
    return np.asarray(X @ X.conj().swapaxes(1, 2) / np.float32(snapshots))
