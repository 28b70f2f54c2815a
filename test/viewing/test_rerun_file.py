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

"""What is drawn in a Rerun file, as far as it needs no Rerun."""

import sys
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.estimates import Estimate


@pytest.fixture
def drawn(monkeypatch):
    """The module, in which Rerun is only called to write."""
    try:
        import rerun  # noqa: F401
    except ImportError:
        empty = ModuleType('rerun')
        empty.blueprint = None
        monkeypatch.setitem(sys.modules, 'rerun', empty)
    from sonar_imm_tools.viewing import rerun_file

    yield rerun_file
    if getattr(sys.modules.get('rerun'), 'blueprint', 0) is None:
        del sys.modules['sonar_imm_tools.viewing.rerun_file']


def estimate(state_names, covariance, **extras):
    n, d = covariance.shape[:2]
    return Estimate(
        stamp_ns=1,
        frame_id='map',
        xyz=np.zeros((n, 3), np.float32),
        state_names=state_names,
        state=np.zeros((n, d)),
        covariance=covariance,
        model_names=(),
        probabilities=np.empty((n, 0)),
        extras=extras,
    )


def test_ellipsoids_are_those_of_the_covariances_of_places(drawn):
    rng = np.random.default_rng(1)
    A = rng.normal(size=(4, 3, 3))
    full = A @ A.swapaxes(1, 2)
    flat = drawn._place_covariances(estimate(('px', 'py'), full[:, :2, :2]))
    assert (flat[:, :2, :2] == full[:, :2, :2]).all() and not flat[:, 2].any()
    upper = {f'place_cov_{a}_{b}': full[:, 'xyz'.index(a), 'xyz'.index(b)] for a, b in (
        ('x', 'x'), ('x', 'y'), ('x', 'z'), ('y', 'y'), ('y', 'z'), ('z', 'z')
    )}  # fmt: skip
    places = drawn._place_covariances(estimate(('range',), full[:, :1, :1], **upper))
    assert places == pytest.approx(full)
    assert drawn._place_covariances(estimate(('range',), full[:, :1, :1])) is None
    half, turns = drawn._ellipsoids(full)
    R = Rotation.from_quat(turns).as_matrix()
    assert np.einsum('nij,nj,nkj->nik', R, (half / 2.0) ** 2, R) == pytest.approx(full)
    assert drawn._ellipsoids(np.zeros((1, 3, 3)))[0] == pytest.approx(0.005)
