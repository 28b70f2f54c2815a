# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What every simulator promises, checked alike for the scenes of all systems."""

import importlib
import pickle

from helpers.scenes import small_scene, smaller_scene
import numpy as np
import pytest

from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS


@pytest.fixture(params=SYSTEMS)
def system(request):
    return SYSTEMS[request.param]


@pytest.fixture
def scenes(system):
    return importlib.import_module(system.scenes)


@pytest.mark.parametrize(
    ('system', 'name'),
    [
        (system, name)
        for system in SYSTEMS
        for name in importlib.import_module(SYSTEMS[system].scenes).SCENARIOS
    ],
)
def test_a_seed_decides_on_every_byte(system, name):
    """Of every scenario, and when each measurement is received."""
    first, again, other = (
        [
            (item.received_ns, pickle.dumps(item.measurement))
            for item in smaller_scene(SYSTEMS[system], name, seed)[1].measurements
        ]
        for seed in (3, 3, 4)
    )
    assert first == again != other
    received = [time for time, _ in first]
    assert received == sorted(received)


def test_a_scene_is_in_order_has_truth_that_draws_and_tells_of_its_instruments(system):
    np.random.seed(1)  # the state of the process, which nobody may touch
    before = np.random.get_state()[1].tobytes()
    config, scene = small_scene(system, 3)
    assert np.random.get_state()[1].tobytes() == before
    times = [item.received_ns for item in scene.measurements]
    assert times == sorted(times) and len(times) > 1
    assert all(item.received_ns >= item.measurement.stamp_ns for item in scene.measurements)
    tables = [table for truth in scene.truth for table in truth.tables(scene.frame_id)]
    assert tables
    for table in tables:
        assert list(table.columns)[:3] == ['x', 'y', 'z'] and table.frame_id
        assert {len(column) for column in table.columns.values()} == {len(table.columns['x'])}
        assert all(table.columns[name].dtype == np.float32 for name in 'xyz')
    tracker = system.build(system.config_type()(**config.instruments()))
    for item in scene.measurements:
        tracker.process(item.measurement)
    assert tracker.counts['used'] > 0 and not tracker.counts['unknown_type']


def test_every_scenario_has_a_description_and_can_be_configured(scenes):
    for name, (description, _) in scenes.SCENARIOS.items():
        assert len(description.split()) > 2
        assert scenes.scenario(name, {}) == scenes.scenario(name, None)
    shares = [spec for spec in scenes.scenario(name, {}).specs() if 'probability' in spec.name]
    assert all((spec.low, spec.high) == (0.0, 1.0) for spec in shares)


def test_a_name_that_nobody_knows_is_answered_with_those_that_exist(scenes):
    known = next(iter(scenes.SCENARIOS))
    with pytest.raises(ConfigError, match=f"unknown scenario '{known}x'.*did you mean.*{known}"):
        scenes.scenario(known + 'x', {})
    with pytest.raises(ConfigError, match='no_such_parameter'):
        scenes.scenario(known, {'no_such_parameter': 1})
