"""The detector node on images as a driver would send them."""

from helpers import marine
import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2

from msg_adapters.detections import read_detections
from sonar_imm.nodes import fls_detector
from sonar_imm.nodes.fls_detector import FlsDetectorNode
from sonar_imm.parameters import ConfigError


def image(spoilt=False):
    samples = np.ones((50, 9), np.uint8)
    samples[30, 2] = 250
    bearing = np.radians(np.linspace(20.0, -20.0, 9))
    return marine.make(
        'ProjectedSonarImage',
        header=marine.header(),
        ping_info=marine.ping_info(),
        beam_directions=marine.vectors(
            np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(9)])
        ),
        ranges=marine.floats(np.arange(1.0, 51.0)),
        image=marine.make(
            'SonarImageData',
            is_bigendian=False,
            dtype=0,
            beam_count=9,
            data=samples.ravel()[: 449 if spoilt else 450],
        ),
    )


def test_without_the_message_package_the_node_says_what_is_missing(make_bench):
    bench = make_bench()
    with pytest.raises(ConfigError, match='ProjectedSonarImage is not installed'):
        bench.add(FlsDetectorNode(context=bench.context))


def test_every_image_is_answered_and_a_bad_one_refused(make_bench, monkeypatch):
    # The package is not installed here: any installed type subscribes, images are handed over.
    bench = make_bench()
    known = fls_detector.message_class
    monkeypatch.setattr(
        fls_detector,
        'message_class',
        lambda name: known('sensor_msgs/msg/Image' if name.startswith('marine') else name),
    )
    node = bench.add(FlsDetectorNode(context=bench.context))
    heard = bench.listen(PointCloud2, '/detections')
    bench.spin_until(lambda: node.count_subscribers('/detections'))
    node.receive(image(spoilt=True))
    node.receive(image())
    bench.spin_until(lambda: heard)
    ping = read_detections(heard[0])
    assert ping.range.tolist() == [31.0] and ping.bearing == pytest.approx([np.radians(10.0)])
    assert node.refused == {'short_data': 1} and len(heard) == 1
