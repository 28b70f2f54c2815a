"""One tracker, one frame: measurements in different frames must not be mixed without a word.

What a sensor on a vehicle says of itself is not in the frame of the tracks, but in its own, and
each such kind of measurement has to keep to one, too.
"""

from __future__ import annotations

from typing import Any

from sonar_imm.measurements import frame_role, Rejection


class FrameGuard:
    """Lets one frame pass: the one it is told, or else the first that a measurement names."""

    def __init__(self, frame_id: str = ''):
        """Expect `frame_id`; empty means that the measurements decide."""
        self._told = self._frame_id = frame_id
        self._on_board: dict[type, FrameGuard] = {}

    def check(self, measurement: Any) -> None:
        """Raise `Rejection` when `measurement` is in another frame.

        One without a frame passes only until a frame is known. A depth is a depth in any frame.
        """
        role = frame_role(measurement)
        if role == 'none':
            return
        if role == 'own':
            guard = self._on_board.setdefault(type(measurement), FrameGuard())
            guard._check(measurement, 'earlier ones')
        else:
            self._check(measurement, 'the tracks')

    def _check(self, measurement: Any, whose: str) -> None:
        if not self._frame_id:
            self._frame_id = measurement.frame_id
        elif measurement.frame_id != self._frame_id:
            raise Rejection(
                'frame',
                f"the frame '{measurement.frame_id}' is not the frame "
                f"'{self._frame_id}' of {whose}",
            )

    def reset(self) -> None:
        """Let the measurements decide again, unless a frame was told."""
        self._frame_id = self._told
        self._on_board.clear()
