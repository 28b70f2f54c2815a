# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is known of a scene: measurements in the order of reception, and the truth as tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Protocol

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from .estimation.arrays import FloatArray


@frozen(eq=False)
class Received:
    """A measurement and when it was received, which may be long after its stamp.

    namespace: put before the topic when there are several instruments of one kind.
    """

    received_ns: int
    measurement: Any
    namespace: str = ''


@frozen(eq=False)
class TruthTable:
    """The truth of one stamp as it is recorded: columns (n,) by name, ``x y z`` f4 [m] first.

    namespace: put before its topic when several instruments of one kind are on board.
    """

    stamp_ns: int
    frame_id: str
    columns: Mapping[str, np.ndarray]
    namespace: str = ''


class Truth(Protocol):
    """What a scene knows of its targets, in tables."""

    def tables(self, frame_id: str) -> Iterable[TruthTable]:
        """Give the truth of each stamp, in `frame_id` unless it has a frame of its own."""
        ...


@frozen(eq=False)
class TrueTrack:
    """Where one target really was: stamp_ns (n,), position (n, 2 or 3) m, velocity (n, 2) m/s, NaN
    where unknown."""

    track_id: int
    stamp_ns: np.ndarray
    position: FloatArray
    velocity: FloatArray

    def tables(self, frame_id: str) -> Iterator[TruthTable]:
        """Give one row per stamp: ``x y z px py vx vy track_id``."""
        position = np.asarray(self.position, np.float64)
        xyz = np.zeros((len(position), 3), np.float32)
        xyz[:, : position.shape[1]] = position
        columns = {
            **dict(zip('xyz', xyz.T)),
            **dict(zip(('px', 'py'), position.T)),
            **dict(zip(('vx', 'vy'), np.asarray(self.velocity, np.float64).T)),
            'track_id': np.full(len(xyz), self.track_id, np.uint32),
        }
        for k, stamp in enumerate(self.stamp_ns):
            row = {name: column[k : k + 1] for name, column in columns.items()}
            yield TruthTable(int(stamp), frame_id, row)


@frozen(eq=False)
class TrueProfile:
    """The floor that one ping really saw, one row per range bin.

    range (n,) m; height (n,) m above the reference floor; angle (n,) rad from broadside; patch
    (n,) rough floor; valid (n,) False in shadow and water column; xyz (n, 3) m in `frame_id`.
    Where the floor cannot answer, angle and xyz are NaN. `namespace` is that of the snapshot.
    surfaces (n,): how many surfaces answer in a bin, the height is that of the strongest, and
    height_2 (n,) m of the next, NaN for none; None where the scene has no objects.
    """

    stamp_ns: int
    frame_id: str
    range: FloatArray
    height: FloatArray
    angle: FloatArray
    patch: NDArray[np.bool_]
    valid: NDArray[np.bool_]
    xyz: FloatArray
    namespace: str = ''
    surfaces: NDArray[np.uint8] | None = None
    height_2: FloatArray | None = None

    def tables(self, frame_id: str) -> Iterator[TruthTable]:
        """Give one row per range bin: ``x y z range height angle patch valid``, with objects
        ``surfaces height_2`` besides."""
        columns = {
            **dict(zip('xyz', np.asarray(self.xyz, np.float32).T)),
            'range': self.range,
            'height': self.height,
            'angle': self.angle,
            'patch': self.patch,
            'valid': self.valid,
        }
        if self.surfaces is not None and self.height_2 is not None:
            columns |= {'surfaces': self.surfaces, 'height_2': self.height_2}
        yield TruthTable(self.stamp_ns, self.frame_id, columns, self.namespace)


PRESENT = 0.4
"""A reflector is present while it has more than this share of its largest amplitude."""


@frozen(eq=False)
class TrueReflectors:
    """The reflectors that one record really had: track_id (n,), depth (n,) m, amplitude (n,) of
    reflection."""

    stamp_ns: int
    frame_id: str
    track_id: NDArray[np.uint32]
    depth: FloatArray
    amplitude: FloatArray

    def tables(self, frame_id: str) -> Iterator[TruthTable]:
        """Give one row per reflector, or none: ``x y z depth amplitude track_id``."""
        zero = np.zeros(len(self.depth), np.float32)
        columns: dict[str, np.ndarray] = {
            'x': zero,
            'y': zero,
            'z': (-self.depth).astype(np.float32),
            'depth': self.depth,
            'amplitude': self.amplitude,
            'track_id': np.asarray(self.track_id, np.uint32),
        }
        yield TruthTable(self.stamp_ns, self.frame_id, columns)


@frozen(eq=False)
class Scene:
    """Measurements in the order in which they were received, and the truth, e.g. one track per
    target or one profile per ping."""

    measurements: tuple[Received, ...]
    truth: tuple[Truth, ...]
    frame_id: str = 'map'
