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

"""What the filters along the range bins of one ping work on; and the filter on a grid.

`filter_ping` and `smooth_ping` do on a grid, with the verbs of `estimation.grid`, what
`filter_kernels` does with particles. What they work on stays in the cache.

Shapes: T bins of a ping, M models, n states, N particles per model, G cells of the grid, P staves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...acoustics import likelihood_kernels
from ...estimation import grid
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray, IntArray
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

    ranges (T,) in metres; echo (T,): bins with an echo; form (T, P), base (T,), spread
    (T, P), or (T, 0) in white noise, signal (T,) and table: see
    `likelihood_kernels.log_likelihoods`; noise (T,): the variance it was made for; constant (T,):
    what the kernels leave out of the log likelihood.
    """

    ranges: FloatArray
    echo: BoolArray
    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    noise: FloatArray
    constant: FloatArray
    table: FloatArray
    geometry: Geometry


class Particles(NamedTuple):
    """x (M, n, N), their weights w (M, N) and the probabilities mu (M,) of the models."""

    x: FloatArray
    w: FloatArray
    mu: FloatArray


class Track(NamedTuple):
    """The floor along one ping: mean (T, n), covariance (T, n, n), probability (T, M) of each
    model, log_likelihood (T,) of each bin given those before it, sample_size (T,) effective."""

    mean: FloatArray
    covariance: FloatArray
    probability: FloatArray
    log_likelihood: FloatArray
    sample_size: FloatArray


class GridMotion(NamedTuple):
    """How the models move on the grid: cells (G,), the states it is made of; transition (M, M) of
    the models; sigma (T, M) of their walks, in cells; `coast` is the model that all follow through
    bins without an echo; favour (T, M): see `models.TerrainModels`, (0, M) for none."""

    cells: FloatArray
    transition: FloatArray
    sigma: FloatArray
    coast: int
    favour: FloatArray


class Drift(NamedTuple):
    """Where each cell goes if the floor keeps its height: `first` (G,), the cell before the one
    that lies just before that place, and the weights (4, G) of that and the next three cells.

    The weights are those of cubic interpolation, which keep the first four moments: splitting
    between two cells would add noise at every bin."""

    first: IntArray
    weight: FloatArray


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
            look_up(
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
def look_up(
    value: FloatArray, row: float, first_depth: float, depth_step: float, depth: FloatArray
) -> None:
    """Replace depths (n,) by ``r sin(phi)`` from a launch table (R, D), bilinearly; row: the range
    over its range step. NaN outside the table."""
    k = min(max(int(row), 0), value.shape[0] - 2)
    f = row - k
    near, far, last = value[k], value[k + 1], value.shape[1] - 2
    for s in range(depth.shape[0]):
        place = (depth[s] - first_depth) / depth_step
        if not 0.0 <= place <= last + 1.0:
            depth[s] = math.nan
            continue
        i = min(int(place), last)
        g = place - i
        low = near[i] + g * (near[i + 1] - near[i])
        high = far[i] + g * (far[i + 1] - far[i])
        depth[s] = low + f * (high - low)


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
def find_drift(
    cells: FloatArray,
    low: int,
    high: int,
    t: int,
    geometry: Geometry,
    out: Drift,
    work: FloatArray,
) -> tuple[int, int]:
    """The drift of the cells [low, high) from bin t - 1 to bin t; the window they reach. work (1
    or more, G) is scratch."""
    G, step = cells.shape[0], cells[1] - cells[0]
    to = work[0, : high - low]
    drift(cells[low:high], t, geometry, to)
    new_low, new_high = G, 0
    for g in range(low, high):
        place = min(max((to[g - low] - cells[0]) / step, 1.0), G - 3.0)
        k = min(int(place), G - 3)
        f = place - k
        out.first[g] = k - 1
        out.weight[0, g] = -f * (f - 1.0) * (f - 2.0) / 6.0
        out.weight[1, g] = (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0
        out.weight[2, g] = -(f + 1.0) * f * (f - 2.0) / 2.0
        out.weight[3, g] = (f + 1.0) * f * (f - 1.0) / 6.0
        new_low, new_high = min(new_low, k - 1), max(new_high, k + 3)
    return new_low, new_high


@kernel
def push(
    p: FloatArray, low: int, high: int, cells: Drift, out: FloatArray, to_low: int, to_high: int
) -> None:
    """Probability p (G,) on [low, high) carried along, into out (G,) on [to_low, to_high)."""
    for g in range(to_low, to_high):
        out[g] = 0.0
    for g in range(low, high):
        for i in range(4):
            out[cells.first[g] + i] += cells.weight[i, g] * p[g]
    for g in range(to_low, to_high):
        out[g] = max(out[g], 0.0)


@kernel
def pull(
    beta: FloatArray, low: int, high: int, cells: Drift, out: FloatArray, to_low: int, to_high: int
) -> None:
    """The adjoint of `push`: what the future says of where each cell of [low, high) goes, from
    beta (G,) on [to_low, to_high), zero outside, into out (G,)."""
    for g in range(low, high):
        total = 0.0
        for i in range(4):
            k = cells.first[g] + i
            if to_low <= k < to_high:
                total += cells.weight[i, g] * beta[k]
        out[g] = max(total, 0.0)


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
    carried = Drift(np.empty(G, np.int64), np.empty((4, G)))
    low, high = grid.trim(p, 0, G)
    for t in range(T):
        echo, reach = ping.echo[t], 0
        if echo:
            grid.mix(p, low, high, motion.transition, mixed)
            if motion.favour.shape[0] > 0:
                favour_cells(mixed, low, high, motion.favour[t])
        else:
            for j in range(M):
                for g in range(low, high):
                    mixed[j, g] = p[j, g]
        if t >= ping.geometry.drift_from:
            to_low, to_high = find_drift(cells, low, high, t, ping.geometry, carried, work)
            for j in range(M):
                push(mixed[j], low, high, carried, p[j], to_low, to_high)
                for g in range(to_low, to_high):
                    mixed[j, g] = p[j, g]
            low, high = to_low, to_high
        for j in range(M):
            reach = max(reach, grid.reach_of(sigma[t, j if echo else coast]))
        new_low, new_high = max(low - reach, 0), min(high + reach, G)
        for j in range(M):
            width = sigma[t, j if echo else coast]
            grid.walk(mixed[j], low, high, width, scratch, p[j], new_low, new_high)
        low, high = grid.trim(p, new_low, new_high)
        n = high - low
        here = value[:n]
        if echo:
            state_log_likelihoods(cells[low:high], ping, t, sines[:n], work, here)
        else:
            for g in range(n):
                here[g] = 0.0
        track.log_likelihood[t] = grid.weigh(p, low, high, here, work)
        low, high = grid.trim(p, low, high)
        window[t, 0], window[t, 1] = low, high
        track.mean[t, 0], track.covariance[t, 0, 0] = grid.summarise(
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
    carried = Drift(np.empty(G, np.int64), np.empty((4, G)))
    backwards, end = motion.transition.T.copy(), 0  # in rows, as `grid.mix` is compiled for
    for t in range(T):
        end += M * (window[t, 1] - window[t, 0])
    low, high = window[T - 1, 0], window[T - 1, 1]
    for j in range(M):
        for g in range(low, high):
            beta[j, g] = 1.0
    end -= M * (high - low)
    for t in range(T - 2, -1, -1):
        echo = ping.echo[t + 1]
        if echo:
            n = high - low
            state_log_likelihoods(cells[low:high], ping, t + 1, sines[:n], work, value[:n])
            grid.weigh(beta, low, high, value[:n], work)
        new_low, new_high = window[t, 0], window[t, 1]
        drifts = t + 1 >= ping.geometry.drift_from
        to_low, to_high = new_low, new_high
        if drifts:
            to_low, to_high = find_drift(
                cells, new_low, new_high, t + 1, ping.geometry, carried, work
            )
        for j in range(M):
            width = motion.sigma[t + 1, j if echo else coast]
            grid.walk(beta[j], low, high, width, scratch, back[j], to_low, to_high)
            if drifts:
                pull(back[j], new_low, new_high, carried, beta[j], to_low, to_high)
                for g in range(new_low, new_high):
                    back[j, g] = beta[j, g]
        low, high = new_low, new_high
        if echo:
            if motion.favour.shape[0] > 0:
                favour_cells(back, low, high, motion.favour[t + 1])
            grid.mix(back, low, high, backwards, beta)
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
        track.mean[t, 0], track.covariance[t, 0, 0] = grid.summarise(
            p, low, high, cells, track.probability[t]
        )


@kernel
def favour_cells(p: FloatArray, low: int, high: int, favour: FloatArray) -> None:
    """Multiply each model's row of p (M, G) on [low, high) by its factor."""
    for j in range(p.shape[0]):
        for g in range(low, high):
            p[j, g] *= favour[j]


@kernel
def state_log_likelihoods(
    state: FloatArray,
    ping: PingLikelihood,
    t: int,
    sines: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Log likelihood of states (n,) given bin t into out (n,); sines (n,) and work (4, n or more)
    are scratch."""
    sines_of(state, t, ping.geometry, work, sines)
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
