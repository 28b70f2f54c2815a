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

"""`estimation.jipda` in readable numpy form: its joint events listed and summed."""

from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.estimation.covariance import add_jitter
from sonar_imm.estimation.jipda import LEAST_GATE, MOST_EVENTS, OPENS_GATE, SMALLER


class Likelihoods(NamedTuple):
    """density (T, D, M): ``N(z_i; h_j, S_j)``; mixture (T, D): f; nis (T, D): the least of the
    models that open a gate, infinite where there is none."""

    density: FloatArray
    mixture: FloatArray
    nis: FloatArray


class Association(NamedTuple):
    """beta (T, D), missed (T,): see the module's text; existence (T,) is their sum."""

    beta: FloatArray
    missed: FloatArray
    existence: FloatArray


def likelihoods(
    h: FloatArray, H: FloatArray, P: FloatArray, c: FloatArray, z: FloatArray, R: FloatArray
) -> Likelihoods:
    """How each detection (D, m) with covariance R (D, m, m) fits each model of
    each track.

    h (T, M, m): what the models expect; H (T or 1, M, m, n); P (T, M, n, n) and c (T, M),
    predicted.
    """
    S, _ = add_jitter((H @ P @ np.swapaxes(H, -1, -2))[:, None] + R[None, :, None])
    v = z[None, :, None] - h[:, None]
    nis = np.einsum('tdjm,tdjm->tdj', v, np.linalg.solve(S, v[..., None])[..., 0])
    m = h.shape[-1]
    density = np.exp(-0.5 * (nis + m * np.log(2.0 * np.pi) + np.linalg.slogdet(S)[1]))
    opens = (c > OPENS_GATE)[:, None]
    return Likelihoods(
        density,
        np.einsum('tj,tdj->td', c, density),
        np.where(opens, nis, np.inf).min(axis=-1, initial=np.inf),
    )


def associate(
    ratio: FloatArray,
    nis: FloatArray,
    existence: FloatArray,
    detection_probability: FloatArray,
    threshold: float,
) -> Association:
    """The sums over all joint events.

    ratio (T, D): f / lambda; nis (T, D): a pair is possible where it is below `threshold`, and
    below less in a cluster that is too large; existence, detection_probability (T,).
    """
    T, D = ratio.shape
    beta = np.zeros((T, D))
    missed = existence * (1.0 - detection_probability)
    missed = missed / (1.0 - existence * detection_probability)
    for tracks, inside in _clusters(nis, threshold):
        total, alone = 0.0, np.zeros(T)
        shares = np.zeros((T, D))
        for event in _events(inside, tracks):
            weight = 1.0
            for t, d in zip(tracks, event):
                detected = existence[t] * detection_probability[t]
                weight *= 1.0 - detected if d < 0 else detected * ratio[t, d]
            total += weight
            for t, d in zip(tracks, event):
                if d < 0:
                    alone[t] += weight
                else:
                    shares[t, d] += weight
        beta[tracks] = shares[tracks] / total
        missed[tracks] *= alone[tracks] / total
    return Association(beta, missed, beta.sum(axis=1) + missed)


def _clusters(nis: FloatArray, threshold: float) -> list[tuple[list[int], BoolArray]]:
    """Tracks that share detections, and which pairs of them are possible (T, D)."""
    inside = nis <= threshold
    waiting = [t for t in range(len(nis)) if inside[t].any()]
    clusters = []
    while waiting:
        tracks, detections = {waiting[0]}, inside[waiting[0]]
        while new := {t for t in waiting if t not in tracks and (inside[t] & detections).any()}:
            tracks |= new
            detections = inside[sorted(tracks)].any(axis=0)
        members = sorted(tracks)
        waiting = [t for t in waiting if t not in tracks]
        own, gate = inside, threshold
        while _count(own, members) > MOST_EVENTS:
            gate = gate * SMALLER if gate > LEAST_GATE else -1.0
            own = nis <= gate
        clusters.append((members, own))
    return clusters


def _events(inside: BoolArray, tracks: list[int]) -> list[tuple[int, ...]]:
    """All ways in which each of `tracks` takes a detection or none (-1), none taken twice; in
    rising order."""
    events: list[tuple[int, ...]] = [()]
    for t in tracks:
        events = [
            (*event, d)
            for event in events
            for d in (-1, *np.flatnonzero(inside[t]).tolist())
            if d < 0 or d not in event
        ]
    return events


def _count(inside: BoolArray, tracks: list[int]) -> int:
    """The number of joint events, or a number above `MOST_EVENTS`."""
    used: set[int] = set()

    def below(place: int, limit: int) -> int:
        if place == len(tracks):
            return 1
        found = below(place + 1, limit)
        for d in np.flatnonzero(inside[tracks[place]]).tolist():
            if found > limit:
                break
            if d not in used:
                used.add(d)
                found += below(place + 1, limit - found)
                used.remove(d)
        return found

    return below(0, MOST_EVENTS)


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
