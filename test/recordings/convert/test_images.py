# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From a bag of sonar images to one the obstacle tracker hears."""

import json

from helpers import marine
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from msg_adapters.navigation import write_navigation
from sonar_imm.measurements import Detections, Navigation, Rejection
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagReader

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
                    stamp_ns=second * 10**9, position=[0.5 * second, 0.0, -20.0],
                    orientation=[0.0, 0.0, 0.0, 1.0], frame_id='odom',
                ),
                ros_message,
            )  # fmt: skip
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
    content = json.loads(capsys.readouterr().out)
    assert content['messages'] == {'/detections': 5, '/nav': 6} and content['bad_rows'] == 1
    assert '/fls/image #' in content['problems'][0]
    with BagReader(out) as reader:
        received = [item.measurement for item in measurements_of(reader, 'obstacle')]
    assert not any(isinstance(item, Rejection) for item in received)
    pings = [item for item in received if isinstance(item, Detections)]
    assert [len(ping) for ping in pings] == [1, 1, 1, 0, 1]
    assert [ping.range[0] for ping in pings if len(ping)] == [31.5, 31.0, 30.5, 29.5]
    assert pings[0].bearing[0] == pytest.approx(BEARINGS[5]) and BEARINGS[5] > 0.0
    assert sum(isinstance(item, Navigation) for item in received) == 6


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


def write(path, messages):
    """A bag with the messages of (topic, message, log time)."""
    types = marine.typestore()
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {}
        for topic, message, log_ns in messages:
            name = message.__msgtype__
            if topic not in links:
                links[topic] = writer.add_connection(topic, name, typestore=types)
            writer.write(links[topic], log_ns, types.serialize_cdr(message, name))
    return path


def oculus(second):
    rng = np.random.default_rng(second)
    samples = np.round(3.0 * np.sqrt(rng.exponential(size=(100, 41)))).astype('u1')
    samples[50, 30] = 200
    return marine.make(
        'oculus_interfaces/msg/Ping',
        header=marine.header(sec=second),
        **dict.fromkeys(('ping_id', 'ping_firing_date', 'master_mode'), 1),
        **dict.fromkeys(('range', 'gain_percent', 'frequency', 'speed_of_sound_used'), 1.0),
        **dict.fromkeys(('temperature', 'pressure'), 1.0),
        range_resolution=0.5,
        has_gains=False,
        n_ranges=100,
        n_beams=41,
        step=41,
        sample_size=1,
        bearings=np.linspace(-2000, 2000, 41).astype(np.int16),
        ping_data=samples.ravel(),
    )


def ping360(angle, second):
    rng = np.random.default_rng([1, round(1000 * second)])
    samples = 3.0 * np.sqrt(rng.exponential(size=200))
    samples += (
        200.0
        * np.exp(-np.square((np.arange(200) - 100) / 2.0))
        * (np.exp(-np.square((angle - 0.2) / 0.04)))
    )
    message = marine.make(
        'ping360_sonar_msgs/msg/SonarEcho', header=marine.header(sec=int(second)),
        angle=float(angle % (2.0 * np.pi)), gain=1, number_of_samples=200, transmit_frequency=740,
        speed_of_sound=1500, range=20, intensities=np.minimum(samples, 255).astype('u1'),
    )  # fmt: skip
    message.header.stamp.nanosec = round(second % 1.0 * 1e9)
    return message


def test_pings_of_an_oculus_in_a_bag_become_detections(tmp_path, capsys):
    pings = [('/oculus/ping', oculus(k), k * 10**9) for k in range(1, 4)]
    bag, out = write(tmp_path / 'bag', pings), tmp_path / 'out'
    assert main(['convert', 'images', str(bag), str(out), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['messages'] == {'/detections': 3}
    with BagReader(out) as reader:
        found = [item.measurement for item in measurements_of(reader, 'obstacle')]
    for ping in found:
        assert ping.range == pytest.approx([25.25], abs=0.1)
        assert ping.bearing == pytest.approx([-np.radians(10.0)], abs=0.01)


def test_directions_of_a_ping360_in_a_bag_are_gathered_into_sweeps(tmp_path, capsys):
    angles = np.arange(-0.6, 0.6, np.radians(1.8))
    scan = np.concatenate([angles, angles[-2::-1], angles[1:]])
    echoes = [
        ('/scan_echo', ping360(angle, 10.0 + 0.1 * k), int((10.0 + 0.1 * k) * 1e9))
        for k, angle in enumerate(scan)
    ]
    bag, out = write(tmp_path / 'bag', echoes), tmp_path / 'out'
    settings = ['--set', 'beam_width_deg=2', '--set', 'range_resolution=0.4']
    assert main(['convert', 'images', str(bag), str(out), *settings, '--json']) == 0
    content = json.loads(capsys.readouterr().out)
    assert content['messages'] == {'/detections': 2} and content['rows'] == len(scan)
    with BagReader(out) as reader:
        found = [item.measurement for item in measurements_of(reader, 'obstacle')]
    for ping in found:
        assert ping.range == pytest.approx([10.1], abs=0.2)
        assert ping.bearing == pytest.approx([0.2], abs=0.02)


def test_several_topics_of_images_have_to_be_chosen_from(tmp_path, capsys):
    pings = [(f'/{side}/ping', oculus(1), 10**9) for side in ('port', 'starboard')]
    bag = write(tmp_path / 'bag', pings)
    assert main(['convert', 'images', str(bag), str(tmp_path / 'out')]) in (1, 2)
    assert '--topic /port/ping' in capsys.readouterr().err
    arguments = ['convert', 'images', str(bag), str(tmp_path / 'one'), '--topic']
    assert main([*arguments, '/starboard/ping']) == 0
    assert main([*arguments[:-2], str(tmp_path / 'none'), '--topic', '/nowhere']) in (1, 2)


def test_what_the_sonar_says_beside_its_images_is_used_from_its_message_on(tmp_path, capsys):
    message = marine.driver_message(
        'marine_interfaces/msg/SonarInfo',
        header=marine.header(),
        intensity_quantity=3,
        intensity_scale=1,
        **dict.fromkeys(('pulse_lengths', 'bandwidths'), marine.floats([])),
        tx_signal_types=np.zeros(0, np.uint8),
    )
    pings = [('/oculus/ping', oculus(k), k * 10**9) for k in range(1, 4)]
    bag = write(tmp_path / 'bag', [*pings, ('/oculus/sonar_info', message, 25 * 10**8)])
    with BagReader(bag) as reader:
        received = [item.measurement for item in measurements_of(reader, 'obstacle')]
    strengths = [item.intensity[0] for item in received if isinstance(item, Detections)]
    assert strengths == pytest.approx([200.0, 200.0, np.sqrt(200.0)])
    out = tmp_path / 'out'
    assert main(['convert', 'images', str(bag), str(out), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['messages'] == {'/detections': 3}
