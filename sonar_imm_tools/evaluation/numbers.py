# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Metrics that all systems share, and how they are put into words.

Errors are summarised by RMSE, median and 95 % point. Whether the stated uncertainty holds is
tested by NEES and NIS, which are chi-square distributed when it does. Their bounds suppose that
successive errors are independent. The errors of one track are correlated over a few stamps, so a
mean slightly outside its bounds proves nothing; one far outside does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import string
from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consistency import average_bounds, nees

SINGULAR = 1e-9


def flatten(values: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Nested mappings as one; the keys are joined by dots."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            result.update(flatten(value, f'{prefix}{key}.'))
        else:
            result[f'{prefix}{key}'] = value
    return result


def counted(number: int, noun: str) -> str:
    """A number of things in words, e.g. ``2 tracks``."""
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def error_summary(error: FloatArray, *, unit: str = 'm') -> dict[str, float]:
    """RMSE, median and 95 % point of non-negative errors; NaN when there are none."""
    rmse = median = p95 = float('nan')
    if len(error):
        rmse, median = float(np.sqrt(np.mean(error**2))), float(np.median(error))
        p95 = float(np.percentile(error, 95.0))
    return {'n': len(error), f'rmse_{unit}': rmse, f'median_{unit}': median, f'p95_{unit}': p95}


def usable_nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """NEES of the rows that are finite and whose covariance is not singular.

    A filter that is certain of one heading states a velocity along that heading only. Then its
    covariance is singular, and NEES is not defined.
    """
    finite = np.isfinite(error).all(axis=1), np.isfinite(covariance).all(axis=(1, 2))
    good = np.logical_and(*finite)
    values = np.linalg.eigvalsh(covariance[good])
    good[good] = values[:, 0] > SINGULAR * values[:, -1]
    return nees(error[good], covariance[good]) if good.any() else np.empty(0)


def chi2_summary(values: FloatArray, dof: int) -> dict[str, Any]:
    """Mean of chi-square values, `dof` expected, with its two-sided 95 % bounds."""
    if not len(values):
        return {'n': 0, 'dof': dof, 'mean': float('nan'), 'believable': None}
    return _within(len(values), dof, float(np.mean(values)), *average_bounds(len(values), dof))


def _within(n: int, dof: int, mean: float, low: float, high: float) -> dict[str, Any]:
    bounds = {'low': low, 'high': high, 'believable': bool(low <= mean <= high)}
    return {'n': n, 'dof': dof, 'mean': mean, **bounds}


def nis_summary(nis: FloatArray, dof: FloatArray) -> dict[str, Any]:
    """Mean NIS of all hits with its bounds; divided by the degrees of freedom where these vary."""
    if not len(nis) or (dof == dof[0]).all():
        return chi2_summary(nis, int(dof[0]) if len(nis) else 2)
    sums = nis.sum(), *average_bounds(1, int(dof.sum()))
    per_dof = (float(value / dof.sum()) for value in sums)
    return {**_within(len(nis), 1, *per_dof), 'divided_by_dof': True}


MOST_NEES = 2.0
"""Mean NEES, over its degrees of freedom, above which a tracker is overconfident whatever its
bands hold: few errors are far too large then."""


def coverage_verdict(coverage: float, stated: float = 0.95, nees: float = 0.0) -> str:
    """Return the verdict on a stated uncertainty.

    :param coverage: share of the truth inside bands. Twice as much outside as stated is
        overconfident, a fifth cautious.
    :param stated: share that the bands state.
    :param nees: mean NEES over its degrees of freedom; both have to hold.
    """
    outside, allowed = round(1.0 - coverage, 9), 1.0 - stated
    if outside > round(2.0 * allowed, 9) or nees > MOST_NEES:
        return 'overconfident'
    return 'cautious' if outside < round(0.2 * allowed, 9) else 'consistent'


def relative_nees(summary: Mapping[str, Any] | None) -> float:
    """Return the mean of a `chi2_summary` over its degrees of freedom; 0 if there is none."""
    mean = summary['mean'] / summary['dof'] if summary and summary.get('n') else 0.0
    return float(mean) if mean == mean else 0.0


def coverage_sentence(coverage: float, nees: float = 0.0) -> str:
    """Return the `coverage_verdict` in words."""
    held = f'its 95 % ellipses hold the truth {100 * coverage:.0f} % of the time'
    words = {
        'overconfident': 'The tracker is overconfident',
        'cautious': 'The tracker is more cautious than it needs to be',
        'consistent': 'The stated uncertainty is consistent with the errors',
    }
    verdict = coverage_verdict(coverage, nees=nees)
    if verdict == 'overconfident' and coverage_verdict(coverage) != verdict:
        held += f', but the others lie far outside (mean NEES {nees:,.3g} times the expected one)'
    return f'{words[verdict]}: {held}.'


def bounds_remark(summary: Mapping[str, Any]) -> str:
    """What to compare the mean of a `chi2_summary` or `nis_summary` with."""
    if 'low' not in summary:
        return f'{summary["n"]} values'
    per = summary.get('divided_by_dof')
    due = 'per degree of freedom: 1 expected' if per else f'{summary["dof"]} expected'
    within = f'{summary["low"]:.2f} to {summary["high"]:.2f}'
    outside = summary.get('believable') is False
    return f'{due}; outside of {within}' if outside else f'{due}, {within} believable'


@frozen
class Check:
    """One check: its result, and what was wanted."""

    name: str
    result: str
    wanted: str
    good: bool


NO_TRUTH = (
    'There is no truth to compare with, so only the estimates and their stated uncertainty are '
    'shown.'
)
UNMATCHED = 'None of them was matched with the truth.'
Text = str | Callable[[Mapping[str, Any]], str]
"""A format with dotted names of metrics, ``'{position.rmse_m:.2f} m'``, or a function of them."""


@frozen(kw_only=True)
class Metric:
    """A metric of ``metrics.json`` as people read it, on the terminal, in the report, or in both.

    label, line: title and text of the line on the terminal. card, value, remark: title, value and
    explanation of the key number in the report. front: whether it is one of the few on the front
    page of several runs. covers: dotted name of the share of the truth inside a band, and the
    share that the band states; nees: dotted name of the NEES that has to hold too. when: whether
    to show it. Without a label it is not on the
    terminal, without a card not in the report, and without the first number that is named in
    neither.
    """

    label: str = ''
    line: str = ''
    card: str = ''
    value: str = ''
    remark: Text = ''
    front: bool = False
    covers: tuple[str, float] | None = None
    nees: str = ''
    when: Callable[[Mapping[str, Any]], object] = lambda metrics: True


@frozen
class Card:
    """One key number: the value, what it is, and a line to compare it with."""

    value: str
    title: str
    remark: str = ''
    front: bool = False


def error(key: str, label: str, unit: str = 'm', **card: Any) -> Metric:
    """The `error_summary` at `key`: all of it in a line, RMSE and the rest on a card."""
    names = [f'{{{key}.{name}_{unit}' for name in ('rmse', 'median', 'p95')]
    shown = {'mps': 'm/s'}.get(unit, unit)
    values: dict[str, Any] = {
        'value': f'{names[0]}:.2f}} {shown}',
        'remark': f'median {names[1]}:.2f}} {shown}, 95 % {names[2]}:.2f}} {shown}',
    }
    line = ' / '.join(f'{name}:.3f}}' for name in names) + f' {shown}'
    return Metric(label=f'{label}, RMSE / median / 95 %', line=line, **values | card)


def chi2(key: str, label: str, card: str = '') -> Metric:
    """The `chi2_summary` or `nis_summary` at `key`: the mean, and what is believable."""
    return Metric(
        label=label,
        line=f'{{{key}.mean:.2f}}, believable {{{key}.low:.2f}} to {{{key}.high:.2f}}',
        card=card,
        value=f'{{{key}.mean:.2f}}',
        remark=lambda metrics: bounds_remark(look_up(metrics, key)),
    )


def each(key: str, names: Iterable[str]) -> list[Metric]:
    """A line for each of the numbers `names` at `key`."""
    return [Metric(label=name.replace('_', ' '), line=f'{{{key}.{name}:.3g}}') for name in names]


def lines(shown: Iterable[Metric], metrics: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Label and text of every metric that is known and belongs on the terminal."""
    return tuple(
        (metric.label, fill(metric.line, metrics))
        for metric in shown
        if metric.label and metric.when(metrics) and _known(metric.line, metrics)
    )


def cards(shown: Iterable[Metric], metrics: Mapping[str, Any]) -> tuple[Card, ...]:
    """The key number of every metric that is known and belongs in the report."""
    return tuple(
        Card(fill(metric.value, metrics), metric.card, fill(metric.remark, metrics), metric.front)
        for metric in shown
        if metric.card and metric.when(metrics) and _known(metric.value, metrics)
    )


def front(cards: Iterable[Card]) -> list[Card]:
    """The three key numbers for the front page: those that are meant for it, then the others."""
    return sorted(cards, key=lambda card: not card.front)[:3]


def verdict(shown: Iterable[Metric], metrics: Mapping[str, Any]) -> str:
    """What the share of the truth inside a band, and the NEES, say about the stated uncertainty;
    empty where nothing tells."""
    for metric in shown:
        if metric.covers is not None and metric.when(metrics):
            inside, stated = look_up(metrics, metric.covers[0]), metric.covers[1]
            if inside is not None and inside == inside:
                return coverage_verdict(
                    inside, stated, relative_nees(look_up(metrics, metric.nees))
                )
    return ''


def fill(text: Text, metrics: Mapping[str, Any]) -> str:
    """`text` with its metrics; ``-`` stands for a number that is not known. The format ``.0%``
    leaves a space before the sign."""
    return text(metrics) if callable(text) else _WORDS.vformat(text, (), metrics)


def look_up(metrics: Mapping[str, Any], name: str) -> Any:
    """What is at a dotted name; None when it is not there."""
    found: Any = metrics
    for key in name.split('.'):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _known(text: str, metrics: Mapping[str, Any]) -> bool:
    """Whether the first number of a format is there."""
    value = next(look_up(metrics, name) for _, name, _, _ in _WORDS.parse(text) if name)
    return value is not None and value == value


class _Words(string.Formatter):
    def get_field(self, name: str, args: Any, metrics: Any) -> tuple[Any, str]:
        return look_up(metrics, name), name

    def format_field(self, value: Any, form: str) -> str:
        if value is None or value != value:
            return '-'
        if form.endswith('%'):
            return f'{100.0 * value:{form[:-1]}f} %'
        return super().format_field(value, form)


_WORDS = _Words()
