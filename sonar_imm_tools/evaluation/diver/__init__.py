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

"""How runs of the diver tracker are judged: tracks of positions against true paths.

`series` holds the estimates as flat arrays, `truth` the true paths, `matching` says which track
belongs to which diver, `scoring` compares them. `summary` and `figures` present the
result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
import functools
from itertools import chain
from pathlib import Path
from typing import Any, TYPE_CHECKING

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.georeferencing import Georeferencer

from ...offline.run_folder import read_measurements, read_truth, RunFolder
from ..judging import Check, Judgement, JudgeOptions, Limit, naming
from .scoring import fix_series, score
from .series import series_of, Truth
from .summary import METRICS, seen, summary_sentence

if TYPE_CHECKING:
    from ..report import Section

__all__ = ['judge', 'LIMIT']

LIMIT = Limit(1.25, 'm', 'position RMSE', 'position.rmse_m')
"""Limit for recordings without one of their own. The raw fixes of Table 1 have 1.71 m and its best
tracker 0.85 m on average; one recording can be worse than the average."""


def judge(folder: RunFolder, options: JudgeOptions) -> Judgement:
    """Score the tracks of `folder`. Raises `BagError` when they or the truth cannot be read."""
    run = folder.read_run()
    with naming(folder.path):
        series = series_of(folder.read_estimates())
    truth = _truth(run, options)
    config = DiverConfig.from_mapping(run['parameters'], ignore_unknown=True)
    georeferencer = Georeferencer(config, Counter())
    placed = chain.from_iterable(map(georeferencer.georeference, read_measurements(run)))
    fixes = [item for item in placed if isinstance(item, (Fix, Fixes))]
    raw = fix_series(fixes) if fixes else None
    metrics = score(series, truth, fixes=raw, cutoff=options.cutoff)
    metrics['truth_lag_s'] = options.lag

    def sections() -> Iterable[Section]:
        # plotly, which only a report needs, takes a second to load.
        from .figures import sections

        # Of a run whose first fix was the origin, only the run knows it.
        origin = Origin(**run['origin']) if run.get('origin') else config.origin()
        return sections(run, metrics, series, truth, raw, origin)

    return Judgement(
        run=run,
        metrics=metrics,
        words=summary_sentence,
        shown=METRICS,
        seen=seen,
        sections=sections,
        accuracy=functools.partial(_accuracy, metrics),
    )


def _truth(run: Mapping[str, Any], options: JudgeOptions) -> Truth | None:
    rows = read_truth(run, options.truth_bag)
    if rows is None:
        return None
    with naming(options.truth_bag or Path(run['bag'])):
        return Truth.from_series(series_of(rows), max_gap=options.gap).shifted(options.lag)


def _accuracy(metrics: Mapping[str, Any], at_most: float | None) -> Check | None:
    position = metrics.get('position', {})
    if not position.get('n'):
        return None
    raw = metrics.get('raw_fix', {}).get('rmse_m')
    remarks = [f'raw fixes {raw:.2f} m'] if raw else []
    if metrics['beyond_cutoff']['n']:
        remarks.insert(0, f'{metrics["tracks"]["completeness"]:.0%} complete')
    remark = f' ({", ".join(remarks)})' if remarks else ''
    return LIMIT.check(position['rmse_m'], at_most=at_most, remark=remark)
