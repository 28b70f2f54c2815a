# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""`estimation.jipda` in readable numpy form: its joint events listed and summed."""

from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.estimation.covariance import add_jitter


class Association(NamedTuple):
    """beta (T, D), missed (T,): see the module's text; existence (T,) is their sum."""

    beta: FloatArray
    missed: FloatArray
    existence: FloatArray


def densities(
    h: FloatArray, H: FloatArray, P: FloatArray, z: FloatArray, R: FloatArray
) -> FloatArray:
    """Return ``N(z_i; h_j, S_j)``, (T, D, M), of detections z (D, m) with covariances R (D, m, m).

    h (T, M, m): what the models expect; H (T or 1, M, m, n); P (T, M, n, n), predicted.
    """
    S, _ = add_jitter((H @ P @ np.swapaxes(H, -1, -2))[:, None] + R[None, :, None])
    v = z[None, :, None] - h[:, None]
    nis = np.einsum('tdjm,tdjm->tdj', v, np.linalg.solve(S, v[..., None])[..., 0])
    m = h.shape[-1]
    return np.asarray(np.exp(-0.5 * (nis + m * np.log(2.0 * np.pi) + np.linalg.slogdet(S)[1])))


def associate(
    ratio: FloatArray,
    possible: BoolArray,
    existence: FloatArray,
    detection_probability: FloatArray,
) -> Association:
    """The sums over all joint events.

    ratio (T, D): f / lambda; possible (T, D); existence, detection_probability (T,).
    """
    T, D = ratio.shape
    detected = existence * detection_probability
    beta, none, total = np.zeros((T, D)), np.zeros(T), 0.0
    for event in events(possible):
        weight = 1.0
        for t, d in enumerate(event):
            weight *= 1.0 - detected[t] if d < 0 else detected[t] * ratio[t, d]
        total += weight
        for t, d in enumerate(event):
            if d < 0:
                none[t] += weight
            else:
                beta[t, d] += weight
    beta, none = beta / total, none / total
    missed = none * existence * (1.0 - detection_probability) / (1.0 - detected)
    return Association(beta, missed, beta.sum(axis=1) + missed)


def events(possible: BoolArray) -> list[tuple[int, ...]]:
    """List all ways in which each track takes a detection or none (-1), none taken twice, in
    rising order; possible (T, D)."""
    found: list[tuple[int, ...]] = [()]
    for row in possible:
        found = [
            (*event, d)
            for event in found
            for d in (-1, *np.flatnonzero(row).tolist())
            if d < 0 or d not in event
        ]
    return found


def update(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    innovation: FloatArray,
    H: FloatArray,
    R: FloatArray,
    beta: FloatArray,
    missed: float,
    considered: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One track by all its detections, x (M, n), P (M, n, n) and mu (M,).

    innovation (D, M, m); H (M, m, n); R (D, m, m); beta (D,), missed: given that the target
    exists, so that they sum to one; considered: (n,) states that have an influence but are not
    estimated.
    """
    M, n = x.shape
    if not beta.any():
        return x.copy(), P.copy(), c.copy()
    S = (H @ P @ np.swapaxes(H, -1, -2))[None] + R[:, None]
    root = np.linalg.cholesky(S)
    white = np.linalg.solve(root, innovation[..., None])[..., 0]
    log = -0.5 * np.sum(white**2, axis=-1) - np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(
        axis=-1
    )
    log_c = np.log(np.where(c > 0.0, c, 1.0)) + np.where(c > 0.0, 0.0, -np.inf)
    # share[i, j] = beta_i N_ji / f_i, in the log domain: f_i is the sum over the models.
    top = (log + log_c).max(axis=1, keepdims=True)
    mixture = top + np.log(np.exp(log + log_c - top).sum(axis=1, keepdims=True))
    share = beta[:, None] * np.exp(log - mixture)
    weight = missed + share.sum(axis=0)
    mu = c * weight
    x1, P1 = np.empty((M, n)), np.empty((M, n, n))
    for j in range(M):
        b0, b = missed / weight[j], share[:, j] / weight[j]
        gain = P[j] @ H[j].T @ np.linalg.inv(S[:, j])
        if considered is not None:
            gain[:, considered] = 0.0
        shift = np.einsum('dam,dm->da', gain, innovation[:, j])
        mean = b @ shift
        left = np.eye(n) - gain @ H[j]
        after = left @ P[j] @ np.swapaxes(left, -1, -2) + gain @ R @ np.swapaxes(gain, -1, -2)
        spread = np.einsum('d,da,db->ab', b, shift, shift) - np.outer(mean, mean)
        total = b0 * P[j] + np.einsum('d,dab->ab', b, after) + spread
        x1[j], P1[j] = x[j] + mean, 0.5 * (total + total.T)
    return x1, P1, mu / mu.sum()
