# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A kernel is compiled once, for one kind of arrays, and by `warm` where it will be needed."""

import json
from pathlib import Path
import subprocess
import sys

from helpers.tracked import RUNS
import pytest

PROGRAM = """
import importlib, json, os, sys

sys.path.append('test')

import numba
from helpers.tracked import RUNS, Tracked
from numba.core.registry import CPUDispatcher

from sonar_imm.trackers import SYSTEMS


def signatures():
    found = {}
    for name, module in list(sys.modules.items()):
        for key, value in list(vars(module).items()) if name.startswith('sonar_imm.') else ():
            if isinstance(value, CPUDispatcher) and value.py_func.__module__ == name:
                found[f'{name}.{key}'] = sorted(map(str, value.signatures))
    return found


class Warmed(Tracked):
    def build(self):
        tracker = super().build()
        tracker.warm({type(measurement) for measurement in self.input})
        self.warmed = signatures()
        return tracker


def recording(name):
    return Warmed(name).warmed, signatures()


# What all processes need is loaded once: each is a copy of this one, in which no kernel is.
for system in SYSTEMS.values():
    importlib.import_module(f'sonar_imm.trackers.{system.name}.tracker')
numba.njit(lambda: 0)()
for name in RUNS:
    child = os.fork()
    if not child:
        print(json.dumps([name, recording(name)]), flush=True)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""


@pytest.fixture(scope='module')
def found():
    """Of each recording the types of the arguments of each kernel, after `warm` and at the end."""
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM],
        cwd=Path(__file__).resolve().parents[2],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return dict(map(json.loads, done.stdout.splitlines()))


@pytest.mark.parametrize('name', RUNS)
def test_nothing_is_left_to_compile_after_warm_and_a_kernel_has_one_kind_of_arguments(found, name):
    before, after = found[name]
    assert any(before.values()) or name.startswith(('diver', 'obstacle'))  # without kernels
    late = {name for name in after if after[name] != before.get(name, [])}
    assert late == set()
    assert {name: kinds for name, kinds in after.items() if len(kinds) > 1} == {}
