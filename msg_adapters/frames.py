"""One tracker, one frame: measurements in different frames must not be mixed without a word."""

from __future__ import annotations

from typing import Any

from sonar_imm.measurements import ArrayDepth, Rejection


class FrameGuard:
    """Lets one frame pass: the one it is told, or else the first that a measurement names."""

    def __init__(self, frame_id: str = ''):
        """Expect `frame_id`; empty means that the measurements decide."""
        self._told = self._frame_id = frame_id

    def check(self, measurement: Any) -> None:
        """Raise `Rejection` when `measurement` is in another frame.

        One without a frame passes only until a frame is known. A depth is a depth in any frame.
        """
        if isinstance(measurement, ArrayDepth):
            return
        if not self._frame_id:
            self._frame_id = measurement.frame_id
        elif measurement.frame_id != self._frame_id:
            raise Rejection('frame', f"the frame '{measurement.frame_id}' is not the frame "
                                     f"'{self._frame_id}' of the tracks")

    def reset(self) -> None:
        """Let the measurements decide again, unless a frame was told."""
        self._frame_id = self._told
