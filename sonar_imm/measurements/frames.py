"""One tracker, one frame: measurements in different frames must not be mixed without a word.

Each measurement class says in `frame_of` whose frame it is in. ``'tracks'`` is the frame of the
estimates, and all of those have to share it. What a sensor on board says of itself is in that
sensor's own frame, and each such kind of measurement has to keep to one, too. An empty `frame_of`
means that the frame does not matter.
"""

from __future__ import annotations

from typing import Any

from .checks import Rejection

TRACKS = 'tracks'
"""`frame_of` of the measurements that share the frame of the estimates."""


class FrameGuard:
    """Lets one frame of the tracks pass: the one it is told, or else the first that a measurement
    names; and one frame of each kind of sensor on board."""

    def __init__(self, frame_id: str = ''):
        """Expect `frame_id`; empty means that the measurements decide."""
        self._told = frame_id
        self.reset()

    @property
    def frame_id(self) -> str:
        """The frame of the tracks, empty until one is known."""
        return self._frames[TRACKS]

    def check(self, measurement: Any) -> None:
        """Raise `Rejection` when `measurement` is in another frame.

        One without a frame passes only until a frame is known.
        """
        if not measurement.frame_of:
            return
        expected = self._frames.get(measurement.frame_of, '')
        if not expected:
            self._frames[measurement.frame_of] = measurement.frame_id
        elif measurement.frame_id != expected:
            whose = 'the tracks' if measurement.frame_of == TRACKS else 'earlier ones'
            raise Rejection(
                'frame',
                f"the frame '{measurement.frame_id}' is not the frame '{expected}' of {whose}",
            )

    def reset(self) -> None:
        """Let the measurements decide again, unless a frame was told."""
        self._frames = {TRACKS: self._told}
