# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Motion models of the diver tracker.

All sets have the outputs position and velocity ``(px, py, vx, vy)``, through their output map E.
They are defined at a reference step T and work at any step dt: noises grow with dt, and the chain
has a rate generator. With ``u_j = (cos a_j, sin a_j)`` the heading of model j and ``w_j`` its left
normal:

heading_speed
    State (x, y, s): the heading belongs to the model, the speed to the state. p += dt s u_j +
    lateral noise along w_j. The speed s is a slow random walk; `hover` stands still.
families
    Four families of models in one filter. `steady` and `brisk` are `heading_speed` sets with a
    slowly or quickly changing speed; `lively` has two constant velocities (x, y, vx, vy), `quiet`
    has one. Transitions inside a family adapt to the data. Transitions between families are rare
    (`family_switch_rate`), so that the families separate. One filter runs per value of
    `covariance_scales`, each a row (`estimation.rows`). The scaled filters do not interact;
    their likelihoods weight them.
others
    Sets of other packages, see `own_models`.

Two extensions apply to any set. *Depth* adds z (up) and its rate, which decays. The path of an
echo depends on z squared, and depth errors are common to all pings, so one filter over the whole
water column can converge to a wrong depth. Therefore rows start in parts of the column, and the
arrivals weight them. *Time-correlated fix errors* add a Gauss-Markov process on each axis.

All sets use common components, x and y first. The models of a set lie in one or two blocks
(`Part`). Velocities are in the second block, because a heading needs one component less.

Source: docs/diver.md; heading_speed follows the paper, whose equations are partly lost.
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
from .sensors import MOST_SENSORS, of_sensor

__all__ = ['build_models', 'ModelSet', 'Part']

OUTPUTS = ('px', 'py', 'vx', 'vy')
_CACHED_STEPS = 64

START_DEPTHS = 3
"""Number of rows of a new track with depth as a state; each starts in its part of the column."""

PART_SPREAD = 1.3
"""Initial variance of z in a row, relative to the variance of its part: the parts overlap."""

HEADING, VELOCITY, HOVER = 0, 1, 2
"""Kinds of models."""

FAMILIES = ('steady', 'brisk', 'lively', 'quiet')

LIVELY, QUIET = (0.05, 0.6), (0.03,)
"""Acceleration noise of the constant velocities, m/s^2 over a reference step."""

LIVELY_STAY = 0.85
"""Probability of keeping a lively model over a reference step."""

USUAL_SCALES = 0.1, 10.0
"""Limits of the covariance scales that have a row in a new track."""

SPEED_MEMORY = 60.0
"""Time constant of the speed memory of a hovering target, s. Without decay, a target that stands
for minutes is estimated as slowly swimming, also when it moves on."""


NO_OFFSET: dict[str, int | bool] = {
    'offset': -1,
    'since': 0,
    'took': 0,
    'taken': 1,
    'fixes': 0,
    'others': 0,
    'aside': False,
    'turns': False,
    'link': 0,
}
"""Assumptions of a new row about offsets (`bursts`).

offset: number of the sensor whose fixes are off, -1 for none; since: stamp of the first of them;
took: stamp of the last fix that the row used, 0 for none; taken: number of fixes before;
fixes: number of fixes of the sensor since; others: of other sensors; aside: whether its last fix
was an outlier; turns: whether each fix may have the offset or not (`fixes` and `others` then count
the last fixes in a row with and without it); link: ID of the track that the row excludes, 0 for
none.
"""


class Families(NamedTuple):
    """Properties of models with unequal states."""

    family: IntArray
    """(M,) index of the family of each model."""
    kind: IntArray
    """(M,) `HEADING`, `VELOCITY` or `HOVER`."""
    units: FloatArray
    """(M, 2) direction of a heading; 0 for other models."""
    speed: float
    """Mean speed of a new track, m/s."""
    speed_variance: float
    """Its variance, (m/s)^2."""
    sector: float
    """Variance of the direction in the sector of a heading, rad^2."""


@frozen(eq=False)
class Part:
    """A block of m models with n' of the common components."""

    models: slice
    """Indices of the models in the set."""
    components: IndexArray
    """(n',) indices of the common components."""
    outputs: FloatArray
    """(q, n', m) output maps."""
    fix_matrix: FloatArray
    """(2, n', m) measurement matrices of a fix."""
    measured: Measured
    """The same as sums of components, see `bank.Measured`."""
    height: int
    """Index of z among the components; -1 without depth."""

    def index_of(self, place: int, common: int) -> int:
        """Return the index in the block of a component `place` of the set with `common` motion
        components.

        Constants follow the motion components.
        """
        if place >= common:
            return len(self.components) + place - common
        return self.components.tolist().index(place)

    def indices(self, common: int, size: int) -> IndexArray:
        """Return the indices of the block components among `size`, of which `common` are motion
        components."""
        return np.append(self.components, np.arange(common, size))


@frozen(eq=False)
class ModelSet:
    """M models over n common components, x and y first."""

    names: tuple[str, ...]
    """Names of the models."""
    E: FloatArray
    """(M, q, n) output maps."""
    chain: Chain
    """Markov chain of the models."""
    start_mean: FloatArray
    """(n - 2,) or (M, n - 2) mean of the components after the position, for a new track."""
    start_variance: FloatArray
    """The variance, of the same shape."""
    initial: FloatArray
    """(M,) model probabilities of a new track."""
    _motion: Callable[[float], Motion]
    outputs: tuple[str, ...] = OUTPUTS
    """Names of the q outputs."""
    height: int = -1
    """Index of z; -1 without depth."""
    bias: int = -1
    """Index of the fix bias; -1 without bias."""
    starts: tuple[float, ...] = (0.0,)
    """(K,) initial z of K rows."""
    families: Families | None = None
    """Data of unequal models; None if all models have all components."""
    scales: tuple[float, ...] = (1.0,)
    """Covariance scales."""
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
    def row_scales(self) -> tuple[float, ...]:
        """(K,) covariance scales of the K rows of a new track: the usual ones, if any."""
        least, most = USUAL_SCALES
        return tuple(s for s in self.scales if least <= s <= most) or self.scales

    @property
    def rows_per_track(self) -> int:
        """Number of rows of a new track."""
        return max(len(self.starts), len(self.row_scales))

    @property
    def fix_matrix(self) -> FloatArray:
        """(M, 2, n) measurement matrices of a fix in common components."""
        if self.bias < 0:
            return self.E[:, :2]
        H = self.E[:, :2].copy()
        H[:, :, self.bias : self.bias + 2] += np.eye(2)
        return H

    def motion(self, dt: float) -> Motion:
        """Return the models over a step of dt >= 0 seconds, in common components."""
        return Motion(*map(np.ascontiguousarray, self._motion(dt)))

    def moves(self, dt: float) -> tuple[Moves, ...]:
        """Return the step of dt seconds of each block."""
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
        """Return x (k, K, M, n), P (k, K, M, n, n) and mu (k, K, M) of k new tracks.

        :param position: (k, 2).
        :param covariance: (k, 2, 2); multiplied by the scale of a row if the position was
            `measured`.
        """
        M, n, K = len(self.names), self.n, self.rows_per_track
        shape = len(position), K, M
        x, P = np.empty((*shape, n)), np.zeros((*shape, n, n))
        x[..., :2], x[..., 2:] = position[:, None, None], self.start_mean
        P[..., :2, :2] = covariance[:, None, None]
        if from_fix and measured and len(self.row_scales) > 1:
            P[..., :2, :2] *= np.array(self.row_scales)[:, None, None, None]
        diagonal = P.reshape(*shape, n * n)[..., :: n + 1]
        diagonal[..., 2:] = self.start_variance
        if self.height >= 0:
            x[..., self.height] = np.array(self.starts)[:, None]
        if self.bias >= 0 and from_fix:
            # A fix is the sum of position and bias, so their errors are anticorrelated.
            shared = np.diag(np.atleast_2d(self.start_variance)[0, self.bias - 2 : self.bias])
            there = slice(self.bias, self.bias + 2)
            P[..., :2, :2] += shared
            P[..., :2, there] = P[..., there, :2] = -shared
        return x, P, np.broadcast_to(self.initial, shape).copy()

    def make_rows(
        self, x: FloatArray, P: FloatArray, mu: FloatArray, logw: FloatArray, sensor: int = 0
    ) -> Rows:
        """Return the rows of T tracks with K rows each: x (T, K, M, n), P (T, K, M, n, n), mu (T,
        K, M), logw (T, K).

        sensor: number of the sensor that started the tracks.
        """
        T, K, M, size = x.shape
        scale = np.resize(np.array(self.row_scales), K)
        start = np.resize(np.arange(len(self.starts)), K)
        return Rows(
            self.to_blocks(x.reshape(T * K, M, size), P.reshape(T * K, M, size, size)),
            mu.reshape(T * K, M),
            logw.reshape(T * K),
            np.repeat(np.arange(T), K),
            np.full(T * K, -1),
            {
                'scale': of_sensor(np.tile(scale, T), sensor),
                'delay': np.zeros((T * K, MOST_SENSORS)),
                'start': np.tile(start, T),
                **{name: np.full(T * K, value) for name, value in NO_OFFSET.items()},
                'side': np.zeros(T * K, np.int64),
            },
        )

    def to_blocks(self, x: FloatArray, P: FloatArray) -> tuple[Gaussians, ...]:
        """Split common components x (N, M, n), P (N, M, n, n) into blocks."""
        found = []
        for part in self.parts:
            at = part.indices(self.n, x.shape[-1])
            own = x[:, part.models][..., at], P[:, part.models][..., at[:, None], at]
            found.append(Gaussians(*(np.ascontiguousarray(np.moveaxis(a, 1, -1)) for a in own)))
        return tuple(found)

    def to_common(self, blocks: tuple[Gaussians, ...]) -> tuple[FloatArray, FloatArray]:
        """Return x (N, M, n) and P (N, M, n, n) in common components.

        A missing component has mean 0 and variance 1.
        """
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
        # A heading has (x, y, s), a velocity (x, y, vx, vy); further components are equal.
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
    """Build the model set named in `config`, with depth and fix bias if configured."""
    built_in = {'families': _build_families, 'heading_speed': _build_heading_speed}
    models = built_in.get(config.model_set, _package_models)(config)
    if config.dimensions == 3:
        models = with_depth(models, config)
    return with_fix_bias(models, config) if config.fix_bias_std > 0.0 else models


def build_chain(config: DiverConfig, matrix: FloatArray) -> markov.RateChain:
    """Return the chain of the configured transition matrix; default: `matrix` (M, M)."""
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
    """Return unit vectors u (M, 2) along and w (M, 2) left of each heading, and the names."""
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
    # Constants of the closure: irregular stamps need a new step at each fix.
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
    # Stationary variance of the speed: `speed_std`, or the larger value of its own noise.
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
        generator = markov.family_generator(family, generators, config.family_switch_rate)
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
        # With depth as a state, rows are depth hypotheses instead of scaled filters.
        scales=(1.0,) if config.dimensions == 3 else tuple(sorted({*config.covariance_scales})),
    )


# -- depth, and errors of fixes ------------------------------------------------------------------


def start_depths(config: DiverConfig) -> tuple[float, ...]:
    """Return the initial z of the rows: centres of equal parts of the water column, or the
    configured z in 2D."""
    if config.dimensions == 2:
        return (config.target_z,)
    count = START_DEPTHS if config.depth_max > config.depth_min else 1
    width = (config.depth_max - config.depth_min) / count
    return tuple(-config.depth_min - (k + 0.5) * width for k in range(count))


def with_depth(base: ModelSet, config: DiverConfig) -> ModelSet:
    """Return `base` with the height z and its rate w: z' = z + tau (1 - a) w, w' = a w + q."""
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
    """Return `base` with time-correlated fix errors, a Gauss-Markov process on each axis."""
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
    """Append the same components to `start` (n,) or (M, n)."""
    there = np.broadcast_to(more, (*start.shape[:-1], len(more)))
    return np.concatenate([start, there], axis=-1)


def _join_motions(base: Motion, F: FloatArray, Q: FloatArray) -> Motion:
    """Append independent components with F and Q to the motion `base`."""
    M, n = base.B.shape
    m = len(F)
    both = Motion(np.zeros((M, n + m, n + m)), np.zeros((M, n + m, n + m)), np.zeros((M, n + m)))
    both.F[:, :n, :n], both.Q[:, :n, :n], both.B[:, :n] = base
    both.F[:, n:, n:], both.Q[:, n:, n:] = F, Q
    return both
