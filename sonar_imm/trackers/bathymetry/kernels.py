"""The particle filter along a block of range bins of one ping, compiled as one loop.

Each verb is a kernel of its own room (`estimation.imm_particles_kernels`,
`acoustics.law_kernels`); here they are called bin after bin on arrays that stay in the cache.
"""

from __future__ import annotations

import math

import numpy as np

from ...acoustics import likelihood_kernels as law
from ...estimation import imm_particles_kernels as imm
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray
from ...estimation.elementary import phasors
from ...estimation.jit import kernel

_HALF_CIRCLE = 0.5 * math.pi
_TURNS = 0.5 / math.pi


@kernel
def sines_of(
    state: FloatArray,
    slant_range: float,
    geometry: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Direction sines of states (n,) into out (n,), NaN where no echo can come from.

    geometry: sonar height, cos tilt, sin tilt, spacing; a sonar height of NaN says that the states
    are angles, else they are heights of the floor. work (2, n) is scratch.
    """
    n = state.shape[0]
    first = work[0, :n]
    if geometry[0] == geometry[0]:
        for s in range(n):
            first[s] = geometry[0] - state[s]
        law.direction_sines(first, slant_range, geometry[1], geometry[2], out)
    else:
        phasors(state, _TURNS, first, out)
        for s in range(n):
            if not abs(state[s]) <= _HALF_CIRCLE:
                out[s] = math.nan


@kernel
def filter_block(
    first: int,
    x: FloatArray,
    w: FloatArray,
    mu: FloatArray,
    transition: FloatArray,
    F: FloatArray,
    G: FloatArray,
    scale: FloatArray,
    coast: int,
    redraw: bool,
    uniform: FloatArray,
    noise: FloatArray,
    slant_range: FloatArray,
    heard: BoolArray,
    form: ComplexArray,
    base: FloatArray,
    spread: ComplexArray,
    signal: FloatArray,
    geometry: FloatArray,
    table: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    probability: FloatArray,
    log_likelihood: FloatArray,
    sample_size: FloatArray,
) -> None:
    """Bins first, first + 1, ... of a ping, as many as `noise` (B, M, k, N) and `uniform`
    (B, 2, M) last for.

    x (M, n, N), w (M, N), mu (M,) are carried on. F (M, n, n), G (M, n, k) times scale (T, M) are
    the motions; `coast` is the model that moves all particles through bins that are not `heard`
    (T,), where the chain rests. `redraw` resamples each model's particles after the update, before
    the answer. form, base, spread, signal: the law of each of the T bins, see
    `law_kernels.log_likelihoods` (spread is (T, 0) in white noise); geometry: see `sines_of`. The
    answers go to mean (T, n), covariance (T, n, n), probability (T, M), log_likelihood (T,) and
    sample_size (T,).
    """
    M, n, N = x.shape
    running, points = np.empty((M, N)), np.empty(N)
    origin = np.empty(N + 1, np.int64)
    sines, value = np.empty(N), np.empty((M, N))
    mixed, work, c = np.empty((M, n, N)), np.empty((4, N)), np.empty(M)
    step, alone = np.empty((n, G.shape[2])), np.eye(M)
    for b in range(noise.shape[0]):
        t = first + b
        if heard[t]:
            imm.mix(x, w, mu, transition, uniform[b, 0], running, points, origin, mixed, c)
        for j in range(M):
            model = j if heard[t] else coast
            for a in range(n):
                for k in range(G.shape[2]):
                    step[a, k] = G[model, a, k] * scale[t, model]
            if heard[t]:
                imm.predict(mixed[j], F[model], step, noise[b, j], x[j])
                sines_of(x[j, 0], slant_range[t], geometry, work, sines)
                law.log_likelihoods(
                    sines,
                    geometry[3],
                    form[t],
                    base[t],
                    spread[t],
                    signal[t],
                    table,
                    work,
                    value[j],
                )
                for s in range(N):
                    w[j, s] = 1.0 / N
            else:
                imm.predict(x[j], F[model], step, noise[b, j], mixed[j])
                for a in range(n):
                    for s in range(N):
                        x[j, a, s] = mixed[j, a, s]
        log_likelihood[t] = imm.update(value, c, w, mu, work[:2]) if heard[t] else 0.0
        sample_size[t] = imm.effective_sample_size(w, mu)
        if redraw and heard[t]:
            imm.mix(x, w, mu, alone, uniform[b, 1], running, points, origin, mixed, c)
            for j in range(M):
                for s in range(N):
                    w[j, s] = 1.0 / N
                    for a in range(n):
                        x[j, a, s] = mixed[j, a, s]
        imm.combine(x, w, mu, mean[t], covariance[t])
        for j in range(M):
            probability[t, j] = mu[j]
