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

"""Parameters of the fathometer scenes, and the floor and the drift drawn from them.

The layers lie about evenly below the first one and undulate independently. Some fade away and some
appear, each over `fade_records`. A layer counts as present while its amplitude exceeds 0.4 of its
largest value. The array drifts and heaves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from sonar_imm.acoustics.fathometer import PROCESSORS
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.parameters import parameter
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm.truth import PRESENT

from ..scenario import Scenario

LEVELS = ('csdm', 'response', 'trace', 'pressure', 'envelope')
MOST_MEMORY = 2e9
"""Bytes of cross-spectra that one scene may hold."""


@frozen(kw_only=True)
class FathometerScenario(Scenario):
    """Parameters of a fathometer scene; the defaults are like the drift of the paper."""

    INSTRUMENT = (
        'record_seconds',
        'snapshot_seconds',
        'frequency_min',
        'frequency_max',
        'phones',
        'element_spacing',
        'sound_speed',
    )

    level: str = parameter('response', 'what is written of the scene', choices=LEVELS)
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
    sample_rate: float = parameter(12000.0, 'pressure: samples per second', unit='Hz', low=10.0)
    phones: int = parameter(32, 'hydrophones of the array', low=3, high=256)
    element_spacing: float = parameter(0.18, 'distance between hydrophones', unit='m', low=1e-3)
    sound_speed: float = parameter(1500.0, 'speed of sound', unit='m/s', low=1300.0, high=1700.0)

    array_depth: float = parameter(73.5, 'mean depth of the deepest hydrophone', unit='m', low=0.0)
    heave: float = parameter(2.5, 'amplitude of its slow heave', unit='m', low=0.0)
    heave_records: float = parameter(180.0, 'records to a period of the heave', low=2.0)
    array_depth_std: float = parameter(
        0.03, 'error of the depth that is stated', unit='m', low=0.0
    )
    depth_companion: bool = parameter(
        False, 'the depth of the array is sent beside the records, not in them'
    )

    first_depth: float = parameter(130.0, 'depth of the first layer', unit='m', low=1.0)
    layers: int = parameter(8, 'layers that are there from the beginning', low=1, high=64)
    layer_spacing: float = parameter(4.0, 'mean distance of layers', unit='m', low=0.1, high=100.0)
    depth_walk: float = parameter(
        0.01, 'how far each layer wanders from record to record', unit='m', low=0.0
    )
    tilt_walk: float = parameter(
        0.04, 'how far all wander together from record to record', unit='m', low=0.0
    )
    first_amplitude: float = parameter(0.35, 'of the first layer', low=0.0, high=1.0)
    amplitude: float = parameter(0.11, 'of the others', low=0.0, high=1.0)
    amplitude_swing: float = parameter(
        0.15, 'share by which amplitudes rise and fall over 70 to 150 records', low=0.0, high=1.0
    )
    appearing: tuple[int, ...] = parameter(
        (140, 262), 'records at which one more layer begins to appear', kind='int[]', low=0
    )
    fading: tuple[int, ...] = parameter(
        (85,), 'records at which a layer begins to fade', kind='int[]', low=0
    )
    fade_records: int = parameter(
        5, 'over how many records layers appear and fade', low=1, high=10_000
    )

    phone_noise: float = parameter(
        0.01, 'noise power of a hydrophone against the surface noise', low=1e-6, high=1e6
    )
    ship_noise: float = parameter(
        3.0, 'power of distant ships at 200 Hz against the surface noise', low=0.0, high=1e6
    )
    ship_pass: tuple[int, ...] = parameter(
        (), 'records between which a ship comes by, a hundred times louder', kind='int[]', low=0
    )
    whitened: bool = parameter(
        False, 'csdm, pressure: spectra made even, as a recorder does that has few bits'
    )
    steps_per_sigma: float = parameter(
        0.0,
        'pressure: whole numbers with so many steps to a standard deviation; 0: real numbers',
        low=0.0,
        high=1e4,
    )
    block_seconds: float = parameter(
        1.0, 'pressure: length of a message', unit='s', low=1e-3, high=60.0
    )
    noise_sigma: float = parameter(
        1.3e-3, 'trace, envelope: standard deviation of the noise', low=1e-9, high=1.0
    )
    pulse_width: float = parameter(
        0.45, 'envelope: standard deviation of the pulse', unit='m', low=1e-3, high=100.0
    )
    scatter: float = parameter(
        0.0,
        'envelope: rms of the volume scatter just below the first layer',
        low=0.0,
        high=10.0,
    )
    scatter_decay: float = parameter(
        5.0, 'envelope: depth over which it falls to 1/e', unit='m', low=0.01, high=1000.0
    )
    stack: int = parameter(4, 'envelope: pings averaged to one record', low=1, high=1000)
    processor: str = parameter(
        'mvdr', 'response: beamformer that looks up and down', choices=PROCESSORS
    )
    depth_min: float = parameter(
        122.0, 'response, trace, envelope: least depth', unit='m', low=0.0
    )
    depth_max: float = parameter(
        172.0, 'response, trace, envelope: greatest depth', unit='m', low=0.1
    )
    depth_step: float = parameter(
        0.03125, 'response, trace, envelope: distance of depths', unit='m', low=1e-4
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
        if self.level == 'csdm' and self.spectra_bytes() > MOST_MEMORY:
            problems.append(
                f'these cross-spectra would take {1e-9 * self.spectra_bytes():.1f} GB: '
                'make fewer records, or traces of them (level response)'
            )
        if self.ship_pass and len(self.ship_pass) != 2:
            problems.append('ship_pass needs two records, first and last')
        if len(self.fading) >= self.layers:
            problems.append('fading would leave no layer')
        return problems

    def told(self) -> dict[str, Any]:
        """See `Scenario.told`."""
        told = Scenario.told(self)
        if self.level == 'csdm':
            # They are drawn frequency by frequency: no window makes their noise fade with depth.
            told |= {'window': 'rectangular', 'overlap': 0.0}
        if self.level == 'pressure':
            # Snapshots are the tracker's own; they are as long as the depths to be tracked need.
            del told['snapshot_seconds']
            told |= {'depth_min': self.depth_min, 'depth_max': self.depth_max}
        if self.level == 'envelope':
            # A profiler has no array: of the instrument only its pulse and its noise matter.
            told = {'sound_speed': self.sound_speed}
            told |= envelope_parameters(self.pulse_width, self.noise_sigma)
        return told

    def spectra_bytes(self) -> float:
        """Size of all cross-spectra of the scene."""
        rows = (self.frequency_max - self.frequency_min) * self.snapshot_seconds
        return 8.0 * self.records * rows * self.phones**2


SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    'drift': ('300 records of the drift of the paper, processed by MVDR: 2 s per record', {}),
    'drift_conventional': (
        'drift, processed conventionally',
        {'processor': 'conventional', 'frequency_min': 200.0},
    ),
    'drift_spectra': (
        'the first four records of a drift, as cross-spectra of 45 MB each',
        {'level': 'csdm', 'records': 4, 'appearing': (), 'fading': ()},
    ),
    'drift_traces': ('drift, traces straight away', {'level': 'trace'}),
    'small': (
        'a short drift of an array of 8 hydrophones in a coarse band, small enough for a bag',
        {
            'level': 'csdm',
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
    'diffuse': (
        'a profiler over a diffuse floor: envelopes, three layers in volume scatter',
        {
            'level': 'envelope',
            'record_seconds': 1.0,
            'array_depth': 0.0,
            'array_depth_std': 0.0,
            'heave': 0.0,
            'first_depth': 16.0,
            'layers': 3,
            'layer_spacing': 5.0,
            'tilt_walk': 0.1,
            'depth_walk': 0.02,
            'amplitude': 0.3,
            'amplitude_swing': 0.3,
            'appearing': (),
            'fading': (),
            'scatter': 0.25,
            'noise_sigma': 0.02,
            'depth_min': 4.5,
            'depth_max': 45.0,
            'depth_step': 0.2,
        },
    ),
    'pressure': (
        'twelve records of eight seconds of pressure at 16 hydrophones over three layers',
        {
            'level': 'pressure',
            'records': 12,
            'record_seconds': 8.0,
            'phones': 16,
            'element_spacing': 0.25,
            'sample_rate': 6000.0,
            'frequency_min': 100.0,
            'frequency_max': 2800.0,
            'whitened': True,
            'steps_per_sigma': 3.0,
            'ship_noise': 0.5,
            'phone_noise': 1e-3,
            'array_depth': 30.0,
            'heave': 0.5,
            'heave_records': 12.0,
            'first_depth': 52.0,
            'layers': 3,
            'layer_spacing': 7.0,
            'depth_walk': 0.05,
            'tilt_walk': 0.0,
            'amplitude': 0.3,
            'depth_min': 42.0,
            'depth_max': 74.0,
            'appearing': (),
            'fading': (),
        },
    ),
}
"""Name: (what it is, what differs from the defaults of `FathometerScenario`)."""


def scenario(name: str, overrides: Mapping[str, Any] | None = None) -> FathometerScenario:
    """The scenario `name` with some values replaced. Raises `ConfigError` naming mistakes."""
    return FathometerScenario.named(name, SCENARIOS, overrides)


@frozen(eq=False)
class Drift:
    """The floor and the array over time: depth and amplitude (records, K) of all layers that ever
    exist, present (records, K), array_depth (records,) and the depth that is stated,
    array_depth_told (records,)."""

    depth: FloatArray
    amplitude: FloatArray
    present: NDArray[np.bool_]
    array_depth: FloatArray
    array_depth_told: FloatArray


def drift_of(config: FathometerScenario, rng: np.random.Generator) -> Drift:
    """Draw the floor and the path of the array."""
    T, K = config.records, config.layers + len(config.appearing)
    together = np.cumsum(config.tilt_walk * rng.standard_normal(T))
    alone = np.cumsum(config.depth_walk * rng.standard_normal((T, K)), axis=0)
    jitter = 0.25 * config.layer_spacing * rng.uniform(-1.0, 1.0, K)
    # Layers that appear lie below the others.
    depth = config.first_depth + config.layer_spacing * np.arange(K) + jitter
    depth = depth + together[:, None] + alone
    level = config.amplitude * rng.uniform(0.8, 1.25, K)
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
    turns = record[:, None] / rng.uniform(70.0, 150.0, K) + rng.uniform(size=K)
    swing = np.exp(config.amplitude_swing * np.sin(2.0 * np.pi * turns))
    turns = record / config.heave_records + rng.uniform()
    array_depth = config.array_depth + config.heave * np.sin(2.0 * np.pi * turns)
    told = array_depth + config.array_depth_std * rng.standard_normal(T)
    return Drift(
        depth, np.clip(level * share * swing, 0.0, 1.0), share > PRESENT, array_depth, told
    )
