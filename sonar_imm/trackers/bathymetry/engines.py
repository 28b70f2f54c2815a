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

"""Two ways to run the terrain models along a ping: particles, and a grid.

Both take the same models and the same likelihood, and give the same answer up to the Monte Carlo
noise of the particles.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.elementary import normals
from .grid_kernels import filter_ping, GridMotion, smooth_ping
from .kernels import Draws, filter_block, Motion, Particles, PingLikelihood, Track
from .models import TerrainModels

# Random numbers are drawn for so many at a time, which still fit into the cache.
_BLOCK = 32768


def run_particles(
    models: TerrainModels,
    ping: PingLikelihood,
    count: int,
    entropy: tuple[int, ...],
    *,
    resample: bool = False,
    watch: Callable[[int, Particles], None] | None = None,
) -> Track:
    """The IMM particle filter along a ping, with `count` particles per model.

    entropy: integers that name this ping; the same ones give the same bits, whatever other pings
    there were. resample: resample each model after the update, as the paper's effective sample
    size of always one demands. watch: called with each bin and its particles, for pictures.
    """
    seeds = np.random.SeedSequence(entropy).spawn(3)
    start, draws, noises = (np.random.Generator(np.random.SFC64(seed)) for seed in seeds)
    T, M = models.scale.shape
    n, k = models.F.shape[1], models.G.shape[2]
    x, w = models.draw(count, start), np.full((M, count), 1.0 / count)
    particles = Particles(x, w, models.initial.copy())
    motion = Motion(
        models.F, models.G, models.scale, models.transition, models.coast, models.favour
    )
    track = _empty(T, M, n)
    block = max(1, min(_BLOCK // (M * k * count), T))
    size = M * k * count
    uniform = np.empty(block * size + block * size % 2)
    noise = np.empty_like(uniform)
    for first in range(0, T, block):
        bins = min(block, T - first)
        noises.random(out=uniform)
        normals(uniform, noise)
        block_noise = noise[: bins * size].reshape(bins, M, k, count)
        random = Draws(draws.random((bins, 2, M)), block_noise)
        if watch is None:
            filter_block(first, particles, motion, random, ping, resample, track)
            continue
        for b in range(bins):
            one = Draws(random.uniform[b : b + 1], random.noise[b : b + 1])
            filter_block(first + b, particles, motion, one, ping, resample, track)
            watch(first + b, particles)
    return _with_constants(track, ping)


def run_grid(
    models: TerrainModels, ping: PingLikelihood, cells: FloatArray, *, smooth: bool
) -> Track:
    """The exact filter along a ping for models of one state, on `cells` (G,), evenly spaced; with
    `smooth` the exact smoother."""
    T, M = models.scale.shape
    track = _empty(T, M, 1)
    track.sample_size[:] = np.nan
    shape = models.density(cells)
    p = models.initial[:, None] * (shape / shape.sum())
    sigma = models.scale / (cells[1] - cells[0])
    motion = GridMotion(cells, models.transition, sigma, models.coast, models.favour)
    window = np.empty((T, 2), np.int64)
    kept = filter_ping(p, motion, ping, window, track, smooth)
    if smooth:
        smooth_ping(kept, window, motion, ping, track)
    return _with_constants(track, ping)


def _empty(T: int, M: int, n: int) -> Track:
    return Track(np.empty((T, n)), np.empty((T, n, n)), np.empty((T, M)), np.empty(T), np.empty(T))


def _with_constants(track: Track, ping: PingLikelihood) -> Track:
    """The same with log likelihoods of the samples, not only of what depends on the state."""
    constant = np.where(ping.heard, ping.constant, 0.0)
    return track._replace(log_likelihood=track.log_likelihood + constant)
