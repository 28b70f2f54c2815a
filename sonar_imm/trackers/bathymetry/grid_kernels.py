"""The grid filter and smoother along the range bins of one ping, compiled.

The verbs are those of `estimation.grid_kernels`; see `bathymetry_kernels.filter_block` for the
arguments that describe the ping.
"""

from __future__ import annotations

import numpy as np

from ...acoustics import likelihood_kernels as law
from ...estimation import grid_kernels as grid
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from ...estimation.jit import kernel
from .kernels import sines_of


@kernel
def filter_ping(
    p: FloatArray,
    cells: FloatArray,
    transition: FloatArray,
    sigma: FloatArray,
    coast: int,
    slant_range: FloatArray,
    heard: BoolArray,
    form: ComplexArray,
    base: FloatArray,
    spread: ComplexArray,
    signal: FloatArray,
    geometry: FloatArray,
    table: FloatArray,
    window: IntArray,
    mean: FloatArray,
    covariance: FloatArray,
    probability: FloatArray,
    log_likelihood: FloatArray,
    keep: bool,
) -> FloatArray:
    """All T bins from p (M, G), the joint probability before the first; sigma (T, M) in cells.

    The windows [low, high) of the filtered densities go to window (T, 2). With `keep` the
    densities themselves are given, one after the other, M rows each; else nothing (0,).
    """
    (M, G), T = p.shape, slant_range.shape[0]
    mixed, scratch = np.empty((M, G)), np.empty((7, max(G, 128) + 16))
    work, value, sines = np.empty((4, G)), np.empty(G), np.empty(G)
    kept, used = np.empty(4096 if keep else 0), 0
    low, high = grid.trim(p, 0, G)
    for t in range(T):
        reach = 0
        if heard[t]:
            grid.mix(p, low, high, transition, mixed)
        else:
            for j in range(M):
                for g in range(low, high):
                    mixed[j, g] = p[j, g]
        for j in range(M):
            reach = max(reach, grid.reach_of(sigma[t, j if heard[t] else coast]))
        new_low, new_high = max(low - reach, 0), min(high + reach, G)
        for j in range(M):
            width = sigma[t, j if heard[t] else coast]
            grid.walk(mixed[j], low, high, width, scratch, p[j], new_low, new_high)
        low, high = new_low, new_high
        n = high - low
        if heard[t]:
            bins_sines, bins_value = sines[:n], value[:n]
            sines_of(cells[low:high], slant_range[t], geometry, work, bins_sines)
            law.log_likelihoods(
                bins_sines,
                geometry[3],
                form[t],
                base[t],
                spread[t],
                signal[t],
                table,
                work,
                bins_value,
            )
        else:
            bins_value = value[:n]
            for g in range(n):
                bins_value[g] = 0.0
        log_likelihood[t] = grid.update(p, low, high, bins_value, work)
        low, high = grid.trim(p, low, high)
        window[t, 0], window[t, 1] = low, high
        mean[t, 0], covariance[t, 0, 0] = grid.combine(p, low, high, cells, probability[t])
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
    cells: FloatArray,
    transition: FloatArray,
    sigma: FloatArray,
    coast: int,
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
) -> None:
    """Forward-backward: what `filter_ping` kept, given the whole ping; the answers of all bins but
    the last are written anew."""
    M, G, T = transition.shape[0], cells.shape[0], slant_range.shape[0]
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
        if heard[t + 1]:
            n = high - low
            bins_sines, bins_value = sines[:n], value[:n]
            sines_of(cells[low:high], slant_range[t + 1], geometry, work, bins_sines)
            law.log_likelihoods(
                bins_sines,
                geometry[3],
                form[t + 1],
                base[t + 1],
                spread[t + 1],
                signal[t + 1],
                table,
                work,
                bins_value,
            )
            grid.update(beta, low, high, bins_value, work)
        new_low, new_high = window[t, 0], window[t, 1]
        for j in range(M):
            width = sigma[t + 1, j if heard[t + 1] else coast]
            grid.walk(beta[j], low, high, width, scratch, back[j], new_low, new_high)
        low, high = new_low, new_high
        if heard[t + 1]:
            grid.mix(back, low, high, transition.T, beta)
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
        mean[t, 0], covariance[t, 0, 0] = grid.combine(p, low, high, cells, probability[t])
