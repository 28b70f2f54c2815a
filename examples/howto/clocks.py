# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Fixes of a diver, and the track of a GPS whose clock is 1.5 s ahead."""

import numpy as np

rng = np.random.default_rng(1)
with open('fixes.csv', 'w') as fixes, open('gps.csv', 'w') as gps:
    for file in (fixes, gps):
        print('time,x,y', file=file)
    for second in range(1, 121):
        x, y = 0.8 * second, 20 * np.sin(second / 15)
        print(f'{second},{x + rng.normal()},{y + rng.normal()}', file=fixes)
        print(f'{second + 1.5},{x},{y}', file=gps)  # the clock of the GPS is 1.5 s ahead
