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

"""How the process of a node ends."""

import subprocess
import sys

import pytest

PROGRAM = """
import atexit, sys
from sonar_imm.nodes.stopping import Stopper
atexit.register(print, 'modules are taken down')
stopper = Stopper()
stopper.asked = {asked}
print('said')
sys.exit(stopper.end(3))
"""


@pytest.mark.parametrize('asked', [True, False])
def test_a_process_that_was_told_to_stop_does_not_take_its_modules_down(asked):
    """That takes seconds on a busy machine, in which no watchdog lives."""
    command = [sys.executable, '-c', PROGRAM.format(asked=asked)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 3 and done.stdout.startswith('said\n') and not done.stderr
    assert ('taken down' in done.stdout) != asked
