"""One tracker, one frame: measurements in different frames must not be mixed without a word."""

from __future__ import annotations

from typing import Any

from sonar_imm.measurements import Rejection


class FrameGuard:
    """Lets one frame pass: the one it is told, or else that of the first measurement it sees."""

    def __init__(self, frame_id: str = ''):
        """Expect `frame_id`; empty means that the first measurement decides."""
        self._expected = frame_id
        self._frame_id: str | None = frame_id or None

    def check(self, measurement: Any) -> None:
        """Raise `Rejection` when `measurement` is in another frame; an empty name is one too."""
        if self._frame_id is None:
            self._frame_id = measurement.frame_id
        elif measurement.frame_id != self._frame_id:
            raise Rejection('frame', f"the frame '{measurement.frame_id}' is not the frame "
                                     f"'{self._frame_id}' of the tracks")

    def reset(self) -> None:
        """Let the next measurement decide again, unless a frame was told."""
        self._frame_id = self._expected or None
