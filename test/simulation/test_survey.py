# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulated surveys: what is known without the formulas that they test."""

import json

from attrs import evolve
import numpy as np
import pytest

from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.export.points import read_points
from sonar_imm_tools.simulation.survey import budget, pings_of, scenario, simulate
from sonar_imm_tools.survey.line import line_of

EXACT = {
    'lines': 1, 'cross_lines': 0, 'length': 60.0, 'noise': 0.0, 'nav_errors': 0.0,
    'roll_bias_deg': 0.0, 'tide_std': 0.0, 'sound_speed_error': 0.0, 'outliers': 0.0,
    'fish': False, 'ghost': False, 'terrain': 'slope', 'slope': 0.1,
}  # fmt: skip


def off_the_floor(scene, line):
    return line.z - scene.floor.at(line.xy[:, 0], line.xy[:, 1])


def surveyed(**changes):
    """A survey without errors but for `changes`, and its first line."""
    scene = simulate(scenario('survey', {**EXACT, **changes}), 1)
    return scene, line_of(scene.points[0], budget())


def test_without_errors_soundings_lie_on_the_floor():
    scene, line = surveyed()
    assert np.abs(off_the_floor(scene, line)).max() < 1e-4
    assert line.speed == pytest.approx(2.0, abs=0.3)
    assert np.abs(line.port - [0.0, 1.0]).max() < 0.05  # it yaws by .8 deg
    for depth in (20.0, 40.0):  # hills of some of the depth
        _, line = surveyed(terrain='survey', slope=0.0, length=200.0, depth=depth)
        below = -line.z / depth
        assert 0.6 < below.min() < 0.9 and 1.1 < below.max() < 1.4  # 12 to 28 of 20 m


def test_lines_lie_side_by_side_and_cross_lines_evenly_along_them():
    scene, _ = surveyed(lines=3, spacing=20.0, cross_lines=2, terrain='flat')
    middle = [(points['x'].mean(), points['y'].mean()) for points in scene.points]
    lines = [(30.0, 0.0), (30.0, 20.0), (30.0, 40.0)]
    np.testing.assert_allclose(middle, [*lines, (20.0, 20.0), (40.0, 20.0)], atol=1.5)


def test_true_corrections_put_soundings_back_on_the_floor():
    """Each correction, its sign and both sides, against poses and rays that know no partials."""
    for name, value, left in (
        ('roll_bias_deg', 1.0, 0.02),
        ('pitch', 1.0, 0.012),
        ('heading', 2.0, 0.03),
        ('latency', 0.5, 0.02),
        ('tide_std', 0.5, 1e-4),
        ('sound_speed_error', 4.0, 0.12),
    ):
        scene, line = surveyed(**{name: value})
        true = scene.corrections[0]
        before, after, wrong = (
            np.abs(off_the_floor(scene, line.corrected(each))).max()
            for each in (np.zeros_like(true), true, -true)
        )
        assert after < left < before / 3.0 and wrong > 1.5 * before, (before, after, wrong)


def test_neighbours_of_a_swath_share_a_third_of_their_noise():
    noise = off_the_floor(*surveyed(terrain='flat', noise=0.1, length=200.0)).reshape(-1, 2, 40)
    assert noise.std() == pytest.approx(0.1, rel=0.05)
    for apart, share in ((1, 1 / 3), (2, 1 / 9), (5, 0.0)):
        product = noise[..., apart:] * noise[..., :-apart]
        assert product.mean() / noise.var() == pytest.approx(share, abs=0.06)


def test_the_same_seed_is_the_same_survey():
    config = scenario('survey', {'lines': 2, 'cross_lines': 1, 'length': 60.0})
    item, again, other = (simulate(config, seed) for seed in (3, 3, 4))
    z, same, another = ([p['z'].tobytes() for p in each.points] for each in (item, again, other))
    assert z == same and z[0] != another[0]
    assert item.fish[1].sum() > 50 and (item.bad[1] >= item.fish[1]).all()
    assert 0.005 < item.bad[0].mean() < 0.1


@pytest.mark.parametrize(
    'changes, off, spread',
    [
        ({}, 0.0, 0.02),
        ({'tide_std': 1.0}, None, 0.02),
        ({'roll_bias_deg': 1.0}, 0.0, 0.8),
        ({'sound_speed_error': 10.0}, -0.33, 0.5),
    ],
)
def test_pings_of_a_survey_are_tracked_to_its_floor_less_what_is_wrong(changes, off, spread):
    exact = {'nav_errors': 0.0, 'roll_bias_deg': 0.0, 'tide_std': 0.0, 'sound_speed_error': 0.0}
    small = {'lines': 1, 'cross_lines': 0, 'length': 12.0, 'terrain': 'slope'}
    true, lines = pings_of(scenario('survey', {**small, **exact, **changes}), 3)
    ((name, scene, told),) = lines
    assert name == 'line_000' and len(scene.truth) == 12
    config = BathymetryConfig.from_mapping(told).for_inputs(frozenset({'nav', 'snapshot'}))
    tracker, error = BathymetryTracker(config), []
    for item in scene.measurements:
        each = item.measurement
        for made in tracker.process(evolve(each, side=item.namespace) if item.namespace else each):
            x, y, z = (made.extras[f'p{axis}'][made.extras['valid'] > 0] for axis in 'xyz')
            error.append(z - true.floor.at(x, y))
    errors = np.concatenate(error)
    expected = -true.corrections[0, 3] if off is None else off
    assert errors.mean() == pytest.approx(expected, abs=0.08)
    assert 0.5 * spread < errors.std() < spread


def test_the_command_writes_lines_and_truth(tmp_path, capsys):
    out, bags = tmp_path / 'survey', tmp_path / 'bags'
    small = '--set lines=2 --set cross_lines=0 --set length=40'.split()
    assert main(['simulate', 'survey', str(out), '--soundings', *small]) == 0
    assert sorted(path.name for path in out.iterdir()) == ['line_000', 'line_001', 'truth.npz']
    scene = simulate(scenario('survey', {'lines': 2, 'cross_lines': 0, 'length': 40.0}), 0)
    read = read_points(out / 'line_001' / 'soundings.csv')
    assert read['x'].tolist() == scene.points[1]['x'].tolist()
    truth = np.load(out / 'truth.npz')
    assert truth['corrections'].tolist() == scene.corrections.tolist()
    assert len(truth['bad']) == sum(map(len, scene.points))
    x0, y0, nx, ny = truth['ext']
    assert truth['truth_z'].shape == (nx, ny)
    there = scene.floor.at(np.array([x0 + 5.5]), np.array([y0 + 7.5]))
    assert truth['truth_z'][5, 7] == pytest.approx(there[0], abs=1e-4)
    capsys.readouterr()
    for arguments, words in (
        (['survey', str(out), '--soundings'], 'is there already'),
        (['survey', str(bags), '--soundings', '--set', 'lines=0'], 'lines'),
        (['diver', str(bags), '--soundings'], '--soundings'),
    ):
        assert main(['simulate', *arguments]) == 2
        error = capsys.readouterr().err
        assert words in error and 'Traceback' not in error and not bags.exists()
    shorter = '--set lines=1 --set cross_lines=0 --set length=10 --json'.split()
    assert main(['simulate', 'survey', str(bags), *shorter]) == 0
    assert json.loads(capsys.readouterr().out)['messages'] > 100
    assert main(['track', str(bags / 'line_000.bag'), str(tmp_path / 'run')]) == 0
    assert set(read_points(tmp_path / 'run' / 'soundings.csv')['side']) == {0, 1}
    with np.load(bags / 'truth.npz') as known:
        assert known['names'].tolist() == ['line_000'] and not len(known['bad'])
