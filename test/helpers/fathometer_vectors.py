# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What of the acceptance vectors is no recording: how far our numbers are from theirs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from helpers.vector_files import load_vectors
from sonar_imm.acoustics.fathometer import sediment_thickness
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.set_model import gaussian_walk, SetModel, Sets
from sonar_imm.measurements import Pressure
from sonar_imm.trackers.fathometer.pressure import PressureStream
from sonar_imm.trackers.fathometer.response import (
    array_coherence,
    array_response,
    Lattice,
    processor_pulse,
)
from sonar_imm.trackers.fathometer.tracker import FathometerConfig

EXACT_LOG_EVIDENCE = 298.6663117
"""Of the records of exact_hmm.npz, by enumeration of all sets of up to three members on the 60
cells, in a program of its own."""


def exact_hmm_model() -> SetModel:
    """The model that the records of exact_hmm.npz are drawn from."""
    lag = np.arange(60)
    return SetModel(
        cells=60, separation=3, order_min=1, transition=np.full((3, 3), 0.2) + 0.4 * np.eye(3),
        walk=gaussian_walk(0.8), gram=np.sinc(lag / 2.2) * np.exp(-((lag / 12.0) ** 2)),
        amplitude_std=3.0,
    )  # fmt: skip


class SignedSet(NamedTuple):
    """A row of signed_likelihood.npz: one set under its model, what was heard, the log likelihood
    and the mean amplitudes (order,)."""

    model: SetModel
    sets: Sets
    response: FloatArray
    log_likelihood: float
    amplitude: FloatArray


def signed_sets() -> Iterator[SignedSet]:
    """All rows of fathometer_sea/signed_likelihood.npz."""
    v = load_vectors('fathometer_sea/signed_likelihood')
    n = v['response'].shape[1]
    edges = float(v['frequency_min']), float(v['frequency_max'])
    pulse = band_pulse(*edges, float(v['sound_speed']))
    for k, order in enumerate(v['order']):
        model = SetModel(
            cells=n, separation=1, order_min=int(order), transition=np.eye(1), walk=np.ones(1),
            gram=pulse(float(v['depth_step']) * np.arange(n)),
            amplitude_std=float(v['amplitude_std_sigmas']), negative_probability=0.05,
        )  # fmt: skip
        sets = Sets.empty(model, 1)
        sets.order[0], sets.cell[0] = order, v['cell'][k, :order]
        sets.sign[0] = v['sign'][k, :order]
        log_likelihood, amplitude = float(v['log_likelihood'][k]), v['amplitude_mean'][k, :order]
        yield SignedSet(model, sets, v['response'][k], log_likelihood, amplitude)


def sediment() -> float:
    """Largest error of the thickness, m."""
    v = load_vectors('fathometer_sea/sediment')
    found = [
        sediment_thickness(v['two_way_time_below_bottom'], float(speed), float(gradient))
        for speed, gradient in zip(v['sound_speed'], v['gradient'])
    ]
    return float(np.abs(np.array(found) - v['thickness']).max())


def pressure() -> dict[str, float]:
    """Largest relative errors of what is made of pressure.npz, of both records."""
    v = load_vectors('fathometer_sea/pressure')
    names = ('snapshot_seconds', 'record_seconds', 'frequency_min', 'frequency_max')
    settings: dict[str, Any] = {name: float(v[name]) for name in names}
    config = FathometerConfig(
        phones=16, element_spacing=float(v['element_spacing']), phone_correction='off',
        noise_depth_min=0.0, noise_depth_max=0.0, **settings,
    )  # fmt: skip
    depth = v['depth']
    lattice = Lattice(float(depth[0]), float(depth[1] - depth[0]), len(depth))
    worst: dict[str, float] = {}
    for k in range(len(v['p'])):
        block = Pressure(
            stamp_ns=1, pressure=v['p'][k] * v['scale'][k], sample_rate=float(v['sample_rate'])
        )
        (collected,), _ = PressureStream(config, Counter()).push(block, 40.0)
        coherent = array_coherence(collected.spectra, config)
        found = array_response(collected.spectra, lattice, config, float(v['array_depth'][k]))
        pulse = processor_pulse(coherent, Lattice(40.0, lattice.step, 320), config.sound_speed)
        rows = np.searchsorted(collected.spectra.frequency, v['csdm_frequency'] - 0.1)
        pairs: Mapping[str, tuple[np.ndarray, np.ndarray]] = {
            'R': (levelled(collected.spectra.csdm[rows]), levelled(v['csdm'][k])),
            'gamma': (coherent.gamma, v['gamma_mvdr'][k]),
            'W': (levelled(coherent.weight), levelled(v['weight'][k])),
            'b': (found.amplitude, v['response'][k]),
            'mirror sigma': (found.sigma[:1], v['sigma_mirror'][k : k + 1]),
            'pulse': (pulse(np.asarray(lattice.step * np.arange(320))), v['pulse_processor'][k]),
        }
        for name, (ours, theirs) in pairs.items():
            error = float(np.abs(ours - theirs).max() / np.abs(theirs).max())
            worst[name] = max(worst.get(name, 0.0), error)
    return worst


def levelled(values: np.ndarray) -> np.ndarray:
    """Of any level: only ratios of cross-spectra count."""
    return values / np.abs(values).max()
