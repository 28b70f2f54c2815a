# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The noise of a response, measured where no echo is: in the mirror window of an array."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import median_filter

from ...acoustics import fathometer
from ...estimation.arrays import FloatArray
from ...measurements import Rejection, Trace

LEAST_NOISE_SAMPLES = 50
OWN_SOUND = 1.5
"""How much louder than further away noise near an array is that hears itself."""


def stated_sigma(trace: Trace, depth: FloatArray, noise_sigma: float) -> FloatArray | None:
    """Return the noise (n,) at `depth` (n,), m, that is configured (`noise_sigma`, 0 for none) or
    else that the trace states; None where neither is."""
    if noise_sigma:
        return np.full(len(depth), noise_sigma)
    if trace.sigma is None:
        return None
    known = np.isfinite(trace.sigma)
    return np.interp(depth, trace.depth[known], trace.sigma[known])


def measured_sigma(quiet: FloatArray) -> float:
    sigma = fathometer.noise_sigma(quiet)
    if not sigma > 0.0:
        # Coarse steps of a converter leave no deviation of the median.
        sigma = float(np.std(quiet))
    if not (np.isfinite(sigma) and sigma > 0.0):
        raise Rejection('no_noise', 'the record has no noise to compare its peaks with')
    return sigma


def mirror_sigma(
    at: Callable[[float, float, int], FloatArray],
    below: FloatArray,
    step: float,
    reference_depth: float,
    aperture: float,
    half: float = np.inf,
) -> FloatArray:
    """Noise (n,) of a response `below` (n,) m below the array, every `step` m, where it holds no
    echo: at the same lags, negative, that is at the depths 2 reference_depth - z. It fades there
    as it does below, and is as much louder near a short array, which hears itself. Left out: what
    is nearer than the aperture, or further than `half`, m, from where on the lags of a snapshot
    are those of the other side. at(first, step, count): the response. Raises `Rejection`."""
    # Few depths are made more.
    count = max(len(below), 4 * LEAST_NOISE_SAMPLES)
    away = below[0] + step * np.arange(count)
    quiet = (away >= aperture) & (away <= half)
    beyond = np.count_nonzero(quiet) < LEAST_NOISE_SAMPLES and away[-1] > half
    if beyond:
        away = aperture + step * np.arange(count)
        quiet = away <= half
    if np.count_nonzero(quiet) < LEAST_NOISE_SAMPLES:
        raise Rejection('no_noise', 'nothing of the mirrored depths is free of the array itself')
    noise = at(reference_depth - float(away[-1]), step, count)[::-1]
    # The noise of a coherence has mean zero: no median of it is taken off.
    whole = measured_sigma(np.append(noise[quiet], -noise[quiet]))
    sigma = np.full(len(below), whole)
    if not beyond:
        first = int(np.argmax(quiet))
        near = _own_sound(noise[quiet], whole, max(LEAST_NOISE_SAMPLES, int(aperture / step)))
        near = near[: max(len(below) - first, 0)]
        sigma[first : first + len(near)] = near
    return sigma


def _own_sound(noise: FloatArray, whole: float, width: int) -> FloatArray:
    """Noise (K,) of as many cells from the array on as it is louder than `whole`, from the values
    (n,) of the mirror window, nearest first: never louder again further away."""
    spread = median_filter(np.abs(noise), size=min(width, len(noise)), mode='reflect')
    local = np.minimum.accumulate(spread / fathometer.MAD_OF_UNIT_NORMAL)
    return np.asarray(local[: int(np.argmax(np.append(local, 0.0) < OWN_SOUND * whole))])
