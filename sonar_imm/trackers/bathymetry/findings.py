# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the last pings say of a sonar: its noise, its staves and the sign of its phases.

Of a ping by itself: `LoudBins`; `residual_ratio` compares what is left beside the echo with the
noise that is stated, and `sign_evidence` whether a floor explains the echoes better with the phase
turned round.
Of the last pings: sentences for `BathymetryTracker.warnings`, stave by stave.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

from attrs import evolve
import numpy as np

from ...acoustics.calibration import Calibration, DEAD
from ...estimation.arrays import BoolArray, FloatArray
from .config import BathymetryConfig

FEWEST_PINGS = 5
FEWEST_BINS = 100
"""Of fewer bins `residual_ratio` says nothing."""
NOISE_BOUNDS = 0.5, 2.0
"""Between these ratios of its residual the noise is as stated, as far as the test goes."""
SOME_GAIN, SOME_NOISE, SOME_PHASE = 1.0, 3.0, 3.0
"""From so many decibels, decibels and degrees on a stave is named."""
INVERTED = 150.0
"""Degrees from which on a stave is inverted."""
TILTS = 15.0, 60.0
"""deg: tilts from which on, and below which, the sign of the phase can be told by a floor."""
DECIDED, MOST_TRIED = 20.0, 20
"""Log likelihood that decides the sign of the phase, and pings it is looked for in at most."""
OPEN_STD = 3.0
"""m, at least, of the height before the first bin while the sign is looked for."""
MOST_OF_BIN = 20.0


class LoudBins(NamedTuple):
    """How many bins stand 20 dB above the noise, how many of them are passed over, and the share
    of their power that differs from stave to stave, NaN without any; `layover.array_error`, NaN
    where layover is ignored; how many bins from the depth of the floor on are usable, and how many
    of these are passed over; `coherence.common_mode`; whether there were too few staves for the
    two surfaces of a bin; `variances.bins_alike`."""

    bins: int
    silent: int
    decorrelation: float
    array_error: float = math.nan
    beyond: int = 0
    beyond_silent: int = 0
    common_mode: float = 0.0
    unresolved: bool = False
    alike: float = 1.0


class Sign(NamedTuple):
    """What pings say of the sign of the phase: the sum of the log likelihoods, as configured less
    turned round, and of how many pings."""

    evidence: float = 0.0
    pings: int = 0

    @property
    def is_open(self) -> bool:
        return abs(self.evidence) <= DECIDED and self.pings < MOST_TRIED

    @property
    def is_turned(self) -> bool:
        return self.evidence < -DECIDED


def with_open_start(config: BathymetryConfig) -> BathymetryConfig:
    """The parameters that the sign of the phase is looked for with: `terrain`, outward alone."""
    return evolve(
        config,
        model_set='terrain',
        engine='auto',
        smoothing='none',
        ping_coupling=0.0,
        layover='ignored',
        sigmas=(),
        sigmas_deg=(),
        transition_matrix=(),
        stay_probability=0.0,
        initial_probabilities=(),
        initial_mean=0.0 if config.model_set == 'angle_two_rw' else config.initial_mean,
        initial_std=OPEN_STD
        if config.model_set == 'angle_two_rw'
        else max(config.initial_std, OPEN_STD),
    )


def sign_evidence(configured: FloatArray, turned: FloatArray) -> float:
    """Sum of the log likelihoods of the bins (T,), as configured less turned round; a bin that
    nothing explains, or a single one, does not decide."""
    with np.errstate(invalid='ignore'):
        each = configured - turned
    return float(np.clip(np.nan_to_num(each, nan=0.0), -MOST_OF_BIN, MOST_OF_BIN).sum())


def sign_warnings(signs: Sequence[Sign]) -> list[str]:
    turned = [sign for sign in signs if sign.is_turned]
    return [
        'echoes fit the other sign of the phase (log likelihood '
        f'{-sign.evidence / sign.pings:+.0f} a ping): conjugate turned'
        for sign in turned[:1]
    ]


def residual_ratio(
    iq: np.ndarray,
    sines: FloatArray,
    spacing: float,
    noise: FloatArray,
    chosen: BoolArray,
    staves: int | None = None,
) -> float:
    """Whether the noise that a sonar states can be true: the mean of r over the bins `chosen`
    (T,); NaN when they are less than `FEWEST_BINS`.

    What is left of the P staves of a bin y beside the echo from the estimated direction,

        r = (|y|^2 - |a^H y|^2 / P) / ((P - 1) sn2),

    is noise in P - 1 directions, by the noise variance sn2 that is stated: its mean is 1 whatever
    the floor sends back and whether or not its power fades (`acoustics.laplace`), and in n bins it
    is known to sqrt(3 / n) or better. A second echo in a bin and staves that do not agree raise
    it, a direction that is fitted to the noise lowers it by a few hundredths.

    iq (T, P); sines (T,) of the estimated directions from broadside; spacing of the staves in
    wavelengths; noise (T,) variance at a stave; staves: how many of the P are live, None for all;
    the others are zero.
    """
    chosen = chosen & np.isfinite(sines)
    if np.count_nonzero(chosen) < FEWEST_BINS:
        return math.nan
    y = np.asarray(iq[chosen], np.complex128)
    staves = staves or y.shape[1]
    phase = 2.0 * math.pi * spacing * sines[chosen][:, None] * np.arange(y.shape[1])
    beam = np.abs((y * np.exp(-1j * phase)).sum(axis=1))
    left = np.square(np.abs(y)).sum(axis=1) - np.square(beam) / staves
    return float(np.mean(left / ((staves - 1) * noise[chosen])))


def noise_warnings(ratios: Sequence[float]) -> list[str]:
    """What the ratios (`residual_ratio`) of the last pings say of the stated noise, in sentences.
    Only a mean that is wrong by 3 dB counts, and only when the median ping shows it."""
    known = [ratio for ratio in ratios if math.isfinite(ratio)]
    if len(known) < FEWEST_PINGS:
        return []
    typical = float(np.median(known))
    if NOISE_BOUNDS[0] <= typical <= NOISE_BOUNDS[1]:
        return []
    advice = '' if typical < 1.0 else ', decorrelation and element_spacing_wavelengths'
    return [
        f'what the sensor states cannot be true: beside the echo the staves have {typical:.2g} '
        f'times the noise that is stated; check noise_variance{advice}'
    ]


class Staves(NamedTuple):
    """What most of several pings say of the staves (P,): gain and noise in decibels, phase in
    degrees; see `Calibration`."""

    live: BoolArray
    gain_db: FloatArray
    phase_deg: FloatArray
    coherence: FloatArray
    noise_db: FloatArray
    order: tuple[int, ...]
    no_wave: BoolArray
    tilt_deg: float


def staves_of(pings: Sequence[Calibration]) -> Staves | None:
    """Return what most pings say of the staves, None of fewer than `FEWEST_PINGS`; pings of other
    numbers of staves than the last one, or that had too few echoes, do not count."""
    last = len(pings[-1].live) if pings else 0
    known = [ping for ping in pings if ping.bins > 0 and len(ping.live) == last]
    if len(known) < FEWEST_PINGS:
        return None
    gain = np.median([ping.gain for ping in known], axis=0)
    noise = np.median([ping.noise for ping in known], axis=0) * np.square(gain)
    order = tuple(int(place) for place in np.median([ping.order for ping in known], axis=0))
    with np.errstate(divide='ignore'):
        return Staves(
            live=np.mean([ping.live for ping in known], axis=0) > 0.5,
            gain_db=20.0 * np.log10(gain),
            phase_deg=np.degrees(np.angle(np.mean([np.exp(1j * p.phase) for p in known], axis=0))),
            coherence=np.median([ping.coherence for ping in known], axis=0),
            noise_db=10.0 * np.log10(noise / np.median(noise)),
            order=order,
            no_wave=np.mean([ping.no_wave for ping in known], axis=0) > 0.5,
            tilt_deg=math.degrees(float(np.median([ping.sine_std for ping in known]))),
        )


def stave_warnings(pings: Sequence[Calibration]) -> list[str]:
    """What the last pings say of the staves, each named, in sentences."""
    found = staves_of(pings)
    if found is None:
        return []
    gone, quiet = ~found.live, found.gain_db < 10.0 * math.log10(DEAD)
    dead, deaf = gone & quiet, gone & ~quiet
    sentences = [f'{_staves(dead)} dead: masked'] if dead.any() else []
    if deaf.any():
        sentences.append(
            f'{_staves(deaf, "hears", "hear")} noise only (coherence '
            f'{_numbers(found.coherence[deaf], ".2f")}): masked'
        )
    weak = found.live & (found.gain_db <= -SOME_GAIN)
    strong = found.live & (found.gain_db >= SOME_GAIN)
    for which, how in ((weak, 'weaker'), (strong, 'stronger')):
        if which.any():
            level = _numbers(np.abs(found.gain_db[which]), '.1f')
            sentences.append(f'{_staves(which)} {level} dB {how} than the others: gain corrected')
    noisy = found.live & (found.noise_db >= SOME_NOISE)
    if noisy.any():
        level = _numbers(found.noise_db[noisy], '.1f')
        sentences.append(
            f'{_staves(noisy, "has", "have")} {level} dB more noise than the others: counted less'
        )
    inverted = found.live & (np.abs(found.phase_deg) >= INVERTED)
    if inverted.any():
        sentences.append(f'{_staves(inverted)} inverted: phase corrected by 180 deg')
    off = found.live & ~inverted & (np.abs(found.phase_deg) >= SOME_PHASE)
    if off.any():
        sentences.append(
            f'{_staves(off)} off in phase by {_numbers(found.phase_deg[off], ".0f")} deg: '
            f'corrected, which leaves the tilt uncertain by {found.tilt_deg:.1f} deg'
        )
    changed = np.array(found.order) != np.arange(len(found.order))
    if changed.any():
        sentences.append(f'{_staves(changed)} exchanged: put back')
    if found.no_wave.any():
        least = found.coherence[found.no_wave].min()
        hint = ': exchanged cables?' if np.count_nonzero(found.no_wave) > 1 else ''
        sentences.append(
            f'{_staves(found.no_wave, "fits", "fit")} no plane wave (coherence {least:.2f}){hint}'
        )
    return sentences


def _staves(which: BoolArray, one: str = 'is', several: str = 'are') -> str:
    numbers = [str(number) for number in np.flatnonzero(which)]
    if len(numbers) == 1:
        return f'stave {numbers[0]} {one}'
    return f'staves {", ".join(numbers)} {several}'


def _numbers(values: FloatArray, form: str) -> str:
    return ', '.join(format(value, form) for value in values)
