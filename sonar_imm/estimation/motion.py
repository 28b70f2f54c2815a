# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Motion models by name: what a target may do, stated once, for any filter that mixes models.

A `Model` names the components of its state and says how they move. Models of different components
run side by side in one state that has them all (`Joint`). A component that a model lacks is drawn
afresh from a stated law at each step, so that a model that needs it meets a sane prior when mixed;
and it is zero under that model: who hovers has no velocity.

Components of the models here: px, py position [m]; vx, vy velocity [m/s]; ax, ay acceleration
[m/s^2]; turn [rad/s, counter-clockwise]. Noises are densities of white noise, so that ten steps of
0.1 s equal one of 1 s.

Source: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*
(2001), ch. 6 and 11; Li, Jilkov, *Survey of maneuvering target tracking, part I*, IEEE TAES 39(4),
2003.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from attrs import field, frozen
import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray

POSITION, VELOCITY, ACCELERATION = ('px', 'py'), ('vx', 'vy'), ('ax', 'ay')


class Motion(NamedTuple):
    """One step: x <- F x + B + N(0, Q), of one model or of M. F, Q (..., n, n), B (..., n)."""

    F: FloatArray
    Q: FloatArray
    B: FloatArray


@frozen(eq=False)
class Model:
    """One way to move.

    components: names of its n states. motion: ``motion(x, dt)`` gives the `Motion` over dt >= 0
    seconds, (n, n), (n, n) and (n,), linearised about the mean x (n,) where it is not linear
    (``B = f(x) - F x``). outputs: what else it says of the target, each a row (n,):
    ``{'vx': (0, 0, 1)}`` is a velocity that equals the third state.
    """

    name: str
    components: tuple[str, ...]
    motion: Callable[[FloatArray, float], Motion]
    outputs: Mapping[str, Sequence[float]] = field(factory=dict)


def cv(noise: float, name: str = 'cv') -> Model:
    """Constant velocity (px, py, vx, vy), disturbed by white acceleration of `noise` m/s/sqrt(s)
    on each axis.

    >>> F, Q, B = cv(noise=1.0).motion(None, 2.0)
    >>> F[0, :3].tolist(), Q[0].round(3).tolist()
    ([1.0, 0.0, 2.0], [2.667, 0.0, 2.0, 0.0])
    """
    return ct(noise, 0.0, name)


def ct(
    noise: float, turn_rate: float | None = None, name: str = 'ct', *, turn_noise: float = 0.01
) -> Model:
    """Coordinated turn, disturbed by white acceleration of `noise` m/s/sqrt(s).

    turn_rate: rad/s, counter-clockwise, of (px, py, vx, vy). None: it is a state, (px, py, vx, vy,
    turn), which walks at random by `turn_noise` rad/s/sqrt(s); linearised about the mean.
    """

    def known(x: FloatArray, dt: float) -> Motion:
        rate = float(turn_rate or 0.0)
        return Motion(turning(rate, dt), white_acceleration(noise**2, rate, dt), np.zeros(4))

    def unknown(x: FloatArray, dt: float) -> Motion:
        rate = float(x[4])
        F, Q = np.eye(5), np.zeros((5, 5))
        F[:4, :4], Q[:4, :4] = turning(rate, dt), white_acceleration(noise**2, rate, dt)
        F[:4, 4] = _turning_slope(rate, dt) @ x[2:4]
        Q[4, 4] = turn_noise**2 * dt
        return Motion(F, Q, np.append(-rate * F[:4, 4], 0.0))

    if turn_rate is None:
        return Model(name, (*POSITION, *VELOCITY, 'turn'), unknown)
    return Model(name, (*POSITION, *VELOCITY), known)


def ca(noise: float, name: str = 'ca') -> Model:
    """Constant acceleration (px, py, vx, vy, ax, ay), disturbed by white jerk of `noise`
    m/s^2/sqrt(s) on each axis."""

    def motion(x: FloatArray, dt: float) -> Motion:
        F = np.array([[1.0, dt, dt**2 / 2.0], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        powers = np.array([[20.0, 8.0, 6.0], [8.0, 3.0, 2.0], [6.0, 2.0, 1.0]])
        order = np.arange(5, 2, -1)[:, None] - np.arange(3)
        Q = noise**2 * dt**order / powers
        return Motion(np.kron(F, np.eye(2)), np.kron(Q, np.eye(2)), np.zeros(6))

    return Model(name, (*POSITION, *VELOCITY, *ACCELERATION), motion)


def hover(noise: float, name: str = 'hover') -> Model:
    """Standing still (px, py), but for a random walk of `noise` m/sqrt(s) on each axis."""

    def motion(x: FloatArray, dt: float) -> Motion:
        return Motion(np.eye(2), noise**2 * dt * np.eye(2), np.zeros(2))

    return Model(name, POSITION, motion)


class Joint:
    """M models in one state of n components.

    Raises ValueError when models share a name, a model names a component twice, or a row of
    outputs does not fit.

    names (M,), components (n,): of the state, in the order in which models name them; outputs
    (q,): the components and what else models say; E (M, q, n): outputs of each model; has (M, n):
    which components each one has.
    """

    def __init__(self, models: Sequence[Model]):
        self.models = tuple(models)
        self.names = tuple(model.name for model in models)
        if not models or len(set(self.names)) < len(models):
            raise ValueError(f'models need names of their own, got {list(self.names)}')
        self.components = tuple(dict.fromkeys(c for model in models for c in model.components))
        more = (name for model in models for name in model.outputs)
        self.outputs = tuple(dict.fromkeys((*self.components, *more)))
        self._index = [[self.components.index(c) for c in model.components] for model in models]
        self._places = [np.ix_(own, own) for own in self._index]
        self.has = np.zeros((len(models), len(self.components)), bool)
        self.E = np.zeros((len(models), len(self.outputs), len(self.components)))
        for model, own, has, E in zip(models, self._index, self.has, self.E):
            if len(set(own)) < len(own):
                raise ValueError(f"model '{model.name}' names a component twice")
            has[own] = True
            E[own, own] = 1.0
            for name, row in model.outputs.items():
                if np.shape(row) != (len(own),):
                    raise ValueError(
                        f"output '{name}' of model '{model.name}' needs {len(own)} values, one "
                        f'for each of its components, got {np.size(row)}'
                    )
                E[self.outputs.index(name)] = 0.0
                E[self.outputs.index(name), own] = row

    def motion(self, x: FloatArray, dt: float, mean: ArrayLike, variance: ArrayLike) -> Motion:
        """The step of all models from their means x (M, n); mean, variance (n,): the law of what
        a model lacks. Raises ValueError for a motion of another size."""
        M, n = self.has.shape
        F, B = np.zeros((M, n, n)), np.tile(np.full(n, mean, np.float64), (M, 1))
        Q = np.tile(np.diag(np.full(n, variance, np.float64)), (M, 1, 1))
        for j, (model, own, places) in enumerate(zip(self.models, self._index, self._places)):
            step = [np.asarray(part, np.float64) for part in model.motion(x[j, own], dt)]
            k = len(own)
            if [part.shape for part in step] != [(k, k), (k, k), (k,)]:
                raise ValueError(
                    f"model '{model.name}': motion has to give F ({k}, {k}), Q ({k}, {k}) and B "
                    f'({k},), got {", ".join(str(part.shape) for part in step)}'
                )
            F[j][places], Q[j][places], B[j, own] = step
        return Motion(F, Q, B)


def white_acceleration(rate: float, turn: float, dt: float) -> FloatArray:
    """Process noise (4, 4) of a velocity that walks at random, `rate` (m/s)^2 a second, while it
    turns by `turn` rad/s: the exact integral, so steps compose."""
    angle = turn * dt
    lag = (angle - np.sin(angle)) / angle**3 if abs(angle) > 1e-2 else 1.0 / 6.0 - angle**2 / 120.0
    along, across = 0.5 * dt**2 * np.sinc(0.5 * angle / np.pi) ** 2, dt**2 * angle * lag
    Q = np.empty((4, 4))
    Q[:2, :2] = 2.0 * rate * dt**3 * lag * np.eye(2)
    Q[:2, 2:] = rate * np.array([[along, across], [-across, along]])
    Q[2:, :2] = Q[:2, 2:].T
    Q[2:, 2:] = rate * dt * np.eye(2)
    return Q


def turning(rate: float, dt: float) -> FloatArray:
    """Transition (4, 4) of (px, py, vx, vy) under a constant turn rate, rad/s,
    counter-clockwise."""
    F = np.eye(4)
    angle = rate * dt
    # sin(a)/rate and (1 - cos(a))/rate, whose limits at rate 0 are dt and 0
    along = dt * np.sinc(angle / np.pi)
    across = dt * np.sin(0.5 * angle) * np.sinc(0.5 * angle / np.pi)
    F[:2, 2:] = [[along, -across], [across, along]]
    F[2:, 2:] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return F


def _turning_slope(rate: float, dt: float) -> FloatArray:
    """How `turning` changes with the rate, (4, 2): the columns of vx and vy."""
    angle = rate * dt
    sine, cosine = np.sin(angle), np.cos(angle)
    if abs(angle) > 1e-3:
        along = (dt * cosine - sine / rate) / rate
        across = (dt * sine - (1.0 - cosine) / rate) / rate
    else:
        along, across = -rate * dt**3 / 3.0, 0.5 * dt**2 * (1.0 - 0.25 * angle**2)
    return np.array(
        [
            [along, -across],
            [across, along],
            [-dt * sine, -dt * cosine],
            [dt * cosine, -dt * sine],
        ]
    )
