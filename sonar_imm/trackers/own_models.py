# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Models of motion that another package brings: what they have to be, and how they are found.

A package registers a name in the entry-point group `sonar_imm.models`. What stands there is called
with the tracker's config, and gives `DiverModels` for the diver tracker (parameter `model_set`) or
an `ObstacleBehaviour` for the obstacle tracker (parameter `behaviours`); a class whose constructor
takes the config will do. See docs/howto/own_model.md.

Whatever is wrong with one becomes a `ConfigError` that names the entry point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import re
from typing import Any, cast, NamedTuple, Protocol

from attrs import frozen
import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import FloatArray
from ..estimation.markov import check_transition_matrix
from ..estimation.motion import Joint, Model, Motion
from ..parameters import Config, ConfigError, MODELS, registered

_WORD = re.compile(r'[A-Za-z0-9_]+')


class DiverModels(Protocol):
    """A model set: M linear models that the IMM of the diver tracker runs side by side.

    models: each has the components px and py [m, east and north] first; a velocity is vx, vy
    [m/s], as components or as outputs (`estimation.motion.Model`). transition: (M, M),
    ``[i, j] = Pr(model j | model i before)`` over `reference_step` seconds. start: mean and
    standard deviation of every component but px and py for a new track, ``{'vx': (0.0, 0.5)}``; a
    model that lacks the component draws it from there as well.
    """

    models: Sequence[Model]
    transition: ArrayLike
    start: Mapping[str, tuple[float, float]]


class BehaviourStep(NamedTuple):
    """A step on each horizontal axis: ``e' = keep e + w``, ``w ~ N(0, noise)``, and the obstacle
    goes by ``step e + push w`` metres. Where the square of e, on both axes together, is less than
    `slow`, the noise is less in proportion."""

    keep: float
    step: float
    push: float
    noise: float
    slow: float = 0.0


class ObstacleBehaviour(Protocol):
    """What an obstacle may do besides standing still.

    It has one number e on each horizontal axis, such as a velocity or a displacement. std:
    standard deviation of e of a new obstacle, above 0. velocity: whether e is the velocity [m/s],
    for ``vx``, ``vy`` and the forecast of collisions. share: how probable the behaviour is for a
    new obstacle, where fixed has 0.54, swaying and moving 0.18, seabed 0.1.
    """

    std: float
    velocity: bool
    share: float

    def step(self, dt: float) -> BehaviourStep:
        """Over dt >= 0 seconds; a tuple of the first four numbers will do."""
        ...


@frozen(eq=False)
class OwnSet:
    """A `DiverModels` that was checked: joint, its models in one state; transition (M, M); mean
    and variance (n,) of a new track, of px and py without meaning."""

    joint: Joint
    transition: FloatArray
    mean: FloatArray
    variance: FloatArray

    def motion(self, dt: float) -> Motion:
        """The step of all models; of linear ones the state is not needed."""
        unknown = np.full(self.joint.has.shape, np.nan)
        return self.joint.motion(unknown, dt, self.mean, self.variance)


def diver_models(name: str, config: Config) -> OwnSet:
    """The model set of that name. Raises ConfigError."""
    made = _made('model_set', name, config, ('models', 'transition', 'start'))
    try:
        return checked(made)
    except Exception as error:
        raise _wrong('model_set', name, error) from error


def checked(made: DiverModels) -> OwnSet:
    """What the diver tracker makes of a set. Raises ValueError."""
    joint = Joint(made.models)
    for model in joint.models:
        if tuple(model.components[:2]) != ('px', 'py'):
            raise ValueError(f"the components of model '{model.name}' have to begin px, py")
        if not _WORD.fullmatch(model.name):
            raise ValueError(f"'{model.name}' cannot name a column; letters, digits, _ can")
    if lacking := sorted(set(joint.components[2:]) - set(made.start)):
        raise ValueError(f'start lacks {", ".join(lacking)}')
    law = [(0.0, 1.0)] * 2 + [made.start[name] for name in joint.components[2:]]
    mean, std = np.array(law, np.float64).T
    if not (np.isfinite(mean).all() and np.isfinite(std).all() and (std > 0.0).all()):
        raise ValueError('start needs finite means, and standard deviations above 0')
    transition = check_transition_matrix(made.transition)
    if len(transition) != len(joint.names):
        raise ValueError(f'transition needs a row for each of {len(joint.names)} models')
    found = OwnSet(joint, transition, mean, std**2)
    if not all(np.isfinite(part).all() for part in found.motion(1.0)):
        raise ValueError('a motion depends on the state; the diver tracker takes linear ones')
    return found


def obstacle_behaviour(name: str, config: Config) -> ObstacleBehaviour:
    """The behaviour of that name. Raises ConfigError."""
    made = _made('behaviours', name, config, ('std', 'velocity', 'share', 'step'))
    try:
        step = np.array(BehaviourStep(*made.step(1.0)), np.float64)
        if not (np.isfinite(step).all() and step[3:].min() >= 0.0 and 0.0 < made.std < np.inf):
            raise ValueError(
                'a step has to be finite, its noise and slow at least 0, and std above 0'
            )
        if not 0.0 < made.share < np.inf or not _WORD.fullmatch(name):
            raise ValueError('share has to be above 0, and the name of letters, digits and _')
    except Exception as error:
        raise _wrong('behaviours', name, error) from error
    return cast(ObstacleBehaviour, made)


def _made(parameter: str, name: str, config: Config, needs: Sequence[str]) -> Any:
    entry = registered(MODELS, name)
    try:
        if entry is None:
            raise LookupError('no package registers it')
        made = entry.load()(config)
        if lacking := [each for each in needs if not hasattr(made, each)]:
            raise TypeError(f'{type(made).__name__} lacks {", ".join(lacking)}')
    except Exception as error:
        raise _wrong(parameter, name, error) from error
    return made


def _wrong(parameter: str, name: str, error: Exception) -> ConfigError:
    entry = registered(MODELS, name)
    where = f'{MODELS}: {entry.value}' if entry is not None else MODELS
    text = ' '.join(str(error).split())
    kind = '' if type(error) in (ValueError, LookupError) else f'{type(error).__name__}: '
    return ConfigError(f"{parameter} '{name}' ({where}) cannot be used: {kind}{text}")
