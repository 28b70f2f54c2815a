"""A vertical line array that drifts over a layered floor, in the noise of the sea surface.

The array receives the surface noise directly and as echoes of the layers. `level` says what is
written of a scene:
    csdm      cross-spectra: Wishart samples of the exact ones of `acoustics.ambient`, with red
              noise of ships from the horizontal and noise of the hydrophones;
    response  traces processed from such cross-spectra;
    trace     traces made directly, of pulses and noise in the same band: hundreds per second;
    envelope  of a sub-bottom profiler over a floor that scatters, see `envelope`;
    pressure  time series from many plane waves: slow, for short scenes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...acoustics import fathometer
from ...acoustics.ambient import horizontal_noise_csdm, sample_csdm, surface_noise_csdm
from ...acoustics.pulse import band_pulse
from ...estimation.arrays import FloatArray
from ...measurements import ArrayDepth, CrossSpectra, Pressure, Trace
from ..scene import Received, Scene, TrueReflectors
from .envelope import envelope
from .scenario import Drift, drift_of, FathometerScenario, PRESENT, scenario, SCENARIOS

__all__ = [
    'cross_spectra',
    'FathometerScenario',
    'PRESENT',
    'scenario',
    'SCENARIOS',
    'simulate',
    'stream',
]

FIRST_STAMP_NS = 1_700_000_000_000_000_000
FRAME_ID = 'array'


def simulate(config: FathometerScenario, seed: int) -> Scene:
    """Run a scene. The same config and seed give the same scene.

    The stamp of a record is that of its last sample. Array depths that are sent beside the records
    have the stamp of their record and come before it.
    """
    records = list(stream(config, seed))
    received = tuple(one for measurements, _ in records for one in measurements)
    return Scene(received, tuple(truth for _, truth in records), frame_id=FRAME_ID)


def stream(
    config: FathometerScenario, seed: int
) -> Iterator[tuple[list[Received], TrueReflectors]]:
    """Like `simulate`, record by record: long scenes of cross-spectra do not fit into memory."""
    rng = np.random.default_rng(seed)
    drift = drift_of(config, rng)
    for record, measurements in enumerate(_measurements(config, drift, rng)):
        stamp_ns = measurements[-1].stamp_ns
        received = [Received(one.stamp_ns, one) for one in measurements]
        if config.depth_companion:
            depth = float(drift.array_depth_told[record])
            companion = ArrayDepth(stamp_ns=stamp_ns, depth=depth, frame_id=FRAME_ID)
            received.insert(0, Received(stamp_ns, companion))
        here = np.flatnonzero(drift.present[record])
        truth = TrueReflectors(
            stamp_ns,
            FRAME_ID,
            (1 + here).astype(np.uint32),
            drift.depth[record, here],
            drift.amplitude[record, here],
        )
        yield received, truth


def stamp_of(config: FathometerScenario, record: int) -> int:
    """Time of the last sample of a record."""
    return FIRST_STAMP_NS + round((record + 1) * config.record_seconds * 1e9)


def _measurements(
    config: FathometerScenario, drift: Drift, rng: np.random.Generator
) -> Iterator[list[Any]]:
    """The measurements of each record."""
    for record in range(config.records):
        told = None if config.depth_companion else float(drift.array_depth_told[record])
        if config.level == 'pressure':
            yield _pressure(config, drift, record, told, rng)
        elif config.level == 'trace':
            yield [_trace(config, drift, record, told, rng)]
        elif config.level == 'envelope':
            yield [_envelope(config, drift, record, told, rng)]
        else:
            spectra = cross_spectra(config, drift, record, told, rng)
            yield [spectra if config.level == 'csdm' else _response(config, spectra, drift)]


def cross_spectra(
    config: FathometerScenario,
    drift: Drift,
    record: int,
    told: float | None,
    rng: np.random.Generator,
) -> CrossSpectra:
    """A sample of the cross-spectra of one record around their expectation. told: the depth of the
    array that the record states."""
    spacing = 1.0 / config.snapshot_seconds
    first = int(np.ceil(config.frequency_min / spacing - 1e-9))
    last = int(np.floor(config.frequency_max / spacing + 1e-9))
    frequency = spacing * np.arange(first, last + 1)
    there = drift.amplitude[record] > 0.0
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
    # Surface noise is red: it falls by 5 dB per octave.
    R *= ((frequency / 1000.0) ** -1.6)[:, None, None]
    return CrossSpectra(
        stamp_ns=stamp_of(config, record),
        frame_id=FRAME_ID,
        frequency=frequency,
        csdm=sample_csdm(R, config.snapshots, rng),
        snapshots=config.snapshots,
        reference_depth=told,
    )


def _depths(config: FathometerScenario) -> FloatArray:
    count = int((config.depth_max - config.depth_min) / config.depth_step + 1e-6) + 1
    return config.depth_min + config.depth_step * np.arange(count)


def _response(config: FathometerScenario, spectra: CrossSpectra, drift: Drift) -> Trace:
    heights = config.element_spacing * np.arange(config.phones)
    w = fathometer.steering(spectra.frequency, heights, config.sound_speed)
    gamma = fathometer.coherence(spectra.csdm, w, config.processor)
    record = round((spectra.stamp_ns - FIRST_STAMP_NS) / (config.record_seconds * 1e9)) - 1
    comb = float(spectra.frequency[0]), 1.0 / config.snapshot_seconds
    depth, where = _depths(config), float(drift.array_depth_told[record])

    def at(first: float, count: int) -> FloatArray:
        lattice = first, config.depth_step, count
        return fathometer.depth_response(gamma, *comb, lattice, where, config.sound_speed)

    sigma = fathometer.noise_sigma(at(180.0, 2000))
    return Trace(
        stamp_ns=spectra.stamp_ns,
        frame_id=FRAME_ID,
        depth=depth,
        amplitude=at(config.depth_min, len(depth)),
        sigma=np.full(len(depth), sigma),
        reference_depth=spectra.reference_depth,
    )


def _trace(
    config: FathometerScenario,
    drift: Drift,
    record: int,
    told: float | None,
    rng: np.random.Generator,
) -> Trace:
    """Pulses, and noise through the same band, with the error of the array's depth."""
    depth, step = _depths(config), config.depth_step
    pulse = band_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
    size = 2 * len(depth)
    frequency = np.fft.rfftfreq(size, 2.0 * step / config.sound_speed)
    band = (frequency >= config.frequency_min) & (frequency <= config.frequency_max)
    spectrum = band * (rng.standard_normal((len(band), 2)) @ np.array([1.0, 1j]))
    noise = np.fft.irfft(spectrum, size)[: len(depth)]
    noise *= config.noise_sigma * size / np.sqrt(4.0 * np.count_nonzero(band))
    shift = drift.array_depth_told[record] - drift.array_depth[record]
    # The level of an MVDR response falls with the two-way path plus the length of the array.
    height = drift.depth[record] - drift.array_depth[record]
    level = (
        12.0 * drift.amplitude[record] / (2.0 * height + config.phones * config.element_spacing)
    )
    there = pulse(depth[:, None] - drift.depth[record] - shift) @ level
    return Trace(
        stamp_ns=stamp_of(config, record),
        frame_id=FRAME_ID,
        depth=depth,
        amplitude=there + noise,
        sigma=np.full(len(depth), config.noise_sigma),
        reference_depth=told,
    )


def _envelope(
    config: FathometerScenario,
    drift: Drift,
    record: int,
    told: float | None,
    rng: np.random.Generator,
) -> Trace:
    depth = _depths(config)
    return Trace(
        stamp_ns=stamp_of(config, record),
        frame_id=FRAME_ID,
        depth=depth,
        amplitude=envelope(config, drift, record, depth, rng),
        reference_depth=told,
    )


def _pressure(
    config: FathometerScenario,
    drift: Drift,
    record: int,
    told: float | None,
    rng: np.random.Generator,
) -> list[Pressure]:
    """Blocks of one snapshot's length, summed up from plane waves (`_rays`)."""
    length = round(config.record_seconds * config.sample_rate)
    frequency = np.fft.rfftfreq(length, 1.0 / config.sample_rate)
    heard = (frequency >= 0.5 * config.frequency_min) & (frequency < 1.2 * config.frequency_max)
    k = 2.0 * np.pi * frequency[heard] / config.sound_speed
    height = drift.depth[record] - drift.array_depth[record]
    spectra = np.zeros((config.phones, len(k)), np.complex64)
    for u, power in _rays(height.max(), 0.125 * config.sound_speed / config.frequency_max, rng):
        down = np.sqrt(0.5 * power) * (rng.standard_normal((len(k), 2)) @ np.array([1.0, 1j]))
        down = down.astype(np.complex64)
        # The phase of numpy's transform: a later arrival turns by exp(-i w t).
        up = down * (np.exp(-2j * u * np.outer(k, height)) @ drift.amplitude[record])
        step = np.exp(1j * u * k * config.element_spacing).astype(np.complex64)
        back = step.conj()
        up = up.astype(np.complex64)
        for m in range(config.phones):
            spectra[m] += down + up
            down *= step
            up *= back
    noise = rng.standard_normal((config.phones, 2 * len(k)), np.float32).view(np.complex64)
    spectra += np.float32(np.sqrt(0.5 * config.phone_noise)) * noise
    full = np.zeros((config.phones, len(frequency)), np.complex64)
    full[:, heard] = spectra * (np.maximum(frequency[heard], 1.0) / 1000.0) ** -0.8
    pressure = np.fft.irfft(full, length, axis=1).T * np.sqrt(length)
    block = round(config.snapshot_seconds * config.sample_rate)
    end_ns = stamp_of(config, record)
    return [
        Pressure(
            stamp_ns=end_ns - round((length - first) / config.sample_rate * 1e9),
            frame_id=FRAME_ID,
            pressure=pressure[first : first + block],
            sample_rate=config.sample_rate,
            reference_depth=told,
        )
        for first in range(0, length - 1, block)
    ]


def _rays(
    height: float, resolution: float, rng: np.random.Generator
) -> Iterator[tuple[float, float]]:
    """Sines u of the angles at which plane waves come down, and their powers, one in all.

    The steep ones make the echo. They stand so close that the echoes of neighbours, H du apart,
    are not told apart, or each would look like a layer of its own; 48 do for the others.
    """
    steep = 0.8
    count = int(np.ceil((1.0 - steep) * height / resolution))
    edges = np.concatenate([np.linspace(0.0, steep, 48), np.linspace(steep, 1.0, count + 1)[1:]])
    for low, high in zip(edges, edges[1:]):
        yield float(rng.uniform(low, high)), float(high**2 - low**2)
