# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the fathometer tracker predicts of each record, for `evaluation.tuning`.

The filter says how much more probable a record is than one of noise alone. Noise alone has

    log p = -N (log sigma + mean(a^2) / (2 sigma^2))

up to a constant, with N independent samples, so that the noise can be fitted, too. The mean is
over the samples of the trace: the depths between them, which a small `depth_std` needs, are no
data. The particles leave a noise of their own in the sum, against which the differences of the
curvature are wide.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.acoustics.pulse import independent_samples
from sonar_imm.estimation.set_filter import SetStep
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.pressure import Pace
from sonar_imm.trackers.fathometer.response import Response
from sonar_imm.trackers.fathometer.tracker import FathometerTracker

from ..tuning import Scores, Tunable

PARTICLES = 4000
"""Most particles of a fit."""
FIRST_RECORDS = 10
STEP = 0.4
UNEXPLAINED = -50.0
"""Against noise alone, of a record that no set explains."""


def for_tuning(config: FathometerConfig) -> FathometerConfig:
    """No looking ahead or back, and not more particles than a sum needs."""
    return evolve(
        config,
        particles=min(config.particles, PARTICLES),
        preview_seconds=0.0,
        smoothing_lag=0,
        multiples='off',
    )


def tunables(config: FathometerConfig, measurements: Sequence[Any]) -> list[Tunable]:
    """The noise only of traces that do not state it."""
    found = [Tunable.of(config, 'depth_std', step=STEP)]
    traces = [item for item in measurements if isinstance(item, Trace)]
    if traces and all(trace.sigma is None for trace in traces):
        start = config.noise_sigma or _measured(config, traces)
        found.insert(0, Tunable(name='noise_sigma', start=start, step=STEP))
    found.append(Tunable.of(config, 'amplitude_std_sigmas', step=STEP, usual=False))
    if config.pulse == 'gaussian':
        found.append(Tunable.of(config, 'pulse_width', step=STEP, usual=False))
    return found


def _measured(config: FathometerConfig, traces: Sequence[Trace]) -> float:
    """The noise that the tracker measures by itself, the median of the first records."""
    tracker, found = FathometerTracker(config), []
    for trace in traces[:FIRST_RECORDS]:
        tracker.process(trace)
        found.append(tracker.health().get('sigma', math.nan))
    typical = float(np.nanmedian(found)) if np.isfinite(found).any() else 1.0
    return typical if typical > 0.0 else 1.0


class Scored(FathometerTracker):
    """The tracker, with what it predicted. scores: by stamp."""

    def __init__(self, config: FathometerConfig, measurements: Sequence[Any] = ()):
        self.scores: Scores = {}
        self._trace_step = next((m.step for m in measurements if isinstance(m, Trace)), 0.0)
        super().__init__(config)

    def _filtered(self, response: Response) -> tuple[Response, SetStep, int, Pace]:
        response, step, records, pace = super()._filtered(response)
        gained = step.log_evidence if step.ok else UNEXPLAINED
        assert self._lattice is not None
        every = max(1, round(self._trace_step / self._lattice.step))
        amplitude, sigma = response.amplitude[::every], response.sigma[::every]
        span, width = self._lattice.step * self._lattice.cells, 0.25 * every * self._lattice.step
        independent = independent_samples(response.pulse or self.pulse, span, width)
        seen = amplitude != 0.0
        sigma, amplitude = sigma[seen], amplitude[seen]
        noise = np.log(sigma) + 0.5 * np.square(amplitude / sigma)
        alone = -independent * float(np.mean(noise)) if seen.any() else 0.0
        self.scores[response.stamp_ns] = gained + alone, 1
        return response, step, records, pace
