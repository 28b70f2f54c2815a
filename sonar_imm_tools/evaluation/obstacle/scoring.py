# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scores of obstacle tracks: `score` gives one nested dict of plain numbers, `metrics.json`.

range, bearing, vertical_offset   RMSE, median and 95 % point of confirmed tracks, whole run
vertical_offset_near              the same within 50 m, where a vehicle has to decide
consistency                       NEES, NIS, and how often the 90 % band holds the truth
above                             calibration of the stated probability of being above
gospa                             several obstacles: distance, missed and false per ping
tracks                            how many, found and false, and identity switches: an obstacle
                                  is taken over by another track
tether_m, tether_std_m            how far above the sea floor the obstacle is whose track has most
                                  echoes: the length of its tether, if it is moored; needs altitude

`motion_metrics` adds whether obstacles move as stated, and whether stated collisions happen.

velocity    RMSE of each axis, of what moves and of what does not; NEES of what moves
behaviours  mean stated probability of each behaviour, by what the obstacle does; brier: of all
            behaviours together, 0 to 2
collisions  Brier score of the stated probability, beside that of a guess by how often it happens,
            and by bins how often what was stated happened

A collision is what the parameters of the run define: `safety_radius` and `safety_height` at once,
within `cpa_horizon`. A forecast counts where the truth goes on until its outcome is known: it
happened, the horizon is over, or the obstacle has been passed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray
from sonar_imm.estimation.consistency import identity_switches, interval_coverage
from sonar_imm.measurements import Altitude, Measurement
from sonar_imm.trackers.obstacle.config import BEHAVIOURS, ObstacleConfig

from ... import SECOND
from ..numbers import chi2_summary, error_summary, usable_nees
from .series import match, Matching, Series, TruePath

NEAR = 50.0
BINS = (0.0, 0.1, 0.3, 0.7, 0.9, 1.0)
RISKS = (0.0, 0.02, 0.1, 0.3, 0.6, 0.9, 1.0)


def score(
    series: Series, truth: tuple[TruePath, ...] | None, *, cutoff: float, gap: float
) -> tuple[dict[str, Any], Matching | None]:
    """All metrics of a run, and the matching they rest on. Without truth only what needs none."""
    pings, tracks = series.scan_ns, len(np.unique(series.track_id))
    nis = series.nis[np.isfinite(series.nis)]
    metrics: dict[str, Any] = {
        'pings': len(pings),
        'span_s': float(np.ptp(pings)) / SECOND if len(pings) else 0.0,
        'tracks_confirmed': tracks,
        'rows_confirmed': len(series),
        'consistency': {'nis': chi2_summary(nis, 2)},
    }
    if not truth:
        return metrics, None
    found = match(series, truth, cutoff=cutoff, gap=gap)
    error = found.error
    near = found.truth[:, 0] <= NEAR
    metrics |= {
        'cutoff_m': float(cutoff),
        'scored_rows': len(found.row),
        'range': error_summary(np.abs(error[:, 0])),
        'bearing': error_summary(np.degrees(np.abs(error[:, 1])), unit='deg'),
        'vertical_offset': error_summary(np.abs(error[:, 2])),
        'vertical_offset_near': error_summary(np.abs(error[near, 2])),
        'above': above_calibration(found),
        'gospa': gospa_summary(found, cutoff),
        'tracks': {
            'true_obstacles': len(truth),
            'found_obstacles': len(np.unique(found.target)),
            'tracks': tracks,
            'false_tracks': tracks - len(np.unique(series.track_id[found.row])),
            'identity_switches': identity_switches(followed_by(found, len(truth))),
        },
    }
    metrics['consistency'] |= truth_consistency(found)
    return metrics, found


def truth_consistency(found: Matching) -> dict[str, Any]:
    """NEES of the offset and of the whole state, coverage of the 90 % band."""
    error, covariance = found.error, found.series.covariance[found.row]
    offset = usable_nees(error[:, 2:], covariance[:, 2:, 2:])
    low, high = found.series.low[found.row], found.series.high[found.row]
    return {
        'nees_offset': chi2_summary(offset, 1),
        'nees_state': chi2_summary(usable_nees(error, covariance), 3),
        'band_coverage': interval_coverage(found.truth[:, 2], low, high),
    }


def followed_by(found: Matching, obstacles: int) -> IntArray:
    """(pings, obstacles) id of the track on each obstacle, -1 without."""
    series = found.series
    followed = np.full((len(series.scan_ns), obstacles), -1, np.int64)
    ping = np.searchsorted(series.scan_ns, series.stamp_ns[found.row])
    followed[ping, found.target] = series.track_id[found.row]
    return followed


def above_calibration(found: Matching) -> dict[str, Any]:
    """Brier score of P(above), and for each range of it how often the obstacle was above."""
    stated, true = found.series.above[found.row], found.truth[:, 2] < 0.0
    if not len(stated):
        return {}
    return {'brier': float(np.mean((stated - true) ** 2)), 'bins': binned(stated, true, BINS)}


def binned(
    stated: FloatArray, true: BoolArray, edges: Sequence[float]
) -> dict[str, dict[str, float]]:
    """How often what was stated (m,) is true (m,), by ranges of the stated probability."""
    which = np.clip(np.searchsorted(edges, stated, side='right') - 1, 0, len(edges) - 2)
    return {
        f'{edges[k]:g} to {edges[k + 1]:g}': {
            'n': int((which == k).sum()),
            'stated': float(stated[which == k].mean()),
            'came_true': float(true[which == k].mean()),
        }
        for k in range(len(edges) - 1)
        if (which == k).any()
    }


def gospa_summary(found: Matching, cutoff: float) -> dict[str, float]:
    """GOSPA in range and bearing laid flat, averaged over the pings, and its parts."""
    if not len(found.gospa):
        return {}
    half = 0.5 * cutoff**2
    distance, _, missed, false = found.gospa.mean(axis=0)
    return {
        'mean_m': float(distance),
        'missed_per_ping': float(missed / half),
        'false_per_ping': float(false / half),
    }


def tether_length(
    series: Series, received: Sequence[Measurement], config: ObstacleConfig
) -> dict[str, float]:
    """``tether_m`` and ``tether_std_m``: the altitude of the sonar at the first echo of the track
    with most echoes, less the offset then, as its last echo shows it. Empty without a track, or
    without an altitude within `max_altitude_age` of the first echo."""
    track = series.pick((series.track_id == series.longest_track()) & np.isfinite(series.nis))
    heights = [item for item in received if isinstance(item, Altitude)]
    if not (len(track) and heights):
        return {}
    first = int(track.stamp_ns[0])
    nearest = min(heights, key=lambda item: abs(item.stamp_ns - first))
    if abs(nearest.stamp_ns - first) > config.max_altitude_age * SECOND:
        return {}
    # The sonar may dive meanwhile: the obstacle lies where the last echo has it.
    offset = track.height[0] + track.state[0, 2] - track.height[-1]
    length = nearest.altitude + config.sonar_lever[2] - offset
    std = np.hypot(np.sqrt(track.covariance[-1, 2, 2]), config.altitude_std)
    return {'tether_m': float(length), 'tether_std_m': float(std)}


def motion_metrics(
    found: Matching, truth: Sequence[TruePath], config: ObstacleConfig
) -> dict[str, Any]:
    """``velocity``, ``behaviours`` and ``collisions``, each where the run and its truth tell."""
    metrics = {
        'velocity': velocity_scores(found, truth),
        'behaviours': behaviour_scores(found, truth),
        'collisions': forecast_scores(*forecasts(found, truth, config)),
    }
    return {name: values for name, values in metrics.items() if values}


def velocity_scores(found: Matching, truth: Sequence[TruePath]) -> dict[str, Any]:
    series, at = found.series, _newest(found, truth)
    known = np.array([path.velocity is not None for path in truth], bool)[found.target]
    known &= np.isfinite(series.velocity[found.row]).all(axis=1)
    rows = np.flatnonzero(known)
    if not len(rows):
        return {}
    true = np.array([truth[found.target[k]].velocity[at[k]] for k in rows])
    error = series.velocity[found.row[rows]] - true
    moves = np.linalg.norm(true, axis=1) > 0.0
    scores: dict[str, Any] = {
        name: {'n': int(which.sum()), 'rmse_m_s': float(np.sqrt(np.mean(error[which] ** 2)))}
        for name, which in (('moving', moves), ('still', ~moves))
        if which.any()
    }
    # What is certain not to move has a velocity of zero without spread.
    if moves.any():
        spread = series.velocity_covariance[found.row[rows[moves]]]
        scores['moving']['nees'] = chi2_summary(usable_nees(error[moves], spread), 2)
    return scores


def behaviour_scores(found: Matching, truth: Sequence[TruePath]) -> dict[str, Any]:
    at = _newest(found, truth)
    stated = np.nan_to_num(found.series.does[found.row])
    known = np.array([path.does is not None for path in truth], bool)[found.target]
    rows = np.flatnonzero(known & (stated.sum(axis=1) > 0.0))
    if not len(rows):
        return {}
    true = np.array([truth[found.target[k]].does[at[k]] for k in rows])
    confusion: dict[str, dict[str, float]] = {}
    for kind in np.unique(true):
        means = stated[rows][true == kind].T
        each = {name: float(np.mean(column)) for name, column in zip(BEHAVIOURS, means)}
        confusion[BEHAVIOURS[kind]] = {'n': int((true == kind).sum()), **each}
    off = stated[rows] - np.eye(len(BEHAVIOURS))[true]
    return {'confusion': confusion, 'brier': float(np.mean(np.sum(off**2, axis=1)))}


def forecasts(
    found: Matching, truth: Sequence[TruePath], config: ObstacleConfig
) -> tuple[FloatArray, BoolArray]:
    """Stated probabilities (m,) of which the outcome is known, and whether it happened (m,)."""
    stated, came = [], []
    outcomes = [_outcomes(path, config) for path in truth]
    at = _newest(found, truth)
    for k, row in enumerate(found.row.tolist()):
        outcome = outcomes[found.target[k]][at[k]]
        if np.isfinite(found.series.risk[row]) and np.isfinite(outcome):
            stated.append(found.series.risk[row])
            came.append(outcome > 0.0)
    return np.array(stated, float), np.array(came, bool)


def forecast_scores(stated: FloatArray, came: BoolArray) -> dict[str, Any]:
    """Brier score and bins of forecasts (m,) and what came of them (m,)."""
    if not len(stated):
        return {}
    often = float(came.mean())
    return {
        'n': len(stated),
        'happened': often,
        'brier': float(np.mean((stated - came) ** 2)),
        'brier_of_a_guess': often * (1.0 - often),
        'bins': binned(stated, came, RISKS),
    }


def _outcomes(path: TruePath, config: ObstacleConfig) -> FloatArray:
    """Of each stamp (n,) of an obstacle: 1 when a collision follows, 0 when none does, NaN when
    the truth ends before that is known."""
    t = path.stamp_ns / SECOND
    distance, _, offset = path.seen.T
    level = np.sqrt(np.maximum(distance**2 - offset**2, 0.0))
    near = level <= config.safety_radius
    hits = np.flatnonzero(near & (np.abs(offset) <= config.safety_height))
    outcome = np.full(len(t), np.nan)
    # Passed: it was nearest before the end, and is out of reach when the truth ends.
    nearest = int(np.argmin(level))
    passed = nearest < len(t) - 1 and level[-1] > config.safety_radius
    for k in range(len(t)):
        following = hits[np.searchsorted(hits, k) :]
        if len(following) and t[following[0]] - t[k] <= config.cpa_horizon:
            outcome[k] = 1.0
        elif passed or t[-1] - t[k] >= config.cpa_horizon:
            outcome[k] = 0.0
    return outcome


def _newest(found: Matching, truth: Sequence[TruePath]) -> IntArray:
    """Index into the obstacle's truth, the newest of each matched row (m,)."""
    stamps = found.series.stamp_ns[found.row]
    at = np.zeros(len(found.row), np.int64)
    for target, path in enumerate(truth):
        rows = found.target == target
        at[rows] = np.searchsorted(path.stamp_ns, stamps[rows], side='right') - 1
    return np.maximum(at, 0)
