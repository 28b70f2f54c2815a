# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Models that another package registers: found, checked, and right to 1e-9."""

import json
import os
import subprocess
import sys
import textwrap

from helpers.diver_runs import fix, run
from helpers.obstacle_runs import track_scene
from helpers.source import ROOT
import numpy as np
import pytest

from sonar_imm import IMM, position
from sonar_imm.parameters import ConfigError, MODELS, registered
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm.trackers.obstacle.config import ObstacleConfig

CODE = '''
    import math

    import numpy as np

    from sonar_imm import Model, Motion


    class Turns:
        """Straight on and turning, by numerical integration."""

        transition = np.full((3, 3), 0.075) + 0.775 * np.eye(3)

        def __init__(self, config):
            rate = np.radians(20.0)
            self.start = {'vx': (0.0, config.velocity_std), 'vy': (0.0, config.velocity_std)}
            self.models = [
                turn('straight', 0.0, 0.1), turn('left', rate, 0.3), turn('right', -rate, 0.3)
            ]


    def turn(name, rate, noise):
        A = np.zeros((4, 4))
        A[:2, 2:], A[2:, 2:] = np.eye(2), rate * np.array([[0.0, -1.0], [1.0, 0.0]])
        white = np.diag([0.0, 0.0, noise**2, noise**2])

        def motion(x, dt):
            from scipy.linalg import expm

            block = expm(dt * np.block([[-A, white], [np.zeros((4, 4)), A.T]]))  # Van Loan
            F = block[4:, 4:].T
            return Motion(F, F @ block[:4, 4:], np.zeros(4))

        return Model(name, ('px', 'py', 'vx', 'vy'), motion)


    class Headings:
        """heading_speed again: velocities are outputs; standing has no speed of its own."""

        def __init__(self, config):
            built_in = build(config)
            self.transition = built_in.chain.matrix
            self.start = {'speed': (config.speed_mean, config.speed_std)}
            self.models = []
            for j, name in enumerate(built_in.names):
                ux, uy = built_in.E[j, 2:, 2]
                outputs = {'vx': (0, 0, ux), 'vy': (0, 0, uy)}
                self.models.append(Model(name, ('px', 'py', 'speed'), swim(built_in, j), outputs))


    def build(config):
        from attrs import evolve
        from sonar_imm.trackers.diver.models import build_models

        plain = {'model_set': 'heading_speed', 'dimensions': 2, 'fix_bias_std': 0.0}
        return build_models(evolve(config, **plain))


    def swim(built_in, j):
        return lambda x, dt: Motion(*(part[j] for part in built_in.motion(dt)))


    class Mover:
        """The behaviour moving of the obstacle tracker again."""

        velocity, share = True, 0.18

        def __init__(self, config):
            self.std, self.noise = 0.5 * config.max_speed, config.speed_noise**2
            self.slow = (0.3 * config.max_speed) ** 2

        def step(self, dt):
            return 1.0, dt, dt / 2.0, self.noise * dt, self.slow


    class NoStart(Turns):
        def __init__(self, config):
            super().__init__(config)
            del self.start


    class Curved(Turns):
        def __init__(self, config):
            super().__init__(config)
            self.models[0] = Model(
                'curved', ('px', 'py', 'vx', 'vy'), lambda x, dt: Motion(np.eye(4) * x[2], *zeros)
            )


    zeros = np.zeros((4, 4)), np.zeros(4)


    class Narrow(Turns):
        transition = property(lambda self: np.eye(2), lambda self, value: None)


    def broken(config):
        raise RuntimeError('no licence')


    def nothing(config):
        return object()


    class Wild(Mover):
        def step(self, dt):
            return 1.0, math.nan, 0.0, 0.0
'''
NAMES = 'Turns Headings Mover NoStart Curved Narrow broken nothing Wild absent'


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Where a package with entry points is installed, as pip install --target leaves it."""
    folder = tmp_path_factory.mktemp('site')
    (folder / 'tiny_models.py').write_text(textwrap.dedent(CODE))
    about = folder / 'tiny_models-1.0.dist-info'
    about.mkdir()
    (about / 'METADATA').write_text('Metadata-Version: 2.1\nName: tiny-models\nVersion: 1.0\n')
    lines = [f'tiny_{name.lower()} = tiny_models:{name}' for name in NAMES.split()]
    lines.append('tiny_module = not_there:Model')
    (about / 'entry_points.txt').write_text('\n'.join(['[sonar_imm.models]', *lines, '']))
    return folder


@pytest.fixture
def installed(folder, monkeypatch):
    monkeypatch.syspath_prepend(str(folder))


def fixes():
    rng = np.random.default_rng(2)
    stamps = np.cumsum(rng.uniform(0.3, 1.5, 60))
    angle = 0.02 * stamps**1.3
    at = 20.0 * np.column_stack([np.cos(angle), np.sin(angle)]) + rng.normal(0.0, 0.5, (60, 2))
    return [fix(t, x, y, 0.25 * np.eye(2)) for t, (x, y) in zip(stamps, at)]


def test_a_set_gives_the_estimates_of_the_same_filter_alone(installed):
    config = DiverConfig(model_set='tiny_turns', adaptation='fixed', max_tracks=1)
    first, *others = fixes()
    made = run(DiverTracker(config), [first, *others])
    own = registered(MODELS, 'tiny_turns').load()(config)
    imm = IMM(
        own.models, own.transition, [*first.position[:2], 0.0, 0.0],
        np.diag([0.25, 0.25, *[config.velocity_std**2] * 2]), position(0.5),
        stamp=first.stamp_ns / 1e9,
    )  # fmt: skip
    for item, mine in zip(others, made[1:], strict=True):
        imm.step(item.position[:2], stamp=item.stamp_ns / 1e9)
        assert mine.state[0] == pytest.approx(imm.estimate.mean, rel=1e-9, abs=1e-9)
        assert mine.covariance[0] == pytest.approx(imm.estimate.covariance, rel=1e-9, abs=1e-9)
        assert mine.probabilities[0] == pytest.approx(imm.model_probabilities, abs=1e-9)


@pytest.mark.parametrize(
    'values', [{}, {'fix_bias_std': 0.5, 'association': 'jipda'}, {'dimensions': 3}]
)
def test_a_diver_model_written_again_gives_the_same_estimates(installed, values):
    ours, theirs = (
        run(DiverTracker(DiverConfig(model_set=name, **values)), fixes())
        for name in ('tiny_headings', 'heading_speed')
    )
    assert len(ours) == len(theirs) == 60
    for mine, reference in zip(ours, theirs):
        assert mine.state == pytest.approx(reference.state, rel=1e-9, abs=1e-9)
        assert mine.covariance == pytest.approx(reference.covariance, rel=1e-9, abs=1e-9)
        assert mine.probabilities == pytest.approx(reference.probabilities, abs=1e-9)


def test_a_behaviour_written_again_gives_the_same_estimates(installed):
    names = 'fixed', 'swaying', 'tiny_mover', 'seabed'
    _, ours = track_scene('movers', 1, behaviours=names)
    _, theirs = track_scene('movers', 1)
    assert list(ours) == list(theirs)
    moving = 0.0
    for stamp, reference in theirs.items():
        assert ours[stamp].state == pytest.approx(reference.state, rel=1e-9, abs=1e-9)
        for name in ('prob_fixed', 'vx', 'vy', 'vel_cov_x_x', 'collision_probability'):
            if name in reference.extras:
                assert ours[stamp].extras[name] == pytest.approx(reference.extras[name], abs=1e-9)
        found = ours[stamp].extras['prob_tiny_mover']
        assert found == pytest.approx(reference.extras['prob_moving'], abs=1e-9)
        moving = max([moving, *found])
    assert moving > 0.9


@pytest.mark.parametrize(
    'model_set, problem',
    [
        ('tiny_nostart', r'\(sonar_imm.models: tiny_models:NoStart\).* lacks start'),
        ('tiny_curved', 'a motion depends on the state'),
        ('tiny_narrow', 'transition needs a row for each of 3 models'),
        ('tiny_broken', 'RuntimeError: no licence'),
        ('tiny_absent', "AttributeError: module 'tiny_models' has no attribute 'absent'"),
        ('tiny_module', "ModuleNotFoundError: No module named 'not_there'"),
        ('tiny_nothing', 'object lacks models, transition, start'),
        ('tiny_nobody', 'a name that a package registers as sonar_imm.models, got .tiny_nobody'),
    ],
)
def test_what_cannot_be_used_is_one_sentence(installed, model_set, problem):
    with pytest.raises(ConfigError, match=problem) as caught:
        DiverConfig.from_mapping({'model_set': model_set})
    assert len(caught.value.problems) == 1 and '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'name, problem',
    [
        ('tiny_wild', 'a step has to be finite'),
        ('tiny_nothing', 'object lacks std, velocity, share, step'),
    ],
)
def test_behaviours_too(installed, name, problem):
    with pytest.raises(ConfigError, match=problem):
        ObstacleConfig.from_mapping({'behaviours': ['fixed', name]})


def test_two_packages_with_one_name(installed, tmp_path, monkeypatch):
    other = tmp_path / 'other-1.0.dist-info'
    other.mkdir()
    (other / 'METADATA').write_text('Metadata-Version: 2.1\nName: other\nVersion: 1.0\n')
    (other / 'entry_points.txt').write_text('[sonar_imm.models]\ntiny_turns = other:Turns\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match='by other:Turns and by tiny_models:Turns'):
        DiverConfig(model_set='tiny_turns')


def test_it_may_have_a_depth_and_the_parameters_of_chains(installed):
    config = DiverConfig(
        model_set='tiny_turns', dimensions=3, initial_probabilities=(0.8, 0.1, 0.1)
    )
    models = build_models(config)
    assert models.names == ('straight', 'left', 'right') and config.model_count() == 3
    assert models.outputs == ('px', 'py', 'pz', 'vx', 'vy', 'vz')
    with pytest.raises(ConfigError, match='3 x 3 = 9 values for model_set tiny_turns'):
        DiverConfig(model_set='tiny_turns', transition_matrix=(0.5, 0.5, 0.5, 0.5))


def test_the_command_tracks_with_it(folder, tmp_path):
    """In a process of its own, which finds the package on its path."""
    bag = str(ROOT / 'bags' / 'diver_table1')
    env = dict(os.environ, PYTHONPATH=os.pathsep.join([str(ROOT), str(folder)]))
    command = [sys.executable, '-m', 'sonar_imm_tools.cli', 'track', bag]
    out = tmp_path / 'own'

    def track(out, model_set):
        words = [*command, str(out), '--set', f'model_set={model_set}']
        return subprocess.run(words, env=env, capture_output=True, text=True)

    done = track(out, 'tiny_headings')
    assert done.returncode == 0, done.stderr
    assert json.loads((out / 'run.json').read_text())['parameters']['model_set'] == 'tiny_headings'
    (table,) = (np.genfromtxt(path, delimiter=',', names=True) for path in out.glob('*.csv'))
    assert np.isfinite(table['prob_hover']).all() and len(table['px']) > 50
    done = track(tmp_path / 'no', 'tiny_broken')
    assert done.returncode == 2 and 'no licence' in done.stderr and 'Traceback' not in done.stderr
