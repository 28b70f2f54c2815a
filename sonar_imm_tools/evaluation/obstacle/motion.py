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

"""Whether obstacles move as stated, and whether stated collisions happen.

velocity    RMSE of each axis, of what moves and of what does not; NEES of what moves
behaviours  mean stated probability of each behaviour, by what the obstacle does; brier: of all
            behaviours together, 0 to 2
collisions  Brier score of the stated probability, beside that of a guess by how often it happens,
            and by bins how often what was stated happened

A collision is what the tracker was told it is: `safety_radius` and `safety_height` at once, within
`cpa_horizon`. A forecast counts where the truth goes on until its outcome is known: it happened,
the horizon is over, or the obstacle has been passed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers.obstacle.config import BEHAVIOURS, ObstacleConfig

from ... import SECOND
from ..numbers import chi2_summary, usable_nees
from .series import Matching, TruePath

RISKS = (0.0, 0.02, 0.1, 0.3, 0.6, 0.9, 1.0)


def motion_metrics(
    found: Matching, truth: Sequence[TruePath], config: ObstacleConfig
) -> dict[str, Any]:
    """``velocity``, ``behaviours`` and ``collisions``, each where the run and its truth tell."""
    metrics = {
        'velocity': velocity_scores(found, truth),
        'behaviours': behaviour_scores(found, truth),
        'collisions': forecast_scores(*forecasts(found, truth, config)),
    }
    return {name: values for name, values in metrics.items() if values}


def velocity_scores(found: Matching, truth: Sequence[TruePath]) -> dict[str, Any]:
    series, at = found.series, _newest(found, truth)
    known = np.array([path.velocity is not None for path in truth], bool)[found.target]
    known &= np.isfinite(series.velocity[found.row]).all(axis=1)
    rows = np.flatnonzero(known)
    if not len(rows):
        return {}
    true = np.array([truth[found.target[k]].velocity[at[k]] for k in rows])  # type: ignore[index]
    error = series.velocity[found.row[rows]] - true
    moves = np.linalg.norm(true, axis=1) > 0.0
    scores: dict[str, Any] = {
        name: {'n': int(which.sum()), 'rmse_m_s': float(np.sqrt(np.mean(error[which] ** 2)))}
        for name, which in (('moving', moves), ('still', ~moves))
        if which.any()
    }
    # What is certain not to move has a velocity of zero without spread.
    if moves.any():
        spread = series.velocity_covariance[found.row[rows[moves]]]
        scores['moving']['nees'] = chi2_summary(usable_nees(error[moves], spread), 2)
    return scores


def behaviour_scores(found: Matching, truth: Sequence[TruePath]) -> dict[str, Any]:
    at = _newest(found, truth)
    stated = np.nan_to_num(found.series.does[found.row])
    known = np.array([path.does is not None for path in truth], bool)[found.target]
    rows = np.flatnonzero(known & (stated.sum(axis=1) > 0.0))
    if not len(rows):
        return {}
    true = np.array([truth[found.target[k]].does[at[k]] for k in rows])  # type: ignore[index]
    confusion = {
        BEHAVIOURS[kind]: {
            'n': int((true == kind).sum()),
            **{
                name: float(stated[rows][true == kind, i].mean())
                for i, name in enumerate(BEHAVIOURS)
            },
        }
        for kind in np.unique(true)
    }
    off = stated[rows] - np.eye(len(BEHAVIOURS))[true]
    return {'confusion': confusion, 'brier': float(np.mean(np.sum(off**2, axis=1)))}


def forecasts(
    found: Matching, truth: Sequence[TruePath], config: ObstacleConfig
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Stated probabilities (m,) of which the outcome is known, and whether it happened (m,)."""
    stated, came = [], []
    outcomes = [_outcomes(path, config) for path in truth]
    at = _newest(found, truth)
    for k, row in enumerate(found.row.tolist()):
        outcome = outcomes[found.target[k]][at[k]]
        if np.isfinite(found.series.risk[row]) and np.isfinite(outcome):
            stated.append(found.series.risk[row])
            came.append(outcome > 0.0)
    return np.array(stated, float), np.array(came, bool)


def forecast_scores(stated: FloatArray, came: NDArray[np.bool_]) -> dict[str, Any]:
    """Brier score and bins of forecasts (m,) and what came of them (m,)."""
    if not len(stated):
        return {}
    which = np.clip(np.searchsorted(RISKS, stated, side='right') - 1, 0, len(RISKS) - 2)
    often = float(came.mean())
    return {
        'n': len(stated),
        'happened': often,
        'brier': float(np.mean((stated - came) ** 2)),
        'brier_of_a_guess': often * (1.0 - often),
        'bins': {
            f'{RISKS[k]:g} to {RISKS[k + 1]:g}': {
                'n': int((which == k).sum()),
                'stated': float(stated[which == k].mean()),
                'came_true': float(came[which == k].mean()),
            }
            for k in range(len(RISKS) - 1)
            if (which == k).any()
        },
    }


def _outcomes(path: TruePath, config: ObstacleConfig) -> FloatArray:
    """Of each stamp (n,) of an obstacle: 1 when a collision follows, 0 when none does, NaN when
    the truth ends before that is known."""
    t = path.stamp_ns / SECOND
    distance, _, offset = path.seen.T
    level = np.sqrt(np.maximum(distance**2 - offset**2, 0.0))
    hits = np.flatnonzero(
        (level <= config.safety_radius) & (np.abs(offset) <= config.safety_height)
    )
    outcome = np.full(len(t), np.nan)
    # Passed: it was nearest before the end, and is out of reach when the truth ends.
    nearest = int(np.argmin(level))
    passed = nearest < len(t) - 1 and level[-1] > config.safety_radius
    for k in range(len(t)):
        following = hits[np.searchsorted(hits, k) :]
        if len(following) and t[following[0]] - t[k] <= config.cpa_horizon:
            outcome[k] = 1.0
        elif passed or t[-1] - t[k] >= config.cpa_horizon:
            outcome[k] = 0.0
    return outcome


def _newest(found: Matching, truth: Sequence[TruePath]) -> NDArray[np.int64]:
    """Index into the obstacle's truth, the newest of each matched row (m,)."""
    stamps = found.series.stamp_ns[found.row]
    at = np.zeros(len(found.row), np.int64)
    for target, path in enumerate(truth):
        rows = found.target == target
        at[rows] = np.searchsorted(path.stamp_ns, stamps[rows], side='right') - 1
    return np.maximum(at, 0)
