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

"""How runs of the fathometer tracker are judged: sets of reflectors against true sets.

`records` pairs estimates and truth, `scoring` compares numbers, depths and amplitudes of the
reflectors. `summary` and `figures` present the result.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import functools
from typing import Any, TYPE_CHECKING

from ...offline.run_folder import read_truth, RunFolder
from ..judging import Check, Judgement, JudgeOptions, Limit
from .records import records_of
from .scoring import CUTOFF, score
from .summary import METRICS, SEEN, summary_sentence

if TYPE_CHECKING:
    from ..report import Section

__all__ = ['judge', 'LIMIT']

LIMIT = Limit(0.08, 'm', 'OSPA', 'ospa_m')
"""Limit for recordings without one of their own. The best configuration has 0.05 m on average over
long drifts; one recording can be worse than the average."""


def judge(folder: RunFolder, options: JudgeOptions) -> Judgement:
    """Score the reflectors of `folder`. Raises `BagError` when it or the truth cannot be read."""
    run = folder.read_run()
    records = records_of(
        folder.read_estimates(),
        read_truth(run, options.truth_bag),
        lag=options.lag,
        gap=options.gap,
    )
    metrics = score(records, CUTOFF if options.cutoff is None else options.cutoff)
    metrics['truth_lag_s'] = options.lag

    def sections() -> Iterable[Section]:
        # plotly, which only a report needs, takes a second to load.
        from .figures import sections

        return sections(run, metrics, records)

    return Judgement(
        run=run,
        metrics=metrics,
        words=summary_sentence,
        shown=METRICS,
        seen=SEEN,
        sections=sections,
        accuracy=functools.partial(_accuracy, metrics),
    )


def _accuracy(metrics: Mapping[str, Any], at_most: float | None) -> Check | None:
    if not metrics.get('scored_records'):
        return None
    return LIMIT.check(
        metrics['ospa_m'],
        at_most=at_most,
        remark=f' (number right in {100 * metrics["order_right"]:.0f} % of the records)',
    )
