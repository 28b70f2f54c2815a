# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A vertical line array that drifts over a layered floor, in the noise of the sea surface.

The array receives the surface noise directly and as echoes of the layers. `level` says what is
written of a scene:
    csdm      cross-spectra: Wishart samples of the exact ones of `acoustics.ambient`, with red
              noise of ships from the horizontal and noise of the hydrophones;
    response  traces processed from such cross-spectra;
    trace     traces made directly, of pulses and noise in the same band: hundreds per second;
    envelope  of a sub-bottom profiler over a floor that scatters, see `envelope`;
    pressure  time series drawn from the cross-spectral model: for short scenes.

Pressure is drawn over a whole record: at each frequency of its own transform C n, with R = C C^H
and n standard complex normal, and all of it transformed back. Every angle, the exact delays
and what is lost of long lags come by themselves; plane waves summed up at some angles put echoes
too shallow, make them weaker and leave peaks beside them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sonar_imm.acoustics import fathometer
from sonar_imm.acoustics.ambient import horizontal_noise_csdm, sample_csdm, surface_noise_csdm
from sonar_imm.acoustics.pulse import band_pulse, gaussian_pulse
from sonar_imm.estimation.arrays import ComplexArray, FloatArray
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Trace
from sonar_imm.truth import Received, Scene, TrueReflectors

from ..scenario import FIRST_STAMP_NS
from .scenario import Drift, drift_of, FathometerScenario, scenario, SCENARIOS

__all__ = [
    'cross_spectra', 'FathometerScenario', 'pressure_blocks', 'scenario', 'SCENARIOS', 'simulate',
    'stream',
]  # fmt: skip

_THRESHOLD = 3.0
"""Standard deviations of the noise below which a profiler writes zero."""
FRAME_ID = 'array'


def simulate(config: FathometerScenario, seed: int) -> Scene:
    """Run a scene. The same config and seed give the same scene.

    The stamp of a record is that of its last sample. Array depths that are sent beside the records
    have the stamp of their record and come before it.
    """
    records = list(stream(config, seed))
    received = tuple(item for measurements, _ in records for item in measurements)
    return Scene(received, tuple(truth for _, truth in records), frame_id=FRAME_ID)


def stream(
    config: FathometerScenario, seed: int
) -> Iterator[tuple[list[Received], TrueReflectors]]:
    """Like `simulate`, record by record: long scenes of cross-spectra do not fit into memory."""
    rng = np.random.default_rng(seed)
    drift = drift_of(config, rng)
    for record in range(config.records):
        depth = float(drift.array_depth_stated[record])
        stated = None if config.depth_companion else depth
        measurements = _measurements(config, drift, record, stated, rng)
        stamp_ns = measurements[-1].stamp_ns
        received = [Received(item.stamp_ns, item) for item in measurements]
        if config.depth_companion:
            companion = ArrayDepth(stamp_ns=stamp_ns, depth=depth, frame_id=FRAME_ID)
            received.insert(0, Received(stamp_ns, companion))
        here = np.flatnonzero(drift.present[record])
        shown = drift.depth[record, here], drift.amplitude[record, here]
        yield received, TrueReflectors(stamp_ns, FRAME_ID, (1 + here).astype(np.uint32), *shown)


def stamp_of(config: FathometerScenario, record: int) -> int:
    """Time of the last sample of a record."""
    return FIRST_STAMP_NS + round((record + 1) * config.record_seconds * 1e9)


def _measurements(
    config: FathometerScenario, drift: Drift, record: int, stated: float | None, rng: Generator
) -> Sequence[Any]:
    """The measurements of a record, which state a depth of the array."""
    if config.level == 'pressure':
        return pressure_blocks(config, drift, record, stated, rng)
    if config.level == 'csdm':
        return [cross_spectra(config, drift, record, stated, rng)]
    amplitude, sigma = _TRACES[config.level](config, drift, record, rng)
    trace = Trace(
        stamp_ns=stamp_of(config, record),
        frame_id=FRAME_ID,
        depth=_depths(config),
        amplitude=amplitude,
        sigma=None if sigma is None else np.full(len(amplitude), sigma),
        reference_depth=stated,
    )
    return [trace]


def cross_spectra(
    config: FathometerScenario, drift: Drift, record: int, stated: float | None, rng: Generator
) -> CrossSpectra:
    """A sample of the cross-spectra of one record around their expectation. stated: the depth of
    the array that the record states."""
    spacing = 1.0 / config.snapshot_seconds
    first = int(np.ceil(config.frequency_min / spacing - 1e-9))
    last = int(np.floor(config.frequency_max / spacing + 1e-9))
    frequency = spacing * np.arange(first, last + 1, dtype=np.float64)
    R = expected_csdm(config, drift, record, frequency)
    return CrossSpectra(
        stamp_ns=stamp_of(config, record),
        frame_id=FRAME_ID,
        frequency=frequency,
        csdm=sample_csdm(R, config.snapshots, rng),
        snapshots=config.snapshots,
        reference_depth=stated,
    )


def _depths(config: FathometerScenario) -> FloatArray:
    count = int((config.depth_max - config.depth_min) / config.depth_step + 1e-6) + 1
    return config.depth_min + config.depth_step * np.arange(count, dtype=np.float64)


def _response(
    config: FathometerScenario, drift: Drift, record: int, rng: Generator
) -> tuple[FloatArray, float]:
    """What the processor makes of cross-spectra, and its noise."""
    spectra = cross_spectra(config, drift, record, None, rng)
    heights = config.element_spacing * np.arange(config.phones)
    w = fathometer.steering(spectra.frequency, heights, config.sound_speed)
    gamma = fathometer.coherence(spectra.csdm, w, config.processor)
    comb = float(spectra.frequency[0]), 1.0 / config.snapshot_seconds
    where = float(drift.array_depth_stated[record])

    def at(first: float, count: int) -> FloatArray:
        lattice = first, config.depth_step, count
        return fathometer.depth_response(gamma, *comb, lattice, where, config.sound_speed)

    sigma = fathometer.noise_sigma(at(180.0, 2000))
    return at(config.depth_min, len(_depths(config))), sigma


def _pulses(
    config: FathometerScenario, drift: Drift, record: int, rng: Generator
) -> tuple[FloatArray, float]:
    """Pulses, and noise through the same band, with the error of the array's depth."""
    depth, step = _depths(config), config.depth_step
    pulse = band_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
    size = 2 * len(depth)
    frequency = np.fft.rfftfreq(size, 2.0 * step / config.sound_speed)
    band = (frequency >= config.frequency_min) & (frequency <= config.frequency_max)
    spectrum = band * (rng.standard_normal((len(band), 2)) @ np.array([1.0, 1j]))
    noise = np.fft.irfft(spectrum, size)[: len(depth)]
    noise *= config.noise_sigma * size / np.sqrt(4.0 * np.count_nonzero(band))
    shift = drift.array_depth_stated[record] - drift.array_depth[record]
    # The level of an MVDR response falls with the two-way path plus the length of the array.
    height = drift.depth[record] - drift.array_depth[record]
    length = config.phones * config.element_spacing
    level = 12.0 * drift.amplitude[record] / (2.0 * height + length)
    there = pulse(depth[:, None] - drift.depth[record] - shift) @ level
    return there + noise, config.noise_sigma


def pressure_blocks(
    config: FathometerScenario, drift: Drift, record: int, stated: float | None, rng: Generator
) -> list[Pressure]:
    """The pressure of one record in blocks of `block_seconds`, the last ends with the record."""
    pressure = pressure_field(config, drift, record, rng)
    scale = 0.0
    if config.steps_per_sigma:
        scale = float(np.std(pressure)) / config.steps_per_sigma
        # What is stored is a multiple of a number in single precision.
        scale = float(np.float32(scale))
        pressure = np.round(pressure / np.float32(scale)) * np.float32(scale)
    block = max(2, round(config.block_seconds * config.sample_rate))
    end_ns = stamp_of(config, record)
    return [
        Pressure(
            stamp_ns=end_ns - round((len(pressure) - first) / config.sample_rate * 1e9),
            frame_id=FRAME_ID,
            pressure=pressure[first : first + block],
            sample_rate=config.sample_rate,
            reference_depth=stated,
            scale=scale,
        )
        for first in range(0, len(pressure) - 1, block)
    ]


def _envelope(
    config: FathometerScenario, drift: Drift, record: int, rng: Generator
) -> tuple[FloatArray, None]:
    """The stacked envelope (n,) of one record, as a sub-bottom profiler records it over a floor
    that scatters in its volume; it says nothing of its noise.

    The pressure behind an envelope is complex. Each layer answers with the pulse, in a phase that
    is drawn anew for each ping, because the layers are rough. Below the first layer everything
    scatters: a complex Gaussian field, seen through the same pulse, whose rms value falls as
    ``exp(-depth below / scatter_decay)``. Where both overlap they interfere, so that an echo comes
    and goes with the speckle around it. The magnitude is averaged over `stack` pings, and what
    lies below three standard deviations of the receiver's noise is written as zero, as instruments
    do.
    """
    pulse, depth = gaussian_pulse(config.pulse_width), _depths(config)
    n, step = len(depth), config.depth_step
    there = drift.amplitude[record] > 0.0
    place, strength = drift.depth[record, there], drift.amplitude[record, there]
    echo = pulse(depth[:, None] - place) * strength
    below = depth - place.min() if len(place) else np.full(n, -1.0)
    level = config.scatter * np.exp(-np.maximum(below, 0.0) / config.scatter_decay)
    level = np.where(below >= 0.0, level, 0.0)
    reach = int(5.0 * config.pulse_width / step)
    kernel = pulse(step * np.arange(-reach, reach + 1, dtype=np.float64))
    kernel /= np.sqrt(np.sum(np.square(kernel)))
    total = np.zeros(n)
    for _ in range(config.stack):
        phase = np.exp(2j * np.pi * rng.uniform(size=len(place)))
        field = echo @ phase
        field = field + np.convolve(level * _complex_noise(n, rng), kernel, 'same')
        wide = _complex_noise(n + 2 * reach, rng)
        field = field + config.noise_sigma * np.convolve(wide, kernel, 'valid')
        total += np.abs(field)
    return np.maximum(total / config.stack - _THRESHOLD * config.noise_sigma, 0.0), None


_TRACES = {'response': _response, 'trace': _pulses, 'envelope': _envelope}
"""Level: how the amplitudes of its traces are made, and the standard deviation of their noise."""


def _complex_noise(count: int, rng: Generator) -> FloatArray:
    """Of unit power, (count,) complex."""
    return rng.standard_normal((count, 2)) @ np.array([1.0, 1j]) * np.sqrt(0.5)


_AT_ONCE = 2048
"""Frequencies whose matrices are in memory together."""


def expected_csdm(
    config: FathometerScenario, drift: Drift, record: int, frequency: FloatArray
) -> ComplexArray:
    """R (F, M, M) of a record at `frequency` (F,) Hz."""
    there = drift.amplitude[record] != 0.0
    array = config.phones, config.element_spacing
    R = surface_noise_csdm(
        frequency,
        *array,
        drift.depth[record, there] - drift.array_depth[record],
        drift.amplitude[record, there],
        config.sound_speed,
    )
    passing = config.ship_pass and config.ship_pass[0] <= record <= config.ship_pass[1]
    ships = (100.0 if passing else 1.0) * config.ship_noise / (1.0 + (frequency / 200.0) ** 2)
    R += ships[:, None, None] * horizontal_noise_csdm(frequency, *array, 0.03, config.sound_speed)
    R += config.phone_noise * np.eye(config.phones)
    if not config.whitened:
        # Surface noise is red: it falls by 5 dB per octave.
        R *= ((frequency / 1000.0) ** -1.6)[:, None, None]
    return R


def pressure_field(
    config: FathometerScenario, drift: Drift, record: int, rng: Generator
) -> NDArray[np.float32]:
    """Pressure (n, M) of one record; a two-sided spectrum of R."""
    length = round(config.record_seconds * config.sample_rate)
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / config.sample_rate), np.float64)
    low, high = 0.5 * config.frequency_min, 1.2 * config.frequency_max
    inside = np.flatnonzero((frequency >= low) & (frequency <= high))
    spectra = np.zeros((len(frequency), config.phones), np.complex64)
    for rows in np.split(inside, range(_AT_ONCE, len(inside), _AT_ONCE)):
        root = np.linalg.cholesky(expected_csdm(config, drift, record, frequency[rows]))
        noise = rng.standard_normal((len(rows), config.phones, 2)) @ np.array([1.0, 1j])
        spectra[rows] = np.sqrt(0.5) * (root @ noise[..., None])[..., 0]
    pressure = np.fft.irfft(spectra, length, axis=0) * np.sqrt(length)
    return pressure.astype(np.float32)
