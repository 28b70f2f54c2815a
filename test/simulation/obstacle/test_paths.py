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

"""Obstacles that sway and move."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.parameters import ConfigError
from sonar_imm_tools.simulation.obstacle.simulator import DOES, scenario, simulate


@pytest.mark.statistics
def test_a_swaying_obstacle_stays_about_its_place():
    moved = []
    for seed in range(40):
        scene = simulate(scenario('swaying', {'last_range': -60.0}), seed)
        place = simulate(scenario('approach', {'last_range': -60.0}), seed).truth[0].position
        truth = scene.truth[0]
        moved.append((truth.position - place)[:, :2])
        assert_allclose(truth.position[:, 2], place[:, 2])
        assert_allclose(truth.velocity, 0.0)
    moved = np.array(moved)
    assert moved.std() == pytest.approx(0.5, rel=0.1)
    lag = 20  # 10 s of a memory of 20 s
    together = np.mean(moved[:, lag:] * moved[:, :-lag]) / np.mean(moved**2)
    assert together == pytest.approx(np.exp(-0.5), abs=0.12)


def test_a_mover_moves_as_its_velocity_says_and_is_seen():
    seen, ways = [], []
    for seed in range(12):
        truth = simulate(scenario('mover'), seed).truth[0]
        dt = np.diff(truth.stamp_ns) * 1e-9
        step = np.diff(truth.position, axis=0)[:, :2] / dt[:, None]
        assert_allclose(step, truth.velocity[1:], atol=1e-5)
        assert 0.3 <= np.linalg.norm(truth.velocity[0]) <= 1.5
        seen.append(truth.in_beam.mean())
        ways.append(truth.velocity[0] / np.linalg.norm(truth.velocity[0]))
    assert np.mean(seen) > 0.5
    assert (np.ptp(ways, axis=0) > 1.0).all()  # they go any way


@pytest.mark.statistics
def test_a_swinging_obstacle_goes_in_smooth_waves():
    moved = []
    for seed in range(20):
        scene = simulate(scenario('swaying', {'obstacle_motion': 'swinging'}), seed)
        place = simulate(scenario('approach'), seed).truth[0].position
        moved.append((scene.truth[0].position - place)[:, :2])
    moved = np.array(moved)
    assert moved.std() == pytest.approx(0.5, rel=0.1)
    # A swing of 15 s has a turning point every 7.5 s; a random sway has one at every other ping.
    turns = np.mean(np.diff(np.sign(np.diff(moved, axis=1)), axis=1) != 0)
    assert turns == pytest.approx(0.5 / 7.5, rel=0.2)


@pytest.mark.parametrize(
    'changes, moving',
    [({'obstacle_starts': 20.0}, (False, True)), ({'obstacle_stops': 20.0}, (True, False))],
)
def test_a_mover_starts_and_stops(changes, moving):
    truth = simulate(scenario('mover', changes), 3).truth[0]
    t = (truth.stamp_ns - truth.stamp_ns[0]) * 1e-9
    step = np.linalg.norm(np.diff(truth.position, axis=0)[:, :2], axis=1) > 1e-6
    assert np.array_equal(step, np.where(t[1:] <= 20.0, *moving))
    assert np.array_equal(truth.does == DOES.index('moving'), np.where(t < 20.0, *moving))
    table = list(truth.tables('odom'))[-1]
    assert [table.columns[f'prob_{name}'][0] for name in ('fixed', 'moving')] == [
        float(not moving[1]), float(moving[1])
    ]  # fmt: skip


def test_truth_tables_say_the_velocity():
    truth = simulate(scenario('mover'), 1).truth[0]
    table = next(iter(truth.tables('odom')))
    assert_allclose([table.columns['vx'][0], table.columns['vy'][0]], truth.velocity[0])


def test_speeds_in_the_wrong_order_are_refused():
    with pytest.raises(ConfigError, match='obstacle_speed'):
        scenario('mover', {'obstacle_speed': [2.0, 1.0]})
