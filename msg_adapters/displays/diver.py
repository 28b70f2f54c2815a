# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Displays of divers: a PoseArray of all at once, and markers.

Odometry comes one message per diver, and a display that keeps the newest message shows one diver.
Each diver is drawn as an ellipse that holds 90 % of where it may be, an arrow to where it will be
in a few seconds, and a label.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import math
from typing import Any

import numpy as np

from sonar_imm.estimates import Estimate

from ..estimates import write_odometry
from ..headers import Make, make_header, make_pose, make_vector
from .tracks import (
    confirmed_rows,
    Drawn,
    make_marker,
    Markers,
    MODELS,
    models_of_the_oldest,
    NAMED_SCALARS,
)

NAMES = ('place', 'course', 'label')
"""Namespaces of the markers of one diver."""
AHEAD = 5.0
"""Seconds of swimming that the arrow shows."""
_ARROW, _CYLINDER, _TEXT = 0, 3, 9
_NINETY = math.sqrt(-2.0 * math.log(0.1))
"""Standard deviations to the edge of the ellipse that holds 90 % of a Gaussian in the plane."""
_SEEN, _COASTING = (0.0, 0.45, 0.7), (0.6, 0.6, 0.6)
_COASTS = 2
_LEAST = 0.05
"""Metres: a display draws nothing thinner."""
FAMILIES = ('family_steady', 'family_brisk', 'family_lively', 'family_quiet', 'hover')
"""Sums of the models of the set `families`, easier to plot than its 37 models."""


class Displays:
    """One Odometry per diver, told apart by ``child_frame_id``; all at once as poses and as
    markers; the models."""

    topics: Mapping[str, str] = {
        'odometry': 'nav_msgs/msg/Odometry',
        'divers': 'geometry_msgs/msg/PoseArray',
        'markers': 'visualization_msgs/msg/MarkerArray',
        MODELS: NAMED_SCALARS,
    }

    def __init__(self) -> None:
        self._markers = Markers(NAMES, write_markers)

    def of(self, estimate: Estimate, make: Make, is_wanted: Callable[[str], Any]) -> Drawn:
        rows = confirmed_rows(estimate)
        if is_wanted('odometry'):
            for row in rows:
                yield 'odometry', write_odometry(estimate, row, make)
        if is_wanted('divers'):
            yield 'divers', write_poses(estimate, rows, make)
        yield from self._markers.of(estimate, rows, make, is_wanted)
        yield from models_of_the_oldest(estimate, rows, make, is_wanted, FAMILIES)

    def forget(self, make: Make) -> Drawn:
        return self._markers.forget(make)


def write_poses(estimate: Estimate, rows: Iterable[int], make: Make) -> Any:
    """Write a PoseArray of the divers in `rows`, x forward along their velocity."""
    poses = []
    for row in rows:
        half = 0.5 * math.atan2(*_velocity(estimate, row)[::-1])
        turn = (0.0, 0.0, math.sin(half), math.cos(half))
        poses.append(make_pose(_place(estimate, row), make, turn))
    header = make_header(estimate.stamp_ns, estimate.frame_id, make)
    return make('geometry_msgs/msg/PoseArray', header=header, poses=poses)


def write_markers(estimate: Estimate, rows: Iterable[int], make: Make) -> Any:
    """Write a MarkerArray of ellipses, arrows and labels."""
    markers = [marker for row in rows for marker in _diver(estimate, row, make)]
    return make('visualization_msgs/msg/MarkerArray', markers=markers)


def _diver(estimate: Estimate, row: int, make: Make) -> list[Any]:
    x, y, z = _place(estimate, row)
    vx, vy = _velocity(estimate, row)
    track_id = int(estimate.extras['track_id'][row])
    coasts = int(estimate.extras['track_state'][row]) == _COASTS
    speed = math.hypot(vx, vy)
    at = [estimate.state_names.index(name) for name in ('px', 'py')]
    variance, axes = np.linalg.eigh(estimate.covariance[row][np.ix_(at, at)])
    half = 0.5 * math.atan2(axes[1, 1], axes[0, 1])  # the long axis is the last one
    wide, long = (max(2.0 * _NINETY * math.sqrt(max(v, 0.0)), _LEAST) for v in variance)

    def marker(name: str, kind: int, size: tuple[float, float, float], **more: Any) -> Any:
        colour = (*(_COASTING if coasts else _SEEN), 0.3 if name == 'place' else 1.0)
        return make_marker(estimate, row, make, name, kind, size, colour, **more)

    ends = [(x, y, z), (x + AHEAD * vx, y + AHEAD * vy, z)]
    points = [make_vector(end, make, 'Point') for end in ends]
    turn = (0.0, 0.0, math.sin(half), math.cos(half))
    words = f'{track_id}: {speed:.1f} m/s' + (', not seen' if coasts else '')
    return [
        marker('place', _CYLINDER, (long, wide, _LEAST), pose=make_pose((x, y, z), make, turn)),
        marker('course', _ARROW, (0.2, 0.5, 0.5), points=points, pose=make_pose((0, 0, 0), make)),
        marker('label', _TEXT, (0.0, 0.0, 1.0), text=words, pose=make_pose((x, y, z + 1.0), make)),
    ]


def _place(estimate: Estimate, row: int) -> tuple[float, float, float]:
    x, y = (float(estimate.state[row, estimate.state_names.index(n)]) for n in ('px', 'py'))
    return x, y, float(estimate.xyz[row, 2])


def _velocity(estimate: Estimate, row: int) -> tuple[float, float]:
    vx, vy = (float(estimate.state[row, estimate.state_names.index(n)]) for n in ('vx', 'vy'))
    return vx, vy
