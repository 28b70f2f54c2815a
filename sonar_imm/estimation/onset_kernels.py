# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The pass of `onset` over a trace, compiled, into arrays of the caller."""

from __future__ import annotations

import math

import numpy as np

from .arrays import FloatArray
from .jit import kernel

FADED, NO_FLOOR = 0.15, -6.0
"""Probability that an onset is quiet, and log weight of a floor that is not in the window."""


@kernel
def onset_pass(
    quiet: FloatArray,
    loud: FloatArray,
    onset: FloatArray,
    log_onset: FloatArray,
    log_ring: FloatArray,
    rates: FloatArray,
    window: int,
    found: FloatArray,
    ring: FloatArray,
) -> None:
    """Write the log weights of the onset, found (n,), and of the transmit pulse, ring (R,).

    quiet, loud, onset (n,): log likelihoods of the samples; log_onset (n,) and log_ring (R,):
    before this trace; rates (4,): probabilities per sample that fish begin and end, and that
    runs of what is loud below the floor do; window: samples of the onset."""
    n = len(quiet)
    enter, leave = math.log(rates[0]), math.log(rates[1])
    stay_quiet, stay_loud = math.log(1.0 - rates[0]), math.log(1.0 - rates[1])
    # Down: water up to each sample, which ends quiet or in fish, for all transmit pulses.
    down_quiet, down_loud = np.full(n + 1, -np.inf), np.full(n + 1, -np.inf)
    pulse = np.zeros(n + 1)
    for z in range(n + 1):
        if z > 0:
            q, f = down_quiet[z - 1], down_loud[z - 1]
            down_quiet[z] = np.logaddexp(q + stay_quiet, f + leave) + quiet[z - 1]
            down_loud[z] = np.logaddexp(q + enter, f + stay_loud) + loud[z - 1]
            pulse[z] = pulse[z - 1] + loud[z - 1]
        if z < len(log_ring):
            down_quiet[z] = np.logaddexp(down_quiet[z], log_ring[z] + pulse[z])
    # Up: what is below each sample, and the onset with it.
    begin, end = math.log(rates[2]), math.log(rates[3])
    keep_quiet, keep_loud = math.log(1.0 - rates[2]), math.log(1.0 - rates[3])
    below_quiet, below_loud = np.zeros(n + 1), np.zeros(n + 1)
    sum_onset, sum_quiet = np.zeros(n + 1), np.zeros(n + 1)
    for z in range(n - 1, -1, -1):
        q, f = quiet[z] + below_quiet[z + 1], loud[z] + below_loud[z + 1]
        below_quiet[z] = np.logaddexp(keep_quiet + q, begin + f)
        below_loud[z] = np.logaddexp(end + q, keep_loud + f)
        sum_onset[z] = sum_onset[z + 1] + onset[z]
        sum_quiet[z] = sum_quiet[z + 1] + quiet[z]
    solid, faded = math.log(1.0 - FADED), math.log(FADED)
    for k in range(n - 1):
        m = min(k + window, n)
        found[k] = log_onset[k] + np.logaddexp(
            solid + sum_onset[k] - sum_onset[m] + below_loud[m],
            faded + sum_quiet[k] - sum_quiet[m] + below_quiet[m],
        )
    found[n - 1] = log_onset[n - 1] + NO_FLOOR
    # Up again, through the water, for each transmit pulse.
    up_quiet, up_loud = found[n - 1], found[n - 1]
    for z in range(n - 1, -1, -1):
        q, f = quiet[z] + up_quiet, loud[z] + up_loud
        up_quiet, up_loud = (
            np.logaddexp(stay_quiet + q, enter + f),
            np.logaddexp(leave + q, stay_loud + f),
        )
        if z < n - 1:
            up_quiet = np.logaddexp(up_quiet, found[z])
            up_loud = np.logaddexp(up_loud, found[z])
        if z < len(log_ring):
            ring[z] = log_ring[z] + pulse[z] + up_quiet
    for k in range(n - 1):
        found[k] += np.logaddexp(down_quiet[k], down_loud[k])
    found[n - 1] += np.logaddexp(down_quiet[n], down_loud[n])
