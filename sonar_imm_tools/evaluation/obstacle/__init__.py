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

"""How runs of the obstacle tracker are judged: heights and 90 % bands against the truth.

`series` lays estimates end to end and says which track is which obstacle. `scoring` says how
large the errors are and whether the stated uncertainty holds, `motion` the same of velocities,
behaviours and collisions, `deferred` what the paper's deferred estimate would have been.
`summary` and `figures` present it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import functools
from pathlib import Path
from typing import Any, TYPE_CHECKING

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.trackers.obstacle.config import ObstacleConfig

from ...offline.run_folder import read_measurements, read_truth, RunFolder
from ..judging import Check, Judgement, JudgeOptions, Limit, naming
from .deferred import deferred_estimates
from .motion import motion_metrics
from .scoring import score
from .series import Matching, series_of, TruePath, truth_of
from .summary import METRICS, seen, summary_sentence

if TYPE_CHECKING:
    from ..report import Section

__all__ = ['judge', 'LIMIT']

LIMIT = Limit(2.5, 'm', 'vertical offset RMSE within 50 m', 'vertical_offset_near.rmse_m')
"""Limit for recordings without one of their own. 300 runs have 1.6 m at 50 m and 0.9 m at 20 m on
average; one recording can be worse than the average."""

CUTOFF = 5.0
"""Metres in range and bearing from which a track is on no obstacle."""


def judge(folder: RunFolder, options: JudgeOptions) -> Judgement:
    """Score the tracks of `folder`. Raises `BagError` when they or the truth cannot be read."""
    run = folder.read_run()
    with naming(folder.path):
        series = series_of(folder.read_estimates())
    tables = read_truth(run, options.truth_bag)
    with naming(options.truth_bag or Path(run['bag'])):
        truth = truth_of(tables or (), options.lag)
    cutoff = CUTOFF if options.cutoff is None else options.cutoff
    metrics, found = score(series, truth, cutoff=cutoff, gap=options.gap)
    metrics['truth_lag_s'] = options.lag
    config = ObstacleConfig.from_mapping(run['parameters'], ignore_unknown=True)
    if found is not None:
        metrics |= motion_metrics(found, truth, config)
    received = list(read_measurements(run))
    deferred = deferred_estimates(series, received, config, _met_first(found, truth), options.gap)
    if deferred is not None:
        metrics['deferred'] = deferred.as_dict()

    def sections() -> Iterable[Section]:
        # plotly, which only a report needs, takes a second to load.
        from .figures import map_section, sections

        origin = Origin(**run['origin']) if run.get('origin') else None
        yield from map_section(series, received, origin)
        yield from sections(metrics, series, truth, found, deferred, received, options.gap)

    return Judgement(
        run=run,
        metrics=metrics,
        words=summary_sentence,
        shown=METRICS,
        seen=seen,
        sections=sections,
        accuracy=functools.partial(_accuracy, metrics),
    )


def _met_first(found: Matching | None, truth: Sequence[TruePath]) -> dict[int, TruePath]:
    """The obstacle that each track was matched with first, by track id."""
    if found is None:
        return {}
    pairs = zip(found.series.track_id[found.row].tolist(), found.target.tolist())
    return {track_id: truth[target] for track_id, target in reversed(list(pairs))}


def _accuracy(metrics: Mapping[str, Any], at_most: float | None) -> Check | None:
    if 'vertical_offset_near' not in metrics:
        return None
    near = metrics['vertical_offset_near']
    if not near['n']:
        return Check(
            f'{LIMIT.meaning} against truth',
            'no obstacle was tracked to within 50 m',
            'at least one',
            good=False,
        )
    return LIMIT.check(
        near['rmse_m'],
        at_most=at_most,
        remark=f' (band holds {100 * metrics["consistency"]["band_coverage"]:.0f} % of the truth)',
    )
