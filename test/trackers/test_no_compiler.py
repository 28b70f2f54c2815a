# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers, obstacles, images and the filters of the package compile nothing, seen in a process
of its own: this one has loaded the compiler. Trackers warn of variances that cannot be true."""

import subprocess
import sys

from helpers.tracked import BAGS
import pytest

from benchmarks.false_warnings import runs

PROGRAM = """
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


def test_no_compiler_stands_before_the_first_estimate():
    words = [sys.executable, '-c', PROGRAM, str(BAGS)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize('name', ['obstacle_movers', 'diver_multistatic'])
@pytest.mark.parametrize('factor, warned', [(1.0, False), (2.0, True), (0.5, True)])
def test_only_variances_that_are_not_true_are_warned_of(name, factor, warned):
    ((_, raised),) = runs(BAGS / name, factor, range(1, 2))
    assert bool(raised) == warned
