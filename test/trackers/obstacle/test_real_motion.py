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

"""Real motion under simulated detections (semi-synthetic): the stated band holds what it says."""

import pytest

from benchmarks.real_navigation import data_folder, dead_reckoned, summary


@pytest.mark.statistics
@pytest.mark.skipif(
    not (data_folder() / 'dvl.csv').exists(),
    reason='the recorded navigation is not there (SONAR_IMM_DATA)',
)
def test_the_band_holds_the_offset_under_real_motion():
    found = summary(dead_reckoned(data_folder()), runs=20)
    assert found['tracked'] == 20
    assert found['band_coverage'] >= 0.8
    assert found['nees'] < 2.0
    # It knows more than where obstacles are drawn, and than its own first answer.
    assert found['rmse_m'] < 0.9 * min(found['answering_zero_rmse_m'], found['spread_of_truth_m'])
    assert found['rmse_m'] < 0.9 * found['first_answer_rmse_m']
