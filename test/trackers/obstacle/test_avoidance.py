# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Closest approach and collision against exact answers, sampling and an independent tracker."""

from pathlib import Path

from helpers.obstacle_runs import EXACT
from helpers.obstacle_sea import column, ENCOUNTERS, tracked
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.measurements import Navigation
from sonar_imm.trackers.navigation import NavigationBuffer
from sonar_imm.trackers.obstacle import avoidance
from sonar_imm.trackers.obstacle.avoidance import Safety
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm_tools.simulation.obstacle.simulator import scenario, Swing

GOLDEN = Path(__file__).parents[2] / 'vectors' / 'obstacle_sea' / 'cpa_golden.npz'


@pytest.fixture(scope='module')
def golden():
    with np.load(GOLDEN) as file:
        return dict(file)


def test_closest_approach_is_exact(golden):
    for k in range(len(golden['dz'])):
        time, distance = avoidance.closest(*golden['r'][k], *golden['w'][k], golden['horizon'][k])
        assert time == pytest.approx(golden['cpa_time'][k], abs=1e-9)
        assert distance == pytest.approx(golden['cpa_distance'][k], abs=1e-9)


def test_collision_of_a_point_is_exact(golden):
    inside = [
        avoidance.collides(
            *golden['r'][k], golden['dz'][k], *golden['w'][k], golden['wz'][k],
            golden['radius'][k], golden['half_height'][k], golden['horizon'][k],
        )
        for k in range(len(golden['dz']))
    ]  # fmt: skip
    assert np.array_equal(inside, golden['inside'])


def safety_of(golden, k):
    V = golden['g_vehicle'][k]
    return Safety(
        np.array([V[0], V[1], V[2]]), float(golden['g_vehicle_std'][k]),
        float(golden['g_radius'][k]), float(golden['g_half_height'][k]),
        float(golden['g_horizon']), avoidance.draws(),
    )  # fmt: skip


def probability(g, C, safety):
    """That one component collides."""
    return avoidance.assess(g[None, None], C[None, None], np.ones((1, 1)), safety)[2][0]


@pytest.mark.parametrize('k', range(9))
def test_collision_of_a_gaussian(golden, k):
    stated = probability(golden['g_mean'][k], golden['g_cov'][k], safety_of(golden, k))
    assert stated == pytest.approx(golden['g_probability'][k], abs=0.02 if k == 7 else 0.01)


def test_the_closed_form_agrees_with_sampling():
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(40):
        g = np.array([rng.uniform(15.0, 80.0), rng.normal(0.0, 4.0), rng.normal(0.0, 2.5), 0, 0])
        g[3:] = rng.normal(0.0, 0.3, 2)
        A = rng.normal(size=(5, 5)) * np.array([0.1, 0.4, 0.5, 0.03, 0.03])[:, None]
        C = A @ A.T + np.diag([0.01, 0.05, 0.05, 1e-4, 1e-4])
        many = rng.normal(size=(20_000, 5))
        settings = np.array([1.5, 0.0, 0.0]), 0.05, 3.0, 2.0, 120.0
        L = np.linalg.cholesky(C + np.diag([0, 0, 0, 0.05**2, 0.05**2]))
        exact = avoidance.sampled(g[:, None], L[..., None], Safety(*settings, many))[0]
        stated = probability(g, C, Safety(*settings, avoidance.draws()))
        errors.append(stated - exact)
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert np.max(np.abs(errors)) < 0.04


def pose(seconds, position):
    return Navigation(
        stamp_ns=round(seconds * 1e9), position=position, orientation=[0.0, 0.0, 0.0, 1.0]
    )


def test_the_course_is_the_line_and_not_the_swing():
    buffer = NavigationBuffer()
    for t in np.arange(0.1, 20.0, 0.1):
        swing = 0.1 * np.sin(2.0 * np.pi * t / 5.0)
        buffer = buffer.added(pose(t, [1.2 * t, -0.9 * t + swing, -20.0 + 0.05 * t]))
    stamp = 20 * 10**9
    velocity = avoidance.course(buffer, stamp, 10.0)
    assert_allclose(velocity, [1.2, -0.9, 0.05], atol=0.03)
    assert np.isnan(avoidance.course(NavigationBuffer(), stamp, 10.0)).all()
    assert np.isnan(avoidance.course(buffer, 2 * stamp, 10.0)).all()


def test_the_course_is_as_sure_as_its_default_says():
    """The sway of the simulated vehicle, and of the study's, is what makes a course wrong."""
    setting = scenario('approach')
    across = []
    for seed in range(60):
        sway = Swing(setting.sway_rms, setting.sway_period, np.random.default_rng(seed))
        t = np.arange(0.0, 10.05, 0.1)
        across.append(np.polyfit(t, sway(t), 1)[0])
    assert np.sqrt(np.mean(np.square(across))) == pytest.approx(
        ObstacleConfig().course_std, rel=0.2
    )


def test_the_tracker_says_what_an_independent_one_does():
    """With its `course_std` and navigation without errors that last."""
    off = {'cpa_distance': [], 'cpa_time': [], 'collision_probability': []}
    for name, number in ENCOUNTERS:
        data, estimates = tracked(name, number, course_std=0.05, **EXACT)
        given = np.flatnonzero(np.isfinite(data['ref_collision']))
        for key, reference in zip(off, ('cpa_distance', 'cpa_time', 'collision')):
            off[key].extend(column(estimates, key, given) - data[f'ref_{reference}'][given])
    rms = {key: float(np.sqrt(np.mean(np.square(values)))) for key, values in off.items()}
    assert len(off['cpa_time']) == 15
    assert rms['cpa_distance'] < 0.4
    assert rms['cpa_time'] < 0.1
    assert rms['collision_probability'] < 0.02
    assert np.abs(off['collision_probability']).max() < 0.06


@pytest.mark.parametrize('seconds', [(), (5.0,), (4.5, 5.0), (5.0, 5.0 + 2e-9)])
def test_positions_of_less_than_a_second_are_no_course(seconds):
    buffer = NavigationBuffer()
    for k, second in enumerate(seconds):
        buffer = buffer.added(pose(second, [k, 0.0, 0.0]))
    assert np.isnan(avoidance.course(buffer, 6 * 10**9, 10.0)).all()


def test_a_second_of_positions_is_a_course():
    buffer = NavigationBuffer()
    for second in (4.0, 5.0):
        buffer = buffer.added(pose(second, [3.0 * second, -second, 0.5]))
    assert_allclose(avoidance.course(buffer, 5 * 10**9, 10.0), [3.0, -1.0, 0.0], atol=1e-9)
