"""A line array that drifts over a layered floor, and hears the sea surface twice.

The layers lie about evenly below the first and undulate on their own; some fade away and some
appear, each over `fade_records`. A layer counts as present while its amplitude exceeds 0.4 of its
greatest. The array drifts and heaves.

What is made of a scene is a matter of `level`:
    csdm      cross-spectra, drawn around the exact ones of `acoustics.ambient` (Wishart), with
              noise of ships from the horizontal, red, and of the phones;
    response  these, processed: traces;
    trace     traces straight away: pulses and noise of the same band, thousands a second;
    pressure  time series from many plane waves: slow, for short scenes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from ..acoustics import fathometer
from ..acoustics.ambient import horizontal_noise_csdm, sample_csdm, surface_noise_csdm
from ..acoustics.pulse import band_pulse
from ..measurements import ArrayDepth, CrossSpectra, FloatArray, Pressure, Trace
from ..parameters import Config, ConfigError, did_you_mean, parameter
from .scene import Received, Scene, TrueReflectors

LEVELS = ('csdm', 'response', 'trace', 'pressure')
FIRST_STAMP_NS = 1_700_000_000_000_000_000
FRAME_ID = 'array'
PRESENT = 0.4
"""A reflector is present while it has more than this share of its greatest amplitude."""


@frozen(kw_only=True)
class FathometerScenario(Config):
    """Everything a fathometer scene can be told; the defaults are like the drift of the paper."""

    level: str = parameter('csdm', 'what is written of the scene', choices=LEVELS)
    records: int = parameter(300, 'number of records', low=1, high=100_000)
    record_seconds: float = parameter(
        89.6, 'from record to record', unit='s', low=0.01, high=86400.0
    )
    snapshots: int = parameter(64, 'independent snapshots of a record', low=1, high=100_000)
    snapshot_seconds: float = parameter(
        1.4, 'length of a snapshot: the inverse of the frequency spacing', unit='s', low=1e-3
    )
    frequency_min: float = parameter(50.0, 'lower edge of the band', unit='Hz', low=1.0)
    frequency_max: float = parameter(4000.0, 'upper edge of the band', unit='Hz', low=2.0)
    sample_rate: float = parameter(12000.0, 'pressure: samples a second', unit='Hz', low=10.0)
    phones: int = parameter(32, 'phones of the array', low=3, high=256)
    element_spacing: float = parameter(0.18, 'distance between phones', unit='m', low=1e-3)
    sound_speed: float = parameter(1500.0, 'speed of sound', unit='m/s', low=1300.0, high=1700.0)

    array_depth: float = parameter(73.5, 'mean depth of the deepest phone', unit='m', low=0.0)
    heave: float = parameter(3.0, 'amplitude of its slow heave', unit='m', low=0.0)
    array_depth_std: float = parameter(
        0.03, 'error of the depth that is told', unit='m', low=0.0
    )
    depth_companion: bool = parameter(
        False, 'the depth of the array is told beside the records, not in them'
    )

    first_depth: float = parameter(130.0, 'depth of the first layer', unit='m', low=1.0)
    layers: int = parameter(8, 'layers that are there from the beginning', low=1, high=64)
    layer_spacing: float = parameter(
        4.0, 'mean distance of layers', unit='m', low=0.1, high=100.0
    )
    depth_walk: float = parameter(
        0.03, 'how far each layer wanders from record to record', unit='m', low=0.0
    )
    tilt_walk: float = parameter(
        0.03, 'how far all wander together from record to record', unit='m', low=0.0
    )
    first_amplitude: float = parameter(0.35, 'of the first layer', low=0.0, high=1.0)
    amplitude: float = parameter(0.12, 'of the others', low=0.0, high=1.0)
    appearing: tuple[int, ...] = parameter(
        (140, 262), 'records at which one more layer begins to appear', kind='int[]', low=0
    )
    fading: tuple[int, ...] = parameter(
        (75,), 'records at which a layer begins to fade', kind='int[]', low=0
    )
    fade_records: int = parameter(12, 'records that takes', low=1, high=10_000)

    phone_noise: float = parameter(
        0.01, 'noise power of a phone against the surface noise', low=1e-6, high=1e6
    )
    ship_noise: float = parameter(
        3.0, 'power of distant ships at 200 Hz against the surface noise', low=0.0, high=1e6
    )
    ship_pass: tuple[int, ...] = parameter(
        (), 'records between which a ship comes by, a hundred times louder', kind='int[]', low=0
    )
    noise_sigma: float = parameter(
        1.3e-3, 'trace: standard deviation of the noise', low=1e-9, high=1.0
    )
    processor: str = parameter(
        'mvdr', 'response: how the array looks up and down', choices=fathometer.PROCESSORS
    )
    depth_min: float = parameter(122.0, 'response, trace: least depth', unit='m', low=0.0)
    depth_max: float = parameter(172.0, 'response, trace: greatest depth', unit='m', low=0.1)
    depth_step: float = parameter(
        0.03125, 'response, trace: distance of depths', unit='m', low=1e-4
    )

    def check(self) -> list[str]:
        problems = []
        if self.frequency_max <= self.frequency_min:
            problems.append('frequency_max must exceed frequency_min')
        if self.depth_max <= self.depth_min + 2.0 * self.depth_step:
            problems.append('depth_max must exceed depth_min by two steps')
        if self.level == 'pressure' and self.frequency_max > 0.5 * self.sample_rate:
            problems.append('frequency_max cannot exceed half the sample_rate')
        if self.level == 'pressure' and self.records * self.record_seconds > 600.0:
            problems.append('pressure is made for 600 s at the most: fewer or shorter records')
        if self.ship_pass and len(self.ship_pass) != 2:
            problems.append('ship_pass needs two records, first and last')
        if len(self.fading) >= self.layers:
            problems.append('fading would leave no layer')
        return problems


_SHORT = {'records': 1, 'appearing': (), 'fading': (), 'heave': 0.0}

SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    'drift': ('300 records of the drift of the paper, as cross-spectra', {}),
    'drift_response': ('drift, processed by MVDR to traces', {'level': 'response'}),
    'drift_conventional': (
        'drift, processed conventionally to traces',
        {'level': 'response', 'processor': 'conventional', 'frequency_min': 200.0},
    ),
    'drift_traces': ('drift, traces straight away', {'level': 'trace'}),
    'small': (
        'a short drift of an array of 8 phones in a coarse band, small enough for a bag',
        {
            'phones': 8,
            'element_spacing': 0.36,
            'records': 12,
            'snapshots': 512,
            'snapshot_seconds': 0.2,
            'frequency_max': 2000.0,
            'layers': 3,
            'amplitude': 0.25,
            'appearing': (),
            'fading': (4,),
            'fade_records': 3,
            'depth_companion': True,
        },
    ),
    'ship_pass': ('drift with a ship that comes by', {'ship_pass': (150, 190)}),
    'pressure': (
        'ten seconds of pressure over two strong layers',
        {
            **_SHORT,
            'level': 'pressure',
            'record_seconds': 9.8,
            'layers': 2,
            'layer_spacing': 8.0,
            'first_amplitude': 0.6,
            'amplitude': 0.4,
        },
    ),
}
"""Name: (what it is, what differs from the defaults of `FathometerScenario`)."""


def scenario(name: str, overrides: Mapping[str, Any] | None = None) -> FathometerScenario:
    """The scenario called `name` with some values replaced. Raises `ConfigError` naming
    mistakes."""
    if name not in SCENARIOS:
        raise ConfigError(
            f"unknown scenario '{name}'{did_you_mean(name, SCENARIOS)}; there are "
            f'{", ".join(SCENARIOS)}'
        )
    return FathometerScenario.from_mapping({**SCENARIOS[name][1], **(overrides or {})})


@frozen(eq=False)
class Drift:
    """What the floor and the array do: depth and amplitude (records, K) of every layer that there
    ever is, present (records, K), array_depth (records,), and array_depth_told (records,)."""

    depth: FloatArray
    amplitude: FloatArray
    present: NDArray[np.bool_]
    array_depth: FloatArray
    array_depth_told: FloatArray


def simulate(config: FathometerScenario, seed: int) -> Scene:
    """Run a scene. The same config and seed give the same scene.

    A record is stamped when its last sample is in. Array depths, when told beside, come with the
    record's own stamp, before it.
    """
    rng = np.random.default_rng(seed)
    drift = drift_of(config, rng)
    received, truth = [], []
    for record, measurements in enumerate(_measurements(config, drift, rng)):
        stamp_ns = measurements[-1].stamp_ns
        if config.depth_companion:
            depth = float(drift.array_depth_told[record])
            companion = ArrayDepth(stamp_ns=stamp_ns, depth=depth, frame_id=FRAME_ID)
            received.append(Received(stamp_ns, companion))
        received += [Received(one.stamp_ns, one) for one in measurements]
        here = np.flatnonzero(drift.present[record])
        truth.append(
            TrueReflectors(
                stamp_ns,
                FRAME_ID,
                (1 + here).astype(np.uint32),
                drift.depth[record, here],
                drift.amplitude[record, here],
            )
        )
    return Scene(tuple(received), tuple(truth), frame_id=FRAME_ID)


def drift_of(config: FathometerScenario, rng: np.random.Generator) -> Drift:
    """Draw the floor and the path of the array."""
    T, K = config.records, config.layers + len(config.appearing)
    together = np.cumsum(config.tilt_walk * rng.standard_normal(T))
    alone = np.cumsum(config.depth_walk * rng.standard_normal((T, K)), axis=0)
    jitter = 0.25 * config.layer_spacing * rng.uniform(-1.0, 1.0, K)
    # Layers that appear lie below the others.
    depth = config.first_depth + config.layer_spacing * np.arange(K) + jitter
    depth = depth + together[:, None] + alone
    level = config.amplitude * rng.uniform(0.8, 1.3, K)
    level[0] = config.first_amplitude
    share = np.ones((T, K))
    record = np.arange(T)
    for k, begin in enumerate(config.appearing, start=config.layers):
        share[:, k] = np.clip((record - begin) / config.fade_records, 0.0, 1.0)
    for k, begin in enumerate(config.fading):
        # Not the first one, which is the sea floor; every other of the rest.
        share[:, 1 + (2 + 2 * k) % (config.layers - 1)] *= np.clip(
            1.0 - (record - begin) / config.fade_records, 0.0, 1.0
        )
    flicker = 1.0 + 0.05 * rng.standard_normal((T, K))
    phase = rng.uniform(0.0, 2.0 * np.pi)
    array_depth = config.array_depth + config.heave * np.sin(phase + 2.0 * np.pi * record / 80.0)
    told = array_depth + config.array_depth_std * rng.standard_normal(T)
    return Drift(
        depth, np.clip(level * share * flicker, 0.0, 1.0), share > PRESENT, array_depth, told
    )


def stamp_of(config: FathometerScenario, record: int) -> int:
    """When the last sample of a record is in."""
    return FIRST_STAMP_NS + round((record + 1) * config.record_seconds * 1e9)


def _measurements(
    config: FathometerScenario, drift: Drift, rng: np.random.Generator
) -> Iterator[list[Any]]:
    """What is measured of each record."""
    for record in range(config.records):
        told = None if config.depth_companion else float(drift.array_depth_told[record])
        if config.level == 'pressure':
            yield _pressure(config, drift, record, told, rng)
        elif config.level == 'trace':
            yield [_trace(config, drift, record, told, rng)]
        else:
            spectra = _cross_spectra(config, drift, record, told, rng)
            yield [spectra if config.level == 'csdm' else _response(config, spectra, drift)]


def _cross_spectra(
    config: FathometerScenario,
    drift: Drift,
    record: int,
    told: float | None,
    rng: np.random.Generator,
) -> CrossSpectra:
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
    # Surface noise is red: it falls by 5 dB an octave.
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
    # The level of an MVDR response: a twelfth of what the echo of a metre's way would be.
    height = drift.depth[record] - drift.array_depth[record]
    level = 12.0 * drift.amplitude[record] / (2.0 * height + config.phones * config.element_spacing)
    there = pulse(depth[:, None] - drift.depth[record] - shift) @ level
    return Trace(
        stamp_ns=stamp_of(config, record),
        frame_id=FRAME_ID,
        depth=depth,
        amplitude=there + noise,
        sigma=np.full(len(depth), config.noise_sigma),
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
