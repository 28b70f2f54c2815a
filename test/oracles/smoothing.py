# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Rauch-Tung-Striebel smoother, which `estimation.smoothing` must equal for one model."""

import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.covariance import add_jitter, symmetrise, transpose
from sonar_imm.estimation.kalman import apply


def rts_smooth(
    x: FloatArray, P: FloatArray, F: FloatArray, Q: FloatArray, B: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Smooth a forward pass of one model: x (K, ..., n) and P (K, ..., n, n)
    filtered; F, Q (K, ..., n, n) and B (K, ..., n) of the move into each step. Returns the
    smoothed x and P."""
    smoothed_x, smoothed_P = x.copy(), P.copy()
    for k in range(len(x) - 2, -1, -1):
        predicted = apply(F[k + 1], x[k]) + (0.0 if B is None else B[k + 1])
        S = F[k + 1] @ P[k] @ transpose(F[k + 1]) + Q[k + 1]
        gain = P[k] @ transpose(F[k + 1]) @ np.linalg.pinv(S, hermitian=True)
        kept = np.eye(x.shape[-1]) - gain @ F[k + 1]
        smoothed_x[k] = x[k] + apply(gain, smoothed_x[k + 1] - predicted)
        noise = gain @ (Q[k + 1] + smoothed_P[k + 1]) @ transpose(gain)
        smoothed_P[k] = add_jitter(symmetrise(kept @ P[k] @ transpose(kept) + noise))[0]
    return smoothed_x, smoothed_P
