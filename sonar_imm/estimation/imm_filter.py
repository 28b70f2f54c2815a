# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""An interacting multiple model filter for one target, ready to use.

>>> import numpy as np
>>> from sonar_imm import ct, cv, IMM, range_bearing
>>> imm = IMM(
...     models=[cv(noise=0.05), ct(noise=0.05, turn_rate=0.2)],
...     transition=[[0.98, 0.02], [0.1, 0.9]],
...     mean=[100.0, 0.0, 0.0, 1.0],  # px, py [m], vx, vy [m/s]
...     covariance=np.diag([25.0, 25.0, 1.0, 1.0]),
...     measurement=range_bearing(range_std=1.0, bearing_std=0.01),
... )
>>> for z in ([100.0, 0.01], [100.1, 0.02], None, [100.2, 0.04]):  # range [m], bearing [rad]
...     verdict = imm.step(z)
>>> imm.estimate.mean.round(1).tolist(), imm.model_probabilities.round(2).tolist()
([100.0, 4.0, -0.1, 1.0], [0.66, 0.34])

It puts together what the other modules hold: `motion` (models), `imm` (mix, predict, update,
combine), `markov` (the chain over any step), `history` (late measurements), `smoothing`. A
measurement that is not linear is linearised about each model's prediction (extended filter).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import Literal, NamedTuple

from attrs import field, frozen
import numpy as np
from numpy.typing import ArrayLike

from . import imm
from .angles import wrap_angle
from .arrays import FloatArray
from .covariance import is_psd
from .history import ReplayHistory
from .markov import ModelChain, RateChain
from .motion import Joint, Model, Motion
from .smoothing import imm_smooth

FOREVER_NS = 2**63 - 1


def _covariance(R: ArrayLike) -> FloatArray:
    return np.atleast_2d(np.asarray(R, np.float64))


@frozen(eq=False)
class MeasurementModel:
    """What a sensor measures: ``z = h(x) + v``, ``v ~ N(0, R)``, z (m,).

    h: of the values (k,) of `components`, which are outputs of the models; R: (m, m); angles:
    which of the m values are angles [rad], whose differences are wrapped; H: the Jacobian (m, k)
    of h at the values, None for central differences.
    """

    h: Callable[[FloatArray], ArrayLike]
    R: FloatArray = field(converter=_covariance)
    components: tuple[str, ...] = ('px', 'py')
    angles: tuple[int, ...] = ()
    H: Callable[[FloatArray], ArrayLike] | None = None

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(m, k) at x (k,)."""
        if self.H is not None:
            return np.asarray(self.H(x), np.float64)
        columns = []
        for step in np.diag(np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(x), 1.0)):
            change = self.difference(self.h(x + step), self.h(x - step))
            columns.append(change / (2.0 * step.sum()))
        return np.stack(columns, axis=1)

    def difference(self, z: ArrayLike, expected: ArrayLike) -> FloatArray:
        """z - expected (m,), with angles in [-pi, pi]."""
        off = np.asarray(z, np.float64) - np.asarray(expected, np.float64)
        off[list(self.angles)] = wrap_angle(off[list(self.angles)])
        return off


def position(std: float) -> MeasurementModel:
    """px and py [m], each with the standard deviation `std` [m]."""
    return MeasurementModel(lambda x: x, std**2 * np.eye(2), H=lambda x: np.eye(2))


def range_bearing(
    range_std: float, bearing_std: float, at: tuple[float, float] = (0.0, 0.0)
) -> MeasurementModel:
    """Range [m] and bearing [rad, counter-clockwise from x] from a sensor at `at` (px, py), with
    their standard deviations."""

    def h(x: FloatArray) -> FloatArray:
        dx, dy = x - at
        return np.array([math.hypot(dx, dy), math.atan2(dy, dx)])

    def H(x: FloatArray) -> FloatArray:
        dx, dy = x - at
        r = math.hypot(dx, dy)
        return np.array([[dx / r, dy / r], [-dy / r**2, dx / r**2]])

    return MeasurementModel(h, np.diag([range_std**2, bearing_std**2]), angles=(1,), H=H)


class Estimate(NamedTuple):
    """mean (q,) and covariance (q, q) of the outputs."""

    mean: FloatArray
    covariance: FloatArray


class Smoothed(NamedTuple):
    """K instants given all data: stamps (K,) [s], mean (K, q) and covariance (K, q, q) of the
    outputs, model_probabilities (K, M)."""

    stamps: FloatArray
    mean: FloatArray
    covariance: FloatArray
    model_probabilities: FloatArray


class _State(NamedTuple):
    """After a step: x (1, M, n), P (1, M, n, n), mu (1, M); the motion and the transition (M, M)
    that led here; log_likelihood and nis of the last measurement, NaN for none."""

    stamp_ns: int
    x: FloatArray
    P: FloatArray
    mu: FloatArray
    motion: Motion | None = None
    transition: FloatArray | None = None
    log_likelihood: float = math.nan
    nis: float = math.nan


Verdict = Literal['used', 'duplicate', 'too_late', 'full']
_Item = tuple['FloatArray | None', 'MeasurementModel | None']


class IMM:
    """The filter of Blom and Bar-Shalom (1988).

    models: M of them, see `motion`; their states may differ, by named components. transition (M,
    M): ``transition[i, j] = Pr(model j | model i before)`` over `dt` seconds; for other steps it
    follows from its generator; or a `markov.RateChain`. mean (n,), covariance (n, n): at the
    start, in the order of `components`; also the law of a component for models that lack it.
    measurement: of `step`, unless that names another. initial (M,): model probabilities, uniform
    if not given. stamp: of the start [s]; None: a step of `dt` before the first measurement, or
    its stamp. history: how late a measurement may be, and how far back `smooth` looks [s]; finite
    where a filter runs for days, because all of it is kept.

    components: names of the n states; outputs: names of the q values of `estimate`, the components
    first. A component that a model lacks is zero in what it gives out.

    Raises ValueError for what does not fit together.
    """

    def __init__(
        self,
        models: Sequence[Model],
        transition: ArrayLike | RateChain,
        mean: ArrayLike,
        covariance: ArrayLike,
        measurement: MeasurementModel | None = None,
        *,
        dt: float = 1.0,
        initial: ArrayLike | None = None,
        stamp: float | None = None,
        history: float = math.inf,
    ):
        self._joint = Joint(models)
        self.models, self.names = self._joint.models, self._joint.names
        self.components, self.outputs = self._joint.components, self._joint.outputs
        M, n = self._joint.has.shape
        x, P = np.array(mean, np.float64), np.array(covariance, np.float64)
        if x.shape != (n,) or P.shape != (n, n):
            raise ValueError(
                f'mean and covariance need {n} and {n} x {n} values, for '
                f'{", ".join(self.components)}; got {x.shape} and {P.shape}'
            )
        if not is_psd(P):
            raise ValueError('covariance has to be positive definite')
        if not history >= 0.0:
            raise ValueError('history cannot be negative')
        self.dt, self.measurement = _nanoseconds(dt) / 1e9, measurement
        self._chain = ModelChain(transition, self.dt, M, initial)
        self.transition = self._chain.matrix
        self._window_ns = FOREVER_NS if math.isinf(history) else _nanoseconds(history)
        self._law = x, np.diag(P).copy()
        both = self._joint.has[:, :, None] & self._joint.has[:, None]
        P = np.where(both | np.eye(n, dtype=bool), P, 0.0)
        self._first = _State(0, np.tile(x, (1, M, 1)), P[None], self._chain.initial[None])
        self._history: ReplayHistory[_State, _Item] | None = None
        if stamp is not None:
            self._begin(_nanoseconds(stamp))

    def step(
        self,
        z: ArrayLike | None,
        dt: float | None = None,
        *,
        stamp: float | None = None,
        measurement: MeasurementModel | None = None,
    ) -> Verdict:
        """One cycle: mix, predict, update. z (m,), or None where the target was not seen.

        When: `stamp` [s], which may be earlier than others (late); or `dt` seconds after the
        newest, by default `dt` of the filter. Measurements of one stamp update one after the
        other. Says ``used``, ``duplicate`` (these values again at this stamp) or ``too_late``
        (older than `history` or than the start). Raises ValueError for values that do not fit.
        """
        if dt is not None and (stamp is not None or not dt >= 0.0):
            raise ValueError('a step has dt, at least 0, or stamp, not both')
        sensor = measurement or self.measurement
        item: _Item = (None, None)
        if z is not None:
            item = self._checked(np.atleast_1d(np.asarray(z, np.float64)), sensor)
        if self._history is None:
            self._begin(0 if stamp is None else _nanoseconds(stamp))
        history = self._history
        assert history is not None
        if stamp is None:
            stamp_ns = history.state.stamp_ns + _nanoseconds(self.dt if dt is None else dt)
        else:
            stamp_ns = _nanoseconds(stamp)
        if stamp_ns < self._start_ns:
            return 'too_late'
        value, model = item
        key = b'' if value is None or model is None else value.tobytes() + model.R.tobytes()
        return history.insert(stamp_ns, key, item, self._cycle).verdict

    @property
    def stamp(self) -> float:
        """Of the newest estimate [s]."""
        return self._state.stamp_ns / 1e9

    @property
    def estimate(self) -> Estimate:
        """The newest mean and covariance of the mixture."""
        now = self._state
        mean, covariance = imm.combine(now.x, now.P, now.mu, self._joint.E)
        return Estimate(mean[0], covariance[0])

    @property
    def model_probabilities(self) -> FloatArray:
        """(M,), in the order of `names`."""
        return self._state.mu[0].copy()

    @property
    def log_likelihood(self) -> float:
        """Of the newest measurement given those before it; NaN where it was missed."""
        return self._state.log_likelihood

    @property
    def nis(self) -> float:
        """Normalised innovation squared of the newest measurement under the mixture, m degrees of
        freedom; NaN where it was missed."""
        return self._state.nis

    def smooth(self) -> Smoothed:
        """All stamps kept in the history, oldest first, each given all measurements
        (`smoothing.imm_smooth`). Raises ValueError before the first step."""
        states = self._history.states if self._history is not None else []
        if not states:
            raise ValueError('there is nothing to smooth before the first step')
        motions = [state.motion for state in states if state.motion is not None]
        transitions = [state.transition for state in states if state.transition is not None]
        x, P, mu = (np.concatenate(part) for part in zip(*(state[1:4] for state in states)))
        F, Q, B = map(np.stack, zip(*motions))
        found = imm_smooth(x, P, mu, np.stack(transitions), F, Q, B)
        stamps = np.array([state.stamp_ns for state in states]) / 1e9
        return Smoothed(stamps, *found.combine(self._joint.E), found.mu)

    @property
    def _state(self) -> _State:
        return self._first if self._history is None else self._history.state

    def _begin(self, stamp_ns: int) -> None:
        self._start_ns = stamp_ns
        self._first = self._first._replace(stamp_ns=stamp_ns)
        self._history = ReplayHistory(self._first, self._window_ns)

    def _checked(self, z: FloatArray, sensor: MeasurementModel | None) -> _Item:
        """Raises ValueError."""
        if sensor is None:
            raise ValueError('a step needs a measurement model, here or in the filter')
        unknown = [name for name in sensor.components if name not in self.outputs]
        if unknown:
            raise ValueError(
                f"'{unknown[0]}' is measured, but no model has it: name what is measured in "
                'MeasurementModel(h, R, components)'
            )
        if z.shape != (len(sensor.R),) or not np.isfinite(z).all():
            raise ValueError(f'z needs {len(sensor.R)} finite values, or None; got {z}')
        return z, sensor

    def _cycle(self, before: _State, stamp_ns: int, items: Sequence[_Item]) -> _State:
        """The state after all measurements of a stamp. Pure."""
        dt = (stamp_ns - before.stamp_ns) / 1e9
        transition = self._chain.over(dt)
        x, P, c = imm.mix(before.x, before.P, before.mu, transition[None])
        motion = self._joint.motion(x[0], dt, *self._law)
        x, P, _ = imm.predict(x, P, *motion)
        now = _State(stamp_ns, x, P, c, motion, transition)
        for z, sensor in items:
            if z is not None and sensor is not None:
                now = self._updated(now, z, sensor)
        return now

    def _updated(self, now: _State, z: FloatArray, sensor: MeasurementModel) -> _State:
        E = self._joint.E[:, [self.outputs.index(name) for name in sensor.components]]
        values = np.einsum('jka,ja->jk', E, now.x[0])
        H = np.stack([sensor.jacobian(value) for value in values]) @ E
        innovation = np.stack([sensor.difference(z, sensor.h(value)) for value in values])
        after = imm.update(now.x, now.P, now.mu, innovation[None], H[None], sensor.R[None])
        found = float(after.log_likelihood[0]), float(after.nis[0])
        return _State(now.stamp_ns, *after[:3], now.motion, now.transition, *found)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)
