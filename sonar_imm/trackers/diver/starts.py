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

"""Tracks that begin where somebody says that a diver is.

A start is no measurement: it is believed, so its track is confirmed at once. Tracks without a name
that it agrees with give way to it, or the diver would have two; with one diver, all do.
"""

from __future__ import annotations

from collections.abc import Sequence

from attrs import evolve
import numpy as np

from ...estimation import imm_kernels
from ...estimation.arrays import BoolArray
from ...estimation.association import CONFIRMED, gate_threshold, TENTATIVE
from ...measurements import Measurement, NOBODY, Start
from .config import DiverConfig
from .state import DiverState


def starts_of(items: Sequence[Measurement]) -> list[Start]:
    """The starts among the measurements of one stamp."""
    return [item for item in items if isinstance(item, Start)]


def make_room(
    now: DiverState, start: Start, config: DiverConfig, E: np.ndarray
) -> tuple[DiverState, bool]:
    """The tracks without those that give way to `start`, and whether there is room for its own; E
    (M, 2, n): to the position."""
    going = now.target_id == NOBODY
    if config.max_tracks > 1 and len(going):
        going &= _agree(now, start, config, E)
    left = now.rows(~going, life=now.life.only(~going))
    if int((left.life.status != TENTATIVE).sum()) < config.max_tracks:
        return left, True
    return evolve(now, not_started=now.not_started + 1), False


def confirmed(now: DiverState) -> DiverState:
    """With its newest track confirmed."""
    status = now.life.status.copy()
    status[-1] = CONFIRMED
    return evolve(now, life=evolve(now.life, status=status))


def no_room(now: DiverState, config: DiverConfig) -> list[str]:
    """What a user has to know of starts that began no track."""
    if not now.not_started:
        return []
    return [
        f'{now.not_started} starts began no track: there are max_tracks '
        f'({config.max_tracks}) confirmed ones'
    ]


def _agree(now: DiverState, start: Start, config: DiverConfig, E: np.ndarray) -> BoolArray:
    """Which tracks (T,) may be where the start is."""
    n = E.shape[-1]
    x, P = np.ascontiguousarray(now.x[..., :n]), np.ascontiguousarray(now.P[..., :n, :n])
    mean, covariance = imm_kernels.combine(x, P, now.mu, np.ascontiguousarray(E))
    apart = start.position[:2] - mean
    squared = np.einsum(
        'ta,ta->t', apart, np.linalg.solve(covariance + start.covariance, apart[..., None])[..., 0]
    )
    return np.asarray(squared <= gate_threshold(config.gate_probability, 2))
