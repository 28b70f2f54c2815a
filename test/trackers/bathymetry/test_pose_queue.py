# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pings that wait for the poses of their ship: stamps of bins, altitudes, and what is counted."""

import numpy as np
import pytest

from sonar_imm.measurements import Altitude, Navigation, Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.trackers.bathymetry.ping import bin_stamps
from sonar_imm.trackers.bathymetry.tracker import PoseQueue
from sonar_imm.trackers.navigation import MOST_WAITING

SECOND = 10**9
START = 10**6
CONFIG = BathymetryConfig(sound_speed=1500.0, max_gap=2.0)


def ping(seconds, **changes):
    """Bins that are heard 0.01 s and 0.5 s after the ping, at 1500 m/s."""
    values = {'range': [7.5, 375.0], 'iq': np.ones((2, 4), np.complex64)}
    return Snapshot(stamp_ns=round((START + seconds) * SECOND), **{**values, **changes})


def pose(seconds):
    return Navigation(
        stamp_ns=round((START + seconds) * SECOND),
        position=(float(seconds), (seconds % 100.0) ** 2, 0.0),
        orientation=(0.0, 0.0, 0.0, 1.0),
        frame_id='odom',
    )


@pytest.fixture
def queue():
    """A queue that knows poses of every second from 0 to 40 s."""
    queue = PoseQueue()
    for second in range(41):
        queue.add_pose(pose(second))
    return queue


def test_a_bin_is_heard_when_sound_has_gone_there_and_back():
    delays = bin_stamps(ping(0.0), CONFIG) - START * SECOND
    assert delays.tolist() == [0, SECOND // 100, SECOND // 2]
    faster = bin_stamps(ping(0.0, sound_speed=1600.0), CONFIG) - START * SECOND
    assert faster.tolist() == [0, 9_375_000, 468_750_000]


def test_the_ship_is_where_it_was_when_each_bin_was_heard(queue):
    queue.add_ping(ping(10.0))
    queue.add_ping(ping(39.5))
    first, last = (ping.posed for ping in queue.ready(CONFIG))
    assert first.poses.position[:, 0] == pytest.approx([10.0, 10.01, 10.5])
    assert first.poses.position[:, 1] == pytest.approx([100.0, 100.21, 110.5])  # 21 m/s
    assert last.poses.position[:, 0] == pytest.approx([39.5, 39.51, 40.0])
    assert first.frame_id == 'odom' and not len(queue)
    queue.add_ping(ping(39.6))  # its last bin is heard after the last pose
    assert queue.ready(CONFIG) == [] and len(queue) == 1
    queue.add_pose(pose(41.0))
    assert len(queue.ready(CONFIG)) == 1


@pytest.mark.parametrize(
    'seconds, altitude', [(9.0, None), (9.6, 30.0), (12.0, 31.0), (18.0, 32.0), (18.6, None)]
)
def test_the_newest_altitude_before_the_end_of_a_ping_counts_for_five_seconds(
    queue, seconds, altitude
):
    for second, height in ((13.5, 32.0), (10.0, 30.0), (30.0, 50.0), (12.0, 31.0)):
        stamp_ns = round((START + second) * SECOND)
        queue.add_altitude(Altitude(stamp_ns=stamp_ns, altitude=height))
    queue.add_ping(ping(seconds))
    (ready,) = queue.ready(CONFIG)
    assert ready.posed.altitude == altitude


def test_what_waits_too_long_is_given_up_the_oldest_first_and_counted(queue):
    for k in range(MOST_WAITING + 3):
        queue.add_ping(ping(50.0 + 0.01 * k))
    assert len(queue) == MOST_WAITING
    assert queue.counts['navigation_missing'] == 3
    for second in range(41, 60):
        queue.add_pose(pose(second))
    ready = queue.ready(CONFIG)
    assert [each.snapshot.stamp_ns for each in (ready[0], ready[-1])] == [
        ping(50.03).stamp_ns,
        ping(52.02).stamp_ns,
    ]


def test_a_clock_that_was_set_back_takes_the_waiting_pings_with_it(queue):
    queue.add_ping(ping(50.0))
    queue.add_ping(ping(51.0))
    for second in range(5):
        queue.add_pose(pose(second - 500_000.0))
    assert queue.counts['restarts'] == 1
    assert queue.counts['navigation_gap'] == 2 and not len(queue)
    queue.add_ping(ping(2.0 - 500_000.0))
    assert len(queue.ready(CONFIG)) == 1
