# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The IMM particle filter along the range bins of one ping, one kernel; and its random numbers.

One set of weighted particles for each model, and the verbs of every particle filter::

    resample    x, c <- x, w, mu, chain, uniform      # who could have become model j
    propagate   x <- F x + G noise                    # each model moves its particles
    weigh       w, mu <- log likelihood, c            # each particle meets the snapshot
    summarise   mean, covariance <- x, w, mu          # before anything is resampled again

There is no rejuvenation step, `move`: the noise of every model keeps copies of a particle apart.
Through a bin without an echo the chain of the models rests and particles are only propagated.

**Resampling is the mixing of the multiple-model filter, and is exact.** Given that model j holds
now, the state one step ago has the density ``sum_i mu_{i|j} p_i(x)``, ``mu_{i|j} = P_ij mu_i /
c_j``; the union of all sets with the weights ``mu_{i|j} w_i`` represents it, and N systematic
draws from the union represent it again (Boers and Driessen 2003). A Gaussian IMM has to put one
Gaussian in the place of that mixture; particles do not. No other resampling is needed: what leaves
it has equal weights. The obvious walk along the cumulative weights has a branch that no processor
can predict. Instead every particle writes its number where its copies begin, the last one to write
at a place being the one that has copies there, and a running maximum fills the places between.
Weights that are not finite give meaningless particles, but no index outside of the arrays.

**Weights are retained.** What is weighed keeps its weights until the next resampling, and the
likelihood of model j is the *weighted* mean ``L_j = sum_n w_n q_n`` of its particles' likelihoods
q_n; ``w_n <- w_n q_n / L_j``, ``mu_j <- c_j L_j / sum``. The answer is summarised before particles
are drawn again, since drawing can only add noise to it.

**Likelihoods without calls of the C library**, which would prevent that the processor runs several
particles at a time. exp is a polynomial and a shift into the exponent, cos and sin of 2 pi v are
polynomials of what is left of v without its nearest whole number, doubled. The log likelihood of
an echo comes from `acoustics.laplace.likelihood_table`: a double holds its own logarithm, its
exponent and first bits number the cells of a table, the other bits say where in the cell it lies.

Loops over particles are written so that the compiler can run them several at a time: no branch, no
running sum, one array written. What cannot be is kept apart. Nothing is allocated here.

References: Y. Boers, J. Driessen, *Interacting multiple model particle filter*, IEE Proc. Radar
Sonar Navig. 150(5), 2003; H. Driessen, Y. Boers, *Efficient particle filter for jump Markov
nonlinear systems*, ibid. 152(5), 2005.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...estimation.jit import kernel

LEAST_CHANCE = 1e-290
"""A model less probable than this before a measurement counts as one that nothing can become: the
reciprocal of its probability could not be held."""
ROUND = 1.5 * 2.0**52
"""Adding this to a double and taking it away again rounds it to a whole number; in between, the
low bits hold that number."""
HALF_CIRCLE = 0.5 * math.pi
TURNS = 0.5 / math.pi

PER_LN2 = 1.0 / math.log(2.0)
# ln 2 in two parts: products of the first with whole numbers up to 1075 are exact.
LN2, LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10
LEAST_EXPONENT = -700.0
E = tuple(1.0 / math.factorial(k) for k in range(13))
# Taylor series in f^2 of sin(pi f) / f and cos(pi f), for abs(f) <= 1/2.
S = tuple((-1.0) ** k * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(11))
C = tuple((-1.0) ** k * math.pi ** (2 * k) / math.factorial(2 * k) for k in range(11))

# The cells of `acoustics.laplace.likelihood_table`: 32 to the octave, from 2^-20 to 2^50.
LOWEST, HIGHEST = 2.0**-20, 2.0**50 * (1.0 - 2.0**-50)
CELL_BITS = 5
SHIFT = 52 - CELL_BITS
FIRST_CELL = (1023 - 20) << CELL_BITS
REST = (1 << SHIFT) - 1
ONE = 1023 << 52

ROOT2, LN_2 = math.sqrt(2.0), math.log(2.0)
MANTISSA = (1 << 52) - 1
# A double with these bits and a small whole number in its lowest ones is 2^52 plus that number.
WHOLE, WHOLE_EXPONENT = 1075 << 52, 2.0**52 + 1023.0


@kernel
def filter_block(
    first: int,
    x: NDArray[np.float64],
    w: NDArray[np.float64],
    mu: NDArray[np.float64],
    F: NDArray[np.float64],
    G: NDArray[np.float64],
    scale: NDArray[np.float64],
    chains: NDArray[np.float64],
    coast: int,
    favour: NDArray[np.float64],
    uniform: NDArray[np.float64],
    noise: NDArray[np.float64],
    echo: NDArray[np.bool_],
    form: NDArray[np.complex128],
    base: NDArray[np.float64],
    spread: NDArray[np.complex128] | None,
    signal: NDArray[np.float64],
    table: NDArray[np.float64],
    height: NDArray[np.float64],
    reach: NDArray[np.float64],
    cos_tilt: NDArray[np.float64],
    sin_tilt: NDArray[np.float64],
    spacing: float,
    launch: NDArray[np.float64] | None,
    row: NDArray[np.float64],
    first_depth: float,
    depth_step: float,
    tilt: NDArray[np.float64] | None,
    drift_from: int,
    c: NDArray[np.float64],
    running: NDArray[np.float64],
    value: NDArray[np.float64],
    mixed: NDArray[np.float64],
    origin: NDArray[np.int64],
    work: NDArray[np.float64],
    bits: NDArray[np.int64],
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    probability: NDArray[np.float64],
    log_likelihood: NDArray[np.float64],
    sample_size: NDArray[np.float64],
) -> None:
    """Filter bins first, first + 1, ... of a ping of T bins, as many as there is noise for.

    M models, n states, k noises, N particles a model. Carried on: particles x (M, n, N), their
    weights w (M, N), the probabilities mu (M,) of the models. How models move: F (M, n, n),
    G (M, n, k) times scale (T, M); chains (1 or 2, M, M): the transition matrix of the models, and
    a second one to resample by after each bin; coast: the model of all particles in bins without
    an echo; favour (T, M): see `models.TerrainModels`, (0, M) for none. Drawn: uniform (B, 2, M),
    standard normal noise (B, M, k, N).

    The likelihood, see `bins.PingLikelihood`: echo (T,), form (T, P), base (T,), spread
    (T, P) or None in white noise, signal (T,), table. The geometry, see `bins.Geometry`:
    launch is None where rays are straight, tilt None for states that are heights.

    Scratch: c (M,), running and value (M, N), mixed (M, n, N), origin (N + 1,), work (5, N) and
    the same memory as whole numbers, bits. Into mean (T, n), covariance (T, n, n),
    probability (T, M), log_likelihood (T,) of each bin given those before it without what the
    table leaves out, -inf when no particle could explain it and the prediction was kept, and
    sample_size (T,), effective.
    """
    M, n, N = x.shape
    K, last = G.shape[2], form.shape[1] - 1
    for b in range(noise.shape[0]):
        t = first + b
        for turn in range(chains.shape[0]):
            if echo[t]:
                # Resample: equally weighted particles for each model into `mixed`.
                for i in range(M):
                    total = 0.0
                    for s in range(N):
                        total += w[i, s]
                        running[i, s] = total
                for j in range(M):
                    c[j], total = 0.0, 0.0
                    for i in range(M):
                        c[j] += chains[turn, i, j] * mu[i]
                    # What nothing can become draws from the mixture of all: it stays finite, and
                    # can come back when the chain allows.
                    possible = c[j] > LEAST_CHANCE
                    for i in range(M):
                        share = chains[turn, i, j] * mu[i] if possible else mu[i]
                        total += share * running[i, N - 1]
                    for k in range(N + 1):
                        origin[k] = 0
                    begin, before, by = 0, 0.0, N / total
                    for i in range(M):
                        share = chains[turn, i, j] * mu[i] if possible else mu[i]
                        for s in range(N):
                            point = (before + share * running[i, s]) * by - uniform[b, turn, j]
                            whole = (point + ROUND) - ROUND
                            work[0, s] = whole + 1.0 if whole < point else whole
                        before += share * running[i, N - 1]
                        for s in range(N):
                            origin[begin] = i * N + s
                            begin = int(work[0, s]) if work[0, s] < N else N
                    source = 0
                    for k in range(N):
                        source = max(source, origin[k])
                        origin[k] = source
                    for a in range(n):
                        i = 0
                        for k in range(N):
                            while origin[k] >= (i + 1) * N:
                                i += 1
                            mixed[j, a, k] = x[i, a, origin[k] - i * N]
                if turn == 0 and favour.shape[0] > 0:
                    total = 0.0
                    for j in range(M):
                        c[j] *= favour[t, j]
                        total += c[j]
                    for j in range(M):
                        c[j] /= total
            if turn == 1:
                for j in range(M if echo[t] else 0):
                    for s in range(N):
                        w[j, s] = 1.0 / N
                        for a in range(n):
                            x[j, a, s] = mixed[j, a, s]
                continue
            best = -math.inf
            for j in range(M):
                model = j if echo[t] else coast
                if not echo[t]:
                    for a in range(n):
                        for s in range(N):
                            mixed[j, a, s] = x[j, a, s]
                if tilt is not None:
                    # Where angles are now if the floor keeps its height: asin(sin(phi) r / r') for
                    # a level sonar; near nadir that is degrees a bin, more than a walk could
                    # follow. What is beyond straight down stays beyond it. Bent rays are taken as
                    # straight: it is a prediction over one bin.
                    for s in range(N if t >= drift_from else 0):
                        rise = height[t] - height[t - 1]
                        down = mixed[j, 0, s] + tilt[t - 1]
                        depth = math.sin(down) * reach[t - 1] + rise
                        ratio = min(max(depth / reach[t], -1.0), 1.0)
                        after = math.asin(ratio)
                        if down > HALF_CIRCLE:
                            after = math.pi - after
                        elif down < -HALF_CIRCLE:
                            after = -math.pi - after
                        mixed[j, 0, s] = after - tilt[t]
                # Propagate.
                for a in range(n):
                    for s in range(N):
                        x[j, a, s] = 0.0
                    for i in range(n):
                        factor = F[model, a, i]
                        if factor != 0.0:
                            for s in range(N):
                                x[j, a, s] += factor * mixed[j, i, s]
                    for k in range(K):
                        factor = G[model, a, k] * scale[t, model]
                        if factor != 0.0:
                            for s in range(N):
                                x[j, a, s] += factor * noise[b, j, k, s]
                if not echo[t]:
                    continue
                # Direction sines into work[0], NaN where no echo can come from.
                if tilt is None:
                    for s in range(N):
                        work[0, s] = height[t] - x[j, 0, s]
                    if launch is not None:
                        k = min(max(int(row[t]), 0), launch.shape[0] - 2)
                        f, columns = row[t] - k, launch.shape[1] - 2
                        for s in range(N):
                            place = (work[0, s] - first_depth) / depth_step
                            if not 0.0 <= place <= columns + 1.0:
                                work[0, s] = math.nan
                                continue
                            i = min(int(place), columns)
                            g = place - i
                            low = launch[k, i] + g * (launch[k, i + 1] - launch[k, i])
                            high = launch[k + 1, i] + g * (launch[k + 1, i + 1] - launch[k + 1, i])
                            work[0, s] = low + f * (high - low)
                    for s in range(N):
                        ratio = work[0, s] / reach[t]
                        across = math.sqrt(1.0 - ratio * ratio)
                        work[0, s] = ratio * cos_tilt[t] - across * sin_tilt[t]
                else:
                    for s in range(N):
                        work[0, s] = x[j, 0, s]
                # cos and sin of angles, then of the phase from stave to stave, into work[1:3].
                for stage in range(1 if tilt is None else 0, 2):
                    factor = spacing if stage == 1 else TURNS
                    for s in range(N):
                        turns = factor * work[0, s]
                        f = turns - ((turns + ROUND) - ROUND)
                        g = f * f
                        sine = S[8] + g * (S[9] + g * S[10])
                        sine = S[4] + g * (S[5] + g * (S[6] + g * (S[7] + g * sine)))
                        sine = f * (S[0] + g * (S[1] + g * (S[2] + g * (S[3] + g * sine))))
                        cosine = C[8] + g * (C[9] + g * C[10])
                        cosine = C[4] + g * (C[5] + g * (C[6] + g * (C[7] + g * cosine)))
                        cosine = C[0] + g * (C[1] + g * (C[2] + g * (C[3] + g * cosine)))
                        work[1, s] = cosine * cosine - sine * sine
                        work[2, s] = 2.0 * sine * cosine
                    if stage == 0:
                        for s in range(N):
                            there = abs(x[j, 0, s]) <= HALF_CIRCLE
                            work[0, s] = work[2, s] if there else math.nan
                # The quadratic form q by Horner's rule into work[3].
                re, im = form[t, last].real, form[t, last].imag
                for s in range(N):
                    work[3, s] = re
                    work[4, s] = im
                for k in range(last - 1, -1, -1):
                    re, im = form[t, k].real, form[t, k].imag
                    for s in range(N):
                        z = work[3, s] * work[1, s] + work[4, s] * work[2, s] + re
                        work[4, s] = work[4, s] * work[1, s] - work[3, s] * work[2, s] + im
                        work[3, s] = z
                if spread is not None:
                    # Beside interferers: the gain 1 + ss2 a^H R^-1 a, and its logarithm.
                    re, im = spread[t, last].real, spread[t, last].imag
                    for s in range(N):
                        value[j, s] = re
                        work[4, s] = im
                    for k in range(last - 1, -1, -1):
                        re, im = spread[t, k].real, spread[t, k].imag
                        for s in range(N):
                            z = value[j, s] * work[1, s] + work[4, s] * work[2, s] + re
                            work[4, s] = work[4, s] * work[1, s] - value[j, s] * work[2, s] + im
                            value[j, s] = z
                    for s in range(N):
                        gain = max(1.0 + signal[t] * value[j, s], 1.0)
                        work[3, s] = base[t] + work[3, s] / gain
                        work[2, s] = math.log(gain)
                for s in range(N):
                    q = work[3, s] if work[3, s] > LOWEST else LOWEST  # NaN goes to the low end
                    work[3, s] = q if q < HIGHEST else HIGHEST
                for s in range(N):
                    bits[1, s] = ((bits[3, s] & REST) << CELL_BITS) | ONE
                for s in range(N):
                    f = work[1, s] - 1.0
                    # Unsigned, so that no check for an index from the end gets into the loop.
                    cell = np.uint64((bits[3, s] >> SHIFT) - FIRST_CELL)
                    cubic = table[2, cell] + f * table[3, cell]
                    value[j, s] = table[0, cell] + f * (table[1, cell] + f * cubic)
                if spread is not None:
                    for s in range(N):
                        value[j, s] -= work[2, s]
                for s in range(N):
                    value[j, s] = value[j, s] if work[0, s] == work[0, s] else -math.inf
                for s in range(N):
                    best = value[j, s] if value[j, s] > best else best
            log_likelihood[t] = 0.0
            if echo[t]:
                # Weigh.
                everything = 0.0
                for j in range(M):
                    mu[j] = c[j]
                    for s in range(N):
                        w[j, s] = 1.0 / N
                for j in range(M if math.isfinite(best) else 0):
                    for s in range(N):
                        value[j, s] -= best
                    for s in range(N):
                        v = value[j, s] if value[j, s] > LEAST_EXPONENT else LEAST_EXPONENT
                        whole = v * PER_LN2 + ROUND
                        work[0, s] = whole
                        whole -= ROUND
                        f = (v - whole * LN2) - whole * LN2_REST
                        p = E[9] + f * (E[10] + f * (E[11] + f * E[12]))
                        p = E[5] + f * (E[6] + f * (E[7] + f * (E[8] + f * p)))
                        p = E[2] + f * (E[3] + f * (E[4] + f * p))
                        work[1, s] = 1.0 + f * (1.0 + f * p)
                    for s in range(N):
                        bits[0, s] = (bits[0, s] + 1023) << 52
                    total = 0.0
                    for s in range(N):
                        q = work[1, s] * work[0, s] if value[j, s] > LEAST_EXPONENT else 0.0
                        value[j, s] = w[j, s] * q
                    for s in range(N):
                        total += value[j, s]
                    mu[j] = c[j] * total
                    everything += mu[j]
                    for s in range(N):
                        value[j, s] = value[j, s] / total if total > 0.0 else w[j, s]
                if everything > 0.0:
                    for j in range(M):
                        mu[j] /= everything
                        for s in range(N):
                            w[j, s] = value[j, s]
                    log_likelihood[t] = best + math.log(everything)
                else:
                    for j in range(M):
                        mu[j] = c[j]
                    log_likelihood[t] = -math.inf
            sample_size[t] = 0.0
            for j in range(M):
                total = 0.0
                for s in range(N):
                    total += w[j, s] * w[j, s]
                sample_size[t] += mu[j] / total
        # Summarise: mean and covariance of the mixture of all models.
        for a in range(n):
            mean[t, a] = 0.0
            for i in range(n):
                covariance[t, a, i] = 0.0
        for j in range(M):
            probability[t, j] = mu[j]
            for a in range(n):
                total = 0.0
                for s in range(N):
                    total += w[j, s] * x[j, a, s]
                mean[t, a] += mu[j] * total
        for j in range(M):
            for a in range(n):
                for i in range(a + 1):
                    total = 0.0
                    for s in range(N):
                        off = w[j, s] * (x[j, a, s] - mean[t, a])
                        total += off * (x[j, i, s] - mean[t, i])
                    covariance[t, a, i] += mu[j] * total
                    covariance[t, i, a] = covariance[t, a, i]


@kernel
def normals(
    uniform: NDArray[np.float64],
    bits: NDArray[np.int64],
    out: NDArray[np.float64],
    exponent: NDArray[np.int64],
) -> None:
    """Standard normal numbers (n,) from uniform ones in [0, 1) (n,), n even; uniform is used up.
    bits and exponent: the memory of uniform and of out as whole numbers.

    Box and Muller: sqrt(-2 ln v) times the cosine and the sine of a random angle. v = 2^e m, and
    ln m is the series of the inverse hyperbolic tangent of (m - 1) / (m + 1).
    """
    half = uniform.shape[0] // 2
    for i in range(half):
        uniform[i] = 1.0 - uniform[i]
    for i in range(half):
        exponent[i] = (bits[i] >> 52) | WHOLE
        bits[i] = (bits[i] & MANTISSA) | ONE
    for i in range(half):
        m, e = uniform[i], out[i] - WHOLE_EXPONENT
        e = e + 1.0 if m > ROOT2 else e
        m = 0.5 * m if m > ROOT2 else m
        f = (m - 1.0) / (m + 1.0)
        t = f * f
        p = 1.0 / 11.0 + t * (1.0 / 13.0 + t * (1.0 / 15.0 + t * (1.0 / 17.0 + t / 19.0)))
        p = 1.0 / 3.0 + t * (1.0 / 5.0 + t * (1.0 / 7.0 + t * (1.0 / 9.0 + t * p)))
        uniform[i] = math.sqrt(max(-2.0 * (e * LN_2 + 2.0 * f * (1.0 + t * p)), 0.0))
    for i in range(half):
        turns = uniform[half + i]
        f = turns - ((turns + ROUND) - ROUND)
        g = f * f
        sine = S[8] + g * (S[9] + g * S[10])
        sine = S[4] + g * (S[5] + g * (S[6] + g * (S[7] + g * sine)))
        sine = f * (S[0] + g * (S[1] + g * (S[2] + g * (S[3] + g * sine))))
        cosine = C[8] + g * (C[9] + g * C[10])
        cosine = C[4] + g * (C[5] + g * (C[6] + g * (C[7] + g * cosine)))
        cosine = C[0] + g * (C[1] + g * (C[2] + g * (C[3] + g * cosine)))
        out[i] = uniform[i] * (cosine * cosine - sine * sine)
        out[half + i] = uniform[i] * (2.0 * sine * cosine)
