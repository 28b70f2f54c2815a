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

"""From the cross-spectra of an array to the depth response of a record, its noise and pulse."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...acoustics import fathometer
from ...acoustics.pulse import Pulse, SampledPulse
from ...acoustics.spectra import noise_taper
from ...estimation.arrays import FloatArray
from ...measurements import CrossSpectra, Rejection
from .config import FathometerConfig
from .response import Lattice, LEAST_NOISE_SAMPLES, MAX_CELLS, measured_sigma, Response

_SINGULAR = 'the cross-spectral matrices are singular: use more loading or more snapshots'


def array_response(
    record: CrossSpectra,
    lattice: Lattice,
    config: FathometerConfig,
    reference_depth: float,
    *,
    mirrored: bool = False,
) -> Response:
    """Look up and down with the array and correlate. mirrored: noise is measured in the mirror
    window even where depths are configured for it. Raises `Rejection` ('bad_band',
    'bad_frequency', 'singular', 'no_noise')."""
    heard = array_coherence(record, config)
    gamma, first, spacing, aperture = heard[:4]
    seconds = config.snapshot_seconds or 1.0 / spacing
    pulse = None
    if config.pulse == 'processor' and config.processor == 'mvdr':
        pulse = processor_pulse(heard, lattice, config.sound_speed)

    def at(low: float, step: float, count: int, *, envelope: bool = False) -> FloatArray:
        return fathometer.depth_response(
            gamma,
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
    b = at(lattice.first, lattice.step, lattice.cells, envelope=config.envelope)
    # Nearer than its own length the array hears itself.
    b[lattice.depth - reference_depth < aperture] = 0.0
    sigma = np.full(lattice.cells, config.noise_sigma)
    if not config.noise_sigma and (mirrored or config.noise_from_mirror):
        sigma[:] = mirror_sigma(at, lattice, reference_depth, aperture)
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
    )


def processor_pulse(heard: ArrayCoherence, lattice: Lattice, sound_speed: float) -> Pulse:
    """The pulse that the processor leaves of a reflector, by its spectrum: a table over all lags
    of the lattice, four to a cell."""
    step, count = 0.25 * lattice.step, 4 * lattice.cells
    spectrum = np.where(np.isfinite(heard.gamma), heard.weight, np.nan).astype(np.complex128)
    value = fathometer.depth_response(
        spectrum, heard.first, heard.spacing, (0.0, step, count), 0.0, sound_speed
    )
    return SampledPulse(step * np.arange(count), value / value[0])


def mirror_sigma(
    at: Callable[[float, float, int], FloatArray],
    lattice: Lattice,
    reference_depth: float,
    aperture: float,
) -> float:
    """Noise of a response where it holds no echo: at the lags of the lattice, negative, that is at
    the depths 2 reference_depth - z. It fades there as it does on the lattice. Left out: what is
    nearer than the aperture. at(first, step, count): the response."""
    # A short lattice is made longer.
    count = max(lattice.cells, 4 * LEAST_NOISE_SAMPLES)
    first = 2.0 * reference_depth - lattice.first - lattice.step * (count - 1)
    depth = first + lattice.step * np.arange(count)
    quiet = reference_depth - depth >= aperture
    if np.count_nonzero(quiet) < LEAST_NOISE_SAMPLES:
        raise Rejection('no_noise', 'nothing of the mirrored depths is free of the array itself')
    noise = at(first, lattice.step, count)[quiet]
    # The noise of a coherence has mean zero: no median of it is taken off.
    return measured_sigma(np.append(noise, -noise))


class ArrayCoherence(NamedTuple):
    """gamma (F,) at the frequencies ``first + spacing * row``, NaN where there is none; first and
    spacing in Hz; aperture: length of the array, m; weight (F,): the spectrum of an echo, NaN as
    gamma."""

    gamma: NDArray[np.complexfloating]
    first: float
    spacing: float
    aperture: float
    weight: FloatArray


def array_coherence(record: CrossSpectra, config: FathometerConfig) -> ArrayCoherence:
    """What the array hears from above and below at once. Raises `Rejection`."""
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
    heights = config.element_spacing * alive
    csdm = record.csdm[rows[use]][:, alive[:, None], alive]
    w = fathometer.steering(record.frequency[rows[use]], heights, config.sound_speed)
    try:
        heard, power = _both_beams(csdm, w, config)
    except np.linalg.LinAlgError:
        heard, power = np.full(len(csdm), np.nan), np.full(len(csdm), np.nan)
    if config.output == 'coherence':
        # A coherence above one is rounding: nothing was left of the matrix.
        heard[np.abs(heard) > 1.0 + 1e-6] = np.nan
    if not np.isfinite(heard).any():
        raise Rejection('singular', _SINGULAR)
    gamma = np.full(index[-1] + 1, np.nan, np.complex128)
    gamma[index[use]] = heard
    weight, there = np.full(len(gamma), np.nan), np.isfinite(heard)
    frequency = record.frequency[rows[use]]
    weight[index[use][there]] = fathometer.echo_spectrum(
        csdm[there], frequency[there], power[there]
    )
    aperture = float(heights[-1] - heights[0])
    return ArrayCoherence(gamma, float(record.frequency[rows[0]]), spacing, aperture, weight)


def _both_beams(
    csdm: NDArray[np.complexfloating], w: NDArray[np.complexfloating], config: FathometerConfig
) -> tuple[NDArray[np.complexfloating], FloatArray]:
    """The output of the processor (F,), and the root of the powers of its beams (F,)."""
    if config.output == 'printed':
        found = fathometer.printed_correlation(csdm, w, config.processor, loading=config.loading)
        return found, np.ones(len(found))
    gamma, power = fathometer.coherence_and_power(
        csdm, w, config.processor, loading=config.loading, gain_db=config.white_noise_gain_db
    )
    return (gamma if config.output == 'coherence' else gamma * power), power


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
