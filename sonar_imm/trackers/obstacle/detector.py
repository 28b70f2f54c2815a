"""Echoes in images of a forward-looking sonar, as detections for the tracker.

A convenience: a detector that knows the sonar is better.
"""

from __future__ import annotations

from typing import Any

from attrs import frozen
import numpy as np

from ...acoustics.cfar import cfar_peaks
from ...measurements import BEAM_AXES, Detections, IMAGE_ORDERS, SonarImage
from ...parameters import Config, parameter


@frozen(kw_only=True)
class DetectorConfig(Config):
    """How images are read and echoes found in them."""

    image_order: str = parameter(
        'range_major',
        'how samples lie: all beams of a range together, or all ranges of a beam',
        choices=IMAGE_ORDERS,
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

    def reading(self) -> dict[str, Any]:
        """What `msg_adapters.sonar_images.read_sonar_image` has to be told."""
        return {name: getattr(self, name) for name in ('image_order', 'beam_axes', 'sound_speed')}


def detect(image: SonarImage, config: DetectorConfig) -> Detections:
    """The echoes in an image, strongest first. Raises `Rejection`."""
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
