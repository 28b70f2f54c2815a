# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How well arrays of receivers locate a diver: axes of the Cramer-Rao ellipse of one ping."""

import numpy as np

from sonar_imm.acoustics.localisation import Localisation, localise
from sonar_imm.acoustics.multistatic import range_sum


def bound(receivers, position):
    rx = np.array(receivers, float)
    tx = np.broadcast_to(rx[0], rx.shape)  # the transmitter stands at the first receiver
    toa = range_sum(position, tx, rx, target_z=-5.0) / 1500.0
    variances = np.full(len(rx), 2e-4**2)  # arrival times good to .2 ms
    fix = localise(rx, toa, variances, tx=tx, target_z=-5.0, sound_speed=1500.0)
    if not isinstance(fix, Localisation):
        return f'refused ({fix.reason})'
    short, long = np.sqrt(np.linalg.eigvalsh(fix.covariance))
    return f'{short:.2f} m by {long:.2f} m' + fix.ambiguous * ', or elsewhere'


square = [(-60, -60, -5), (60, -60, -5), (60, 60, -5), (-60, 60, -5)]
line = [(-60, 0, -5), (-20, 0, -5), (20, 0, -5), (60, 0, -5)]
for name, receivers in (('square', square), ('line', line)):
    for position in ((0, 5), (0, 60), (200, 10)):
        print(f'{name}, diver at {position}: {bound(receivers, position)}')
