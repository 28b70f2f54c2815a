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
heading_speed_lateral
    State (x, y, s, l): as above, with a lateral speed l that fades (Ornstein-Uhlenbeck), for
    headings between the models.
families
    State (x, y, s, unused) or (x, y, vx, vy): two heading_speed sets and three constant velocities
    in one filter, in copies for covariances that are too small; see `families`.
world_headings
    To compare with: state (px, py, vx, vy), but v is drawn afresh around s u_j, s given.
relative_headings
    To compare with: v' = R(a_j) v, p += dt v': model j turns by a_j once; model 0 goes straight.
cv, cv_cv, cv_ct
    Single-direction baselines: white-noise acceleration, quiet and lively, or with turns.
others
    Of other packages, see `own_models`.

Source: docs/diver.md; the multi-directional set after the paper, whose equations are partly lost:
these are reconstructions.
"""

from __future__ import annotations

from collections.abc import Callable

from attrs import evolve
import numpy as np

from ...estimation import markov
from ...estimation.adaptation import Chain
from ...estimation.arrays import FloatArray
from ...estimation.motion import Motion, turning, white_acceleration
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

BASELINE_NOISE = {'cv': (0.25,), 'cv_cv': (0.05, 0.6), 'cv_ct': (0.1, 0.3, 0.3)}
"""Acceleration noise, m/s^2, that suits divers: tuned on the scene of the paper's Table 1."""


def build_models(config: DiverConfig) -> ModelSet:
    """The model set that `config` names, with the depth and the bias of fixes that it asks for."""
    models = {
        'families': _families,
        'heading_speed': _heading_speed,
        'heading_speed_lateral': _heading_speed_lateral,
        'world_headings': _world_headings,
        'relative_headings': _relative_headings,
        'cv': _single_direction,
        'cv_cv': _single_direction,
        'cv_ct': _single_direction,
    }.get(config.model_set, _own)(config)
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


def _heading_speed_lateral(config: DiverConfig) -> ModelSet:
    base = _heading_speed(config)
    M = len(base.names)
    u = base.E[:, 2:, 2]
    w = np.column_stack([-u[:, 1], u[:, 0]])
    E = np.zeros((M, 4, 4))
    E[:, :, :3] = base.E
    E[:, 2:, 3] = w
    variance, fade = config.lateral_speed_std**2, config.lateral_speed_time

    def motion(dt: float) -> Motion:
        small = base.motion(dt)
        F, Q = np.zeros((M, 4, 4)), np.zeros((M, 4, 4))
        F[:, :3, :3], Q[:, :3, :3] = small.F, small.Q
        keep = np.exp(-dt / fade)
        reach = fade * (1.0 - keep)
        F[:, 3, 3] = keep
        F[:, :2, 3] = reach * w
        along = 2.0 * variance * (fade * dt - 2.0 * fade * reach + 0.5 * fade**2 * (1.0 - keep**2))
        cross = variance * fade * (1.0 - keep) ** 2
        Q[:, :2, :2] += along * _outer(w)
        Q[:, :2, 3] = Q[:, 3, :2] = cross * w
        Q[:, 3, 3] = variance * (1.0 - keep**2)
        return Motion(F, Q, np.zeros((M, 4)))

    return ModelSet(
        base.names,
        E,
        base.chain,
        np.append(base.start_mean, 0.0),
        np.append(base.start_variance, variance),
        base.initial,
        motion,
    )


# -- to compare with ------------------------------------------------------------------------------


def _with_velocity(
    config: DiverConfig, names: tuple[str, ...], chain: Chain, motion: Callable[[float], Motion]
) -> ModelSet:
    """Models whose state is position and velocity, which begins at rest."""
    M = len(names)
    return ModelSet(
        names,
        np.tile(np.eye(4), (M, 1, 1)),
        chain,
        np.zeros(2),
        np.full(2, config.velocity_std**2),
        initial_probabilities(config, M),
        motion,
    )


def _world_headings(config: DiverConfig) -> ModelSet:
    u, _, names = headings(config)
    M, T = len(names), config.reference_step
    P = markov.persistent_headings(
        config.directions, config.stay_probability, config.heading_concentration
    )
    variance = config.velocity_noise**2

    def motion(dt: float) -> Motion:
        F, Q = np.zeros((4, 4)), np.zeros((4, 4))
        F[:2, :2] = np.eye(2)
        Q[:2, :2] = variance * T * dt * np.eye(2)
        Q[2:, 2:] = variance * np.eye(2)
        Q[:2, 2:] = Q[2:, :2] = variance * min(T, dt) * np.eye(2)
        return Motion(
            np.tile(F, (M, 1, 1)),
            np.tile(Q, (M, 1, 1)),
            config.fixed_speed * np.hstack([dt * u, u]),
        )

    return _with_velocity(config, names, rate_chain(config, P), motion)


def _relative_headings(config: DiverConfig) -> ModelSet:
    u, _, _ = headings(config)
    M, T = len(u), config.reference_step
    names = tuple(f'turn_{360 * j // M:03d}' for j in range(M))
    turning = markov.persistent_headings(M, config.stay_probability, config.heading_concentration)[
        0
    ]
    chain: Chain = (
        rate_chain(config, turning[None].repeat(M, 0))
        if config.transition_matrix
        else markov.EventChain(turning, T)
    )
    R = np.stack([np.stack([u[:, 0], -u[:, 1]], -1), np.stack([u[:, 1], u[:, 0]], -1)], -2)
    rate = config.velocity_noise**2 / T

    def motion(dt: float) -> Motion:
        F, Q = np.tile(np.eye(4), (M, 1, 1)), white_acceleration(rate, 0.0, dt)
        F[:, :2, 2:], F[:, 2:, 2:] = dt * R, R
        return Motion(F, np.tile(Q, (M, 1, 1)), np.zeros((M, 4)))

    return _with_velocity(config, names, chain, motion)


def _single_direction(config: DiverConfig) -> ModelSet:
    turn = np.deg2rad(config.turn_rate_deg)
    names, turns = {
        'cv': (('cv',), (0.0,)),
        'cv_cv': (('cv_quiet', 'cv_lively'), (0.0, 0.0)),
        'cv_ct': (('cv', 'ct_left', 'ct_right'), (0.0, turn, -turn)),
    }[config.model_set]
    M = len(names)
    noise = config.acceleration_noise or BASELINE_NOISE[config.model_set]
    rates = [value**2 * config.reference_step for value in noise]
    P = markov.persistent(M, config.baseline_stay_probability)

    def motion(dt: float) -> Motion:
        return Motion(
            np.stack([turning(turn, dt) for turn in turns]),
            np.stack([white_acceleration(*both, dt) for both in zip(rates, turns)]),
            np.zeros((M, 4)),
        )

    return _with_velocity(config, names, rate_chain(config, P), motion)
