# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters that several trackers share: declared once, changeable alike, each effective."""

import attrs
from attrs import evolve, frozen
import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import Altitude, Detections, Navigation, Trace
from sonar_imm.node_config import ObstacleNodeConfig
from sonar_imm.parameters import Config, ConfigError, inherited, live, parameter
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm.trackers.model_checks import chain_problems, matrix_problems
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm.trackers.shared_parameters import (
    DetectionParameters,
    StampParameters,
    StreamParameters,
    TrackLifeParameters,
)

SHARED = (DetectionParameters, TrackLifeParameters, StampParameters, StreamParameters)
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


def test_an_inherited_parameter_keeps_its_place_and_what_was_not_changed():
    specs = {spec.name: spec for spec in Both.specs()}
    assert list(specs) == ['own', 'first', 'second', 'third']
    assert specs['first'].default == 0.5 and specs['first'].high == 9.0
    assert specs['first'].low == 0.0 and not specs['first'].read_only
    assert Both().as_dict() == {'own': 'x', 'first': 0.5, 'second': 2, 'third': True}
    assert Both(first=1).first == 1.0 and isinstance(Both(first=1).first, float)
    assert Left().first == 1.0


def test_the_rules_of_all_bases_hold():
    with pytest.raises(ConfigError) as caught:
        Both(first=3.0, third=False)
    assert set(caught.value.problems) == {'first is the largest', 'third is false'}
    with pytest.raises(ConfigError, match='between 0 and 9'):
        Both(first=9.5)


def test_only_what_a_base_has_can_be_inherited():
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


# A contract gives the name to a gap in the navigation there, in a tracker without late pings.
OTHER_MEANING = {'bathymetry': {'max_gap'}}


@pytest.mark.parametrize('system', SYSTEMS)
def test_shared_parameters_come_from_their_base(system):
    """A parameter of a shared name that a class declares by itself would escape the decision."""
    config_type = SYSTEMS[system].config_type()
    for base in SHARED:
        names = {field.name for field in attrs.fields(base) if not field.inherited}
        own = {field.name for field in attrs.fields(config_type)} - OTHER_MEANING.get(
            system, set()
        )
        if names & own:
            assert issubclass(config_type, base)


@pytest.mark.parametrize(
    'system, changed, fixed',
    [
        ('diver', {'gate_probability': 0.99}, {'directions': 8}),
        ('fathometer', {'existence_min': 0.7}, {'particles': 7}),
        ('obstacle', {'birth_rate': 1.0}, {'components': 5}),
    ],
)
def test_a_running_tracker_takes_over_what_may_change(system, changed, fixed):
    config = SYSTEMS[system].config_type()
    tracker = SYSTEMS[system].build(config())
    tracker.reconfigure(config(**changed))
    assert all(getattr(tracker.config, name) == value for name, value in changed.items())
    with pytest.raises(ValueError, match=next(iter(fixed))):
        tracker.reconfigure(config(**fixed))


def test_a_chain_is_checked_once_for_all():
    assert matrix_problems((), 3, 'three') == []
    assert matrix_problems((1.0, 0.0, 0.5, 0.5), 2, 'two') == []
    (few,) = matrix_problems((1.0,), 2, 'two', name='P')
    assert few == 'P needs 2 x 2 = 4 values for two, got 1'
    (wrong,) = matrix_problems((0.9, 0.2, 0.5, 0.5), 2, 'two', name='P')
    assert wrong == 'row 0 of P sums to 1.1, not 1'
    assert chain_problems((), (0.5, 0.6), 2, 'two') == ['initial_probabilities sum to 1.1, not 1']


def echoes_of(tracker, second, offset):
    """One ping; gives how the first track was hit: its NIS, NaN without a hit or track."""
    stamp = second * 10**9
    tracker.process(Altitude(stamp_ns=stamp, altitude=20.0))
    tracker.process(
        Navigation(stamp_ns=stamp, position=[0.0, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0])
    )
    ping = Detections(stamp_ns=stamp, range=[50.0 + offset], bearing=[0.0])
    nis = tracker.process(ping)[-1].extras['nis']
    return nis[0] if len(nis) else np.nan


def test_clutter_of_a_running_obstacle_tracker_follows_the_parameter():
    config = ObstacleConfig(clutter_density=0.001)
    near, far = ObstacleTracker(config), ObstacleTracker(config)
    for tracker in (near, far):
        for second in (1, 2, 3, 4):
            echoes_of(tracker, second, 0.0)
    far.reconfigure(evolve(config, clutter_density=1e4))
    assert np.isfinite(echoes_of(near, 5, 0.3))
    assert np.isnan(echoes_of(far, 5, 0.3))


def test_the_fathometer_believes_a_restarted_clock_after_so_many_records():
    depth = 0.05 * np.arange(200)
    amplitude = np.exp(-np.square((depth - 5.0) / 0.1)) + 0.01 * np.sin(31.0 * depth)

    def used(**values):
        tracker = FathometerTracker(
            FathometerConfig(particles=8, depth_step=0.05, min_separation=0.05, **values)
        )
        for second in (1, 1000, 1001, 1002, 1003):
            tracker.process(Trace(stamp_ns=second * 10**9, depth=depth, amplitude=amplitude))
        return tracker.counts['used'], tracker.counts['restarts']

    assert used() == (5, 0)
    assert used(max_gap=60.0) == (5, 1)
    assert used(max_gap=60.0, restart_after=10) == (1, 0)


ORIGIN_ENDS = (90.0, 360.0, 12000.0)


@pytest.mark.parametrize('kind', [SYSTEMS['diver'].config_type(), ObstacleNodeConfig])
def test_an_origin_is_three_numbers_on_earth(kind):
    """The ends of a range belong to it, and so does the equator; of nothing else zeros are one."""
    for stated in ((54.0, 0.0, 40.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)):
        assert kind(origin=stated).stated_origin() == Origin(*stated)
    assert kind().stated_origin() is None and kind(origin=(0, 0, 40)).stated_origin() is None
    with pytest.raises(ConfigError, match='three values, got 2'):
        kind(origin=(54.0, 10.0))
    for place, name in enumerate(('latitude', 'longitude', 'height')):
        for end in (ORIGIN_ENDS[place], -ORIGIN_ENDS[place]):
            origin = [1.0, 2.0, 3.0]
            origin[place] = end
            assert kind.from_mapping({'origin': origin}).origin == tuple(origin)
            origin[place] *= 1.001
            with pytest.raises(ConfigError, match=f'origin: {name} must be between') as caught:
                kind.from_mapping({'origin': origin})
            assert len(caught.value.problems) == 1
