# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A real node that is killed in the middle of its work goes on where it was saved last.

Only a process can be killed while it writes. That what was saved is all of a tracker is said of
every recording by `trackers/test_state.py`, so the short form has one system.
"""

import itertools
import time

from helpers.estimates import same
from helpers.faults.cases import CASES
from helpers.faults.figures import count, long_form
from helpers.faults.rig import Rig, without_shared_memory
import numpy as np
import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.state_file import read_state, StateError
from sonar_imm_tools.offline.tracking import final_estimates

pytestmark = pytest.mark.system

FORGETFUL = ('bathymetry',)
"""No ping needs the one before it: there a state holds what was counted, and no more."""
AGAIN = 0.25
"""Share of the messages that is sent again; the state has to be younger than that."""
TURNS = count(1, 2)
CLOSEST = 10.0
"""Seconds between messages at most: what comes more than five minutes late is taken for a clock
that was set back."""


def messages_of(case):
    """Its messages, those of a slow sensor closer together."""
    sooner = max(0.0, case.period - CLOSEST)
    primary = itertools.accumulate(message.primary for message in case.messages())
    return [message.moved(-k * sooner) for k, message in zip(primary, case.messages())]


def final(system, estimates):
    """The last word on each stamp."""
    given = final_estimates(estimates, SYSTEMS[system].config_type()())
    return {item.stamp_ns: item for item in given}


def saved_after(path, stamp_ns):
    """Whether there is a state of measurements from `stamp_ns` on."""
    try:
        newest = read_state(path).newest_ns
    except (FileNotFoundError, StateError):
        return False
    return newest is not None and newest >= stamp_ns


def killed(case, arguments, path, messages, at_once, rng):
    """The life of a node that gets `messages` one by one and those `at_once` that nobody waits
    for, and is killed at a random moment of these; gives its estimates."""
    with Rig(case, arguments, discovery=without_shared_memory) as rig:
        estimates = rig.play(messages)
        stamp_ns = messages[-round(AGAIN * len(case.messages()))].stamp_ns
        assert rig.wait_for(lambda: saved_after(path, stamp_ns))
        for item in at_once:
            rig.publishers[item.topic].publish(item.content)
        time.sleep(0.1 * rng.random())
        rig.node.process.kill()
        assert rig.node.process.wait(120.0) == -9
    return estimates


@pytest.mark.parametrize('system', CASES if long_form() else ['diver'])
def test_a_node_that_is_killed_goes_on_with_ids_and_covariances(system, tmp_path, figures):
    figures.skip_if_measured(TURNS, system=system)
    case, rng = CASES[system], np.random.default_rng(4)
    messages = messages_of(case)
    again = round(AGAIN * len(messages))
    given, equal, forgotten, wrong = 0, 0, 0, []
    with Rig(case) as undisturbed:
        whole = final(system, undisturbed.play(messages))
        for turn in range(TURNS):
            path = tmp_path / f'state_{turn}'
            arguments = '-p', f'state_file:={path}'
            stop, cut = (int(rng.integers(*item)) for item in ((again, len(messages) - 6), (2, 6)))
            cut += stop
            first = killed(case, arguments, path, messages[:stop], messages[stop:cut], rng)
            assert final(system, first).keys() <= whole.keys()
            with Rig(case, arguments) as rig:
                log = rig.node.log()
                second = final(system, rig.play(messages[stop - again + 1 :]))
                assert rig.node.stop() == 0 and 'Traceback' not in rig.node.log()
            assert 'goes on from the state' in log, log
            after = {s: item for s, item in whole.items() if s >= messages[cut].stamp_ns}
            assert after.keys() <= second.keys() <= whole.keys()
            given += len(second)
            good = [same(item, whole[stamp]) for stamp, item in second.items()]
            equal += sum(good)
            wrong += [(turn, stop, stamp) for stamp, ok in zip(second, good) if not ok]
            undisturbed.reset()  # what a node makes of it without the file
            alone = final(system, undisturbed.play(messages[stop - again + 1 :]))
            forgotten += sum(not same(alone[stamp], whole[stamp]) for stamp in second)
    figures.add(
        {'system': system}, tried=TURNS, again=again - 1, estimates=given, equal=equal,
        changed_without=forgotten, wrong=wrong,
    )  # fmt: skip
    assert not wrong
    assert forgotten or system in FORGETFUL
