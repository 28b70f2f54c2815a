# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is compiled, in processes of their own, since this one has loaded the compiler: nothing
stands before the first estimate, and nothing is left to compile after `warm`."""

import json
import subprocess
import sys

from helpers.source import ROOT
from helpers.tracked import BAGS, RUNS
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


FIRST = """
import sys
import numpy as np
from sonar_imm import cv, hover, IMM, ParticleIMM, position
from sonar_imm.measurements import SonarImage
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader

def run(tracker, system, name, count):
    tracker.warm()
    with BagReader(sys.argv[1] + '/' + name) as bag:
        found = [item.measurement for item in measurements_of(bag, system)][:count]
    assert max(len(e) for each in found for e in tracker.process(each)) > 0
    assert 'numba' not in sys.modules, name

Config = SYSTEMS['diver'].config_type()
for name in ('diver_table1', 'diver_multistatic'):
    run(SYSTEMS['diver'].build(Config()), 'diver', name, 5)
    smoother = SmoothingDiverTracker(Config(dimensions=3))
    run(smoother, 'diver', name, 4)
    assert len(smoother.smoothed())
Config = SYSTEMS['obstacle'].config_type()
run(SYSTEMS['obstacle'].build(Config()), 'obstacle', 'obstacle_tethers', 40)
rng = np.random.default_rng(0)
amplitude = rng.exponential(size=(60, 40))
amplitude[30, 20] = 1e3
place = {'range': 1.0 + np.arange(60.0), 'bearing': np.linspace(0.3, -0.3, 40)}
assert len(detect(SonarImage(stamp_ns=1, amplitude=amplitude, **place), DetectorConfig())) == 1
imm = IMM([cv(0.1), hover(0.1)], np.eye(2), np.zeros(4), np.eye(4), position(1.0))
imm.step([0.0, 0.0])
imm.step([1.0, 0.0], dt=0.5)
imm.smooth()
still = {'a': lambda x, rng, dt: x}
ParticleIMM(still, [[1.0]], np.ones((5, 1)), lambda x, z: -x[:, 0], rng).step(0.0)
assert 'numba' not in sys.modules
"""


def printed(program):
    words = [sys.executable, '-c', program, str(BAGS)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_no_compiler_stands_before_the_first_estimate():
    printed(FIRST)


@pytest.fixture(scope='module')
def found():
    """Of each recording the types of the arguments of each kernel, after `warm` and at the end."""
    return dict(map(json.loads, printed(PROGRAM).splitlines()))


@pytest.mark.parametrize('name', RUNS)
def test_nothing_is_left_to_compile_after_warm_and_a_kernel_has_one_kind_of_arguments(found, name):
    before, after = found[name]
    assert any(before.values()) or name.startswith(('diver', 'obstacle'))  # without kernels
    late = {name for name in after if after[name] != before.get(name, [])}
    assert late == set()
    assert {name: kinds for name, kinds in after.items() if len(kinds) > 1} == {}
