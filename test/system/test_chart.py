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

"""``chart`` beside what a node publishes: a grid and its nodes that late listeners get as well."""

import os
import subprocess
import sys
import time

from helpers.source import ROOT
import numpy as np
import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from nav_msgs.msg import OccupancyGrid  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402

from msg_adapters.soundings import write_soundings  # noqa: E402
from msg_adapters.table import decode_table  # noqa: E402
from sonar_imm.nodes.messages import make  # noqa: E402
from sonar_imm.nodes.qos import latched_qos, output_qos  # noqa: E402
from sonar_imm.soundings import COLUMNS, Soundings  # noqa: E402
from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id  # noqa: E402
from sonar_imm_tools.replay.link import Link  # noqa: E402
from sonar_imm_tools.simulation.survey import scenario, simulate  # noqa: E402

pytestmark = pytest.mark.system


def messages(points, frame='map'):
    for stamp in np.unique(points.stamp_ns).tolist():
        rows = points.stamp_ns == stamp
        columns = {**points.columns, **{f'p{name}': points[name] for name in 'xyz'}}
        ping = {name: columns[name][rows].astype(kind) for name, kind in COLUMNS.items()}
        yield write_soundings(Soundings(stamp, frame, ping), make)


def started(domain, *arguments):
    return subprocess.Popen(
        [sys.executable, '-m', 'sonar_imm_tools.cli', 'chart', *arguments],
        cwd=ROOT,
        env=dict(os.environ, ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST'),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def grounds(statuses):
    """How many messages the obstacle node has taken as ground, by its newest diagnostics; 0 where
    it refused one."""
    values = {pair.key: pair.value for each in statuses[-1:] for pair in each.status[0].values}
    refused = any(key.startswith(('refused', 'incompatible')) for key in values)
    return 0 if refused else int(values.get('ground received', 0))


def test_a_chart_grows_with_the_lines(monkeypatch):
    """Lines of a node go to the chart, and what changed of it to the obstacle node."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    small = {'lines': 2, 'cross_lines': 0, 'length': 40.0, 'spacing': 30.0, 'ghost': False}
    scene = simulate(scenario('survey', small), 1)
    grids, clouds = [], []
    with (
        reserved_domain_id() as domain,
        Link('sea', domain_id=domain) as link,
        NodeProcess(
            'obstacle', domain_id=domain, arguments=('-r', 'ground:=/sonar_imm_chart/ground')
        ) as obstacle,
    ):
        publisher = link.node.create_publisher(PointCloud2, '/bathymetry/soundings', output_qos())
        link.node.create_subscription(
            OccupancyGrid, '/sonar_imm_chart/grid', grids.append, latched_qos()
        )
        statuses = []
        link.node.create_subscription(DiagnosticArray, '/diagnostics', statuses.append, 10)
        it = started(domain, '--period', '0.3', '--timeout', '180')
        try:
            assert link.wait_for(publisher.get_subscription_count, 120.0)
            assert link.wait_for(
                lambda: link.node.count_subscribers('/sonar_imm_chart/ground'),
                90.0,
                obstacle.trouble,
            )
            for points, least in zip(scene.points, (1, 2)):
                for message in messages(points):
                    publisher.publish(message)
                    time.sleep(0.02)
                before = len(grids)
                assert link.wait_for(lambda: len(grids) > before, 60.0), least  # noqa: B023
            link.wait_for(lambda: False, 2.0)  # what is under way
            assert link.wait_for(lambda: grounds(statuses) > 0, 60.0, obstacle.trouble)
            # Who comes later gets the newest chart.
            link.node.create_subscription(
                PointCloud2, '/sonar_imm_chart/nodes', clouds.append, latched_qos()
            )
            assert link.wait_for(lambda: clouds, 120.0)
            for message in messages(scene.points[0], frame='odom'):
                publisher.publish(message)
                break
            output, error = it.communicate(timeout=240)
        finally:
            it.kill()
            it.wait()
    assert it.returncode == 1 and "in the frame 'odom', others are in 'map'" in error
    assert 'Traceback' not in error and 'line 2: ' in output
    sizes = [grid.info.width * grid.info.height for grid in grids]
    assert sizes[-1] > 1.2 * sizes[0] and grids[-1].header.frame_id == 'map'
    grid = grids[-1]
    assert grid.info.resolution == 1.0
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    table = decode_table(clouds[-1])
    column = np.floor(table['px'] - grid.info.origin.position.x).astype(int)
    row = np.floor(table['py'] - grid.info.origin.position.y).astype(int)
    assert (cells[row, column] >= 0).all() and (cells >= 0).sum() == len(column)
    z = table['z']
    expected = 100.0 * (z - z.min()) / np.ptp(z)
    assert np.abs(cells[row, column] - expected).max() < 0.51
    error = z - scene.floor.at(table['px'], table['py']) + scene.corrections[:, 3].mean()
    assert np.median(np.abs(error)) < 0.6  # nothing is adjusted: roll is 1 deg off
    assert table['lines'].max() == 2


def test_a_topic_that_is_no_soundings_is_one_sentence(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with reserved_domain_id() as domain:
        it = started(domain, '/nobody/soundings', '--timeout', '1')
        output, error = it.communicate(timeout=240)
    assert it.returncode == 1 and 'nobody publishes /nobody/soundings' in error
    assert 'Traceback' not in error
