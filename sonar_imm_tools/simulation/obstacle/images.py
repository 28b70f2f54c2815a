# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Images of a forward-looking sonar, built from what scatters sound and not from a law of
detections.

Noise, water and sea floor are complex Gaussian speckle, as wide as a beam and as long as the
pulse: white noise passed through both. Its mean power is ``1 + reverberation (10 m / r)^2`` and,
where the sea floor is in the beam, that of patches of gamma distributed power (K distribution).
The patches lie in the world, so the same rough spot comes back in ping after ping.

Obstacles are points: the pattern of a beam with sidelobes times the envelope of the pulse. A
chain, a float or the outline of a wreck is a group of them with amplitudes drawn anew in every
ping, since between two pings its glints move by many wavelengths against each other. All are seen
through the vertical pattern of the sonar, out and back.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from scipy.ndimage import convolve1d
from scipy.signal.windows import taylor

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation.arrays import ComplexArray, FloatArray
from sonar_imm.measurements import SonarImage
from sonar_imm.truth import Received

from ..scenario import delay_ns
from .scenario import LATE_DELAY, ObstacleScenario, PULSE_LENGTH

_TEXTURE = 256
"""Patches of the sea floor along each axis before they repeat."""
_GLINTS = {'point': 1, 'chain': 60, 'float': 10, 'wreck': 80}
_HULL = np.array([[0.5, 0.0], [0.2, 0.12], [-0.5, 0.12], [-0.5, -0.12], [0.2, -0.12], [0.5, 0.0]])
"""Corners of the outline of a wreck, along it and across, in lengths: bow ahead, stern flat."""
SEABED_POWER = 10.0
"""Mean power of the sea floor where the edge of the beam meets it, over the noise."""
_FAR_SIDELOBES = 6.0
"""Sidelobes farther than this many beam widths from the beam are left out of speckle."""


class ImageSonar:
    """Makes the images of one scene; every call of `image` draws from the same generator.

    range (R,) m: centres of the bins; bearing (B,) rad, positive to port, port first; heading:
    rad from north of the line of a chain or a wreck.
    """

    def __init__(self, config: ObstacleScenario, rng: Generator):
        self.config = config
        self._rng = rng
        step = config.max_range / config.image_bins
        self.range = step * (np.arange(config.image_bins) + 0.5)
        half = np.radians(0.5 * config.horizontal_fov_deg)
        beam_step = 2.0 * half / config.image_beams
        self.bearing = half - beam_step * (np.arange(config.image_beams) + 0.5)
        self._beam = _BeamPattern(np.radians(config.beam_width_deg), config.sidelobe_db)
        reach = int(np.ceil(_FAR_SIDELOBES * np.radians(config.beam_width_deg) / beam_step))
        self._across = _unit(self._beam(beam_step * np.arange(-reach, reach + 1)))
        reach = int(np.ceil(2.0 * PULSE_LENGTH / step))
        self._along = _unit(self._pulse(step * np.arange(-reach, reach + 1, dtype=np.float64)))
        shape = config.seabed_shape
        self._texture = rng.gamma(shape, 1.0 / shape, (_TEXTURE, _TEXTURE))
        self._chain = rng.uniform(-0.5, 0.5, 60) * config.target_size
        self.heading = rng.uniform(0.0, np.pi)
        ball = rng.normal(size=(10, 3))
        radius = 0.5 * config.target_size * rng.uniform(size=(10, 1)) ** (1.0 / 3.0)
        self._ball = radius * ball / np.linalg.norm(ball, axis=1, keepdims=True)

    def image(self, sonar: Pose, places: list[FloatArray], stretch: float) -> np.ndarray:
        """The image (R, B), 0 to 255, that the sonar at `sonar` (NED) makes of obstacles at
        `places` (3,) NED. `stretch` is the scale error of the ranges."""
        mean = self.mean_power(sonar)
        speckle = self._speckle() * np.sqrt(mean)
        for place in places:
            speckle += self.echo(sonar, place, stretch, mean)
        counts = self.config.image_gain * np.abs(speckle)
        return np.minimum(np.round(counts), 255.0).astype(np.uint8)

    def _speckle(self) -> ComplexArray:
        """(R, B) of unit mean power."""
        shape = len(self.range), len(self.bearing)
        parts = np.sqrt(0.5) * self._rng.normal(size=(2, *shape))
        for axis, pattern in ((1, self._along), (2, self._across)):
            parts = convolve1d(parts, pattern, axis=axis, mode='wrap')
        return parts[0] + 1j * parts[1]

    def mean_power(self, sonar: Pose) -> FloatArray:
        """(R, B) of noise, water and sea floor."""
        config, r = self.config, self.range[:, None]
        mean = np.ones((len(self.range), len(self.bearing)))
        mean += config.reverberation * np.square(10.0 / r)
        # Depth of the sea floor below the sonar, and the direction of its echoes.
        below = config.depth + config.altitude - sonar.position[2]
        if below <= 0.0:
            return mean
        there = r > below
        level = np.sqrt(np.maximum(np.square(r) - below**2, 0.0))
        yaw = np.arctan2(sonar.R[1, 0], sonar.R[0, 0]) - self.bearing
        north, east = level * np.cos(yaw), level * np.sin(yaw)
        down = np.full_like(north, below)
        seen = np.stack([north, east, down], axis=-1) @ sonar.R
        onset = below / np.sin(np.radians(0.5 * config.vertical_fov_deg))
        power = SEABED_POWER * 4.0 * np.square(onset / r)
        power = power * self._vertical(seen) * there
        patch = np.stack([sonar.position[0] + north, sonar.position[1] + east])
        i, j = np.floor(patch / config.seabed_patch).astype(int) % _TEXTURE
        return mean + power * self._texture[i, j]

    def echo(
        self, sonar: Pose, place: FloatArray, stretch: float, mean: FloatArray
    ) -> ComplexArray | float:
        """Complex amplitudes (R, B) of one obstacle."""
        config = self.config
        body = geometry.to_body(sonar, place + self._shape())
        d, azimuth = geometry.project(body, config.azimuth_model)
        centre, _ = geometry.project(geometry.to_body(sonar, place), config.azimuth_model)
        row = int(np.clip(np.searchsorted(self.range, centre), 0, len(self.range) - 1))
        beam = int(np.argmin(np.abs(self.bearing + np.median(azimuth))))
        if centre > self.range[-1] + config.target_size or body[..., 0].max() <= 0.0:
            return 0.0
        # Over the mean of the neighbourhood and not of the very cell, which is a patch by chance.
        around = mean[max(row - 8, 0) : row + 9, max(beam - 12, 0) : beam + 13].mean()
        power = 10.0 ** (0.1 * config.target_snr_db) * around * self._vertical(body)
        n = len(body)
        phase = np.exp(2j * np.pi * self._rng.uniform(size=n))
        fading = np.ones(n)
        if n > 1 or config.target_fading == 'rayleigh':
            fading = np.sqrt(self._rng.exponential(size=n))
        # The power of a group is that of all its glints where one beam holds them all.
        amplitude = phase * fading * np.sqrt(power / (n if config.target == 'float' else 1))
        if config.target in ('chain', 'wreck'):
            amplitude *= np.sqrt(self._share_of_a_beam(float(centre)))
        along = self._pulse(self.range[:, None] - d * stretch)
        across = self._beam(self.bearing + azimuth[:, None])
        return (along * amplitude) @ across

    def _shape(self) -> FloatArray:
        """Glints (n, 3) about the place of an obstacle, NED."""
        if self.config.target == 'float':
            return self._ball
        if self.config.target == 'chain':
            line = np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
            return self._chain[:, None] * line
        if self.config.target == 'wreck':
            sine, cosine = np.sin(self.heading), np.cos(self.heading)
            turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
            outline = _along(_HULL, _GLINTS['wreck'])
            outline = self.config.target_size * (outline - outline.mean(axis=0))
            return np.column_stack([outline, np.zeros(len(outline))]) @ turn.T
        return np.zeros((1, 3))

    def _share_of_a_beam(self, distance: float) -> float:
        """Share of the glints of a line that fall into one beam and pulse, one at least."""
        inside = max(distance * np.radians(self.config.beam_width_deg), PULSE_LENGTH)
        length = max(self.config.target_size, 1e-9)
        if self.config.target == 'wreck':
            length *= np.linalg.norm(np.diff(_HULL, axis=0), axis=1).sum()
        glints = _GLINTS[self.config.target] * min(1.0, inside / length)
        return 1.0 / max(1.0, glints)

    def _pulse(self, off: FloatArray) -> FloatArray:
        """Amplitude of the envelope `off` metres beside the echo."""
        return np.exp(-2.0 * np.log(2.0) * np.square(off / PULSE_LENGTH))

    def _vertical(self, body: FloatArray) -> FloatArray:
        """Power, out and back, of what lies at `body` (..., 3) FRD; 1/4 at the edge."""
        length = np.maximum(np.linalg.norm(body, axis=-1), 1e-9)
        elevation = np.arcsin(np.clip(body[..., 2] / length, -1.0, 1.0))
        return vertical_pattern(elevation, np.radians(self.config.vertical_fov_deg))


def image_pings(
    config: ObstacleScenario,
    poses: Pose,
    stamps: np.ndarray,
    places: list[FloatArray],
    stretch: float,
    seed: int,
) -> list[Received]:
    """The image of each ping that is not lost. poses: of the sonar at the n `stamps`, NED; places:
    (n, 3) NED of each obstacle."""
    rng = np.random.default_rng([seed, 2])
    sonar = ImageSonar(config, rng)
    received = []
    for k, stamp in enumerate(stamps):
        pose = Pose(poses.position[k], poses.R[k])
        pixels = sonar.image(pose, [place[k] for place in places], stretch)
        late = delay_ns(config, LATE_DELAY, rng)
        if rng.uniform() < config.ping_loss:
            continue
        image = SonarImage(
            stamp_ns=int(stamp),
            range=sonar.range,
            bearing=sonar.bearing,
            amplitude=pixels.astype(np.float64),
            frame_id='sonar',
        )
        received.append(Received(int(stamp) + late, image))
    return received


def vertical_pattern(elevation: FloatArray, width: float) -> FloatArray:
    """Power from `elevation` rad, out and back, in a Gaussian beam `width` rad high (-3 dB)."""
    return np.exp(-8.0 * np.log(2.0) * np.square(elevation / width))


class _BeamPattern:
    """Amplitude of a line array shaded after Taylor, 1 ahead, `width` rad wide at -3 dB."""

    def __init__(self, width: float, sidelobe_db: float):
        elements = max(32, int(np.ceil(8.0 / width)))  # no grating lobes in half a turn
        self._weight = taylor(elements, nbar=6, sll=sidelobe_db)
        self._place = np.arange(elements) - 0.5 * (elements - 1)
        self._scale = 1.0
        u = np.linspace(0.0, 1.0, 4001) / elements
        half = np.interp(-np.sqrt(0.5), -self(u), u)
        self._scale = 2.0 * half / width

    def __call__(self, off: FloatArray) -> FloatArray:
        phase = 2.0 * np.pi * self._scale * np.multiply.outer(off, self._place)
        return np.cos(phase) @ self._weight / self._weight.sum()


def _along(corners: FloatArray, count: int) -> FloatArray:
    """Points (count, 2) evenly along the line through corners (n, 2)."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = (np.arange(count) + 0.5) * (way[-1] / count)
    return np.column_stack([np.interp(at, way, corners[:, i]) for i in range(2)])


def _unit(pattern: FloatArray) -> FloatArray:
    return pattern / np.sqrt(np.sum(np.square(pattern)))
