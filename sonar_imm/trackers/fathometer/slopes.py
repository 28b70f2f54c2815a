# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Still or dipping: a multiple-model filter of the slope of each reflector, and the walks that
follow from it.

Under a vessel that moves on, a layer that dips is deeper by the same amount in every record. Each
reflector has two models. Both walk by `depth_std`; one that is **dipping** has a slope s besides,
in m per record, N(0, slope_std^2) when it begins to dip. From record to record either becomes the
other, or a slope a new one, with `slope_switch_probability` p. So there are three ways to the next
record, of which the last two are merged after it:

    still    weight (1 - p) w_still + p w_dipping    N(0, q)                     q = k depth_std^2
    dipping  weight (1 - 2 p) w_dipping              N(k m, k^2 P + q)
    turned   weight p                                N(0, slope_std^2 + q)

for the change of depth after the time of k records, s ~ N(m, P). A turn within a gap counts as at
its end: a layer that turned longer ago is found anew.

The depths of the particles of one reflector are within a cell or two of each other, so that what
its slope is given its depth is the same for all of them: the slope belongs to the identity, and
enters the particle filter as the walk of the members near it (`Walks`), a mixture of the three.

Layers above each other are parallel as a rule. The slope of each is therefore drawn towards that
of the others that dip, N(V, v): V their mean, by weight and precision, v the error of V and how
far they differ, as estimated from their own scatter (random effects; method of moments). Where
they are not parallel they differ much, and each goes by its own. What a reflector has learned
itself is kept apart, so that nothing counts twice.

Sources: H. A. P. Blom and Y. Bar-Shalom, *The interacting multiple model algorithm for systems
with Markovian switching coefficients*, IEEE Trans. AC 33 (1988); R. DerSimonian and N. Laird,
*Meta-analysis in clinical trials*, Controlled Clinical Trials 7 (1986).
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.set_model import Walks
from .config import FathometerConfig
from .response import Lattice, MAX_MOVES

REACH, TURN_REACH = 4.0, 3.0
"""Standard deviations at which the walks of the first two ways, and of the third, are cut."""
MEMORY = 30.0
"""Records that the slope is an average of: floors bend."""
LEAST_WEIGHT = 1e-3
_OTHERS = 1.5


class Slope(NamedTuple):
    """What is known of a reflector's slope: dipping: probability; mean, m per record, and variance
    if it dips; noise: variance of the depth where it was last seen, m^2."""

    dipping: float
    mean: float
    variance: float
    noise: float = 0.0


STILL = Slope(0.0, 0.0, 1.0)


class Common(NamedTuple):
    """What other reflectors say of the slope of one: dipping: how probable it is, before anything
    else is known; mean and variance of the slope then, infinite when nothing is."""

    dipping: float = 0.5
    mean: float = 0.0
    variance: float = math.inf


class Ways(NamedTuple):
    """The three ways to a record: weight, mean and variance (3,) of the change of depth, m;
    cut: at how many standard deviations each ends."""

    weight: FloatArray
    mean: FloatArray
    variance: FloatArray
    cut: FloatArray

    @property
    def log_weight(self) -> FloatArray:
        return np.log(np.maximum(self.weight, 1e-300))

    def surprise(
        self, change: FloatArray, config: FathometerConfig, least: float = 0.0
    ) -> FloatArray:
        """-2 log density (K,) of changes of depth (K,) by the best way, but for a constant;
        infinite beyond all of them, and further than `least`."""
        off = np.square((change[:, None] - self.mean) / config.depth_std)
        relative = self.variance / config.depth_std**2
        cost = off / relative + np.log(relative) - 2.0 * self.log_weight
        reach = np.maximum(least / config.depth_std, self.cut * np.sqrt(relative))
        return np.asarray(np.where(np.sqrt(off) <= reach, cost, np.inf).min(axis=1))


def slopes_followed(config: FathometerConfig) -> bool:
    """A datum that drifts and a floor that slopes are one thing: with heave there is no slope.
    `auto` is none until the tracker puts what it found in its place."""
    return config.slope_std > 0.0 and config.heave in ('none', 'auto')


def begun(common: Common, noise: float, config: FathometerConfig) -> Slope:
    """The slope of a reflector that is new; noise: variance of its depth, m^2."""
    return Slope(common.dipping, 0.0, config.slope_std**2, noise)


def common_slope(slopes: Sequence[Slope]) -> Common:
    """What `slopes` say of that of one more reflector."""
    if not slopes:
        return Common()
    weight, mean, variance = (np.array(column) for column in zip(*(s[:3] for s in slopes)))
    count = float(weight.sum())
    share = (0.5 + count) / (1.0 + len(slopes))
    if count < _OTHERS:
        return Common(share)
    precision = weight / variance
    total = precision.sum()
    V = float(precision @ mean / total)
    excess = float(precision @ np.square(mean - V)) - (count - 1.0)
    differ = max(0.0, excess / float(total - precision @ precision / total))
    # How far they differ is itself known to what their own errors leave only.
    differ += 2.0 / float(total)
    total = float((weight / (variance + differ)).sum())
    return Common(share, V, 1.0 / total + differ)


def ways(slope: Slope, common: Common, records: int, config: FathometerConfig) -> Ways:
    """To the record after the time of so many records."""
    walk = records * config.depth_std**2
    if not slopes_followed(config):
        nothing = np.zeros(1)
        return Ways(nothing + 1.0, nothing, nothing + walk, nothing + REACH)
    p, d = config.slope_switch_probability, slope.dipping
    precision = 1.0 / slope.variance + 1.0 / common.variance
    mean = (slope.mean / slope.variance + common.mean / common.variance) / precision
    return Ways(
        np.array([(1.0 - p) * (1.0 - d) + p * d, (1.0 - 2.0 * p) * d, p]),
        np.array([0.0, records * mean, 0.0]),
        np.array([walk, records**2 / precision + walk, config.slope_std**2 + walk]),
        # A slope of which nothing is known is as one that is new.
        np.array(
            [REACH, REACH if precision > 4.0 / config.slope_std**2 else TURN_REACH, TURN_REACH]
        ),
    )


def learned(
    slope: Slope,
    common: Common,
    change: float,
    noise: float,
    records: int,
    config: FathometerConfig,
    jump: float = 0.0,
) -> Slope:
    """The slope after the depth changed by `change` over so many records, to a depth of variance
    `noise`. jump: by how much all seem to have jumped besides, m; where slopes explain all of it
    better than a jump does, they have it, and reflectors that dip do not jump again and again."""
    plain, _ = _after(slope, common, change, noise, records, config)
    if not jump:
        return plain
    sloping, density = _after(slope, common, change + jump, noise, records, config)
    std = config.common_jump_std
    leap = config.common_jump_probability * math.exp(-0.5 * (jump / std) ** 2)
    leap /= std * math.sqrt(2.0 * math.pi)
    share = density / (density + leap) if density > 0.0 else 0.0
    weight = np.array([(1.0 - share) * plain.dipping, share * sloping.dipping])
    mean, variance = np.array([plain[1:3], sloping[1:3]]).T
    return Slope(min(1.0, float(weight.sum())), *_mixed(weight, mean, variance), noise)


def _after(
    slope: Slope,
    common: Common,
    change: float,
    noise: float,
    records: int,
    config: FathometerConfig,
) -> tuple[Slope, float]:
    """The slope after a change, and how probable that was, 1/m."""
    to = ways(slope, common, records, config)
    error = noise + slope.noise
    log = to.log_weight - 0.5 * (
        np.square(change - to.mean) / (to.variance + error) + np.log(to.variance + error)
    )
    w = np.exp(log - log.max())
    density = float(w.sum()) * math.exp(float(log.max())) / math.sqrt(2.0 * math.pi)
    w /= w.sum()
    walk = records * config.depth_std**2 + error
    found = []
    old = max(slope.variance, config.depth_std**2 / MEMORY)
    for before, P, times in ((slope.mean, old, records), (0.0, config.slope_std**2, 1)):
        gain = P * times / (times**2 * P + walk)
        found.append((before + gain * (change - times * before), (1.0 - gain * times) * P))
    means, variances = np.array(found).T
    return Slope(float(w[1] + w[2]), *_mixed(w[1:], means, variances), noise), density


def _mixed(weight: FloatArray, mean: FloatArray, variance: FloatArray) -> tuple[float, float]:
    """Mean and variance of what is so by either of two, with so much weight (2,)."""
    total = float(weight.sum())
    share = weight / total if total > 0.0 else np.array([1.0, 0.0])
    middle = float(share @ mean)
    return middle, float(share @ (variance + np.square(mean - middle)))


def walks_to(
    known: Sequence[tuple[float, Slope, Common]],
    other: Common,
    lattice: Lattice,
    records: int,
    config: FathometerConfig,
) -> Walks:
    """How members walk that are near the reflectors `known`, by depth, slope and what the others
    say of it; all others by `other` alone."""
    spread = begun(other, 0.0, config)
    every = [ways(spread, other, records, config)]
    every += [ways(slope, common, records, config) for _, slope, common in known]
    kind = np.zeros(lattice.cells, np.int64)
    order = sorted(range(len(known)), key=lambda k: known[k][0])
    place = np.array([known[k][0] for k in order])
    middle = 0.5 * (place[1:] + place[:-1])
    low = np.maximum(place - config.min_separation, np.append(-np.inf, middle)[: len(place)])
    high = np.minimum(place + config.min_separation, np.append(middle, np.inf)[: len(place)])
    edges = np.ceil((np.stack([low, high]) - lattice.first) / lattice.step)
    for k, (begin, end) in zip(order, edges.clip(0, lattice.cells).astype(np.int64).T):
        kind[begin:end] = 1 + k
    most = max(3, MAX_MOVES // lattice.cells)
    cells = [_cells(each, lattice.step, most) for each in every]
    radius = max((high - low + 1) // 2 for low, high in cells)
    centre = np.array([(low + high) // 2 for low, high in cells])
    at = lattice.step * (centre[:, None] + np.arange(-radius, radius + 1))
    probability = np.zeros(at.shape)
    for row, each in enumerate(every):
        for weight, mean, variance, cut in zip(*each):
            if weight < LEAST_WEIGHT:
                continue
            # No narrower than a cell, between the middles of two of which it may lie.
            wide = variance + lattice.step**2 / 12.0
            off = np.square(at[row] - mean) / wide
            K = np.where(off <= np.square(cut), np.exp(-0.5 * off), 0.0)
            whole = math.sqrt(2.0 * math.pi * wide) / lattice.step
            probability[row] += weight * K / max(float(K.sum()), 0.99 * whole)
        probability[row] /= probability[row].sum()
    far = max(high - low for low, high in cells) * lattice.step > 2.0 * config.min_separation
    return Walks(kind, centre, probability, far)


def _cells(to: Ways, step: float, most: int) -> tuple[int, int]:
    """First and last cell, against where a member was, that the ways lead to; about the most
    probable one where that is more than `most`."""
    use = to.weight >= LEAST_WEIGHT
    reach = to.cut * np.sqrt(to.variance)
    low = math.floor(float((to.mean - reach)[use].min()) / step)
    high = math.ceil(float((to.mean + reach)[use].max()) / step)
    if high - low + 3 > most:
        middle = round(float(to.mean[np.argmax(to.weight)]) / step)
        half = (most - 3) // 2
        low, high = max(low, middle - half), min(high, middle + half)
    return low, high
