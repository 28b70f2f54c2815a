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

"""Displays of divers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sonar_imm.estimates import Estimate

from ..divers import NAMES, write_markers, write_poses
from ..estimates import write_odometry
from ..headers import Make
from .tracks import confirmed_rows, Drawn, Markers, MODELS, models_of_the_oldest, NAMED_SCALARS

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
