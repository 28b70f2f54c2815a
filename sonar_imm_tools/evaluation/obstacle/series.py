# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacle estimates and truth as flat arrays, and which track is which obstacle.

Tracks and obstacles are matched ping by ping by their position in the image of the sonar, range
and bearing projected to a plane. The height, which is to be judged, plays no part in the matching.
"""

from __future__ import annotations

from collections.abc import Iterable

from attrs import frozen
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray
from sonar_imm.estimation.consistency import gospa
from sonar_imm.trackers.obstacle.config import BEHAVIOURS

from ... import SECOND
from ..columns import column, covariance_of, read_rows, Rows

STATES = ('range', 'bearing', 'vertical_offset')
PINGS_TO_SEE = 6
"""Pings in the beam after which an obstacle should be tracked."""
PASSED = 0.2
"""Cosine to the axis of the sonar below which an obstacle counts as passed."""

_VELOCITY = ('vx?', 'vy?')
_DOES = tuple(f'prob_{name}?' for name in BEHAVIOURS)


@frozen(eq=False, kw_only=True)
class Series(Rows):
    """Rows of confirmed tracks; state: in the order of `STATES`; place: metres east and north;
    height: metres up; low, high: the 90 % band of the offset; above: its probability; nis: NaN
    without a hit; velocity: m/s; does: the probability of each of `BEHAVIOURS`; risk: the
    probability of a collision. height and the last four are NaN where a run does not state
    them."""

    track_id: IntArray = column('track_id', dtype=np.int64)
    track_state: IntArray = column('track_state', dtype=np.int64)
    state: FloatArray = column(*STATES)
    place: FloatArray = column('x', 'y')
    height: FloatArray = column('pz?')
    covariance: FloatArray = covariance_of(*STATES)
    low: FloatArray = column('vertical_offset_lo')
    high: FloatArray = column('vertical_offset_hi')
    above: FloatArray = column('prob_above')
    nis: FloatArray = column('nis')
    velocity: FloatArray = column(*_VELOCITY)
    velocity_covariance: FloatArray = covariance_of('x', 'y', prefix='vel_cov')
    does: FloatArray = column(*_DOES)
    risk: FloatArray = column('collision_probability?')

    def longest_track(self) -> int | None:
        """Id of the track with most hits, None without rows."""
        ids, counts = np.unique(self.track_id[np.isfinite(self.nis)], return_counts=True)
        return int(ids[np.argmax(counts)]) if len(ids) else None


@frozen(eq=False, kw_only=True)
class _TrueRows(Rows):
    track_id: IntArray = column('track_id', dtype=np.int64, default=1)
    state: FloatArray = column(*STATES)
    in_beam: FloatArray = column('in_beam', default=1)
    velocity: FloatArray = column(*_VELOCITY)
    does: FloatArray = column(*_DOES)


@frozen(eq=False)
class TruePath:
    """True states of one obstacle: stamp_ns (n,); seen (n, 3) in the order of `STATES`; in_beam
    (n,); velocity (n, 2) m/s and does (n,), which of `BEHAVIOURS`, both None where they are
    not known."""

    track_id: int
    stamp_ns: IntArray
    seen: FloatArray
    in_beam: BoolArray
    velocity: FloatArray | None = None
    does: IntArray | None = None

    def at(self, stamp_ns: IntArray, gap: float) -> FloatArray:
        """(m, 3) at other stamps; NaN outside the path and in gaps over `gap` seconds."""
        after = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self.stamp_ns) - 1)
        start, end = self.stamp_ns[after - 1], self.stamp_ns[after]
        fraction = (stamp_ns - start) / np.maximum(end - start, 1)
        known = (fraction >= 0.0) & (fraction <= 1.0) & (end - start <= gap * SECOND)
        before = self.seen[after - 1]
        between = before + fraction[:, None] * (self.seen[after] - before)
        return np.where(known[:, None], between, np.nan)

    def there(self, stamp_ns: IntArray, gap: float) -> BoolArray:
        """True (m,) where it should be tracked: in the beam for a while and not passed yet."""
        last = np.searchsorted(self.stamp_ns, stamp_ns, side='right') - 1
        seen = np.cumsum(self.in_beam)[np.maximum(last, 0)]
        distance, bearing, offset = self.at(stamp_ns, gap).T
        level = np.sqrt(np.maximum(distance**2 - offset**2, 0.0))
        with np.errstate(invalid='ignore'):
            return (seen >= PINGS_TO_SEE) & (level * np.cos(bearing) > PASSED * distance)


@frozen(eq=False)
class Matching:
    """Pairs of estimate rows and obstacles: row (m,) of the series, target (m,) the index of the
    obstacle, truth (m, 3) its state; gospa (pings, 4): distance, localisation, missed, false."""

    series: Series
    row: IntArray
    target: IntArray
    truth: FloatArray
    gospa: FloatArray

    @property
    def error(self) -> FloatArray:
        """(m, 3) estimate minus truth."""
        difference = self.series.state[self.row] - self.truth
        difference[:, 1] = wrap_angle(difference[:, 1])
        return difference


def series_of(estimates: Iterable[Estimate]) -> Series:
    """The confirmed rows. Raises ValueError for estimates of another system."""
    missing = "the estimates are not those of obstacles: there is no column '{}'"
    series = read_rows(Series, estimates, missing)
    return series.pick(series.track_state > 0)


def truth_of(tables: Iterable[Estimate], lag: float = 0.0) -> tuple[TruePath, ...]:
    """Truth by obstacle, shifted to `lag` seconds earlier. Raises ValueError for other tables."""
    rows = read_rows(_TrueRows, tables, "the truth has no column '{}'")
    rows = rows.pick(np.isfinite(rows.state).all(axis=1))
    paths = []
    for track_id, own in rows.by_track():
        if len(own) < 2:
            continue
        paths.append(
            TruePath(
                track_id,
                own.stamp_ns - round(lag * SECOND),
                own.state,
                own.in_beam > 0,
                own.velocity if np.isfinite(own.velocity).all() else None,
                np.argmax(own.does, axis=1) if np.isfinite(own.does).all() else None,
            )
        )
    return tuple(paths)


def match(series: Series, truth: tuple[TruePath, ...], *, cutoff: float, gap: float) -> Matching:
    """Match tracks to obstacles at every ping for which the truth is known."""
    pings = series.scan_ns
    seen = np.array([path.at(pings, gap) for path in truth]).reshape(len(truth), len(pings), 3)
    there = np.array([path.there(pings, gap) for path in truth], bool)
    there = there.reshape(len(truth), len(pings))
    points, flat = level(series.state), level(seen)
    rows, targets, scores = [], [], []
    for ping, (start, end) in enumerate(zip(*series.spans(pings))):
        if not np.isfinite(seen[:, ping]).any():
            continue
        who = np.flatnonzero(there[:, ping])
        found = gospa(flat[who, ping], points[start:end], cutoff)
        scores.append([found.distance, found.localisation, found.missed, found.false])
        hit = found.estimate_of >= 0
        rows += (start + found.estimate_of[hit]).tolist()
        targets += who[hit].tolist()
    row, target = np.array(rows, np.int64), np.array(targets, np.int64)
    at = np.searchsorted(pings, series.stamp_ns[row])
    true = seen[target, at].reshape(-1, 3)
    return Matching(series, row, target, true, np.reshape(scores, (-1, 4)))


def level(seen: FloatArray) -> FloatArray:
    """(..., 2) metres ahead and to port of states (..., 3), as if the vertical offset were 0."""
    distance, bearing = seen[..., 0], seen[..., 1]
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)
