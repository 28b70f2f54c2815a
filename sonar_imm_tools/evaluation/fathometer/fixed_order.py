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

"""Filters of a fixed number of reflectors on the same records, as in the paper's Figure 3.

These are bootstrap filters for the usual number of reflectors, for one less and for one more. They
take the same responses as the tracker of the run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from attrs import evolve, frozen
import numpy as np

from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker

from .records import Image, Record, records_of
from .scoring import pair

MOST_PARTICLES = 2000


@frozen(eq=False)
class FixedOrder:
    """order: the number of reflectors; records: what was found; ospa: mean distance from the
    truth, m, NaN when that is not known."""

    order: int
    records: list[Record]
    ospa: float


def fixed_orders(
    run: Mapping[str, Any], image: Image, records: Sequence[Record], cutoff: float
) -> list[FixedOrder]:
    """Run filters of the most frequent number of reflectors in `records` (the true number when
    known), of one less and of one more. image: the responses of the run."""
    numbers = [r.order if r.true is None else len(r.true) for r in records]
    usual = int(np.bincount(numbers).argmax())
    config = FathometerConfig.from_mapping(run['parameters'], ignore_unknown=True)
    config = evolve(
        config,
        proposal='prior',
        particles=min(config.particles, MOST_PARTICLES),
        order_transition_matrix=(),
        smoothing_lag=0,
        preview_seconds=0.0,
        # The responses are in units of their noise, and free of any background.
        noise_sigma=1.0,
        remove_background=False,
    )
    true = {record.stamp_ns: record.true for record in records}
    return [
        _run(evolve(config, order_min=order, order_max=order), image, true, cutoff)
        for order in (usual - 1, usual, usual + 1)
        if order > 0
    ]


def _run(
    config: FathometerConfig, image: Image, true: Mapping[int, Any], cutoff: float
) -> FixedOrder:
    tracker = FathometerTracker(config)
    estimates = []
    for stamp_ns, column in zip(image.stamp_ns.tolist(), image.value.T):
        trace = Trace(stamp_ns=stamp_ns, depth=image.depth, amplitude=column)
        estimates += tracker.process(trace)
    records = [evolve(r, true=true.get(r.stamp_ns)) for r in records_of(estimates)]
    apart = [pair(r.found.depth, r.true.depth, cutoff).ospa for r in records if r.true is not None]
    return FixedOrder(config.order_min, records, float(np.mean(apart)) if apart else float('nan'))
