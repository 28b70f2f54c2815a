# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Fixes of three divers whose transponders are polled in turn, once a second."""

import numpy as np

rng = np.random.default_rng(1)
with open('polled.csv', 'w') as file:
    print('time,x,y,std', file=file)
    for turn in range(1, 61):
        for diver in range(3):
            second = turn + (diver + 0.5) / 3
            x, y = [0.5 * second, 20 * diver] + 0.3 * rng.normal(size=2)
            print(f'{second:.3f},{x},{y},0.3', file=file)
