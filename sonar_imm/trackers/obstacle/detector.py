# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Echoes in images of a forward-looking sonar, as detections for the tracker.

`ImageDetector` takes images in and gives detections out, one message per ping. The directions of a
scanning sonar come one by one; it gathers a sweep of them first. What a sonar says of its images
(`SonarInfo`) counts in place of the parameters.
"""

from __future__ import annotations

from typing import Any

from attrs import evolve, frozen
import numpy as np

from ...acoustics.image_echoes import EchoRules, find_echoes
from ...estimation.arrays import FloatArray
from ...measurements import (
    BEAM_AXES,
    Detections,
    IMAGE_ORDERS,
    Rejection,
    SonarImage,
    SonarInfo,
)
from ...parameters import Config, ConfigError, constant, parameter

SIDES = ('port', 'starboard')
ENDS = ('near', 'far')
MAX_SWEEP = 1000
"""Directions of a sweep."""
SCALES = ('amplitude', 'power', 'decibel')
MOST_INFOS = 16
"""Sonars, by their frames, of which it is known what they say of their images."""


@frozen(kw_only=True)
class DetectorConfig(Config):
    """How images are read and echoes found in them. The defaults fit a Blueview P450."""

    # fmt: off
    # -- how images are written ------------------------------------------------------------------
    image_order: str = parameter('range_major', '',
        'order of the samples: all beams of a range together (range_major), or all ranges of a '
        'beam (beam_major)', choices=IMAGE_ORDERS)
    image_scale: str = parameter('amplitude', '',
        'what a sample is: an amplitude, a power, or a level in steps of decibel_step (decibel)',
        choices=SCALES)
    decibel_step: float = parameter(0.5, 'dB',
        'image_scale decibel: level of one count', range=(1e-3, 100.0))
    beam_axes: str = parameter('auto', '',
        'axes of the beam vectors: marine (z forward, y to starboard), rep103 (x forward, y to '
        'port), or the one along which they point (auto)', choices=BEAM_AXES)
    sound_speed: float = parameter(1500.0, 'm/s',
        'speed of sound for raw images that state none', range=(1300.0, 1700.0))
    image_near_range: float = parameter(0.0, 'm',
        'nearest range of images that state none (sensor_msgs/Image, SonoptixECHO)',
        range=(0.0, 1e4))
    image_far_range: float = parameter(0.0, 'm',
        'farthest range of images that state none; 0: unknown', range=(0.0, 1e4))
    image_fov_deg: float = parameter(0.0, 'deg',
        'width of the sector of images that state no bearings; 0: unknown', range=(0.0, 360.0))
    image_first_beam: str = parameter('port', '',
        'side of the first column of images that state no bearings', choices=SIDES)
    image_first_range: str = parameter('near', '',
        'end of the first row of images that state no ranges', choices=ENDS)

    # -- how echoes are found --------------------------------------------------------------------
    beam_width_deg: float = parameter(1.0, 'deg',
        '-3 dB width of a beam; no less than a column', range=(0.01, 90.0))
    range_resolution: float = parameter(0.3, 'm',
        '-3 dB width of the echo of a point; no less than a row', range=(1e-3, 100.0))
    training: int = constant(16, '',
        'number of rows before and behind an echo from which the noise is estimated',
        range=(2, 1000))
    training_beams: int = constant(25, '',
        'number of columns around an echo from which the noise is estimated', range=(1, 1000))
    guard: int = constant(4, '',
        'number of rows around an echo that are left out of the estimate of the noise',
        range=(0, 100))
    false_alarm: float = constant(1e-6, '',
        'probability that a cell of Rayleigh noise is taken for an echo', range=(1e-15, 0.1))
    threshold_margin_db: float = parameter(0.5, 'dB',
        'margin of the detection threshold above that of the noise and the roughness of the sea '
        'floor; -3: one of a thousand noise cells passes, not one of a million',
        range=(-3.0, 30.0))
    growth_false_alarm: float = constant(1e-3, '',
        'probability that a cell of Rayleigh noise beside an echo is taken for a part of the echo',
        range=(1e-15, 0.5))
    sidelobe_db: float = parameter(17.0, 'dB',
        'cells so far below the loudest one of their range are taken for its sidelobes',
        range=(0.0, 200.0))
    join_distance: float = parameter(1.5, 'm',
        'distance below which echoes are joined to one obstacle', range=(0.0, 100.0))
    min_range: float = parameter(1.0, 'm',
        'range below which echoes are taken for the vehicle; the first 10 rows of an image give '
        'none either', range=(0.0, 1e4))
    max_detections: int = parameter(100, '',
        'largest number of detections of a ping, the strongest', range=(1, 10_000))

    # -- a scanning sonar ------------------------------------------------------------------------
    sweep_sector_deg: float = parameter(120.0, 'deg',
        'scanning sonar: full width of the sector around ahead that is used', range=(1.0, 360.0))
    sweep_max_gap: float = constant(2.0, 's',
        'scanning sonar: time without a beam that ends a sweep', range=(0.01, 600.0))
    # fmt: on

    def rules(self) -> EchoRules:
        return EchoRules(
            beam_width=np.radians(self.beam_width_deg),
            range_resolution=self.range_resolution,
            false_alarm=self.false_alarm,
            margin=10.0 ** (0.1 * self.threshold_margin_db),
            growth=self.growth_false_alarm,
            sidelobe=10.0 ** (-0.1 * self.sidelobe_db),
            join_distance=self.join_distance,
            nearest=self.min_range,
            beams=self.training_beams,
            training=self.training,
            guard=self.guard,
        )


class ImageDetector:
    """Detections from images in the order of their stamps.

    infos: what sonars say of their images, and the parameters with it, by their frames.
    """

    def __init__(self, config: DetectorConfig):
        self.config = config
        self._sweep: list[SonarImage] = []
        self.infos: dict[str, tuple[SonarInfo, DetectorConfig]] = {}

    def process(self, image: SonarImage) -> Detections | None:
        """The echoes in an image; None for a direction of a sweep that goes on. Raises
        `Rejection`."""
        info, config = self.infos.get(image.frame_id, (None, self.config))
        if info is not None and info.gain:
            image = evolve(image, amplitude=info.gain * image.amplitude + info.offset)
        if not image.scanning:
            return detect(image, config)
        whole = self._gathered(image)
        return None if whole is None else detect(whole, config)

    def describe(self, info: SonarInfo) -> None:
        """Read the images in the frame of `info` as it says, from the next one on."""
        changes: dict[str, Any] = {}
        if info.scale:
            changes['image_scale'] = info.scale
        if info.scale == 'decibel' and info.gain:
            changes['decibel_step'] = 1.0
        if info.echo_duration > 0.0:
            changes['range_resolution'] = 0.5 * self.config.sound_speed * info.echo_duration
        try:
            config = evolve(self.config, **changes)
        except ConfigError as error:
            raise Rejection('out_of_range', f'what the sonar says of itself: {error}') from None
        self.infos.pop(info.frame_id, None)
        if len(self.infos) >= MOST_INFOS:
            self.infos.pop(next(iter(self.infos)))
        self.infos[info.frame_id] = info, config

    def _gathered(self, beam: SonarImage) -> SonarImage | None:
        """The sweep that `beam` ends, if it does; `beam` begins the next one."""
        ahead = abs(float(beam.bearing[0])) <= np.radians(0.5 * self.config.sweep_sector_deg)
        if ahead and self._goes_on(beam):
            self._sweep.append(beam)
            return None
        done, self._sweep = self._sweep, [beam] if ahead else []
        if len(done) >= 2 and beam.bearing[0] != done[-1].bearing[0] and ahead:
            self._turned(done, beam)
        return _whole(done) if len(done) >= 2 else None

    def _goes_on(self, beam: SonarImage) -> bool:
        """Whether `beam` continues the sweep: the next direction the same way round, soon, with
        the same ranges."""
        if not self._sweep:
            return True
        last = self._sweep[-1]
        gap = (beam.stamp_ns - last.stamp_ns) * 1e-9
        if not 0.0 <= gap <= self.config.sweep_max_gap or beam.frame_id != last.frame_id:
            return False
        if not np.array_equal(beam.range, last.range):
            return False
        turn = _turn(last, beam)
        if turn == 0.0 or len(self._sweep) >= MAX_SWEEP:
            return False
        if abs(turn) * len(self._sweep) >= 2.0 * np.pi:
            return False
        return len(self._sweep) < 2 or turn * _turn(self._sweep[-2], last) > 0.0

    def _turned(self, done: list[SonarImage], beam: SonarImage) -> None:
        """Where a sonar turns back, the last direction belongs to the next sweep too."""
        if _turn(done[-1], beam) * _turn(done[-2], done[-1]) < 0.0:
            self._sweep.insert(0, done[-1])


def _turn(first: SonarImage, second: SonarImage) -> float:
    """Angle from one direction to the next, rad, -pi to pi."""
    off = float(second.bearing[0] - first.bearing[0])
    return float(np.arctan2(np.sin(off), np.cos(off)))


def _whole(sweep: list[SonarImage]) -> SonarImage:
    """One image of the directions of a sweep, stamped at its end."""
    last = sweep[-1]
    delay = np.array([(beam.stamp_ns - last.stamp_ns) * 1e-9 for beam in sweep])
    return evolve(
        last,
        bearing=np.array([beam.bearing[0] for beam in sweep]),
        amplitude=np.column_stack([beam.amplitude for beam in sweep]),
        scanning=False,
        delay=delay,
    )


def detect(image: SonarImage, config: DetectorConfig) -> Detections:
    """The echoes in an image, strongest first. Raises `Rejection`."""
    amplitude, distance, bearing, delay = _in_order(image)
    if config.image_scale == 'power':
        amplitude = np.sqrt(np.maximum(amplitude, 0.0))
    elif config.image_scale == 'decibel':
        with np.errstate(over='ignore'):
            amplitude = 10.0 ** (amplitude * (config.decibel_step / 20.0))
    found = find_echoes(amplitude, distance, bearing, config.rules())
    late = np.full(len(found.bearing), np.nan)
    if delay is not None and len(bearing):
        late = np.interp(found.bearing, bearing, delay)
    n = slice(None, config.max_detections)
    return Detections(
        stamp_ns=image.stamp_ns,
        range=found.range[n],
        bearing=found.bearing[n],
        var_range=found.var_range[n],
        var_bearing=found.var_bearing[n],
        intensity=found.amplitude[n],
        extent_range=found.extent_range[n],
        extent_bearing=found.extent_bearing[n],
        frame_id=image.frame_id,
        time_offset=late[n],
    )


def _in_order(image: SonarImage) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Amplitudes (R, B), ranges, bearings and delays of what has a place, with ranges and bearings
    ascending."""
    rows, beams = _ascending(image.range), _ascending(image.bearing)
    bearing = image.bearing[beams]
    if len(bearing) and np.ptp(bearing) > 2.0 * np.pi:
        raise Rejection('out_of_range', 'the beams of the image span more than a turn')
    delay = None if image.delay is None else image.delay[beams]
    amplitude = np.asarray(image.amplitude, np.float64)[rows][:, beams]
    return amplitude, image.range[rows], bearing, delay


def _ascending(axis: FloatArray) -> np.ndarray | slice:
    """What puts the places of an axis that are numbers in order; a slice, which copies nothing,
    where they are in order already."""
    places = np.flatnonzero(np.isfinite(axis))
    if len(places) and places[-1] - places[0] == len(places) - 1:
        steps = np.diff(axis[places])
        if (steps > 0.0).all():
            return slice(places[0], places[-1] + 1)
        if (steps < 0.0).all():
            return slice(places[-1], places[0] - 1 if places[0] else None, -1)
    return places[np.argsort(axis[places], kind='stable')]
