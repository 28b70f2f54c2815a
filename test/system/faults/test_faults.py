# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every fault of the table, done to a real node: in the short form to one node each, in turn.

Queues, services, clocks and the log are those of the node as it is started: of a process.
"""

import re

from helpers.commands import children
from helpers.faults.cases import CASES
from helpers.faults.figures import FOLDER, long_form
from helpers.faults.rig import LEVELS, Rig
from helpers.faults.table import FAULTS
import pytest

pytestmark = pytest.mark.system


def pairs():
    """Faults and systems to try. Those of one node together, for of several processes that share
    the tests one starts it then; on a page of figures in the order of the table."""
    found = [*tried()]
    return found if FOLDER else sorted(found, key=lambda pair: (pair[1], pair[0].arguments))


IN_PROCESS = {
    '~/reset', 'input disabled, then enabled', '/clock and stamps an hour back',
    'a publisher that cannot be heard (QoS)', 'the state cannot be saved (read-only disk)',
}  # fmt: skip
"""What `nodes/test_base.py` and `nodes/test_saved_state.py` do to a node in their own process;
only the long form does it to another one as well."""


def tried():
    for turn, fault in enumerate(FAULTS):
        if long_form():
            yield from ((fault, system) for system in fault.systems)
        elif fault.name not in IN_PROCESS:
            yield fault, fault.systems[turn % len(fault.systems)]


@pytest.fixture(scope='module')
def rigs():
    """Nodes that all faults share, by system and arguments, and what each makes of the input
    undisturbed."""
    running = {}
    yield running
    for rig, _ in running.values():
        begun = children(rig.node.process.pid)
        code, log = rig.node.stop(), rig.node.log()
        rig.__exit__()
        assert code == 0 and 'Traceback' not in log and not begun


@pytest.mark.parametrize('fault, system', pairs(), ids=lambda item: getattr(item, 'name', item))
def test_a_fault_is_survived_counted_and_said(fault, system, rigs, figures):
    figures.skip_if_measured(fault=fault.name, system=system)
    key = system, *fault.arguments
    if key not in rigs:
        fresh = Rig(CASES[system], fault.arguments)
        rigs[key] = fresh, fresh.undisturbed()
    rig, expected = rigs[key]
    outcome = rig.suffer(fault.disturb, expected)
    limit = CASES[system].settle if fault.settle is None else fault.settle
    figures.add(
        {'fault': fault.name, 'system': system}, recovered=outcome.recovered, limit=limit,
        estimates=outcome.estimates, losses=outcome.losses,
        worst=LEVELS[max(map(LEVELS.index, outcome.levels))],
        traceback='Traceback' in outcome.words,
    )  # fmt: skip
    assert 'Traceback' not in outcome.words
    assert outcome.answered
    assert outcome.recovered is not None and outcome.recovered <= limit, outcome
    found = [key for key in outcome.losses for item in fault.counted if re.search(item, key)]
    assert bool(found) == bool(fault.counted), outcome.losses
    assert max(map(LEVELS.index, outcome.levels)) >= LEVELS.index(fault.level), outcome
    assert re.search(fault.says, outcome.words), outcome.words
