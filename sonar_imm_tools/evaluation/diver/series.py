# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimates of divers as flat arrays, and truth at their stamps.

Truth has its own rate (GPS once per second, a simulation at each step). Between two points
position and velocity are interpolated linearly. Beyond the ends, and in gaps longer than a limit,
truth is unknown and nothing is scored.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from attrs import evolve, frozen
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray
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
        """Return what a track is called: by the name of its target, if it has one. names: of
        targets by target ID."""
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
    series = read_rows(
        Series, estimates, "the estimates have no column '{}'", model_names=next(iter(models), ())
    )
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
        """The truth shifted by `lag` seconds: estimates at t are compared with truth at t +
        lag."""
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
