# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Images of both kinds in both orders, and the echoes in them."""

import itertools

from attrs import asdict, evolve
from helpers import marine
from helpers.refusals import reason as why
import numpy as np
import pytest

from msg_adapters.fans import unfolded
from msg_adapters.inputs import inputs_of
from msg_adapters.sonar_images import DTYPES, write_picture
from sonar_imm.measurements import Rejection, SonarImage, SonarInfo
from sonar_imm.measurements.obstacle import MAX_IMAGE_CELLS
from sonar_imm.trackers.obstacle import detector
from sonar_imm.trackers.obstacle.detector import DetectorConfig, ImageDetector
from sonar_imm_tools.recordings.messages import ros_message

IMAGE, INFO = inputs_of('fls_detector')

BEARINGS = np.radians(np.linspace(20.0, -20.0, 41))  # port first
RANGES = 2.0 + 0.25 * np.arange(120)
PLACES, STRENGTHS = ([40, 90], [5, 33]), [200.0, 120.0]


def picture():
    rng = np.random.default_rng(5)
    image = np.round(4.0 * np.sqrt(rng.exponential(size=(len(RANGES), len(BEARINGS)))))
    image[PLACES] = STRENGTHS
    return image


def data(image, order, dtype='u1', big=False):
    samples = (image if order == 'range_major' else image.T).astype(('>' if big else '<') + dtype)
    return marine.make(
        'SonarImageData', is_bigendian=big, dtype=DTYPES.index(dtype),
        beam_count=len(BEARINGS), data=np.frombuffer(samples.tobytes(), np.uint8),
    )  # fmt: skip


def projected(order='range_major', axes='rep103', **change):
    port, ahead, none = np.sin(BEARINGS), np.cos(BEARINGS), np.zeros(len(BEARINGS))
    beams = np.column_stack([ahead, port, none] if axes == 'rep103' else [none, -port, ahead])
    return marine.make(
        'ProjectedSonarImage', header=marine.header(), ping_info=marine.ping_info(),
        beam_directions=marine.vectors(beams), ranges=marine.floats(RANGES),
        image=data(picture(), order, **change),
    )  # fmt: skip


def raw(sample0=8, sound_speed=1500.0):
    """c / (2 rate) = 0.25 m a sample: sample0 = 8 begins at 2 m."""
    return marine.make(
        'RawSonarImage', header=marine.header(), ping_info=marine.ping_info(sound_speed),
        sample_rate=3000.0, samples_per_beam=len(RANGES), sample0=sample0,
        tx_delays=marine.floats([]), tx_angles=marine.floats([]),
        rx_angles=marine.floats(-BEARINGS), image=data(picture(), 'range_major'),
    )  # fmt: skip


def config(**values):
    return DetectorConfig(**{'image_order': 'range_major', **values})


def read(message, **values):
    return IMAGE.reader(message.__msgtype__, 'enu', config(**values).as_dict())(message)


def detect(message, **values):
    return detector.detect(read(message, **values), config(**values))


def check_echoes(found):
    assert found.range == pytest.approx(RANGES[PLACES[0]], abs=0.02)
    assert found.bearing == pytest.approx(BEARINGS[PLACES[1]], abs=1e-3)
    assert found.bearing[0] > 0.0 > found.bearing[1]  # port, starboard
    assert found.intensity == pytest.approx(STRENGTHS)


@pytest.mark.parametrize(
    'order, axes, dtype, big',
    [('range_major', 'rep103', 'u1', False), ('beam_major', 'marine', 'u2', True),
     ('range_major', 'marine', 'f4', False), ('beam_major', 'rep103', 'f8', True)],
)  # fmt: skip
def test_echoes_are_found_where_they_are(order, axes, dtype, big):
    message = marine.sent(projected(order, axes, dtype=dtype, big=big))
    found = detect(message, image_order=order)
    assert found.stamp_ns == 100_000_000_005 and found.frame_id == 'sonar'
    check_echoes(found)


def test_samples_of_a_raw_image_begin_at_sample0():
    check_echoes(detect(raw()))
    assert read(raw()).range == pytest.approx(RANGES)
    assert read(raw(sample0=0)).range == pytest.approx(RANGES - 2.0)
    slow = read(raw(sound_speed=0.0), sound_speed=1450.0)
    assert slow.range == pytest.approx(RANGES * 1450.0 / 1500.0)
    # The wrong order is not mended in silence.
    assert read(projected('beam_major')).amplitude[40, 5] != 200.0


def test_samples_and_ranges_that_are_no_numbers_are_left_out():
    message = projected(dtype='f4')
    samples = np.frombuffer(bytes(message.image.data), '<f4').copy()
    samples[:500], samples[600] = np.nan, np.inf
    message.image.data = np.frombuffer(samples.tobytes(), np.uint8)
    assert detect(message).intensity.tolist() == [200.0, 120.0]
    message = projected()
    message.ranges[40], message.ranges[41:44] = np.nan, np.inf
    assert detect(message).intensity.tolist() == [120.0]


# -- what a sonar says of its images ------------------------------------------------------------

CW, FM = 1, 2
AMPLITUDE, POWER = 2, 3
LINEAR, DECIBEL = 1, 2


read_info = INFO.reader('marine_interfaces/msg/SonarInfo', 'enu', {})


def sonar_info(frame_id='sonar', **fields):
    values = {'header': marine.header(frame_id=frame_id), **fields}
    return marine.driver_message('marine_interfaces/msg/SonarInfo', **values)


def described(message, image, **values):
    """The detector of images, and the echoes after the sonar has said what `message` holds."""
    of_images = ImageDetector(config(**values))
    of_images.describe(read_info(message))
    return of_images, of_images.process(image)


@pytest.mark.parametrize(
    'fields, of_amplitude',
    [
        ({'intensity_quantity': AMPLITUDE, 'intensity_scale': LINEAR}, lambda a: a),
        ({'intensity_quantity': POWER, 'intensity_scale': LINEAR}, np.square),
        ({'intensity_quantity': POWER, 'intensity_scale': DECIBEL, 'scale': 0.25},
         lambda a: 80.0 * np.log10(np.maximum(a, 0.1))),
        ({'intensity_quantity': POWER, 'intensity_scale': LINEAR, 'scale': 4.0, 'offset': -8.0},
         lambda a: np.square(a) / 4.0 + 2.0),
    ],
)  # fmt: skip
def test_what_the_sonar_says_of_a_sample_counts_in_place_of_the_parameters(fields, of_amplitude):
    image = evolve(read(projected()), amplitude=of_amplitude(picture()))
    for stated in ('amplitude', 'decibel'):
        how = {'image_scale': stated, 'decibel_step': 3.0}
        check_echoes(described(sonar_info(**fields), image, **how)[1])


def test_the_pulse_says_how_long_an_echo_is_where_it_is_known():
    for fields, resolution in (
        ({'tx_signal_types': [CW], 'pulse_lengths': [4e-4]}, 0.3),
        ({'tx_signal_types': [FM], 'pulse_lengths': [1e-2], 'bandwidths': [1329.0]}, 0.5),
        ({'tx_signal_types': [CW, CW], 'pulse_lengths': [4e-4, 8e-4]}, 0.6),
        ({'tx_signal_types': [0], 'pulse_lengths': [4e-4]}, 0.7),
        ({'tx_signal_types': [FM], 'pulse_lengths': [1e-2]}, 0.7),
        ({'pulse_lengths': [4e-4]}, 0.7),
    ):
        made, _ = described(sonar_info(**fields), read(projected()), range_resolution=0.7)
        assert made.infos['sonar'][1].range_resolution == pytest.approx(resolution, rel=1e-3)


def test_a_sonar_says_it_of_its_own_images_and_of_what_comes_next():
    power, image = {'intensity_quantity': POWER, 'intensity_scale': LINEAR}, read(projected())
    of_images, found = described(sonar_info('stern', **power), image)
    assert found.intensity.tolist() == [200.0, 120.0]

    def tell(**fields):
        of_images.describe(read_info(sonar_info(**fields)))

    for fields, strongest in ((power, np.sqrt(200.0)), ({}, 200.0)):
        tell(**fields)
        assert of_images.process(image).intensity[0] == pytest.approx(strongest)
    known = dict(of_images.infos)  # what cannot be true is refused, and nothing changes
    wrong = [{'intensity_scale': DECIBEL, 'scale': scale} for scale in (np.nan, -1.0)]
    for fields in (*wrong, {'tx_signal_types': [CW], 'pulse_lengths': [1e3]}):
        assert why(tell, **fields) == 'out_of_range'
    assert of_images.infos == known
    stated = {'scale': 'power', 'gain': 2.0, 'offset': 1.0, 'echo_duration': 2**-10}
    info = SonarInfo(stamp_ns=5, frame_id='sonar', **stated)
    assert asdict(read_info(INFO.write(info, marine.driver_message))) == asdict(info)


# -- Images of single drivers and simulators, and what of them is refused --


GEOMETRY = {'image_near_range': 2.0, 'image_far_range': 22.0, 'image_fov_deg': 60.0}
PIXELS = np.arange(8 * 6).reshape(8, 6)  # 8 ranges, 6 beams


def read_sent(message, **settings):
    return IMAGE.reader(message.__msgtype__, 'enu', settings)(marine.sent(message))


def refused(message, **settings):
    return why(IMAGE.reader(message.__msgtype__, 'enu', settings), message)


# -- Oculus -------------------------------------------------------------------------------------


def oculus(gains=None, size=1, packet=b'', **changes):
    samples = PIXELS.astype(f'<u{size}')
    rows = [row.tobytes() for row in samples]
    if gains is not None:
        rows = [np.uint32(gain).tobytes() + row for gain, row in zip(gains, rows)]
    values = {
        'header': marine.header(), 'range_resolution': 0.5, 'has_gains': gains is not None,
        'n_ranges': 8, 'n_beams': 6, 'step': len(rows[0]), 'sample_size': size,
        'bearings': np.array([-3000, -1500, -500, 500, 1500, 3000], np.int16),
        'ping_data': np.frombuffer(packet + b''.join(rows), np.uint8), **changes,
    }  # fmt: skip
    return marine.driver_message('oculus_interfaces/msg/Ping', **values)


def test_an_oculus_ping_is_read_row_by_row():
    for size in (1, 2, 4):
        image = read_sent(oculus(size=size))
        np.testing.assert_array_equal(image.amplitude, PIXELS)
        assert image.range == pytest.approx(0.5 * np.arange(8) + 0.25)
        # Hundredths of a degree, positive to starboard.
        assert np.degrees(image.bearing) == pytest.approx([30.0, 15.0, 5.0, -5.0, -15.0, -30.0])
        assert image.stamp_ns == 100_000_000_005 and image.frame_id == 'sonar'
    # Gains are divided out, and a packet is read from its end.
    gains = np.array([1, 4, 9, 16, 25, 36, 49, 0])
    wanted = PIXELS / np.sqrt(np.maximum(gains, 1))[:, None]
    np.testing.assert_allclose(read_sent(oculus(gains=gains)).amplitude, wanted)
    header = b'\x53\x4f' + bytes(range(200))
    np.testing.assert_array_equal(read_sent(oculus(packet=header)).amplitude, PIXELS)


# -- Ping360 ------------------------------------------------------------------------------------


def ping360(angle=0.3, **changes):
    values = {'angle': angle, 'range': 20, 'intensities': np.array([1, 200, 3, 4], np.uint8)}
    values |= {'header': marine.header(), **changes}
    return marine.driver_message('ping360_sonar_msgs/msg/SonarEcho', **values)


def test_an_echo_of_a_ping360_is_one_direction_of_a_sweep():
    image = read_sent(ping360(angle=2.0 * np.pi - 0.25))
    assert image.scanning and image.bearing == pytest.approx([-0.25], abs=1e-6)
    assert image.range.tolist() == [5.0, 10.0, 15.0, 20.0]
    assert image.amplitude.tolist() == [[1.0], [200.0], [3.0], [4.0]]


# -- images whose geometry is a parameter --------------------------------------------------------


def sonoptix(sizes=(8, 6), offset=0, data=None):
    samples = np.concatenate([np.zeros(offset), PIXELS.ravel()]) if data is None else data
    kind = 'std_msgs/msg/MultiArrayDimension'
    sides = [marine.driver_message(kind, size=size) for size in sizes]
    layout = {'layout__data_offset': offset, 'layout__dim': sides, 'data': marine.floats(samples)}
    values = {f'array_data__{name}': value for name, value in layout.items()}
    return marine.driver_message('sensors/msg/SonoptixECHO', header=marine.header(), **values)


def photo(pixels=PIXELS, encoding='mono8', dtype='u1', big=False, pad=0, **changes):
    rows = pixels.astype(('>' if big else '<') + dtype)
    data = b''.join(row.tobytes() + bytes(pad) for row in rows)
    values = {
        'header': marine.header(), 'height': pixels.shape[0], 'width': pixels.shape[1],
        'encoding': encoding, 'is_bigendian': int(big),
        'step': pixels.shape[1] * rows.itemsize + pad, 'data': np.frombuffer(data, np.uint8),
        **changes,
    }  # fmt: skip
    return marine.make('sensor_msgs/msg/Image', **values)


def test_ranges_and_directions_come_from_parameters():
    for message in (sonoptix(), sonoptix(offset=3), photo()):
        image = read_sent(message, **GEOMETRY)
        np.testing.assert_array_equal(image.amplitude, PIXELS)
        assert image.range == pytest.approx(3.25 + 2.5 * np.arange(8))
        assert np.degrees(image.bearing) == pytest.approx([25.0, 15.0, 5.0, -5.0, -15.0, -25.0])
        first = {'image_first_beam': 'starboard', 'image_first_range': 'far'}
        turned = read_sent(message, **GEOMETRY, **first)
        np.testing.assert_array_equal(turned.amplitude, PIXELS[::-1, ::-1])
        assert turned.bearing[0] > 0.0 and turned.range[0] < turned.range[-1]
        assert refused(message) == refused(message, image_far_range=20.0) == 'no_geometry'
    # An image of beam rows is turned, and one without pixels read.
    image = read_sent(photo(PIXELS.T), **GEOMETRY, image_order='beam_major')
    np.testing.assert_array_equal(image.amplitude, PIXELS)
    message = photo(pixels=np.zeros((0, 0), int))
    assert read_sent(message, **GEOMETRY).amplitude.shape == (0, 0)
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    assert refused(message, **GEOMETRY) == 'bad_stamp'


def test_pixels_of_all_kinds_paddings_and_byte_orders_are_read():
    kinds = {'mono8': 'u1', '8UC1': 'u1', 'mono16': 'u2', '32FC1': 'f4', '64FC1': 'f8'}
    for (encoding, dtype), big in itertools.product(kinds.items(), (False, True)):
        message = photo(encoding=encoding, dtype=dtype, big=big, pad=5)
        np.testing.assert_array_equal(read_sent(message, **GEOMETRY).amplitude, PIXELS)


def marine_image(make=projected, cut=slice(None), **changes):
    """One of marine_acoustic_msgs, with other fields of itself or of its samples."""
    message = make()
    message.image.data = message.image.data[cut]
    for name, value in changes.items():
        setattr(message.image if hasattr(message.image, name) else message, name, value)
    return message


NONE, MOST = np.zeros(0, np.uint8), 2**32 - 1
HUGE = {'n_ranges': 65535, 'n_beams': 65535, 'bearings': np.zeros(65535, np.int16)}
REFUSED = {
    (marine_image, 'bad_shape'): [{'beam_count': 40}, {'beam_count': 0}],
    (marine_image, 'out_of_range'): [{'make': raw, 'sample_rate': each} for each in (0.0, np.nan)],
    (marine_image, 'short_data'): [{'cut': slice(-1)}, {'cut': slice(0)}],
    (marine_image, 'bad_field'): [{'dtype': 10}],
    # A claim of a huge image takes no memory.
    (marine_image, 'too_large'): [{'make': raw, 'samples_per_beam': MOST},
                                  {'ranges': marine.floats(np.arange(200_000.0))}],
    (oculus, 'short_data'): [
        {'packet': b'xx' + bytes(200)},  # neither image nor packet
        {'ping_data': np.zeros(47, np.uint8)}, {'ping_data': NONE}, {'step': MOST},
        {'step': 3, 'ping_data': np.zeros(24, np.uint8)},
    ],
    (oculus, 'too_large'): [HUGE],
    (oculus, 'bad_shape'): [{'n_beams': 5}, {'bearings': np.zeros(0, np.int16)}],
    (oculus, 'bad_field'): [{'sample_size': 3}, {'sample_size': 0}],
    (oculus, 'out_of_range'): [{'range_resolution': each} for each in (np.nan, 0.0, 1e300)],
    (ping360, 'short_data'): [{'intensities': NONE}],
    (ping360, 'too_large'): [{'intensities': np.zeros(MAX_IMAGE_CELLS + 1, np.uint8)}],
    (ping360, 'out_of_range'): [{'range': 0}, {'angle': np.nan}, {'angle': 1e30}],
    (photo, 'bad_field'): [{'encoding': 'rgb8'}, {'encoding': ''}],
    (photo, 'short_data'): [{'data': np.zeros(47, np.uint8)}, {'step': 3}, {'step': MOST}],
    (photo, 'too_large'): [{'height': MOST}, {'width': MOST, 'height': MOST}],
    (sonoptix, 'bad_shape'): [{'sizes': (8,)}, {'sizes': (8, 6, 1)}],
    (sonoptix, 'short_data'): [{'sizes': (8, 7)}, {'data': [1.0]}],
    (sonoptix, 'too_large'): [{'sizes': (MOST, MOST)}],
}  # fmt: skip


@pytest.mark.parametrize('make, code', REFUSED)
def test_a_message_that_cannot_be_is_refused(make, code):
    for changes in REFUSED[make, code]:
        assert refused(make(**changes), **GEOMETRY) == code, changes


def test_a_written_picture_is_read_again():
    place = {'range': 3.25 + 2.5 * np.arange(8), 'bearing': np.radians(25.0 - 10.0 * np.arange(6))}
    for factor, encoding in ((1.0, 'mono8'), (0.5, '32FC1'), (300.0, '32FC1')):
        image = SonarImage(stamp_ns=7, frame_id='sonar', amplitude=factor * PIXELS, **place)
        message = write_picture(image, ros_message)
        assert message.encoding == encoding
        again = read_sent(message, **GEOMETRY)
        np.testing.assert_allclose(again.amplitude, image.amplitude)
        np.testing.assert_allclose(again.range, image.range)
        assert (again.stamp_ns, again.frame_id) == (7, 'sonar')


# -- fans as a screen shows them


ROWS = 120


def fan(sector_deg, far_first=True, target=(0.2, 80.0), seed=3):
    """The picture of an echo at (angle to the left, rows of range), and noise, apex at one end."""
    half = np.radians(0.5 * sector_deg)
    columns = round(2 * ROWS * np.sin(half))
    ahead, left = np.mgrid[:ROWS, :columns] + 0.5
    left = 0.5 * columns - left
    r, angle = np.hypot(ahead, left), np.arctan2(left, ahead)
    picture = np.random.default_rng(seed).rayleigh(10.0, r.shape)
    off = np.hypot(ahead - target[1] * np.cos(target[0]), left - target[1] * np.sin(target[0]))
    picture += 200.0 * np.exp(-np.square(off / 2.0))
    picture[(r > ROWS) | (np.abs(angle) > half)] = 0.0
    return picture[::-1] if far_first else picture


def test_a_fan_gives_ranges_by_beams():
    for sector, far_first in ((60.0, True), (90.0, False), (130.0, True)):
        found = unfolded(fan(sector, far_first), sector)
        row, column = np.unravel_index(found.argmax(), found.shape)
        angle = np.radians(sector) * (0.5 - (column + 0.5) / found.shape[1])
        assert row + 0.5 == pytest.approx(80.0, abs=1.0)
        assert angle == pytest.approx(0.2, abs=0.02)
        assert np.median(found[10:]) == pytest.approx(np.median(found[10:, 10:-10]), rel=0.1)


def test_a_fan_of_another_sector_is_refused_and_ranges_by_beams_stay_as_they_are():
    """Also where those from row `dark` on are dark."""
    with pytest.raises(Rejection, match='fan as a screen shows it, 90 deg wide'):
        unfolded(fan(90.0), 130.0)
    for columns, dark in itertools.product((16, 170, 240, 400), (0, 80, ROWS)):
        picture = np.random.default_rng(1).rayleigh(10.0, (ROWS, columns))
        picture[dark:] = 0.0
        assert unfolded(picture, 90.0) is picture
