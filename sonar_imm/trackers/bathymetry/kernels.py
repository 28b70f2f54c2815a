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

"""The particle filter along a block of range bins of one ping, compiled as one loop.

Each verb is a kernel of its own room (`estimation.imm_particles`,
`acoustics.likelihood_kernels`); here they are called bin after bin on arrays that stay in the
cache.

Shapes: T bins of a ping, M models, n states, k noises, N particles per model, P staves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...acoustics import likelihood_kernels, rays
from ...estimation import imm_particles as imm
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray
from ...estimation.elementary import phasors
from ...estimation.jit import kernel

_HALF_CIRCLE = 0.5 * math.pi
_TURNS = 0.5 / math.pi


class Geometry(NamedTuple):
    """How a state becomes a direction in each of T bins; see `acoustics.sounding`.

    of_heights: states are heights of the floor, else angles. height (T,): of the array, in the
    same terms, m; reach (T,): r C, by which a depth is divided, m; tilt (T,): psi, rad, with its
    cosine and sine; `spacing` of the staves in wavelengths, negative for a conjugated array.
    launch: where rays bend, the table of `rays.launch_table`, (0, 0) where they do not; row (T,):
    place of each range in it; first_depth and depth_step, m, of its columns.
    drift_from: the first bin that angles reach at constant height, T or more for never.
    """

    of_heights: bool
    height: FloatArray
    reach: FloatArray
    tilt: FloatArray
    cos_tilt: FloatArray
    sin_tilt: FloatArray
    spacing: float
    launch: FloatArray
    row: FloatArray
    first_depth: float
    depth_step: float
    drift_from: int


class PingLikelihood(NamedTuple):
    """The likelihood of the state in each of T bins.

    ranges (T,) in metres; heard (T,): bins that say something; form (T, P), base (T,), spread
    (T, P), or (T, 0) in white noise, signal (T,) and table: see
    `likelihood_kernels.log_likelihoods`; noise (T,): the variance it was made for; constant (T,):
    what the kernels leave out of the log likelihood.
    """

    ranges: FloatArray
    heard: BoolArray
    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    noise: FloatArray
    constant: FloatArray
    table: FloatArray
    geometry: Geometry


class Motion(NamedTuple):
    """How the models move: F (M, n, n), G (M, n, k) times scale (T, M); transition (M, M) of the
    models; `coast` is the model that moves all particles through bins where nothing is heard;
    favour (T, M): see `models.TerrainModels`, (0, M) for none."""

    F: FloatArray
    G: FloatArray
    scale: FloatArray
    transition: FloatArray
    coast: int
    favour: FloatArray


class Particles(NamedTuple):
    """x (M, n, N), their weights w (M, N) and the probabilities mu (M,) of the models."""

    x: FloatArray
    w: FloatArray
    mu: FloatArray


class Draws(NamedTuple):
    """Random numbers for B bins: uniform (B, 2, M) for mixing and resampling, standard normal
    noise (B, M, k, N)."""

    uniform: FloatArray
    noise: FloatArray


class Track(NamedTuple):
    """The floor along one ping: mean (T, n), covariance (T, n, n), probability (T, M) of each
    model, log_likelihood (T,) of each bin given those before it, sample_size (T,) effective."""

    mean: FloatArray
    covariance: FloatArray
    probability: FloatArray
    log_likelihood: FloatArray
    sample_size: FloatArray


@kernel
def sines_of(
    state: FloatArray, t: int, geometry: Geometry, work: FloatArray, out: FloatArray
) -> None:
    """Direction sines of states (n,) at bin t into out (n,), NaN where no echo can come from.
    States are heights of the floor, or angles, as `geometry` says; work (1 or more, n or more) is
    scratch."""
    n = state.shape[0]
    first = work[0, :n]
    if geometry.of_heights:
        height = geometry.height[t]
        for s in range(n):
            first[s] = height - state[s]
        if geometry.launch.shape[0] > 0:
            rays.look_up(
                geometry.launch,
                geometry.row[t],
                geometry.first_depth,
                geometry.depth_step,
                first,
            )
        likelihood_kernels.direction_sines(
            first, geometry.reach[t], geometry.cos_tilt[t], geometry.sin_tilt[t], out
        )
    else:
        phasors(state, _TURNS, first, out)
        for s in range(n):
            if not abs(state[s]) <= _HALF_CIRCLE:
                out[s] = math.nan


@kernel
def drift(state: FloatArray, t: int, geometry: Geometry, out: FloatArray) -> None:
    """Where angles (n,) of bin t - 1 are at bin t if the floor keeps its height, into out (n,).

    ``phi' = asin(sin(phi) r / r')`` for a level sonar; near nadir that is degrees a bin, more than
    a walk could follow. What is beyond straight down stays beyond it. Bent rays are taken as
    straight: it is a prediction over one bin.
    """
    rise = geometry.height[t] - geometry.height[t - 1]
    for s in range(state.shape[0]):
        down = state[s] + geometry.tilt[t - 1]
        depth = math.sin(down) * geometry.reach[t - 1] + rise
        ratio = min(max(depth / geometry.reach[t], -1.0), 1.0)
        after = math.asin(ratio)
        if down > _HALF_CIRCLE:
            after = math.pi - after
        elif down < -_HALF_CIRCLE:
            after = -math.pi - after
        out[s] = after - geometry.tilt[t]


@kernel
def favoured(c: FloatArray, favour: FloatArray) -> None:
    """Predicted probabilities c (M,) times what favours each model, as probabilities again."""
    total = 0.0
    for j in range(c.shape[0]):
        c[j] *= favour[j]
        total += c[j]
    for j in range(c.shape[0]):
        c[j] /= total


@kernel
def filter_block(
    first: int,
    particles: Particles,
    motion: Motion,
    draws: Draws,
    ping: PingLikelihood,
    resample: bool,
    track: Track,
) -> None:
    """Bins first, first + 1, ... of a ping, as many as `draws` last for.

    `particles` are carried on, the answers go into `track`. Where nothing is heard the chain of
    the models rests. `resample` resamples each model's particles after the update, before the
    answer.
    """
    x, w, mu = particles
    M, n, N = x.shape
    F, G, scale, noise = motion.F, motion.G, motion.scale, draws.noise
    heard, geometry, table = ping.heard, ping.geometry, ping.table
    form, base, spread, signal = ping.form, ping.base, ping.spread, ping.signal
    scratch = imm.ResampleScratch(np.empty((M, N)), np.empty(N), np.empty(N + 1, np.int64))
    sines, value = np.empty(N), np.empty((M, N))
    mixed, work, c = np.empty((M, n, N)), np.empty((4, N)), np.empty(M)
    step, alone = np.empty((n, G.shape[2])), np.eye(M)
    for b in range(noise.shape[0]):
        t = first + b
        if heard[t]:
            imm.resample(x, w, mu, motion.transition, draws.uniform[b, 0], scratch, mixed, c)
            if motion.favour.shape[0] > 0:
                favoured(c, motion.favour[t])
        for j in range(M):
            model = j if heard[t] else motion.coast
            for a in range(n):
                for k in range(G.shape[2]):
                    step[a, k] = G[model, a, k] * scale[t, model]
            if t >= geometry.drift_from:
                before = mixed[j, 0] if heard[t] else x[j, 0]
                drift(before, t, geometry, before)
            if heard[t]:
                imm.propagate(mixed[j], F[model], step, noise[b, j], x[j])
                # Written out: a call that takes the whole of `ping` would cost 5 % of the ping.
                sines_of(x[j, 0], t, geometry, work, sines)
                likelihood_kernels.log_likelihoods(
                    sines,
                    geometry.spacing,
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
                imm.propagate(x[j], F[model], step, noise[b, j], mixed[j])
                for a in range(n):
                    for s in range(N):
                        x[j, a, s] = mixed[j, a, s]
        track.log_likelihood[t] = imm.weigh(value, c, w, mu, work[:2]) if heard[t] else 0.0
        track.sample_size[t] = imm.effective_sample_size(w, mu)
        if resample and heard[t]:
            imm.resample(x, w, mu, alone, draws.uniform[b, 1], scratch, mixed, c)
            for j in range(M):
                for s in range(N):
                    w[j, s] = 1.0 / N
                    for a in range(n):
                        x[j, a, s] = mixed[j, a, s]
        imm.summarise(x, w, mu, track.mean[t], track.covariance[t])
        for j in range(M):
            track.probability[t, j] = mu[j]
