# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The passive fathometer: a depth response from the noise at a vertical line array.

Noise made at the sea surface travels down past the array, is reflected by the layers of the floor
and comes up again. Looking up and looking down with the array and correlating the two gives an
echo at the two-way time of each layer.

Conventions
    Fourier transform exp(-i w t). Hydrophone 0 is the deepest, hydrophone m stands h_m above it;
    steering vector w_m = exp(+i k h_m), k = w / c: noise going down is p = w, the echo of a layer
    H below hydrophone 0 is a exp(-i k (h_m + 2 H)), a phase that is exp(-i 2 k H) times conj(w).
    The echo then lies at the time +2 H / c, so that depth is z = z_ref + c t / 2, where z_ref is
    the depth of hydrophone 0. Down is positive.

Processors, R (F, M, M) the cross-spectral density, w_+ = w, w_- = conj(w)
    conventional  C = w^T R w                   P_+- = w_+-^H R w_+-
    MVDR          C = (w_-^H R_l^-1 w_+) / [(w_-^H R_l^-1 w_-) (w_+^H R_l^-1 w_+)]
                                                P_+- = 1 / (w_+-^H R_l^-1 w_+-)
                  with R_l = R + loading tr(R)/M I in *every* place: with a plain R between loaded
                  weights the echo changes its sign as the loading grows.
    white noise   the MVDR whose loading is, frequency by frequency, the least that keeps the gain
                  against white noise of both beams above a limit.

Coherence (`coherence`), |gamma| <= 1
    gamma = -i C / sqrt(P_+ P_-), with the sign turned for MVDR, whose echo is inverted (Harrison
    2009). Dividing by the beam powers makes red noise white; the quarter turn is there because
    correlated noise gives the time integral of the impulse response.

Depth response
    b(z) = Re mean_n gamma_n exp(i w_n 2 (z - z_ref) / c), noise of standard deviation
    1 / sqrt(2 L F) for L snapshots and F frequencies (conventional).

Printed equations that do not hold: the MVDR output w^H R w with the weights as printed is the
conjugate of the conventional one (echoes at negative times).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..estimation.arrays import FloatArray
from .ambient import noise_integral

ComplexArray = NDArray[np.complexfloating]

PROCESSORS = ('conventional', 'mvdr', 'white_noise')
OUTPUTS = ('coherence', 'correlation', 'printed')

MAD_OF_UNIT_NORMAL = 0.6744897501960817
"""Median absolute deviation of a normal number of standard deviation one."""
_LOADINGS = (1e-6, 1e2)
_RUNNING = 31


def steering(frequency: ArrayLike, heights: ArrayLike, sound_speed: float) -> ComplexArray:
    """w (F, M) at `frequency` (F,) Hz for hydrophones `heights` (M,) m above the deepest."""
    k = 2.0 * np.pi * np.asarray(frequency, np.float64) / sound_speed
    return np.exp(1j * k[:, None] * np.asarray(heights, np.float64))


def conventional(csdm: ComplexArray, w: ComplexArray) -> tuple[ComplexArray, FloatArray]:
    """C = w^T R w (F,) and sqrt(P_+ P_-) (F,)."""
    up, down = _form(w, csdm, w), _form(w.conj(), csdm, w.conj())
    with np.errstate(invalid='ignore'):
        return _form(w.conj(), csdm, w), np.sqrt(up.real * down.real)


def mvdr(
    csdm: ComplexArray, w: ComplexArray, loading: float | FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """C (F,) and sqrt(P_+ P_-) (F,) with `loading` in units of the mean power of a hydrophone, one
    number or one per frequency. Raises numpy.linalg.LinAlgError when a loaded matrix is singular.
    """
    M = csdm.shape[-1]
    power = np.einsum('fmm->f', csdm).real / M
    ridge = np.asarray(loading * power)[:, None, None].astype(csdm.dtype)
    loaded = csdm + ridge * np.eye(M, dtype=csdm.dtype)
    w = w.astype(csdm.dtype)
    solved = np.linalg.solve(loaded, np.stack([w, w.conj()], axis=-1))
    cross = np.einsum('fm,fm->f', w, solved[..., 0])  # w_-^H is the plain transpose of w
    up = np.einsum('fm,fm->f', w.conj(), solved[..., 0]).real
    down = np.einsum('fm,fm->f', w, solved[..., 1]).real
    with np.errstate(invalid='ignore', divide='ignore', over='ignore'):
        return cross / (up * down), 1.0 / np.sqrt(up * down)


def white_noise_loading(csdm: ComplexArray, w: ComplexArray, gain_db: float) -> FloatArray:
    """The least loading (F,), in units of the mean power of a hydrophone, with which the gain
    against white noise 1 / |weights|^2 of both beams is within `gain_db` (negative) of its
    greatest value M.

    The gain grows with the loading, which is bisected on a logarithmic scale from 1e-6 to 1e2, to
    one per cent.
    """
    M = csdm.shape[-1]
    power = np.einsum('fmm->f', csdm).real / M
    eye = np.eye(M, dtype=csdm.dtype)
    beams = np.stack([w, w.conj()], axis=-1).astype(csdm.dtype)
    low, high = (np.full(len(csdm), bound) for bound in np.log(_LOADINGS))
    for _ in range(11):
        middle = 0.5 * (low + high)
        loaded = csdm + (np.exp(middle) * power)[:, None, None].astype(csdm.dtype) * eye
        solved = np.linalg.solve(loaded, beams)
        passed = np.abs(np.sum(beams.conj() * solved, axis=1)) ** 2
        gain = passed / np.sum(np.abs(solved) ** 2, axis=1)
        enough = (gain >= M * 10.0 ** (0.1 * gain_db)).all(axis=1)
        high, low = np.where(enough, middle, high), np.where(enough, low, middle)
    return np.exp(high)


def coherence(
    csdm: ComplexArray,
    w: ComplexArray,
    processor: str,
    *,
    loading: float = 1e-2,
    gain_db: float = -3.0,
) -> ComplexArray:
    """gamma (F,): normalised, quarter turned, echoes positive; NaN where a beam has no power.

    Raises numpy.linalg.LinAlgError for MVDR when a loaded matrix is singular."""
    return coherence_and_power(csdm, w, processor, loading=loading, gain_db=gain_db)[0]


def coherence_and_power(
    csdm: ComplexArray,
    w: ComplexArray,
    processor: str,
    *,
    loading: float = 1e-2,
    gain_db: float = -3.0,
) -> tuple[ComplexArray, FloatArray]:
    """See `coherence`; and sqrt(P_+ P_-) (F,), by which the correlation was divided."""
    if processor == 'conventional':
        C, power = conventional(csdm, w)
        turn = -1j
    elif processor in ('mvdr', 'white_noise'):
        white = processor == 'white_noise'
        C, power = mvdr(csdm, w, white_noise_loading(csdm, w, gain_db) if white else loading)
        turn = 1j
    else:
        raise ValueError(f'a processor is one of {PROCESSORS}, not {processor!r}')
    with np.errstate(invalid='ignore', divide='ignore'):
        gamma = turn * C / power
    return np.where(np.isfinite(gamma), gamma, np.nan), power


def printed_correlation(
    csdm: ComplexArray, w: ComplexArray, processor: str, *, loading: float = 1e-2
) -> ComplexArray:
    """C (F,) as the paper prints it: equation (2), w^T R w, or for mvdr equation (4), w_+^H R w_-
    with the weights of equation (3), in which R is loaded, and R itself between them. Its echoes
    lie at negative times."""
    if processor == 'conventional':
        return conventional(csdm, w)[0]
    M = csdm.shape[-1]
    power = np.einsum('fmm->f', csdm).real / M
    loaded = csdm + (loading * power)[:, None, None].astype(csdm.dtype) * np.eye(
        M, dtype=csdm.dtype
    )
    beams = np.stack([w, w.conj()], axis=-1).astype(csdm.dtype)
    weights = np.linalg.solve(loaded, beams)
    weights = weights / np.einsum('fmk,fmk->fk', beams.conj(), weights)[:, None, :]
    return _form(weights[..., 0], csdm, weights[..., 1])


def echo_spectrum(csdm: ComplexArray, frequency: ArrayLike, power: FloatArray) -> FloatArray:
    """W (F,), mean one: how much of an echo MVDR lets through at each frequency, so that the pulse
    of a reflector is ``sum W cos(4 pi f delta / c) / sum W``.

    W = tr R / (M f sqrt(P_+ P_-)), P the MVDR powers of the two beams, `power` their root, as a
    running mean over 31 rows: where MVDR is sharper than a plain sum, at low frequencies, the echo
    is stronger. `frequency` (F,) Hz. The response itself stays unweighted: weights make it ring.
    """
    M = csdm.shape[-1]
    f = np.asarray(frequency, np.float64)
    f = np.maximum(f, np.min(f, where=f > 0.0, initial=np.inf))
    W = np.einsum('fmm->f', csdm).real.astype(np.float64) / (M * f * power)
    smooth = _running_mean(W)
    return np.asarray(smooth / smooth.mean())


def surface_share(
    csdm: ComplexArray, frequency: ArrayLike, heights: NDArray[np.floating], sound_speed: float
) -> FloatArray:
    """How much of the power of a hydrophone comes from the surface (F,), as a running mean over 31
    rows: of that alone there are echoes. W of `echo_spectrum` takes all power for it, and below
    200 Hz most may be of ships, which is heard from the horizontal.

    What is as loud from above as from below, and what the hydrophones do not share, leaves the
    cross-spectra real; noise from the surface alone has the imaginary part of `noise_integral`
    between two heights (M,). Its level is the least-squares fit to the imaginary parts.
    """
    k = 2.0 * np.pi * np.asarray(frequency, np.float64)[:, None] / sound_speed
    upper, lower = np.tril_indices(len(heights), -1)
    apart, group = np.unique(np.round(heights[upper] - heights[lower], 6), return_inverse=True)
    g = noise_integral(k * apart).imag
    found = np.stack(
        [
            csdm[:, upper[group == n], lower[group == n]].imag.sum(axis=1)
            for n in range(len(apart))
        ],
        axis=1,
    )
    level = (found * g).sum(axis=1) / (np.square(g) @ np.bincount(group))
    power = np.einsum('fmm->f', csdm).real.astype(np.float64) / len(heights)
    return np.maximum(_running_mean(level / power), 1e-3)


def sampled_share(csdm: ComplexArray, loading: float, snapshots: float) -> FloatArray:
    """What MVDR powers of so many snapshots are about, of those of the exact cross-spectra
    (F,): ``1 - (d - 1) / snapshots``, d = sum l / (l + loading tr R / M) over the eigenvalues l of
    R, how many directions are fitted. From every 16th row."""
    rows = np.arange(0, len(csdm), 16)
    values = np.linalg.eigvalsh(csdm[rows]).clip(min=0.0)
    ridge = loading * values.mean(axis=1, keepdims=True)
    with np.errstate(invalid='ignore', divide='ignore'):
        fitted = np.nan_to_num(values / (values + ridge)).sum(axis=1)
    share = np.interp(np.arange(len(csdm)), rows, 1.0 - (fitted - 1.0) / snapshots)
    return np.maximum(share, 1.0 / snapshots)


def echo_phase(
    csdm: ComplexArray,
    frequency: ArrayLike,
    heights: NDArray[np.floating],
    below: ArrayLike,
    sound_speed: float,
    loading: float,
) -> FloatArray:
    """Phase (K, F), rad, of what MVDR makes of the echo of a layer, against exp(-i 2 k H): of
    layers ``H = below`` (K,), m below hydrophone 0, by the cross-spectra of this record.

    Noise comes down under all angles, and what comes nearly from above the array cannot tell from
    the vertical: its echo has the phase u 2 k H, u the sine of its angle, which is less than that
    from above. So there is a tail above the layer, the more so the nearer the layer and the wider
    the beam (.16 rad at 100 Hz, 22 m below 4 m of hydrophones). Cross-spectra of the echo are
    those of `noise_integral` between the array and its image; R_l^-1 of this record says what
    MVDR leaves of them. From every 16th row."""
    f = np.asarray(frequency, np.float64)
    rows = np.arange(0, len(f), 16)
    k, R = 2.0 * np.pi * f[rows] / sound_speed, csdm[rows].astype(np.complex128)
    w, M = steering(f[rows], heights, sound_speed), len(heights)
    ridge = loading * np.einsum('fmm->f', R).real / M
    solved = np.linalg.solve(
        R + ridge[:, None, None] * np.eye(M), np.stack([w.conj(), w], axis=-1)
    )
    # Pairs whose image is equally far count together.
    apart, group = np.unique(np.round(heights[:, None] + heights, 6), return_inverse=True)
    pairs = solved[:, :, None, 0].conj() * solved[:, None, :, 1]
    pairs = pairs.reshape(len(rows), -1) @ np.eye(len(apart))[group.ravel()]
    found = []
    for H in np.asarray(below, np.float64):
        image = noise_integral(-k[:, None] * (apart + 2.0 * H))
        echo = -1j * (pairs * image).sum(axis=1) * np.exp(2j * k * H)
        found.append(np.interp(np.arange(len(f)), rows, np.unwrap(np.angle(echo))))
    return np.array(found)


def _running_mean(values: FloatArray) -> FloatArray:
    half = min(_RUNNING // 2, len(values) - 1)
    padded = np.pad(values, half, 'reflect')
    return np.convolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), 'valid')


def depth_response(
    gamma: ComplexArray,
    first: float,
    spacing: float,
    depths: tuple[float, float, int],
    reference_depth: float,
    sound_speed: float,
    *,
    envelope: bool = False,
) -> FloatArray:
    """b (n,) at n depths from `depths` = (first depth, step, n).

    gamma (F,) at the frequencies ``first + spacing * row``; NaN rows are left out of the mean.
    envelope: the modulus instead of the real part, which is what a Hilbert transform would show.
    Raises ValueError when no row is left.
    """
    use = np.isfinite(gamma)
    if not use.any():
        raise ValueError('the coherence has no finite value')
    z0, step, n = depths
    t0, dt = 2.0 * (z0 - reference_depth) / sound_speed, 2.0 * step / sound_speed
    rows = np.arange(len(gamma))
    turned = np.where(use, gamma, 0.0) * np.exp(2j * np.pi * (first + spacing * rows) * t0)
    total = chirp_z(turned, spacing * dt, n) * np.exp(2j * np.pi * first * dt * np.arange(n))
    mean = total / np.count_nonzero(use)
    return np.abs(mean) if envelope else np.ascontiguousarray(mean.real)


def chirp_z(values: ComplexArray, turns: float, count: int) -> ComplexArray:
    """sum_n values_n exp(2 pi i turns n k) for k = 0 .. count - 1 (Bluestein): n k is written as
    (n^2 + k^2 - (k - n)^2) / 2, which makes it a convolution."""
    N = len(values)
    size = 1 << (N + count - 2).bit_length()
    i = np.arange(max(N, count))
    chirp = np.exp(1j * np.pi * np.mod(turns * i * i, 2.0))
    filter_ = np.zeros(size, np.complex128)
    filter_[:count] = chirp[:count].conj()
    filter_[size - N + 1 :] = chirp[1:N][::-1].conj()
    spectrum = np.fft.fft(values * chirp[:N], size) * np.fft.fft(filter_)
    return np.asarray(np.fft.ifft(spectrum)[:count] * chirp[:count])


def sediment_thickness(
    two_way_time: ArrayLike, sound_speed: float, gradient: float = 0.0
) -> FloatArray:
    """Metres of sediment between its top and what answers `two_way_time` s later.

    sound_speed: c0 at the top, m/s; gradient: g of c0 + g z with the depth z below the top, 1/s.
    On the way down dt = dz / (c0 + g z), so z = (c0 / g) (exp(g t / 2) - 1), c0 t / 2 without
    gradient.
    """
    way = 0.5 * np.asarray(two_way_time, np.float64)
    if not gradient:
        return np.asarray(sound_speed * way)
    return np.asarray(sound_speed / gradient * np.expm1(gradient * way))


def noise_sigma(b: FloatArray) -> float:
    """Standard deviation of the noise of b, by the median absolute deviation: a few reflectors do
    not spoil it. NaN without samples."""
    finite = b[np.isfinite(b)]
    if not len(finite):
        return float('nan')
    return float(np.median(np.abs(finite - np.median(finite)))) / MAD_OF_UNIT_NORMAL


def _form(left: ComplexArray, R: ComplexArray, right: ComplexArray) -> ComplexArray:
    """left^H R right (F,)."""
    product = np.matmul(R, right[..., None].astype(R.dtype))[..., 0]
    return np.einsum('fm,fm->f', left.conj().astype(R.dtype), product)
