# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Snapshots for the bathymetry tests: the independent vectors, and small floors of our own."""

import math

import numpy as np

from helpers.vector_files import load_vectors
from sonar_imm.acoustics import array
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig

EXACT = {'tilt_std_deg': 0.0, 'spacing_std': 0.0, 'sound_speed_std': 0.0}
"""An array and water that are known: the covariance is that of the filter."""


def vector(name):
    """A case: its arrays, the config that describes it, its snapshot."""
    case = load_vectors(f'bathymetry/{name}')
    values = {
        'sonar_height': float(case['H']), 'tilt_deg': math.degrees(case['tilt']),
        'element_spacing_wavelengths': float(case['dlam']),
        'transition_matrix': case['Pi'].ravel().tolist(),
        'initial_probabilities': case['mu0'].tolist(), 'initial_std': float(case['sd0']),
        'particles_per_model': 3000, 'gate_false_alarm': 1.0, **EXACT,
    }  # fmt: skip
    if name.startswith('set_ii_'):
        values |= {'model_set': 'height_two_rw', 'sigmas': case['sigmas'].tolist()}
    elif name.startswith('set_iii'):
        sigmas = [float(case['sigma1_deg']), *case['sigma2_deg'].tolist()]
        values |= {'model_set': 'angle_two_rw', 'sigmas_deg': sigmas}
        values |= {'initial_mean': float(case['th0']), 'angle_drift': False}
    else:
        sigmas = [float(case['s_rw']), float(case['s_ncs'])]
        values |= {'model_set': 'height_rw_ncs', 'sigmas': sigmas}
        values |= {'initial_slope_std': float(case['sb0']), 'redrawn_slope_std': float(case['gb'])}
    noise = np.full(len(case['r']), float(case['sn2']))
    stated = {'noise_variance': noise, 'signal_variance': case['rho'] * noise}
    snapshot = Snapshot(stamp_ns=1_000, range=case['r'], iq=case['Y'], **stated)
    return case, BathymetryConfig(**values), snapshot


def floor(height, *, seed=1, stamp_ns=1_000, snr_db=25.0, H=15.0, tilt_deg=30.0, P=8, **more):
    """A snapshot of a floor of `height` (T,) or a number, noise variance 1."""
    ranges = more.pop('ranges', 20.0 + 0.05 * np.arange(300))
    spacing, conjugate = more.pop('spacing', 0.5), more.pop('conjugate', False)
    rng, depth = np.random.default_rng(seed), H - np.broadcast_to(height, ranges.shape)
    sine = array.direction_sine(depth, ranges, math.radians(tilt_deg))

    def circular(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * math.sqrt(0.5)

    y = 10.0 ** (snr_db / 20.0) * circular(len(ranges), 1)
    y = y * array.steering(sine, P, spacing, conjugate=conjugate)
    y = (y + circular(len(ranges), P)) * np.sqrt(rng.exponential(size=(len(ranges), 1)))
    y[more.pop('shadow', slice(0, 0))] = circular(1, P)
    more.setdefault('noise_variance', np.ones(len(ranges)))
    return Snapshot(stamp_ns=stamp_ns, range=ranges, iq=y.astype(np.complex64), **more)
