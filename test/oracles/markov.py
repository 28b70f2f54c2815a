# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The stationary distribution of a Markov chain."""

import numpy as np

from sonar_imm.estimation.arrays import FloatArray


def stationary_law(P: FloatArray) -> FloatArray:
    """The stationary distribution (M,), pi P = pi. ValueError when there is more
    than one."""
    M = len(P)
    system = np.vstack([P.T - np.eye(M), np.ones(M)])
    if np.linalg.matrix_rank(system, tol=1e-12 * M) < M:
        raise ValueError(
            'the chain has closed classes that never meet: several distributions are stationary'
        )
    law = np.linalg.lstsq(system, np.append(np.zeros(M), 1.0), rcond=None)[0]
    law = np.clip(law, 0.0, None)
    return np.asarray(law / law.sum())
