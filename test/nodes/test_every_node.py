# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every node: live is offline, hostile input is refused, services answer. And what the nodes of a
swath and of an array publish besides."""

from importlib import import_module

from helpers.node_bench import Driven
from helpers.scenes import SMALL, smaller_scene
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState, PointCloud2
from std_srvs.srv import SetBool, Trigger

from msg_adapters.array_records import read_trace, write_pressure, write_trace
from msg_adapters.estimates import read_estimate, write_estimate
from msg_adapters.inputs import inputs_of
from msg_adapters.navigation import write_navigation
from msg_adapters.snapshots import write_snapshot
from msg_adapters.soundings import read_soundings
from sonar_imm.measurements import Navigation, Pressure
from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.fathometer import FathometerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import input_qos, lockstep_qos
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.simulation.bathymetry import simulator as swath
from sonar_imm_tools.simulation.fathometer import simulator as array

SHARES = {'model_probabilities': JointState}
MESSAGES = 60
MORE = ('obstacle', 'late'), ('fathometer', 'small'), ('fathometer', 'pressure')
"""Messages that come late, cross-spectra, pressure."""


class Fed(Driven):
    """The node of a system, fed with a small scene in lock-step."""

    def __init__(self, bench, system, scenario):
        self.system = system
        config, scene = smaller_scene(system, scenario, 3)
        settings = config.instruments()
        self.config = system.config_type()(**settings)
        # On a busy machine a message may wait: here it is used all the same.
        overrides = [Parameter('max_wait', value=0.0)]
        for name, value in settings.items():
            given = list(value) if isinstance(value, tuple) else value
            overrides.append(Parameter(name, value=given))
        kind = getattr(import_module(system.node), f'{system.name.capitalize()}Node')
        node = bench.start(kind, parameter_overrides=overrides)
        inputs = {topic.measurement: topic for topic in inputs_of(system.name)}
        given = [item.measurement for item in scene.measurements[:MESSAGES]]
        self.messages = [(inputs[type(m)], inputs[type(m)].write(m, make)) for m in given]
        self.publishers = {}
        for topic, message in self.messages:
            if topic.name not in self.publishers:
                made = bench.publisher(type(message), topic.full_name(system.name))
                self.publishers[topic.name] = made
        super().__init__(bench, node, f'/{system.name}')

    def send(self, messages):
        """What was published of them."""
        start = len(self.estimates)
        for topic, message in messages:
            self.publish(self.publishers[topic.name], message)
        return [bytes(message.data) for message in self.estimates[start:]]

    def offline(self):
        """What the tracker makes of the same messages, without a node."""
        tracker, made = self.system.build(self.config), []
        for topic, message in self.messages:
            type_name = next(n for n in topic.readers if message_class(n) is type(message))
            read = topic.reader(type_name, 'enu', self.config.as_dict(), topic.name)
            sent = deserialize_message(serialize_message(message), type(message))
            made += tracker.process(read(sent))
        return [bytes(write_estimate(estimate, make).data) for estimate in made]


@pytest.mark.parametrize('name, scenario', [*SMALL.items(), *MORE])
def test_live_is_offline_hostile_input_is_refused_and_services_answer(make_bench, name, scenario):
    """One start of the node, since starting takes longest."""
    driven = Fed(make_bench(), SYSTEMS[name], scenario)
    live = driven.send(driven.messages)
    assert live and live == driven.offline()

    taken, refused, published = driven.answer
    assert refused == 0
    hostile = [(topic, type(message)()) for topic, message in driven.messages[:3]]
    assert driven.send(hostile) == []
    assert driven.answer == (taken + len(hostile), len(hostile), published)

    response = driven.bench.call(SetBool, f'/{name}/enable', SetBool.Request(data=False))
    assert response.success
    assert driven.send(driven.messages) == []
    driven.bench.call(SetBool, f'/{name}/enable', SetBool.Request(data=True))

    assert driven.bench.call(Trigger, f'/{name}/reset', Trigger.Request()).success
    assert driven.send(driven.messages) == live


def test_with_navigation_soundings_and_shares_are_published(make_bench):
    """One node for both sides; what `~/soundings` says is what the offline table holds."""
    bench = make_bench(p=['max_wait:=0.0', 'navigation:=required'])
    node = bench.start(BathymetryNode)
    kinds = {**dict.fromkeys(('estimate', 'soundings'), PointCloud2), **SHARES}
    tables, clouds, shares = bench.hear(node, lockstep_qos(), **kinds)
    types = {'port/snapshot': PointCloud2, 'starboard/snapshot': PointCloud2, 'nav': Odometry}
    publishers = {name: bench.publisher(kind, f'/{name}') for name, kind in types.items()}
    values = {'pings': 2, 'ping_rate': 10.0, 'last_range': 24.0}
    scene = swath.simulate(swath.scenario('moving_two_sides', values), 3)
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


START = 1_700_000_000 * 10**9


def test_traces_become_reflectors_with_ids_and_displays(make_bench):
    bench = make_bench(p=['particles:=2000'])
    node = bench.start(FathometerNode)
    kinds = {**dict.fromkeys(('estimate', 'response'), PointCloud2), **SHARES}
    tables, responses, numbers = bench.hear(node, **kinds)
    values = {'records': 4, 'appearing': (), 'fading': (), 'layers': 4}
    scene = array.simulate(array.scenario('drift_traces', values), 3)
    measured = [item.measurement for item in scene.measurements]
    publisher = bench.publisher(PointCloud2, '/trace')
    bench.send(node, publisher, *(write_trace(item, make) for item in measured))
    bench.spin_until(lambda: len(responses) == len(numbers) == len(tables) == 4)
    estimate = read_estimate(tables[-1])
    assert estimate.stamp_ns == measured[-1].stamp_ns
    assert np.allclose(np.sort(estimate.state[:, 0]), np.sort(scene.truth[-1].depth), atol=0.2)
    assert len(set(estimate.extras['track_id'])) == 4
    orders = [each for each in zip(numbers[-1].position, numbers[-1].name) if 'order' in each[1]]
    assert max(orders)[1] == 'order_4'
    shown = read_trace(responses[-1])
    assert len(shown) == len(measured[-1])
    assert np.corrcoef(shown.amplitude, measured[-1].amplitude)[0, 1] > 0.999


def test_blocks_of_a_whole_array_arrive_without_loss(make_bench):
    """1.4 s of 32 hydrophones at 12 kHz, 2 MB each, ten times as fast as a driver publishes."""
    bench, rng = make_bench(p=['particles:=200', 'record_seconds:=28.0']), np.random.default_rng(5)
    node = bench.start(FathometerNode)
    driver = bench.publisher(PointCloud2, '/pressure', input_qos(50))
    blocks = [
        Pressure(
            stamp_ns=START + round(k * 1.4e9), frame_id='array', sample_rate=12000.0,
            pressure=rng.normal(size=(16800, 32)), reference_depth=70.0,
        )
        for k in range(20)
    ]  # fmt: skip
    for message in [write_pressure(block, make) for block in blocks]:
        driver.publish(message)
        bench.executor.spin_once(timeout_sec=0.02)
    bench.spin_until(lambda: node._meter.received['pressure'] == len(blocks))
    counts = node.tracker.counts
    assert (counts['blocks'], counts['gaps'], counts['used']) == (len(blocks), 0, 1)
    assert not node._meter.refused
