# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whether a range bin holds two surfaces (``gated``), and the height of both (``resolved``).

Only stretches of a ping are looked at in which `acoustics.layover` finds a second surface
possible. There an exact filter and smoother runs on a grid of heights. A bin is of order 1, one
height h, or of order 2, a pair h1 < h2 at least `APART` from each other::

    birth   order 1 -> 2: the height stays, the other one may be anywhere
    end     order 2 -> 1: either height survives
    move    each height walks, mostly little; sometimes it goes anywhere, as three surfaces do
            that take turns to be the two strongest

The amplitudes of the echoes are integrated out. With the local signal-to-noise ratio v,
d = P + 1/v, b = a^H y of the middle of the array, y in units of the noise, and real
G = a1^H a2 = n / m, n = sin(P x / 2), m = sin(x / 2), x the difference of both phase steps::

    log l1 = |b|^2 / d - log(1 + v P)
    log l2 = (d (|b1|^2 + |b2|^2) - 2 G Re(conj(b1) b2)) / (d^2 - G^2) - log(v^2 (d^2 - G^2))

Multiplied by m^2, a pair takes one division. All moves are symmetric and act on each height by
itself, so that the smoother uses them as they are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...acoustics import rays
from ...acoustics.layover import BIRTH, END, Layover
from ...acoustics.variances import HALF_WIDTH, mean_power, moving_mean
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray
from .bins import Geometry, PingLikelihood
from .surface_kernels import pair_likelihoods, step_orders, weigh_orders

POSSIBLE, MARGIN = 0.05, 10
"""A stretch is where the chain says more than this, and so many bins around it."""
BRIGHTER, AROUND = 3.0, 60
"""It is also where the power, a mean of 21 bins, is so many times the median of so many bins to
either side: what faces the sonar is bright, also where two waves are too faint for the chain."""
EXISTS = 0.5
"""From this probability on both surfaces are soundings."""
FEWEST_STAVES = 4
STEP, BELOW, ABOVE, ABOVE_HIGHER = 0.1, 1.5, 4.5, 1.5
"""Metres: the grid's step, and how far it reaches below and above the lower of the floors at both
ends of a stretch, and at least above the higher one."""
MOST_CELLS = 121
LONGEST = 4000
"""A stretch of more bins is cut: what is kept of each bin takes 14 kB or more."""
APART = 0.3
WALK = (0.98, 0.03), (0.02, 0.2)
WALK_OF_TWO = (0.7, 0.04), (0.3, 0.2)
"""Share and standard deviation, m, of the moves from one bin to the next."""
ANYWHERE = 0.002
NOISE = 1.3
"""By this factor noise is larger than stated: there are more than two echoes in many bins."""
WIDER, WIDEST = 1.5, 0.05
"""Standard deviations are larger than those of the grid by this factor, and by so many metres."""
START_STD, LEAST_START = 0.1, 1e-9
"""How near the floor a stretch begins, m; and what cells have that lie further away."""


class Surfaces(NamedTuple):
    """existence (T,) of a second surface, the heights (T, 2) of the lower and the upper one and
    their variances (T, 2), NaN outside stretches."""

    existence: FloatArray
    height: FloatArray
    variance: FloatArray


class Moves(NamedTuple):
    """How bins follow each other: birth and end of the second height, the chance that a height
    goes `anywhere`, the walks of one height and of each of two, (K + 1,) see `_taps`, and the
    least distance of two, `gap`, in cells."""

    birth: float
    end: float
    anywhere: float
    walk: FloatArray
    walk_of_two: NDArray[np.float32]
    gap: int


def possible_bins(iq: np.ndarray, second: Layover) -> BoolArray:
    """Bins (T,) of iq (T, P) in which a second surface is possible: the chain says so, or they are
    `BRIGHTER` than those around them."""
    power = np.nan_to_num(moving_mean(mean_power(iq), HALF_WIDTH, second.usable))
    # Made longer here: scipy 1.15 gives zeros for fewer bins than half a window.
    usual = median_filter(np.pad(power, AROUND, 'edge'), 2 * AROUND + 1)[AROUND:-AROUND]
    bright = second.usable & (power > BRIGHTER * usual)
    return np.asarray((second.existence > POSSIBLE) | bright)


def stretches(possible: BoolArray) -> list[tuple[int, int]]:
    """First bin and end of each stretch around bins (T,) in which a second surface is possible."""
    near = np.convolve(possible, np.ones(2 * MARGIN + 1))[MARGIN:-MARGIN] > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]]).astype(np.int8)))
    return [
        (low, min(low + LONGEST, end))
        for first, end in edges.reshape(-1, 2).tolist()
        for low in range(first, end, LONGEST)
    ]


def resolve(
    iq: np.ndarray, ping: PingLikelihood, geometry: Geometry, second: Layover, floor: FloatArray
) -> Surfaces:
    """Both surfaces in the stretches of a ping: iq (T, P), how heights become directions, what
    `acoustics.layover` says, and the height of the floor (T,) as a single surface has it."""
    existence = np.array(second.existence)
    height, variance = np.full((2, len(existence), 2), np.nan)
    snr = ping.signal / ping.noise
    larger = NOISE * (1.0 + second.array_error * snr)
    moves = Moves(
        BIRTH,
        END,
        ANYWHERE,
        _taps(WALK),
        _taps(WALK_OF_TWO).astype(np.float32),
        round(APART / STEP),
    )
    for first, end in stretches(possible_bins(iq, second)):
        here = slice(first, end)
        cells = _cells(floor, first, end)
        start = np.exp(-0.5 * np.square((cells - floor[first]) / START_STD)) + LEAST_START
        found = smooth_stretch(
            start / start.sum(),
            cells,
            (iq[here] / np.sqrt(ping.noise * larger)[here, None]).astype(np.complex128),
            (snr / larger)[here],
            second.usable[here],
            _sines(cells, geometry, here),
            geometry.spacing,
            moves,
        )
        known = np.isfinite(found.existence)
        existence[here][known] = found.existence[known]
        height[here], variance[here] = found.height, found.variance
    return Surfaces(existence, height, WIDER**2 * (variance + STEP**2 / 12.0) + WIDEST**2)


def _cells(floor: FloatArray, first: int, end: int) -> FloatArray:
    """The grid (G,) of a stretch, by the floors before and behind it."""
    before = float(np.median(floor[max(first - MARGIN, 0) : first + MARGIN]))
    behind = float(np.median(floor[max(end - MARGIN, 0) : end + MARGIN]))
    low, high = min(before, behind), max(before, behind)
    top = max(low + ABOVE, high + ABOVE_HIGHER)
    count = min(round((top - low + BELOW) / STEP) + 1, MOST_CELLS)
    return np.asarray(low - BELOW + STEP * np.arange(count, dtype=np.float64))


def _taps(walk: tuple[tuple[float, float], ...]) -> FloatArray:
    """Probabilities (K + 1,) of moving by 0, 1, ... K cells in either direction."""
    reach = math.ceil(3.5 * max(std for _, std in walk) / STEP)
    place = STEP * np.arange(-reach, reach + 1)
    taps = np.zeros(2 * reach + 1)
    for share, std in walk:
        part = np.exp(-0.5 * np.square(place / std))
        taps += share * part / part.sum()
    return np.ascontiguousarray(taps[reach:])


def smooth_stretch(
    start: FloatArray,
    cells: FloatArray,
    y: ComplexArray,
    ratio: FloatArray,
    usable: BoolArray,
    sines: FloatArray,
    spacing: float,
    moves: Moves,
) -> Surfaces:
    """Both surfaces of a stretch of n bins, with the means and variances of the grid.

    start (G,): probabilities of cells (G,), heights of order 1, at the first bin; y (n, P) in
    units of the noise, ratio (n,) of signal to noise, and which bins are usable (n,): the others
    say nothing; sines (n, G) of the cells, NaN where no echo can come from.
    """
    n, G = sines.shape
    K, gap = len(moves.walk_of_two) - 1, moves.gap
    pairs = (G - gap) * (G - gap + 1) // 2
    # Of each bin: what it says itself, and what it and those before say; pairs row after row.
    likely_lone, likely_two = np.ones((n, G)), np.ones((n, pairs), np.float32)
    kept_lone, kept_two = np.empty((n, G)), np.empty((n, pairs), np.float32)
    lone, two = start.copy(), np.zeros((G + 2 * K, G + 2 * K), np.float32)
    sums, flat, half = np.empty((3, G)), two.ravel(), np.zeros(two.size, np.float32)
    work, squares, answer = np.empty((11, G)), np.empty((2, G, G)), np.empty((n, 6))
    bits = work.view(np.int64)
    heard = usable & ~np.isnan(sines).all(axis=1)

    def step(backward: bool) -> None:
        step_orders(lone, two, *moves, backward, sums, flat, half)

    def weigh(t: int, backward: bool) -> None:
        likely, kept = (likely_lone[t], likely_two[t]), (kept_lone[t], kept_two[t])
        weigh_orders(lone, two, *likely, *kept, cells, gap, backward, answer[t])

    for t in range(n):
        if t > 0:
            step(backward=False)
        if heard[t]:
            scratch = work, bits, squares[0], squares[1]
            said = likely_lone[t], likely_two[t]
            pair_likelihoods(y[t], ratio[t], sines[t], spacing, gap, *scratch, *said)
        weigh(t, backward=False)
    # From here on what later bins say of each height and pair.
    lone[:] = 1.0
    two[K : K + G, K : K + G] = np.triu(np.ones((G, G)), gap)
    for t in range(n - 1, -1, -1):
        weigh(t, backward=True)
        if t > 0:
            step(backward=True)
    single, double = answer[:, 0], answer[:, 1]
    answer[~(double > 0.0), 2:] = np.nan
    with np.errstate(invalid='ignore'):
        return Surfaces(double / (single + double), answer[:, 2:4], answer[:, 4:])


def _sines(cells: FloatArray, geometry: Geometry, here: slice) -> FloatArray:
    """Direction sines (n, G) of heights `cells` (G,) in the bins `here`, NaN where no echo can
    come from."""
    g = geometry
    rise = g.height[here, None] - cells
    if len(g.launch):
        rise = rays.look_up(g.launch, g.row[here], g.first_depth, g.depth_step, rise)
    with np.errstate(invalid='ignore'):
        ratio = rise / g.reach[here, None]
        across = np.sqrt(1.0 - ratio * ratio)
        return np.asarray(ratio * g.cos_tilt[here, None] - across * g.sin_tilt[here, None])
