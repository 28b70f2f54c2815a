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

"""What is drawn of an estimate besides its table: chosen here once, for the nodes and for the view
of a run that was tracked offline.

Of divers and obstacles only confirmed tracks are drawn, coasting ones too. The probabilities of
the models are those of the track that lasted longest (the smallest ``track_id``): a plotting tool
draws one curve per name, and several tracks in turn would be a zigzag between them. Those of all
tracks are columns of ``~/estimate``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

import numpy as np

from sonar_imm.estimates import Estimate

from .estimates import write_model_probabilities, write_model_shares, write_odometry
from .headers import Make
from .obstacles import write_ended, write_markers, write_no_markers, write_poses

CONFIRMED = 1
"""Least `track_state` of a confirmed track: 0 tentative, 1 confirmed, 2 coasting."""
_NAMED_SCALARS = 'sensor_msgs/msg/JointState'
Drawn = Iterator[tuple[str, Any]]
"""Names of topics, without ``~/``, and the messages to publish on them."""


class Displays(Protocol):
    """The drawings of one system. topics: their message types by name.

    Messages are made by `make`, and only for names that `heard` somebody asks for.
    """

    topics: Mapping[str, str]

    def of(self, estimate: Estimate, make: Make, heard: Callable[[str], Any]) -> Drawn:
        """Draw the newest estimate."""

    def forget(self, make: Make) -> Drawn:
        """Take away what is drawn: all tracks are forgotten."""


class DiverDisplays:
    """One Odometry per diver, told apart by ``child_frame_id``, and the models."""

    topics: Mapping[str, str] = {
        'odometry': 'nav_msgs/msg/Odometry',
        'model_probabilities': _NAMED_SCALARS,
    }

    def of(self, estimate: Estimate, make: Make, heard: Callable[[str], Any]) -> Drawn:
        rows = confirmed_rows(estimate)
        if heard('odometry'):
            for row in rows:
                yield 'odometry', write_odometry(estimate, row, make)
        yield from _models_of_the_oldest(estimate, rows, make, heard)

    def forget(self, make: Make) -> Drawn:
        return iter(())


class ObstacleDisplays:
    """Places, markers that show the band of the height, and the models."""

    topics: Mapping[str, str] = {
        'obstacles': 'geometry_msgs/msg/PoseArray',
        'markers': 'visualization_msgs/msg/MarkerArray',
        'model_probabilities': _NAMED_SCALARS,
    }

    def __init__(self) -> None:
        self._frame_id = ''
        self._shown: set[int] = set()

    def of(self, estimate: Estimate, make: Make, heard: Callable[[str], Any]) -> Drawn:
        self._frame_id = estimate.frame_id
        rows = confirmed_rows(estimate)
        if heard('obstacles'):
            yield 'obstacles', write_poses(estimate, rows, make)
        ids = set(estimate.extras['track_id'][rows].tolist())
        ended, self._shown = sorted(self._shown - ids), ids
        if heard('markers') and ended:
            yield 'markers', write_ended(self._frame_id, ended, make)
        if heard('markers') and len(rows):
            yield 'markers', write_markers(estimate, rows, make)
        yield from _models_of_the_oldest(estimate, rows, make, heard)

    def forget(self, make: Make) -> Drawn:
        self._shown = set()
        yield 'markers', write_no_markers(self._frame_id, make)


class BathymetryDisplays:
    """The share of the bins that each terrain model holds."""

    topics: Mapping[str, str] = {'model_probabilities': _NAMED_SCALARS}

    def of(self, estimate: Estimate, make: Make, heard: Callable[[str], Any]) -> Drawn:
        if heard('model_probabilities'):
            yield 'model_probabilities', write_model_shares(estimate, make)

    def forget(self, make: Make) -> Drawn:
        return iter(())


class FathometerDisplays:
    """How probable each number of reflectors is, the same in all rows."""

    topics: Mapping[str, str] = {'model_probabilities': _NAMED_SCALARS}

    def of(self, estimate: Estimate, make: Make, heard: Callable[[str], Any]) -> Drawn:
        if heard('model_probabilities'):
            yield 'model_probabilities', write_model_probabilities(estimate, 0, make)

    def forget(self, make: Make) -> Drawn:
        return iter(())


DISPLAYS: dict[str, type[Displays]] = {
    'bathymetry': BathymetryDisplays,
    'fathometer': FathometerDisplays,
    'obstacle': ObstacleDisplays,
    'diver': DiverDisplays,
}
"""By system."""


def confirmed_rows(estimate: Estimate) -> np.ndarray:
    """The rows of an estimate whose tracks are confirmed."""
    return np.flatnonzero(estimate.extras['track_state'] >= CONFIRMED)


def _models_of_the_oldest(
    estimate: Estimate, rows: np.ndarray, make: Make, heard: Callable[[str], Any]
) -> Drawn:
    if len(rows) and heard('model_probabilities'):
        oldest = rows[np.argmin(estimate.extras['track_id'][rows])]
        yield 'model_probabilities', write_model_probabilities(estimate, oldest, make)
