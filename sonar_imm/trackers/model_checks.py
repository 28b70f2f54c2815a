"""Rules that the configs of several trackers share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..estimation.association import TrackRules
from ..measurements import nanoseconds


class TrackParameters(Protocol):
    """The parameters of confirmation and deletion; max_coast in seconds."""

    confirm_hits: int
    confirm_window: int
    delete_misses: int
    max_coast: float


def track_rules(config: TrackParameters) -> TrackRules:
    """The rules of tracks that `config` states."""
    return TrackRules(
        config.confirm_hits,
        config.confirm_window,
        config.delete_misses,
        nanoseconds(config.max_coast),
    )


def chain_problems(
    matrix: Sequence[float], initial: Sequence[float], models: int, model_set: str
) -> list[str]:
    """What is wrong with a row-major transition matrix and the initial probabilities of a set of
    `models`; empty ones were left to the tracker."""
    problems = []
    if matrix:
        if len(matrix) != models * models:
            problems.append(
                f'transition_matrix needs {models} x {models} = {models * models} values for '
                f'model_set {model_set}, got {len(matrix)}'
            )
        else:
            sums = np.reshape(matrix, (models, models)).sum(axis=1)
            problems += [
                f'row {row} of transition_matrix sums to {total:.6g}, not 1'
                for row, total in enumerate(sums)
                if abs(total - 1.0) > 1e-6
            ]
    if initial:
        if len(initial) != models:
            problems.append(f'initial_probabilities needs {models} values, got {len(initial)}')
        elif abs(sum(initial) - 1.0) > 1e-6:
            problems.append(f'initial_probabilities sum to {sum(initial):.6g}, not 1')
    return problems
