# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How runs of the bathymetry tracker are judged: the floor along each ping against the true floor.

`METRICS`, `summary_sentence` and `figures` present what `scoring` finds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.soundings import SIDES

from ...offline.run_folder import read_truth
from ..judging import Case, Limit
from ..numbers import error, fill, look_up, Metric, NO_TRUTH
from .scoring import profiles_of, score

__all__ = ['LIMIT', 'METRICS', 'REMARK', 'scored', 'SEEN', 'summary_sentence']

LIMIT = Limit(0.25, 'm', 'height RMSE', 'height.all.rmse_m')
"""Limit for recordings without one of their own, over all bins with an echo. On the scene of the
paper the default reaches 0.15 m, and MUSIC, which has no terrain model, 0.27 m."""


def scored(case: Case) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """Score the floors of a run, of each side against its own truth."""
    truth: list[Estimate] = []
    for topic, side in truth_topics(case.run).items():
        for table in read_truth(case.run, case.options.truth_bag, topic) or []:
            sided = {} if side is None else {'side': np.full(len(table), side, np.uint8)}
            truth.append(evolve(table, extras={**table.extras, **sided}))
    swath = case.estimates(lambda estimates: profiles_of(estimates, truth))
    return score(swath), (case.run, case.folder.path, swath)


def truth_topics(run: Mapping[str, Any]) -> dict[str, int | None]:
    """Where the truth of a run lies, and of which side: ``/port/snapshot`` belongs to
    ``/truth/port/estimate``. None: the input has one side only."""
    sides = {f'{side}/snapshot': number for number, side in enumerate(SIDES)}
    return {
        f'/truth{topic.rpartition("/")[0]}/estimate': sides.get(name)
        for topic, name in run['topics'].items()
        if name.endswith('snapshot')
    }


def _unscored(metrics: Mapping[str, Any]) -> bool:
    return not look_up(metrics, 'height.all.n')


def _patches(metrics: Mapping[str, Any]) -> object:
    """Whether there are both smooth floor and rough patches."""
    return look_up(metrics, 'height.patch.n') and look_up(metrics, 'height.smooth.n')


# fmt: off
METRICS = (
    Metric(label='pings, range bins', line='{pings}, {bins}'),
    Metric(label='bins with an echo', line='{heard_share:.0%}'),
    Metric(label='bins with two surfaces', line='{two_share:.1%}',
        when=lambda metrics: look_up(metrics, 'two_share') is not None),
    Metric(label='two surfaces: found / soundings all the same / single bins lost',
        line='{layover.found:.0%} / {layover.soundings:.0%} / {layover.lost:.1%}',
        when=lambda metrics: (
            look_up(metrics, 'layover.bins') and not look_up(metrics, 'layover.heights')
        )),
    Metric(label='two surfaces: found / single bins taken for two',
        line='{layover.found:.0%} / {layover.lost:.1%}',
        when=lambda metrics: look_up(metrics, 'layover.heights')),
    Metric(label='both heights of two surfaces, RMS to the nearest / inside two sd',
        line='{layover.heights.rmse_m:.2f} m / {layover.heights.inside_band:.0%}',
        when=lambda metrics: look_up(metrics, 'layover.heights.n')),
    Metric(card='Pings', value='{pings}', remark='{bins} range bins', when=_unscored),
    Metric(card='Bins with an echo', value='{heard_share:.0%}', when=_unscored),
    Metric(card='Stated uncertainty, median', value='{height_std_median_m:.2f} m', when=_unscored),
    Metric(card='Bins labelled rough', value='{rough_share:.0%}', when=_unscored),
    error('height.all', 'height error, all', card='Height error, RMS', front=True),
    error('height.smooth', 'height error, smooth'),
    Metric(card='On smooth floor, RMS', value='{height.smooth.rmse_m:.2f} m', when=_patches),
    error('height.patch', 'height error, patch'),
    Metric(card='In rough patches, RMS', value='{height.patch.rmse_m:.2f} m', when=_patches),
    error('height.shadow', 'height error, shadow'),
    error('angle.all', 'angle error, all', 'deg', card='Angle error, RMS',
        value='{angle.all.rmse_deg:.2f}°', remark=''),
    Metric(label='inside two sd, smooth / patch',
        line='{inside_band.smooth:.0%} / {inside_band.patch:.0%}',
        card='Truth inside two standard deviations', value='{inside_band.all:.0%}',
        remark='95 % would be perfect', front=True, covers=('inside_band.all', 0.95)),
    Metric(label='overlap of the rough patches', line='{segmentation.iou:.2f}',
        card='Overlap of the rough patches', value='{segmentation.iou:.2f}', front=True,
        remark='noticed {segmentation.bins_late_in:.0f} bins late, left '
        '{segmentation.bins_late_out:.0f} bins late',
        when=lambda metrics: look_up(metrics, 'segmentation.patches')),
    Metric(label='floor called smooth / rough / cannot tell',
        line='{verdicts.smooth:.0%} / {verdicts.rough:.0%} / {verdicts.cannot_tell:.0%}',
        when=lambda metrics: look_up(metrics, 'verdicts.rough') is not None),
    Metric(label='of these right, smooth / rough',
        line='{verdicts.smooth_right:.1%} / {verdicts.rough_right:.1%}',
        when=lambda metrics: look_up(metrics, 'verdicts.rough_right') is not None),
    Metric(label='bins late, into / out of a patch',
        line='{segmentation.bins_late_in:.0f} / {segmentation.bins_late_out:.0f}'),
    Metric(label='shadow passed over', line='{gate.shadow_passed_over:.0%}',
        when=lambda metrics: look_up(metrics, 'gate.shadow_bins')),
)
# fmt: on


REMARK = ''
SEEN = '{pings} pings, {bins} range bins, {heard_share:.0%} with an echo'


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    if _unscored(metrics):
        echo = '{pings} pings with {bins} range bins, of which {heard_share:.0%} have an echo. '
        return fill(echo, metrics) + NO_TRUTH
    words = 'On average the floor lies {height.all.rmse_m:.2f} m from the truth (RMS)'
    if _patches(metrics):
        words += (
            ': {height.smooth.rmse_m:.2f} m where it is smooth, {height.patch.rmse_m:.2f} m in '
            'rough patches'
        )
    words += (
        '. {inside_band.all:.0%} of the bins lie inside the band of two standard deviations; '
        '95 % would be perfect.'
    )
    if look_up(metrics, 'segmentation.patches'):
        words += ' What is labelled rough and what is rough overlap by {segmentation.iou:.0%}.'
    return fill(words, metrics)
