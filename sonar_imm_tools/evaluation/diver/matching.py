# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which estimate belongs to which true target, stamp by stamp, and the metrics of whole tracks.

With one target and never more than one track they belong together, however far apart, so that no
large error is left out. Otherwise the rows of each stamp are assigned to the true targets by least
total distance (Hungarian method). Pairs further apart than the cutoff do not count: the target was
missed and the track is false. Whether that was so, or the error is large, nobody can tell: what is
left over on both sides is paired too, and kept apart, so that a verdict that would change with it
can be withheld.
"""

from __future__ import annotations

from attrs import frozen
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consistency import identity_switches

from .series import IntArray, Series, Truth


@frozen(eq=False, kw_only=True)
class Matching:
    """Pairs of estimate rows and true targets.

    row: (k,) row of the series; target: (k,) index of the true path; truth: (k, 4) its state.
    scan_ns: (s,) the stamps at which some truth is known. present: (paths, s) whether a target is
    there; followed_by: (paths, s) id of the track on it, -1 without. scored: (n,) which rows of
    the series lie on such a stamp. beyond_row, beyond_truth: rows and true states (b, 4) of the
    pairs that the cutoff keeps out.
    """

    series: Series
    row: IntArray
    target: IntArray
    truth: FloatArray
    beyond_row: IntArray
    beyond_truth: FloatArray
    scan_ns: IntArray
    present: NDArray[np.bool_]
    followed_by: IntArray
    scored: NDArray[np.bool_]

    @property
    def error(self) -> FloatArray:
        """(k, 4) estimate minus truth; velocity NaN where the truth has none."""
        return self.series.state[self.row] - self.truth

    @property
    def distance(self) -> FloatArray:
        """(k,) metres between estimate and truth."""
        return np.hypot(*self.error[:, :2].T)


def match(series: Series, truth: Truth, *, cutoff: float) -> Matching:
    """Assign the rows of `series` to `truth` at every stamp of the run where truth is known."""
    states = truth.at(series.scan_ns)
    present = np.isfinite(states[:, :, 0])
    known = present.any(axis=0)
    limit = np.inf if _one_to_one(series, truth) else cutoff
    starts = np.searchsorted(series.stamp_ns, series.scan_ns, side='left')
    ends = np.searchsorted(series.stamp_ns, series.scan_ns, side='right')
    followed_by = np.full(present.shape, -1, np.int64)
    near: list[tuple[np.integer, ...]] = []
    beyond: list[tuple[np.integer, ...]] = []
    for scan in np.flatnonzero(known & (ends > starts)):
        there = np.flatnonzero(present[:, scan])
        offset = series.state[starts[scan] : ends[scan], None, :2] - states[None, there, scan, :2]
        distance = np.hypot(offset[..., 0], offset[..., 1])
        pairs = assign(distance, limit)
        for at, column in pairs:
            near.append((starts[scan] + at, there[column], scan))
            followed_by[there[column], scan] = series.track_id[starts[scan] + at]
        if len(pairs) < min(distance.shape):
            rows = np.setdiff1d(np.arange(len(distance)), [at for at, _ in pairs])
            columns = np.setdiff1d(np.arange(len(there)), [column for _, column in pairs])
            beyond += [
                (starts[scan] + rows[at], there[columns[column]], scan)
                for at, column in assign(distance[np.ix_(rows, columns)], np.inf)
            ]
    row, target, ping = np.array(near, np.int64).reshape(-1, 3).T
    beyond_row, beyond_target, beyond_ping = np.array(beyond, np.int64).reshape(-1, 3).T
    scan_ns = series.scan_ns[known]
    return Matching(
        series=series,
        row=row,
        target=target,
        truth=states[target, ping],
        beyond_row=beyond_row,
        beyond_truth=states[beyond_target, beyond_ping],
        scan_ns=scan_ns,
        present=present[:, known],
        followed_by=followed_by[:, known],
        scored=np.isin(series.stamp_ns, scan_ns),
    )


def assign(distance: FloatArray, limit: float) -> list[tuple[int, int]]:
    """Pairs (row, column) of least total distance, without those at `limit` or beyond."""
    cost = np.where(np.isfinite(distance), np.minimum(distance, limit), 1e12)
    return [
        (int(row), int(column))
        for row, column in zip(*linear_sum_assignment(cost))
        if distance[row, column] < limit
    ]


def _one_to_one(series: Series, truth: Truth) -> bool:
    return len(truth) == 1 and len(np.unique(series.stamp_ns)) == len(series)


def track_summary(matching: Matching) -> dict[str, float]:
    """Counts that describe whole tracks.

    identity_switches: how often a target is taken over by another track id. fragmentations: how
    often a target is lost and found again. false_tracks: tracks that are on no target for most of
    their life. completeness: share of (target, stamp) pairs that were found.
    """
    series = matching.series
    found = matching.followed_by != -1
    present = int(matching.present.sum())
    scored_ids, lifetimes = np.unique(series.track_id[matching.scored], return_counts=True)
    on_target = series.track_id[matching.row]
    hits = np.array([np.count_nonzero(on_target == track_id) for track_id in scored_ids])
    return {
        'true_targets': int(matching.present.any(axis=1).sum()),
        'tracks': len(scored_ids),
        'false_tracks': int(np.count_nonzero(2 * hits < lifetimes)),
        'identity_switches': identity_switches(matching.followed_by.T),
        'fragmentations': sum(
            _interruptions(is_found[there]) for is_found, there in zip(found, matching.present)
        ),
        'completeness': float(found.sum() / present) if present else float('nan'),
        'false_rows_per_scan': float(
            (matching.scored.sum() - len(matching.row)) / max(1, len(matching.scan_ns))
        ),
    }


def _interruptions(found: NDArray[np.bool_]) -> int:
    """How often a target that had been found was found again after a loss."""
    begins = np.count_nonzero(np.diff(found.astype(np.int8), prepend=0) == 1)
    return max(0, int(begins) - 1)
