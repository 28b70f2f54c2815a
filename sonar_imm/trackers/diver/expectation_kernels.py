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

"""What a ping would measure of a predicted diver, compiled: for association, NIS and residuals."""

from __future__ import annotations

import math

import numpy as np

from ...acoustics.arrivals_3d import BEARING, observe
from ...estimation.arrays import FloatArray
from ...estimation.jit import kernel
from .ping_kernels import Numbers


@kernel
def fit_numbers(
    x: FloatArray, P: FloatArray, mu: FloatArray, height: float, numbers: Numbers
) -> tuple[FloatArray, FloatArray]:
    """Log-likelihood (C,) of each number under the mixture of the models x (M, n), P (M, n, n), mu
    (M,), and its least NIS (C,) of any model."""
    M, n = x.shape
    C = len(numbers.value)
    likelihood, least = np.zeros(C), np.full(C, np.inf)
    g = np.empty(n)
    for c in range(C):
        for j in range(M):
            nu = numbers.value[c] - observe(
                numbers.kind[c], x[j], numbers.columns[c], height, numbers.tx[c], numbers.rx[c], g
            )
            if numbers.kind[c] == BEARING:
                nu -= 2.0 * math.pi * math.floor(nu / (2.0 * math.pi) + 0.5)
            S = numbers.variance[c]
            for a in range(n):
                if g[a] != 0.0:
                    for b in range(n):
                        S += g[a] * P[j, a, b] * g[b]
            nis = nu * nu / S
            least[c] = min(least[c], nis)
            likelihood[c] += mu[j] * math.exp(-0.5 * nis) / math.sqrt(2.0 * math.pi * S)
        likelihood[c] = math.log(max(likelihood[c], 1e-300))
    return likelihood, least


@kernel
def expect_residuals(
    x: FloatArray, mu: FloatArray, height: float, numbers: Numbers
) -> tuple[FloatArray, FloatArray]:
    """Residuals (C,), value less the one expected of the mixture of the models x (M, n), mu (M,),
    and those of each model (M, C)."""
    M, n = x.shape
    C = len(numbers.value)
    residual, nu, g = np.zeros(C), np.empty((M, C)), np.empty(n)
    for j in range(M):
        for c in range(C):
            nu[j, c] = numbers.value[c] - observe(
                numbers.kind[c], x[j], numbers.columns[c], height, numbers.tx[c], numbers.rx[c], g
            )
            if numbers.kind[c] == BEARING:
                nu[j, c] -= 2.0 * math.pi * math.floor(nu[j, c] / (2.0 * math.pi) + 0.5)
            residual[c] += mu[j] * nu[j, c]
    return residual, nu


@kernel
def expect_numbers(
    x: FloatArray, P: FloatArray, mu: FloatArray, height: float, numbers: Numbers
) -> tuple[FloatArray, FloatArray]:
    """Residuals (C,), value less the expected one, and the covariance (C, C) of what is expected,
    without the variances of the numbers, of the mixture of the models."""
    M, n = x.shape
    C = len(numbers.value)
    covariance, G, GP = np.zeros((C, C)), np.empty((C, n)), np.empty(n)
    residual, nu = expect_residuals(x, mu, height, numbers)
    for j in range(M):
        if mu[j] == 0.0:
            continue
        for c in range(C):
            observe(
                numbers.kind[c],
                x[j],
                numbers.columns[c],
                height,
                numbers.tx[c],
                numbers.rx[c],
                G[c],
            )
        for c in range(C):
            for a in range(n):
                GP[a] = 0.0
                for b in range(n):
                    GP[a] += G[c, b] * P[j, b, a]
            for d in range(c + 1):
                value = 0.0
                for a in range(n):
                    value += GP[a] * G[d, a]
                covariance[c, d] += mu[j] * value
    for c in range(C):
        for d in range(c + 1):
            for j in range(M):
                covariance[c, d] += mu[j] * (nu[j, c] - residual[c]) * (nu[j, d] - residual[d])
            covariance[d, c] = covariance[c, d]
    return residual, covariance
