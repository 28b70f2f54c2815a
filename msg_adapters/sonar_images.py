"""Images of a forward-looking sonar, and the echoes in them as detections.

The messages are marine_acoustic_msgs ProjectedSonarImage and RawSonarImage: magnitudes by range
and beam. They do not say in which order the samples lie, and publishers differ, so it is a
parameter: ``range_major`` (all beams of the first range first: image = range * beams + beam) or
``beam_major`` (all ranges of the first beam first). The wrong order gives stripes, not an error.
"""

from __future__ import annotations

from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.acoustics.cfar import cfar_peaks
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Detections, Rejection
from sonar_imm.parameters import Config, parameter

from .detections import BEAM_AXES, beam_bearings, SOUND_SPEEDS
from .headers import stamp_ns

DTYPES = ('u1', 'i1', 'u2', 'i2', 'u4', 'i4', 'u8', 'i8', 'f4', 'f8')
IMAGE_TYPES = (
    'marine_acoustic_msgs/msg/ProjectedSonarImage',
    'marine_acoustic_msgs/msg/RawSonarImage',
)


@frozen(kw_only=True)
class DetectorConfig(Config):
    """How images are read and echoes found in them."""

    image_order: str = parameter(
        'range_major',
        'how samples lie: all beams of a range together, or all ranges of a beam',
        choices=('range_major', 'beam_major'),
    )
    beam_axes: str = parameter(
        'auto',
        'axes of the beam vectors: marine (z forward, y to starboard), rep103 (x forward, '
        'y to port), or by which of the two the beams point along',
        choices=BEAM_AXES,
    )
    sound_speed: float = parameter(
        1500.0, 'of raw images that state none', unit='m/s', low=1300.0, high=1700.0
    )
    guard: int = parameter(2, 'range cells around an echo that are not noise', low=0, high=100)
    training: int = parameter(
        12, 'range cells on either side that tell the noise', low=2, high=1000
    )
    false_alarm: float = parameter(
        1e-6, 'that a cell of noise is taken for an echo', low=1e-15, high=0.1
    )
    min_range: float = parameter(
        1.0, 'echoes from nearer are the vehicle', unit='m', low=0.0, high=1e4
    )
    max_detections: int = parameter(100, 'of a ping, the strongest', low=1, high=10_000)


@frozen(eq=False)
class SonarImage:
    """range (R,) m and bearing (B,) rad, positive to port, of the magnitudes amplitude (R, B)."""

    stamp_ns: int
    range: FloatArray
    bearing: FloatArray
    amplitude: FloatArray
    frame_id: str = ''


def read_sonar_image(message: Any, config: DetectorConfig) -> SonarImage:
    """Read either message, told apart by its fields. Raises `Rejection`."""
    if hasattr(message, 'ranges'):
        distance = np.array(message.ranges, np.float64)
        beams = np.array(
            [[beam.x, beam.y, beam.z] for beam in message.beam_directions], np.float64
        ).reshape(-1, 3)
        bearing = beam_bearings(beams, config.beam_axes)
    else:
        distance = _raw_ranges(message, config.sound_speed)
        bearing = -np.array(message.rx_angles, np.float64)  # receive angles count to starboard
    amplitude = _samples(message.image, len(distance), len(bearing), config.image_order)
    return SonarImage(
        stamp_ns(message), distance, bearing, amplitude, str(message.header.frame_id)
    )


def detect(message: Any, config: DetectorConfig) -> Detections:
    """The echoes in an image, strongest first. Raises `Rejection`."""
    image = read_sonar_image(message, config)
    usable = np.isfinite(image.range) & (image.range >= config.min_range)
    peaks = cfar_peaks(
        image.amplitude,
        guard=config.guard,
        training=config.training,
        false_alarm=config.false_alarm,
    )
    row, beam = peaks[usable[peaks[:, 0]] & np.isfinite(image.bearing[peaks[:, 1]])].T
    row, beam = row[: config.max_detections], beam[: config.max_detections]
    return Detections(
        stamp_ns=image.stamp_ns,
        range=image.range[row],
        bearing=image.bearing[beam],
        intensity=image.amplitude[row, beam],
        frame_id=image.frame_id,
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


def _samples(image: Any, ranges: int, beams: int, order: str) -> FloatArray:
    """The magnitudes (ranges, beams)."""
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
