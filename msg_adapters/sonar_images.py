# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Images of a forward-looking sonar, as drivers and simulators send them.

- marine_acoustic_msgs ProjectedSonarImage and RawSonarImage: magnitudes with their ranges and
  directions. They do not say in which order the samples lie, and publishers differ, so it is a
  parameter: ``range_major`` (all beams of the first range first: image = range * beams + beam) or
  ``beam_major`` (all ranges of the first beam first). The wrong order gives stripes, not an error.
- ``oculus_interfaces/Ping`` (ENSTA Bretagne, Forssea): rows of ranges, little-endian. With
  `has_gains` every row begins with its gain, four bytes, and its samples are divided by the square
  root of that. The definition says that `ping_data` is the image; the driver puts the whole packet
  of the sonar there, whose end is the image. Both are read.
- ``ping360_sonar_msgs/SonarEcho`` (Centrale Nantes): one direction of a scanning sonar. Sample k
  lies at ``(k + 1) range / samples``, as in the driver.
- ``marine_interfaces/SonarInfo`` (unh_marine_autonomy), latched beside images, in their frame:
  what a sample is, and the pulse.
- ``sensors/SonoptixECHO`` (recordings of SOLAQUA), a Float32MultiArray of ranges by beams, and
  sensor_msgs Image: samples alone; ranges and directions are parameters. A sensor_msgs Image that
  shows the fan as on a screen is read as ranges by beams (`fans`).

Bearings of marine_acoustic_msgs raw images and of the Oculus count to starboard, those of the
Ping360 to port, as its driver draws them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import MAX_IMAGE_CELLS, Rejection, SonarImage, SonarInfo

from .detections import beam_bearings, FARTHEST, SOUND_SPEEDS
from .fans import unfolded
from .headers import head_of, Make, make_header, places_of

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
_GAIN_BYTES = 4
_PACKET = b'SO'
"""The first bytes of a packet of the Oculus (0x4f53, little-endian)."""
_SAMPLES = {1: '<u1', 2: '<u2', 4: '<u4'}
_CW, _FM_UP, _FM_DOWN = 1, 2, 3
_SINC = 0.886
"""-3 dB width of the echo of a frequency-modulated pulse, times its bandwidth."""
_AMPLITUDE, _POWER, _LINEAR, _DECIBEL = 2, 3, 1, 2


def read_projected_image(
    message: Any, *, image_order: str = 'range_major', beam_axes: str = 'auto', **_: Any
) -> SonarImage:
    """Read a ProjectedSonarImage.

    image_order: see the module's text; beam_axes: as in `detections.read_sonar_ranges`. Raises
    `Rejection`.
    """
    distance = np.array(message.ranges, np.float64)
    bearing = beam_bearings(places_of(message.beam_directions), beam_axes)
    return _image(message, distance, bearing, image_order)


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
        **head_of(message),
        range=distance,
        bearing=bearing,
        amplitude=image_samples(message.image, len(distance), len(bearing), image_order),
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
    if image_order == 'beam_major':
        return on_a_grid(message, pixels.T, **geometry)
    by_beams = unfolded(pixels, float(geometry.get('image_fov_deg', 0.0)))
    if by_beams is not pixels:
        geometry['image_first_range'] = 'near'
    return on_a_grid(message, by_beams, **geometry)


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
        missing = 'image_far_range', 'image_fov_deg'
        raise Rejection(
            'no_geometry',
            f'the image does not say its ranges and directions: set {" and ".join(missing)}',
            missing,
        )
    if image_first_beam == 'starboard':
        pixels = pixels[:, ::-1]
    if image_first_range == 'far':
        pixels = pixels[::-1]
    rows, beams = pixels.shape
    depth, sector = image_far_range - image_near_range, np.radians(image_fov_deg)
    return SonarImage(
        **head_of(message),
        range=image_near_range + depth * (np.arange(rows) + 0.5) / max(rows, 1),
        bearing=sector * (0.5 - (np.arange(beams) + 0.5) / max(beams, 1)),
        amplitude=pixels.astype(np.float64),
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


# -- messages of single drivers ----------------------------------------------------------------


def read_oculus_ping(message: Any, **_: Any) -> SonarImage:
    """Read an Oculus Ping; bearings count to starboard. Raises `Rejection`."""
    rows, beams, step = int(message.n_ranges), int(message.n_beams), int(message.step)
    size = int(message.sample_size)
    if size not in _SAMPLES:
        raise Rejection('bad_field', f'the ping has samples of {size} bytes; 1, 2 or 4 are read')
    head = _GAIN_BYTES if message.has_gains else 0
    bearings = np.array(message.bearings, np.float64)
    if len(bearings) != beams:
        raise Rejection('bad_shape', f'the ping has {beams} beams but {len(bearings)} bearings')
    check_cells(rows, beams)
    resolution = float(message.range_resolution)
    if not (np.isfinite(resolution) and 0.0 < resolution * max(rows, 1) <= FARTHEST):
        raise Rejection('out_of_range', f'the ping has a range step of {resolution:g} m')
    data = memoryview(message.ping_data).cast('B')
    wanted = rows * step
    whole = len(data) == wanted or (len(data) > wanted and bytes(data[:2]) == _PACKET)
    if step < head + beams * size or not whole:
        raise Rejection(
            'short_data',
            f'the ping holds {len(data)} bytes in rows of {step}, {rows} ranges and {beams} '
            f'beams of {size} bytes need {rows * (head + beams * size)}',
        )
    table = np.frombuffer(data[len(data) - wanted :], np.uint8).reshape(rows, step)
    samples = np.ascontiguousarray(table[:, head : head + beams * size]).view(_SAMPLES[size])
    amplitude = samples.astype(np.float64)
    if message.has_gains:
        gain = np.ascontiguousarray(table[:, :_GAIN_BYTES]).view('<u4').astype(np.float64)
        amplitude = amplitude / np.sqrt(np.maximum(gain, 1.0))  # a gain of zero was not filled in
    return SonarImage(
        **head_of(message),
        range=resolution * (np.arange(rows) + 0.5),
        bearing=-np.radians(0.01 * bearings),
        amplitude=amplitude,
    )


def read_ping360_echo(message: Any, **_: Any) -> SonarImage:
    """Read a SonarEcho, an image of one beam; a detector gathers those of a sweep. Raises
    `Rejection`."""
    samples = np.frombuffer(memoryview(message.intensities).cast('B'), np.uint8)
    check_cells(len(samples), 1)
    far, angle = float(message.range), float(message.angle)
    if not len(samples):
        raise Rejection('short_data', 'the echo holds no samples')
    if not far > 0.0:
        raise Rejection('out_of_range', f'the echo has a range of {far:g} m')
    if not (np.isfinite(angle) and abs(angle) <= 4.0 * np.pi):
        raise Rejection('out_of_range', f'the echo has an angle of {angle:g} rad')
    return SonarImage(
        **head_of(message),
        range=far * (np.arange(len(samples)) + 1.0) / len(samples),
        bearing=np.array([np.arctan2(np.sin(angle), np.cos(angle))]),
        amplitude=samples.astype(np.float64)[:, None],
        scanning=True,
    )


def read_sonoptix_echo(
    message: Any, *, image_order: str = 'range_major', **geometry: Any
) -> SonarImage:
    """Read a SonoptixECHO; geometry: see `on_a_grid`. Raises `Rejection`."""
    layout = message.array_data.layout
    sizes = [int(dim.size) for dim in layout.dim]
    samples = np.asarray(message.array_data.data, np.float32)
    offset = int(layout.data_offset)
    if len(sizes) != 2:
        raise Rejection('bad_shape', f'the array has {len(sizes)} dimensions, an image has 2')
    check_cells(*sizes)
    if len(samples) != offset + sizes[0] * sizes[1]:
        raise Rejection(
            'short_data',
            f'the array holds {len(samples)} numbers, {sizes[0]} by {sizes[1]} are needed',
        )
    pixels = samples[offset:].reshape(sizes)
    return on_a_grid(message, pixels if image_order == 'range_major' else pixels.T, **geometry)


def read_sonar_info(message: Any, **_: Any) -> SonarInfo:
    """Read a SonarInfo. What it does not know, or only the converter of the sonar does, is left
    to the parameters. Raises `Rejection`."""
    scale, quantity = '', int(message.intensity_quantity)
    if message.intensity_scale == _DECIBEL:
        scale = 'decibel'
    elif message.intensity_scale == _LINEAR and quantity in (_AMPLITUDE, _POWER):
        scale = 'amplitude' if quantity == _AMPLITUDE else 'power'
    gain, offset = (float(value) for value in (message.scale, message.offset))
    if not scale or gain == 0.0:
        gain = offset = 0.0
    if not (np.isfinite([gain, offset]).all() and gain >= 0.0):
        raise Rejection('out_of_range', f'samples times {gain:g} plus {offset:g} are no levels')
    return SonarInfo(
        **head_of(message),
        scale=scale,
        gain=gain,
        offset=offset,
        echo_duration=_echo_duration(message),
    )


def _echo_duration(message: Any) -> float:
    """Seconds; of several sectors the longest, 0 where one of them is not known."""
    kinds = [int(kind) for kind in message.tx_signal_types]
    lengths, bandwidths = (
        np.array(values, np.float64) for values in (message.pulse_lengths, message.bandwidths)
    )
    found = np.zeros(len(kinds))
    for k, kind in enumerate(kinds):
        if kind == _CW and k < len(lengths):
            found[k] = lengths[k]
        elif kind in (_FM_UP, _FM_DOWN) and k < len(bandwidths) and bandwidths[k] > 0.0:
            found[k] = _SINC / bandwidths[k]
    known = len(found) and np.isfinite(found).all() and found.min() > 0.0
    return float(found.max()) if known else 0.0


def write_sonar_info(info: SonarInfo, make: Make) -> Any:
    """Write a SonarInfo; of the pulse it has the length of one that is not modulated."""
    linear = {'amplitude': _AMPLITUDE, 'power': _POWER}
    return make(
        'marine_interfaces/msg/SonarInfo',
        header=make_header(info.stamp_ns, info.frame_id, make),
        intensity_quantity=linear.get(info.scale, 0),
        intensity_scale=_LINEAR if info.scale in linear else _DECIBEL if info.scale else 0,
        scale=info.gain,
        offset=info.offset,
        pulse_lengths=[info.echo_duration] if info.echo_duration else [],
        tx_signal_types=[_CW] if info.echo_duration else [],
    )
