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

"""The baseline in world coordinates follows, as a baseline should."""

import numpy as np

from benchmarks.landmark import LandmarkTracker
from benchmarks.obstacle_accuracy import config_of, track
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate


def test_one_gaussian_in_world_coordinates_follows_an_obstacle():
    setting = scenario('approach', {'last_range': 40.0})
    final = track(simulate(setting, 3), config_of(setting), LandmarkTracker)
    newest = final[max(final)]
    (row,) = np.flatnonzero(newest.extras['track_state'] > 0)
    error = abs(newest.state[row, 2] - 3.0)
    assert error < 4.0 * np.sqrt(newest.covariance[row, 2, 2]) + 1.0
    assert abs(newest.state[row, 0] - 40.0) < 2.0
