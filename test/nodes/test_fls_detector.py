# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The detector node on images as a driver would send them."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from helpers.node_bench import values_of
import numpy as np
import pytest
from sensor_msgs.msg import Image, PointCloud2

from msg_adapters.detections import read_detections
from msg_adapters.sonar_images import write_picture
from msg_adapters.table import decode_table
from sonar_imm.measurements import SonarImage
from sonar_imm.nodes.fls_detector import FlsDetectorNode
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import latched_qos
from sonar_imm.parameters import ConfigError

PARAMETERS = (
    "input_types:=['image=sensor_msgs/msg/Image']", 'image_far_range:=50.0', 'image_fov_deg:=40.0',
)  # fmt: skip


def picture(second=100, spoilt=False, frame_id='sonar'):
    pixels = np.ones((50, 9))
    pixels[30, 2] = 250.0
    image = SonarImage(
        stamp_ns=second * 10**9, range=np.arange(50.0), bearing=np.arange(9.0), amplitude=pixels,
        frame_id=frame_id,
    )  # fmt: skip
    message = write_picture(image, make)
    if spoilt:
        message.data = message.data[:-1]
    return message


def counts(message):
    return {name: int(column[0]) for name, column in decode_table(message).items()}


SCAN = "input_types:=['image=sensor_msgs/msg/LaserScan']"


@pytest.mark.parametrize(
    'given, sentence',
    [([], 'ProjectedSonarImage is not installed'), ([SCAN], 'image must be one of')],
)
def test_what_cannot_be_heard_is_one_sentence(make_bench, given, sentence):
    with pytest.raises(ConfigError, match=sentence):
        make_bench(p=given).start(FlsDetectorNode)


def test_every_image_is_answered_and_a_bad_one_refused(make_bench):
    bench = make_bench(p=PARAMETERS)
    answers = bench.listen(PointCloud2, '/fls_detector/processed', latched_qos())
    received = bench.listen(PointCloud2, '/detections')
    given = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.start(FlsDetectorNode)
    sender = bench.peer.create_publisher(Image, '/image', 10)
    bench.spin_until(sender.get_subscription_count)
    bench.spin_until(lambda: answers and counts(answers[-1])['listeners'] == 1)
    images = picture(), picture(101, spoilt=True), picture(101, frame_id='stern'), picture(102)
    for message in images:
        before = len(answers)
        sender.publish(message)
        bench.spin_until(lambda before=before: len(answers) > before)
    bench.spin_until(lambda: len(received) == 2)
    ping = read_detections(received[0])
    assert ping.range == pytest.approx([30.5], abs=0.1)
    assert ping.bearing == pytest.approx([np.radians(40.0 * (0.5 - 2.5 / 9.0))], abs=0.01)
    assert np.isfinite([ping.var_range[0], ping.extent_bearing[0], ping.intensity[0]]).all()
    assert [item.header.stamp.sec for item in received] == [100, 102]
    assert node.refused == {'short_data': 1, 'frame': 1}
    due = {'messages': 4, 'refused': 2, 'estimates': 2, 'listeners': 1}
    assert counts(answers[-1]) == due
    assert answers[-1].header.stamp.sec == 102
    before = len(given)
    bench.spin_until(lambda: len(given) > before + 1)
    values = values_of(given[-1])
    assert values['image received'] == '4' and values['refused: short_data'] == '1'
    assert values['count: published'] == '2'


def test_without_images_the_node_waits_for_them(make_bench):
    bench = make_bench(p=PARAMETERS)
    received = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.start(FlsDetectorNode)
    # What comes before is that it loads or compiles kernels.
    bench.spin_until(
        lambda: received and received[-1].status[0].message == 'no message yet on /image'
    )
    assert received[-1].status[0].level == received[-1].status[1].level == DiagnosticStatus.STALE
    node.receive('image', picture())
    bench.spin_until(lambda: received[-1].status[0].message == 'receiving')


def test_a_mistake_in_the_detector_ends_neither_node_nor_answers(make_bench, monkeypatch):
    bench = make_bench(p=PARAMETERS)
    node = bench.start(FlsDetectorNode)
    answers = bench.listen(PointCloud2, '/fls_detector/processed', latched_qos())

    def broken(image):
        raise ZeroDivisionError

    monkeypatch.setattr(node._detector, 'process', broken)
    node.receive('image', picture())
    bench.spin_until(lambda: answers and counts(answers[-1])['messages'] == 1)
    node.receive('image', picture(101))
    bench.spin_until(lambda: counts(answers[-1])['messages'] == 2)
    assert counts(answers[-1])['estimates'] == 1
