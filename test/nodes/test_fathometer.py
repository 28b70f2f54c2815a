# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer node: an estimate a record, pressure in blocks, displays, hostility."""

import attrs
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import pytest
from sensor_msgs.msg import JointState, PointCloud2
from std_srvs.srv import Trigger

from msg_adapters.array_records import (
    read_pressure,
    read_trace,
    write_array_depth,
    write_csdm,
    write_pressure,
    write_trace,
)
from msg_adapters.estimates import read_estimate
from msg_adapters.table import encode_table
from sonar_imm.acoustics.spectra import BlockAverage, SnapshotStream
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure
from sonar_imm.nodes.fathometer import FathometerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import input_qos, lockstep_qos, output_qos
from sonar_imm_tools.simulation.fathometer.simulator import scenario, simulate

SMALL = ('phones:=8', 'element_spacing:=0.36', 'frequency_max:=2000.0', 'particles:=2000')
START = 1_700_000_000 * 10**9


class Rig:
    def __init__(self, bench):
        self.bench = bench
        self.node = bench.add(FathometerNode(context=bench.context))
        self.tables = bench.listen(PointCloud2, '/fathometer/estimate', lockstep_qos())
        self.publishers = {
            name: bench.peer.create_publisher(PointCloud2, f'/{name}', lockstep_qos())
            for name in ('csdm', 'pressure', 'trace')
        }
        self.publishers['array_depth'] = bench.peer.create_publisher(
            message_class('geometry_msgs/msg/PointStamped'), '/array_depth', lockstep_qos()
        )
        bench.spin_until(
            lambda: (
                all(item.get_subscription_count() for item in self.publishers.values())
                and self.node.count_subscribers('/fathometer/estimate')
            )
        )

    def send(self, name, *messages):
        received = self.node._meter.received
        for message in messages:
            before = received.total()
            self.publishers[name].publish(message)
            self.bench.spin_until(lambda want=before: received.total() > want)
        self.bench.spin_until(lambda: len(self.tables) == self.node._published)


def rig_of(make_bench, *parameters):
    return Rig(make_bench(*(word for text in parameters for word in ('-p', text))))


@pytest.fixture
def rig(make_bench):
    return rig_of(make_bench, *SMALL)


def traces(**values):
    scene = simulate(scenario('drift_traces', {'records': 4, 'appearing': (), **values}), 3)
    return [item.measurement for item in scene.measurements], scene.truth


def table(**columns):
    """A message that no adapter of ours would write."""
    return encode_table(columns, stamp_ns=START, frame_id='array', make=make)


def test_traces_become_reflectors_with_ids_and_displays(make_bench):
    # Of an array of another band: with the pulse of that of `rig` a side lobe is a reflector.
    rig = rig_of(make_bench, 'particles:=2000')
    responses = rig.bench.listen(PointCloud2, '/fathometer/response')
    numbers = rig.bench.listen(JointState, '/fathometer/model_probabilities')
    rig.bench.spin_until(
        lambda: (
            rig.node.count_subscribers('/fathometer/response')
            and rig.node.count_subscribers('/fathometer/model_probabilities')
        )
    )
    measured, truth = traces(fading=(), layers=4)
    rig.send('trace', *[write_trace(item, make) for item in measured])
    rig.bench.spin_until(lambda: len(responses) == len(numbers) == len(rig.tables) == 4)
    estimate = read_estimate(rig.tables[-1])
    assert estimate.stamp_ns == measured[-1].stamp_ns
    assert np.allclose(np.sort(estimate.state[:, 0]), np.sort(truth[-1].depth), atol=0.2)
    assert len(set(estimate.extras['track_id'])) == 4
    orders = {
        name: position
        for name, position in zip(numbers[-1].name, numbers[-1].position)
        if name.startswith('order')
    }
    assert max(orders, key=lambda name: orders[name]) == 'order_4'
    shown = read_trace(responses[-1])
    assert len(shown) == len(measured[-1])
    assert np.corrcoef(shown.amplitude, measured[-1].amplitude)[0, 1] > 0.999


def test_cross_spectra_use_the_depth_that_a_companion_tells(rig):
    scene = simulate(scenario('small', {'records': 3, 'fading': ()}), 2)
    for item in scene.measurements:
        entry = item.measurement
        if isinstance(entry, ArrayDepth):
            rig.send('array_depth', write_array_depth(entry, make))
        else:
            rig.send('csdm', write_csdm(entry, make))
    assert len(rig.tables) == 3 and not rig.node._meter.refused
    estimate = read_estimate(rig.tables[-1])
    distance = np.abs(estimate.state[:, :1] - scene.truth[-1].depth)
    assert (distance.min(axis=1) < 0.2).all()


def blocks_of(seconds, *, hydrophones=8, rate=4000.0, block=0.5, seed=5):
    rng = np.random.default_rng(seed)
    n = round(block * rate)
    return [
        Pressure(
            stamp_ns=START + round(k * block * 1e9), frame_id='array',
            pressure=rng.normal(size=(n, hydrophones)), sample_rate=rate, reference_depth=70.0,
        )
        for k in range(round(seconds / block))
    ]  # fmt: skip


def test_pressure_makes_records_and_previews_between_them(make_bench):
    rig = rig_of(
        make_bench, *SMALL, 'snapshot_seconds:=0.4', 'record_seconds:=4.0', 'preview_seconds:=1.0'
    )
    rig.send(
        'pressure',
        *[write_pressure(attrs.evolve(block, scale=1e-3), make) for block in blocks_of(10.0)],
    )
    preview = [int(read_estimate(table).extras['preview'][0]) for table in rig.tables]
    assert preview.count(0) == 2
    assert preview.count(1) >= 2
    assert rig.node.tracker.counts['blocks'] == 20


RECORD = (
    'phones:=12', 'element_spacing:=0.36', 'frequency_max:=2000.0', 'snapshot_seconds:=0.5',
    'record_seconds:=19.5', 'depth_min:=122.0', 'depth_max:=172.0', 'particles:=2000',
)  # fmt: skip


@pytest.fixture(scope='module')
def received():
    """Twenty seconds of pressure over two layers, at 132 m and 136 m, in blocks of 0.5 s."""
    array = {'phones': 12, 'element_spacing': 0.36, 'sample_rate': 6000.0}
    times = {'records': 1, 'block_seconds': 0.5, 'record_seconds': 19.5}
    floor = {'array_depth': 73.5, 'first_depth': 130.0, 'layers': 2, 'first_amplitude': 0.6}
    sound = {'frequency_min': 50.0, 'frequency_max': 2000.0, 'amplitude': 0.6}
    scene = simulate(scenario('pressure', {**array, **times, **floor, **sound}), 1)
    assert scene.truth[0].depth == pytest.approx([131.6, 136.4], abs=0.05)
    return [write_pressure(item.measurement, make) for item in scene.measurements]


def spectra_of(messages, stamp_ns):
    """The cross-spectra of all the pressure, averaged at once."""
    blocks = [read_pressure(message) for message in messages]
    length, first, last = 3000, 25, 1000
    stream = SnapshotStream(length, length // 2, slice(first, last + 1))
    parts = stream.push(np.concatenate([block.pressure for block in blocks]))
    (average,) = BlockAverage(len(parts)).push(parts)
    return CrossSpectra(
        stamp_ns=stamp_ns, frame_id=blocks[0].frame_id,
        frequency=2.0 * np.arange(first, last + 1), csdm=average.csdm,
        snapshots=average.snapshots, reference_depth=blocks[0].reference_depth,
    )  # fmt: skip


def test_pressure_gives_the_estimate_of_its_cross_spectra(make_bench, received):
    rig = rig_of(make_bench, *RECORD)
    rig.send('pressure', *received)
    assert len(rig.tables) == 1 and not rig.node._meter.refused
    live = read_estimate(rig.tables[0])
    assert live.state[:, 0] == pytest.approx([131.6, 136.4], abs=0.2)
    response = rig.node.tracker.response
    rig.bench.call(Trigger, '/fathometer/reset', Trigger.Request())
    rig.send('csdm', write_csdm(spectra_of(received, live.stamp_ns), make))
    other = read_estimate(rig.tables[1])
    assert other.stamp_ns == live.stamp_ns
    columns, expected = live.columns(), other.columns()
    assert list(columns) == list(expected)
    # Single precision moves the response by a thousandth of its noise, and of 2000 particles that
    # begin blindly some draws with it.
    sigma = columns['sigma'][0]
    assert expected['sigma'][0] == pytest.approx(sigma, rel=1e-3)
    again = rig.node.tracker.response
    assert np.abs(again.amplitude - response.amplitude).max() < 1e-3 * sigma
    assert columns['depth'] == pytest.approx(expected['depth'], abs=0.02)


def test_lost_repeated_and_late_blocks_are_counted_and_survived(make_bench, received):
    rig = rig_of(make_bench, *RECORD)
    more = [write_pressure(item, make) for item in follow(received, 3)]
    blocks = [*received, *more]
    order = [0, 1, 1, 2, 4, 3, 5, *range(7, len(blocks))]
    rig.send('pressure', *[blocks[k] for k in order])
    counts = rig.node.tracker.counts
    assert counts['duplicate'] == 1 and counts['too_late'] == 1
    # Block 3 was missing when 4 came; 6 never came.
    assert counts['gaps'] == 2 and not counts['records_abandoned']
    assert counts['blocks'] == len(order) - 2
    assert len(rig.tables) == 1 and not rig.node._errors
    assert read_estimate(rig.tables[0]).state[0, 0] == pytest.approx(131.6, abs=0.2)


def follow(messages, count):
    """The first `count` blocks again, as if they came after the last."""
    blocks = [read_pressure(message) for message in messages]
    end = blocks[-1].stamp_ns + blocks[-1].duration_ns
    return [
        attrs.evolve(block, stamp_ns=block.stamp_ns - blocks[0].stamp_ns + end)
        for block in blocks[:count]
    ]


def test_blocks_of_a_whole_array_arrive_without_loss(make_bench):
    """1.4 s of 32 hydrophones at 12 kHz, 2 MB each, ten times as fast as a driver publishes."""
    rig = rig_of(make_bench, 'particles:=200', 'record_seconds:=28.0')
    driver = rig.bench.peer.create_publisher(PointCloud2, '/pressure', input_qos(50))
    rig.bench.spin_until(driver.get_subscription_count)
    blocks = blocks_of(28.0, hydrophones=32, rate=12000.0, block=1.4)
    for message in [write_pressure(block, make) for block in blocks]:
        driver.publish(message)
        rig.bench.executor.spin_once(timeout_sec=0.02)
    rig.bench.spin_until(lambda: rig.node._meter.received['pressure'] == len(blocks), 30.0)
    assert rig.node.tracker.counts['blocks'] == len(blocks)
    assert rig.node.tracker.counts['gaps'] == 0
    assert rig.node.tracker.counts['used'] == 1
    assert not rig.node._meter.refused


@pytest.mark.usefixtures('quick')
def test_diagnostics_name_what_was_wrong_and_tracking_goes_on(make_bench):
    rig = rig_of(make_bench, *SMALL, 'loading:=0.0')
    received = rig.bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    scene = simulate(scenario('small', {'records': 4, 'fading': (), 'depth_companion': False}), 2)
    records = [item.measurement for item in scene.measurements]
    for k, record in enumerate(records):
        csdm = np.array(record.csdm)
        csdm[:, 5], csdm[:, :, 5] = np.nan, np.nan
        rig.send('csdm', write_csdm(attrs.evolve(record, csdm=csdm) if k else record, make))
    late = records[-1].stamp_ns + 10**9
    rig.send(
        'csdm',
        write_csdm(
            attrs.evolve(records[0], stamp_ns=late, csdm=np.ones_like(records[0].csdm)), make
        ),
    )
    upper = np.triu(0.5 * np.ones((8, 8))) + 0.5 * np.eye(8)
    csdm = np.broadcast_to(upper.astype(np.complex64), (6, 8, 8)).reshape(6, -1).view(np.float32)
    rig.send('csdm', table(frequency=np.float32(100.0 + np.arange(6)), csdm=csdm))

    def newest():
        return {
            pair.key: pair.value
            for item in received[-1:]
            for s in item.status
            for pair in s.values
        }

    rig.bench.spin_until(lambda: newest().get('refused: not_hermitian') == '1')
    values = newest()
    assert values['count: singular'] == '1' and values['count: dead_hydrophones_masked'] == '3'
    assert values['count: used'] == '4' and len(rig.tables) == 4 and not rig.node._errors
    offset = np.abs(read_estimate(rig.tables[-1]).state[:, :1] - scene.truth[-1].depth)
    assert (offset.min(axis=1) < 0.2).all()
