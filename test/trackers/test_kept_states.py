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

"""States of trackers with every option, on shipped recordings and on every simulated scene, are
written and taken again: tables, types and shapes of `state_values` have all that states hold."""

import contextlib
from importlib import import_module
from pathlib import Path

import attrs
import pytest

from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.state_file import (
    frozen_state,
    json_parameters,
    read_state,
    restore,
    Saved,
    tracker_from,
    write_state,
)
from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader

BAGS = Path(__file__).resolve().parents[2] / 'bags'
QUICK = {'fathometer': {'particles': '200'}}
MOST = 60
SCENES = [
    (system, scene)
    for system in SYSTEMS
    for scene in import_module(f'sonar_imm_tools.simulation.{system}').SCENARIOS
]


def values_of(spec):
    """Texts of `--set` that use what a parameter can switch on."""
    if spec.choices:
        return spec.choices
    if spec.kind == 'bool':
        return ('true', 'false')
    if spec.kind in ('int', 'float') and spec.default == 0:
        return (str(2 if spec.high is None else min(spec.high, 2)),)
    return ()


OPTIONS = [
    (system.name, spec.name, value)
    for system in SYSTEMS.values()
    for spec in system.config_type().specs()
    for value in values_of(spec)
]
BAG = {
    'bathymetry': 'bathymetry_ship',
    'diver': 'diver_multistatic',
    'fathometer': 'fathometer_pressure',
    'obstacle': 'obstacle_wreck',
}


def take_again(system, bag, own, overrides, path):
    """Save the state of intake and tracker again and again, and load what was saved."""
    system = SYSTEMS[system]
    overrides = QUICK.get(system.name, {}) | overrides
    config = load_config(system, own, overrides)[0]
    intake = Intake(system.build(config))
    with BagReader(bag) as reader:
        read = measurements_of(reader, system.name, settings=config.as_dict())
        found = [item.measurement for item in read]
    found = [m for m in found if m is not None and not isinstance(m, Rejection)][:MOST]
    for k, measurement in enumerate(found):
        try:
            admitted = intake.admit(measurement)
        except Rejection:
            continue
        if admitted is not None:
            intake.tracker.process(admitted)
        if k % 12 and k < len(found) - 1:
            continue
        saved = Saved(
            system=system.name,
            parameters=json_parameters(config),
            saved_ns=1,
            newest_ns=None,
            state=frozen_state(intake.tracker),
            extras={'intake': frozen_state(intake)},
        )
        write_state(path, saved)
        once = load(path, system, config)
        size = write_state(path, attrs.evolve(saved, **once))
        assert write_state(path, attrs.evolve(saved, **load(path, system, config))) == size


def load(path, system, config):
    """Load a state, and give the state of what was made of it."""
    saved = read_state(path)
    intake = Intake(tracker_from(saved, system, config))
    restore(intake, saved.extras['intake'])
    return {'state': frozen_state(intake.tracker), 'extras': {'intake': frozen_state(intake)}}


@pytest.mark.parametrize('bag', sorted(path.name for path in BAGS.iterdir()))
@pytest.mark.parametrize('own', [True, False])
def test_states_on_every_shipped_recording(bag, own, tmp_path):
    parameters = own_parameters(BAGS / bag) if own else None
    take_again(bag.split('_')[0], BAGS / bag, parameters, {}, tmp_path / 'state')


@pytest.mark.statistics
@pytest.mark.parametrize('system, name, value', OPTIONS)
def test_states_with_every_option(system, name, value, tmp_path):
    bag = BAGS / BAG[system]
    with contextlib.suppress(ConfigError):  # some need others beside them
        take_again(system, bag, own_parameters(bag), {name: value}, tmp_path / 'state')


@pytest.mark.statistics
@pytest.mark.parametrize('system, scene', SCENES)
def test_states_on_every_scene(system, scene, tmp_path, capsys):
    assert main(['simulate', system, str(tmp_path / 'bag'), '--scenario', scene]) == 0
    own = own_parameters(tmp_path / 'bag')
    take_again(system, tmp_path / 'bag', own, {}, tmp_path / 'state')
