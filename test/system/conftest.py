# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Real processes heed signals, whatever started the tests; where figures of faults go."""

import signal

from helpers.faults.figures import Figures
import pytest


@pytest.fixture(autouse=True, scope='session')
def _signals_are_heeded():
    """A run in the background of a script ignores SIGINT, under nohup SIGHUP; so would nodes."""
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


@pytest.fixture(autouse=True, scope='session')
def _patience():
    """Nodes are waited for, however busy the machine is."""
    from sonar_imm_tools.replay import harness, lockstep

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(harness, '_STOP_LIMIT', 120.0)
        for name in ('ANSWER_LIMIT', 'MATCH_LIMIT'):
            patch.setattr(lockstep, name, 120.0)
        yield


@pytest.fixture(scope='module')
def figures(request):
    """The rows of the file of this module, e.g. those of ``test_signals.py``."""
    return Figures(request.module.__name__.rpartition('test_')[2])
