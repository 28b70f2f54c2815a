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

"""What the state of a diver holds: the motion of all models, and the constants behind it.

*Motion* (`ModelSet`): M models over a common state, and how a track begins in them. Any set may be
given two things besides: depth, and the lasting error of fixes.

Depth is z up and its rate, which fades like that of a diver who goes up and down. One filter with
the whole water column as its prior locks onto a wrong depth, because the path of an echo bends
with z squared and the error is common to all pings. So there are copies of the models, each of
which begins in its part of the column; they do not switch, and what they say of the arrivals
weighs them. Where the arrivals say nothing about z the copies stay as likely as they were, and
their spread is in the published covariance.

*Constants* (`Instruments`, `Layout`): each receiver may lie off its stated place and have a late
clock; the sound speed may be wrong for all; a sensor of bearings may be turned by some degrees,
because its mount or its heading is off. These constants stand behind the states of motion of
every model and track, and the receivers that have been heard so far decide how many there are. New
ones come in with their prior, uncorrelated with all that is known.

How a constant is treated is described in `estimation.consider`. What is considered is one
constant for all models and tracks. What is estimated is a copy in each model and track, mixed like
any state: one posterior shared by tracks would need their joint covariance, and the posterior of
one track as the prior of another would count its data twice.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

from attrs import evolve, field, frozen
import numpy as np

from ...acoustics.arrivals_3d import CLOCK, EMISSION, OFFSET, SOUND_SPEED_ERROR, X, Y, Z
from ...estimation import markov
from ...estimation.adaptation import Chain
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.gauss_markov import gauss_markov
from ...estimation.motion import Motion
from ...measurements import Arrivals
from .config import DiverConfig
from .family_kernels import Mixing

OUTPUTS = ('px', 'py', 'vx', 'vy')
_CACHED_STEPS = 64

DEPTH_COPIES = 3
"""Copies of the models, each of which begins in its part of the water column."""

COPY_SPREAD = 1.3
"""Variance in z with which a copy begins, in variances of its part: the parts overlap."""

AT_TRANSMITTER = 0.01
"""Horizontal distance in metres within which a receiver is at the transmitter: the frame hangs on
that place, so that it has no error of position there."""
MOST_RECEIVERS = 64
"""Receivers whose errors are part of the state, which grows with its square; those that are heard
first. More are numbers that wander, not instruments."""


@frozen(eq=False)
class ModelSet:
    """M models over a common state of n components, x and y first.

    names: of the models; E: (M, q, n) outputs; chain: the law of switching; start: state
    components after the position for a new track, mean and variance, (n - 2,) each or (M, n - 2);
    initial: (M,) model probabilities of a new track. What `with_depth` and `with_fix_bias` add:
    outputs, names of the q outputs; height and bias, places of z and of the bias of fixes in the
    state, -1 for none; heights (K,): where K copies of the models begin in z, which do not switch
    between each other. What `families` adds: mixing, the kinds of unequal states; scales (K,): by
    what K copies multiply the covariances of measurements; stated (K,): which of them say how far
    off an estimate may be.
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
    heights: tuple[float, ...] = (0.0,)
    mixing: Mixing | None = None
    scales: tuple[float, ...] = (1.0,)
    stated: tuple[bool, ...] = (True,)
    _cache: OrderedDict[float, Motion] = field(factory=OrderedDict, init=False)

    @property
    def n(self) -> int:
        return int(self.E.shape[2])

    @property
    def copies(self) -> int:
        return max(len(self.heights), len(self.scales))

    @property
    def blocks(self) -> tuple[slice, ...]:
        """The places of models with states of the same components that switch between each
        other."""
        if self.mixing is None:
            return (slice(0, len(self.names)),)
        ends = np.cumsum(np.bincount(self.mixing.family)).tolist()
        return tuple(slice(first, last) for first, last in zip([0, *ends], ends))

    def by_model(self, mu: FloatArray) -> FloatArray:
        """Model probabilities (T, M) of mu (T, K M), whatever the copy."""
        if self.copies == 1:
            return mu
        return np.asarray(mu.reshape(len(mu), self.copies, len(self.names)).sum(axis=1))

    @property
    def fix(self) -> FloatArray:
        """(M, 2, n): what a fix measures of the state."""
        if self.bias < 0:
            return self.E[:, :2]
        H = self.E[:, :2].copy()
        H[:, :, self.bias : self.bias + 2] += np.eye(2)
        return H

    def motion(self, dt: float) -> Motion:
        """The models over a step of dt seconds, dt >= 0."""
        found = self._cache.get(dt)
        if found is None:
            found = self._cache[dt] = Motion(*map(np.ascontiguousarray, self._motion(dt)))
            if len(self._cache) > _CACHED_STEPS:
                self._cache.popitem(last=False)
        return found

    def new_tracks(
        self,
        position: FloatArray,
        covariance: FloatArray,
        from_fix: bool = True,
        measured: bool = True,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x (k, K M, n), P (k, K M, n, n), mu (k, K M) of tracks first seen at `position` (k, 2)
        with `covariance` (k, 2, 2), which the copies multiply where it is that of what was
        `measured`."""
        M, n, K = len(self.names), self.n, self.copies
        shape = len(position), K * M
        x, P = np.empty((*shape, n)), np.zeros((*shape, n, n))
        x[..., :2], x[..., 2:] = position[:, None], self._for_copies(self.start_mean)
        P[..., :2, :2] = covariance[:, None]
        if from_fix and measured and len(self.scales) > 1:
            P[..., :2, :2] *= np.repeat(self.scales, M)[:, None, None]
        diagonal = P.reshape(*shape, n * n)[..., :: n + 1]
        diagonal[..., 2:] = self._for_copies(self.start_variance)
        if self.height >= 0:
            x[..., self.height] = np.repeat(self.heights, M)
        if self.bias >= 0 and from_fix:
            # A fix is position and bias: as much as one is larger the other is smaller.
            shared = np.diag(np.atleast_2d(self.start_variance)[0, self.bias - 2 : self.bias])
            there = slice(self.bias, self.bias + 2)
            P[..., :2, :2] += shared
            P[..., :2, there] = P[..., there, :2] = -shared
        mu = np.empty(shape)
        mu[:] = np.tile(self.initial / K, K) if K > 1 else self.initial
        return x, P, mu

    def _for_copies(self, start: FloatArray) -> FloatArray:
        """What all models begin with, or each one of each copy."""
        return start if start.ndim == 1 else np.tile(start, (self.copies, 1))


def headings(config: DiverConfig) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Unit vectors along u (M, 2) and to the left of w (M, 2) each heading, and their names."""
    angle = 2.0 * np.pi * np.arange(config.directions) / config.directions
    u = np.column_stack([np.cos(angle), np.sin(angle)])
    w = np.column_stack([-np.sin(angle), np.cos(angle)])
    return (
        u,
        w,
        tuple(f'heading_{360 * j // config.directions:03d}' for j in range(config.directions)),
    )


def rate_chain(config: DiverConfig, matrix: FloatArray) -> markov.RateChain:
    """The chain of `matrix` (M, M), or of the one that the parameters state."""
    if config.transition_matrix:
        matrix = np.reshape(config.transition_matrix, matrix.shape)
    return markov.RateChain(matrix, config.reference_step)


def initial_probabilities(config: DiverConfig, models: int) -> FloatArray:
    """(M,) of a new track."""
    if config.initial_probabilities:
        return np.array(config.initial_probabilities)
    return np.full(models, 1.0 / models)


def heights_of(config: DiverConfig) -> tuple[float, ...]:
    """z at which the copies of the models begin: the middles of equal parts of the water column,
    or where the diver is assumed to be."""
    if config.dimensions == 2:
        return (config.target_z,)
    copies = DEPTH_COPIES if config.depth_max > config.depth_min else 1
    width = (config.depth_max - config.depth_min) / copies
    return tuple(-config.depth_min - (k + 0.5) * width for k in range(copies))


def with_depth(base: ModelSet, config: DiverConfig) -> ModelSet:
    """`base` with the height z and its rate w, z' = z + tau (1 - a) w, w' = a w + q, in copies
    over the water column."""
    M, n, heights = len(base.names), base.n, heights_of(config)
    copies = len(heights)
    width = (config.depth_max - config.depth_min) / copies
    E = np.zeros((M, 6, n + 2))
    E[:, :2, :n], E[:, 3:5, :n] = base.E[:, :2], base.E[:, 2:]
    E[:, 2, n] = E[:, 5, n + 1] = 1.0
    rate = config.vertical_speed_std**2

    def motion(dt: float) -> Motion:
        fade, added = gauss_markov(config.vertical_speed_std, config.vertical_speed_time, dt)
        way = config.vertical_speed_time * (1.0 - fade)
        return _joined(base.motion(dt), np.array([[1.0, way], [0.0, fade]]), np.diag([0.0, added]))

    return evolve(
        base,
        E=np.tile(E, (copies, 1, 1)),
        start_mean=_appended(base.start_mean, [heights[0], 0.0]),
        start_variance=_appended(
            base.start_variance, [max(COPY_SPREAD * width**2 / 12.0, 1e-4), rate]
        ),
        motion=motion,
        outputs=('px', 'py', 'pz', 'vx', 'vy', 'vz'),
        height=n,
        heights=heights,
    )


def with_fix_bias(base: ModelSet, config: DiverConfig) -> ModelSet:
    """`base` with an error of the fixes that lasts, one Gauss-Markov process an axis."""
    n, std = base.n, config.fix_bias_std
    E = np.concatenate([base.E, np.zeros((*base.E.shape[:2], 2))], axis=2)

    def motion(dt: float) -> Motion:
        fade, added = gauss_markov(std, config.fix_bias_time, dt)
        return _joined(base.motion(dt), fade * np.eye(2), added * np.eye(2))

    return evolve(
        base,
        E=E,
        start_mean=_appended(base.start_mean, [0.0, 0.0]),
        start_variance=_appended(base.start_variance, [std**2, std**2]),
        motion=motion,
        bias=n,
    )


def _appended(start: FloatArray, more: list[float]) -> FloatArray:
    """`start` (n,) or (M, n) with the same further components for all models."""
    there = np.broadcast_to(more, (*start.shape[:-1], len(more)))
    return np.concatenate([start, there], axis=-1)


def _joined(base: Motion, F: FloatArray, Q: FloatArray) -> Motion:
    """The motion of more states beside those of `base`, on which nothing of it depends."""
    M, n = base.B.shape
    m = len(F)
    both = Motion(np.zeros((M, n + m, n + m)), np.zeros((M, n + m, n + m)), np.zeros((M, n + m)))
    both.F[:, :n, :n], both.Q[:, :n, :n], both.B[:, :n] = base
    both.F[:, n:, n:], both.Q[:, n:, n:] = F, Q
    return both


TIMES, PLACE, BEARINGS = 'times', 'place', 'bearings'
"""What may be off for good."""


@frozen
class Instruments:
    """Receivers heard so far, in the order in which their errors stand in the state.

    known: each a receiver id or the name of a sensor, and what of it may be off: `TIMES` of
    arrival, `PLACE` as well, or `BEARINGS`.
    """

    known: tuple[tuple[int | str, str], ...] = ()

    def with_receivers(self, ping: Arrivals, config: DiverConfig) -> Instruments:
        """With the receivers of a ping, `MOST_RECEIVERS` in all; the same where nothing is to be
        known of them."""
        new: list[tuple[int | str, str]] = []
        if config.receiver_position_std or config.receiver_clock_std:
            ids = {each for each, what in self.known if what != BEARINGS}
            for receiver in np.unique(ping.rx_id).tolist():
                if receiver not in ids:
                    row = int(np.flatnonzero(ping.rx_id == receiver)[0])
                    apart = np.hypot(*(ping.rx[row] - ping.tx[row])[:2])
                    new.append((receiver, TIMES if apart <= AT_TRANSMITTER else PLACE))
        if config.bearing_bias_std_deg:
            bearing = np.unique(ping.rx_id[np.isfinite(ping.bearing)]).tolist()
            new += [(each, BEARINGS) for each in bearing if (each, BEARINGS) not in self.known]
        return self._with(new)

    def with_sensor(self, name: str) -> Instruments:
        """With a sensor whose fixes may all be turned about it; the same where it is known."""
        return self if (name, BEARINGS) in self.known else self._with([(name, BEARINGS)])

    def _with(self, new: list[tuple[int | str, str]]) -> Instruments:
        new = new[: max(0, MOST_RECEIVERS - len(self.known))]
        return Instruments((*self.known, *new)) if new else self

    def layout(self, config: DiverConfig, models: ModelSet) -> Layout:
        """Where the errors stand behind the states of motion of `models`."""
        n = models.n
        variances: list[float] = []
        estimated: list[bool] = []
        errors = config.systematic_errors
        speed = -1
        if config.sound_speed_std:
            speed = n
            variances.append((config.sound_speed_std / config.sound_speed) ** 2)
            estimated.append(errors != 'consider')
        offsets, clocks, bearings = {}, {}, {}
        for receiver, what in self.known:
            if what == BEARINGS:
                bearings[receiver] = n + len(variances)
                variances.append(np.radians(config.bearing_bias_std_deg) ** 2)
                estimated.append(errors == 'estimate')
                continue
            if config.receiver_position_std and what == PLACE:
                offsets[receiver] = n + len(variances)
                variances += [config.receiver_position_std**2] * 2
                estimated += [errors == 'estimate'] * 2
            if config.receiver_clock_std:
                clocks[receiver] = n + len(variances)
                variances.append((config.receiver_clock_std * config.sound_speed) ** 2)
                estimated.append(errors != 'consider')
        H = np.zeros((1, len(models.E), 2, n + len(variances)))
        H[0, :, :, :n] = models.fix
        mask = np.array([True] * n + estimated)
        scales, stated = np.array(models.scales), np.array(models.stated)
        places = speed, offsets, clocks, bearings
        return Layout(n, np.array(variances), mask, H, scales, stated, *places)


LEAST_WEIGHT = 1e-150
"""Weight that a copy keeps."""


def each_kept(log_weight: FloatArray, mu: FloatArray, copies: int) -> FloatArray:
    """mu (K M) in which each of the copies keeps `LEAST_WEIGHT`: a ping of many arrivals can be
    e^700 times as probable in one as in another; log_weight (K M) is of what mu is."""
    lost = np.flatnonzero(mu.reshape(copies, -1).sum(axis=1) < LEAST_WEIGHT)
    if copies == 1 or not len(lost):
        return mu
    kept = mu.reshape(copies, -1).copy()
    for copy in lost:
        own = log_weight.reshape(copies, -1)[copy]
        inside = np.exp(own - own.max()) if np.isfinite(own.max()) else np.ones_like(own)
        kept[copy] = LEAST_WEIGHT * inside / inside.sum()
    return np.asarray(kept.ravel() / kept.sum())


def as_stated(mu: FloatArray, stated: BoolArray) -> FloatArray:
    """mu (..., K M) without the copies that are not `stated` (K,)."""
    if stated.all():
        return mu
    kept = np.where(np.repeat(stated, mu.shape[-1] // len(stated)), mu, 0.0)
    return np.asarray(kept / kept.sum(axis=-1, keepdims=True))


@frozen(eq=False)
class Layout:
    """n states of motion, then q constants with prior `variances` (q,).

    mask (n + q,): True for what an update may move, False for what is only considered; H
    (1, M, 2, n + q): what a fix measures of the whole state; scales, stated (K,): as in
    `ModelSet`; sound_speed, offsets, clocks, bearings: places in the whole state, -1 or absent
    for none.
    """

    n: int
    variances: FloatArray
    mask: BoolArray
    H: FloatArray
    scales: FloatArray
    stated: BoolArray
    sound_speed: int
    offsets: dict[int | str, int]
    clocks: dict[int | str, int]
    bearings: dict[int | str, int]

    @property
    def size(self) -> int:
        return self.n + len(self.variances)

    def columns(
        self, models: ModelSet, receivers: np.ndarray, passive: bool, bearing: BoolArray
    ) -> IntArray:
        """(C, 7) for `acoustics.arrivals_3d.observe`, of which some are a `bearing` (C,); of a tag
        the emission stands last."""
        out = np.full((len(receivers), 7), -1)
        out[:, X], out[:, Y], out[:, Z] = 0, 1, models.height
        out[:, SOUND_SPEED_ERROR] = self.sound_speed
        out[:, OFFSET] = [self.offsets.get(receiver, -1) for receiver in receivers.tolist()]
        out[:, CLOCK] = [
            (self.bearings if angle else self.clocks).get(receiver, -1)
            for receiver, angle in zip(receivers.tolist(), bearing)
        ]
        if passive:
            out[:, EMISSION] = self.size
        return out

    def as_seen(
        self, x: FloatArray, P: FloatArray, sensor: str, place: FloatArray, *, back: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """States (..., n + q) and covariances whose positions are those that a `sensor` at `place`
        (2,) shows: turned about it by the error of its bearings, or `back`.

        So a fix measures the position itself, whoever it is of and wherever he is: what the error
        does to it stands in the covariance of the state, wherever the state goes from there.
        """
        if sensor not in self.bearings:  # there were too many before it
            return x, P
        at, sign = self.bearings[sensor], -1.0 if back else 1.0
        angle, arm = sign * x[..., at], x[..., :2] - place
        cos, sin = np.cos(angle), np.sin(angle)
        turned = np.stack([cos * arm[..., 0] - sin * arm[..., 1],
                           sin * arm[..., 0] + cos * arm[..., 1]], axis=-1)  # fmt: skip
        T = np.zeros_like(P)
        T[..., range(self.size), range(self.size)] = 1.0
        T[..., 0, 0] = T[..., 1, 1] = cos
        T[..., 1, 0], T[..., 0, 1] = sin, -sin
        T[..., 0, at], T[..., 1, at] = -sign * turned[..., 1], sign * turned[..., 0]
        x, P = x.copy(), T @ P @ np.swapaxes(T, -1, -2)
        x[..., :2] = place + turned
        return x, 0.5 * (P + np.swapaxes(P, -1, -2))

    def widened(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (..., m) and covariances (..., m, m), m <= n + q, with the constants that are new
        at their prior."""
        m, size = x.shape[-1], self.size
        if m == size:
            return x, P
        wide, covariance = np.zeros((*x.shape[:-1], size)), np.zeros((*x.shape[:-1], size, size))
        wide[..., :m], covariance[..., :m, :m] = x, P
        new = range(m, size)
        covariance[..., new, new] = self.variances[m - self.n :]
        return wide, covariance
