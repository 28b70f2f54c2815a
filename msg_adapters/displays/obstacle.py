# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Displays of obstacles: a PoseArray, and markers that show the band of the vertical offset.

A point in a display would suggest that the height is known. So each obstacle is drawn as a bar
over the 90 % band of its vertical offset, coloured by whether it is above or below, with a ball at
the mean, coloured by the probability of a collision, and a label. The id of a marker
is the track id. Markers of a track that is over are deleted; all have a lifetime besides, so that
they vanish when nothing is published any more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from sonar_imm.estimates import Estimate

from ..headers import Make, make_header, make_pose
from .tracks import (
    confirmed_rows,
    Drawn,
    make_marker,
    Markers,
    MODELS,
    models_of_the_oldest,
    NAMED_SCALARS,
)

NAMES = ('band', 'obstacle', 'label')
"""Namespaces of the markers of one obstacle."""
_CUBE, _SPHERE, _TEXT = 1, 2, 9
_ABOVE, _BELOW, _UNKNOWN = (0.84, 0.37, 0.0), (0.0, 0.45, 0.7), (0.6, 0.6, 0.6)
_CLEAR, _NEAR, _DANGER = (0.3, 0.75, 0.4), (0.95, 0.75, 0.1), (0.85, 0.1, 0.1)
DANGERS = (0.05, 0.2)
"""Probabilities of a collision from which a ball is yellow, and red."""
COARSE = 2.0
"""Half width of the band, m, from which a label leaves out decimetres."""
SURE = 0.9
"""Probability of above or below from which an obstacle has its colour."""
BEHAVIOURS = ('prob_fixed', 'prob_swaying', 'prob_moving', 'prob_seabed')
"""Columns of what an obstacle does, of which an estimate has those that are considered."""


class Displays:
    """Places, markers that show the band of the height, and the models: above or below, and the
    behaviours."""

    topics: Mapping[str, str] = {
        'obstacles': 'geometry_msgs/msg/PoseArray',
        'markers': 'visualization_msgs/msg/MarkerArray',
        MODELS: NAMED_SCALARS,
    }

    def __init__(self) -> None:
        self._markers = Markers(NAMES, write_markers)

    def of(self, estimate: Estimate, make: Make, is_wanted: Callable[[str], Any]) -> Drawn:
        rows = confirmed_rows(estimate)
        if is_wanted('obstacles'):
            yield 'obstacles', write_poses(estimate, rows, make)
        yield from self._markers.of(estimate, rows, make, is_wanted)
        own = (name for name in estimate.extras if name.startswith('prob_'))
        shown = tuple(dict.fromkeys((*BEHAVIOURS, *own)))
        yield from models_of_the_oldest(estimate, rows, make, is_wanted, shown)

    def forget(self, make: Make) -> Drawn:
        return self._markers.forget(make)


def write_poses(estimate: Estimate, rows: Iterable[int], make: Make) -> Any:
    """Write a PoseArray of the obstacles in `rows`, without orientation."""
    places = [estimate.xyz[row] for row in rows]
    return write_places(places, estimate.stamp_ns, estimate.frame_id, make)


def write_places(places: Iterable[np.ndarray], stamp_ns: int, frame_id: str, make: Make) -> Any:
    """Write a PoseArray of places, each (3,), without orientation."""
    return make(
        'geometry_msgs/msg/PoseArray',
        header=make_header(stamp_ns, frame_id, make),
        poses=[_pose(make, *(float(value) for value in place)) for place in places],
    )


def write_markers(estimate: Estimate, rows: Iterable[int], make: Make) -> Any:
    """Write a MarkerArray of bars, balls and labels."""
    markers = [marker for row in rows for marker in _obstacle(estimate, row, make)]
    return make('visualization_msgs/msg/MarkerArray', markers=markers)


def band(estimate: Estimate, row: int) -> tuple[float, float]:
    """Smallest and largest z of the 90 % band of one obstacle, metres in the frame."""
    z, offset = float(estimate.xyz[row, 2]), float(estimate.state[row, 2])
    low, high = (float(estimate.extras[f'vertical_offset_{end}'][row]) for end in ('lo', 'hi'))
    # The offset counts down from the sonar: its largest value is the deepest.
    return z + offset - high, z + offset - low


def _obstacle(estimate: Estimate, row: int, make: Make) -> list[Any]:
    x, y, z = (float(value) for value in estimate.xyz[row])
    bottom, top = band(estimate, row)
    track_id = int(estimate.extras['track_id'][row])
    colour = _colour(float(estimate.probabilities[row, estimate.model_names.index('above')]))
    half = 0.5 * (top - bottom)
    digits = 0 if half >= COARSE else 1
    label = (
        f'{track_id}: {estimate.state[row, 0]:.0f} m ahead, '
        f'{estimate.state[row, 2]:+.{digits}f} \N{PLUS-MINUS SIGN} {half:.{digits}f} m down'
    )
    risk = float(estimate.extras.get('collision_probability', np.full(len(estimate), np.nan))[row])
    if np.isfinite(risk):
        label += f', collision {100.0 * risk:.0f} %'

    def marker(
        name: str,
        kind: int,
        height: float,
        size: tuple[float, float, float],
        alpha: float,
        colour: tuple[float, float, float] = colour,
        **more: Any,
    ) -> Any:
        more['pose'] = _pose(make, x, y, height)
        return make_marker(estimate, row, make, name, kind, size, (*colour, alpha), **more)

    return [
        marker('band', _CUBE, 0.5 * (bottom + top), (0.4, 0.4, max(top - bottom, 0.05)), 0.5),
        marker('obstacle', _SPHERE, z, (0.8, 0.8, 0.8), 1.0, _danger(risk)),
        marker(
            'label',
            _TEXT,
            top + 1.0,
            (0.0, 0.0, 1.0),
            1.0,
            text=label,
        ),
    ]


def _colour(above: float) -> tuple[float, float, float]:
    if max(above, 1.0 - above) < SURE:
        return _UNKNOWN
    return _ABOVE if above > 0.5 else _BELOW


def _danger(risk: float) -> tuple[float, float, float]:
    if not np.isfinite(risk):
        return _UNKNOWN
    return _CLEAR if risk < DANGERS[0] else _NEAR if risk < DANGERS[1] else _DANGER


def _pose(make: Make, x: float, y: float, z: float) -> Any:
    finite = [value if np.isfinite(value) else 0.0 for value in (x, y, z)]
    return make_pose(finite, make)
