# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From the record of an array or a profiler to one row of numbers: its depth response.

A `Lattice` of depths is laid out at the first record and kept. Every record, wherever the array
was, is put onto it: its `Response` is what the particles are weighed by. Traces come as they are;
of an array the cross-spectra are looked at upward and downward at once, and correlated.

An envelope, such as sub-bottom profilers record, is never negative, and has the pulse and the
noise of an envelope: `Water` makes normal numbers of it. How wide the pulse is and what noise
there is depend on the instrument; the rest is common (`envelope_parameters`).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from attrs import evolve, field, frozen
import numpy as np
from numpy.typing import NDArray

from ...acoustics import fathometer
from ...acoustics.hydrophones import correct_phones
from ...acoustics.pulse import (
    band_pulse,
    envelope_pulse,
    gaussian_pulse,
    measured_pulse,
    Pulse,
    SampledPulse,
)
from ...acoustics.spectra import noise_taper
from ...estimation.arrays import FloatArray
from ...estimation.set_model import walk_reach
from ...estimation.set_shifts import Jump, MAX_SHIFTS, Shift
from ...measurements import CrossSpectra, Rejection, Trace
from ...parameters import ConfigError, small_text
from .config import FathometerConfig
from .noise import LEAST_NOISE_SAMPLES, measured_sigma, mirror_sigma, stated_sigma
from .water import SeenFloor, Water

MAX_CELLS = 100_000
MAX_MOVES = 8_000_000
"""Of a lattice: cells times the cells that a reflector can move to. Each takes 16 bytes in the
tables of moves, 32 where reflectors of either sign are looked for."""
LEAST_SHIFT, MORE_ROOM = 0.02, 0.25
"""Shares of the window of a trace: by how much it shifts to count, and what room is made."""
MAX_SIGMAS = 1e6
LOUDEST = 1e100
"""Of a trace, whatever its unit: squares of what is louder are beyond numbers."""
_JUMP_STEP, _JUMP_REACH = 1.0 / 16.0, 4.0 / 1.5
"""Of the grid of jumps, m, and how far they reach, in standard deviations."""
_SINGULAR = 'the cross-spectral matrices are singular: use more loading or more snapshots'
_PHASES = 4
"""At how many depths the phase of an echo is found."""


@frozen
class Lattice:
    """Depths ``first + step * (0 .. cells - 1)``, m, of records of so many hydrophones, 0 for
    traces."""

    first: float
    step: float
    cells: int
    hydrophones: int = 0

    @property
    def depth(self) -> FloatArray:
        return self.first + self.step * np.arange(self.cells, dtype=np.float64)

    def require(self, config: FathometerConfig) -> None:
        """Raise ValueError where no lattice of `config` would have been made like that."""
        last = self.first + self.step * (self.cells - 1)
        if self.step <= 0.0 or _checked(self.first, self.step, last, config).cells != self.cells:
            raise ValueError('no lattice is like that')

    def padded(self, cells: int) -> Lattice:
        """With so many more cells at either end."""
        return Lattice(self.first - cells * self.step, self.step, self.cells + 2 * cells)


@frozen(eq=False)
class Response:
    """The depth response of one record.

    depth, amplitude, sigma (n,): on the lattice, with the standard deviation of the noise.
    reference_depth: of the array, m, NaN when not known. aperture: length of the array, m, 0 for
    traces; snapshot_seconds: of what was averaged, 0 for traces. pulse: of this record, None for
    the one that is configured. noise_unknown: sigma is that of the whole trace, reflectors
    included. phones (4, M): gain in dB, sign, delay in s and share of each hydrophone before it
    was corrected, NaN where it was not looked at, see `acoustics.hydrophones`. noise_wraps: the
    depths that are configured for noise reach beyond half a snapshot. Of an envelope the amplitude
    is a normal number: rms (n,) is the noise and scatter that it is seen against, in the unit of
    the trace, empty for other records; floor: see `SeenFloor`.
    """

    stamp_ns: int
    frame_id: str
    depth: Annotated[FloatArray, 'd'] = field(repr=False)
    amplitude: Annotated[FloatArray, 'd'] = field(repr=False)
    sigma: Annotated[FloatArray, 'd'] = field(repr=False)
    reference_depth: float = np.nan
    aperture: float = 0.0
    snapshot_seconds: float = 0.0
    pulse: SampledPulse | None = field(default=None, repr=False)
    noise_unknown: bool = False
    noise_wraps: bool = False
    phones: Annotated[FloatArray, '4m'] = field(factory=lambda: np.empty((4, 0)), repr=False)
    rms: Annotated[FloatArray, 'r'] = field(factory=lambda: np.empty(0), repr=False)
    floor: SeenFloor | None = field(default=None, repr=False)

    @property
    def noise(self) -> float:
        """Median of the noise over the depths, in the unit of the record."""
        return float(np.median(self.rms if len(self.rms) else self.sigma))

    def onto(self, padded: Lattice) -> Response:
        """The same at other depths of the same step and centre; nothing is known of new ones."""
        more = (padded.cells - len(self.depth)) // 2
        cells = slice(max(-more, 0), len(self.depth) - max(-more, 0))
        sigma = np.pad(self.sigma[cells], max(more, 0), 'edge')
        amplitude = np.pad(self.amplitude[cells], max(more, 0))
        return evolve(self, depth=padded.depth, amplitude=amplitude, sigma=sigma)


def pulse_of(config: FathometerConfig) -> Pulse:
    """The pulse that is configured, that of the band where each record has its own.
    Raises `ConfigError` for a file that cannot be used."""
    if config.pulse in ('auto', 'band', 'processor'):
        return band_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
    if config.pulse == 'envelope':
        return envelope_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
    if config.pulse == 'gaussian':
        return gaussian_pulse(config.pulse_width)
    try:
        rows = small_text(Path(config.pulse_file), 'utf-8-sig').split('\n')
        # The first line may name the columns.
        named = any(character.isalpha() for character in rows[0].replace('e', ''))
        table = [[float(cell) for cell in row.split(',')] for row in rows[named:] if row.strip()]
        return measured_pulse([row[0] for row in table], [row[1] for row in table])
    except OSError as error:
        raise ConfigError(f'pulse_file {config.pulse_file}: {error.strerror}') from None
    except IndexError:
        raise ConfigError(f'pulse_file {config.pulse_file}: two columns are needed') from None
    except ValueError as error:
        raise ConfigError(f'pulse_file {config.pulse_file}: {str(error)[:200]}') from None


def lattice_of_trace(trace: Trace, config: FathometerConfig) -> Lattice:
    """The depths of the trace that lie in the window; more of them where reflectors move too
    little for its own. Raises `Rejection` when none do."""
    low, high = _window(config, (trace.depth[0], trace.depth[-1]))
    step = config.depth_step
    if not step:
        step = trace.step / np.ceil(0.5 * trace.step / config.depth_std)
    first = trace.depth[0] + step * np.ceil((low - trace.depth[0]) / step - 1e-6)
    return _checked(float(first), float(step), min(high, float(trace.depth[-1])), config)


def widened(lattice: Lattice, trace: Trace, config: FathometerConfig) -> Lattice | None:
    """Lattice with room for a trace whose window has shifted, None where it has room, lies further
    away than it is long, or depths are configured. Raises `Rejection` for too many depths."""
    low, high = float(trace.depth[0]), float(trace.depth[-1])
    last = lattice.first + lattice.step * (lattice.cells - 1)
    least = max(lattice.step, LEAST_SHIFT * (high - low))
    if config.depth_max or (low > lattice.first - least and high < last + least):
        return None
    if low > 2.0 * last - lattice.first or high < 2.0 * lattice.first - last:
        return None
    # More than it takes: the window may go on shifting.
    room = MORE_ROOM * (high - low)
    above = math.ceil((lattice.first - low + room) / lattice.step) if low < lattice.first else 0
    end = high + room if high > last else last
    first = lattice.first - max(above, 0) * lattice.step
    return evolve(_checked(first, lattice.step, end, config), hydrophones=lattice.hydrophones)


def lattice_of_array(reference_depth: float, config: FathometerConfig) -> Lattice:
    """The depths in the window. Raises `Rejection` when there are none."""
    low, high = depths_wanted(config, reference_depth)
    step = config.depth_step or config.sound_speed / (12.0 * config.frequency_max)
    return _checked(low, step, high, config)


def depths_wanted(config: FathometerConfig, reference_depth: float) -> tuple[float, float]:
    """First and last depth to be tracked below an array, m."""
    return _window(config, (reference_depth + 10.0, reference_depth + 110.0))


def _checked(first: float, step: float, high: float, config: FathometerConfig) -> Lattice:
    wanted = (high - first) / step + 1.0 + 1e-6
    if not wanted >= 2.0:
        raise Rejection('other_depths', 'the record does not reach the depths to be tracked')
    # With heave the record is needed further up and down.
    padded = wanted + (9.0 * config.array_depth_std / step if config.heave != 'none' else 0.0)
    if padded > MAX_CELLS:
        raise Rejection(
            'too_large',
            f'the depths to be tracked make {padded:.0f} steps of {step:g} m; {MAX_CELLS} at most',
        )
    reach = walk_reach(config.depth_std / step)
    if padded * (2.0 * reach + 1.0) > MAX_MOVES:
        raise Rejection(
            'too_large',
            f'{padded:.0f} steps of {step:g} m, from each of which a reflector can move by '
            f'{reach:.0f} (depth_std {config.depth_std:g} m), are '
            f'{padded * (2.0 * reach + 1.0):.3g} moves; {MAX_MOVES} at most: use a greater '
            'depth_step or fewer depths',
        )
    return Lattice(first, step, int(wanted))


def _window(config: FathometerConfig, otherwise: tuple[float, float]) -> tuple[float, float]:
    return (config.depth_min, config.depth_max) if config.depth_max else otherwise


def heave_shift(config: FathometerConfig, step: float) -> Shift | None:
    """The heave as a shift in cells of `step` m: on a grid that is finer than reflectors move and
    than the heave changes."""
    if config.heave == 'none':
        return None
    memory = config.heave_memory if config.heave == 'memory' else 0.0
    std = config.array_depth_std / step
    fine = min(config.depth_std / step / 3.0, 0.5 * std * np.sqrt(1.0 - memory**2))
    return Shift(std=std, memory=memory, step=int(max(1.0, fine, np.ceil(4.0 * std / 200.0))))


def common_jump(config: FathometerConfig, step: float) -> Jump | None:
    """The jump of all reflectors in cells of `step` m, on a grid that walks reach between."""
    if config.heave != 'none' or not config.common_jump_probability:
        return None
    reach = _JUMP_REACH * config.common_jump_std / step
    grid = int(max(1.0, np.round(_JUMP_STEP / step), np.ceil(reach / (MAX_SHIFTS // 2))))
    return Jump(
        probability=config.common_jump_probability,
        std=config.common_jump_std / step,
        step=grid,
        reach=max(1, round(reach / grid)),
    )


def trace_response(
    trace: Trace, lattice: Lattice, config: FathometerConfig, reference_depth: float, water: Water
) -> Response:
    """Put a trace onto the lattice; where it does not reach, the response is zero. Raises
    `Rejection` when it has no noise to compare with, or lies elsewhere."""
    amplitude = np.where(np.isfinite(trace.amplitude), trace.amplitude, 0.0)
    loudest = float(np.max(np.abs(amplitude)))
    if trace.sigma is not None:
        loudest = float(np.max(trace.sigma[np.isfinite(trace.sigma)], initial=loudest))
    if loudest > LOUDEST:
        raise Rejection(
            'out_of_range', f'the trace holds {loudest:.3g}; {LOUDEST:g} is possible at most'
        )
    depth = lattice.depth
    if depth[0] > trace.depth[-1] or depth[-1] < trace.depth[0]:
        raise Rejection('other_depths', 'the trace lies outside of the depths that are tracked')
    if water.active:
        return _envelope_response(trace, lattice, config, reference_depth, water)
    quiet = (trace.depth >= config.noise_depth_min) & (trace.depth <= config.noise_depth_max)
    quiet &= np.isfinite(trace.amplitude)
    if np.count_nonzero(quiet) < LEAST_NOISE_SAMPLES:
        quiet = np.isfinite(trace.amplitude)
    sigma, noise_unknown = stated_sigma(trace, depth, config.noise_sigma), False
    if sigma is None:
        sigma = np.full(len(depth), measured_sigma(amplitude[quiet]))
        noise_unknown = config.noise_from_mirror
    return Response(
        trace.stamp_ns,
        trace.frame_id,
        depth,
        np.interp(depth, trace.depth, amplitude, left=0.0, right=0.0),
        sigma,
        reference_depth,
        noise_unknown=noise_unknown,
    )


def _envelope_response(
    trace: Trace, lattice: Lattice, config: FathometerConfig, reference_depth: float, water: Water
) -> Response:
    """An envelope as normal numbers against its noise and the scatter below its floor."""
    known = trace.amplitude[np.isfinite(trace.amplitude)]
    if not np.ptp(known) > 0.0:
        raise Rejection('no_noise', 'the record has no noise to compare its peaks with')
    b, scale, floor = water.take(trace)
    depth, own = lattice.depth, water.depth
    pulse = None
    if config.pulse == 'auto':
        lag = 0.25 * lattice.step * np.arange(4 * lattice.cells, dtype=np.float64)
        pulse = SampledPulse(lag, gaussian_pulse(water.pulse_width)(lag))
    return Response(
        trace.stamp_ns,
        trace.frame_id,
        depth,
        np.interp(depth, own, b, left=0.0, right=0.0),
        np.ones(len(depth)),
        reference_depth,
        pulse=pulse,
        rms=np.interp(depth, own, scale),
        floor=floor,
    )


def residual_sigma(response: Response, fitted: FloatArray) -> Response:
    """`response` with the noise that is left where the reflectors' own response `fitted` (n,) is
    taken off; as it was when that has no noise."""
    reached = response.amplitude != 0.0
    try:
        sigma = measured_sigma((response.amplitude - fitted)[reached])
    except Rejection:
        return response
    return evolve(response, sigma=np.full(len(response.depth), sigma))


def array_response(
    record: CrossSpectra,
    lattice: Lattice,
    config: FathometerConfig,
    reference_depth: float,
) -> Response:
    """Look up and down with the array and correlate. Raises `Rejection` ('bad_band',
    'bad_frequency', 'singular', 'no_noise')."""
    below = lattice.depth - reference_depth
    coherence = array_coherence(record, config, below)
    gamma, first, spacing, aperture = coherence[:4]
    seconds = config.snapshot_seconds or 1.0 / spacing
    # Lags beyond half a snapshot are those of the other side, and what is heard of the array
    # itself at lag zero.
    half = 0.25 * config.sound_speed * min(seconds, 1.0 / spacing)
    wraps = not config.noise_from_mirror and config.noise_depth_max - reference_depth > half
    pulse = None
    if config.pulse == 'processor' and config.processor == 'mvdr':
        coherent = coherence._replace(weight=coherence.weight * coherence.share)
        pulse = processor_pulse(coherent, lattice, config.sound_speed)

    def at(
        low: float,
        step: float,
        count: int,
        *,
        envelope: bool = False,
        turn: float | NDArray[np.complexfloating] = 1.0,
    ) -> FloatArray:
        return fathometer.depth_response(
            turn * gamma,
            first,
            spacing,
            (low, step, count),
            reference_depth,
            config.sound_speed,
            envelope=envelope,
        )

    def taper(depth: FloatArray) -> FloatArray:
        way = 2.0 * (depth - reference_depth) / config.sound_speed
        return noise_taper(config.window, config.overlap, way / seconds)

    # The noise of an envelope is that of the response: its own scatter is less.
    depths, b = (lattice.first, lattice.step, lattice.cells), np.zeros(lattice.cells)
    # The phase of an echo goes with 1 / depth: in between, responses are interpolated in that.
    inverse = 1.0 / np.maximum(below, aperture or 1.0)
    for turn, unit in zip(coherence.turns, np.eye(len(coherence.turns))):
        share = np.interp(inverse, coherence.inverse, unit)
        b += share * at(*depths, envelope=config.envelope, turn=turn)
    # Nearer than its own length the array hears itself.
    b[lattice.depth - reference_depth < aperture] = 0.0
    sigma = np.full(lattice.cells, config.noise_sigma)
    if not config.noise_sigma and (wraps or config.noise_from_mirror):
        sigma = mirror_sigma(at, below, lattice.step, reference_depth, aperture, half)
    elif not config.noise_sigma:
        span = config.noise_depth_max - config.noise_depth_min
        step = max(lattice.step, span / MAX_CELLS)
        low = max(config.noise_depth_min, reference_depth + 2.0 * aperture)
        quiet = Lattice(low, step, max(int(span / step), LEAST_NOISE_SAMPLES))
        # The deeper, the less is left of the noise, too: it is measured deeper than it is needed.
        flat = at(quiet.first, quiet.step, quiet.cells) / taper(quiet.depth)
        sigma = measured_sigma(flat) * taper(lattice.depth)
    return Response(
        record.stamp_ns,
        record.frame_id,
        lattice.depth,
        b,
        sigma,
        reference_depth,
        aperture,
        seconds,
        pulse,
        phones=coherence.phones,
        noise_wraps=wraps and not config.noise_sigma,
    )


def processor_pulse(
    coherence: ArrayCoherence, lattice: Lattice, sound_speed: float
) -> SampledPulse:
    """The pulse that the processor leaves of a reflector, by its spectrum: a table over all lags
    of the lattice, four to a cell."""
    step, count = 0.25 * lattice.step, 4 * lattice.cells
    spectrum = np.where(np.isfinite(coherence.gamma), coherence.weight, np.nan).astype(
        np.complex128
    )
    value = fathometer.depth_response(
        spectrum, coherence.first, coherence.spacing, (0.0, step, count), 0.0, sound_speed
    )
    return SampledPulse(step * np.arange(count, dtype=np.float64), value / value[0])


class ArrayCoherence(NamedTuple):
    """gamma (F,) at the frequencies ``first + spacing * row``, NaN where there is none; first and
    spacing in Hz; aperture: length of the array, m; weight (F,): the spectrum of an echo, NaN as
    gamma, if all noise were the surface's and the matrices exact; share (F,): by what it is less
    than that; turns (K, F): what takes the phase of `fathometer.echo_phase` off echoes from 1 /
    inverse (K,) m below the array; one, and one row of ones, where it is left; phones (4, M): see
    `Response`."""

    gamma: NDArray[np.complexfloating]
    first: float
    spacing: float
    aperture: float
    weight: FloatArray
    share: FloatArray
    turns: NDArray[np.complexfloating]
    inverse: FloatArray
    phones: FloatArray


def array_coherence(
    record: CrossSpectra, config: FathometerConfig, below: FloatArray | None = None
) -> ArrayCoherence:
    """What the array hears from above and below at once; below (n,): where echoes are looked for,
    m below hydrophone 0, rising. Raises `Rejection`."""
    rows = np.flatnonzero(
        (record.frequency >= config.frequency_min - 1e-6)
        & (record.frequency <= config.frequency_max + 1e-6)
    )
    if len(rows) < 2:
        raise Rejection(
            'bad_band',
            f'{len(rows)} frequencies lie between {config.frequency_min:g} Hz and '
            f'{config.frequency_max:g} Hz; 2 are needed',
        )
    index, spacing = _comb(record.frequency[rows])
    use = record.usable[rows]
    if not use.any():
        raise Rejection('nan', 'no frequency of the band has only finite, positive powers')
    if config.processor == 'mvdr' and config.loading < 1e-9 and rank_deficient(record):
        raise Rejection('singular', _SINGULAR)
    alive = np.flatnonzero(record.alive)
    csdm, scale = _near_one(record.csdm[rows[use]][:, alive[:, None], alive])
    csdm, alive, phones = _equal_phones(csdm, record.frequency[rows[use]], alive, record, config)
    heights = config.element_spacing * alive
    w = fathometer.steering(record.frequency[rows[use]], heights, config.sound_speed)
    try:
        found, power = _both_beams(csdm, scale, w, config)
    except np.linalg.LinAlgError:
        found, power = np.full(len(csdm), np.nan), np.full(len(csdm), np.nan)
    if config.output == 'coherence':
        # A coherence above one is rounding: nothing was left of the matrix.
        found[np.abs(found) > 1.0 + 1e-6] = np.nan
    if not np.isfinite(found).any():
        raise Rejection('singular', _SINGULAR)
    gamma = np.full(index[-1] + 1, np.nan, np.complex128)
    gamma[index[use]] = found
    weight, there = np.full(len(gamma), np.nan), np.isfinite(found)
    frequency = record.frequency[rows[use]]
    weight[index[use][there]] = fathometer.echo_spectrum(
        csdm[there], frequency[there], power[there]
    )
    aperture = float(heights[-1] - heights[0])
    share = np.ones(len(gamma))
    turns, inverse = np.ones((1, len(gamma)), np.complex128), np.ones(1)
    processor = config.pulse == 'processor' and config.processor == 'mvdr' and len(heights) > 1
    if processor:
        share[index[use][there]] = fathometer.surface_share(
            csdm[there], frequency[there], heights, config.sound_speed
        )
    if processor and record.snapshots > 0.0:
        share[index[use][there]] *= fathometer.sampled_share(
            csdm[there], config.loading, record.snapshots
        )
    if processor and below is not None and config.output != 'printed':
        far, near = (1.0 / max(float(below[k]), aperture) for k in (-1, 0))
        inverse = np.linspace(far, near, _PHASES)
        phase = fathometer.echo_phase(
            csdm[there],
            frequency[there],
            heights,
            1.0 / inverse,
            config.sound_speed,
            config.loading,
        )
        turns = np.ones((_PHASES, len(gamma)), np.complex128)
        turns[:, index[use][there]] = np.exp(-1j * phase)
    first = float(record.frequency[rows[0]])
    return ArrayCoherence(gamma, first, spacing, aperture, weight, share, turns, inverse, phones)


def _equal_phones(
    csdm: NDArray[np.complexfloating],
    frequency: FloatArray,
    alive: NDArray[np.int64],
    record: CrossSpectra,
    config: FathometerConfig,
) -> tuple[NDArray[np.complexfloating], NDArray[np.int64], FloatArray]:
    """The cross-spectra as of equal hydrophones, those of `alive` that are kept, and what was
    found of all of the record, see `Response.phones`."""
    phones = np.full((4, record.hydrophones), np.nan)
    if config.phone_correction == 'off':
        return csdm, alive, phones
    full = config.phone_correction == 'full'
    wave = config.sound_speed / config.element_spacing
    csdm, keep, fit = correct_phones(
        csdm, frequency, alive, wave, config.phone_least_share, full=full
    )
    gain_db = 10.0 * np.log10(np.median(fit.gain, axis=0))
    phones[:, alive] = np.stack([gain_db, fit.sign, fit.delay, fit.share])
    return csdm, alive[keep], phones


def _near_one(
    csdm: NDArray[np.complexfloating],
) -> tuple[NDArray[np.complexfloating], FloatArray]:
    """`csdm` over `scale` (F,), powers of two that bring the mean power of a hydrophone near one.
    No digit changes, but products of powers stay inside single precision in any unit."""
    power = np.einsum('fmm->fm', csdm).real.mean(axis=1, dtype=np.float64)
    scale = np.exp2(np.clip(np.frexp(power)[1], -120, 120))
    return csdm * (1.0 / scale).astype(csdm.real.dtype)[:, None, None], scale


def _both_beams(
    csdm: NDArray[np.complexfloating],
    scale: FloatArray,
    w: NDArray[np.complexfloating],
    config: FathometerConfig,
) -> tuple[NDArray[np.complexfloating], FloatArray]:
    """The output of the processor (F,) for ``scale * csdm``, and the root of the powers of its
    beams (F,) for `csdm`."""
    if config.output == 'printed':
        found = fathometer.printed_correlation(csdm, w, config.processor, loading=config.loading)
        return found * scale, 1.0 / scale
    gamma, power = fathometer.coherence_and_power(
        csdm, w, config.processor, loading=config.loading, gain_db=config.white_noise_gain_db
    )
    return (gamma if config.output == 'coherence' else gamma * power * scale), power


def rank_deficient(record: CrossSpectra) -> bool:
    """True when the matrix in the middle of the band says less than its size: fewer snapshots than
    hydrophones, or hydrophones that hear the same."""
    middle = np.flatnonzero(record.usable)[record.usable.sum() // 2]
    values = np.linalg.eigvalsh(record.csdm[middle][np.ix_(record.alive, record.alive)])
    return bool(values[0] < 1e-6 * values[-1])


def _comb(frequency: FloatArray) -> tuple[NDArray[np.int64], float]:
    """Whole numbers (F,), from 0 on, and the spacing they multiply."""
    apart = np.diff(frequency)
    steps = np.round(apart / np.min(apart))
    # The smallest of many distances in single precision is too small: round twice.
    steps = np.round(apart / (apart[steps == 1.0].mean()))
    index = np.append(0, np.cumsum(steps)).astype(np.int64)
    spacing = float(frequency[-1] - frequency[0]) / float(index[-1])
    if index[-1] > 1_000_000 or (
        np.abs(frequency - frequency[0] - spacing * index).max() > 0.01 * spacing
    ):
        raise Rejection('bad_frequency', 'the frequencies are no multiples of one spacing')
    return index, spacing


def envelope_parameters(
    pulse_width: float, noise_sigma: float, window: float = np.inf
) -> dict[str, Any]:
    """Parameters of the tracker by name, for a pulse of standard deviation `pulse_width`, m, and
    noise of `noise_sigma`, in the units of the record, 0 where each record states it; window: of
    the depths, m."""
    # Two pulses nearer than that make one hump.
    separation = 3.0 * pulse_width
    return {
        'pulse': 'gaussian',
        'pulse_width': pulse_width,
        'noise_sigma': noise_sigma,
        'min_separation': separation,
        # Records come several a second and the floor slopes; 1.4 m a record can be followed.
        'depth_std': 0.35,
        'order_max': max(1, int(min(window / separation, 6.0))),
    }
