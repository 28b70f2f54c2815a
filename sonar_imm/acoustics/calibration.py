# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Gain, phase and noise of the staves of an array, measured from the echoes of one ping.

The echo of a bin is one plane wave, of any direction and power. So what all bins show of a stave p
beside the others is the stave: with c_p its gain and phase,

    y_tp = c_p s_t exp(i w_t p) + noise

the directions w_t are the peaks of the beam of y / c, and c_p follows from what the other staves
say of the echo, S_t = sum over q != p of y_tq exp(-i w_t q) / c_q, in a few rounds of both::

    z_tp = y_tp exp(-i w_t p) / c_p
    c_p <- c_p (P - 1) sum_t z_tp conj(S_t) / m_t  /  sum_t |S_t|^2 / m_t

with m_t the power of the bin, so that strong echoes count no more than others. Rounds change the
phases; the gain, into which the noise of a stave does not enter, is that of the last one. The
*coherence* of a stave is the correlation of z_tp with S_t: one that only hears noise has none.

**No echo tells a phase that grows evenly from stave to stave** from a tilt of the array: that
part is taken off, and what it may have been is `Calibration.sine_std`. A stave far off does not
tilt the line through the others.

Staves that are exchanged fit no plane wave. Exchanging them back is tried for those of little
coherence. The noise of each stave is what two of the three parts of a wave, its amplitude, phase
and direction, leave of it; staves whose noise does not differ by chance alone have weights.

All of it is of one ping. An array for which nothing is significant is left as it is, to the bit.
"""

from __future__ import annotations

from itertools import combinations
import math

from attrs import evolve, frozen
import numpy as np

from ..estimation.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from .array import direction_grid, phase_step
from .laplace import autocorrelation
from .variances import mean_power
from .wave_kernels import beam_peaks

FEWEST_STAVES = 4
LOUD, FEWEST_LOUD, FIRST_BINS, MOST_BINS = 10.0, 50, 512, 1536
"""Bins so many times the noise are used; the array is measured from so many of them or more. At
most so many, spread over the ping, show whether it is exact, and so many what it is."""
DEAD, NOISE_ONLY, NO_WAVE = 0.1, 0.5, 0.9
"""Power of a dead stave, in that of the median; coherence of one that hears noise only, and of one
that fits no plane wave, in the median of all."""
SURE = 0.88
"""Below this coherence of the median stave the bins hold no plane waves."""
ROUNDS, CONVERGED = 12, 0.3
"""At most; and the step that ends them, in standard deviations."""
LEAST, SIGNIFICANT = 0.003, 5.0
"""A gain, as its logarithm, or a phase is one from so much and so many standard deviations on."""
BESIDE_LINE = math.radians(60.0)
FAINT, STRONG, FEWEST_FAINT = 10.0, 100.0, 100
"""The noise of staves is measured from bins with echoes between so many times the noise."""
ALIKE, SPREAD, NOISE_ROUNDS = 6.0, 1.15, 30
"""Noise of a stave that differs from the median by less than so many standard deviations,
sqrt(spread / bins) of its logarithm, is that of the median."""
STEADY = 0.6
"""Of the incoherent power of a stave, from faint to loud bins."""
MOST_EXCHANGED, EXCHANGES, TRIED_BINS = 8, 2, 48
"""Of so many staves without a plane wave each pair is tried, in so many bins, and so many
exchanges are found."""


@frozen(eq=False)
class Calibration:
    """What the staves of one array are, all (P,), stave 0 first.

    gain: of amplitudes, 1 for the median stave; phase: radians; both are of the samples, which are
    to be divided by them. coherence: 0 to 1. noise: variance after that, in that of the median
    stave before. order: which column of the samples is which stave. no_wave: fits no plane wave.
    live: the other staves are masked. sine_std: standard deviation of the direction sine that the
    line of the phases leaves. bins: how many were used, 0 where nothing was measured.
    """

    live: BoolArray
    gain: FloatArray
    phase: FloatArray
    coherence: FloatArray
    noise: FloatArray
    order: IntArray
    no_wave: BoolArray
    sine_std: float = 0.0
    bins: int = 0

    @classmethod
    def exact(cls, staves: int) -> Calibration:
        """An array that is what it is said to be."""
        ones, nothing = np.ones(staves), np.zeros(staves)
        return cls(
            ones > 0.0, ones, nothing, ones, ones, np.arange(staves), np.zeros(staves, bool)
        )

    @property
    def is_exact(self) -> bool:
        """Whether samples stay as they are."""
        same = self.live.all() and (self.gain == 1.0).all() and (self.phase == 0.0).all()
        return bool(same and (self.order == np.arange(len(self.order))).all())

    @property
    def fits(self) -> BoolArray:
        """Staves (P,) that are dead, or fit a plane wave: the others hear something else."""
        return np.where(self.live, ~self.no_wave, np.square(self.gain) < DEAD)

    @property
    def count(self) -> int:
        """How many staves are live."""
        return int(np.count_nonzero(self.live))

    @property
    def weights(self) -> FloatArray | None:
        """What staves count (P,), see `laplace.form_coefficients`: 0 for masked ones, 1 on average
        for the others; None where all count the same."""
        if self.live.all() and (self.noise == self.noise[0]).all():
            return None
        return np.asarray(self.live * self.level / self.noise)

    @property
    def level(self) -> float:
        """The noise that counts, the harmonic mean over live staves."""
        return float(1.0 / np.mean(1.0 / self.noise[self.live]))

    @property
    def mean_noise(self) -> float:
        return float(np.mean(self.noise[self.live]))

    @property
    def log_volume(self) -> float:
        """Logarithm of the product of the noises of live staves, in powers of `level`."""
        return float(np.log(self.noise[self.live] / self.level).sum())

    def heard(self, iq: np.ndarray) -> np.ndarray:
        """The live staves of iq (n, P)."""
        return iq if self.live.all() else iq[:, self.live]

    def power(self, iq: np.ndarray) -> FloatArray:
        """Mean power (n,) of the staves of iq (n, P), as much as each counts."""
        weights = self.weights
        if weights is None:
            return mean_power(iq)
        return np.asarray(np.square(np.abs(iq), dtype=np.float64) @ weights / self.count)

    @property
    def run(self) -> slice:
        """The longest run of live staves."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], self.live, [0]])))
        first, end = edges[::2], edges[1::2]
        longest = int(np.argmax(end - first))
        return slice(int(first[longest]), int(end[longest]))

    def apply(self, iq: np.ndarray) -> np.ndarray:
        """Samples iq (n, P) of an array without these errors; masked staves are zero."""
        if self.is_exact:
            return iq
        factor = np.exp(-1j * self.phase) / np.where(self.live, self.gain, 1.0)
        live = np.where(self.live, iq[:, self.order], 0.0)
        return np.asarray(live * factor.astype(iq.dtype))


def calibrate(
    iq: np.ndarray, usable: BoolArray, spacing: float, noise: FloatArray | None
) -> Calibration:
    """Measure the staves of iq (n, P) from the echoes in the bins that are usable (n,).

    spacing: of the staves in wavelengths; noise (n,): variance at a stave, None where it is not
    known: then the louder half of the bins is used.
    """
    staves = iq.shape[1]
    exact = Calibration.exact(staves)
    if staves < FEWEST_STAVES:
        return exact
    power = np.square(iq.real, dtype=np.float64) + np.square(iq.imag, dtype=np.float64)
    level = np.where(usable, np.median(power, axis=1), 0.0)
    if noise is None:
        loud = level > np.median(level[usable])
    else:
        loud = level > LOUD * noise
    places = np.flatnonzero(loud)
    if len(places) < FEWEST_LOUD:
        return exact
    places = places[np.linspace(0, len(places) - 1, min(len(places), MOST_BINS)).astype(int)]
    # The loudest bins come last.
    places = places[np.argsort(level[places], kind='stable')]
    y = np.asarray(iq[places], np.complex128) / np.sqrt(level[places])[:, None]
    few = y[:: -(-len(y) // FIRST_BINS)]
    found = _staves(few, spacing, np.arange(staves))
    if not found.fits.all():
        found = _exchanged(few, spacing, found)
    if found.no_wave.all():  # most staves agree in nothing: the bins hold no plane waves
        return exact
    if len(few) < len(y) and not (found.is_exact and found.weights is None):
        found = _staves(y, spacing, found.order, found)
    return found


class _Fit:
    """Rounds of directions and staves, of samples y (n, P) whose columns are in order.

    c (P,) the staves, with all their power, so that one of noise does not grow; scale (P,): how
    much of it is echo; z (n, P) the samples without direction and c; coherence (P,); std (P, 2) of
    the logarithms of gain and phase, zero for masked staves.
    """

    def __init__(self, y: ComplexArray, spacing: float, live: BoolArray):
        self.y, self.spacing, self.live = y, spacing, live
        power = np.square(np.abs(y)).mean(axis=0)
        power = np.where(live, power / np.median(power[live]), 1.0)
        self.c = np.sqrt(power).astype(np.complex128)
        self._step = math.inf

    def improve(self, rounds: int) -> None:
        """Do so many rounds at most."""
        for _ in range(rounds):
            if self._step < CONVERGED:
                return
            self._step = self._round()

    def _round(self) -> float:
        n, staves = self.y.shape
        v = np.where(self.live, self.y / self.c, 0.0)
        v /= np.sqrt(np.square(np.abs(v)).sum(axis=1) / self.live.sum())[:, None]
        z = v * np.exp(-1j * _peaks(v, self.spacing)[:, None] * np.arange(staves))
        others = z.sum(axis=1)[:, None] - z
        each = z * others.conj()
        cross, heard = each.mean(axis=0), np.square(np.abs(others)).mean(axis=0)
        self.z, self.others = z, others
        with np.errstate(divide='ignore', invalid='ignore'):
            step = np.where(self.live, cross / heard, 1.0)
            off = np.where(self.live, each / cross - 1.0, 0.0)
        step = np.where(np.abs(step) > 0.0, step, 1.0)
        step /= np.where(self.live, np.median(np.abs(step[self.live])), 1.0)
        std = [np.sqrt(np.square(part).mean(axis=0) / n) for part in (off.real, off.imag)]
        self.std = np.column_stack(std)
        # Where a line remains, the next peaks take it.
        moved = _beside_line(np.angle(step), self.live)[0]
        self.scale = np.abs(step)
        self.c = self.c * step / self.scale
        self.coherence = self.coherence_of(slice(None))
        return float((np.abs(moved) / (self.std[:, 1] + 1e-9))[self.live].max())

    def coherence_of(self, part: slice) -> FloatArray:
        """The correlation (P,) of each stave with the others in part of the bins, zero for masked
        staves."""
        z, others = self.z[part], self.others[part]
        powers = np.square(np.abs(z)).mean(axis=0) * np.square(np.abs(others)).mean(axis=0)
        cross = np.abs((z * others.conj()).mean(axis=0))
        return np.where(self.live, cross / np.sqrt(np.where(powers > 0.0, powers, 1.0)), 0.0)


def _peaks(v: ComplexArray, spacing: float) -> FloatArray:
    """Phase steps (n,) from stave to stave at which v (n, P) is loudest."""
    grid = direction_grid(v.shape[1], spacing)
    phase = phase_step(spacing) * grid
    form = autocorrelation(v)
    form[:, 1:] *= 2.0
    peak, place = np.empty(len(v)), np.empty(len(v))
    row = np.empty(len(grid))
    beam_peaks(form, np.cos(phase), np.sin(phase), row, row.copy(), peak, place)
    return np.asarray(phase[0] + place * (phase[1] - phase[0]))


def _staves(
    y: ComplexArray, spacing: float, order: IntArray, before: Calibration | None = None
) -> Calibration:
    """Measure the staves of y (n, P), their columns taken in this order; those that were masked
    before stay so."""
    y = y[:, order]
    staves = y.shape[1]
    power = np.square(np.abs(y)).mean(axis=0)
    live, heard = power > DEAD * np.median(power), np.zeros(staves)
    if before is not None:
        live, heard = before.live, before.coherence.copy()
    while True:
        fit = _Fit(y, spacing, live)
        for rounds in (2, ROUNDS):
            fit.improve(rounds)
            # One at a time: a loud one spoils the others as well.
            worst = int(np.argmin(np.where(live, fit.coherence, np.inf)))
            deaf = fit.coherence[worst] < NOISE_ONLY * np.median(fit.coherence[live])
            if deaf:
                break
        if not deaf or 2 * np.count_nonzero(live) <= staves:
            break
        heard[worst], live = fit.coherence[worst], live & (np.arange(staves) != worst)
    heard[live] = fit.coherence[live]
    if not np.median(heard[live]) > SURE:
        return evolve(Calibration.exact(staves), coherence=heard, no_wave=live)
    gain = np.where(live, np.abs(fit.c) * fit.scale, np.sqrt(power))
    gain /= np.median(gain[live])
    phase, among = _beside_line(np.angle(fit.c), live)
    least = LEAST + SIGNIFICANT * fit.std
    if not (np.abs(np.log(gain[live])) > least[live, 0]).any():
        gain = np.where(live, 1.0, gain)
    sine_std = 0.0
    if (np.abs(phase) > least[:, 1])[live].any():
        place = np.arange(staves)[among]
        wide = math.sqrt(np.square(place - place.mean()).sum())
        # The line that was taken off is that of phases as large as those that are left: Student's
        # law of n - 2 degrees of freedom has a variance (n - 2) / (n - 4) times theirs.
        size = math.sqrt(np.square(phase[among]).sum() / max(len(place) - 4, 1))
        sine_std = size / (2.0 * math.pi * abs(spacing) * wide)
    else:
        phase = np.zeros(staves)
    # Noise matters less to loud echoes; what fits no wave does not fit loud ones either.
    faint, loud = map(fit.coherence_of, _halves(len(y)))
    steady = 1.0 - loud**2 > STEADY * (1.0 - faint**2)
    no_wave = live & steady & (loud < NO_WAVE * np.median(loud[live]))
    noise = np.ones(staves)
    if 2 * np.count_nonzero(live & steady) < np.count_nonzero(live):
        noise = _noise(fit, gain)
    return Calibration(live, gain, phase, heard, noise, order, no_wave, sine_std, len(y))


def _halves(bins: int) -> tuple[slice, slice]:
    return slice(0, bins // 2), slice(bins // 2, bins)


def _beside_line(phase: FloatArray, live: BoolArray) -> tuple[FloatArray, BoolArray]:
    """What phases (P,) have beside a line, zero for staves that are masked, and which staves are
    near it (P,)."""
    place = np.flatnonzero(live)
    low, high = np.triu_indices(len(place), 1)
    rise = _wrapped(phase[place[high]] - phase[place[low]]) / (place[high] - place[low])
    rest = phase - np.median(rise) * np.arange(len(phase))
    rest = _wrapped(rest - np.angle(np.exp(1j * rest[live]).sum()))
    among = live & (np.abs(rest) < BESIDE_LINE)
    if np.count_nonzero(among) >= 3:
        line = np.polyfit(np.flatnonzero(among), rest[among], 1)
        rest = _wrapped(rest - np.polyval(line, np.arange(len(phase))))
    return np.where(live, rest, 0.0), among


def _wrapped(phase: FloatArray) -> FloatArray:
    return np.asarray(np.angle(np.exp(1j * phase)))


def _noise(fit: _Fit, gain: FloatArray) -> FloatArray:
    """Noise (P,) of the staves, see `Calibration`."""
    staves, live = len(gain), fit.live
    z = fit.z[:, live] / fit.scale[live]
    count = z.shape[1]
    wave = z.mean(axis=1)
    rest = np.square(np.abs(z - wave[:, None])).sum(axis=1) / (count - 1.5)
    with np.errstate(divide='ignore'):
        snr = np.square(np.abs(wave)) / rest
    chosen = (snr > FAINT) & (snr < STRONG)
    if np.count_nonzero(chosen) < FEWEST_FAINT:
        return np.ones(staves)
    turned = z[chosen] * np.exp(-1j * np.angle(wave[chosen]))[:, None]
    place = np.flatnonzero(live).astype(np.float64)
    noise = np.ones(count)
    for _ in range(NOISE_ROUNDS):
        before, noise = noise, _noise_round(turned, place, noise)
        noise /= np.median(noise)
        if np.abs(np.log(noise / before)).max() < 1e-3:
            break
    out, off = np.ones(staves), ALIKE * math.sqrt(SPREAD / np.count_nonzero(chosen))
    differs = np.abs(np.log(noise)) > off
    if differs.any():
        raw = noise * np.square(gain[live])
        out[live] = np.where(differs, noise, 1.0) / np.median(raw)
    return out


def _noise_round(turned: ComplexArray, place: FloatArray, noise: FloatArray) -> FloatArray:
    """Noise (m,) of staves at `place` (m,) from turned (n, m), waves of phase 0 and direction 0,
    given what it was taken for. In phase with the wave the amplitude is fitted, beside it the
    phase and the direction."""
    weight = 1.0 / noise
    total, rest = weight.sum(), np.zeros_like(noise)
    real = turned.real - (turned.real @ weight / total)[:, None]
    centre = place - place @ weight / total
    wide = float(np.square(centre) @ weight)
    beside = turned.imag - (turned.imag @ weight / total)[:, None]
    beside = beside - ((beside * weight) @ centre / wide)[:, None] * centre
    rest = np.square(real) + np.square(beside)
    scale = rest @ weight / (len(noise) - 1.5)
    left = 1.0 - 0.5 * weight * (2.0 / total + np.square(centre) / wide)
    return np.asarray((rest / scale[:, None]).mean(axis=0) / left)


def _exchanged(y: ComplexArray, spacing: float, found: Calibration) -> Calibration:
    """The same with staves exchanged back that fit a plane wave then, if that helps."""
    few, first = y[:: -(-len(y) // TRIED_BINS)], found
    for _ in range(EXCHANGES):
        flagged = np.flatnonzero(~found.fits)
        if not 2 <= len(flagged) <= MOST_EXCHANGED:
            return first
        best, order = 0.0, found.order
        for a, b in combinations(flagged, 2):
            tried = found.order.copy()
            tried[[a, b]] = tried[[b, a]]
            fit = _Fit(few[:, tried], spacing, found.live | ~found.fits)
            fit.improve(1)
            if (mean := float(fit.coherence[flagged].mean())) > best:
                best, order = mean, tried
        found = _staves(y, spacing, order)
        if found.fits.all():
            return found
    return first
