# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Envelopes of a profiler: their noise by depth, their pulse, and amplitudes as normal numbers.

The envelope of noise is no Gaussian: it has a Rayleigh distribution, which exceeds a with the
probability ``exp(-(a / s)^2)`` for noise of rms s. Against a Gaussian it is a layer at every
depth; mapped to a normal number,

    b = Phi^-1(1 - exp(-(x / s)^2)),

it is noise of standard deviation one, and what stands out of it still does (`to_normal`).

The noise by depth is what the quietest tenth of the traces has (`first_noise`), and no more than
at any greater depth: where layers are, nothing of the traces is quiet. Once it is known where the
water ends, it is the rms of what is above (`water_noise`). The samples at the beginning that are
loud in nearly every trace are the transmit pulse (`transmit_samples`). The pulse is told by how
steeply the first maximum of the floor rises (`rise`): what follows may be scatter.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import log_ndtr, ndtri_exp

from ..estimation.arrays import BoolArray, FloatArray, IntArray

__all__ = [
    'converter_step',
    'first_noise',
    'from_normal',
    'is_envelope',
    'log_likelihoods',
    'pulse_and_lead',
    'quietest',
    'rise',
    'scatter_power',
    'to_normal',
    'transmit_samples',
    'water_noise',
]

_QUIET = 0.1
"""Quantile of the traces that is noise at every depth."""
_QUIET_OF_RMS = math.sqrt(-math.log1p(-_QUIET))
"""That quantile of a Rayleigh distribution of rms one."""
_STEADY = 0.6
_RING, _FEW_VALUES, _ZEROS = 0.1, 4096, 0.05
_RUNNING, _POOLED, _LEAST_POOLED, _ENOUGH = 31, 41, 200, 60
_LOUDEST, _MOST, _RATIO = 0.995, 1.3, 2.0
_HALF_OF_SIGMA = 1.1774
_REACH, _LEAST_PULSES, _LEAST_WIDTH = 8, 10, 1.2
_LINEAR = 6.0
_LOWEST = -3.0902323061678132
"""Normal number of a probability of one in a thousand."""
_B_LINEAR = -float(ndtri_exp(-(_LINEAR**2)))
_OUTLIERS, _BELOW = 0.01, 1.39


def is_envelope(amplitude: FloatArray) -> bool:
    """True when no sample is negative, and some are not zero."""
    return bool(np.nanmin(amplitude) >= 0.0 and np.nanmax(amplitude) > 0.0)


def converter_step(traces: FloatArray) -> float:
    """The step of a coarse converter: the least difference of few distinct values, or the least
    value that a recorder with a threshold writes in place of zero; else 0."""
    values = np.unique(traces[np.isfinite(traces)])
    if values[-1] > 0.0 and np.mean(traces == 0.0) >= _ZEROS:
        return float(values[values > 0.0][0])
    return float(np.diff(values).min()) if 1 < len(values) <= _FEW_VALUES else 0.0


def quietest(trace: FloatArray) -> float:
    """Noise, rms, of one trace (n,): of its quietest tenth, at least 1e-3 of its maximum."""
    quiet = float(np.nanquantile(trace, _QUIET)) / _QUIET_OF_RMS
    return max(quiet, 0.5 * converter_step(trace), 1e-3 * float(np.nanmax(trace)))


def transmit_samples(traces: FloatArray) -> int:
    """How many samples at the beginning of the traces (T, n) are loud in nine of ten of them, and
    steady: a floor that begins there is not."""
    loud = _quiet(traces) > _RING * float(np.median(np.nanmax(traces, axis=1)))
    ring = int(np.argmin(np.append(loud, False)))
    if not ring:
        return 0
    quiet, most = np.nanquantile(traces[:, :ring], [_QUIET, 1.0 - _QUIET], axis=0)
    return ring if float(np.median(quiet / most)) > _STEADY else 0


def first_noise(traces: FloatArray) -> FloatArray:
    """Noise (n,), rms, of the traces (T, n), at least half a step of the converter and a
    thousandth of the loudest."""
    if len(traces) < _ENOUGH:
        # The tenth of a few traces is one of them, and the least of many such much too quiet.
        half = _RUNNING // 2
        padded = np.pad(traces, ((0, 0), (half, half)), 'edge')
        windows = np.lib.stride_tricks.sliding_window_view(padded, _RUNNING, axis=1)
        quiet = _quiet(windows.transpose(0, 2, 1).reshape(-1, traces.shape[1]))
    else:
        quiet = median_filter(_quiet(traces), _RUNNING, mode='nearest')
    quiet = np.minimum.accumulate((quiet / _QUIET_OF_RMS)[::-1])[::-1]
    loudest = float(np.median(np.nanmax(traces, axis=1)))
    return np.maximum(quiet, max(0.5 * converter_step(traces), 1e-3 * loudest))


def _quiet(traces: FloatArray) -> FloatArray:
    """The quietest tenth (n,) of the traces (T, n), where none reaches as at the depth beside."""
    known = ~np.isnan(traces)
    if known.all():
        return np.asarray(np.quantile(traces, _QUIET, axis=0))
    there = np.flatnonzero(known.any(axis=0))
    found = np.nanquantile(traces[:, there], _QUIET, axis=0)
    return np.interp(np.arange(traces.shape[1]), there, found)


def water_noise(
    traces: FloatArray, first: FloatArray, ring: int, onset: IntArray, pulse: float
) -> FloatArray:
    """Noise (n,), rms, of what lies between the `ring` samples of the transmit pulse and four
    pulses above `onset` (T,), in samples as `pulse`; within 1 to 1.3 times `first` (n,), of
    `first_noise`, which stays where too little is seen."""
    n = traces.shape[1]
    cell = np.arange(n)
    end = np.floor(onset - 4.0 * pulse)
    water = (cell >= ring + 2) & (cell < end[:, None])
    if not water.any():
        return first
    water &= traces <= np.quantile(traces[water], _LOUDEST)
    count = _pooled(water.sum(axis=0))
    power = _pooled(np.where(water, np.square(traces), 0.0).sum(axis=0))
    seen = np.flatnonzero(count >= _LEAST_POOLED)
    if not len(seen):
        return first
    found = first.copy()
    found[seen] = np.sqrt(power[seen] / count[seen])
    last = seen[-1]
    ratio = float(found[last] / first[last])
    found[last + 1 :] *= ratio if ratio <= _RATIO else 1.0
    return np.asarray(np.clip(found, first, _MOST * first))


def _pooled(values: FloatArray | IntArray) -> FloatArray:
    running = np.append(0.0, np.cumsum(np.pad(values, _POOLED // 2), dtype=np.float64))
    return np.asarray(running[_POOLED:] - running[:-_POOLED])


def rise(trace: FloatArray, onset: int) -> tuple[float, int] | None:
    """Half height to the first maximum below `onset`, in standard deviations of the pulse, and
    where it is, in samples; None where there is none.

    It is the first local maximum from two samples above that exceeds half of the largest sample up
    to seven further."""
    for k in range(max(onset - 2, 1), len(trace) - 1):
        if trace[k] < trace[k - 1] or trace[k] < trace[k + 1]:
            continue
        if not trace[k] > 0.5 * trace[k : k + _REACH].max():
            continue
        half = 0.5 * trace[k]
        before = np.flatnonzero(trace[:k] <= half)
        if not len(before):
            return None
        low = int(before[-1])
        place = low + (half - trace[low]) / (trace[low + 1] - trace[low])
        return (k - place) / _HALF_OF_SIGMA, k
    return None


def pulse_and_lead(traces: FloatArray, onset: IntArray) -> tuple[float, float, float]:
    """Standard deviation of the pulse; by how much the first maximum lies below the onset, and how
    far that is spread; in samples, by the traces (T, n) whose floor begins at `onset` (T,), -1 for
    none; NaN when too few say so."""
    found = [
        (*each, k)
        for trace, k in zip(traces, onset.tolist())
        if k >= 0 and (each := rise(np.nan_to_num(trace), k)) is not None
    ]
    if len(found) < _LEAST_PULSES:
        return math.nan, math.nan, math.nan
    width, top, begin = np.array(found).T
    # Whole samples: the mean of the middle half is as robust as the median, and finer.
    lead = np.sort(top - begin)
    quarter = len(lead) // 4
    middle = lead[quarter : len(lead) - quarter]
    spread = math.hypot(float(middle[-1] - middle[0]) / 1.349, 1.0 / math.sqrt(12.0))
    return max(float(np.median(width)), _LEAST_WIDTH), float(middle.mean()), spread


def log_likelihoods(
    trace: FloatArray, noise: FloatArray, loudest: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log likelihood (n,) of each sample of a trace (n,) as quiet, loud, and as the onset of a
    floor, zero where it is NaN. noise (n,), rms; loudest: what the loudest traces reach.

    By y = log(x / noise). Below zero the mass of the distribution counts, above its density:
    Rayleigh for what is quiet, with a hundredth of what is loud, which is even up to the loudest.
    """
    # Where the noise rises by far with the depth, that of most depths is none of the water.
    common = min(float(np.median(noise)), _MOST * float(np.min(noise)))
    span = math.log(max(loudest / common, 1.0)) + _BELOW
    with np.errstate(divide='ignore', invalid='ignore'):
        y = np.log(trace / noise)
    below, known = y < 0.0, ~np.isnan(y)
    y = np.clip(np.nan_to_num(y), -50.0, 50.0)
    loud = np.where(below, math.log(_BELOW / span), -math.log(span))
    rayleigh = math.log(2.0) + 2.0 * y - np.exp(np.minimum(2.0 * y, 6.0))
    quiet = np.where(below, math.log(1.0 - math.exp(-1.0)), rayleigh)
    quiet = np.logaddexp(math.log(1.0 - _OUTLIERS) + quiet, math.log(_OUTLIERS) + loud)
    onset = np.where(below, math.log(0.02), -math.log(span))
    return quiet * known, loud * known, onset * known


def scatter_power(trace: FloatArray, noise: FloatArray, onset: int, pulse: float) -> FloatArray:
    """Power (n,) of volume scatter by distance in samples from four pulses below the onset on: of
    running medians over 16 pulses, without the noise (n,), never rising with the depth."""
    found = np.zeros(len(trace))
    first = onset + math.ceil(4.0 * pulse)
    below = np.nan_to_num(trace[first:])
    if len(below):
        median = median_filter(below, 2 * round(8.0 * pulse) + 1, mode='reflect')
        power = np.square(median) / math.log(2.0) - np.square(noise[first:])
        found[: len(below)] = np.minimum.accumulate(np.maximum(power, 0.0))
    return found


def to_normal(x: FloatArray) -> FloatArray:
    """Amplitudes over the rms of their noise, as normal numbers: of noise standard deviation one.
    Beyond 6 straight on, never below the number of one in a thousand."""
    near = -ndtri_exp(-np.square(np.minimum(x, _LINEAR)))
    found = np.where(x > _LINEAR, _B_LINEAR + math.sqrt(2.0) * (x - _LINEAR), near)
    return np.asarray(np.maximum(found, _LOWEST))


def from_normal(b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The inverse of `to_normal`, and its derivative."""
    near = np.clip(b, _LOWEST, _B_LINEAR)
    log_tail = log_ndtr(-near)
    x = np.sqrt(-log_tail)
    slope = np.exp(-0.5 * np.square(near) - 0.5 * math.log(2.0 * math.pi) - log_tail) / (2.0 * x)
    far: BoolArray = b > _B_LINEAR
    flat = 1.0 / math.sqrt(2.0)
    return np.where(far, _LINEAR + flat * (b - _B_LINEAR), x), np.where(far, flat, slope)
