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

"""What the tracker has to be told of envelopes, such as sub-bottom profilers record.

An envelope has the pulse of an envelope, is never negative, and stands in the volume scatter of
the floor. How wide the pulse is and what noise there is depend on the instrument; the rest is
common.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...acoustics.pulse import independent_samples
from ...estimation.set_scatter import decaying_profile, Scatter
from .config import FathometerConfig
from .response import heave_shift, Lattice, pulse_of

DECAYS = (2.0, 4.0, 8.0, 16.0)
"""Depths, m, over which the scatter may fall to 1/e: silt with gas to sand."""
MAX_CELLS = 10_000


def envelope_parameters(pulse_width: float, noise_sigma: float) -> dict[str, Any]:
    """Parameters of the tracker by name, for a pulse of standard deviation `pulse_width`, m, and
    noise of `noise_sigma`, in the units of the record."""
    return {
        'pulse': 'gaussian',
        'pulse_width': pulse_width,
        'noise_sigma': noise_sigma,
        'scatter_decay': DECAYS,
        # Two pulses nearer than that make one hump.
        'min_separation': 3.0 * pulse_width,
        # Records come several a second and the floor slopes; 1.4 m a record can be followed.
        'depth_std': 0.35,
        'order_max': 6,
    }


def scatter_of(config: FathometerConfig, lattice: Lattice) -> Scatter | None:
    """The background below the first reflector, on the cells of a record. Raises ValueError for
    too many of them."""
    if not config.scatter_decay:
        return None
    pulse, step = pulse_of(config), lattice.step
    shift = heave_shift(config, step)
    cells = lattice.cells + (2 * shift.pad if shift else 0)
    if cells > MAX_CELLS:
        raise ValueError(
            f'volume scatter is looked for on up to {MAX_CELLS} steps of depth, not {cells}: use '
            'a greater depth_step or fewer depths'
        )
    independent = independent_samples(pulse, step * cells, 0.25 * step) / cells
    decays = np.asarray(config.scatter_decay) / step
    profile = decaying_profile(pulse(step * np.arange(cells)), decays)
    # Wide enough to take out a pulse: twice what of it is above one half.
    half = float(np.count_nonzero(pulse(0.01 * step * np.arange(100 * cells)) > 0.5)) / 100.0
    return Scatter(
        profile=profile,
        spread=config.scatter_spread,
        share=min(1.0, independent),
        window=2 * int(np.ceil(2.0 * half)) + 1,
    )
