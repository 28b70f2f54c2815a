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

"""The sentences about a run of the diver tracker."""

from sonar_imm_tools.evaluation.diver.summary import summary_sentence


def metrics(tracked, raw):
    return {
        'position': {'n': 5, 'rmse_m': tracked},
        'raw_fix': {'n': 5, 'rmse_m': raw},
        'consistency': {'coverage': {'95': 0.95}, 'verdict': 'consistent'},
    }


def test_the_raw_fixes_may_be_the_truth_itself():
    assert 'the truth itself' in summary_sentence(metrics(0.5, 0.0))
    assert 'removes 75 %' in summary_sentence(metrics(0.5, 2.0))
    assert 'adds 100 %' in summary_sentence(metrics(2.0, 1.0))
