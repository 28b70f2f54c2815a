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

"""What the figures of all systems share."""

import numpy as np
import pytest

from sonar_imm_tools.evaluation.plotting import nis_figure, thin


@pytest.mark.parametrize('count, most', [(0, 10), (10, 10), (11, 10), (99, 10)])
def test_thinning_keeps_at_most_what_it_says(count, most):
    left = len(np.arange(count)[thin(count, most)])
    assert left <= most and left >= min(count, most // 2)


def test_hits_with_different_degrees_of_freedom_are_divided_by_them():
    time, nis = np.arange(4.0), np.array([2.0, 9.0, 4.0, 1.0])
    same, mixed = (nis_figure(time, nis, np.array(dof)) for dof in ([2] * 4, [2, 3, 2, 1]))
    np.testing.assert_allclose(same.data[0].y, nis)
    np.testing.assert_allclose(mixed.data[0].y, [1.0, 3.0, 2.0, 1.0])
    assert len(same.layout.shapes) == 1 and len(mixed.layout.shapes) == 0
