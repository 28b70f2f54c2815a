# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Fixes of a diver that turns now and then, and the track of a GPS buoy above it."""

import numpy as np

rng = np.random.default_rng(7)
with open('fixes.csv', 'w') as fixes, open('gps.csv', 'w') as gps:
    print('time,easting,northing,std', file=fixes)
    print('time,easting,northing', file=gps)
    x, y, heading = 0.0, 0.0, 0.5
    for second in range(240):
        if second % 12 == 0:
            heading += rng.normal(scale=1.2)  # a turn every twelve seconds
        x, y = x + 0.7 * np.cos(heading), y + 0.7 * np.sin(heading)
        time = f'2026-05-04T09:{second // 60:02}:{second % 60:02}Z'
        print(f'{time},{x:.2f},{y:.2f}', file=gps)
        if rng.random() < 0.8:  # one fix in five is missing
            seen = rng.normal((x, y), 1.5)
            print(f'{time},{seen[0]:.2f},{seen[1]:.2f},1.5', file=fixes)
