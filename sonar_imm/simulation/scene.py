"""What every simulated scene is made of."""

from __future__ import annotations

from typing import Any

from attrs import frozen
import numpy as np

from ..measurements import FloatArray


@frozen(eq=False)
class Received:
    """A measurement and when it reached the computer, which may be long after its stamp."""

    received_ns: int
    measurement: Any


@frozen(eq=False)
class TrueTrack:
    """Where one target really was: stamp_ns (n,), position (n, 3) m, velocity (n, 2) m/s."""

    track_id: int
    stamp_ns: np.ndarray
    position: FloatArray
    velocity: FloatArray


@frozen(eq=False)
class Scene:
    """measurements in the order in which they were received; truth, e.g. one track a target.

    How a measurement or a truth of some class is recorded: `recordings.scenes`.
    """

    measurements: tuple[Received, ...]
    truth: tuple[Any, ...]
    frame_id: str = 'map'
