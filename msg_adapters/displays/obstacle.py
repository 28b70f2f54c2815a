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

"""Displays of obstacles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sonar_imm.estimates import Estimate

from ..headers import Make
from ..obstacles import NAMES, write_markers, write_poses
from .tracks import confirmed_rows, Drawn, Markers, MODELS, models_of_the_oldest, NAMED_SCALARS

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
