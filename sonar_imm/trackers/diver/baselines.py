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

"""Model sets to compare with the default: the readings of the paper with a velocity in the state,
and filters with a single direction.

world_headings
    State (px, py, vx, vy), but v is drawn afresh around s u_j with a speed s that is given.
relative_headings
    v' = R(a_j) v, p += dt v': model j turns by a_j once; model 0 goes straight.
cv, cv_cv, cv_ct
    The single-direction baselines: white-noise acceleration, quiet and lively, or with turns.

With ``u_j = (cos a_j, sin a_j)`` the heading of model j; see `models`.
"""

from __future__ import annotations

import numpy as np

from ...estimation import markov
from ...estimation.adaptation import Chain
from ...estimation.arrays import FloatArray
from ...estimation.motion import Motion, turning, white_acceleration
from .config import DiverConfig
from .state_space import headings, initial_probabilities, ModelSet, rate_chain

BASELINE_NOISE = {'cv': (0.25,), 'cv_cv': (0.05, 0.6), 'cv_ct': (0.1, 0.3, 0.3)}
"""Acceleration noise, m/s^2, that suits divers: tuned on the scene of the paper's Table 1."""


def _velocity_state(M: int) -> FloatArray:
    return np.tile(np.eye(4), (M, 1, 1))


def world_headings(config: DiverConfig) -> ModelSet:
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

    return ModelSet(
        names,
        _velocity_state(M),
        rate_chain(config, P),
        np.zeros(2),
        np.full(2, config.velocity_std**2),
        initial_probabilities(config, M),
        motion,
    )


def relative_headings(config: DiverConfig) -> ModelSet:
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

    return ModelSet(
        names,
        _velocity_state(M),
        chain,
        np.zeros(2),
        np.full(2, config.velocity_std**2),
        initial_probabilities(config, M),
        motion,
    )


def single_direction(config: DiverConfig) -> ModelSet:
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

    return ModelSet(
        names,
        _velocity_state(M),
        rate_chain(config, P),
        np.zeros(2),
        np.full(2, config.velocity_std**2),
        initial_probabilities(config, M),
        motion,
    )
