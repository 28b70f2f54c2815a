# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How runs of the obstacle tracker are judged: heights and 90 % bands against the truth.

`series` lays estimates end to end and says which track is which obstacle. `scoring` says how
large the errors are and whether what is stated holds. `METRICS`, `summary_sentence` and `figures`
present it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from sonar_imm.trackers.obstacle.config import BEHAVIOURS, ObstacleConfig

from ..judging import Case, Limit
from ..numbers import chi2, counted, each, error, fill, look_up, Metric, NO_TRUTH, UNMATCHED
from .scoring import motion_metrics, NEAR, score, tether_length
from .series import series_of, truth_of

__all__ = ['LIMIT', 'METRICS', 'REMARK', 'scored', 'SEEN', 'summary_sentence']

LIMIT = Limit(
    2.5, 'm', 'vertical offset RMSE within 50 m', 'vertical_offset_near.rmse_m',
    missed='no obstacle was tracked to within 50 m',
)  # fmt: skip
"""Limit for recordings without one of their own. 300 runs have 1.6 m at 50 m and 0.9 m at 20 m on
average; one recording can be worse than the average."""

CUTOFF = 5.0
"""Metres in range and bearing from which a track is on no obstacle."""


def scored(case: Case) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """Score the tracks of a run against true obstacles."""
    options, config = case.options, case.config(ObstacleConfig)
    series = case.estimates(series_of)
    truth = case.truth(partial(truth_of, lag=options.lag)) or ()
    cutoff = CUTOFF if options.cutoff is None else options.cutoff
    metrics, found = score(series, truth, cutoff=cutoff, gap=options.gap)
    metrics['truth_lag_s'] = options.lag
    if found is not None:
        metrics |= motion_metrics(found, truth, config)
    received = list(case.measurements())
    metrics |= tether_length(series, received, config)
    return metrics, (metrics, series, truth, found, received, options.gap, case.origin())


# fmt: off
METRICS = (
    Metric(card='Confirmed obstacles', value='{tracks_confirmed}',
        remark='{pings} pings in {span_s:.0f} s',
        when=lambda metrics: not look_up(metrics, 'range.n')),
    error('range', 'range error'),
    error('bearing', 'bearing error', 'deg'),
    error('vertical_offset', 'vertical offset error'),
    error('vertical_offset_near', f'the same within {NEAR:.0f} m',
        card=f'Height error within {NEAR:.0f} m, RMS', front=True),
    chi2('consistency.nees_offset', 'NEES, vertical offset', card='NEES of the offset'),
    chi2('consistency.nees_state', 'NEES, whole state'),
    chi2('consistency.nis', 'NIS', card='NIS of the hits'),
    Metric(label='truth inside the 90 % band', line='{consistency.band_coverage:.0%}',
        card='Truth inside the 90 % band', value='{consistency.band_coverage:.0%}',
        remark='90 % would be perfect', front=True, covers=('consistency.band_coverage', 0.9)),
    Metric(label='Brier score of P(above)', line='{above.brier:.3f}'),
    *(
        metric
        for name in ('moving', 'still')
        for metric in (
            Metric(
                label=f'velocity error, {name}, RMSE per axis',
                line=f'{{velocity.{name}.rmse_m_s:.3f}} m/s',
            ),
            chi2(f'velocity.{name}.nees', 'NEES, velocity'),
        )
    ),
    *(
        Metric(
            label=f'P({name}) of what is',
            line=f'{{behaviours.confusion.{name}.{name}:.3f}} '
            f'({{behaviours.confusion.{name}.n}} rows)',
        )
        for name in BEHAVIOURS
    ),
    Metric(label='Brier score of collisions',
        line='{collisions.brier:.3f}, of a guess {collisions.brier_of_a_guess:.3f} '
        '({collisions.n} forecasts, {collisions.happened:.0%} happened)'),
    Metric(label='GOSPA', line='{gospa.mean_m:.2f} m', card='GOSPA', value='{gospa.mean_m:.2f} m',
        front=True,
        remark='{gospa.missed_per_ping:.2f} missed, {gospa.false_per_ping:.2f} false per ping'),
    Metric(label='above the sea floor (tether, if moored)',
        line='{tether_m:.2f} m, standard deviation {tether_std_m:.2f} m'),
    *each(
        'tracks',
        ('true_obstacles', 'found_obstacles', 'tracks', 'false_tracks', 'identity_switches'),
    ),
)
# fmt: on


def seen(metrics: Mapping[str, Any]) -> str:
    """What was tracked, in a few words."""
    true = look_up(metrics, 'tracks.true_obstacles')
    found = counted(metrics['tracks_confirmed'], 'obstacle')
    if true is not None:
        found = f'{metrics["tracks"]["found_obstacles"]} of {counted(true, "obstacle")}'
    return fill(f'{found}, {{pings}} pings in {{span_s:.0f}} s', metrics)


SEEN = seen
REMARK = ' (band holds {consistency.band_coverage:.0%} of the truth)'


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    if not look_up(metrics, 'vertical_offset.n'):
        return fill('{tracks_confirmed} confirmed obstacles in {span_s:.0f} s. ', metrics) + (
            UNMATCHED if 'scored_rows' in metrics else NO_TRUTH
        )
    near = (
        f'Within {NEAR:.0f} m the height of an obstacle is right to '
        '{vertical_offset_near.rmse_m:.2f} m (RMS). '
    )
    return fill(
        (near if metrics['vertical_offset_near']['n'] else '')
        + 'Its 90 % band holds the truth {consistency.band_coverage:.0%} of the time. '
        '{tracks.found_obstacles} of {tracks.true_obstacles} obstacles were found, '
        '{tracks.false_tracks} tracks were false.',
        metrics,
    )
