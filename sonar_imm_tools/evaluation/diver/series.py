# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimates of divers as flat arrays, truth at their stamps, and which belongs to which.

Truth has its own rate (GPS once per second, a simulation at each step). Between two points
position and velocity are interpolated linearly. Beyond the ends, and in gaps longer than a limit,
truth is unknown and nothing is scored.

With one target and never more than one track they belong together, however far apart, so that no
large error is left out. Otherwise the rows of each stamp are assigned to the true targets by least
total distance (Hungarian method). Pairs further apart than the cutoff do not count: the target was
missed and the track is false. Whether that was so, or the error is large, nobody can tell: what is
left over on both sides is paired too, and kept apart, so that a verdict that would change with it
can be withheld.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from attrs import evolve, frozen
import numpy as np
from scipy.optimize import linear_sum_assignment

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray
from sonar_imm.estimation.consistency import identity_switches
from sonar_imm.measurements import NOBODY

from ... import SECOND
from ..columns import column, covariance_of, read_rows, Rows

STATES = ('px', 'py', 'vx', 'vy')


@frozen(eq=False, kw_only=True)
class Series(Rows):
    """Rows of tracks, in metres and m/s; velocities and their covariance are NaN where unknown.

    place, place_covariance: x, y, z and their covariance, NaN where depth is not estimated; z: of
    the point that is drawn, which of truth is its height. nis: NaN without a hit; nis_dof: its
    degrees of freedom, NaN where unknown.
    """

    track_id: IntArray = column('track_id', dtype=np.int64, default=0)
    track_state: IntArray = column('track_state', dtype=np.int64, default=1)
    target_id: IntArray = column('target_id', dtype=np.int64, default=NOBODY)
    state: FloatArray = column('px', 'py', 'vx?', 'vy?')
    covariance: FloatArray = covariance_of(*STATES)
    place: FloatArray = column('px', 'py', 'pz?')
    place_covariance: FloatArray = covariance_of('px', 'py', 'pz')
    z: FloatArray = column('z?')
    model_names: tuple[str, ...]
    probabilities: FloatArray = column('prob_*')
    nis: FloatArray = column('nis?')
    nis_dof: FloatArray = column('nis_dof?')

    def confirmed(self) -> Series:
        """Without the rows of tentative tracks."""
        return self.pick(self.track_state > 0)

    def hits(self) -> Series:
        """The rows that were updated by a measurement."""
        return self.pick(np.isfinite(self.nis) & (self.nis_dof > 0))

    def name(self, track_id: int, names: Mapping[str, str]) -> str:
        """Return what a track is called, by its target where `names` (by target ID) has it."""
        own = self.target_id[self.track_id == track_id]
        found = [names[key] for key in map(str, own[::-1].tolist()) if key in names]
        return f'{found[0]} (track {track_id})' if found else f'track {track_id}'

    def longest_track(self) -> int | None:
        """Id of the track with most rows (the lowest such id), None without rows."""
        ids, counts = np.unique(self.track_id, return_counts=True)
        return int(ids[np.argmax(counts)]) if len(ids) else None


def series_of(estimates: Iterable[Estimate]) -> Series:
    """The rows of `estimates` by stamp. Truth tables, which state no covariance and no model, work
    too.

    Raises ValueError when there is no column px or py, or when the models change from one estimate
    to another.
    """
    estimates = list(estimates)
    models = {estimate.model_names for estimate in estimates if len(estimate)}
    if len(models) > 1:
        raise ValueError('the models change within the recording: it holds more than one run')
    missing, names = "the estimates have no column '{}'", next(iter(models), ())
    series = read_rows(Series, estimates, missing, model_names=names)
    return evolve(series, scan_ns=np.unique(series.scan_ns))


@frozen(eq=False)
class TruthPath:
    """One true target: stamp_ns (n,) strictly increasing; state (n, 4), unknown velocity NaN;
    z (n,), None where it is not known: 0 throughout is a height that nobody filled in."""

    track_id: int
    stamp_ns: IntArray
    state: FloatArray
    z: FloatArray | None = None

    def at(self, stamp_ns: IntArray, *, max_gap: float) -> FloatArray:
        """(m, 4) state at `stamp_ns`; NaN outside the path and inside gaps over `max_gap` s."""
        wanted = np.asarray(stamp_ns, np.int64)
        after = np.searchsorted(self.stamp_ns, wanted, side='left')
        inside = after < len(self.stamp_ns)
        after = np.minimum(after, len(self.stamp_ns) - 1)
        exact = inside & (self.stamp_ns[after] == wanted)
        before = np.maximum(after - 1, 0)
        gap = self.stamp_ns[after] - self.stamp_ns[before]
        inside &= exact | ((after > 0) & (gap <= max_gap * SECOND))
        # Differences of int64 stamps first: a float64 of an absolute stamp is only good to 0.2 us.
        fraction = (wanted - self.stamp_ns[before]) / np.maximum(gap, 1)
        state = self.state[before] + fraction[:, None] * (self.state[after] - self.state[before])
        state[exact] = self.state[after[exact]]
        state[~inside] = np.nan
        return state


@frozen(eq=False)
class Truth:
    """All true targets of a recording."""

    paths: tuple[TruthPath, ...]
    max_gap: float = 60.0

    @classmethod
    def from_series(cls, series: Series, *, max_gap: float = 60.0) -> Truth:
        """Split a truth `series` by track id.

        Of several rows of one target with one stamp the last counts. Rows with a position that is
        not finite are left out.
        """
        good = series.pick(np.isfinite(series.state[:, :2]).all(axis=1))
        paths = (
            TruthPath(target, rows.stamp_ns, rows.state, rows.z if rows.z.any() else None)
            for target, rows in good.by_track()
        )
        return cls(tuple(paths), max_gap)

    def __len__(self) -> int:
        return len(self.paths)

    def shifted(self, lag: float) -> Truth:
        """The truth `lag` seconds earlier: estimates at t are compared with truth at t + lag."""
        shift = round(lag * SECOND)
        paths = (evolve(path, stamp_ns=path.stamp_ns - shift) for path in self.paths)
        return evolve(self, paths=tuple(paths))

    def at(self, stamp_ns: IntArray) -> FloatArray:
        """(paths, m, 4) states at `stamp_ns`, NaN where unknown."""
        empty = np.empty((0, len(stamp_ns), 4))
        return np.concatenate(
            [empty, *[path.at(stamp_ns, max_gap=self.max_gap)[None] for path in self.paths]]
        )

    def heights(self, stamp_ns: IntArray) -> FloatArray:
        """(paths, m) z at `stamp_ns`, NaN where unknown."""
        out = np.full((len(self.paths), len(stamp_ns)), np.nan)
        for row, path in zip(out, self.paths):
            if path.z is not None:
                upright = evolve(path, state=path.z[:, None].astype(np.float64))
                row[:] = upright.at(stamp_ns, max_gap=self.max_gap)[:, 0]
        return out


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
    present: BoolArray
    followed_by: IntArray
    scored: BoolArray

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
    one_to_one = len(truth) == 1 and len(np.unique(series.stamp_ns)) == len(series)
    limit = np.inf if one_to_one else cutoff
    starts, ends = series.spans(series.scan_ns)
    followed_by = np.full(present.shape, -1, np.int64)
    near: list[tuple[np.integer, ...]] = []
    beyond: list[tuple[np.integer, ...]] = []
    for scan in np.flatnonzero(known & (ends > starts)):
        there = np.flatnonzero(present[:, scan])
        offset = series.state[starts[scan] : ends[scan], None, :2] - states[None, there, scan, :2]
        distance = np.hypot(offset[..., 0], offset[..., 1])
        pairs = assign(distance, limit)
        for at, diver in pairs:
            near.append((starts[scan] + at, there[diver], scan))
            followed_by[there[diver], scan] = series.track_id[starts[scan] + at]
        if len(pairs) < min(distance.shape):
            rows = np.setdiff1d(np.arange(len(distance)), [at for at, _ in pairs])
            divers = np.setdiff1d(np.arange(len(there)), [diver for _, diver in pairs])
            beyond += [
                (starts[scan] + rows[at], there[divers[diver]], scan)
                for at, diver in assign(distance[np.ix_(rows, divers)], np.inf)
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


def track_summary(matching: Matching) -> dict[str, float]:
    """Counts that describe whole tracks.

    identity_switches: how often a target is taken over by another track id. fragmentations: how
    often a target is lost and found again. false_tracks: tracks that are on no target for most of
    their life. completeness: share of (target, stamp) pairs that were found.
    """
    series = matching.series
    found = matching.followed_by != -1
    wanted = int(matching.present.sum())
    scored_ids, lifetimes = np.unique(series.track_id[matching.scored], return_counts=True)
    on_target = series.track_id[matching.row]
    hits = np.array([np.count_nonzero(on_target == track_id) for track_id in scored_ids])
    begins = [
        np.diff(f[there].astype(np.int8), prepend=0) for f, there in zip(found, matching.present)
    ]
    return {
        'true_targets': int(matching.present.any(axis=1).sum()),
        'tracks': len(scored_ids),
        'false_tracks': int(np.count_nonzero(2 * hits < lifetimes)),
        'identity_switches': identity_switches(matching.followed_by.T),
        'fragmentations': sum(max(0, np.count_nonzero(each == 1) - 1) for each in begins),
        'completeness': float(found.sum() / wanted) if wanted else float('nan'),
        'false_rows_per_scan': float(
            (matching.scored.sum() - len(matching.row)) / max(1, len(matching.scan_ns))
        ),
    }
