# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Small recordings with fixes and truth, written by the package itself."""

import numpy as np

from helpers.dive_scenes import legs, stamps
from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Fix
from sonar_imm.truth import TrueTrack
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

FIX_SIGMA = 1.2


def write_dive(path, *, count=120, seed=4, truth=True, topic='/fix', spoilt=(), shuffle=False):
    """One diver, a fix a second, truth at half seconds; `spoilt` fixes have a NaN position."""
    rng = np.random.default_rng(seed)
    times = np.arange(count) * 1.0
    place = legs(times)[:, :2] + rng.normal(0.0, FIX_SIGMA, (count, 2))
    order = np.arange(count)
    if shuffle:
        for pair in range(10, count - 1, 7):
            order[[pair, pair + 1]] = order[[pair + 1, pair]]
    with BagWriter(path) as bag:
        if truth:
            dense = np.arange(2 * count) * 0.5
            state = legs(dense)
            true = TrueTrack(0, stamps(dense), state[:, :2], state[:, 2:])
            for stamp, name, message in records_of(true, 'map'):
                bag.write(name, message, stamp)
        stamp_ns = stamps(times)
        for arrival, index in enumerate(order):
            given = {'position': [*place[index], 0.0], 'covariance': np.eye(2) * FIX_SIGMA**2}
            fix = Fix(stamp_ns=stamp_ns[index], frame_id='map', **given)
            message = write_fix(fix, ros_message)
            if index in spoilt:
                message.pose.pose.position.x = float('nan')
            bag.write(topic, message, stamp_ns[arrival])
    return path
