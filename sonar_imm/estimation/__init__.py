# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Mathematics of multiple-model estimation: no sonar, no ROS, no clock, no global random state.

Two conventions hold in every module. A transition matrix is read ``P[i, j] = Pr(model j at k |
model i at k-1)``: rows sum to one. The cycle of a multiple-model filter is *mix, predict, update,
combine*.
"""

__all__ = [
    'adaptation',
    'angles',
    'arrays',
    'association',
    'bank',
    'consider',
    'consistency',
    'covariance',
    'gauss_markov',
    'history',
    'imm',
    'imm_filter',
    'jipda',
    'jit',
    'kalman',
    'marginals',
    'markov',
    'motion',
    'onset',
    'particle_imm',
    'particles',
    'rows',
    'set_filter',
    'set_members',
    'set_model',
    'set_shifts',
    'smoothing',
]
