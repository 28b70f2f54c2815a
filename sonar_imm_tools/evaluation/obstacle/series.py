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

"""Obstacle estimates and truth as flat arrays, and which track is which obstacle.

Tracks and obstacles are matched ping by ping by their position in the image of the sonar, range
and bearing projected to a plane. The height, which is to be judged, plays no part in the matching.
"""

from __future__ import annotations

from collections.abc import Iterable

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.estimation.arrays import FloatArray, IntArray
from sonar_imm.estimation.consistency import gospa
from sonar_imm.trackers.obstacle.config import BEHAVIOURS

from ... import SECOND

STATES = ('range', 'bearing', 'vertical_offset')
PINGS_TO_SEE = 6
"""Pings in the beam after which an obstacle should be tracked."""
PASSED = 0.2
"""Cosine to the axis of the sonar below which an obstacle counts as passed."""


@frozen(eq=False, kw_only=True)
class Series:
    """Rows of confirmed tracks, sorted by stamp: stamp_ns, track_id (n,); state (n, 3) in the
    order of `STATES`; covariance (n, 3, 3); low, high: the 90 % band of the offset (n,); above:
    its probability (n,); nis (n,), NaN without a hit; velocity (n, 2) m/s with velocity_covariance
    (n, 2, 2); does (n, 4): the probability of each of `BEHAVIOURS`; risk (n,): the probability of
    a collision; these are NaN where a run does not tell them. ping_ns: all pings."""

    ping_ns: IntArray
    stamp_ns: IntArray
    track_id: IntArray
    state: FloatArray
    covariance: FloatArray
    low: FloatArray
    high: FloatArray
    above: FloatArray
    nis: FloatArray
    velocity: FloatArray
    velocity_covariance: FloatArray
    does: FloatArray
    risk: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def pick(self, rows: NDArray) -> Series:
        """Some of the rows; `ping_ns` is kept."""
        return Series(ping_ns=self.ping_ns, **{name: getattr(self, name)[rows] for name in _ROWS})

    def longest_track(self) -> int | None:
        """Id of the track with most hits, None without rows."""
        ids, counts = np.unique(self.track_id[np.isfinite(self.nis)], return_counts=True)
        return int(ids[np.argmax(counts)]) if len(ids) else None


_ROWS = (
    'stamp_ns', 'track_id', 'state', 'covariance', 'low', 'high', 'above', 'nis', 'velocity',
    'velocity_covariance', 'does', 'risk',
)  # fmt: skip


@frozen(eq=False)
class TruePath:
    """True states of one obstacle: stamp_ns (n,); seen (n, 3) in the order of `STATES`; in_beam
    (n,); velocity (n, 2) m/s and does (n,), which of `BEHAVIOURS`, both None where it is not
    told."""

    track_id: int
    stamp_ns: IntArray
    seen: FloatArray
    in_beam: NDArray[np.bool_]
    velocity: FloatArray | None = None
    does: IntArray | None = None

    def at(self, stamp_ns: IntArray, gap: float) -> FloatArray:
        """(m, 3) at other stamps; NaN outside the path and in gaps over `gap` seconds."""
        after = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self.stamp_ns) - 1)
        start, end = self.stamp_ns[after - 1], self.stamp_ns[after]
        fraction = (stamp_ns - start) / np.maximum(end - start, 1)
        known = (fraction >= 0.0) & (fraction <= 1.0) & (end - start <= gap * SECOND)
        between = self.seen[after - 1] + fraction[:, None] * (
            self.seen[after] - self.seen[after - 1]
        )
        return np.where(known[:, None], between, np.nan)

    def there(self, stamp_ns: IntArray, gap: float) -> NDArray[np.bool_]:
        """True (m,) where it should be tracked: in the beam for a while and not passed yet."""
        seen = np.cumsum(self.in_beam)[
            np.clip(
                np.searchsorted(self.stamp_ns, stamp_ns, side='right') - 1,
                0,
                len(self.stamp_ns) - 1,
            )
        ]
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
    """Concatenate the confirmed rows. Raises ValueError for estimates of another system."""
    ordered = sorted(estimates, key=lambda one: one.stamp_ns)
    filled = [one for one in ordered if len(one)]
    if any(one.state_names != STATES for one in filled):
        raise ValueError('the estimates are not those of obstacles')

    def stack(parts: list[NDArray], tail: tuple[int, ...] = ()) -> NDArray:
        return np.concatenate([np.empty((0, *tail)), *parts])

    def extra(name: str) -> FloatArray:
        return stack([np.asarray(one.extras[name], float) for one in filled])

    columns = [one.columns() for one in filled]

    def told(name: str) -> FloatArray:
        if all(name in each for each in columns):
            return stack([np.asarray(each[name], float) for each in columns])
        return np.full(sum(map(len, filled)), np.nan)

    spread = [told(f'vel_cov_{axes}') for axes in ('x_x', 'x_y', 'x_y', 'y_y')]
    full = Series(
        ping_ns=np.array([one.stamp_ns for one in ordered], np.int64),
        stamp_ns=np.repeat(
            np.array([one.stamp_ns for one in filled], np.int64), [len(one) for one in filled]
        ),
        track_id=extra('track_id').astype(np.int64),
        state=stack([one.state for one in filled], (3,)),
        covariance=stack([one.covariance for one in filled], (3, 3)),
        low=extra('vertical_offset_lo'),
        high=extra('vertical_offset_hi'),
        above=stack([one.probabilities[:, one.model_names.index('above')] for one in filled]),
        nis=extra('nis'),
        velocity=np.stack([told('vx'), told('vy')], axis=-1),
        velocity_covariance=np.stack(spread, axis=-1).reshape(-1, 2, 2),
        does=np.stack([told(f'prob_{name}') for name in BEHAVIOURS], axis=-1),
        risk=told('collision_probability'),
    )
    return full.pick(extra('track_state') > 0)


def truth_of(tables: Iterable[Estimate], lag: float = 0.0) -> tuple[TruePath, ...]:
    """Truth by obstacle, shifted to `lag` seconds earlier. Raises ValueError for other tables."""
    rows: dict[int, list[tuple[int, ...]]] = {}
    for table in tables:
        if missing := [name for name in STATES if name not in table.extras]:
            raise ValueError(f"the truth has no column '{missing[0]}'")
        columns = [np.asarray(table.extras[name], float) for name in STATES]
        columns.append(np.asarray(table.extras.get('in_beam', np.ones(len(table.xyz))), float))
        unknown, told = np.full(len(table.xyz), np.nan), table.columns()
        for name in ('vx', 'vy', *(f'prob_{name}' for name in BEHAVIOURS)):
            columns.append(np.asarray(told.get(name, unknown), float))
        ids = np.asarray(table.extras.get('track_id', np.ones(len(table.xyz))), int)
        for number, values in zip(ids, zip(*columns)):
            rows.setdefault(int(number), []).append((table.stamp_ns, *map(float, values)))
    paths = []
    for number, told in sorted(rows.items()):
        by_stamp = {one[0]: one[1:] for one in told if np.isfinite(one[1:4]).all()}
        if len(by_stamp) < 2:
            continue
        stamps = np.array(sorted(by_stamp), np.int64)
        values = np.array([by_stamp[stamp] for stamp in stamps.tolist()])
        velocity, does = values[:, 4:6], values[:, 6:]
        paths.append(
            TruePath(
                number,
                stamps - round(lag * SECOND),
                values[:, :3],
                values[:, 3] > 0,
                velocity if np.isfinite(velocity).all() else None,
                np.argmax(does, axis=1) if np.isfinite(does).all() else None,
            )
        )
    return tuple(paths)


def match(series: Series, truth: tuple[TruePath, ...], *, cutoff: float, gap: float) -> Matching:
    """Match tracks to obstacles at every ping for which the truth is known."""
    pings = series.ping_ns
    seen = np.array([path.at(pings, gap) for path in truth]).reshape(len(truth), len(pings), 3)
    there = np.array([path.there(pings, gap) for path in truth], bool)
    there = there.reshape(len(truth), len(pings))
    points, flat = level(series.state), level(seen)
    starts = np.searchsorted(series.stamp_ns, pings, side='left')
    ends = np.searchsorted(series.stamp_ns, pings, side='right')
    rows, targets, scores = [], [], []
    for ping, (start, end) in enumerate(zip(starts, ends)):
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
    return Matching(
        series, row, target, seen[target, at].reshape(-1, 3), np.reshape(scores, (-1, 4))
    )


def level(seen: FloatArray) -> FloatArray:
    """(..., 2) metres ahead and to port of states (..., 3), as if the vertical offset were 0."""
    distance, bearing = seen[..., 0], seen[..., 1]
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)
