# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Rules that the configs of several trackers share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..estimation.markov import check_transition_matrix


def matrix_problems(
    matrix: Sequence[float], models: int, what: str, *, name: str = 'transition_matrix'
) -> list[str]:
    """What is wrong with a row-major transition matrix of `models` (of `what`, in words); an empty
    one was left to the tracker."""
    if not matrix:
        return []
    if len(matrix) != models * models:
        return [
            f'{name} needs {models} x {models} = {models * models} values for {what}, got '
            f'{len(matrix)}'
        ]
    try:
        check_transition_matrix(np.reshape(matrix, (models, models)), name=name)
    except ValueError as error:
        return [str(error)]
    return []


def chain_problems(
    matrix: Sequence[float], initial: Sequence[float], models: int, model_set: str
) -> list[str]:
    """What is wrong with a row-major transition matrix and the initial probabilities of a set of
    `models`; empty ones were left to the tracker."""
    problems = matrix_problems(matrix, models, f'model_set {model_set}')
    if initial:
        if len(initial) != models:
            problems.append(f'initial_probabilities needs {models} values, got {len(initial)}')
        elif abs(sum(initial) - 1.0) > 1e-6:
            problems.append(f'initial_probabilities sum to {sum(initial):.6g}, not 1')
    return problems
