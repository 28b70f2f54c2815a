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

"""Mean NIS of a memory, against closed forms and random numbers."""

import numpy as np
import pytest
from scipy.stats import chi2

from sonar_imm.estimation.consistency import NIS_MEMORY, NisMemory


def test_the_memory_is_a_weighted_mean():
    rng = np.random.default_rng(2)
    nis, dof = rng.chisquare(3, 300), rng.integers(1, 4, 300)
    memory = NisMemory()
    for k in range(0, 300, 3):
        memory = memory.after(nis[k : k + 3], dof[k : k + 3])
    weight = (1.0 - 1.0 / NIS_MEMORY) ** np.arange(299, -1, -1)
    assert (nis > 9.0 * dof).any()  # some are so far out that they count as nine
    expected = weight @ np.minimum(nis, 9.0 * dof) / (weight @ dof)
    assert memory.mean == pytest.approx(expected, rel=1e-12)
    assert memory.square == pytest.approx(weight**2 @ dof, rel=1e-12)
    assert memory.after(np.empty(0), 2) == memory


def test_its_bounds_are_those_of_the_chi_square_of_the_same_variance():
    memory = NisMemory()
    for _ in range(2000):
        memory = memory.after(np.array([2.0]), 2)
    equivalent = memory.dof**2 / memory.square
    assert equivalent == pytest.approx(2.0 * (2.0 * NIS_MEMORY - 1.0), rel=1e-9)
    tail = 2.866516e-7  # of a Gaussian beyond five sigmas
    low, high = memory.bounds
    assert low == pytest.approx(chi2.ppf(tail, equivalent) / equivalent, rel=2e-3)
    assert high == pytest.approx(chi2.isf(tail, equivalent) / equivalent, rel=2e-3)


@pytest.mark.parametrize('factor, verdict', [(1.0, 0), (4.0, 1), (0.25, -1)])
def test_true_words_are_believed_and_wrong_ones_are_not(factor, verdict):
    rng = np.random.default_rng(3)
    memory, verdicts = NisMemory(), []
    for _ in range(5000):
        memory = memory.after(factor * rng.chisquare(2, 1), 2)
        verdicts.append(memory.verdict)
    assert not any(verdicts[:68])  # too few
    assert set(verdicts[200:]) == {verdict}
    assert bool(memory.warnings('echoes', 'look')) == bool(verdict)
    if verdict:
        word = 'more' if verdict > 0 else 'less'
        assert f'echoes miss by {word} than stated' in memory.warnings('echoes', 'look')[0]
