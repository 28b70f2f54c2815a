# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How runs of the fathometer tracker are judged: sets of reflectors against true sets.

`METRICS`, `summary_sentence` and `figures` present what `scoring` finds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...offline.run_folder import read_truth
from ..judging import Case, Limit
from ..numbers import error, fill, Metric, NO_TRUTH
from .scoring import CUTOFF, records_of, score

__all__ = ['LIMIT', 'METRICS', 'REMARK', 'scored', 'SEEN', 'summary_sentence']

LIMIT = Limit(0.08, 'm', 'OSPA', 'ospa_m')
"""Limit for recordings without one of their own. The best configuration has 0.05 m on average over
long drifts; one recording can be worse than the average."""


def scored(case: Case) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """Score the reflectors of a run, record by record."""
    options = case.options
    truth = read_truth(case.run, options.truth_bag)
    records = records_of(case.folder.read_estimates(), truth, lag=options.lag, gap=options.gap)
    metrics = score(records, CUTOFF if options.cutoff is None else options.cutoff)
    metrics['truth_lag_s'] = options.lag
    return metrics, (case.run, metrics, records)


def _unscored(metrics: Mapping[str, Any]) -> bool:
    return 'scored_records' not in metrics


# fmt: off
METRICS = (
    Metric(label='records', line='{records}'),
    Metric(label='reflectors per record', line='{reflectors_mean:.2f}'),
    Metric(card='Reflectors per record', value='{reflectors_mean:.1f}', when=_unscored),
    Metric(card='Reflectors in all', value='{ids}', remark='{records} records', when=_unscored),
    Metric(label='number of reflectors right', line='{order_right:.1%}',
        card='Number of reflectors right', value='{order_right:.0%}', front=True),
    Metric(label='OSPA', line='{ospa_m:.3f} m', card='OSPA', value='{ospa_m:.3f} m',
        remark='cutoff {cutoff_m:g} m', front=True),
    Metric(label='false / missed per record',
        line='{false_per_record:.3f} / {missed_per_record:.3f}', card='False / missed per record',
        value='{false_per_record:.2f} / {missed_per_record:.2f}'),
    error('depth', 'depth error', card='Depth error, RMS', value='{depth.rmse_m:.3f} m',
        remark='{depth.inside_2_sigma:.0%} within two stated sigma', front=True,
        covers=('depth.inside_2_sigma', 0.95)),
    Metric(label='amplitude error, median / 95 %',
        line='{amplitude.median_relative_error:.1%} / {amplitude.p95_relative_error:.1%}',
        card='Amplitude error, median', value='{amplitude.median_relative_error:.0%}'),
    Metric(label='identity switches', line='{identity_switches}'),
)
# fmt: on


REMARK = ' (number right in {order_right:.0%} of the records)'
SEEN = '{reflectors_mean:.1f} reflectors per record, {records} records'


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    if not metrics['records']:
        return 'There is no record in this run.'
    if _unscored(metrics):
        found = '{reflectors_mean:.1f} reflectors per record in {records} records. '
        return fill(found, metrics) + NO_TRUTH
    words = (
        'The number of reflectors is right in {order_right:.0%} of the records; a record lies '
        '{ospa_m:.3f} m from the true set (OSPA).'
    )
    if metrics['depth']['n']:
        words += (
            ' Depths are off by {depth.rmse_m:.3f} m (RMS); {false_per_record:.2f} reflectors per '
            'record are false and {missed_per_record:.2f} are missed.'
        )
    return fill(words, metrics)
