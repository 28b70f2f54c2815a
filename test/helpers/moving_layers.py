# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Traces of six layers that move, below an array whose depth may be told wrongly."""

import numpy as np

from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.measurements import Trace

LAYERS = np.array([52.0, 56.5, 60.0, 64.2, 68.0, 72.5])
STRENGTH = np.array([25.0, 18.0, 13.0, 10.0, 8.5, 7.0])


def scene(error, seed, records=36, floor=None):
    """Traces of six layers as an array at 30 m sees them, told by `error` m (T,) wrongly; and the
    true depths (T, 6). Only lags are seen: the stated depth shifts all that is drawn."""
    rng, pulse = np.random.default_rng(seed), band_pulse(100.0, 2800.0, 1500.0)
    depth, traces = np.arange(42.0, 82.0, 0.05), []
    true = LAYERS + (np.zeros(records) if floor is None else floor)[:, None]
    kernel = pulse(0.05 * np.arange(-60, 61))
    for k, wrong in enumerate(error):
        noise = np.convolve(rng.standard_normal(len(depth) + 120), kernel, 'valid')
        noise /= np.sqrt(np.sum(np.square(kernel)))
        echo = pulse(depth[:, None] - true[k] - wrong) @ STRENGTH
        traces.append(
            Trace(
                stamp_ns=(k + 1) * 10**9,
                depth=depth,
                amplitude=echo + noise,
                sigma=np.ones(len(depth)),
                reference_depth=30.0 + wrong,
            )
        )
    return traces, true
