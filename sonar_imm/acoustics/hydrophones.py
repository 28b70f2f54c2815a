# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Hydrophones that differ: gains, turned wires and delays, found in the cross-spectra themselves.

Noise of the sea surface is the same around every hydrophone of a vertical array, so that its
cross-spectra depend on the distance of two hydrophones alone. Of those that were measured,

    R_mn = c_m conj(c_n) T_{m-n} + noise of each hydrophone

with T Toeplitz and otherwise free (echoes are some 5 % of it) and the responses c to be found:

    gain    power of a hydrophone over that of the median one, as a running median over frequency;
    sign    of the leading eigenvector of Re R at frequencies where T is positive whatever the
            noise, below a quarter of a wave between two hydrophones; the majority is right;
    delay   that aligns R_mn with T, the median or mean along each diagonal, by turns;
    share   regression of R_mn on T: how much of the sound of its neighbours a hydrophone has.

A delay that grows linearly along the array is a tilt or another speed of sound, and stays. What
all hydrophones share cannot be seen. Hydrophones whose share is small hear something else, and
their delay means nothing: they are left out, and the rest is looked at anew. Where the whole array
hears nothing in common there is no T, and gains are all that is found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from ..estimation.arrays import BoolArray, FloatArray, IntArray
from .spectra import ComplexArray

__all__ = ['apply_response', 'correct_phones', 'fit_phones', 'LEAST_DELAY', 'PhoneFit']

LEAST_DELAY = 1.0 / 60.0
"""Periods of the highest frequency that a delay has at least: less is as good as none."""
_RUNNING, _LEAST_ROWS = 31, 3
_POSITIVE = 1.5
"""Phase between two hydrophones, rad, up to which T is positive."""
_NEAR, _SWEEPS, _GRID, _REACH, _STEP = 3, 4, 181, 0.45, 0.7
_MOST_ROWS = 1000
"""Frequencies that delays are looked for with: more say nothing new and cost as much."""
_COMMON = 0.5
"""Least part of the cross-spectra of neighbours, in power, that T explains."""
_FEW = 5
"""With fewer hydrophones the median of a diagonal follows the faulty one."""


class PhoneFit(NamedTuple):
    """Responses of M hydrophones: gain (F, M) in power, sign (M,) 1 or -1, delay (M,) s, share
    (M,) of the sound of the neighbours, NaN where it was not looked for."""

    gain: FloatArray
    sign: IntArray
    delay: FloatArray
    share: FloatArray


def correct_phones(
    csdm: ComplexArray,
    frequency: FloatArray,
    place: IntArray,
    wave: float,
    least_share: float,
    *,
    full: bool = True,
) -> tuple[ComplexArray, BoolArray, PhoneFit]:
    """The cross-spectra as of equal hydrophones, which of them (M,) are kept, and what was found.

    csdm (F, M, M) at `frequency` (F,) Hz, M living hydrophones at the whole numbers `place` (M,)
    of their spacing; wave: speed of sound over that spacing, Hz; least_share: hydrophones with
    less are left out of what is returned (K of M), but for three; full: False for gains alone.
    """
    fit = fit_phones(csdm, frequency, place, wave, full=full)
    keep = np.nan_to_num(fit.share, nan=1.0) >= least_share
    if keep.sum() < _LEAST_ROWS:
        keep = np.ones(len(keep), np.bool_)
    found = fit
    if not keep.all():
        csdm = csdm[:, keep][:, :, keep]
        # Foreign sound has drawn the others along.
        found = fit_phones(csdm, frequency, place[keep], wave, full=full)
        for whole, part in zip(fit[1:], found[1:]):
            whole[keep] = part
        fit.gain[:, keep] = found.gain
    return apply_response(csdm, frequency, found), keep, fit


def fit_phones(
    csdm: ComplexArray, frequency: FloatArray, place: IntArray, wave: float, *, full: bool = True
) -> PhoneFit:
    """The responses of the hydrophones, see `correct_phones` and the head of this page."""
    M = len(place)
    power = np.einsum('fmm->fm', csdm).real.astype(np.float64)
    ratio = power / np.median(power, axis=1, keepdims=True)
    gain = median_filter(ratio, size=(min(_RUNNING, len(ratio)), 1), mode='nearest')
    sign, delay, share = np.ones(M, np.int64), np.zeros(M), np.full(M, np.nan)
    if not full or M < _FEW:
        return PhoneFit(gain, sign, delay, share)
    rows = slice(None, None, -(-len(frequency) // _MOST_ROWS))
    root = np.sqrt(gain[rows]).astype(csdm.real.dtype)
    level = csdm[rows] / root[:, :, None] / root[:, None, :]
    sign = _signs(level, frequency[rows], place, wave)
    delay, share, common = _delays(level * np.outer(sign, sign), frequency[rows], place)
    if common < _COMMON:
        return PhoneFit(gain, np.ones(M, np.int64), np.zeros(M), np.full(M, np.nan))
    return PhoneFit(gain, sign, delay, share)


def apply_response(csdm: ComplexArray, frequency: FloatArray, fit: PhoneFit) -> ComplexArray:
    """The cross-spectra (F, M, M) with the responses of `fit` taken off."""
    delay = np.where(np.abs(fit.delay) < LEAST_DELAY / np.max(frequency), 0.0, fit.delay)
    c = fit.sign / np.sqrt(fit.gain)
    if delay.any():
        c = c * np.exp(2j * np.pi * np.outer(frequency, delay))
    c = c.astype(csdm.dtype if np.iscomplexobj(c) else csdm.real.dtype)
    return np.asarray(csdm * c[:, :, None] * c.conj()[:, None, :])


def _signs(level: ComplexArray, frequency: FloatArray, place: IntArray, wave: float) -> IntArray:
    """Signs (M,); 1 where nothing tells."""
    M = len(place)
    lag = np.abs(place[:, None] - place)
    A = np.zeros((M, M))
    for apart in range(1, int(lag.max()) + 1):
        rows = np.flatnonzero(2.0 * np.pi * frequency * apart / wave < _POSITIVE)
        if len(rows) < _LEAST_ROWS:
            break
        here = lag == apart
        A[here] = level[rows].real.mean(axis=0)[here]
    vector = np.linalg.eigh(A)[1][:, -1]
    sign = np.where(vector < 0.0, -1, 1)
    if sign.sum() < 0:
        sign, vector = -sign, -vector
    return np.where(np.abs(vector) > 1e-3 * np.abs(vector).max(), sign, 1)


def _delays(
    level: ComplexArray, frequency: FloatArray, place: IntArray
) -> tuple[FloatArray, FloatArray, float]:
    """Delays (M,), s, and shares (M,) of cross-spectra of equal gain and sign; and how much of all
    pairs T explains."""
    M, index = len(place), np.arange(len(place))
    lag = place[:, None] - place
    first, second = np.nonzero((lag > 0) & (lag <= _NEAR))
    apart = lag[first, second]
    pairs = level[:, first, second].astype(np.complex128)
    of_first, of_second = np.eye(M)[first], np.eye(M)[second]
    grid = np.linspace(-_REACH, _REACH, _GRID) / np.max(frequency)
    waves = np.exp(2j * np.pi * np.outer(frequency, grid))

    def diagonals(shifted: ComplexArray, *, robust: bool) -> ComplexArray:
        T = np.empty(shifted.shape, np.complex128)
        for distance in np.unique(apart):
            here = apart == distance
            own = shifted[:, here]
            middle = own.mean(axis=1)
            if robust:
                middle = np.median(own.real, axis=1) + 1j * np.median(own.imag, axis=1)
            T[:, here] = middle[:, None]
        return T

    def aligned(shifted: ComplexArray, T: ComplexArray) -> ComplexArray:
        product = shifted * T.conj()
        return np.asarray(product @ of_first + product.conj() @ of_second)

    def moved(delay: FloatArray) -> ComplexArray:
        turn = np.outer(frequency, delay[first] - delay[second])
        return np.asarray(pairs * np.exp(2j * np.pi * turn))

    delay = np.zeros(M)
    for sweep in range(_SWEEPS):
        shifted = moved(delay)
        robust = sweep < _SWEEPS // 2
        score = (aligned(shifted, diagonals(shifted, robust=robust)).T @ waves).real
        best = np.clip(score.argmax(axis=1), 1, _GRID - 2)
        before, here, after = (score[index, best + k] for k in (-1, 0, 1))
        with np.errstate(divide='ignore', invalid='ignore'):
            beside = 0.5 * (before - after) / (before - 2.0 * here + after)
        beside = np.clip(np.nan_to_num(beside), -1.0, 1.0)
        step = grid[best] + (grid[1] - grid[0]) * beside
        delay = delay + (_STEP if robust else 1.0) * (step - np.median(step))
    delay = _without_slope(delay, place, LEAST_DELAY / float(np.max(frequency)))
    shifted = moved(delay)
    T = diagonals(shifted, robust=True)
    strength = np.square(np.abs(T)).sum(axis=0) @ (of_first + of_second)
    with np.errstate(divide='ignore', invalid='ignore'):
        share = aligned(shifted, T).sum(axis=0).real / strength
    whole = float(np.square(np.abs(pairs)).sum())
    common = float(np.square(np.abs(T)).sum()) / whole if whole > 0.0 else 0.0
    return delay, np.nan_to_num(share), common


def _without_slope(delay: FloatArray, place: IntArray, least: float) -> FloatArray:
    """Delays (M,) without what is linear along the array, so that their median is zero.

    The slope is the median from one hydrophone to the next. Where most of them are late, each by
    its own, that is uncertain, and it is the median over all pairs (Theil and Sen)."""
    first, second = np.triu_indices(len(place), 1)
    neighbours = second == first + 1
    slopes = (delay[second] - delay[first]) / (place[second] - place[first])
    for use in (neighbours, np.ones(len(slopes), np.bool_)):
        level = delay - np.median(slopes[use]) * place
        level = level - np.median(level)
        if np.median(np.abs(level)) < least:
            break
    return np.asarray(level)
