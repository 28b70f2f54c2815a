# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters of the fathometer scenes, and the floor and the drift drawn from them.

The layers lie about evenly below the first one and undulate independently. Some fade away and some
appear, each over `fade_records`. A layer counts as present while its amplitude exceeds 0.4 of its
largest value. The array drifts and heaves.
"""

from __future__ import annotations

from typing import Any

from attrs import frozen
import numpy as np
from numpy.random import Generator

from sonar_imm.acoustics.fathometer import PROCESSORS
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.parameters import parameter
from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm.truth import PRESENT

from ..scenario import Scenario, Scenarios

LEVELS = ('csdm', 'response', 'trace', 'pressure', 'envelope')
MOST_MEMORY = 2e9
"""Bytes of cross-spectra that one scene may hold."""


@frozen(kw_only=True)
class FathometerScenario(Scenario):
    """Parameters of a fathometer scene; the defaults are like the drift of the paper."""

    INSTRUMENT = (
        'record_seconds', 'snapshot_seconds', 'frequency_min', 'frequency_max', 'phones',
        'element_spacing', 'sound_speed',
    )  # fmt: skip

    # fmt: off
    level: str = parameter('response', '', 'kind of records that is written', choices=LEVELS)
    records: int = parameter(300, '', 'number of records', range=(1, 100_000))
    record_seconds: float = parameter(89.6, 's',
        'time from record to record', range=(0.01, 86400.0))
    snapshots: int = parameter(64, '',
        'number of independent snapshots of a record', range=(1, 100_000))
    snapshot_seconds: float = parameter(1.4, 's',
        'length of a snapshot: the inverse of the frequency spacing', range=(1e-3, None))
    frequency_min: float = parameter(50.0, 'Hz',
        'lower edge of the frequency band', range=(1.0, None))
    frequency_max: float = parameter(4000.0, 'Hz',
        'upper edge of the frequency band', range=(2.0, None))
    sample_rate: float = parameter(12000.0, 'Hz',
        'level pressure: samples per second', range=(10.0, None))
    phones: int = parameter(32, '', 'number of hydrophones of the array', range=(3, 256))
    element_spacing: float = parameter(0.18, 'm',
        'distance between hydrophones', range=(1e-3, None))
    sound_speed: float = parameter(1500.0, 'm/s',
        'speed of sound in the water', range=(1300.0, 1700.0))

    array_depth: float = parameter(73.5, 'm',
        'mean depth of the deepest hydrophone', range=(0.0, None))
    heave: float = parameter(2.5, 'm',
        'amplitude of the slow heave of the array', range=(0.0, None))
    heave_records: float = parameter(180.0, '',
        'period of the heave of the array, in records', range=(2.0, None))
    array_depth_std: float = parameter(0.03, 'm',
        'standard deviation of the stated depth of the array', range=(0.0, None))
    depth_companion: bool = parameter(False, '',
        'the depth of the array is sent beside the records, not in them')

    first_depth: float = parameter(130.0, 'm', 'depth of the first layer', range=(1.0, None))
    layers: int = parameter(8, '',
        'number of layers that are there from the beginning', range=(1, 64))
    layer_spacing: float = parameter(4.0, 'm', 'mean distance between layers', range=(0.1, 100.0))
    depth_walk: float = parameter(0.01, 'm',
        'standard deviation of the step of each layer from record to record', range=(0.0, None))
    tilt_walk: float = parameter(0.04, 'm',
        'standard deviation of the step of all layers together from record to record',
        range=(0.0, None))
    first_amplitude: float = parameter(0.35, '', 'amplitude of the first layer', range=(0.0, 1.0))
    amplitude: float = parameter(0.11, '',
        'amplitude of the layers below the first', range=(0.0, 1.0))
    amplitude_swing: float = parameter(0.15, '',
        'share by which amplitudes rise and fall over 70 to 150 records', range=(0.0, 1.0))
    appearing: tuple[int, ...] = parameter((140, 262), '',
        'numbers of the records at which one more layer begins to appear', range=(0, None),
        kind='int[]')
    fading: tuple[int, ...] = parameter((85,), '',
        'numbers of the records at which a layer begins to fade', range=(0, None), kind='int[]')
    fade_records: int = parameter(5, '',
        'number of records over which layers appear and fade', range=(1, 10_000))

    phone_noise: float = parameter(0.01, '',
        'noise power of a hydrophone relative to the surface noise', range=(1e-6, 1e6))
    ship_noise: float = parameter(3.0, '',
        'power of distant ships at 200 Hz relative to the surface noise', range=(0.0, 1e6))
    ship_pass: tuple[int, ...] = parameter((), '',
        'first and last record while a ship passes, a hundred times louder than distant ships; '
        'empty: none', range=(0, None), kind='int[]')
    whitened: bool = parameter(False, '',
        'levels csdm and pressure: spectra made flat, as by a recorder with few bits')
    steps_per_sigma: float = parameter(0.0, '',
        'level pressure: number of integer steps per standard deviation; 0: real numbers',
        range=(0.0, 1e4))
    block_seconds: float = parameter(1.0, 's',
        'level pressure: length of a message', range=(1e-3, 60.0))
    noise_sigma: float = parameter(1.3e-3, '',
        'levels trace and envelope: standard deviation of the noise', range=(1e-9, 1.0))
    pulse_width: float = parameter(0.45, 'm',
        'level envelope: standard deviation of the pulse', range=(1e-3, 100.0))
    scatter: float = parameter(0.0, '',
        'level envelope: rms of the volume scatter just below the first layer', range=(0.0, 10.0))
    scatter_decay: float = parameter(5.0, 'm',
        'level envelope: depth over which the volume scatter falls to 1/e', range=(0.01, 1000.0))
    stack: int = parameter(4, '',
        'level envelope: number of pings averaged to one record', range=(1, 1000))
    processor: str = parameter('mvdr', '',
        'level response: beamformer that looks up and down', choices=PROCESSORS)
    depth_min: float = parameter(122.0, 'm',
        'levels response, trace and envelope: least depth', range=(0.0, None))
    depth_max: float = parameter(172.0, 'm',
        'levels response, trace and envelope: greatest depth', range=(0.1, None))
    depth_step: float = parameter(0.03125, 'm',
        'levels response, trace and envelope: distance between depths', range=(1e-4, None))
    # fmt: on

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
        rows = (self.frequency_max - self.frequency_min) * self.snapshot_seconds
        size = 8.0 * self.records * rows * self.phones**2
        if self.level == 'csdm' and size > MOST_MEMORY:
            problems.append(
                f'these cross-spectra would take {1e-9 * size:.1f} GB: '
                'make fewer records, or traces of them (level response)'
            )
        if self.ship_pass and len(self.ship_pass) != 2:
            problems.append('ship_pass needs two records, first and last')
        if len(self.fading) >= self.layers:
            problems.append('fading would leave no layer')
        return problems

    def instruments(self) -> dict[str, Any]:
        """See `Scenario.instruments`."""
        known = Scenario.instruments(self)
        if self.level == 'csdm':
            # They are drawn frequency by frequency: no window makes their noise fade with depth.
            known |= {'window': 'rectangular', 'overlap': 0.0}
        if self.level == 'pressure':
            # Snapshots are the tracker's own; they are as long as the depths to be tracked need.
            del known['snapshot_seconds']
            known |= {'depth_min': self.depth_min, 'depth_max': self.depth_max}
        if self.level == 'envelope':
            # A profiler has no array: of the instrument only its pulse and its noise matter.
            known = {'sound_speed': self.sound_speed}
            known |= envelope_parameters(self.pulse_width, self.noise_sigma)
        # The speed of a scene is the one that it has.
        return {**known, 'sound_speed_std': 0.0}


# fmt: off
SCENARIOS: Scenarios = {
    'drift': ('300 records of the drift of the paper, processed by MVDR: 2 s per record', {}),
    'drift_conventional': ('drift, processed conventionally',
        {'processor': 'conventional', 'frequency_min': 200.0}),
    'drift_spectra': ('the first four records of a drift, as cross-spectra of 45 MB each',
        {'level': 'csdm', 'records': 4, 'appearing': (), 'fading': ()}),
    'drift_traces': ('drift, traces straight away', {'level': 'trace'}),
    'small': ('a short drift of an array of 8 hydrophones in a coarse band, small enough for a '
        'bag',
        {'level': 'csdm', 'phones': 8, 'element_spacing': 0.36, 'records': 12, 'snapshots': 512,
         'snapshot_seconds': 0.2, 'frequency_max': 2000.0, 'layers': 3, 'amplitude': 0.25,
         'appearing': (), 'fading': (4,), 'fade_records': 3, 'depth_companion': True}),
    'ship_pass': ('drift with a ship that comes by', {'ship_pass': (150, 190)}),
    'diffuse': ('a profiler over a diffuse floor: envelopes, three layers in volume scatter',
        {'level': 'envelope', 'record_seconds': 1.0, 'array_depth': 0.0, 'array_depth_std': 0.0,
         'heave': 0.0, 'first_depth': 16.0, 'layers': 3, 'layer_spacing': 5.0, 'tilt_walk': 0.1,
         'depth_walk': 0.02, 'amplitude': 0.3, 'amplitude_swing': 0.3, 'appearing': (),
         'fading': (), 'scatter': 0.25, 'noise_sigma': 0.02, 'depth_min': 4.5, 'depth_max': 45.0,
         'depth_step': 0.2}),
    'pressure': ('twelve records of eight seconds of pressure at 16 hydrophones over three layers',
        {'level': 'pressure', 'records': 12, 'record_seconds': 8.0, 'phones': 16,
         'element_spacing': 0.25, 'sample_rate': 6000.0, 'frequency_min': 100.0,
         'frequency_max': 2800.0, 'whitened': True, 'steps_per_sigma': 3.0, 'ship_noise': 0.5,
         'phone_noise': 1e-3, 'array_depth': 30.0, 'heave': 0.5, 'heave_records': 12.0,
         'first_depth': 52.0, 'layers': 3, 'layer_spacing': 7.0, 'depth_walk': 0.05,
         'tilt_walk': 0.0, 'amplitude': 0.3, 'depth_min': 42.0, 'depth_max': 74.0, 'appearing': (),
         'fading': ()}),
}
# fmt: on

scenario = FathometerScenario.among(SCENARIOS)


@frozen(eq=False)
class Drift:
    """The floor and the array over time: depth and amplitude (records, K) of all layers that ever
    exist, present (records, K), array_depth (records,) and the depth that is stated,
    array_depth_stated (records,)."""

    depth: FloatArray
    amplitude: FloatArray
    present: BoolArray
    array_depth: FloatArray
    array_depth_stated: FloatArray


def drift_of(config: FathometerScenario, rng: Generator) -> Drift:
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
    stated = array_depth + config.array_depth_std * rng.standard_normal(T)
    return Drift(
        depth, np.clip(level * share * swing, 0.0, 1.0), share > PRESENT, array_depth, stated
    )
