# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Composition of a relative fix with the vessel's pose against draws of every error."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.acoustics.geometry import Pose, rotation
from sonar_imm.acoustics.relative_position import Mounting, place, Uncertainty

NOTHING = np.zeros((3, 3))

VESSEL = Pose(np.array([1.0, 2.0, 3.0]), rotation(0.1, -0.05, 0.8))
MOUNT = Mounting(np.array([2.0, -1.0, -3.0]), rotation(0.0, 0.1, -0.4), 0.05)
POSITION = np.diag([1.0, 0.5, 0.2]) + 0.1
ATTITUDE = np.diag(np.radians([0.5, 0.4, 2.0])) ** 2 + 1e-5
OFFSET = np.array([150.0, 60.0, -40.0])
STD = {'range_std': 0.1, 'angle_std': np.radians(2.0)}


def truth(levelled=False):
    seen = OFFSET if levelled else VESSEL.R @ MOUNT.R @ OFFSET
    return VESSEL.position + VESSEL.R @ MOUNT.lever + seen


def claimed(levelled=False, covariance=None):
    """What is stated of the place of a target measured without an error."""
    known = VESSEL, Uncertainty(POSITION, ATTITUDE), MOUNT, OFFSET, covariance
    return place(*known, levelled=levelled, **STD).covariance


def test_what_is_certain_adds_nothing_and_place_and_lever_what_they_are_uncertain_by():
    std = {'range_std': 1.0, 'angle_std': 1.0}
    sure, loose = Mounting(MOUNT.lever, MOUNT.R), Mounting(MOUNT.lever, MOUNT.R, 0.3)
    placed = place(VESSEL, Uncertainty(NOTHING, NOTHING), sure, OFFSET, NOTHING, **std)
    assert placed.position == pytest.approx(truth())
    assert not placed.covariance.any()
    placed = place(VESSEL, Uncertainty(POSITION, NOTHING), loose, OFFSET, NOTHING, **std)
    assert placed.covariance == pytest.approx(POSITION + 0.09 * np.eye(3))


def draws(count, rng, *, levelled=False, angle_std=STD['angle_std'], covariance=None):
    """Places found from measurements with every error drawn, and their stated covariances."""
    along = OFFSET / np.linalg.norm(OFFSET)
    aside = np.cross(along, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    across = np.array([aside, np.cross(along, aside)])
    found, stated = [], []
    for _ in range(count):
        turn = Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), ATTITUDE)).as_matrix()
        position = VESSEL.position + rng.multivariate_normal(np.zeros(3), POSITION)
        mount = Mounting(MOUNT.lever, MOUNT.R, MOUNT.lever_std)
        if covariance is None:
            bent = Rotation.from_rotvec(angle_std * rng.normal(size=2) @ across).apply(OFFSET)
            offset = bent * (1.0 + 0.1 * rng.normal() / np.linalg.norm(OFFSET))
        else:
            offset = OFFSET + rng.multivariate_normal(np.zeros(3), covariance)
        # The lever is off too: what is measured lies beside where it is said to be.
        slip = VESSEL.R @ (MOUNT.lever_std * rng.normal(size=3))
        placed = place(
            Pose(position + slip, turn @ VESSEL.R), Uncertainty(POSITION, ATTITUDE), mount, offset,
            covariance, range_std=0.1, angle_std=angle_std, levelled=levelled,
        )  # fmt: skip
        found.append(placed.position)
        stated.append(placed.covariance)
    return np.array(found), np.array(stated)


@pytest.mark.statistics
@pytest.mark.parametrize('levelled', [False, True])
@pytest.mark.parametrize('covariance', [None, np.diag([4.0, 9.0, 1.0]) + 0.5])
def test_mean_and_covariance_are_those_of_the_draws(levelled, covariance):
    rng = np.random.default_rng(1)
    count = 6000
    found, stated = draws(count, rng, levelled=levelled, covariance=covariance)
    error = found - truth(levelled)
    spread = np.cov(error.T)
    assert (np.abs(error.mean(axis=0)) < 4.0 * np.sqrt(np.diag(spread) / count)).all()
    C = claimed(levelled, covariance)
    scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
    assert np.abs((spread - C) / scale).max() < 0.08
    nees = np.einsum('ki,kij,kj->k', error, np.linalg.inv(stated), error)
    # What is stated turns with what was measured, which costs a tenth.
    assert 2.8 < nees.mean() < 3.4


@pytest.mark.statistics
def test_along_the_line_of_sight_the_bend_counts():
    """To first order alone a sonar good to .1 m in range would claim it of the place."""
    found, _ = draws(4000, np.random.default_rng(2))
    arm = truth() - VESSEL.position
    along = arm / np.linalg.norm(arm)
    std = np.sqrt(along @ (claimed() - POSITION) @ along)
    assert std > 0.3
    spread = np.cov((found - truth()).T) - POSITION
    assert np.sqrt(along @ spread @ along) == pytest.approx(std, rel=0.15)


def test_jacobian_of_the_attitude():
    """The covariance to first order against differences of the place."""
    tiny = np.diag([1e-12, 4e-12, 9e-12])
    exact = {'range_std': 1e-9, 'angle_std': 1e-9}
    C = place(VESSEL, Uncertainty(NOTHING, tiny), MOUNT, OFFSET, NOTHING, **exact).covariance
    C = C - MOUNT.lever_std**2 * np.eye(3)
    columns = []
    for axis in np.eye(3):
        step = 1e-6 * axis
        turned = [
            VESSEL.position
            + Rotation.from_rotvec(sign * step).as_matrix() @ (truth() - VESSEL.position)
            for sign in (1.0, -1.0)
        ]
        columns.append((turned[0] - turned[1]) / 2e-6)
    J = np.array(columns).T
    assert C == pytest.approx(J @ tiny @ J.T, rel=1e-4, abs=1e-13)


def test_a_target_at_the_transceiver_has_a_covariance():
    known = VESSEL, Uncertainty(NOTHING, NOTHING), MOUNT, np.zeros(3), None
    placed = place(*known, range_std=0.5, angle_std=0.1)
    assert placed.covariance == pytest.approx((0.25 + 0.0025) * np.eye(3))
