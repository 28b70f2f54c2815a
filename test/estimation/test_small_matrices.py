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

"""What works on many components at once against what works on one."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.estimation import small_matrices
from sonar_imm.estimation.small_matrices import (
    lanes_for,
    MOST_LANES,
    not_psd,
    semidefinite_roots,
    turn_of,
)


def covariances(rng, n, lanes):
    """Covariances (lanes, n, n): sound ones, singular ones, and some that are none."""
    A = rng.normal(size=(lanes, n, n)) * 10.0 ** rng.uniform(-3.0, 2.0, (lanes, n, 1))
    P = A @ np.swapaxes(A, -1, -2)
    P[1, 2, :] = P[1, :, 2] = 0.0
    P[2, n - 1, :] = P[2, :, n - 1] = P[2, 0, 0] = 0.0
    P[3] = np.outer(np.arange(1.0, n + 1), np.arange(1.0, n + 1))
    P[4, 1, 1] *= -1.0
    P[5, 0, 0] = np.nan
    P[6, n - 1, n - 1] = np.inf
    P[7] = 0.0
    return P


@pytest.mark.parametrize('n', [3, 4, 6])
def test_roots_and_soundness_are_those_of_single_matrices(n):
    lanes = 40
    P = covariances(np.random.default_rng(n), n, lanes)
    S, L, scratch = (
        np.ascontiguousarray(np.moveaxis(P, 0, -1)),
        np.zeros((n, n, lanes)),
        np.empty(lanes),
    )
    bad = np.empty(lanes, np.int64)
    semidefinite_roots(S, L, scratch)
    for k in range(lanes):
        root = np.zeros((n, n))
        small_matrices.semidefinite_root(P[k], root)
        mine = np.tril(L[:, :, k])
        assert_allclose(mine, root, rtol=1e-6, atol=1e-300, err_msg=str(k))
        size = np.sqrt(np.abs(np.diag(P[k])))
        close = np.abs(mine @ mine.T - root @ root.T) <= 1e-13 * np.outer(size, size)
        assert close.all() or not np.isfinite(P[k]).all(), k
    not_psd(S, L, scratch, bad)
    alone = [not small_matrices.is_psd(P[k], np.zeros((n, n))) for k in range(lanes)]
    assert bad.tolist() == [int(each) for each in alone]
    assert {0, 1} == set(bad.tolist())


@pytest.mark.parametrize('count', [1, 9, MOST_LANES, MOST_LANES + 1, 180, 560])
def test_turns_cover_all_components(count):
    lanes = lanes_for(count)
    done = [turn_of(first, count, lanes) + np.arange(lanes) for first in range(0, count, lanes)]
    assert lanes <= MOST_LANES
    assert set(np.concatenate(done).tolist()) == set(range(count))
