"""Images of a forward-looking sonar.

The messages are marine_acoustic_msgs ProjectedSonarImage and RawSonarImage: magnitudes by range
and beam. They do not say in which order the samples lie, and publishers differ, so it is a
parameter: ``range_major`` (all beams of the first range first: image = range * beams + beam) or
``beam_major`` (all ranges of the first beam first). The wrong order gives stripes, not an error.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Rejection, SonarImage

from .detections import beam_bearings, SOUND_SPEEDS
from .headers import stamp_ns

DTYPES = ('u1', 'i1', 'u2', 'i2', 'u4', 'i4', 'u8', 'i8', 'f4', 'f8')
IMAGE_TYPES = (
    'marine_acoustic_msgs/msg/ProjectedSonarImage',
    'marine_acoustic_msgs/msg/RawSonarImage',
)


def read_sonar_image(
    message: Any,
    *,
    image_order: str = 'range_major',
    beam_axes: str = 'auto',
    sound_speed: float = 1500.0,
) -> SonarImage:
    """Read either message, told apart by its fields.

    image_order: see the module's text; beam_axes: as in `detections.read_sonar_ranges`;
    sound_speed: m/s, of raw images that state none. Raises `Rejection`.
    """
    if hasattr(message, 'ranges'):
        distance = np.array(message.ranges, np.float64)
        beams = np.array(
            [[beam.x, beam.y, beam.z] for beam in message.beam_directions], np.float64
        ).reshape(-1, 3)
        bearing = beam_bearings(beams, beam_axes)
    else:
        distance = _raw_ranges(message, sound_speed)
        bearing = -np.array(message.rx_angles, np.float64)  # receive angles count to starboard
    amplitude = image_samples(message.image, len(distance), len(bearing), image_order)
    return SonarImage(
        stamp_ns=stamp_ns(message),
        range=distance,
        bearing=bearing,
        amplitude=amplitude,
        frame_id=str(message.header.frame_id),
    )


def _raw_ranges(message: Any, sound_speed: float) -> FloatArray:
    """(R,) metres; sample k came ``(sample0 + k) / sample_rate`` seconds after transmission."""
    rate = float(message.sample_rate)
    if not (np.isfinite(rate) and rate > 0.0):
        raise Rejection('out_of_range', f'the sample rate of the image is {rate:g} Hz')
    count = int(message.samples_per_beam)
    if count > 1_000_000:
        raise Rejection('too_large', f'an image with {count} samples per beam')
    stated = float(message.ping_info.sound_speed)
    speed = stated if SOUND_SPEEDS[0] <= stated <= SOUND_SPEEDS[1] else sound_speed
    return (int(message.sample0) + np.arange(count)) * speed / (2.0 * rate)


def image_samples(image: Any, ranges: int, beams: int, order: str) -> FloatArray:
    """The samples (ranges, beams) of an image. Raises `Rejection`."""
    if not 0 <= int(image.dtype) < len(DTYPES):
        raise Rejection('bad_field', f'the image has the unknown datatype {int(image.dtype)}')
    if int(image.beam_count) != beams:
        raise Rejection(
            'bad_shape', f'the image has {int(image.beam_count)} beams but {beams} directions'
        )
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
