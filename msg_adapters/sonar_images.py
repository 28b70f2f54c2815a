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

"""Images of a forward-looking sonar, as drivers and simulators send them.

- marine_acoustic_msgs ProjectedSonarImage and RawSonarImage: magnitudes with their ranges and
  directions. They do not say in which order the samples lie, and publishers differ, so it is a
  parameter: ``range_major`` (all beams of the first range first: image = range * beams + beam) or
  ``beam_major`` (all ranges of the first beam first). The wrong order gives stripes, not an error.
- oculus_interfaces Ping, ping360_sonar_msgs SonarEcho: see `vendor_images`.
- sensors SonoptixECHO, sensor_msgs Image: samples alone; ranges and directions are parameters.

Bearings of marine_acoustic_msgs raw images and of the Oculus count to starboard, those of the
Ping360 to port, as its driver draws them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import MAX_IMAGE_CELLS, Rejection, SonarImage

from .detections import beam_bearings, SOUND_SPEEDS
from .headers import Make, make_header, stamp_ns

DTYPES = ('u1', 'i1', 'u2', 'i2', 'u4', 'i4', 'u8', 'i8', 'f4', 'f8')
ENCODINGS = {
    'mono8': 'u1',
    '8UC1': 'u1',
    'mono16': 'u2',
    '16UC1': 'u2',
    '32FC1': 'f4',
    '64FC1': 'f8',
}
"""Encodings of sensor_msgs/Image with one number a pixel."""


def read_projected_image(
    message: Any, *, image_order: str = 'range_major', beam_axes: str = 'auto', **_: Any
) -> SonarImage:
    """Read a ProjectedSonarImage.

    image_order: see the module's text; beam_axes: as in `detections.read_sonar_ranges`. Raises
    `Rejection`.
    """
    distance = np.array(message.ranges, np.float64)
    beams = np.array(
        [[beam.x, beam.y, beam.z] for beam in message.beam_directions], np.float64
    ).reshape(-1, 3)
    return _image(message, distance, beam_bearings(beams, beam_axes), image_order)


def read_raw_image(
    message: Any, *, image_order: str = 'range_major', sound_speed: float = 1500.0, **_: Any
) -> SonarImage:
    """Read a RawSonarImage; sound_speed: m/s, where the message states none. Raises
    `Rejection`."""
    distance = _raw_ranges(message, sound_speed)
    bearing = -np.array(message.rx_angles, np.float64)  # receive angles count to starboard
    return _image(message, distance, bearing, image_order)


def _image(
    message: Any, distance: FloatArray, bearing: FloatArray, image_order: str
) -> SonarImage:
    """The SonarImageData of a message, with its axes."""
    return SonarImage(
        stamp_ns=stamp_ns(message),
        range=distance,
        bearing=bearing,
        amplitude=image_samples(message.image, len(distance), len(bearing), image_order),
        frame_id=str(message.header.frame_id),
    )


def read_picture(message: Any, *, image_order: str = 'range_major', **geometry: Any) -> SonarImage:
    """Read a sensor_msgs/Image with one number a pixel, one row a range (``range_major``) or a
    beam. geometry: see `on_a_grid`. Raises `Rejection`."""
    encoding = str(message.encoding)
    if encoding not in ENCODINGS:
        raise Rejection(
            'bad_field',
            f"the image is encoded as '{encoding}'; samples of a sonar are one of "
            f'{", ".join(ENCODINGS)}',
        )
    dtype = np.dtype(('>' if message.is_bigendian else '<') + ENCODINGS[encoding])
    height, width, step = int(message.height), int(message.width), int(message.step)
    check_cells(height, width)
    data = memoryview(message.data).cast('B')
    if step < width * dtype.itemsize or len(data) < step * height:
        raise Rejection(
            'short_data',
            f'the image holds {len(data)} bytes in rows of {step}, {height} rows of {width} '
            f'pixels need {height * width * dtype.itemsize}',
        )
    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)
    pixels = np.ascontiguousarray(rows[:, : width * dtype.itemsize]).view(dtype)
    return on_a_grid(message, pixels if image_order == 'range_major' else pixels.T, **geometry)


def on_a_grid(
    message: Any,
    pixels: NDArray[Any],
    *,
    image_near_range: float = 0.0,
    image_far_range: float = 0.0,
    image_fov_deg: float = 0.0,
    image_first_beam: str = 'port',
    image_first_range: str = 'near',
    **_: Any,
) -> SonarImage:
    """An image of `pixels` (R, B), whose ranges and bearings the message does not say.

    Ranges lie evenly between `image_near_range` and `image_far_range` m, beams over
    `image_fov_deg`; the first column is that of `image_first_beam` (``'port'``,
    ``'starboard'``), the first row that of `image_first_range` (``'near'``, ``'far'``). Raises
    `Rejection` when nobody said.
    """
    if not (image_far_range > image_near_range and image_fov_deg > 0.0):
        raise Rejection(
            'no_geometry',
            'the image does not say its ranges and directions: set image_far_range and '
            'image_fov_deg',
        )
    if image_first_beam == 'starboard':
        pixels = pixels[:, ::-1]
    if image_first_range == 'far':
        pixels = pixels[::-1]
    rows, beams = pixels.shape
    depth, sector = image_far_range - image_near_range, np.radians(image_fov_deg)
    return SonarImage(
        stamp_ns=stamp_ns(message),
        range=image_near_range + depth * (np.arange(rows) + 0.5) / max(rows, 1),
        bearing=sector * (0.5 - (np.arange(beams) + 0.5) / max(beams, 1)),
        amplitude=pixels.astype(np.float64),
        frame_id=str(message.header.frame_id),
    )


def write_picture(image: SonarImage, make: Make) -> Any:
    """Write a sensor_msgs/Image, one row a range: ``mono8`` for whole numbers from 0 to 255, else
    ``32FC1``. Its ranges and bearings are lost."""
    counts = image.amplitude
    whole = counts.size and counts.min() >= 0.0 and counts.max() <= 255.0
    small = bool(whole and (counts == np.round(counts)).all())
    pixels = counts.astype('<u1' if small else '<f4')
    height, width = pixels.shape
    return make(
        'sensor_msgs/msg/Image',
        header=make_header(image.stamp_ns, image.frame_id, make),
        height=height,
        width=width,
        encoding='mono8' if small else '32FC1',
        is_bigendian=0,
        step=width * pixels.itemsize,
        data=pixels.tobytes(),
    )


def check_cells(rows: int, beams: int) -> None:
    """Raise `Rejection` for an image that claims to be larger than any sonar makes, before memory
    is taken for it."""
    if rows * beams > MAX_IMAGE_CELLS:
        raise Rejection(
            'too_large',
            f'an image of {rows} ranges and {beams} beams; at most {MAX_IMAGE_CELLS} samples '
            'are read',
        )


def _raw_ranges(message: Any, sound_speed: float) -> FloatArray:
    """(R,) metres; sample k came ``(sample0 + k) / sample_rate`` seconds after transmission."""
    rate = float(message.sample_rate)
    if not (np.isfinite(rate) and rate > 0.0):
        raise Rejection('out_of_range', f'the sample rate of the image is {rate:g} Hz')
    count = int(message.samples_per_beam)
    check_cells(count, 1)
    stated = float(message.ping_info.sound_speed)
    speed = stated if SOUND_SPEEDS[0] <= stated <= SOUND_SPEEDS[1] else sound_speed
    samples = np.arange(count, dtype=np.float64)
    return (int(message.sample0) + samples) * speed / (2.0 * rate)


def image_samples(image: Any, ranges: int, beams: int, order: str) -> FloatArray:
    """The samples (ranges, beams) of an image. Raises `Rejection`."""
    if not 0 <= int(image.dtype) < len(DTYPES):
        raise Rejection('bad_field', f'the image has the unknown datatype {int(image.dtype)}')
    if int(image.beam_count) != beams:
        raise Rejection(
            'bad_shape', f'the image has {int(image.beam_count)} beams but {beams} directions'
        )
    check_cells(ranges, beams)
    dtype = np.dtype(('>' if image.is_bigendian else '<') + DTYPES[int(image.dtype)])
    data = memoryview(image.data).cast('B')
    wanted = ranges * beams * dtype.itemsize
    if len(data) != wanted:
        raise Rejection(
            'short_data',
            f'the image holds {len(data)} bytes, {ranges} ranges and {beams} beams need {wanted}',
        )
    flat = np.frombuffer(data, dtype).astype(np.float64)
    if order == 'range_major':
        return flat.reshape(ranges, beams)
    return np.ascontiguousarray(flat.reshape(beams, ranges).T)
