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

"""The motion models a diver tracker can run side by side.

All sets give the same outputs, position and velocity ``(px, py, vx, vy)``, through their output
map E, and are stated at a reference step T but usable at any step dt: noises grow like the
processes they stand for, and the chain has a rate generator. With ``u_j = (cos a_j, sin a_j)`` the
heading of model j and ``w_j`` its left normal:

heading_speed
    State (x, y, s): the heading is in the model, the speed in the state. p += dt s u_j + wander
    along w_j; s is a slow random walk; `hover` stands still.
families
    State (x, y, s, unused) or (x, y, vx, vy): two heading_speed sets and three constant velocities
    in one filter, in copies for covariances that are too small; see `families`.
others
    Of other packages, see `own_models`.

Source: docs/diver.md; heading_speed is after the paper, whose equations are partly lost.
"""

from __future__ import annotations

from attrs import evolve
import numpy as np

from ...estimation import markov
from ...estimation.arrays import FloatArray
from ...estimation.motion import Motion
from ..own_models import diver_models
from .config import DiverConfig
from .families import families
from .state_space import (
    headings,
    initial_probabilities,
    ModelSet,
    OUTPUTS,
    rate_chain,
    with_depth,
    with_fix_bias,
)

__all__ = ['build_models']


def build_models(config: DiverConfig) -> ModelSet:
    """The model set that `config` names, with the depth and the bias of fixes that it asks for."""
    built_in = {'families': _families, 'heading_speed': _heading_speed}
    models = built_in.get(config.model_set, _own)(config)
    if config.dimensions == 3:
        models = with_depth(models, config)
    return with_fix_bias(models, config) if config.fix_bias_std > 0.0 else models


def _own(config: DiverConfig) -> ModelSet:
    own = diver_models(config.model_set, config)
    names = own.joint.outputs
    E = np.zeros((len(own.joint.names), len(OUTPUTS), len(own.mean)))
    for row, name in enumerate(OUTPUTS):
        if name in names:
            E[:, row] = own.joint.E[:, names.index(name)]
    return ModelSet(
        own.joint.names,
        E,
        rate_chain(config, own.transition),
        own.mean[2:],
        own.variance[2:],
        initial_probabilities(config, len(E)),
        own.motion,
    )


def _outer(v: FloatArray) -> FloatArray:
    """v v^T for each row: (M, 2) -> (M, 2, 2)."""
    return np.asarray(v[:, :, None] * v[:, None, :])


def _heading_speed(config: DiverConfig) -> ModelSet:
    u, w, names = headings(config)
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
    wander = config.lateral_noise**2 * _outer(w)
    if config.hover:
        wander[-1] = config.hover_noise**2 * np.eye(2)
    speed_rate = config.speed_noise**2 / T
    # Irregular stamps ask for a new step at each fix.
    still, along, nothing = np.tile(np.eye(3), (M, 1, 1)), _outer(u), np.zeros((M, 3))

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
        rate_chain(config, P),
        np.array([config.speed_mean]),
        np.array([config.speed_std**2]),
        initial_probabilities(config, M),
        motion,
    )


def _families(config: DiverConfig) -> ModelSet:
    plain = evolve(
        config, model_set='heading_speed', transition_matrix=(), initial_probabilities=()
    )
    return families(
        config,
        _heading_speed(plain),
        _heading_speed(evolve(plain, speed_noise=config.brisk_speed_noise)),
    )
