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

"""Scores of obstacle tracks: `score` gives one nested dict of plain numbers, `metrics.json`.

range, bearing, vertical_offset   RMSE, median and 95 % point of confirmed tracks, whole run
vertical_offset_near              the same within 50 m, where a vehicle has to decide
consistency                       NEES, NIS, and how often the 90 % band holds the truth
above                             calibration of the stated probability of being above
gospa                             several obstacles: distance, missed and false per ping
tracks                            how many, found and false, and identity switches: an obstacle
                                  is taken over by another track
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.consistency import identity_switches, interval_coverage

from ... import SECOND
from ..numbers import chi2_summary, error_summary, usable_nees
from .series import match, Matching, Series, TruePath

NEAR = 50.0
BINS = (0.0, 0.1, 0.3, 0.7, 0.9, 1.0)


def score(
    series: Series, truth: tuple[TruePath, ...] | None, *, cutoff: float, gap: float
) -> tuple[dict[str, Any], Matching | None]:
    """All metrics of a run, and the matching they rest on. Without truth only what needs none."""
    pings = series.ping_ns
    nis = series.nis[np.isfinite(series.nis)]
    metrics: dict[str, Any] = {
        'pings': len(pings),
        'span_s': float(np.ptp(pings)) / SECOND if len(pings) else 0.0,
        'tracks_confirmed': len(np.unique(series.track_id)),
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
            'tracks': metrics['tracks_confirmed'],
            'false_tracks': metrics['tracks_confirmed']
            - len(np.unique(series.track_id[found.row])),
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


def followed_by(found: Matching, obstacles: int) -> NDArray[np.int64]:
    """(pings, obstacles) id of the track on each obstacle, -1 without."""
    series = found.series
    followed = np.full((len(series.ping_ns), obstacles), -1, np.int64)
    ping = np.searchsorted(series.ping_ns, series.stamp_ns[found.row])
    followed[ping, found.target] = series.track_id[found.row]
    return followed


def above_calibration(found: Matching) -> dict[str, Any]:
    """Brier score of P(above), and for each range of it how often the obstacle was above."""
    stated, true = found.series.above[found.row], found.truth[:, 2] < 0.0
    if not len(stated):
        return {}
    which = np.clip(np.searchsorted(BINS, stated, side='right') - 1, 0, len(BINS) - 2)
    table = {
        f'{BINS[k]:g} to {BINS[k + 1]:g}': {
            'n': int((which == k).sum()),
            'stated': float(stated[which == k].mean()),
            'came_true': float(true[which == k].mean()),
        }
        for k in range(len(BINS) - 1)
        if (which == k).any()
    }
    return {'brier': float(np.mean((stated - true) ** 2)), 'bins': table}


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
