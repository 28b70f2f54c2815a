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

"""A kernel is compiled once, for one kind of arrays, and by `warm` where it will be needed."""

import json
from pathlib import Path
import subprocess
import sys

from helpers.tracked import RUNS
import pytest

RUN = """
import json, sys

sys.path.append('test')

from helpers.tracked import Tracked
from numba import types
from numba.core.registry import CPUDispatcher


def signatures():
    found = {}
    for name, module in list(sys.modules.items()):
        for key, value in list(vars(module).items()) if name.startswith('sonar_imm.') else ():
            if isinstance(value, CPUDispatcher) and value.py_func.__module__ == name:
                kinds = {str(tuple(map(types.unliteral, s))) for s in value.signatures}
                found[f'{name}.{key}'] = sorted(kinds)
    return found


class Warmed(Tracked):
    def build(self):
        tracker = super().build()
        tracker.warm({type(measurement) for measurement in self.input})
        self.warmed = signatures()
        return tracker


run = Warmed(sys.argv[1])
print(json.dumps([run.warmed, signatures()]))
"""
COLD = {'_repair', '_update_again'}
"""Compiled when the first covariance needs it, and what they call."""


@pytest.fixture(scope='module', params=RUNS)
def compilations(request):
    """Of each kernel the types of its arguments, after `warm` and after a recording."""
    found = subprocess.run(
        [sys.executable, '-c', RUN, request.param],
        cwd=Path(__file__).resolve().parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(found.stdout.splitlines()[-1])


def test_nothing_is_left_to_compile_after_warm(compilations):
    before, after = compilations
    assert any(before.values())
    late = {name for name in after if after[name] != before.get(name, [])}
    assert {name for name in late if name.rpartition('.')[2] not in COLD} == set()


def test_a_kernel_has_one_kind_of_arguments(compilations):
    several = {name: kinds for name, kinds in compilations[1].items() if len(kinds) > 1}
    assert several == {}
