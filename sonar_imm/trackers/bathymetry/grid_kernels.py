"""The grid filter and smoother along the range bins of one ping, compiled.

The verbs are those of `estimation.grid_kernels`. Shapes: T bins of a ping, M models, G cells.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...acoustics import likelihood_kernels
from ...estimation import grid_kernels as grid
from ...estimation.arrays import FloatArray, IntArray
from ...estimation.jit import kernel
from .kernels import PingLikelihood, sines_of, Track


class GridMotion(NamedTuple):
    """How the models move on the grid: cells (G,), the states it is made of; transition (M, M) of
    the models; sigma (T, M) of their walks, in cells; `coast` is the model that all follow through
    bins where nothing is heard."""

    cells: FloatArray
    transition: FloatArray
    sigma: FloatArray
    coast: int


@kernel
def filter_ping(
    p: FloatArray,
    motion: GridMotion,
    ping: PingLikelihood,
    window: IntArray,
    track: Track,
    keep: bool,
) -> FloatArray:
    """All T bins from p (M, G), the joint probability before the first.

    The windows [low, high) of the filtered densities go into window (T, 2), the answers into
    `track`. With `keep` the densities themselves are returned, one after the other, M rows each;
    else nothing (0,).
    """
    (M, G), T = p.shape, ping.ranges.shape[0]
    cells, sigma, coast = motion.cells, motion.sigma, motion.coast
    mixed, scratch = np.empty((M, G)), np.empty((7, max(G, 128) + 16))
    work, value, sines = np.empty((4, G)), np.empty(G), np.empty(G)
    kept, used = np.empty(4096 if keep else 0), 0
    low, high = grid.trim(p, 0, G)
    for t in range(T):
        heard, reach = ping.heard[t], 0
        if heard:
            grid.mix(p, low, high, motion.transition, mixed)
        else:
            for j in range(M):
                for g in range(low, high):
                    mixed[j, g] = p[j, g]
        for j in range(M):
            reach = max(reach, grid.reach_of(sigma[t, j if heard else coast]))
        new_low, new_high = max(low - reach, 0), min(high + reach, G)
        for j in range(M):
            width = sigma[t, j if heard else coast]
            grid.walk(mixed[j], low, high, width, scratch, p[j], new_low, new_high)
        low, high = new_low, new_high
        n = high - low
        here = value[:n]
        if heard:
            _log_likelihoods(cells[low:high], ping, t, sines[:n], work, here)
        else:
            for g in range(n):
                here[g] = 0.0
        track.log_likelihood[t] = grid.update(p, low, high, here, work)
        low, high = grid.trim(p, low, high)
        window[t, 0], window[t, 1] = low, high
        track.mean[t, 0], track.covariance[t, 0, 0] = grid.combine(
            p, low, high, cells, track.probability[t]
        )
        if keep:
            needed = used + M * (high - low)
            if needed > kept.shape[0]:
                larger = np.empty(2 * needed)
                for s in range(used):
                    larger[s] = kept[s]
                kept = larger
            for j in range(M):
                for g in range(low, high):
                    kept[used] = p[j, g]
                    used += 1
    return kept


@kernel
def smooth_ping(
    kept: FloatArray,
    window: IntArray,
    motion: GridMotion,
    ping: PingLikelihood,
    track: Track,
) -> None:
    """Forward-backward: what `filter_ping` kept, given the whole ping. The answers of all bins but
    the last are written anew into `track`."""
    cells, coast = motion.cells, motion.coast
    M, G, T = motion.transition.shape[0], cells.shape[0], ping.ranges.shape[0]
    beta, back, p = np.empty((M, G)), np.empty((M, G)), np.empty((M, G))
    scratch, work = np.empty((7, max(G, 128) + 16)), np.empty((4, G))
    value, sines = np.empty(G), np.empty(G)
    end = 0
    for t in range(T):
        end += M * (window[t, 1] - window[t, 0])
    low, high = window[T - 1, 0], window[T - 1, 1]
    for j in range(M):
        for g in range(low, high):
            beta[j, g] = 1.0
    end -= M * (high - low)
    for t in range(T - 2, -1, -1):
        heard = ping.heard[t + 1]
        if heard:
            n = high - low
            _log_likelihoods(cells[low:high], ping, t + 1, sines[:n], work, value[:n])
            grid.update(beta, low, high, value[:n], work)
        new_low, new_high = window[t, 0], window[t, 1]
        for j in range(M):
            width = motion.sigma[t + 1, j if heard else coast]
            grid.walk(beta[j], low, high, width, scratch, back[j], new_low, new_high)
        low, high = new_low, new_high
        if heard:
            grid.mix(back, low, high, motion.transition.T, beta)
        else:
            for j in range(M):
                for g in range(low, high):
                    beta[j, g] = back[j, g]
        end -= M * (high - low)
        total, s = 0.0, end
        for j in range(M):
            for g in range(low, high):
                p[j, g] = kept[s] * beta[j, g]
                total += p[j, g]
                s += 1
        for j in range(M):
            for g in range(low, high):
                p[j, g] /= total
        track.mean[t, 0], track.covariance[t, 0, 0] = grid.combine(
            p, low, high, cells, track.probability[t]
        )


@kernel
def _log_likelihoods(
    state: FloatArray,
    ping: PingLikelihood,
    t: int,
    sines: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Log likelihood of states (n,) given bin t into out (n,); sines (n,) and work (4, n or more)
    are scratch."""
    sines_of(state, ping.ranges[t], ping.geometry, work, sines)
    likelihood_kernels.log_likelihoods(
        sines,
        ping.geometry.spacing,
        ping.form[t],
        ping.base[t],
        ping.spread[t],
        ping.signal[t],
        ping.table,
        work,
        out,
    )
