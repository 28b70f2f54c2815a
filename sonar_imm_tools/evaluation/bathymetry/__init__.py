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

"""How runs of the bathymetry tracker are judged: the floor along each ping against the true floor.

`profiles` pairs estimate and truth of each ping, `scoring` compares them. `summary` and
`figures` present the result.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import functools
import math
from typing import Any, TYPE_CHECKING

from attrs import evolve
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.soundings import SIDES

from ...offline.run_folder import read_truth, RunFolder
from ..judging import Check, Judgement, JudgeOptions, Limit, naming
from .profiles import profiles_of
from .scoring import score
from .summary import METRICS, SEEN, summary_sentence

if TYPE_CHECKING:
    from ..report import Section

__all__ = ['judge', 'LIMIT']

LIMIT = Limit(0.25, 'm', 'height RMSE', 'height.all.rmse_m')
"""Limit for recordings without one of their own, over all bins with an echo. On the scene of the
paper the default reaches 0.15 m, and MUSIC, which has no terrain model, 0.27 m."""


def judge(folder: RunFolder, options: JudgeOptions) -> Judgement:
    """Score the floors of `folder`. Raises `BagError` when they or the truth cannot be read."""
    run = folder.read_run()
    truth: list[Estimate] = []
    for topic, side in truth_topics(run).items():
        for table in read_truth(run, options.truth_bag, topic) or []:
            sided = {} if side is None else {'side': np.full(len(table), side, np.uint8)}
            truth.append(evolve(table, extras={**table.extras, **sided}))
    with naming(folder.path):
        swath = profiles_of(folder.read_estimates(), truth)
    metrics = score(swath)

    def sections() -> Iterable[Section]:
        # plotly, which only a report needs, takes a second to load.
        from .figures import sections

        return sections(run, folder.path, swath)

    return Judgement(
        run=run,
        metrics=metrics,
        words=summary_sentence,
        shown=METRICS,
        seen=SEEN,
        sections=sections,
        accuracy=functools.partial(_accuracy, metrics),
    )


def truth_topics(run: Mapping[str, Any]) -> dict[str, int | None]:
    """Where the truth of a run lies, and of which side: ``/port/snapshot`` belongs to
    ``/truth/port/estimate``. None: the input has one side only."""
    sides = {f'{side}/snapshot': number for number, side in enumerate(SIDES)}
    return {
        f'/truth{topic.rpartition("/")[0]}/estimate': sides.get(name)
        for topic, name in run['topics'].items()
        if name.endswith('snapshot')
    }


def _accuracy(metrics: Mapping[str, Any], at_most: float | None) -> Check | None:
    height = metrics.get('height', {}).get('all', {})
    if not height.get('n') or math.isnan(height['rmse_m']):
        return None
    return LIMIT.check(height['rmse_m'], at_most=at_most)
