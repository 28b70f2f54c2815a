# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Models and behaviours that other packages register; parameters that several systems share."""

import json
import os
import subprocess
import sys
import textwrap

import attrs
from attrs import evolve, frozen
from helpers.diver_runs import fix, run
from helpers.obstacle_runs import track_scene
from helpers.source import ROOT
import numpy as np
import pytest

from sonar_imm import IMM, position
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import Altitude, Detections, Navigation, Trace
from sonar_imm.node_config import ObstacleNodeConfig
from sonar_imm.parameters import (
    Config,
    ConfigError,
    inherited,
    live,
    MODELS,
    parameter,
    registered,
)
from sonar_imm.trackers import shared_parameters as bases
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

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
            from attrs import evolve
            from sonar_imm.trackers.diver.models import build_models

            plain = {'model_set': 'heading_speed', 'dimensions': 2, 'fix_bias_std': 0.0}
            built_in = build_models(evolve(config, **plain))
            self.transition = built_in.chain.matrix
            self.start = {'speed': (config.speed_mean, config.speed_std)}
            self.models = []
            for j, name in enumerate(built_in.names):
                ux, uy = built_in.E[j, 2:, 2]
                outputs = {'vx': (0, 0, ux), 'vy': (0, 0, uy)}
                self.models.append(Model(name, ('px', 'py', 'speed'), swim(built_in, j), outputs))

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

    class Narrow(Turns):
        transition = np.eye(2)

    class Curved(Turns):
        def __init__(self, config):
            super().__init__(config)
            zeros = np.zeros((4, 4)), np.zeros(4)
            curved = lambda x, dt: Motion(np.eye(4) * x[2], *zeros)
            self.models[0] = Model('curved', ('px', 'py', 'vx', 'vy'), curved)

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
    lines = [f'tiny_{name.lower()} = tiny_models:{name}' for name in NAMES.split()]
    about(folder, 'tiny-models', *lines, 'tiny_module = not_there:Model')
    return folder


def about(folder, name, *entries):
    place = folder / f'{name.replace("-", "_")}-1.0.dist-info'
    place.mkdir()
    (place / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n')
    (place / 'entry_points.txt').write_text('\n'.join(['[sonar_imm.models]', *entries, '']))


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
    start = [*first.position[:2], 0.0, 0.0], np.diag([0.25] * 2 + [config.velocity_std**2] * 2)
    imm = IMM(own.models, own.transition, *start, position(0.5), stamp=first.stamp_ns / 1e9)
    for item, mine in zip(others, made[1:], strict=True):
        imm.step(item.position[:2], stamp=item.stamp_ns / 1e9)
        assert mine.state[0] == pytest.approx(imm.estimate.mean, rel=1e-9, abs=1e-9)
        assert mine.covariance[0] == pytest.approx(imm.estimate.covariance, rel=1e-9, abs=1e-9)
        assert mine.probabilities[0] == pytest.approx(imm.model_probabilities, abs=1e-9)


@pytest.mark.parametrize('values', [
    {}, {'fix_bias_std': 0.5, 'association': 'jipda'}, {'dimensions': 3},
])  # fmt: skip
def test_a_diver_model_written_again_gives_the_same_estimates(installed, values):
    ours, theirs = (
        run(DiverTracker(DiverConfig(model_set=name, **values)), fixes())
        for name in ('tiny_headings', 'heading_speed')
    )
    assert len(ours) == len(theirs) == 60
    for pair in zip(ours, theirs):
        for name in ('state', 'covariance', 'probabilities'):
            mine, due = (getattr(each, name) for each in pair)
            assert mine == pytest.approx(due, rel=1e-9, abs=1e-9)


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


@pytest.mark.parametrize('name, problem', [
    ('nostart', r'\(sonar_imm.models: tiny_models:NoStart\).* lacks start'),
    ('curved', 'a motion depends on the state'),
    ('narrow', 'transition needs a row for each of 3 models'),
    ('broken', 'RuntimeError: no licence'),
    ('absent', "AttributeError: module 'tiny_models' has no attribute 'absent'"),
    ('module', "ModuleNotFoundError: No module named 'not_there'"),
    ('nothing', 'object lacks models, transition, start'),
    ('nobody', 'a name that a package registers as sonar_imm.models, got .tiny_nobody'),
])  # fmt: skip
def test_what_cannot_be_used_is_one_sentence(installed, name, problem):
    with pytest.raises(ConfigError, match=problem) as caught:
        DiverConfig.from_mapping({'model_set': f'tiny_{name}'})
    assert len(caught.value.problems) == 1 and '\n' not in str(caught.value)


@pytest.mark.parametrize('name, problem', [
    ('wild', 'a step has to be finite'), ('nothing', 'object lacks std, velocity, share, step'),
])  # fmt: skip
def test_behaviours_too(installed, name, problem):
    with pytest.raises(ConfigError, match=problem):
        ObstacleConfig.from_mapping({'behaviours': ['fixed', f'tiny_{name}']})


def test_two_packages_with_one_name(installed, tmp_path, monkeypatch):
    about(tmp_path, 'other', 'tiny_turns = other:Turns')
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match='by other:Turns and by tiny_models:Turns'):
        DiverConfig(model_set='tiny_turns')


def test_it_may_have_a_depth_and_the_parameters_of_chains(installed):
    given = {'model_set': 'tiny_turns', 'dimensions': 3, 'initial_probabilities': (0.8, 0.1, 0.1)}
    config = DiverConfig(**given)
    models = build_models(config)
    assert models.names == ('straight', 'left', 'right') and config.model_count() == 3
    assert models.outputs == ('px', 'py', 'pz', 'vx', 'vy', 'vz')
    with pytest.raises(ConfigError, match='3 x 3 = 9 values for model_set tiny_turns'):
        DiverConfig(model_set='tiny_turns', transition_matrix=(0.5, 0.5, 0.5, 0.5))


def test_the_command_tracks_with_it(folder, tmp_path):
    env = dict(os.environ, PYTHONPATH=os.pathsep.join([str(ROOT), str(folder)]))
    command = [sys.executable, '-m', 'sonar_imm_tools.cli', 'track', f'{ROOT}/bags/diver_table1']
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


BASES = 'DetectionParameters', 'TrackLifeParameters', 'StampParameters', 'StreamParameters'
SHARED = [getattr(bases, name) for name in BASES]
# Sound shapes the lattice of the fathometer and the readers of the obstacle tracker, but arrival
# times meet it only when they are used.
APART = {'sound_speed'}


@frozen(kw_only=True, slots=False)
class Left(Config):
    first: float = live(1.0, '', 'first', range=(0.0, 5.0))
    second: int = parameter(2, '', 'second')

    def check(self):
        return [*super().check(), *(['first is the largest'] if self.first > self.second else [])]


@frozen(kw_only=True, slots=False)
class Right(Config):
    third: bool = parameter(True, '', 'third')

    def check(self):
        return [*super().check(), *([] if self.third else ['third is false'])]


@frozen(kw_only=True)
class Both(Left, Right):
    own: str = parameter('x', '', 'own')
    first: float = inherited(Left, 'first', 0.5, range=(0.0, 9.0))


def test_inherited_parameters_keep_their_place_and_what_was_not_changed_and_the_rules_of_all():
    specs = {spec.name: spec for spec in Both.specs()}
    assert list(specs) == ['own', 'first', 'second', 'third']
    assert specs['first'].default == 0.5 and specs['first'].high == 9.0
    assert specs['first'].low == 0.0 and not specs['first'].read_only
    assert Both().as_dict() == {'own': 'x', 'first': 0.5, 'second': 2, 'third': True}
    assert isinstance(Both(first=1).first, float) and Left().first == 1.0
    with pytest.raises(ConfigError) as caught:
        Both(first=3.0, third=False)
    assert set(caught.value.problems) == {'first is the largest', 'third is false'}
    with pytest.raises(ConfigError, match='between 0 and 9'):
        Both(first=9.5)
    with pytest.raises(KeyError):
        inherited(Left, 'third', False)


def test_a_parameter_may_change_in_all_systems_or_in_none():
    """Pings of the bathymetry tracker share no state: all may change there but the frames."""
    flags: dict[str, set[bool]] = {}
    for name, system in SYSTEMS.items():
        specs = system.config_type().specs()
        if name == 'bathymetry':
            fixed = {spec.name for spec in specs if spec.read_only}
            assert fixed == {'vehicle_frame', 'sonar_frame'}
            continue
        for spec in specs:
            flags.setdefault(spec.name, set()).add(spec.read_only)
    assert {name for name, flag in flags.items() if len(flag) > 1} == APART


@pytest.mark.parametrize('system', SYSTEMS)
def test_shared_parameters_come_from_their_base(system):
    """A parameter of a shared name that a class declares by itself would escape the decision."""
    config_type = SYSTEMS[system].config_type()
    # A contract gives the name to a gap in the navigation there, in a tracker without late pings.
    other_meaning = {'max_gap'} if system == 'bathymetry' else set()
    own = {field.name for field in attrs.fields(config_type)} - other_meaning
    for base in SHARED:
        names = {field.name for field in attrs.fields(base) if not field.inherited}
        assert not names & own or issubclass(config_type, base)


@pytest.mark.parametrize('system, changed, fixed', [
    ('diver', {'gate_probability': 0.99}, {'directions': 8}),
    ('fathometer', {'existence_min': 0.7}, {'particles': 7}),
    ('obstacle', {'birth_rate': 1.0}, {'components': 5}),
])  # fmt: skip
def test_a_running_tracker_takes_over_what_may_change(system, changed, fixed):
    config = SYSTEMS[system].config_type()
    tracker = SYSTEMS[system].build(config())
    tracker.reconfigure(config(**changed))
    assert all(getattr(tracker.config, name) == value for name, value in changed.items())
    with pytest.raises(ValueError, match=next(iter(fixed))):
        tracker.reconfigure(config(**fixed))


def echoes_of(tracker, second, offset):
    """One ping; gives how the first track was hit: its NIS, NaN without a hit or track."""
    stamp, place = {'stamp_ns': second * 10**9}, {'position': [0.0, 0.0, -20.0]}
    tracker.process(Altitude(altitude=20.0, **stamp))
    tracker.process(Navigation(orientation=[0.0, 0.0, 0.0, 1.0], **place, **stamp))
    ping = Detections(range=[50.0 + offset], bearing=[0.0], **stamp)
    return np.append(tracker.process(ping)[-1].extras['nis'], np.nan)[0]


def test_clutter_of_a_running_obstacle_tracker_follows_the_parameter():
    config = ObstacleConfig(clutter_density=0.001)
    for clutter, hit in ((0.001, True), (1e4, False)):
        tracker = ObstacleTracker(config)
        for second in (1, 2, 3, 4):
            echoes_of(tracker, second, 0.0)
        tracker.reconfigure(evolve(config, clutter_density=clutter))
        assert np.isfinite(echoes_of(tracker, 5, 0.3)) == hit


def test_the_fathometer_believes_a_restarted_clock_after_so_many_records():
    depth = 0.05 * np.arange(200)
    amplitude = np.exp(-np.square((depth - 5.0) / 0.1)) + 0.01 * np.sin(31.0 * depth)
    trace, fine = {'depth': depth, 'amplitude': amplitude}, {'depth_step': 0.05}

    def used(**values):
        config = FathometerConfig(particles=8, min_separation=0.05, **fine, **values)
        tracker = FathometerTracker(config)
        for second in (1, 1000, 1001, 1002, 1003):
            tracker.process(Trace(stamp_ns=second * 10**9, **trace))
        return tracker.counts['used'], tracker.counts['restarts']

    assert used() == (5, 0)
    assert used(max_gap=60.0) == (5, 1)
    assert used(max_gap=60.0, restart_after=10) == (1, 0)


@pytest.mark.parametrize('kind', [SYSTEMS['diver'].config_type(), ObstacleNodeConfig])
def test_an_origin_is_three_numbers_on_earth(kind):
    """The ends of a range belong to it, and so does the equator; of nothing else zeros are one."""
    for stated in ((54.0, 0.0, 40.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)):
        assert kind(origin=stated).stated_origin() == Origin(*stated)
    assert kind().stated_origin() is None and kind(origin=(0, 0, 40)).stated_origin() is None
    with pytest.raises(ConfigError, match='three values, got 2'):
        kind(origin=(54.0, 10.0))
    ends = {'latitude': 90.0, 'longitude': 360.0, 'height': 12000.0}
    for place, (name, most) in enumerate(ends.items()):
        for end in (most, -most):
            origin = [1.0, 2.0, 3.0]
            origin[place] = end
            assert kind.from_mapping({'origin': origin}).origin == tuple(origin)
            origin[place] *= 1.001
            with pytest.raises(ConfigError, match=f'origin: {name} must be between') as caught:
                kind.from_mapping({'origin': origin})
            assert len(caught.value.problems) == 1
