# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""States of trackers with every option, on shipped recordings and on every simulated scene, are
written and taken again: annotations and tables of classes have all that states hold."""

import contextlib
from importlib import import_module
from pathlib import Path

from helpers.tracked import saved
import pytest

from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.state_file import intake_from, read_state, write_state
from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader

BAGS = Path(__file__).resolve().parents[2] / 'bags'
QUICK = {'fathometer': {'particles': '200'}}
SHORT = {'fathometer': ['--set', 'records=8']}
MOST = 48
BAG = {
    'bathymetry': 'bathymetry_ship',
    'diver': 'diver_multistatic',
    'fathometer': 'fathometer_pressure',
    'obstacle': 'obstacle_wreck',
}


def values_of(spec):
    """Texts of `--set` that use what a parameter can switch on."""
    if spec.choices:
        return spec.choices
    if spec.kind == 'bool':
        return ('true', 'false')
    if spec.kind in ('int', 'float') and spec.default == 0:
        return (str(2 if spec.high is None else min(spec.high, 2)),)
    return ()


def take_again(name, bag, own, overrides, path):
    """Save the state of intake and tracker again and again, and load it: the same bytes."""
    system = SYSTEMS[name]
    config = load_config(system, own, QUICK.get(name, {}) | overrides)[0]
    intake = Intake(system.build(config))
    with BagReader(bag) as reader:
        read = measurements_of(reader, name, settings=config.as_dict())
        found = [item.measurement for item in read]
    found = [m for m in found if m is not None and not isinstance(m, Rejection)][:MOST]
    for k, measurement in enumerate(found):
        with contextlib.suppress(Rejection):
            admitted = intake.admit(measurement)
            if admitted is not None:
                intake.tracker.process(admitted)
        if k % 16 == 0 or k == len(found) - 1:
            write_state(path, saved(intake, system))
            first = path.read_bytes()
            again = intake_from(read_state(path), system, config)
            write_state(path, saved(again, system))
            assert path.read_bytes() == first, (bag.name, overrides, k)


@pytest.mark.parametrize('name', SYSTEMS)
def test_states_on_every_shipped_recording(name, tmp_path):
    bags = sorted(BAGS.glob(f'{name}_*'))
    for bag, own in [*((bag, own_parameters(bag)) for bag in bags), (bags[0], None)]:
        take_again(name, bag, own, {}, tmp_path / 'state')


@pytest.mark.statistics
@pytest.mark.parametrize('name', SYSTEMS)
def test_states_with_every_option(name, tmp_path):
    bag = BAGS / BAG[name]
    for spec in SYSTEMS[name].config_type().specs():
        for value in values_of(spec):
            with contextlib.suppress(ConfigError):  # some need others beside them
                take_again(name, bag, own_parameters(bag), {spec.name: value}, tmp_path / 'state')


@pytest.mark.statistics
@pytest.mark.parametrize('name', SYSTEMS)
def test_states_on_every_scene(name, tmp_path, capsys):
    for scene in import_module(f'sonar_imm_tools.simulation.{name}').SCENARIOS:
        bag = tmp_path / scene
        words = ['simulate', name, str(bag), '--scenario', scene, *SHORT.get(name, [])]
        assert main(words) == 0
        take_again(name, bag, own_parameters(bag), {}, tmp_path / 'state')
