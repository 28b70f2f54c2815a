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

"""The cases of `benchmarks.cold_start` can be run; their times are for a quiet machine."""

import pytest

from benchmarks.cold_start import CASES
from sonar_imm import measurements
from sonar_imm.trackers import SYSTEMS


@pytest.mark.parametrize('name', CASES)
def test_every_case_has_steps(name):
    case = CASES[name]
    system = SYSTEMS[case.system]
    tracker = system.build(system.config_type()(**case.parameters))
    inputs = {getattr(measurements, each) for each in case.inputs}
    steps = {step for step, _ in tracker.warm_steps(inputs or None)}
    assert steps and set(case.steps) <= steps


def test_every_system_has_a_case_with_everything():
    compiled = {name for name, system in SYSTEMS.items() if system.kernels}
    assert {case.system for case in CASES.values() if not case.inputs} == compiled
