"""How runs of the bathymetry tracker are judged: the floor along each ping against the true floor.

`profiles` pairs estimate and truth of each ping, `scoring` compares them. `summary`, `sections`
and `figures` present the result; `bench` measures the speed beside other filters (`peers`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import functools
import math
from typing import Any, TYPE_CHECKING

from ..judging import Check, Judgement, JudgeOptions, Limit
from ..run_folder import read_truth, RunFolder
from .profiles import profiles_of, Swath
from .scoring import score
from .summary import lines, summary_sentence

if TYPE_CHECKING:
    from ..page import Part

LIMIT = Limit(0.25, 'm', 'height RMSE')
"""Limit for the shipped recordings, over all bins with an echo. On the scene of the paper the
default reaches 0.15 m, and MUSIC, which has no terrain model, 0.27 m."""


def judge(folder: RunFolder, options: JudgeOptions) -> Judgement:
    """Score the floors of `folder`. Raises `BagError` when they or the truth cannot be read."""
    run = folder.read_run()
    truth = read_truth(run, options.truth_bag, truth_topic(run))
    swath = profiles_of(folder.read_estimates(), truth)
    metrics = score(swath)
    return Judgement(
        metrics=metrics,
        summary=summary_sentence(metrics),
        lines=tuple(lines(metrics)),
        part=functools.partial(_part, run, metrics, swath),
        accuracy=functools.partial(_accuracy, metrics),
    )


def truth_topic(run: Mapping[str, Any]) -> str:
    """Where the truth of a run lies: ``/port/snapshot`` belongs to ``/truth/port/estimate``."""
    tracked = next(iter(run['topics']))
    return f'/truth{tracked.rpartition("/")[0]}/estimate'


def _part(
    run: Mapping[str, Any], metrics: Mapping[str, Any], swath: Swath, checks: Sequence[Check]
) -> Part:
    # plotly, which only a report needs, takes a second to load.
    from .sections import bathymetry_part

    return bathymetry_part(run, metrics, swath, checks)


def _accuracy(metrics: Mapping[str, Any], at_most: float | None) -> Check | None:
    height = metrics.get('height', {}).get('all', {})
    if not height.get('n') or math.isnan(height['rmse_m']):
        return None
    return LIMIT.check(height['rmse_m'], at_most=at_most)
