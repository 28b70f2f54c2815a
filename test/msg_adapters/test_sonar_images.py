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

"""Images of both kinds in both orders, and the echoes in them."""

from helpers import marine
import numpy as np
import pytest

from msg_adapters.inputs import inputs_of
from msg_adapters.sonar_images import DTYPES
from sonar_imm.measurements import Rejection
from sonar_imm.trackers.obstacle import detector
from sonar_imm.trackers.obstacle.detector import DetectorConfig

(IMAGE,) = inputs_of('fls_detector')

BEARINGS = np.radians(np.linspace(20.0, -20.0, 41))  # port first
RANGES = 2.0 + 0.25 * np.arange(120)
ECHOES = {(40, 5): 200.0, (90, 33): 120.0}


def picture():
    rng = np.random.default_rng(5)
    image = np.round(4.0 * np.sqrt(rng.exponential(size=(len(RANGES), len(BEARINGS)))))
    for place, strength in ECHOES.items():
        image[place] = strength
    return image


def data(image, order, dtype='u1', big=False, beams=None):
    samples = (image if order == 'range_major' else image.T).astype(('>' if big else '<') + dtype)
    return marine.make(
        'SonarImageData',
        is_bigendian=big,
        dtype=DTYPES.index(dtype),
        beam_count=len(BEARINGS) if beams is None else beams,
        data=np.frombuffer(samples.tobytes(), np.uint8),
    )


def projected(order='range_major', axes='rep103', **change):
    port, ahead, none = np.sin(BEARINGS), np.cos(BEARINGS), np.zeros(len(BEARINGS))
    beams = np.column_stack([ahead, port, none] if axes == 'rep103' else [none, -port, ahead])
    return marine.make(
        'ProjectedSonarImage',
        header=marine.header(),
        ping_info=marine.ping_info(),
        beam_directions=marine.vectors(beams),
        ranges=marine.floats(RANGES),
        image=data(picture(), order, **change),
    )


def raw(sample0=8, rate=3000.0, sound_speed=1500.0):
    """c / (2 rate) = 0.25 m a sample: sample0 = 8 begins at 2 m."""
    return marine.make(
        'RawSonarImage',
        header=marine.header(),
        ping_info=marine.ping_info(sound_speed),
        sample_rate=rate,
        samples_per_beam=len(RANGES),
        sample0=sample0,
        tx_delays=marine.floats([]),
        tx_angles=marine.floats([]),
        rx_angles=marine.floats(-BEARINGS),
        image=data(picture(), 'range_major'),
    )


def config(**values):
    return DetectorConfig(**{'image_order': 'range_major', **values})


def read(message, config):
    name = message.__msgtype__
    return IMAGE.reader(name, 'enu', config.as_dict())(message)


def detect(message, config):
    return detector.detect(read(message, config), config)


def reason(message, **values):
    with pytest.raises(Rejection) as caught:
        detect(message, config(**values))
    return caught.value.reason


@pytest.mark.parametrize('order', ['range_major', 'beam_major'])
@pytest.mark.parametrize('axes', ['rep103', 'marine'])
@pytest.mark.parametrize('dtype, big', [('u1', False), ('u2', True), ('f4', False), ('f8', True)])
def test_echoes_are_found_where_they_are(order, axes, dtype, big):
    found = detect(
        marine.sent(projected(order, axes, dtype=dtype, big=big)), config(image_order=order)
    )
    assert found.stamp_ns == 100_000_000_005 and found.frame_id == 'sonar'
    assert found.range == pytest.approx([RANGES[40], RANGES[90]], abs=0.02)
    assert found.bearing == pytest.approx([BEARINGS[5], BEARINGS[33]], abs=1e-3)
    assert found.bearing[0] > 0.0 > found.bearing[1]  # port, starboard
    assert found.intensity.tolist() == [200.0, 120.0]


def test_samples_of_a_raw_image_begin_at_sample0():
    found = detect(raw(), config())
    assert found.range == pytest.approx([RANGES[40], RANGES[90]], abs=0.02)
    assert found.bearing == pytest.approx([BEARINGS[5], BEARINGS[33]], abs=1e-3)
    assert read(raw(), config()).range == pytest.approx(RANGES)
    assert read(raw(sample0=0), config()).range == pytest.approx(RANGES - 2.0)
    slow = read(raw(sound_speed=0.0), config(sound_speed=1450.0))
    assert slow.range == pytest.approx(RANGES * 1450.0 / 1500.0)


def test_the_wrong_order_is_not_mended_in_silence():
    mixed = read(projected('beam_major'), config())
    assert mixed.amplitude[40, 5] != 200.0


@pytest.mark.parametrize(
    'message, code',
    [
        (projected(beams=40), 'bad_shape'),
        (projected(beams=0), 'bad_shape'),
        (raw(rate=0.0), 'out_of_range'),
        (raw(rate=np.nan), 'out_of_range'),
    ],
)
def test_an_image_that_does_not_fit_is_refused(message, code):
    assert reason(message) == code


def test_too_few_or_too_many_bytes_are_refused():
    for cut in (slice(0, -1), slice(0, 0)):
        message = projected()
        message.image.data = message.image.data[cut]
        assert reason(message) == 'short_data'
    message = projected()
    message.image.dtype = 10
    assert reason(message) == 'bad_field'


def test_a_claim_of_a_huge_image_takes_no_memory():
    message = raw()
    message.samples_per_beam = 2**32 - 1
    assert reason(message) == 'too_large'
    message = projected()
    message.ranges = marine.floats(np.arange(200_000.0))
    assert reason(message) == 'too_large'


def test_samples_that_are_no_numbers_are_silence():
    message = projected(dtype='f4')
    samples = np.frombuffer(bytes(message.image.data), '<f4').copy()
    samples[:500] = np.nan
    samples[600] = np.inf
    message.image.data = np.frombuffer(samples.tobytes(), np.uint8)
    found = detect(message, config())
    assert found.intensity.tolist() == [200.0, 120.0]


def test_ranges_that_are_no_numbers_are_left_out():
    message = projected()
    message.ranges[40] = np.nan
    message.ranges[41:44] = np.inf
    assert detect(message, config()).intensity.tolist() == [120.0]
