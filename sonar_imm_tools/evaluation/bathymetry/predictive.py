# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the bathymetry tracker predicts of each range bin of a ping, given the bins before it, for
`evaluation.tuning`. Pings are independent of each other: of a long recording some, evenly chosen,
say as much in less time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig, DEFAULT_SIGMAS_DEG
from sonar_imm.trackers.bathymetry.tracker import BathymetryTracker

from ..tuning import Scores, Tunable

MOST_PINGS, PARTICLES = 16, 1000
UNEXPLAINED = -200.0
"""Of a bin in which no model puts anything."""


def for_tuning(config: BathymetryConfig) -> BathymetryConfig:
    """Two walks of the height run as Gaussian filters, without Monte Carlo noise; what needs
    particles has many. Nothing looks back."""
    return evolve(
        config,
        particles_per_model=max(config.particles_per_model, PARTICLES),
        engine='gaussian' if config.model_set == 'height_two_rw' else 'auto',
        smoothing='none',
        ping_coupling=0.0,
        layover='ignored',
    )


def tunables(config: BathymetryConfig, measurements: Sequence[Any]) -> list[Tunable]:
    """The noise of the smoothest model only when it is asked for: a flat floor makes it so small
    that the next floor does not fit."""
    if config.is_terrain:
        return []
    if config.model_set == 'angle_two_rw':
        name, noise = 'sigmas_deg', config.sigmas_deg or DEFAULT_SIGMAS_DEG
    else:
        name, noise = 'sigmas', config.sigmas_used
    found = [
        Tunable(name=name, start=value, place=place, whole=tuple(noise), usual=place > 0)
        for place, value in enumerate(noise)
        if value > 0.0
    ]
    if not config.transition_matrix:
        found.append(Tunable(name='stay_probability', start=config.stay_used, kind='logit'))
    return found


class Scored(BathymetryTracker):
    """The tracker, with what it predicted. scores: by stamp, both sides together."""

    def __init__(self, config: BathymetryConfig, measurements: Sequence[Any] = ()):
        self.scores: Scores = {}
        pings = sorted({item.stamp_ns for item in measurements if isinstance(item, Snapshot)})
        if len(pings) > MOST_PINGS:
            chosen = np.linspace(0, len(pings) - 1, MOST_PINGS).round().astype(int)
            pings = [pings[k] for k in chosen]
        self.used = set(pings)
        super().__init__(config)

    def process(self, measurement: Any) -> list[Estimate]:
        if isinstance(measurement, Snapshot) and measurement.stamp_ns not in self.used:
            return []
        made = super().process(measurement)
        for estimate in made:
            logs = np.asarray(estimate.extras['log_likelihood'], float)
            bins = logs[np.asarray(estimate.extras['valid'], bool)]
            score, count = self.scores.get(estimate.stamp_ns, (0.0, 0))
            score += float(np.maximum(bins, UNEXPLAINED).sum())
            self.scores[estimate.stamp_ns] = score, count + len(bins)
        return made
