# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the obstacle tracker predicts of each ping, for `evaluation.tuning`: as
`evaluation.diver.predictive`, in range and bearing over the sector that the sonar sees, of tracks
as far as they are in the beam, each with its own existence.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any

import numpy as np

from sonar_imm.estimation.marginals import log_total
from sonar_imm.measurements import Detections
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.events import detected, ratios
from sonar_imm.trackers.obstacle.pings import Ping
from sonar_imm.trackers.obstacle.state import Known
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker

from ..tuning import Scores, Tunable


def for_tuning(config: ObstacleConfig) -> ObstacleConfig:
    """Nothing costs time beside the filter itself."""
    return config


def tunables(config: ObstacleConfig, measurements: Sequence[Any]) -> list[Tunable]:
    """Standard deviations only where some detections come without a variance."""
    pings = [item for item in measurements if isinstance(item, Detections)]
    found = []
    if any(np.isnan(ping.var_range).any() for ping in pings):
        found.append(Tunable.of(config, 'range_std', scanned=True))
    if any(np.isnan(ping.var_bearing).any() for ping in pings):
        found.append(Tunable.of(config, 'bearing_std_deg', scanned=True))
    found.append(Tunable.of(config, 'detection_probability', kind='logit'))
    for name in ('clutter_density', 'sway_std', 'max_speed'):
        if getattr(config, name) > 0.0:
            found.append(Tunable.of(config, name, usual=name == 'clutter_density'))
    return found


class Scored(ObstacleTracker):
    """The tracker, with what it predicted. scores: by stamp."""

    def __init__(self, config: ObstacleConfig, measurements: Sequence[Any] = ()):
        self.scores: Scores = {}
        self.area = config.max_range * math.radians(config.horizontal_fov_deg)
        super().__init__(config)

    def _associate(self, known: Known, ping: Ping) -> Known:
        known = super()._associate(known, ping)
        match, table = ping.match, known.obstacles
        score = float(np.log(match.density).sum()) - known.clutter.mean(self.config) * self.area
        every = table.existence.classes * detected(table, self.filter)
        visible = table.existence.visible(table.mixture.mu, match.compared.visible)
        seen, missed = every.sum(axis=1), 1.0 - (every * visible).sum(axis=1)
        g = ratios(match.compared, match.density, len(seen))
        score += log_total(seen[:, None] * g, missed, g > 0.0)
        self.scores[ping.stamp_ns] = score, len(ping.echoes) if len(seen) else 0
        return known
