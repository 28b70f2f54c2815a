# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bathymetry node: an estimate a ping, hostile snapshots named and counted, pings dropped."""

import time

from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import JointState, PointCloud2

from msg_adapters.estimates import read_estimate
from msg_adapters.navigation import write_navigation
from msg_adapters.snapshots import write_snapshot
from msg_adapters.soundings import read_soundings
from msg_adapters.table import encode_table
from sonar_imm.measurements import Navigation
from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm.soundings import soundings_of
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

SHORT = {'pings': 3, 'last_range': 24.0}


def pings(**values):
    scene = simulate(scenario('paper', {**SHORT, **values}), 3)
    return [item.measurement for item in scene.measurements], scene.truth


class Rig:
    def __init__(self, bench):
        self.bench = bench
        self.node = bench.add(BathymetryNode(context=bench.context))
        self.tables = bench.listen(PointCloud2, '/bathymetry/estimate', lockstep_qos())
        self.publisher = bench.peer.create_publisher(PointCloud2, '/snapshot', lockstep_qos())
        bench.spin_until(
            lambda: (
                self.publisher.get_subscription_count()
                and self.node.count_subscribers('/bathymetry/estimate')
            )
        )

    def send(self, *messages):
        received = self.node._meter.received
        for message in messages:
            before = received.total()
            self.publisher.publish(message)
            self.bench.spin_until(lambda want=before: received.total() > want)
        self.bench.spin_until(lambda: len(self.tables) == self.node._published)


@pytest.fixture
def rig(make_bench):
    return Rig(make_bench('-p', 'max_wait:=0.0'))


def table(rows, *, stamp_ns=5 * 10**9, **columns):
    """A message that no adapter of ours would write."""
    columns.setdefault('range', np.linspace(17.0, 24.0, rows, dtype=np.float32))
    columns.setdefault('iq', np.ones((rows, 8), np.float32))
    return encode_table(columns, stamp_ns=stamp_ns, frame_id='sonar', make=make)


def test_a_ping_becomes_the_floor_under_it(rig):
    snapshots, truth = pings()
    rig.send(*[write_snapshot(snapshot, make) for snapshot in snapshots])
    assert len(rig.tables) == 3
    for message, snapshot, true in zip(rig.tables, snapshots, truth):
        estimate = read_estimate(message)
        assert estimate.stamp_ns == snapshot.stamp_ns and estimate.frame_id == 'sonar'
        assert len(estimate) == len(snapshot)
        assert np.sqrt(np.mean(np.square(estimate.state[20:, 0] - true.height[20:]))) < 0.1
        # What RViz2 and Foxglove draw: starboard is to the right, the floor 15 m below.
        assert np.median(np.abs(estimate.xyz[20:, 2] + 15.0)) < 0.1
        assert (estimate.xyz[20:, 1] < 0.0).all()
        assert set(estimate.extras['label']) <= {0, 1}
    assert not rig.node._errors


def test_hostile_snapshots_are_named_and_counted_and_the_node_lives(rig):
    (good,) = pings(pings=1)[0]
    one_bin = table(1)
    huge = table(1_000_000, iq=np.ones((1_000_000, 4), np.float32))
    backward = table(40, range=np.linspace(24.0, 17.0, 40, dtype=np.float32))
    odd = table(40, iq=np.ones((40, 7), np.float32))
    no_staves = table(40, iq=np.ones((40, 2), np.float32))
    nan = table(40, iq=np.full((40, 8), np.nan, np.float32))
    silent = table(40, iq=np.zeros((40, 8), np.float32))
    empty = table(0)
    no_column = encode_table(
        {'range': np.ones(4, np.float32)}, stamp_ns=10**9, frame_id='sonar', make=make
    )
    changing = table(40, sound_speed=np.linspace(1400, 1500, 40, dtype=np.float32))
    cut = write_snapshot(good, make)
    cut.data = bytes(cut.data)[:-100]
    rig.send(one_bin, huge, backward, odd, no_staves, nan, silent, empty, no_column, changing, cut)
    refused = rig.node._meter.refused
    assert refused.total() == 11 and not rig.tables and not rig.node._errors
    assert {
        'too_short', 'too_large', 'bad_range', 'bad_field', 'nan', 'silent', 'missing_column',
        'not_constant',
    } <= set(refused)  # fmt: skip
    rig.send(write_snapshot(good, make))
    assert len(read_estimate(rig.tables[0])) == len(good)


def test_pings_of_changing_sizes_and_some_bad_bins_are_used(rig):
    sizes = []
    for number, values in enumerate(
        ({'staves': 8}, {'staves': 2}, {'staves': 16}, {'last_range': 18.0}, {'first_range': 10.0})
    ):
        item = pings(pings=1, **values)[0][0]
        message = write_snapshot(item, make)
        message.header.stamp.sec = 100 + number
        raw = np.frombuffer(bytes(message.data), np.uint8).copy().reshape(len(item), -1)
        iq = next(field.offset for field in message.fields if field.name == 'iq')
        raw[5, iq : iq + 4] = np.array([np.nan], np.float32).view(np.uint8)
        message.data = raw.tobytes()
        rig.send(message)
        sizes.append(len(item))
    assert [message.width for message in rig.tables] == sizes
    for message in rig.tables:
        assert np.isfinite(read_estimate(message).state).all()
    assert rig.node.tracker.counts['bins_unusable'] == 5


def test_a_spacing_other_than_configured_is_counted(make_bench):
    rig = Rig(make_bench('-p', 'max_wait:=0.0', '-p', 'element_spacing_wavelengths:=0.7'))
    rig.send(*[write_snapshot(ping, make) for ping in pings()[0]])
    assert not rig.tables
    assert rig.node.tracker.counts['other_spacing'] == 3


def test_pings_that_waited_too_long_are_dropped_whole_and_counted(make_bench):
    limit = 0.5
    rig = Rig(make_bench('-p', f'max_wait:={limit}'))
    first, second, last = [write_snapshot(ping, make) for ping in pings()[0]]
    begin = time.monotonic()
    rig.publisher.publish(first)
    rig.publisher.publish(second)
    while time.monotonic() < begin + 1.5 * limit:  # the node is busy
        time.sleep(0.05)
    rig.bench.spin_until(lambda: rig.node._meter.received['snapshot'] == 2)
    assert rig.node._meter.dropped['snapshot'] == 2
    rig.send(last)
    assert len(rig.tables) == 1 and rig.tables[0].header.stamp == last.header.stamp
    assert rig.node._meter.dropped['snapshot'] == 2


def test_two_sides_are_two_nodes(make_bench):
    bench = make_bench('-p', 'side:=port')
    node = bench.add(BathymetryNode(context=bench.context, namespace='port'))
    tables = bench.listen(PointCloud2, '/port/bathymetry/estimate', lockstep_qos())
    publisher = bench.peer.create_publisher(PointCloud2, '/port/snapshot', lockstep_qos())
    bench.spin_until(
        lambda: (
            publisher.get_subscription_count()
            and node.count_subscribers('/port/bathymetry/estimate')
        )
    )
    publisher.publish(write_snapshot(pings(pings=1)[0][0], make))
    bench.spin_until(lambda: tables)
    assert (read_estimate(tables[0]).xyz[20:, 1] > 0.0).all()


def test_with_navigation_soundings_and_shares_are_published(make_bench):
    """One node for both sides; what `~/soundings` says is what the offline table holds."""
    bench = make_bench('-p', 'max_wait:=0.0', '-p', 'navigation:=required')
    node = bench.add(BathymetryNode(context=bench.context))
    tables = bench.listen(PointCloud2, '/bathymetry/estimate', lockstep_qos())
    clouds = bench.listen(PointCloud2, '/bathymetry/soundings', lockstep_qos())
    shares = bench.listen(JointState, '/bathymetry/model_probabilities', lockstep_qos())
    types = {'port/snapshot': PointCloud2, 'starboard/snapshot': PointCloud2, 'nav': Odometry}
    publishers = {
        name: bench.peer.create_publisher(kind, f'/{name}', lockstep_qos())
        for name, kind in types.items()
    }
    outputs = ('estimate', 'soundings', 'model_probabilities')
    bench.spin_until(
        lambda: (
            all(item.get_subscription_count() for item in publishers.values())
            and all(node.count_subscribers(f'/bathymetry/{name}') for name in outputs)
        )
    )
    values = {'pings': 2, 'ping_rate': 10.0, 'last_range': 24.0}
    scene = simulate(scenario('moving_two_sides', values), 3)
    received = node._meter.received
    for item in scene.measurements:
        before = received.total()
        if isinstance(item.measurement, Navigation):
            publishers['nav'].publish(write_navigation(item.measurement, make))
        else:
            message = write_snapshot(item.measurement, make)
            publishers[f'{item.namespace}/snapshot'].publish(message)
        bench.spin_until(lambda want=before: received.total() > want)
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


def test_with_coupled_labels_an_estimate_comes_with_the_next_ping(make_bench):
    rig = Rig(make_bench('-p', 'max_wait:=0.0', '-p', 'ping_coupling:=0.35'))
    snapshots, _ = pings()
    rig.send(*[write_snapshot(snapshot, make) for snapshot in snapshots])
    found = [read_estimate(message).stamp_ns for message in rig.tables]
    assert found == [snapshot.stamp_ns for snapshot in snapshots[:2]]
    assert rig.node.tracker.health()['pings_held'] == 1 and not rig.node._errors
