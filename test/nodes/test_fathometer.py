# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer node: an estimate a record, displays, pressure in large blocks."""

import numpy as np
from sensor_msgs.msg import JointState, PointCloud2

from msg_adapters.array_records import read_trace, write_pressure, write_trace
from msg_adapters.estimates import read_estimate
from sonar_imm.measurements import Pressure
from sonar_imm.nodes.fathometer import FathometerNode
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import input_qos
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

START = 1_700_000_000 * 10**9


def test_traces_become_reflectors_with_ids_and_displays(make_bench):
    bench = make_bench(p=['particles:=2000'])
    node = bench.start(FathometerNode)
    outputs = ('estimate', 'response', 'model_probabilities')
    tables = bench.listen(PointCloud2, '/fathometer/estimate')
    responses = bench.listen(PointCloud2, '/fathometer/response')
    numbers = bench.listen(JointState, '/fathometer/model_probabilities')
    bench.spin_until(
        lambda: all(node.count_subscribers(f'/fathometer/{name}') for name in outputs)
    )
    values = {'records': 4, 'appearing': (), 'fading': (), 'layers': 4}
    scene = simulate(scenario('drift_traces', values), 3)
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
