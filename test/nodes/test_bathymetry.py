# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bathymetry node: an estimate a ping, soundings and shares of labels."""

from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import JointState, PointCloud2

from msg_adapters.estimates import read_estimate
from msg_adapters.navigation import write_navigation
from msg_adapters.snapshots import write_snapshot
from msg_adapters.soundings import read_soundings
from sonar_imm.measurements import Navigation
from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm.soundings import soundings_of
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate


def test_a_ping_becomes_the_floor_under_it(make_bench):
    bench = make_bench(p=['max_wait:=0.0'])
    node = bench.start(BathymetryNode)
    tables = bench.listen(PointCloud2, '/bathymetry/estimate', lockstep_qos())
    bench.spin_until(lambda: node.count_subscribers('/bathymetry/estimate'))
    scene = simulate(scenario('paper', {'pings': 3, 'last_range': 24.0}), 3)
    snapshots = [item.measurement for item in scene.measurements]
    publisher = bench.publisher(PointCloud2, '/snapshot')
    bench.send(node, publisher, *(write_snapshot(snapshot, make) for snapshot in snapshots))
    bench.spin_until(lambda: len(tables) == 3)
    for message, snapshot, true in zip(tables, snapshots, scene.truth):
        estimate = read_estimate(message)
        assert estimate.stamp_ns == snapshot.stamp_ns and estimate.frame_id == 'sonar'
        assert len(estimate) == len(snapshot)
        assert np.sqrt(np.mean(np.square(estimate.state[20:, 0] - true.height[20:]))) < 0.1
        # What RViz2 and Foxglove draw: starboard is to the right, the floor 15 m below.
        assert np.median(np.abs(estimate.xyz[20:, 2] + 15.0)) < 0.1
        assert (estimate.xyz[20:, 1] < 0.0).all()
        assert set(estimate.extras['label']) <= {0, 1}
    assert not node._errors


def test_with_navigation_soundings_and_shares_are_published(make_bench):
    """One node for both sides; what `~/soundings` says is what the offline table holds."""
    bench = make_bench(p=['max_wait:=0.0', 'navigation:=required'])
    node = bench.start(BathymetryNode)
    tables = bench.listen(PointCloud2, '/bathymetry/estimate', lockstep_qos())
    clouds = bench.listen(PointCloud2, '/bathymetry/soundings', lockstep_qos())
    shares = bench.listen(JointState, '/bathymetry/model_probabilities', lockstep_qos())
    types = {'port/snapshot': PointCloud2, 'starboard/snapshot': PointCloud2, 'nav': Odometry}
    publishers = {name: bench.publisher(kind, f'/{name}') for name, kind in types.items()}
    outputs = ('estimate', 'soundings', 'model_probabilities')
    bench.spin_until(
        lambda: all(node.count_subscribers(f'/bathymetry/{name}') for name in outputs)
    )
    values = {'pings': 2, 'ping_rate': 10.0, 'last_range': 24.0}
    scene = simulate(scenario('moving_two_sides', values), 3)
    for item in scene.measurements:
        if isinstance(item.measurement, Navigation):
            bench.send(node, publishers['nav'], write_navigation(item.measurement, make))
        else:
            publisher = publishers[f'{item.namespace}/snapshot']
            bench.send(node, publisher, write_snapshot(item.measurement, make))
    bench.spin_until(lambda: len(tables) == len(clouds) == len(shares) == 4)
    for table, cloud, share in zip(tables, clouds, shares):
        estimate = read_estimate(table)
        expected = soundings_of(estimate)
        found = read_soundings(cloud)
        assert found.frame_id == 'map' and len(found) == len(expected) > 100
        for name, column in expected.columns.items():
            np.testing.assert_array_equal(found.columns[name], column)
        assert list(share.name) == list(estimate.model_names)
        assert sum(share.position) == pytest.approx(1.0)
        labels = estimate.extras['label'][estimate.extras['valid'] > 0]
        assert share.position[1] == pytest.approx((labels == 1).mean())
    assert {int(read_soundings(cloud).columns['side'][0]) for cloud in clouds} == {0, 1}
