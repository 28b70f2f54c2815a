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

"""Images in the messages of single drivers: Oculus, Ping360, Sonoptix Echo.

- ``oculus_interfaces/Ping`` (ENSTA Bretagne, Forssea): rows of ranges, little-endian. With
  `has_gains` every row begins with its gain, four bytes, and its samples are divided by the square
  root of that. The definition says that `ping_data` is the image; the driver puts the whole packet
  of the sonar there, whose end is the image. Both are read.
- ``ping360_sonar_msgs/SonarEcho`` (Centrale Nantes): one direction of a scanning sonar. Sample k
  lies at ``(k + 1) range / samples``, as in the driver.
- ``sensors/SonoptixECHO`` (recordings of SOLAQUA): a Float32MultiArray of ranges by beams.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sonar_imm.measurements import Rejection, SonarImage

from .headers import stamp_ns
from .sonar_images import check_cells, on_a_grid

_GAIN_BYTES = 4
_PACKET = b'SO'
"""The first bytes of a packet of the Oculus (0x4f53, little-endian)."""
_SAMPLES = {1: '<u1', 2: '<u2', 4: '<u4'}
_FARTHEST = 1e4


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
    if not (np.isfinite(resolution) and 0.0 < resolution * max(rows, 1) <= _FARTHEST):
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
        stamp_ns=stamp_ns(message),
        range=resolution * (np.arange(rows) + 0.5),
        bearing=-np.radians(0.01 * bearings),
        amplitude=amplitude,
        frame_id=str(message.header.frame_id),
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
        stamp_ns=stamp_ns(message),
        range=far * (np.arange(len(samples)) + 1.0) / len(samples),
        bearing=np.array([np.arctan2(np.sin(angle), np.cos(angle))]),
        amplitude=samples.astype(np.float64)[:, None],
        frame_id=str(message.header.frame_id),
        scanning=True,
    )


def read_sonoptix_echo(
    message: Any, *, image_order: str = 'range_major', **geometry: Any
) -> SonarImage:
    """Read a SonoptixECHO; geometry: see `sonar_images.on_a_grid`. Raises `Rejection`."""
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
