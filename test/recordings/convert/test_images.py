"""From a bag of sonar images to one the obstacle tracker hears."""

import json

from helpers import marine
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from msg_adapters.navigation import write_navigation
from sonar_imm.cli import main
from sonar_imm.measurements import Detections, Navigation, Rejection
from sonar_imm.recordings.measurements import measurements_of
from sonar_imm.recordings.messages import ros_message
from sonar_imm.recordings.reader import BagReader

BEARINGS = np.radians(np.linspace(20.0, -20.0, 41))


def image(second, row, spoilt=False):
    """Beam-major, an echo at row / 2 + 2 m to port, none for row 0."""
    rng = np.random.default_rng(second)
    samples = np.round(3.0 * np.sqrt(rng.exponential(size=(41, 100))))
    if row:
        samples[5, row] = 200.0
    payload = np.frombuffer(samples.astype('u1').tobytes(), np.uint8)
    return marine.make(
        'ProjectedSonarImage',
        header=marine.header(sec=second),
        ping_info=marine.ping_info(),
        beam_directions=marine.vectors(
            np.column_stack([np.zeros(41), -np.sin(BEARINGS), np.cos(BEARINGS)])
        ),
        ranges=marine.floats(2.0 + 0.5 * np.arange(100)),
        image=marine.make(
            'SonarImageData',
            is_bigendian=False,
            dtype=0,
            beam_count=41,
            data=payload[:-1] if spoilt else payload,
        ),
    )


@pytest.fixture
def bag(tmp_path):
    path, types = tmp_path / 'survey', marine.typestore()
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        pictures = writer.add_connection(
            '/fls/image', marine.PACKAGE + 'ProjectedSonarImage', typestore=types
        )
        poses = writer.add_connection('/auv/odometry', 'nav_msgs/msg/Odometry', typestore=types)
        for second in range(1, 7):
            message = image(second, 0 if second == 4 else 60 - second, spoilt=second == 6)
            writer.write(
                pictures, second * 10**9, types.serialize_cdr(message, message.__msgtype__)
            )
            pose = write_navigation(
                Navigation(
                    stamp_ns=second * 10**9,
                    position=[0.5 * second, 0.0, -20.0],
                    orientation=[0.0, 0.0, 0.0, 1.0],
                    frame_id='odom',
                ),
                ros_message,
            )
            writer.write(poses, second * 10**9 + 1, types.serialize_cdr(pose, pose.__msgtype__))
    return path


def test_images_become_pings_also_empty_ones_and_navigation_comes_along(bag, tmp_path, capsys):
    out = tmp_path / 'detections'
    assert (
        main(
            ['convert', 'images', str(bag), str(out), '--set', 'image_order=beam_major', '--json']
        )
        == 0
    )
    told = json.loads(capsys.readouterr().out)
    assert told['messages'] == {'/detections': 5, '/nav': 6} and told['bad_rows'] == 1
    assert '/fls/image #' in told['problems'][0]
    with BagReader(out) as reader:
        heard = [one.measurement for one in measurements_of(reader, 'obstacle')]
    assert not any(isinstance(one, Rejection) for one in heard)
    pings = [one for one in heard if isinstance(one, Detections)]
    assert [len(ping) for ping in pings] == [1, 1, 1, 0, 1]
    assert [ping.range[0] for ping in pings if len(ping)] == [31.5, 31.0, 30.5, 29.5]
    assert pings[0].bearing[0] == pytest.approx(BEARINGS[5]) and BEARINGS[5] > 0.0
    assert sum(isinstance(one, Navigation) for one in heard) == 6


def test_a_bag_without_images_and_a_wrong_setting_are_one_sentence(bag, tmp_path, capsys):
    out = str(tmp_path / 'out')
    assert main(['convert', 'images', str(bag), out, '--set', 'image_order=sideways']) == 2
    assert 'image_order' in capsys.readouterr().err
    first = str(tmp_path / 'first')
    assert main(['convert', 'images', str(bag), first, '--set', 'image_order=beam_major']) == 0
    capsys.readouterr()
    assert main(['convert', 'images', first, out]) in (1, 2)
    error = capsys.readouterr().err
    assert 'has no topic with' in error and len(error.splitlines()) == 1
