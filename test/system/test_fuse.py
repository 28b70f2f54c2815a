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

"""``fuse --live`` beside two nodes that publish the same diver."""

import os
import subprocess
import sys
import time

from helpers.dive_scenes import estimate_at, SECOND, START_NS
from helpers.source import ROOT
import numpy as np
import pytest

pytest.importorskip('rclpy')

from sensor_msgs.msg import PointCloud2  # noqa: E402

from msg_adapters.estimates import read_estimate, write_estimate  # noqa: E402
from sonar_imm.nodes.messages import make  # noqa: E402
from sonar_imm.nodes.qos import output_qos  # noqa: E402
from sonar_imm_tools.replay.harness import reserved_domain_id  # noqa: E402
from sonar_imm_tools.replay.link import Link  # noqa: E402

pytestmark = pytest.mark.system

TOPICS = '/port/diver/estimate', '/starboard/diver/estimate'


def test_two_nodes_are_one_topic(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    stated, fused = np.diag([0.04, 0.04, 0.01, 0.01]), []
    with reserved_domain_id() as domain, Link('sea', domain_id=domain) as link:
        out = [link.node.create_publisher(PointCloud2, topic, output_qos()) for topic in TOPICS]
        link.node.create_subscription(
            PointCloud2, '/sonar_imm_fuse/estimate', fused.append, output_qos()
        )
        it = subprocess.Popen(
            [sys.executable, '-m', 'sonar_imm_tools.cli', 'fuse', '--live', *TOPICS],
            cwd=ROOT,
            env=dict(os.environ, ROS_DOMAIN_ID=str(domain)),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert link.wait_for(lambda: all(p.get_subscription_count() for p in out), 120.0)
            assert link.wait_for(
                lambda: link.node.count_publishers('/sonar_imm_fuse/estimate'), 60.0
            )
            for k in range(40):
                for own, publisher in zip((7, 3), out):
                    place = [0.5 * k, 0.1 * own, 0.5, 0.0]
                    estimate = estimate_at(START_NS + k * SECOND, [place], [own], stated=stated)
                    publisher.publish(write_estimate(estimate, make))
                link.wait_for(lambda: False, 0.05)
            link.wait_for(lambda: len(fused) >= 40, 20.0)
            out[0].publish(make('sensor_msgs/msg/PointCloud2'))
            time.sleep(0.1)
            output, error = it.communicate(timeout=60)
        finally:
            it.kill()
            it.wait()
    made = [read_estimate(message) for message in fused]
    assert len(made) >= 35 and all(each.extras['track_id'].tolist() == [1] for each in made)
    assert all(np.allclose(each.covariance[0], stated) for each in made)  # not twice as sure
    assert f'track 7 of {TOPICS[0]} and 3 of {TOPICS[1]} are one diver' in output
    assert it.returncode == 1 and 'Traceback' not in error and 'no estimates of divers' in error
