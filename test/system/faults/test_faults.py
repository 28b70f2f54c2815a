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

"""Every fault of the table, done to a real node."""

import re

import pytest

from helpers.faults.cases import CASES
from helpers.faults.rig import LEVELS, Rig
from helpers.faults.table import FAULTS

pytestmark = pytest.mark.system

PAIRS = [(fault, name) for fault in FAULTS for name in fault.systems]


@pytest.fixture(scope='module')
def rigs():
    """A node of each system that all faults share, and what it makes of the input by itself."""
    running = {}
    yield running
    for rig, _ in running.values():
        log, code = rig.node.log(), rig.node.stop()
        rig.__exit__()
        assert code == 0 and 'Traceback' not in log


@pytest.fixture
def rig(request, rigs):
    """The node for a fault: one of its own where it needs other arguments."""

    def give(system, arguments=()):
        if arguments:
            alone = Rig(CASES[system], arguments)
            request.addfinalizer(alone.__exit__)
            return alone, alone.undisturbed()
        if system not in rigs:
            fresh = Rig(CASES[system])
            rigs[system] = fresh, fresh.undisturbed()
        return rigs[system]

    return give


@pytest.mark.parametrize('fault, system', PAIRS, ids=lambda one: getattr(one, 'name', one))
def test_a_fault_is_survived_counted_and_said(fault, system, rig):
    node, expected = rig(system, fault.arguments)
    outcome = node.suffer(fault.disturb(CASES[system]), expected)
    print(fault.name, system, outcome.recovered, outcome.estimates, outcome.losses, sorted(outcome.levels), round(outcome.seconds,1))
    assert 'Traceback' not in node.node.log()
    assert not outcome.unanswered
    limit = CASES[system].settle if fault.settle is None else fault.settle
    assert outcome.recovered is not None and outcome.recovered <= limit, outcome
    found = [key for key in outcome.losses for one in fault.counted if re.search(one, key)]
    assert bool(found) == bool(fault.counted), outcome.losses
    assert max(map(LEVELS.index, outcome.levels)) >= LEVELS.index(fault.level), outcome.levels
    assert re.search(fault.says, outcome.words), outcome.words
