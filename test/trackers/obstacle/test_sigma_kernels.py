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

"""Sigma points of many components against plain numpy, near and far from their centre."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.trackers.obstacle import sigma_kernels


def sigma_points(rng, lanes, spread):
    """States (4, lanes), their root (4, 4, lanes), and all points (4, 9, lanes)."""
    y = np.array(
        [
            rng.uniform(20.0, 80.0, lanes), rng.uniform(-0.5, 0.5, lanes),
            rng.uniform(-5.0, 5.0, lanes), rng.normal(0.0, 0.01, lanes),
        ]
    )  # fmt: skip
    scale = np.array([0.2, spread, 1.5, 0.003])
    F = np.tril(rng.normal(size=(lanes, 4, 4)) * scale[:, None]).transpose(1, 2, 0)
    points = np.repeat(y[:, None], 9, axis=1)
    for column in range(4):
        points[:, 1 + 2 * column] += F[:, column]
        points[:, 2 + 2 * column] -= F[:, column]
    return y, np.ascontiguousarray(F), points


@pytest.mark.parametrize('cone', [False, True])
def test_places_equal_the_geometry(cone):
    rng = np.random.default_rng(1)
    y, F, points = sigma_points(rng, 7, 0.01)
    R = geometry.rotation(0.1, -0.05, 2.0)
    out, scratch = np.empty((3, 7, 7)), np.empty((9, 7, 7))
    sigma_kernels.places(y, F, 1.0, R, cone, scratch, out)
    model = 'cone' if cone else 'plane'
    exact = geometry.reconstruct(points[0], points[1], points[2] - 1.0, R, model)
    assert_allclose(np.moveaxis(out, 0, -1), exact[:7], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize('spread', [1e-4, 0.01, 0.5])
@pytest.mark.parametrize('turn', [0.0, 0.1, 1.0, 3.0])
def test_azimuths_equal_the_arc_tangent(spread, turn):
    """By series, by the halved angle and by the arc tangent itself."""
    rng = np.random.default_rng(2)
    near = np.array([-0.4, 0.0, 0.3, 3.1])
    azimuth = near + turn + np.concatenate([np.zeros((1, 4)), rng.normal(0.0, spread, (8, 4))])
    d = rng.uniform(10.0, 50.0, (9, 4))
    m = np.stack([d * np.cos(azimuth), d * np.sin(azimuth), rng.normal(size=(9, 4))])
    distance, got = np.empty((9, 4)), np.empty((9, 4))
    sigma_kernels.echoes(near, m, False, np.empty((3, 9, 4)), distance, got)
    assert_allclose(distance, np.linalg.norm(m, axis=0), rtol=1e-14)
    centre = np.arctan2(m[1, 0], m[0, 0])
    beside = np.remainder(azimuth - azimuth[0] + np.pi, 2.0 * np.pi) - np.pi
    assert_allclose(got, centre + beside, rtol=1e-13, atol=2e-15)
