# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Likelihoods of a bin as in `trackers.bathymetry.filter_kernels`, the same to the bit; and of a
direction, from their definitions."""

from __future__ import annotations

import math

import numpy as np

from sonar_imm.acoustics.laplace import IMPOSSIBLE, log_density
from sonar_imm.trackers.bathymetry import filter_kernels as k


def exponentials(values):
    """exp of values (...) that are not positive; 0 below -700 and for NaN."""
    possible = values > k.LEAST_EXPONENT
    v = np.where(possible, values, k.LEAST_EXPONENT)
    whole = (v * k.PER_LN2 + k.ROUND) - k.ROUND
    f = (v - whole * k.LN2) - whole * k.LN2_REST
    p = np.full_like(f, k.E[12])
    for coefficient in k.E[11:1:-1]:
        p = coefficient + f * p
    p = 1.0 + f * (1.0 + f * p)
    return np.where(possible, np.ldexp(p, whole.astype(int)), 0.0)


def phasors(values, factor):
    """cos and sin of 2 pi factor values (n,); NaN stays NaN."""
    turns = factor * values
    f = turns - ((turns + k.ROUND) - k.ROUND)
    t = f * f
    s, c = np.full_like(f, k.S[10]), np.full_like(f, k.C[10])
    for a, b in zip(k.S[9::-1], k.C[9::-1]):
        s, c = a + t * s, b + t * c
    s = f * s
    return c * c - s * s, 2.0 * s * c


def polynomial(g, cosine, sine):
    """Re sum_k g_k z^k of z = cosine - i sine, (n,)."""
    real, imaginary = np.full_like(cosine, g[-1].real), np.full_like(cosine, g[-1].imag)
    for each in g[-2::-1]:
        x = real * cosine + imaginary * sine + each.real
        imaginary = imaginary * cosine - real * sine + each.imag
        real = x
    return real


def log_densities(q, table):
    """The tabulated log likelihood of q (n,)."""
    q = np.minimum(np.where(q > k.LOWEST, q, k.LOWEST), k.HIGHEST)
    bits = q.view(np.int64)
    x = (((bits & k.REST) << k.CELL_BITS) | k.ONE).view(np.float64) - 1.0
    constant, linear, square, cube = table[:, (bits >> k.SHIFT) - k.FIRST_CELL]
    return np.asarray(constant + x * (linear + x * (square + x * cube)))


def log_likelihoods(sines, spacing, form, base, spread, signal, table):
    """Log likelihood of direction sines (n,) for one bin, see `bins.PingLikelihood`; -inf for NaN.
    What does not depend on the direction is left out."""
    cosine, sine = phasors(sines, spacing)
    q, less = polynomial(form, cosine, sine), np.zeros_like(sines)
    if len(spread):
        gain = np.fmax(1.0 + signal * polynomial(spread, cosine, sine), 1.0)
        q, less = base + q / gain, np.array([math.log(each) for each in gain])
    return np.where(np.isnan(sines), -np.inf, log_densities(q, table) - less)


def sines_of(state, t, g):
    """Direction sines of states (n,) at bin t, NaN where no echo can come from."""
    if not g.of_heights:
        return np.where(np.abs(state) <= k.HALF_CIRCLE, phasors(state, k.TURNS)[1], np.nan)
    depth = g.height[t] - state
    if len(g.launch):
        near = min(max(int(g.row[t]), 0), len(g.launch) - 2)
        place, last = (depth - g.first_depth) / g.depth_step, g.launch.shape[1] - 2
        known = (place >= 0.0) & (place <= last + 1.0)
        i = np.minimum(np.where(known, place, 0.0).astype(int), last)
        low, high = (row[i] + (place - i) * (row[i + 1] - row[i]) for row in g.launch[near:][:2])
        depth = np.where(known, low + (g.row[t] - near) * (high - low), np.nan)
    ratio = depth / g.reach[t]
    with np.errstate(invalid='ignore'):
        return np.asarray(ratio * g.cos_tilt[t] - np.sqrt(1.0 - ratio * ratio) * g.sin_tilt[t])


def state_log_likelihoods(state, ping, t):
    """Log likelihood of states (n,) given bin t."""
    parts = (ping.form[t], ping.base[t], ping.spread[t], ping.signal[t], ping.table)
    return log_likelihoods(sines_of(state, t, ping.geometry), ping.geometry.spacing, *parts)


def drift(state, t, g):
    """Where angles (n,) of bin t - 1 are at bin t if the floor keeps its height."""
    out, rise = np.empty_like(state), g.height[t] - g.height[t - 1]
    for s, down in enumerate(state + g.tilt[t - 1]):
        depth = math.sin(down) * g.reach[t - 1] + rise
        after = math.asin(min(max(depth / g.reach[t], -1.0), 1.0))
        if abs(down) > k.HALF_CIRCLE:  # what is beyond straight down stays beyond it
            after = math.copysign(math.pi, down) - after
        out[s] = after - g.tilt[t]
    return out


def log_likelihood(sines, y, signal_variance, noise_variance, step, likelihood='laplace'):
    """Log likelihood of direction sines (...) given one snapshot y (P,), less what does not depend
    on the direction; -inf for NaN. `step` is from `array.phase_step`."""
    a = np.exp(1j * step * np.asarray(sines)[..., None] * np.arange(len(y)))
    kappa = signal_variance / (noise_variance + len(y) * signal_variance)
    beam = np.abs(a.conj() @ y) ** 2
    q = (np.vdot(y, y).real - kappa * beam) / noise_variance
    density = log_density(q, len(y)) if likelihood == 'laplace' else -q
    return np.where(np.isnan(q), IMPOSSIBLE, density)


def interfered_log_likelihood(sines, y, signal_variance, covariance, step, likelihood='laplace'):
    """The same, given the noise covariance (P, P) of the snapshot, by linear algebra."""
    u, staves = np.asarray(sines), len(y)
    a = np.exp(1j * step * np.nan_to_num(u)[..., None] * np.arange(staves))
    gamma = covariance + signal_variance * a[..., :, None] * a[..., None, :].conj()
    solved = np.linalg.solve(gamma, np.broadcast_to(y[:, None], (*u.shape, staves, 1)))[..., 0]
    q = (y.conj() * solved).sum(axis=-1).real
    density = log_density(q, staves) if likelihood == 'laplace' else -q
    determinant = np.linalg.slogdet(gamma)[1] - np.linalg.slogdet(covariance)[1]
    return np.where(np.isnan(u), IMPOSSIBLE, density - determinant)
