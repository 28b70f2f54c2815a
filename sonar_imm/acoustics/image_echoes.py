# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Echoes in images of a forward-looking sonar, with their place, spread and variance.

    level -> threshold -> sidelobes blanked -> grown and joined -> centroid

`cfar` says which cells are loud. A strong echo shows in the sidelobes of all beams of its range,
so cells far below the loudest of their range are left out. Connected cells above a lower threshold
are a part, and parts that come within `join_distance` of each other are one echo: a chain or a
float is a group of glints. At least one cell of it has to be above the higher threshold. Its place
is the centroid weighted by power.

The variance of a centroid is, in range and likewise in bearing,

    (w / 2)^2 / SNR + (step / 10)^2 + max(0, S - S_point)

w is the -3 dB width of the echo of a point, S the second moment of the echo and S_point that of a
point. Over something extended the centroid wanders by the *whole* spread from ping to ping,
because the glints interfere; dividing by the number of cells would be wrong. An echo on the edge
of the image is cut off and has w^2 more.
"""

from __future__ import annotations

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from ..estimation.arrays import FloatArray
from .cfar import effective_cells, quiet_level, tail_factor, threshold_factor

MAX_CELLS = 20_000
"""Loud cells of an image, the strongest, that are looked at."""
_GAUSSIAN = 1.0 / (8.0 * np.log(2.0))
"""Variance of a Gaussian pattern whose -3 dB width is 1."""
_LARGEST = 1e38
"""Squares of the largest float32 still fit into a float64."""


@frozen(kw_only=True)
class EchoRules:
    """How echoes are separated from noise.

    beam_width rad and range_resolution m: -3 dB widths of the echo of a point; false_alarm: of a
    cell of Rayleigh noise; margin: that threshold is so much higher (power), for noise with longer
    tails; growth: false alarm probability of the other cells of an echo; sidelobe: cells below
    this share of the loudest power of their range are left out; join_distance m; nearest m: cells
    nearer tell noise only; beams, training, guard: see `cfar.noise_level`.
    """

    beam_width: float
    range_resolution: float
    false_alarm: float = 1e-6
    margin: float = 2.0
    growth: float = 1e-3
    sidelobe: float = 10.0**-1.7
    join_distance: float = 1.5
    nearest: float = 0.0
    beams: int = 25
    training: int = 16
    guard: int = 4


@frozen(eq=False)
class Echoes:
    """n echoes, strongest first: range m and bearing rad of the centroids, their variances, the
    spread (standard deviation) along both, peak amplitude and peak power over noise, each (n,)."""

    range: FloatArray
    bearing: FloatArray
    var_range: FloatArray
    var_bearing: FloatArray
    extent_range: FloatArray
    extent_bearing: FloatArray
    amplitude: FloatArray
    snr: FloatArray


def find_echoes(
    amplitude: FloatArray,
    distance: FloatArray,
    bearing: FloatArray,
    rules: EchoRules,
) -> Echoes:
    """The echoes in `amplitude` (R, B) with rows at `distance` (R,) m and beams at `bearing` (B,)
    rad, both finite and in order. Cells that are not finite count as silence.

    Raises ValueError for an image that is not two-dimensional.
    """
    power = np.square(np.where(np.isfinite(amplitude), amplitude, 0.0).clip(-_LARGEST, _LARGEST))
    step = _step(distance), _step(bearing)
    width = max(rules.range_resolution, step[0]), max(rules.beam_width, step[1])
    level, sides, rough = quiet_level(
        power, beams=rules.beams, training=rules.training, guard=rules.guard
    )
    if not power.size:
        return _nothing()
    cells = effective_cells(rules.training, width[0] / step[0])
    cells *= effective_cells(min(rules.beams, power.shape[1]), width[1] / step[1])
    high = _thresholds(rules.false_alarm, cells, sides)
    high *= rules.margin * tail_factor(rough, rules.false_alarm)
    low = _thresholds(rules.growth, cells, sides)
    low[distance < rules.nearest] = np.inf
    with np.errstate(invalid='ignore'):  # an infinite threshold of a silent cell
        loud = power > low[:, None] * level
    loud &= power >= rules.sidelobe * power.max(axis=1, keepdims=True)
    row, beam, part = _cells(loud, power)
    if not len(row):
        return _nothing()
    part = joined_parts(part, distance[row], bearing[beam], rules.join_distance)
    certain = np.bincount(part, power[row, beam] > high[row] * level[row, beam]) > 0
    row, beam, part = row[certain[part]], beam[certain[part]], part[certain[part]]
    if not len(row):
        return _nothing()
    part = (np.cumsum(certain) - 1)[part]
    return _measured(part, row, beam, power, level, distance, bearing, step, width)


def _step(axis: FloatArray) -> float:
    """The usual distance of two neighbours, 1 when there are none."""
    steps = np.abs(np.diff(axis))
    steps = steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else 1.0


def _thresholds(false_alarm: float, cells: float, sides: FloatArray) -> FloatArray:
    """Factor (R,) for each row; infinite without any noise to compare with."""
    whole = max(1, round(cells))
    factors = np.array(
        [
            np.inf,
            threshold_factor(false_alarm, whole, 1),
            threshold_factor(false_alarm, whole, 2),
        ]
    )
    return factors[sides.astype(int)]


def _cells(loud: NDArray[np.bool_], power: FloatArray) -> tuple[NDArray[np.intp], ...]:
    """Row, beam and number of the connected part of the loud cells, row by row; of too many only
    the strongest."""
    from scipy.ndimage import label

    row, beam = np.nonzero(loud)
    if len(row) > MAX_CELLS:
        least = np.partition(power[row, beam], len(row) - MAX_CELLS)[len(row) - MAX_CELLS]
        loud = loud & (power >= least)
        row, beam = np.nonzero(loud)
    numbers, _ = label(loud, structure=np.ones((3, 3), int))
    return row, beam, numbers[row, beam].astype(np.intp) - 1


def _measured(
    part: NDArray[np.intp],
    row: NDArray[np.intp],
    beam: NDArray[np.intp],
    power: FloatArray,
    level: FloatArray,
    distance: FloatArray,
    bearing: FloatArray,
    step: tuple[float, float],
    width: tuple[float, float],
) -> Echoes:
    weight = power[row, beam]
    count = int(part.max()) + 1
    total = np.bincount(part, weight, count)

    def moments(value: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean = np.bincount(part, weight * value, count) / total
        return mean, np.bincount(part, weight * np.square(value - mean[part]), count) / total

    r, S_r = moments(distance[row])
    b, S_b = moments(bearing[beam])
    order = np.lexsort((-weight, part))  # the loudest cell of each part first
    peak = order[np.searchsorted(part[order], np.arange(count))]
    loudest = weight[peak]
    noise = level[row[peak], beam[peak]]
    snr = loudest / np.maximum(noise, np.finfo(float).tiny)
    variances = [
        np.square(0.5 * w) / snr + np.square(0.1 * s) + np.maximum(0.0, S - w**2 * _GAUSSIAN)
        for w, s, S in zip(width, step, (S_r, S_b))
    ]
    # Of an echo on the edge of the image one side is missing.
    for index, w, size in ((row, width[0], power.shape[0]), (beam, width[1], power.shape[1])):
        edge = np.bincount(part, (index == 0) | (index == size - 1), count) > 0
        variances[0 if index is row else 1] += np.square(w) * edge
    best = np.argsort(-loudest, kind='stable')
    columns = (r, b, *variances, np.sqrt(S_r), np.sqrt(S_b), np.sqrt(loudest), snr)
    return Echoes(*(column[best] for column in columns))


def _nothing() -> Echoes:
    return Echoes(*(np.empty(0) for _ in range(8)))


def joined_parts(
    part: NDArray[np.intp], distance: FloatArray, bearing: FloatArray, reach: float
) -> NDArray[np.intp]:
    """Part numbers (n,) of cells in which parts with cells within `reach` of each other have the
    same one: 0, 1, ... without gaps. The cells lie at `distance` (n,) m, ascending, and `bearing`
    (n,) rad."""
    from scipy.spatial import cKDTree

    reach, count = max(reach, 1e-9), int(part.max()) + 1
    place = np.stack([np.cos(bearing), np.sin(bearing)]) * distance
    # Cells in one square are within reach: what is joined by squares needs no look at its cells.
    corner = np.floor(place / (reach * np.sqrt(0.5)))
    square, of_cell = np.unique(corner[0] + 1j * corner[1], return_inverse=True)
    root = _connected(part, count + of_cell)
    close = cKDTree(np.stack([square.real, square.imag], axis=1)).query_pairs(
        3.0, output_type='ndarray'
    )
    apart = close[np.diff(root[count + close], axis=1)[:, 0] != 0]
    cell = np.flatnonzero(np.isin(of_cell, apart))
    near = cell[cKDTree(place.T[cell]).query_pairs(reach, output_type='ndarray')]
    root = _connected(*np.concatenate([np.stack([part, count + of_cell], axis=1), part[near]]).T)
    _, first, number = np.unique(root[part], return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]


def _connected(a: NDArray[np.intp], b: NDArray[np.intp]) -> NDArray[np.intp]:
    """The component (n,) of each of the nodes of a graph with edges from `a` (e,) to `b` (e,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = int(max(a.max(), b.max())) + 1
    edges = coo_array((np.ones(len(a)), (a, b)), shape=(size, size))
    return np.asarray(connected_components(edges, directed=False)[1], np.intp)
