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

"""The motion models a diver tracker runs side by side.

All sets give the same outputs, position and velocity ``(px, py, vx, vy)``, through their output
map E, and are stated at a reference step T but usable at any step dt: noises grow like the
processes they stand for, and the chain has a rate generator. With ``u_j = (cos a_j, sin a_j)`` the
heading of model j and ``w_j`` its left normal:

heading_speed
    State (x, y, s): the heading is in the model, the speed in the state. p += dt s u_j + wander
    along w_j; s is a slow random walk; `hover` stands still.
families
    One filter for divers that swim steadily, briskly, turn about or drift: `steady` and `brisk`,
    each a `heading_speed` set with a speed that is kept or changes within a minute; `lively`, two
    constant velocities (x, y, vx, vy); and `quiet`, one. Inside a family the chain is as ever and
    learns. From one family to another it goes rarely (`family_switch_rate`), or the families never
    separate. The whole filter runs under several scales of the covariances of measurements
    (`covariance_scales`), each a row (`estimation.rows`): these do not mix, what they say of the
    measurements weighs them.
others
    Of other packages, see `own_models`.

Any set may be given two things besides. *Depth* is z up and its rate, which fades like that of a
diver who goes up and down. One filter with the whole water column as its prior locks onto a wrong
depth, because the path of an echo bends with z squared and the error is common to all pings. So
there are rows that begin in their part of the column, and what they say of the arrivals weighs
them. *The lasting error of fixes* is a Gauss-Markov process on each axis.

All sets are stated in common components, x and y first. The models of a set lie in one or two
blocks (`Part`), the velocities in the second, because a heading needs no fourth component.

Source: docs/diver.md; heading_speed is after the paper, whose equations are partly lost.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
import math
from typing import NamedTuple

from attrs import evolve, field, frozen
import numpy as np

from ...estimation import markov
from ...estimation.adaptation import Chain
from ...estimation.arrays import FloatArray, IndexArray, IntArray
from ...estimation.bank import Bank, Gaussians, Measured, Moves
from ...estimation.gauss_markov import gauss_markov
from ...estimation.motion import Motion, white_acceleration
from ...estimation.rows import Rows
from ..own_models import diver_models
from .config import DiverConfig

__all__ = ['build_models', 'ModelSet', 'Part']

OUTPUTS = ('px', 'py', 'vx', 'vy')
_CACHED_STEPS = 64

START_DEPTHS = 3
"""Rows of a new track where depth is a state, each of which begins in its part of the column."""

PART_SPREAD = 1.3
"""Variance in z with which a row begins, in variances of its part: the parts overlap."""

HEADING, VELOCITY, HOVER = 0, 1, 2
"""Kinds of models."""

FAMILIES = ('steady', 'brisk', 'lively', 'quiet')

LIVELY, QUIET = (0.05, 0.6), (0.03,)
"""Acceleration noise of the constant velocities, m/s^2 over a reference step."""

LIVELY_STAY = 0.85
"""Probability of keeping the model of the lively family over a reference step."""

SPEED_MEMORY = 60.0
"""Time within which a diver who stands forgets his pace, s, as `brisk` does: else who stands for
minutes is taken for one who swims at a crawl, and keeps to that when he goes on."""


class Families(NamedTuple):
    """What models of unequal states have in common: family (M,), the place of each one's family;
    kind (M,); units (M, 2), the direction of a heading, 0 of all others; speed and speed_variance
    of a new track; sector, the variance of a direction in its sector, rad^2."""

    family: IntArray
    kind: IntArray
    units: FloatArray
    speed: float
    speed_variance: float
    sector: float


@frozen(eq=False)
class Part:
    """The models of a block: their places in the set; components (n',): which of the common ones
    they have; outputs (q, n', m); seen (2, n', m) and measured: what a fix shows; height: place of
    z among the components, -1 for none."""

    models: slice
    components: IndexArray
    outputs: FloatArray
    fix_matrix: FloatArray
    measured: Measured
    height: int

    def index_of(self, place: int, common: int) -> int:
        """Return where the component stands that is at `place` among all, of which `common` are
        the models' and the others stand behind them."""
        if place >= common:
            return len(self.components) + place - common
        return self.components.tolist().index(place)

    def indices(self, common: int, size: int) -> IndexArray:
        """Return where the components of the block stand among `size`, of which `common` are the
        models'."""
        return np.append(self.components, np.arange(common, size))


@frozen(eq=False)
class ModelSet:
    """M models over n common components, x and y first.

    names: of the models; E: (M, q, n) outputs; chain: the law of switching; start: components
    after the position for a new track, mean and variance, (n - 2,) each or (M, n - 2); initial:
    (M,) model probabilities of a new track. What depth and the bias of fixes add: outputs, names
    of the q outputs; height and bias, places of z and of the bias, -1 for none; starts (K,): where
    K rows begin in z. families: of models with unequal states, None where all have all components;
    scales (K,): by what K rows multiply the covariances of measurements.
    """

    names: tuple[str, ...]
    E: FloatArray
    chain: Chain
    start_mean: FloatArray
    start_variance: FloatArray
    initial: FloatArray
    _motion: Callable[[float], Motion]
    outputs: tuple[str, ...] = OUTPUTS
    height: int = -1
    bias: int = -1
    starts: tuple[float, ...] = (0.0,)
    families: Families | None = None
    scales: tuple[float, ...] = (1.0,)
    parts: tuple[Part, ...] = field(init=False)
    bank: Bank = field(init=False)
    _cache: OrderedDict[float, tuple[Moves, ...]] = field(factory=OrderedDict, init=False)

    def __attrs_post_init__(self) -> None:
        object.__setattr__(self, 'parts', self._build_parts())
        object.__setattr__(self, 'bank', self._build_bank())

    @property
    def n(self) -> int:
        return int(self.E.shape[2])

    @property
    def rows_per_track(self) -> int:
        """Rows with which a track begins."""
        return max(len(self.starts), len(self.scales))

    @property
    def fix_matrix(self) -> FloatArray:
        """(M, 2, n): what a fix measures of the common components."""
        if self.bias < 0:
            return self.E[:, :2]
        H = self.E[:, :2].copy()
        H[:, :, self.bias : self.bias + 2] += np.eye(2)
        return H

    def motion(self, dt: float) -> Motion:
        """Return the models over a step of dt seconds, dt >= 0, in common components."""
        return Motion(*map(np.ascontiguousarray, self._motion(dt)))

    def moves(self, dt: float) -> tuple[Moves, ...]:
        """Return the step of each block."""
        found = self._cache.get(dt)
        if found is None:
            F, Q, B = (np.moveaxis(part, 0, -1) for part in self._motion(dt))
            found = tuple(self._block_moves(part, F, Q, B) for part in self.parts)
            self._cache[dt] = found
            if len(self._cache) > _CACHED_STEPS:
                self._cache.popitem(last=False)
        return found

    @staticmethod
    def _block_moves(part: Part, F: FloatArray, Q: FloatArray, B: FloatArray) -> Moves:
        at, own = part.components, part.models
        square = np.ix_(at, at)
        F, Q, B = F[square][..., own], Q[square][..., own], B[at][..., own]
        return Moves(*map(np.ascontiguousarray, (F, Q, B)))

    def initial_states(
        self,
        position: FloatArray,
        covariance: FloatArray,
        from_fix: bool = True,
        measured: bool = True,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x (k, K, M, n), P (k, K, M, n, n), mu (k, K, M) of tracks first seen at
        `position` (k, 2) with `covariance` (k, 2, 2), which the rows multiply where it is that of
        what was `measured`."""
        M, n, K = len(self.names), self.n, self.rows_per_track
        shape = len(position), K, M
        x, P = np.empty((*shape, n)), np.zeros((*shape, n, n))
        x[..., :2], x[..., 2:] = position[:, None, None], self.start_mean
        P[..., :2, :2] = covariance[:, None, None]
        if from_fix and measured and len(self.scales) > 1:
            P[..., :2, :2] *= np.array(self.scales)[:, None, None, None]
        diagonal = P.reshape(*shape, n * n)[..., :: n + 1]
        diagonal[..., 2:] = self.start_variance
        if self.height >= 0:
            x[..., self.height] = np.array(self.starts)[:, None]
        if self.bias >= 0 and from_fix:
            # A fix is position and bias: as much as one is larger the other is smaller.
            shared = np.diag(np.atleast_2d(self.start_variance)[0, self.bias - 2 : self.bias])
            there = slice(self.bias, self.bias + 2)
            P[..., :2, :2] += shared
            P[..., :2, there] = P[..., there, :2] = -shared
        return x, P, np.broadcast_to(self.initial, shape).copy()

    def make_rows(self, x: FloatArray, P: FloatArray, mu: FloatArray, logw: FloatArray) -> Rows:
        """Return the table of T targets with K rows each: x (T, K, M, n), P (T, K, M, n, n), mu
        (T, K, M), logw (T, K)."""
        T, K, M, size = x.shape
        scale = np.resize(np.array(self.scales), K)
        start = np.resize(np.arange(len(self.starts)), K)
        return Rows(
            self.to_blocks(x.reshape(T * K, M, size), P.reshape(T * K, M, size, size)),
            mu.reshape(T * K, M),
            logw.reshape(T * K),
            np.repeat(np.arange(T), K),
            np.full(T * K, -1),
            {'scale': np.tile(scale, T), 'start': np.tile(start, T)},
        )

    def to_blocks(self, x: FloatArray, P: FloatArray) -> tuple[Gaussians, ...]:
        """Return the blocks of states in common components: x (N, M, n), P (N, M, n, n)."""
        found = []
        for part in self.parts:
            at = part.indices(self.n, x.shape[-1])
            own = x[:, part.models][..., at], P[:, part.models][..., at[:, None], at]
            found.append(Gaussians(*(np.ascontiguousarray(np.moveaxis(a, 1, -1)) for a in own)))
        return tuple(found)

    def to_common(self, blocks: tuple[Gaussians, ...]) -> tuple[FloatArray, FloatArray]:
        """Return x (N, M, n) and P (N, M, n, n) in common components; of one that a model lacks,
        mean 0 and variance 1."""
        N = len(blocks[0].x)
        size = self.n + blocks[0].x.shape[1] - len(self.parts[0].components)
        x, P = np.zeros((N, len(self.names), size)), np.zeros((N, len(self.names), size, size))
        P[..., range(size), range(size)] = 1.0
        for part, block in zip(self.parts, blocks):
            at = part.indices(self.n, size)
            own = np.arange(part.models.start, part.models.stop)
            x[:, own[:, None], at] = np.moveaxis(block.x, -1, 1)
            P[:, own[:, None, None], at[:, None], at] = np.moveaxis(block.P, -1, 1)
        return x, P

    def _build_parts(self) -> tuple[Part, ...]:
        every = np.arange(self.n)
        if self.families is None:
            return (self._build_part(slice(0, len(self.names)), every),)
        first = int((self.families.kind != VELOCITY).sum())
        # A heading has (x, y, s), a velocity (x, y, vx, vy); behind these all have the same.
        return (
            self._build_part(slice(0, first), np.delete(every, 3)),
            self._build_part(slice(first, len(self.names)), every),
        )

    def _build_part(self, models: slice, components: IndexArray) -> Part:
        at = components.tolist()
        seen = np.moveaxis(self.fix_matrix[models][..., components], 0, -1)
        measured: Measured = ((0,), (1,))
        if self.bias >= 0:
            measured = (0, at.index(self.bias)), (1, at.index(self.bias + 1))
        outputs = np.moveaxis(self.E[models][..., components], 0, -1)
        height = at.index(self.height) if self.height >= 0 else -1
        parts = np.ascontiguousarray(outputs), np.ascontiguousarray(seen)
        return Part(models, components, *parts, measured, height)

    def _build_bank(self) -> Bank:
        kinds = self.families
        if kinds is None:
            return Bank(np.zeros((2, len(self.names))))
        moving = kinds.kind == VELOCITY
        law = kinds.speed, kinds.speed_variance, kinds.sector
        return Bank(np.ascontiguousarray(kinds.units[~moving].T), int(moving.sum()), *law)


def build_models(config: DiverConfig) -> ModelSet:
    """Return the model set that `config` names, with the depth and the bias of fixes that it asks
    for."""
    built_in = {'families': _build_families, 'heading_speed': _build_heading_speed}
    models = built_in.get(config.model_set, _package_models)(config)
    if config.dimensions == 3:
        models = with_depth(models, config)
    return with_fix_bias(models, config) if config.fix_bias_std > 0.0 else models


def build_chain(config: DiverConfig, matrix: FloatArray) -> markov.RateChain:
    """Return the chain of `matrix` (M, M), or of the one that the parameters state."""
    if config.transition_matrix:
        matrix = np.reshape(config.transition_matrix, matrix.shape)
    return markov.RateChain(matrix, config.reference_step)


def initial_probabilities(config: DiverConfig, models: int) -> FloatArray:
    """Return the model probabilities (M,) of a new track."""
    if config.initial_probabilities:
        return np.array(config.initial_probabilities)
    return np.full(models, 1.0 / models)


def _package_models(config: DiverConfig) -> ModelSet:
    own = diver_models(config.model_set, config)
    names = own.joint.outputs
    E = np.zeros((len(own.joint.names), len(OUTPUTS), len(own.mean)))
    for row, name in enumerate(OUTPUTS):
        if name in names:
            E[:, row] = own.joint.E[:, names.index(name)]
    return ModelSet(
        own.joint.names,
        E,
        build_chain(config, own.transition),
        own.mean[2:],
        own.variance[2:],
        initial_probabilities(config, len(E)),
        own.motion,
    )


# -- headings ------------------------------------------------------------------------------------


def heading_vectors(config: DiverConfig) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Return unit vectors along u (M, 2) and to the left of w (M, 2) each heading, and their
    names."""
    angle = 2.0 * np.pi * np.arange(config.directions) / config.directions
    u = np.column_stack([np.cos(angle), np.sin(angle)])
    w = np.column_stack([-np.sin(angle), np.cos(angle)])
    degrees = [360 * j // config.directions for j in range(config.directions)]
    return u, w, tuple(f'heading_{each:03d}' for each in degrees)


def _outer_products(v: FloatArray) -> FloatArray:
    """Return v v^T for each row: (M, 2) -> (M, 2, 2)."""
    return np.asarray(v[:, :, None] * v[:, None, :])


def _build_heading_speed(config: DiverConfig) -> ModelSet:
    u, w, names = heading_vectors(config)
    P = markov.persistent_headings(
        config.directions, config.stay_probability, config.heading_concentration
    )
    if config.hover:
        P = markov.with_hover(P, config.hover_enter, config.hover_stay)
        u, w, names = np.vstack([u, np.zeros(2)]), np.vstack([w, np.zeros(2)]), (*names, 'hover')
    M, T = len(names), config.reference_step
    E = np.zeros((M, 4, 3))
    E[:, :2, :2] = np.eye(2)
    E[:, 2:, 2] = u
    wander = config.lateral_noise**2 * _outer_products(w)
    if config.hover:
        wander[-1] = config.hover_noise**2 * np.eye(2)
    speed_rate = config.speed_noise**2 / T
    # Irregular stamps ask for a new step at each fix.
    still, along, nothing = np.tile(np.eye(3), (M, 1, 1)), _outer_products(u), np.zeros((M, 3))

    def motion(dt: float) -> Motion:
        F, Q = still.copy(), np.zeros((M, 3, 3))
        F[:, :2, 2] = dt * u
        Q[:, :2, :2] = wander * (dt / T) + speed_rate * dt**3 / 3.0 * along
        Q[:, :2, 2] = Q[:, 2, :2] = speed_rate * dt**2 / 2.0 * u
        Q[:, 2, 2] = speed_rate * dt
        return Motion(F, Q, nothing)

    return ModelSet(
        names,
        E,
        build_chain(config, P),
        np.array([config.speed_mean]),
        np.array([config.speed_std**2]),
        initial_probabilities(config, M),
        motion,
    )


# -- families ------------------------------------------------------------------------------------


def _build_families(config: DiverConfig) -> ModelSet:
    plain = evolve(
        config, model_set='heading_speed', transition_matrix=(), initial_probabilities=()
    )
    steady, brisk = (
        _build_heading_speed(evolve(plain, speed_noise=noise))
        for noise in (config.speed_noise, config.brisk_speed_noise)
    )
    noises = config.acceleration_noise or (*LIVELY, *QUIET)
    count, moving = len(steady.names), len(noises)
    family = np.repeat(np.arange(4), [count, count, len(LIVELY), len(QUIET)])
    M, T = len(family), config.reference_step
    u, _, _ = heading_vectors(config)
    units = np.zeros((M, 2))
    units[: config.directions] = units[count : count + config.directions] = u
    own = np.where(np.arange(count) < config.directions, HEADING, HOVER)
    kind = np.concatenate([own, own, np.full(moving, VELOCITY)])
    sector = (2.0 * np.pi / config.directions) ** 2 / 12.0
    speed = config.speed_mean, config.speed_std**2
    E = np.zeros((M, 4, 4))
    E[: 2 * count, :, :3] = np.concatenate([steady.E, brisk.E])
    E[2 * count :] = np.eye(4)
    hovers = np.flatnonzero(kind == HOVER)
    # A pace that is forgotten has the spread of `speed_std` in the end, or that of its own noise.
    noise = np.square([config.speed_noise, config.brisk_speed_noise])[: len(hovers)] / T
    forgotten = np.maximum(0.5 * SPEED_MEMORY * noise, speed[1])

    def motion(dt: float) -> Motion:
        F, Q, B = np.zeros((M, 4, 4)), np.zeros((M, 4, 4)), np.zeros((M, 4))
        F[:] = np.eye(4)
        for first, models in ((0, steady), (count, brisk)):
            rows = slice(first, first + count)
            F[rows, :3, :3], Q[rows, :3, :3], _ = models.motion(dt)
        kept = math.exp(-dt / SPEED_MEMORY)
        F[hovers, 2, 2], B[hovers, 2] = kept, (1.0 - kept) * speed[0]
        Q[hovers, 2, 2] = -math.expm1(-2.0 * dt / SPEED_MEMORY) * forgotten
        F[2 * count :, :2, 2:] = dt * np.eye(2)
        for row, noise in enumerate(noises, start=2 * count):
            Q[row] = white_acceleration(noise**2 * T, 0.0, dt)
        return Motion(F, Q, B)

    start_mean, start_variance = np.zeros((M, 2)), np.full((M, 2), config.velocity_std**2)
    start_mean[: 2 * count, 0] = speed[0]
    start_variance[: 2 * count] = speed[1], 1.0
    if config.transition_matrix:
        chain = build_chain(config, np.eye(M))
    else:
        rates = markov.RateChain(markov.persistent(len(LIVELY), LIVELY_STAY), T).generator
        generators = [
            markov.RateChain(models.chain.matrix, T).generator for models in (steady, brisk)
        ]
        generators += [rates, np.zeros((len(QUIET), len(QUIET)))]
        generator = family_generator(family, generators, config.family_switch_rate)
        chain = markov.RateChain.of_generator(generator, T)
    if config.initial_probabilities:
        initial = initial_probabilities(config, M)
    else:
        initial = 0.25 / np.bincount(family)[family]
    names = [f'{name}_{each}' for name in FAMILIES[:2] for each in steady.names]
    return ModelSet(
        (*names, 'lively_calm', 'lively_sharp', 'quiet'),
        E,
        chain,
        start_mean,
        start_variance,
        initial,
        motion,
        families=Families(family, kind, units, *speed, sector),
        # Rows begin at depths where depth is a state; one thing at a time.
        scales=(1.0,) if config.dimensions == 3 else config.covariance_scales,
    )


def family_generator(family: IntArray, blocks: list[FloatArray], rate: float) -> FloatArray:
    """Return the generator (M, M) of chains that go from each family to each other one at `rate` /
    3, evenly to its models; between the first two the place in the family is kept."""
    size = np.bincount(family)
    out = np.asarray(rate / 3.0 / size[family][None] * (family[:, None] != family[None]))
    count = int(size[0])
    for a, b in ((0, 1), (1, 0)):
        kept = slice(a * count, (a + 1) * count), slice(b * count, (b + 1) * count)
        out[kept] = rate / 3.0 * np.eye(count)
    first = 0
    for block in blocks:
        own = slice(first, first + len(block))
        out[own, own] = block
        first += len(block)
    np.fill_diagonal(out, 0.0)
    np.fill_diagonal(out, -out.sum(axis=1))
    return out


# -- depth, and errors of fixes ------------------------------------------------------------------


def start_depths(config: DiverConfig) -> tuple[float, ...]:
    """Return z at which rows begin: the middles of equal parts of the water column, or where the
    diver is assumed to be."""
    if config.dimensions == 2:
        return (config.target_z,)
    count = START_DEPTHS if config.depth_max > config.depth_min else 1
    width = (config.depth_max - config.depth_min) / count
    return tuple(-config.depth_min - (k + 0.5) * width for k in range(count))


def with_depth(base: ModelSet, config: DiverConfig) -> ModelSet:
    """Return `base` with the height z and its rate w, z' = z + tau (1 - a) w, w' = a w + q, in
    rows over the water column."""
    M, n, starts = len(base.names), base.n, start_depths(config)
    width = (config.depth_max - config.depth_min) / len(starts)
    E = np.zeros((M, 6, n + 2))
    E[:, :2, :n], E[:, 3:5, :n] = base.E[:, :2], base.E[:, 2:]
    E[:, 2, n] = E[:, 5, n + 1] = 1.0
    rate = config.vertical_speed_std**2

    def motion(dt: float) -> Motion:
        fade, added = gauss_markov(config.vertical_speed_std, config.vertical_speed_time, dt)
        way = config.vertical_speed_time * (1.0 - fade)
        return _join_motions(
            base.motion(dt), np.array([[1.0, way], [0.0, fade]]), np.diag([0.0, added])
        )

    spread = max(PART_SPREAD * width**2 / 12.0, 1e-4)
    return evolve(
        base,
        E=E,
        start_mean=_append_start(base.start_mean, [starts[0], 0.0]),
        start_variance=_append_start(base.start_variance, [spread, rate]),
        motion=motion,
        outputs=('px', 'py', 'pz', 'vx', 'vy', 'vz'),
        height=n,
        starts=starts,
    )


def with_fix_bias(base: ModelSet, config: DiverConfig) -> ModelSet:
    """Return `base` with an error of the fixes that lasts, one Gauss-Markov process an axis."""
    n, std = base.n, config.fix_bias_std
    E = np.concatenate([base.E, np.zeros((*base.E.shape[:2], 2))], axis=2)

    def motion(dt: float) -> Motion:
        fade, added = gauss_markov(std, config.fix_bias_time, dt)
        return _join_motions(base.motion(dt), fade * np.eye(2), added * np.eye(2))

    return evolve(
        base,
        E=E,
        start_mean=_append_start(base.start_mean, [0.0, 0.0]),
        start_variance=_append_start(base.start_variance, [std**2, std**2]),
        motion=motion,
        bias=n,
    )


def _append_start(start: FloatArray, more: list[float]) -> FloatArray:
    """Return `start` (n,) or (M, n) with the same further components for all models."""
    there = np.broadcast_to(more, (*start.shape[:-1], len(more)))
    return np.concatenate([start, there], axis=-1)


def _join_motions(base: Motion, F: FloatArray, Q: FloatArray) -> Motion:
    """Return the motion of more components beside those of `base`, on which nothing of it
    depends."""
    M, n = base.B.shape
    m = len(F)
    both = Motion(np.zeros((M, n + m, n + m)), np.zeros((M, n + m, n + m)), np.zeros((M, n + m)))
    both.F[:, :n, :n], both.Q[:, :n, :n], both.B[:, :n] = base
    both.F[:, n:, n:], both.Q[:, n:, n:] = F, Q
    return both
