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

"""What the traces of a sub-bottom profiler tell of their instrument.

The water above the floor is quiet, so that the first arrival of a trace is plain to see, and its
shape is that of the pulse where little scatters below it: the lower quartile over all traces of
its width at half height is taken. What is above the first arrival is noise; of coarse steps of a
converter it is at least half a step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import FloatArray, IntArray

_RUN, _REACH, _LOUD = 3, 4, 8.0
_LEAST_ARRIVALS = 10
_NEAR = 1.5
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


def is_envelope(amplitude: FloatArray) -> bool:
    """True when no sample of the traces (T, n) is negative, and some are not zero."""
    return bool(np.nanmin(amplitude) >= 0.0 and np.nanmax(amplitude) > 0.0)


def arrival_edges(amplitude: FloatArray) -> IntArray:
    """Sample at which each trace (T, n) first begins, -1 where none does: the first of three
    successive samples above an eighth of what the loud traces reach."""
    loud = float(np.quantile(amplitude.max(axis=1), 0.99)) / _LOUD
    above = amplitude > loud
    count = amplitude.shape[1] - _RUN + 1
    if count < 1:
        return np.full(len(amplitude), -1)
    run = np.logical_and.reduce([above[:, k : k + count] for k in range(_RUN)])
    return np.where(run.any(axis=1), run.argmax(axis=1), -1)


def first_arrivals(amplitude: FloatArray) -> IntArray:
    """Sample of the first arrival of each trace (T, n), -1 where there is none: the greatest of
    the four from its edge on."""
    return np.array(
        [
            -1 if i < 0 else i + int(np.argmax(trace[i : i + _REACH]))
            for i, trace in zip(arrival_edges(amplitude), amplitude)
        ]
    )


def measured_instrument(
    amplitude: FloatArray, spacing: float, stack: int = 1
) -> tuple[float, float] | None:
    """Standard deviation of the pulse, m, and noise, for envelopes (T, n) with samples `spacing` m
    apart, of which `stack` successive ones are averaged; None when too few first arrivals stand
    free."""
    step = _step(amplitude)
    count = len(amplitude) // stack
    amplitude = amplitude[: count * stack].reshape(count, stack, -1).mean(axis=1)
    arrivals = first_arrivals(amplitude)
    free = [(trace, int(i)) for trace, i in zip(amplitude, arrivals) if i >= _REACH]
    widths = [width for trace, i in free if (width := _width(trace, i)) is not None]
    if len(widths) < _LEAST_ARRIVALS:
        return None
    pulse = spacing * max(float(np.quantile(widths, 0.25)) / _FWHM, 0.4)
    quiet = np.concatenate([trace[: i - _REACH] for trace, i in free] or [np.empty(0)])
    rms = float(np.sqrt(np.mean(np.square(quiet)))) if len(quiet) else 0.0
    return pulse, max(rms, 0.5 * step, 1e-3 * float(amplitude.max()))


def _width(trace: FloatArray, peak: int) -> float | None:
    """Width at half height of the hump at `peak`, samples, None when it leaves the trace."""
    half = 0.5 * trace[peak]
    before, after = np.flatnonzero(trace[:peak] <= half), np.flatnonzero(trace[peak:] <= half)
    if not len(before) or not len(after):
        return None
    low, high = int(before[-1]), peak + int(after[0])
    left = low + (half - trace[low]) / (trace[low + 1] - trace[low])
    right = high - (half - trace[high]) / (trace[high - 1] - trace[high])
    return float(right - left)


def _step(amplitude: FloatArray) -> float:
    """The step of a coarse converter: the least difference of few distinct values, else 0."""
    values = np.unique(amplitude)
    return float(np.diff(values).min()) if 1 < len(values) <= 4096 else 0.0


def doubted_spacing(
    amplitude: FloatArray, spacing: float, offset: float, stated: NDArray
) -> str | None:
    """A sentence when samples `spacing` m apart, the first of the traces (T, n) `offset` m down,
    cannot be right; None otherwise. stated (T,): depth of the water by the headers, m, 0 where
    they say nothing."""
    span = offset + spacing * amplitude.shape[1]
    if not 1.0 <= span <= 12_000.0:
        return f'the sample interval of the headers makes the traces end at {span:g} m'
    arrivals = first_arrivals(amplitude)
    known = (stated > 0.0) & (arrivals >= _REACH)
    if np.count_nonzero(known) < _LEAST_ARRIVALS:
        return None
    sample = offset / spacing + arrivals[known]
    fits = float(np.median(stated[known] / sample))
    if fits / _NEAR <= spacing <= fits * _NEAR:
        return None
    return (
        f'the sample interval of the headers ({spacing:.3g} m a sample) puts the first arrivals '
        f'at {np.median(spacing * sample):.1f} m, where the headers themselves state '
        f'{np.median(stated[known]):.1f} m of water: {fits:.3g} m a sample would fit; '
        'give the sample spacing'
    )
