"""Two ways to run the terrain models along a ping: particles, and a grid.

Both take the same models and the same likelihood, and give the same answer up to the Monte Carlo
noise of the particles.
"""

from __future__ import annotations

from attrs import evolve, frozen
import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.elementary import normals
from .grid_kernels import filter_ping, smooth_ping
from .kernels import filter_block
from .likelihood import PingLikelihood
from .models import TerrainModels

# Random numbers are drawn for so many at a time, which still fit into the cache.
_BLOCK = 32768


@frozen(eq=False)
class Track:
    """The floor along one ping: mean (T, n), covariance (T, n, n), probability (T, M) of each
    model, log_likelihood (T,) of each bin given those before it, sample_size (T,) effective."""

    mean: FloatArray
    covariance: FloatArray
    probability: FloatArray
    log_likelihood: FloatArray
    sample_size: FloatArray


def run_particles(
    models: TerrainModels,
    law: PingLikelihood,
    particles: int,
    entropy: tuple[int, ...],
    *,
    redraw: bool = False,
) -> Track:
    """The IMM particle filter along a ping.

    entropy: integers that name this ping; the same ones give the same bits, whatever other pings
    there were. redraw: resample each model after the update, as the paper's effective sample size
    of always one demands.
    """
    seeds = np.random.SeedSequence(entropy).spawn(3)
    start, draws, noises = (np.random.Generator(np.random.SFC64(seed)) for seed in seeds)
    T, M = models.scale.shape
    n, k = models.F.shape[1], models.G.shape[2]
    x, w = models.draw(particles, start), np.full((M, particles), 1.0 / particles)
    mu = models.initial.copy()
    track = _empty(T, M, n)
    block = max(1, min(_BLOCK // (M * k * particles), T))
    size = M * k * particles
    uniform = np.empty(block * size + block * size % 2)
    noise = np.empty_like(uniform)
    for first in range(0, T, block):
        count = min(block, T - first)
        noises.random(out=uniform)
        normals(uniform, noise)
        filter_block(
            first,
            x,
            w,
            mu,
            models.transition,
            models.F,
            models.G,
            models.scale,
            models.coast,
            redraw,
            draws.random((count, 2, M)),
            noise[: count * size].reshape(count, M, k, particles),
            law.ranges,
            law.heard,
            law.form,
            law.base,
            law.spread,
            law.signal,
            law.geometry,
            law.table,
            track.mean,
            track.covariance,
            track.probability,
            track.log_likelihood,
            track.sample_size,
        )
    return _with_constants(track, law)


def run_grid(
    models: TerrainModels, law: PingLikelihood, cells: FloatArray, *, smooth: bool
) -> Track:
    """The exact filter along a ping for models of one state, on `cells` (G,), evenly spaced; with
    `smooth` the exact smoother."""
    T, M = models.scale.shape
    track = _empty(T, M, 1)
    track.sample_size[:] = np.nan
    shape = np.exp(-0.5 * np.square((cells - models.mean[0]) / models.std[0]))
    p = models.initial[:, None] * (shape / shape.sum())
    sigma = models.scale / (cells[1] - cells[0])
    window = np.empty((T, 2), np.int64)
    ping = (
        law.ranges,
        law.heard,
        law.form,
        law.base,
        law.spread,
        law.signal,
        law.geometry,
        law.table,
    )
    moments = track.mean, track.covariance, track.probability
    motion = cells, models.transition, sigma, models.coast
    kept = filter_ping(p, *motion, *ping, window, *moments, track.log_likelihood, smooth)
    if smooth:
        smooth_ping(kept, window, *motion, *ping, *moments)
    return _with_constants(track, law)


def _empty(T: int, M: int, n: int) -> Track:
    return Track(np.empty((T, n)), np.empty((T, n, n)), np.empty((T, M)), np.empty(T), np.empty(T))


def _with_constants(track: Track, law: PingLikelihood) -> Track:
    """The same with log likelihoods of the samples, not only of what depends on the state."""
    constant = np.where(law.heard, law.constant, 0.0)
    return evolve(track, log_likelihood=track.log_likelihood + constant)
