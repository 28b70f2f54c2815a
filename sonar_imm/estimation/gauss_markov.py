# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Errors that are correlated in time: the first-order Gauss-Markov process.

A position source that filters its output makes errors that last. As white noise they would
average out within seconds, and the covariance of the track would be far too small. The process
``b' = a b + q`` with ``a = exp(-dt / time)`` and ``var q = std^2 (1 - a^2)`` keeps the variance
``std^2`` at any step, and its correlation fades to 1/e within `time`.

Source: A. Gelb (ed.), *Applied Optimal Estimation*, 1974, sec. 3.8; Y. Bar-Shalom, X. R. Li,
T. Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, sec. 8.2 (state
augmentation for autocorrelated noise).
"""

from __future__ import annotations

import math


def gauss_markov(std: float, time: float, dt: float) -> tuple[float, float]:
    """(a, q): the factor of a step of dt seconds and the variance it adds, `std` being the
    standard deviation for ever and `time` in seconds that of the correlation.

    >>> a, q = gauss_markov(std=2.0, time=10.0, dt=10.0)
    >>> round(a, 4), round(q, 4)  # exp(-1), 4 (1 - exp(-2))
    (0.3679, 3.4587)
    """
    return math.exp(-dt / time), -(std**2) * math.expm1(-2.0 * dt / time)
