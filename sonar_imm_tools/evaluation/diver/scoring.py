# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scores of a tracked recording: errors, and whether the stated uncertainty holds.

`score` gives one nested dict of plain numbers, which is `metrics.json`:

depth                the error of z and the NEES of x, y, z, where both run and truth have a depth
position, velocity   RMSE, median and 95 % point of the error of confirmed tracks
raw_fix              the same for the raw fixes, which a tracker has to beat
lag                  the shift of truth with the smallest error: late stamps, a towed tag
consistency          NEES and NIS with their chi-square bounds, coverage of the ellipses
tracks, gospa        several targets: identity switches, losses, false tracks, and GOSPA
beyond_cutoff        pairs of an estimate and a target that are too far apart to be one: in none of
                     the errors, and no verdict is given that would change with them
models               probability of each motion model, and how often the most probable one changed
"""

from __future__ import annotations

from collections.abc import Iterable
import math
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.association import gate_threshold
from sonar_imm.estimation.consistency import gospa, switches_by_scan, switching_gospa
from sonar_imm.measurements import Fix, Fixes, NOBODY, scan_of

from ... import SECOND
from .. import numbers
from .series import match, Matching, Series, track_summary, Truth

COVERAGE_LEVELS = (0.5, 0.9, 0.95)
LAG_RANGE = 30.0
LEAST_CUTOFF = 10.0
CUTOFF_MEDIANS = 6.0
"""The cutoff in medians of the distance, seven standard deviations of an axis: errors that many
times the usual ones are on another target, or on none."""


def score(
    series: Series,
    truth: Truth | None = None,
    *,
    fixes: Series | None = None,
    cutoff: float | None = None,
) -> dict[str, Any]:
    """All metrics of a run. Without `truth` only those that need none: NIS, models, counts.

    fixes: the raw fixes, see `fix_series`; cutoff: metres from which an estimate is on no target,
    None for `usual_cutoff`.
    """
    confirmed = series.confirmed()
    hits = confirmed.hits()
    span = (series.scan_ns[-1] - series.scan_ns[0]) / SECOND if len(series.scan_ns) else 0.0
    metrics: dict[str, Any] = {
        'stamps': len(series.scan_ns),
        'span_s': float(span),
        'rows_confirmed': len(confirmed),
        'rows_tentative': len(series) - len(confirmed),
        'tracks_confirmed': len(np.unique(confirmed.track_id)),
        'consistency': {'nis': numbers.nis_summary(hits.nis, hits.nis_dof)},
        'models': model_summary(confirmed),
    }
    if truth is None or not len(truth):
        return metrics
    if cutoff is None:
        cutoff = usual_cutoff(confirmed if fixes is None or not len(fixes) else fixes, truth)
    matching = match(confirmed, truth, cutoff=cutoff)
    metrics['cutoff_m'] = float(cutoff)
    metrics['scored_stamps'] = len(matching.scan_ns)
    beyond = len(matching.beyond_row)
    metrics['beyond_cutoff'] = {'n': beyond, 'share': beyond / max(1, beyond + len(matching.row))}
    metrics['position'] = numbers.error_summary(matching.distance)
    speed_error = np.hypot(*matching.error[:, 2:].T)
    metrics['velocity'] = numbers.error_summary(speed_error[np.isfinite(speed_error)], unit='mps')
    if fixes is not None and len(fixes):
        raw = match(fixes, truth, cutoff=cutoff)
        found: dict[str, Any] = numbers.error_summary(raw.distance)
        metrics['raw_fix'] = {**found, 'beyond': len(raw.beyond_row)}
        metrics['same_stamps'] = at_same_stamps(matching, raw)
    metrics['consistency'].update(truth_consistency(matching))
    metrics.update(depth_summary(matching, truth))
    metrics['tracks'] = track_summary(matching)
    metrics['gospa'] = gospa_summary(matching, truth, cutoff)
    metrics['lag'] = best_lag(matching, truth)
    return metrics


def at_same_stamps(track: Matching, raw: Matching) -> dict[str, Any]:
    """Return the RMSE, m, of estimates and fixes at the stamps that both have."""
    stamps = [each.series.stamp_ns[each.row] for each in (track, raw)]
    shared = [np.isin(own, other) for own, other in zip(stamps, stamps[::-1])]
    names = ('track_rmse_m', 'raw_rmse_m')
    rmse = {
        name: float(np.sqrt(np.mean(np.square(each.distance[here])))) if here.any() else math.nan
        for name, each, here in zip(names, (track, raw), shared)
    }
    return {'n': int(shared[0].sum()), **rmse}


def usual_cutoff(series: Series, truth: Truth) -> float:
    """Metres from which an estimate is on no target, by the raw fixes, so that all trackers of a
    recording have the same, or by the tracks where there are none: six times the median distance
    from the truth, and at least 10."""
    distance = match(series, truth, cutoff=np.inf).distance
    median = float(np.median(distance)) if len(distance) else 0.0
    return max(LEAST_CUTOFF, CUTOFF_MEDIANS * median)


def fix_series(fixes: Iterable[Fix | Fixes]) -> Series:
    """Fixes as a series without tracks: every row has track id 0, no velocity, no models."""
    ordered = [scan_of(fix) for fix in sorted(fixes, key=lambda fix: fix.stamp_ns)]
    counts = [len(scan) for scan in ordered]
    stamps = np.array([scan.stamp_ns for scan in ordered], np.int64)
    n = sum(counts)
    state, covariance = np.full((n, 4), np.nan), np.full((n, 4, 4), np.nan)
    for scan, start in zip(ordered, np.cumsum([0, *counts])):
        rows = slice(start, start + len(scan))
        state[rows, :2] = scan.position[:, :2]
        if scan.covariance is not None:
            covariance[rows, :2, :2] = scan.covariance[:, :2, :2]
    return Series(
        scan_ns=np.unique(stamps),
        stamp_ns=np.repeat(stamps, counts),
        track_id=np.zeros(n, np.int64),
        target_id=np.full(n, NOBODY),
        track_state=np.ones(n, np.int64),
        state=state,
        covariance=covariance,
        place=np.full((n, 3), np.nan),
        place_covariance=np.full((n, 3, 3), np.nan),
        z=np.full(n, np.nan),
        model_names=(),
        probabilities=np.empty((n, 0)),
        nis=np.full(n, np.nan),
        nis_dof=np.full(n, np.nan),
    )


def truth_consistency(matching: Matching) -> dict[str, Any]:
    """NEES on position and on the whole state, and the coverage of the position ellipses.

    verdict: what coverage and NEES say; it, and `believable` of a NEES, are None where the pairs
    beyond the cutoff would change them.
    """
    series = matching.series
    error, covariance = matching.error, series.covariance[matching.row]
    far = series.state[matching.beyond_row] - matching.beyond_truth, matching.beyond_row
    position, position_far = (
        numbers.usable_nees(e[:, :2], series.covariance[rows, :2, :2])
        for e, rows in ((error, matching.row), far)
    )
    coverage = {f'{100 * level:g}': _coverage(position, level) for level in COVERAGE_LEVELS}
    whole = _coverage(np.concatenate([position, position_far]), 0.95)
    near = _summary(position, position_far, 2)
    far_too = numbers.chi2_summary(np.concatenate([position, position_far]), 2)
    verdict, of_all = (
        numbers.coverage_verdict(share, nees=numbers.relative_nees(summary))
        for share, summary in ((coverage['95'], near), (whole, far_too))
    )
    result: dict[str, Any] = {
        'nees_position': near,
        'coverage': coverage,
        'verdict': verdict if len(position) and verdict == of_all else None,
        'singular_position_covariances': len(error) - len(position),
    }
    if known := int(np.isfinite(error).all(axis=1).sum()):
        state = numbers.usable_nees(error, covariance)
        far_state = numbers.usable_nees(far[0], series.covariance[far[1]])
        result['nees_state'] = _summary(state, far_state, 4)
        result['singular_state_covariances'] = known - len(state)
    return result


def depth_summary(matching: Matching, truth: Truth) -> dict[str, Any]:
    """The error of depth and the NEES of the three coordinates; nothing where the run estimates no
    depth or the truth has none."""
    series = matching.series
    z = truth.heights(series.stamp_ns[matching.row])[matching.target, np.arange(len(matching.row))]
    error = series.place[matching.row] - np.column_stack([matching.truth[:, :2], z])
    known = np.isfinite(error).all(axis=1)
    if not known.any():
        return {}
    whole = numbers.usable_nees(error[known], series.place_covariance[matching.row[known]])
    down = np.abs(error[known, 2])
    return {'depth': {**numbers.error_summary(down), 'nees_3d': numbers.chi2_summary(whole, 3)}}


def _coverage(position: FloatArray, level: float) -> float:
    """Share of the NEES of positions inside the ellipse of a level; NaN for none."""
    inside = position <= gate_threshold(level, 2)
    return float(np.mean(inside)) if len(position) else float('nan')


def _summary(nees: FloatArray, beyond: FloatArray, dof: int) -> dict[str, Any]:
    """`chi2_summary` of the pairs within the cutoff."""
    kept = numbers.chi2_summary(nees, dof)
    if len(nees) and len(beyond):
        whole = numbers.chi2_summary(np.concatenate([nees, beyond]), dof)
        sides = [np.searchsorted([s['low'], s['high']], s['mean']) for s in (kept, whole)]
        if sides[0] != sides[1]:
            kept['believable'] = None
    return kept


def model_summary(series: Series) -> dict[str, Any]:
    """Mean probability of each model, the share of rows in which it is the most probable one, and
    how often per minute the most probable one changes."""
    if not len(series) or not series.model_names:
        return {}
    leader = np.argmax(series.probabilities, axis=1)
    changes, duration = 0, 0.0
    for track_id in np.unique(series.track_id):
        rows = series.track_id == track_id
        changes += int(np.count_nonzero(np.diff(leader[rows])))
        duration += float(np.ptp(series.stamp_ns[rows])) / SECOND
    return {
        'mean_probability': dict(
            zip(series.model_names, series.probabilities.mean(axis=0).tolist())
        ),
        'leads': {
            name: float(np.mean(leader == index)) for index, name in enumerate(series.model_names)
        },
        'leader_changes_per_minute': 60.0 * changes / duration if duration > 0 else float('nan'),
    }


def gospa_summary(matching: Matching, truth: Truth, cutoff: float) -> dict[str, float]:
    """GOSPA (p = 2, alpha = 2) averaged over the scored stamps, and its parts; and the same of the
    run as a whole with half of the cutoff for each identity switch."""
    series, states = matching.series, truth.at(matching.scan_ns)
    parts = []
    for scan, (start, end) in enumerate(zip(*series.spans(matching.scan_ns))):
        there = states[matching.present[:, scan], scan, :2]
        parts.append(gospa(there, series.state[start:end, :2], cutoff))
    if not parts:
        return {}
    half = 0.5 * cutoff**2
    return {
        'mean_m': float(np.mean([part.distance for part in parts])),
        'rms_m': float(np.sqrt(np.mean([part.distance**2 for part in parts]))),
        'with_switches_m': switching_gospa(
            np.array([part.distance for part in parts]),
            switches_by_scan(matching.followed_by.T),
            0.5 * cutoff,
        ),
        'missed_per_scan': float(np.mean([part.missed for part in parts])) / half,
        'false_per_scan': float(np.mean([part.false for part in parts])) / half,
    }


def best_lag(matching: Matching, truth: Truth) -> dict[str, float]:
    """The lag of `Truth.shifted` with the least RMSE: a coarse search, then a fine one.

    Positive: the estimates agree best with the truth that much later. The pairing is kept.
    """
    stamp_ns = matching.series.stamp_ns[matching.row]
    position = matching.series.state[matching.row, :2]

    def rmse(lag: float) -> float:
        states = truth.shifted(lag).at(stamp_ns)[matching.target, np.arange(len(stamp_ns)), :2]
        distance = np.hypot(*(position - states).T)
        return numbers.error_summary(distance[np.isfinite(distance)])['rmse_m']

    reach = min(LAG_RANGE, float(np.ptp(stamp_ns)) / SECOND / 4.0) if len(stamp_ns) else 0.0
    if reach <= 0.0:
        return {}
    grid = np.linspace(-reach, reach, 61)
    coarse = grid[int(np.nanargmin([rmse(lag) for lag in grid]))]
    step = grid[1] - grid[0]
    fine = minimize_scalar(rmse, bounds=(coarse - step, coarse + step), method='bounded')
    return {
        'best_s': float(fine.x),
        'rmse_at_best_m': float(fine.fun),
        'rmse_at_zero_m': rmse(0.0),
    }
