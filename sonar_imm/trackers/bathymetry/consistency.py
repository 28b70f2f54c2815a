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

"""Whether the noise that a sonar states can be true.

What is left of the P staves of a bin y beside the echo from the estimated direction,

    r = (|y|^2 - |a^H y|^2 / P) / ((P - 1) sn2),

is noise in P - 1 directions, by the noise variance sn2 that is stated: its mean is one whatever
the floor sends back and whether or not its power fades (`acoustics.laplace`), and in n bins it is
known to sqrt(3 / n) or better. A second echo in a bin and staves that do not agree raise it, a
direction that is fitted to the noise lowers it by a few hundredths. So only a mean that is wrong
by 3 dB counts, and only when the median ping shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from ...estimation.arrays import BoolArray, ComplexArray, FloatArray

FEWEST_BINS = 100
FEWEST_PINGS = 5
BOUNDS = 0.5, 2.0
"""Between these the noise is as stated, as far as the test goes."""


def residual_ratio(
    iq: ComplexArray,
    sines: FloatArray,
    spacing: float,
    noise: FloatArray,
    chosen: BoolArray,
) -> float:
    """The mean of r over the bins `chosen` (T,); NaN when they are less than `FEWEST_BINS`.

    iq (T, P); sines (T,) of the estimated directions from broadside; spacing of the staves in
    wavelengths; noise (T,) variance at a stave.
    """
    chosen = chosen & np.isfinite(sines)
    if np.count_nonzero(chosen) < FEWEST_BINS:
        return math.nan
    y = np.asarray(iq[chosen], np.complex128)
    staves = y.shape[1]
    phase = 2.0 * math.pi * spacing * sines[chosen][:, None] * np.arange(staves)
    beam = np.abs((y * np.exp(-1j * phase)).sum(axis=1))
    left = np.square(np.abs(y)).sum(axis=1) - np.square(beam) / staves
    return float(np.mean(left / ((staves - 1) * noise[chosen])))


def noise_warnings(ratios: Sequence[float]) -> list[str]:
    """What the ratios of the last pings say of the noise that is stated, in sentences."""
    known = [one for one in ratios if math.isfinite(one)]
    if len(known) < FEWEST_PINGS:
        return []
    typical = float(np.median(known))
    if BOUNDS[0] <= typical <= BOUNDS[1]:
        return []
    advice = '' if typical < 1.0 else ', decorrelation and element_spacing_wavelengths'
    return [
        f'what the sensor states cannot be true: beside the echo the staves have {typical:.2g} '
        f'times the noise that is stated; check noise_variance{advice}'
    ]
