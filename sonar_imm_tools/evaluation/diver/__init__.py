# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How runs of the diver tracker are judged: tracks of positions against true paths.

`series` holds the estimates and the true paths as flat arrays and says which track belongs to
which diver, `scoring` compares them. `METRICS`, `summary_sentence` and `figures` present the
result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any

from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.georeferencing import Georeferencer

from ..judging import Case, Limit
from ..numbers import (
    chi2,
    counted,
    coverage_sentence,
    each,
    error,
    fill,
    look_up,
    Metric,
    NO_TRUTH,
    relative_nees,
    UNMATCHED,
)
from .scoring import fix_series, score
from .series import series_of, Truth

__all__ = ['LIMIT', 'METRICS', 'REMARK', 'scored', 'SEEN', 'summary_sentence']

LIMIT = Limit(1.25, 'm', 'position RMSE', 'position.rmse_m')
"""Limit for recordings without one of their own. The raw fixes of Table 1 have 1.71 m and its best
tracker 0.85 m on average; one recording can be worse than the average."""


def scored(case: Case) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """Score the tracks of a run against true paths, and the raw fixes too."""

    def true_paths(rows: Iterable[Estimate]) -> Truth:
        truth = Truth.from_series(series_of(rows), max_gap=case.options.gap)
        return truth.shifted(case.options.lag)

    series = case.estimates(series_of)
    truth = case.truth(true_paths)
    config = case.config(DiverConfig)
    georeferencer = Georeferencer(config, Counter())
    placed = chain.from_iterable(map(georeferencer.georeference, case.measurements()))
    fixes = [item for item in placed if isinstance(item, (Fix, Fixes))]
    raw = fix_series(fixes) if fixes else None
    metrics = score(series, truth, fixes=raw, cutoff=case.options.cutoff)
    metrics['truth_lag_s'] = case.options.lag
    # Of a run whose first fix was the origin, only the run knows it.
    origin = case.origin() or config.stated_origin()
    return metrics, (metrics, series, truth, raw, origin, case.run.get('target_names'))


def remark(metrics: Mapping[str, Any]) -> str:
    """What follows the error: that of the raw fixes, and how much was found."""
    raw = metrics.get('raw_fix', {}).get('rmse_m')
    remarks = [f'raw fixes {raw:.2f} m'] if raw else []
    if metrics['beyond_cutoff']['n']:
        remarks.insert(0, f'{metrics["tracks"]["completeness"]:.0%} complete')
    return f' ({", ".join(remarks)})' if remarks else ''


def _unscored(metrics: Mapping[str, Any]) -> bool:
    return not look_up(metrics, 'position.n')


def _several(metrics: Mapping[str, Any]) -> bool:
    """Whether there are several tracks or several divers."""
    counts = [look_up(metrics, f'tracks.{name}') or 0 for name in ('tracks', 'true_targets')]
    return max(counts) > 1 and not _unscored(metrics)


def _truncated(metrics: Mapping[str, Any]) -> bool:
    return bool(look_up(metrics, 'beyond_cutoff.n')) and not _unscored(metrics)


# fmt: off
METRICS = (
    Metric(label='divers found',
        line='{tracks.completeness:.0%} of the time, within {cutoff_m:.3g} m; the errors below '
        'are those of then', card='Divers found', value='{tracks.completeness:.0%}',
        remark='within {cutoff_m:.3g} m; the errors are those of then', when=_truncated),
    Metric(card='Confirmed tracks', value='{tracks_confirmed}',
        remark='{stamps} stamps in {span_s:.0f} s', when=_unscored),
    error('position', 'position error', card='Position error, RMS', front=True),
    error('raw_fix', 'raw fixes', card='Raw fixes, RMS', remark='{raw_fix.n} fixes', front=True),
    error('velocity', 'velocity error', 'mps', card='Velocity error, RMS', remark=''),
    error('depth', 'depth error', remark=''),
    chi2('depth.nees_3d', 'NEES, three coordinates'),
    chi2('consistency.nees_position', 'NEES, position', card='NEES of the position'),
    chi2('consistency.nees_state', 'NEES, whole state'),
    chi2('consistency.nis', 'NIS', card='NIS of the hits'),
    Metric(label='truth inside 50 / 90 / 95 % ellipse',
        line=' / '.join(f'{{consistency.coverage.{level}:.0%}}' for level in (50, 90, 95)),
        card='Truth inside the 95 % ellipse', value='{consistency.coverage.95:.0%}',
        remark='95 % would be perfect', front=True),
    Metric(covers=('consistency.coverage.95', 0.95), nees='consistency.nees_position',
        when=lambda metrics: look_up(metrics, 'consistency.verdict') is not None),
    Metric(label='best lag of the estimates',
        line='{lag.best_s:.2f} s, then RMSE {lag.rmse_at_best_m:.3f} m'),
    Metric(card='Tracks / true targets', value='{tracks.tracks} / {tracks.true_targets}',
        remark='{tracks.identity_switches} identity switches, {tracks.false_tracks} false, '
        '{tracks.completeness:.0%} complete', when=_several),
    *each(
        'tracks',
        (
            'true_targets',
            'tracks',
            'false_tracks',
            'identity_switches',
            'fragmentations',
            'completeness',
            'false_rows_per_scan',
        ),
    ),
)
# fmt: on


def seen(metrics: Mapping[str, Any]) -> str:
    """What was tracked, in a few words."""
    true = look_up(metrics, 'tracks.true_targets')
    of = '' if true is None else f' of {counted(true, "diver")}'
    found = counted(metrics['tracks_confirmed'], 'track') + of
    return fill(f'{found}, {{stamps}} stamps in {{span_s:.0f}} s', metrics)


SEEN, REMARK = seen, remark


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    if _unscored(metrics):
        tracks = counted(metrics['tracks_confirmed'], 'confirmed track')
        why = UNMATCHED if 'scored_stamps' in metrics else NO_TRUTH
        return f'{tracks} in {metrics["span_s"]:.0f} s. {why}'
    sentences = ['On average the track lies {position.rmse_m:.2f} m from the truth (RMS).']
    judged = metrics['consistency']['verdict'] is not None
    if _truncated(metrics):
        sentences = [
            'The divers are found {tracks.completeness:.0%} of the time, within {cutoff_m:.3g} m; '
            'then the track lies {position.rmse_m:.2f} m from the truth (RMS).'
        ]
    if judged and look_up(metrics, 'raw_fix.n'):
        sentences.append(_against_fixes(metrics))
    if judged:
        consistency = metrics['consistency']
        nees = relative_nees(consistency.get('nees_position'))
        sentences.append(coverage_sentence(consistency['coverage']['95'], nees))
    elif _truncated(metrics):
        sentences.append(
            'Whether the stated uncertainty holds cannot be said: {beyond_cutoff.share:.0%} of '
            'the estimates that may be of a diver lie further away.'
        )
    return fill(' '.join(sentences), metrics)


def _against_fixes(metrics: Mapping[str, Any]) -> str:
    same, beyond = metrics['same_stamps'], metrics['raw_fix']['beyond']
    raw = same['raw_rmse_m']
    if not same['n']:
        return 'No fix has the stamp of an estimate to be compared with.'
    if not raw > 0.0:
        return 'The raw fixes are the truth itself: no tracker can be better than they are.'
    change = 1.0 - same['track_rmse_m'] / raw
    out = f', without {beyond} that lie beyond {metrics["cutoff_m"]:.3g} m' if beyond else ''
    return f'The raw fixes lie {raw:.2f} m away at the same stamps{out}: tracking ' + (
        f'removes {100 * change:.0f} % of the error.'
        if change >= 0.0
        else f'adds {-100 * change:.0f} % to it.'
    )
