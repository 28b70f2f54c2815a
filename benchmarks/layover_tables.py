# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The tables of `acoustics.layover`: what L says for or against a second surface, by simulation.

    python -m benchmarks.layover_tables --staves 3 5 --table sonar_imm/acoustics/layover_tables.npz

Bins of one and of two surfaces at equal local signal-to-noise ratio, the power of each surface
exponentially distributed; the second one -12 to 12 dB beside the first and 0.3 to 4 m above it, at
ranges of 20 to 60 m, 15 m above the floor. There are two tables, for steady noise and for noise
that fades with the first surface: a table of both together misses many faint second surfaces in
steady noise. Tables of other numbers of staves in the file stay. Prints the L that one surface
exceeds once in a thousand bins, and the share of two surfaces that do.
"""

from __future__ import annotations

from itertools import product
import math
from pathlib import Path

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.acoustics import layover
from sonar_imm.acoustics.array import direction_sine, steering
from sonar_imm.estimation.arrays import ComplexArray, FloatArray

EDGES = np.array(
    [-1.0, *np.arange(0.25, 6.01, 0.25), 7.0, 8.0, 10.0, 13.0, 17.0, 25.0, 1e9], np.float64
)
DECIBELS = np.arange(0.0, 36.0, 5.0)
HEIGHT, TILT = 15.0, math.radians(30.0)


def snapshots(
    bins: int,
    staves: int,
    decibels: float,
    surfaces: int,
    rng: np.random.Generator,
    fades: bool = False,
) -> ComplexArray:
    """Snapshots (bins, staves) of one or two surfaces in noise of unit variance, their power
    together `decibels` above it; noise that fades has the texture of the first."""
    ranges = rng.uniform(20.0, 60.0, bins)
    up = rng.uniform(0.3, 4.0, bins)
    ratio = 10.0 ** (0.1 * rng.uniform(-12.0, 12.0, bins)) if surfaces == 2 else np.zeros(bins)
    fading = rng.exponential(size=(2, bins))
    first = 10.0 ** (0.1 * decibels) / (1.0 + ratio)
    y = circular(rng, bins, staves)
    if fades:
        y *= np.sqrt(fading[0])[:, None]
    for power, z, height in ((first, fading[0], 0.0), (first * ratio, fading[1], up)):
        sine = direction_sine(HEIGHT - height, ranges, TILT)
        wave = np.sqrt(power * z)[:, None] * circular(rng, bins, 1)
        y += wave * steering(sine, staves, 0.5)
    return y


def circular(rng: np.random.Generator, *shape: int) -> ComplexArray:
    """Circular normal numbers of unit variance."""
    return rng.normal(size=(*shape, 2)).view(np.complex128)[..., 0] * math.sqrt(0.5)


def levels(y: ComplexArray) -> FloatArray:
    """L (bins,) at noise of unit variance."""
    _, single, double = layover.residuals(y, 0.5)
    return np.asarray(2.0 * (np.sqrt(single) - np.sqrt(double)))


def pooled(double: FloatArray, single: FloatArray) -> FloatArray:
    """Log ratio (K,) of the shares of two and one surfaces (K,) in classes, increasing: neighbours
    that decrease are pooled, which keeps the mean of the ratio under `one` at 1."""
    blocks: list[list[float]] = []
    for a, b in zip(double, single):
        blocks.append([a, b, 1])
        while len(blocks) > 1 and blocks[-2][0] * blocks[-1][1] >= blocks[-1][0] * blocks[-2][1]:
            last = blocks.pop()
            blocks[-1] = [x + y for x, y in zip(blocks[-1], last)]
    if len(blocks) > 1 and blocks[-1][1] == 0.0:
        last = blocks.pop()
        blocks[-1] = [x + y for x, y in zip(blocks[-1], last)]
    ratios = [max(a, 1e-9) / b for a, b, _ in blocks]
    return np.repeat(np.log(ratios), [int(count) for *_, count in blocks])


def main(
    staves: tuple[int, ...] = (8,),
    bins: int = 30_000,
    seed: int = 0,
    table: Path | None = None,
) -> Parts:
    made = {}
    if table is not None and table.exists():
        with np.load(table) as known:
            made = {name: known[name] for name in known.files if name.startswith('value_')}
    for count in staves:
        rows: list[list[FloatArray]] = [[], []]
        for fades, row in product((False, True), range(len(DECIBELS))):
            decibels = float(DECIBELS[row])
            rng = np.random.default_rng((seed, count, row, fades))
            single, double = (
                levels(snapshots(bins, count, decibels, k, rng, fades)) for k in (1, 2)
            )
            shares = [np.histogram(found, EDGES)[0] / bins for found in (double, single)]
            rows[fades].append(pooled(*shares))
            level = float(np.quantile(single, 0.999))
            found = {'level': level, 'caught': float((double > level).mean())}
            noise = 'noise that fades' if fades else 'steady noise'
            yield {'levels': {f'{count} staves, {decibels:g} dB, {noise}': found}}
        made[f'value_{count}'] = np.array(rows).astype(np.float32)
    if table is not None:
        numbers = sorted(int(name.removeprefix('value_')) for name in made)
        np.savez_compressed(
            table, staves=np.array(numbers), edges=EDGES, decibels=DECIBELS, **made
        )


if __name__ == '__main__':
    study(main, staves={'nargs': '*', 'type': int}, table={'type': Path})
