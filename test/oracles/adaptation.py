# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What `estimation.adaptation` learns with the form `counts`, as array operations."""

import numpy as np

from sonar_imm.estimation.arrays import FloatArray


def transition_posterior(P: FloatArray, mu_before: FloatArray, mu_after: FloatArray) -> FloatArray:
    """Pr(i at k-1, j at k | data to k) = W_ij mu_j, W the mixing weights.

    P: (..., M, M); mu_before, mu_after: (..., M). Gives (..., M, M).
    """
    joint = P * mu_before[..., :, None]
    c = joint.sum(axis=-2, keepdims=True)
    return np.asarray(joint / np.where(c > 0.0, c, 1.0) * mu_after[..., None, :])


def adapt_counts(
    counts: FloatArray, expected: FloatArray, posterior: FloatArray, nominal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Dirichlet counts, n_ij += W_ij mu_j, beside the counts that the nominal
    matrix predicts for the same step.

    All (..., M, M); gives the new (counts, expected). See `counts_correction`.
    """
    return counts + posterior, expected + posterior.sum(axis=-1, keepdims=True) * nominal


def counts_correction(
    counts: FloatArray, expected: FloatArray, prior: FloatArray, weight: float
) -> FloatArray:
    """Factor for each transition, (n + N0 P0) / (e + N0 P0). `prior` P0 is the
    matrix of the reference step, `weight` N0.

    At a constant step e_ij = n_i. P0_ij, and the corrected matrix is the Dirichlet posterior mean,
    rownorm(n + N0 P0). At irregular steps the factor still compares counts of the same steps.
    """
    given = expected + weight * prior
    return np.asarray(
        np.where(given > 0.0, (counts + weight * prior) / np.where(given > 0.0, given, 1.0), 1.0)
    )


def corrected(P: FloatArray, correction: FloatArray) -> FloatArray:
    """Apply a learnt factor to the matrix of any step and renormalise the rows. (..., M, M)."""
    out = P * correction
    total = out.sum(axis=-1, keepdims=True)
    return np.asarray(np.where(total > 0.0, out / np.where(total > 0.0, total, 1.0), P))
