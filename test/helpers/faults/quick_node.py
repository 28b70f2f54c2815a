# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node as it is started, that reports on itself and saves its state every .05 and .1 s."""

import runpy
import sys

from sonar_imm.nodes import base, saved_state
from sonar_imm.trackers import SYSTEMS

if __name__ == '__main__':
    base.DIAGNOSTICS_PERIOD, saved_state.STATE_INTERVAL = 0.05, 0.1
    name = next(word for word in sys.argv if word.startswith('__node:=')).partition(':=')[2]
    runpy.run_module(SYSTEMS[name].node, run_name='__main__')
