# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The detector node on images as a driver would send them."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from helpers import marine
import numpy as np
import pytest
from sensor_msgs.msg import Image, PointCloud2

from msg_adapters.detections import read_detections
from msg_adapters.sonar_images import write_picture
from msg_adapters.table import decode_table
from sonar_imm.measurements import SonarImage
from sonar_imm.nodes import base
from sonar_imm.nodes.fls_detector import FlsDetectorNode
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import latched_qos
from sonar_imm.parameters import ConfigError

PARAMETERS = (
    "-p input_types:=['image=sensor_msgs/msg/Image'] -p image_far_range:=50.0 "
    '-p image_fov_deg:=40.0'
).split()


def pixels():
    samples = np.ones((50, 9), np.uint8)
    samples[30, 2] = 250
    return samples


def picture(second=100, spoilt=False, frame_id='sonar'):
    message = write_picture(
        SonarImage(
            stamp_ns=second * 10**9, range=np.arange(50.0), bearing=np.arange(9.0),
            amplitude=pixels().astype(float), frame_id=frame_id,
        ),
        make,
    )  # fmt: skip
    if spoilt:
        message.data = message.data[:-1]
    return message


def projected():
    bearing = np.radians(np.linspace(20.0, -20.0, 9))
    directions = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(9)])
    return marine.make(
        'ProjectedSonarImage', header=marine.header(), ping_info=marine.ping_info(),
        beam_directions=marine.vectors(directions), ranges=marine.floats(np.arange(1.0, 51.0)),
        image=marine.image_data(pixels(), 0, 9),
    )  # fmt: skip


def counts(message):
    return {name: int(column[0]) for name, column in decode_table(message).items()}


def test_without_the_message_package_the_node_says_what_is_missing(make_bench):
    bench = make_bench()
    with pytest.raises(ConfigError, match='ProjectedSonarImage is not installed'):
        bench.add(FlsDetectorNode(context=bench.context))


def test_every_image_is_answered_and_a_bad_one_refused(make_bench):
    bench = make_bench(*PARAMETERS)
    answers = bench.listen(PointCloud2, '/fls_detector/processed', latched_qos())
    received = bench.listen(PointCloud2, '/detections')
    given = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.add(FlsDetectorNode(context=bench.context))
    sender = bench.peer.create_publisher(Image, '/image', 10)
    bench.spin_until(sender.get_subscription_count)
    bench.spin_until(lambda: answers and counts(answers[-1])['listeners'] == 1)
    for message in (picture(), picture(101, spoilt=True), picture(102)):
        before = len(answers)
        sender.publish(message)
        bench.spin_until(lambda before=before: len(answers) > before)
    bench.spin_until(lambda: len(received) == 2)
    ping = read_detections(received[0])
    assert ping.range == pytest.approx([30.5], abs=0.1)
    assert ping.bearing == pytest.approx([np.radians(40.0 * (0.5 - 2.5 / 9.0))], abs=0.01)
    assert np.isfinite([ping.var_range[0], ping.extent_bearing[0], ping.intensity[0]]).all()
    assert [item.header.stamp.sec for item in received] == [100, 102]
    assert node.refused == {'short_data': 1}
    assert counts(answers[-1]) == {
        'messages': 3, 'refused': 1, 'estimates': 2, 'listeners': 1,
    }  # fmt: skip
    assert answers[-1].header.stamp.sec == 102
    before = len(given)
    bench.spin_until(lambda: len(given) > before + 1)
    values = {pair.key: pair.value for pair in given[-1].status[0].values}
    assert values['image received'] == '3' and values['refused: short_data'] == '1'
    assert {pair.key: pair.value for pair in given[-1].status[1].values}['count: published'] == '2'


def test_images_of_another_sonar_are_refused(make_bench):
    node = FlsDetectorNode(context=make_bench(*PARAMETERS).context)
    for second, frame_id in ((100, 'sonar'), (101, 'stern_sonar'), (102, 'sonar')):
        node.receive('image', picture(second, frame_id=frame_id))
    assert node.refused == {'frame': 1} and node._published == 2
    node.destroy_node()


def test_without_images_the_node_waits_for_them(make_bench):
    bench = make_bench(*PARAMETERS)
    received = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.add(FlsDetectorNode(context=bench.context))
    # What comes before is that it loads or compiles kernels.
    bench.spin_until(
        lambda: received and received[-1].status[0].message == 'no message yet on /image'
    )
    assert received[-1].status[0].level == received[-1].status[1].level == DiagnosticStatus.STALE
    node.receive('image', picture())
    bench.spin_until(lambda: received[-1].status[0].message == 'receiving')


def test_a_package_that_is_there_is_used(make_bench, monkeypatch):
    # The package is not installed here: any installed type subscribes, images are handed over.
    bench = make_bench()
    known = base.message_class
    monkeypatch.setattr(
        base,
        'message_class',
        lambda name: known('sensor_msgs/msg/Image' if name.startswith('marine') else name),
    )
    node = bench.add(FlsDetectorNode(context=bench.context))
    received = bench.listen(PointCloud2, '/detections')
    bench.spin_until(lambda: node.count_subscribers('/detections'))
    answers = bench.listen(PointCloud2, '/fls_detector/processed', latched_qos())
    bench.spin_until(lambda: answers and counts(answers[-1])['listeners'])
    message = projected()
    message.header.stamp = make('builtin_interfaces/msg/Time', sec=100, nanosec=5)
    node.receive('image', message)
    bench.spin_until(lambda: received)
    ping = read_detections(received[0])
    assert ping.range == pytest.approx([31.0], abs=0.1)
    assert ping.bearing == pytest.approx([np.radians(10.0)], abs=0.02)


def test_a_mistake_in_the_detector_ends_neither_node_nor_answers(make_bench, monkeypatch):
    bench = make_bench(*PARAMETERS)
    node = bench.add(FlsDetectorNode(context=bench.context))
    answers = bench.listen(PointCloud2, '/fls_detector/processed', latched_qos())

    def broken(image):
        raise ZeroDivisionError

    monkeypatch.setattr(node._detector, 'process', broken)
    node.receive('image', picture())
    bench.spin_until(lambda: answers and counts(answers[-1])['messages'] == 1)
    node.receive('image', picture(101))
    bench.spin_until(lambda: counts(answers[-1])['messages'] == 2)
    assert counts(answers[-1])['estimates'] == 1


def test_a_wrong_parameter_is_named(make_bench):
    bench = make_bench('-p', "input_types:=['image=sensor_msgs/msg/LaserScan']")
    with pytest.raises(ConfigError, match='input_types: image must be one of'):
        bench.add(FlsDetectorNode(context=bench.context))
