# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Images of single drivers and simulators, and what of them is refused."""

from helpers import marine
import numpy as np
import pytest

from msg_adapters.inputs import inputs_of
from msg_adapters.sonar_images import write_picture
from sonar_imm.measurements import Rejection, SonarImage
from sonar_imm_tools.recordings.messages import ros_message

IMAGE = inputs_of('fls_detector')[0]
GEOMETRY = {'image_near_range': 2.0, 'image_far_range': 22.0, 'image_fov_deg': 60.0}
PIXELS = np.arange(8 * 6).reshape(8, 6)  # 8 ranges, 6 beams


def read(message, **settings):
    return IMAGE.reader(message.__msgtype__, 'enu', settings)(marine.sent(message))


def refused(message, **settings):
    with pytest.raises(Rejection) as caught:
        IMAGE.reader(message.__msgtype__, 'enu', settings)(message)
    assert caught.value.sentence and '\n' not in caught.value.sentence
    return caught.value.reason


# -- Oculus -------------------------------------------------------------------------------------


def oculus(gains=None, size=1, packet=b'', **changes):
    samples = PIXELS.astype(f'<u{size}')
    rows = [row.tobytes() for row in samples]
    if gains is not None:
        rows = [np.uint32(gain).tobytes() + row for gain, row in zip(gains, rows)]
    values = {
        'header': marine.header(),
        'ping_id': 1,
        'ping_firing_date': 2,
        'range': 4.0,
        'gain_percent': 50.0,
        'frequency': 1.2e6,
        'speed_of_sound_used': 1500.0,
        'range_resolution': 0.5,
        'temperature': 10.0,
        'pressure': 1.0,
        'master_mode': 1,
        'has_gains': gains is not None,
        'n_ranges': 8,
        'n_beams': 6,
        'step': len(rows[0]),
        'sample_size': size,
        'bearings': np.array([-3000, -1500, -500, 500, 1500, 3000], np.int16),
        'ping_data': np.frombuffer(packet + b''.join(rows), np.uint8),
        **changes,
    }
    return marine.make('oculus_interfaces/msg/Ping', **values)


@pytest.mark.parametrize('size', [1, 2, 4])
def test_an_oculus_ping_is_read_row_by_row(size):
    image = read(oculus(size=size))
    np.testing.assert_array_equal(image.amplitude, PIXELS)
    assert image.range == pytest.approx(0.5 * np.arange(8) + 0.25)
    # Hundredths of a degree, positive to starboard.
    assert np.degrees(image.bearing) == pytest.approx([30.0, 15.0, 5.0, -5.0, -15.0, -30.0])
    assert image.stamp_ns == 100_000_000_005 and image.frame_id == 'sonar'


def test_gains_of_an_oculus_are_divided_out():
    gains = np.array([1, 4, 9, 16, 25, 36, 49, 0])
    image = read(oculus(gains=gains))
    wanted = PIXELS / np.sqrt(np.maximum(gains, 1))[:, None]
    np.testing.assert_allclose(image.amplitude, wanted)


def test_the_whole_packet_of_an_oculus_is_read_from_its_end():
    header = b'\x53\x4f' + bytes(range(200))
    np.testing.assert_array_equal(read(oculus(packet=header)).amplitude, PIXELS)
    assert refused(oculus(packet=b'xx' + header)) == 'short_data'  # neither image nor packet


@pytest.mark.parametrize(
    'changes, code',
    [
        ({'ping_data': np.zeros(47, np.uint8)}, 'short_data'),
        ({'ping_data': np.zeros(0, np.uint8)}, 'short_data'),
        ({'step': 3, 'ping_data': np.zeros(24, np.uint8)}, 'short_data'),
        ({'step': 2**32 - 1}, 'short_data'),
        (
            {'n_ranges': 65535, 'n_beams': 65535, 'bearings': np.zeros(65535, np.int16)},
            'too_large',
        ),
        ({'n_beams': 5}, 'bad_shape'),
        ({'bearings': np.zeros(0, np.int16)}, 'bad_shape'),
        ({'sample_size': 3}, 'bad_field'),
        ({'sample_size': 0}, 'bad_field'),
        ({'range_resolution': np.nan}, 'out_of_range'),
        ({'range_resolution': 0.0}, 'out_of_range'),
        ({'range_resolution': 1e300}, 'out_of_range'),
    ],
)
def test_an_oculus_ping_that_cannot_be_is_refused(changes, code):
    assert refused(oculus(**changes)) == code


# -- Ping360 ------------------------------------------------------------------------------------


def ping360(angle=0.3, **changes):
    values = {
        'header': marine.header(),
        'angle': angle,
        'gain': 1,
        'number_of_samples': 4,
        'transmit_frequency': 740,
        'speed_of_sound': 1500,
        'range': 20,
        'intensities': np.array([1, 200, 3, 4], np.uint8),
        **changes,
    }
    return marine.make('ping360_sonar_msgs/msg/SonarEcho', **values)


def test_an_echo_of_a_ping360_is_one_direction_of_a_sweep():
    image = read(ping360(angle=2.0 * np.pi - 0.25))
    assert image.scanning and image.bearing == pytest.approx([-0.25], abs=1e-6)
    assert image.range.tolist() == [5.0, 10.0, 15.0, 20.0]
    assert image.amplitude.tolist() == [[1.0], [200.0], [3.0], [4.0]]


@pytest.mark.parametrize(
    'changes, code',
    [
        ({'intensities': np.zeros(0, np.uint8)}, 'short_data'),
        ({'range': 0}, 'out_of_range'),
        ({'angle': np.nan}, 'out_of_range'),
        ({'angle': 1e30}, 'out_of_range'),
    ],
)
def test_an_echo_that_cannot_be_is_refused(changes, code):
    assert refused(ping360(**changes)) == code


# -- images whose geometry is a parameter --------------------------------------------------------


def sonoptix(sizes=(8, 6), offset=0, data=None):
    samples = np.concatenate([np.zeros(offset), PIXELS.ravel()]) if data is None else data
    return marine.make(
        'sensors/msg/SonoptixECHO',
        header=marine.header(),
        array_data=marine.make(
            'std_msgs/msg/Float32MultiArray',
            layout=marine.make(
                'std_msgs/msg/MultiArrayLayout',
                dim=[
                    marine.make('std_msgs/msg/MultiArrayDimension', label='', size=size, stride=0)
                    for size in sizes
                ],
                data_offset=offset,
            ),
            data=marine.floats(samples),
        ),
    )


def picture(pixels=PIXELS, encoding='mono8', dtype='u1', big=False, pad=0, **changes):
    rows = pixels.astype(('>' if big else '<') + dtype)
    data = b''.join(row.tobytes() + bytes(pad) for row in rows)
    values = {
        'header': marine.header(),
        'height': pixels.shape[0],
        'width': pixels.shape[1],
        'encoding': encoding,
        'is_bigendian': int(big),
        'step': pixels.shape[1] * rows.itemsize + pad,
        'data': np.frombuffer(data, np.uint8),
        **changes,
    }
    return marine.make('sensor_msgs/msg/Image', **values)


@pytest.mark.parametrize('message', [sonoptix(), sonoptix(offset=3), picture()])
def test_ranges_and_directions_come_from_parameters(message):
    image = read(message, **GEOMETRY)
    np.testing.assert_array_equal(image.amplitude, PIXELS)
    assert image.range == pytest.approx(3.25 + 2.5 * np.arange(8))
    assert np.degrees(image.bearing) == pytest.approx([25.0, 15.0, 5.0, -5.0, -15.0, -25.0])
    turned = read(message, **GEOMETRY, image_first_beam='starboard', image_first_range='far')
    np.testing.assert_array_equal(turned.amplitude, PIXELS[::-1, ::-1])
    assert turned.bearing[0] > 0.0 and turned.range[0] < turned.range[-1]
    assert refused(message) == 'no_geometry'
    assert refused(message, image_far_range=20.0) == 'no_geometry'


def test_an_image_of_beam_rows_is_turned():
    image = read(picture(PIXELS.T), **GEOMETRY, image_order='beam_major')
    np.testing.assert_array_equal(image.amplitude, PIXELS)


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize(
    'encoding, dtype',
    [('mono8', 'u1'), ('8UC1', 'u1'), ('mono16', 'u2'), ('32FC1', 'f4'), ('64FC1', 'f8')],
)
def test_pixels_of_all_kinds_paddings_and_byte_orders_are_read(encoding, dtype, big):
    image = read(picture(encoding=encoding, dtype=dtype, big=big, pad=5), **GEOMETRY)
    np.testing.assert_array_equal(image.amplitude, PIXELS)


@pytest.mark.parametrize(
    'changes, code',
    [
        ({'encoding': 'rgb8'}, 'bad_field'),
        ({'encoding': ''}, 'bad_field'),
        ({'data': np.zeros(47, np.uint8)}, 'short_data'),
        ({'step': 3}, 'short_data'),
        ({'height': 2**32 - 1}, 'too_large'),
        ({'width': 2**32 - 1, 'height': 2**32 - 1}, 'too_large'),
        ({'step': 2**32 - 1}, 'short_data'),
    ],
)
def test_a_picture_that_cannot_be_is_refused(changes, code):
    assert refused(picture(**changes), **GEOMETRY) == code


def test_pictures_in_a_gap_of_time_and_without_pixels():
    message = picture(pixels=np.zeros((0, 0), int))
    assert read(message, **GEOMETRY).amplitude.shape == (0, 0)
    message.header.stamp.sec = 0
    message.header.stamp.nanosec = 0
    assert refused(message, **GEOMETRY) == 'bad_stamp'


@pytest.mark.parametrize(
    'message, code',
    [
        (sonoptix(sizes=(8,)), 'bad_shape'),
        (sonoptix(sizes=(8, 6, 1)), 'bad_shape'),
        (sonoptix(sizes=(8, 7)), 'short_data'),
        (sonoptix(sizes=(2**32 - 1, 2**32 - 1)), 'too_large'),
        (sonoptix(data=[1.0]), 'short_data'),
    ],
)
def test_an_array_that_cannot_be_is_refused(message, code):
    assert refused(message, **GEOMETRY) == code


@pytest.mark.parametrize('factor, encoding', [(1.0, 'mono8'), (0.5, '32FC1'), (300.0, '32FC1')])
def test_a_written_picture_is_read_again(factor, encoding):
    image = SonarImage(
        stamp_ns=7,
        range=3.25 + 2.5 * np.arange(8),
        bearing=np.radians([25.0, 15.0, 5.0, -5.0, -15.0, -25.0]),
        amplitude=factor * PIXELS,
        frame_id='sonar',
    )
    message = write_picture(image, ros_message)
    assert message.encoding == encoding
    again = read(message, **GEOMETRY)
    np.testing.assert_allclose(again.amplitude, image.amplitude)
    np.testing.assert_allclose(again.range, image.range)
    assert (again.stamp_ns, again.frame_id) == (7, 'sonar')
