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

"""Whether two estimates of one stamp agree as far as they say that they know."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from sonar_imm.estimates import Estimate

GATE, SHARE = 0.99, 0.9
"""A row agrees inside this probability; estimates agree where this share of rows does."""
WIDER = 2.0
"""A standard deviation this many times the expected one is not yet as good."""
SLOW = ('vertical_offset',)
"""States that take a whole approach to learn: as sure as before is not asked of them."""


def agrees(found: Estimate, expected: Estimate) -> bool:
    """Whether nearly every row of each has its like in the other: inside of what both say of their
    errors, and what is found is as sure of itself as what was expected, or nearly so. Rows that
    nobody would use yet, as tentative tracks, do not count."""
    a, b = (_certain(one) for one in (found, expected))
    if not len(a.state) or not len(b.state):
        return len(a.state) == len(b.state)
    near = _near(a, b)
    return bool(near.any(axis=1).mean() >= SHARE and near.any(axis=0).mean() >= SHARE)


def _near(a: Estimate, b: Estimate) -> np.ndarray:
    """(rows of a, rows of b): which rows agree."""
    apart = a.state[:, None] - b.state[None]
    covariance = a.covariance[:, None] + b.covariance[None]
    n = apart.shape[-1]
    weighed = np.linalg.solve(covariance + 1e-12 * np.eye(n), apart[..., None])[..., 0]
    inside = np.einsum('...i,...i->...', apart, weighed) <= chi2.ppf(GATE, n)
    spread_a, spread_b = (np.diagonal(one.covariance, axis1=1, axis2=2) for one in (a, b))
    quick = [k for k, name in enumerate(a.state_names) if name not in SLOW]
    sure = (spread_a[:, None] <= WIDER**2 * spread_b[None] + 1e-12)[..., quick].all(axis=2)
    near: np.ndarray = inside & sure
    if 'range' in a.extras:  # a bin of a swath is itself, whichever other one is like it
        near &= a.extras['range'][:, None] == b.extras['range'][None]
    return near


def _certain(estimate: Estimate) -> Estimate:
    """The rows that somebody would use."""
    extras, keep = estimate.extras, np.ones(len(estimate), bool)
    if 'track_state' in extras:
        keep &= extras['track_state'] > 0
    if 'existence' in extras:
        keep &= ~(extras['existence'] <= 0.5)  # NaN where it is not estimated
    if 'valid' in extras:
        keep &= extras['valid'] > 0
    return Estimate(
        stamp_ns=estimate.stamp_ns,
        frame_id=estimate.frame_id,
        xyz=estimate.xyz[keep],
        state_names=estimate.state_names,
        state=estimate.state[keep],
        covariance=estimate.covariance[keep],
        extras={name: column[keep] for name, column in extras.items()},
    )
