# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From blocks of pressure, as they come, to records of cross-spectra; and how deep the array was.

Blocks may have any length; snapshots run on across them. Between blocks that do not meet the
snapshot that was being filled is given up, and what was averaged before goes on to count; after a
gap longer than a record, it does not.

Where the length of a snapshot is not given, it follows from the deepest depth that is tracked and
from how many snapshots the array needs (`automatic_snapshot`).

The depth of the array comes with the blocks, or from a companion instrument (`CompanionDepths`);
where it was, from another one (`CompanionPlaces`). `Pace` counts what passes between records.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import Counter
import math
from typing import Annotated, ClassVar, NamedTuple

from attrs import define, field, frozen
import numpy as np

from ...acoustics.geodesy import Origin
from ...acoustics.spectra import (
    Average,
    BlockAverage,
    effective_snapshots,
    SlidingAverage,
    SnapshotStream,
)
from ...estimation.arrays import BoolArray, FloatArray
from ...measurements import ArrayDepth, CrossSpectra, GeodeticFix, Pressure, Rejection
from ...measurements.fathometer import MAX_FREQUENCIES
from .config import FathometerConfig

LEAST_REACH, MOST_REACH = 10.0, 12_000.0
"""m below the array for which automatic snapshots are made, whatever depths are tracked."""
MAX_BYTES = 1 << 30
"""Of what waits for the end of a record: samples, cross-spectra, snapshots of the preview."""
_SAMPLES_AT_ONCE = 1 << 24
_MOST_WAYS, _LEAST_WAYS, _SNAPSHOTS_PER_PHONE = 7.0, 5.0, 2.5
MOST_HEAVE = 0.05
"""Standard deviation of the depth within a record, m, above which it is said: a sinusoid of so
much leaves 0.62 of an echo in 50 Hz to 4 kHz (the mean of J0(2 k A), A its amplitude)."""
_KEPT, _INTERVALS = 10_000, 15
"""Depths and places of companions that are kept, and intervals that the usual one is told by."""


class Collected(NamedTuple):
    """Cross-spectra of a record; snapshots: how many independent ones they are worth; seconds:
    length of a snapshot of pressure; depth_std: how much the depth that came with the blocks
    varied, m, 0 when none did."""

    spectra: CrossSpectra
    snapshots: float
    seconds: float = 0.0
    depth_std: float = 0.0


@define(eq=False)
class BlockDepths:
    """Mean and standard deviation of the depths that come with blocks, each counted as often as it
    has samples. STATE: see `trackers.Tracker`."""

    STATE: ClassVar = ('_stated', '_first', '_sums')

    _stated: bool = field(init=False, default=True)
    _first: float = field(init=False, default=0.0)
    _sums: Annotated[FloatArray, '3'] = field(init=False, factory=lambda: np.zeros(3))

    def add(self, depth: float | None, samples: int) -> None:
        self._stated &= depth is not None
        if depth is not None:
            if not self._sums[0]:
                self._first = depth
            away = depth - self._first
            self._sums += samples * np.array([1.0, away, away * away])

    @property
    def mean(self) -> float | None:
        """None when a block came without."""
        if not self._stated or not self._sums[0]:
            return None
        return self._first + float(self._sums[1] / self._sums[0])

    @property
    def std(self) -> float:
        if not self._sums[0]:
            return 0.0
        _, mean, square = self._sums / self._sums[0]
        return math.sqrt(max(0.0, square - mean * mean))


def automatic_snapshot(config: FathometerConfig, hydrophones: int, reach: float) -> float:
    """Length of a snapshot, s, to hear what lies `reach` m below hydrophone 0: seven times the way
    there and back; when that leaves fewer than 2.5 snapshots for each hydrophone, as much shorter
    as it takes, but not less than five times. Shorter ones bend the pulse, longer ones leave
    cross-spectra of too few."""
    way = 2.0 * min(max(reach, LEAST_REACH), MOST_REACH) / config.sound_speed
    share = 1.0 - config.overlap
    wanted = _SNAPSHOTS_PER_PHONE * hydrophones
    wanted *= 1000 / effective_snapshots(config.window, config.overlap, 1000)
    enough = config.record_seconds / (share * wanted + config.overlap)
    seconds = min(max(enough, _LEAST_WAYS * way), _MOST_WAYS * way)
    return min(seconds, config.record_seconds)


class Beginning(NamedTuple):
    """What the length and the number of snapshots follow from, beside the parameters; rate: of
    samples, Hz; reach: as of `PressureStream.push`."""

    hydrophones: int
    rate: float
    reach: float


@define(eq=False)
class PressureStream:
    """Collects `Pressure` into `CrossSpectra`: whole records, and previews from the sliding
    average. STATE: see `trackers.Tracker`. Setting `_begun` makes the streams that follow from it.
    """

    STATE: ClassVar = (
        '_begun',
        '_next_ns',
        '_alive',
        '_depths',
        '_snapshots',
        '_blocks',
        '_sliding',
    )

    config: FathometerConfig
    counts: Counter[str]
    _begun: Beginning | None = field(
        init=False, default=None, on_setattr=lambda stream, _, begun: stream._begin(begun)
    )
    _next_ns: int = field(init=False, default=0)
    _alive: Annotated[BoolArray, 'M'] = field(init=False, factory=lambda: np.ones(0, np.bool_))
    _depths: BlockDepths = field(init=False, factory=BlockDepths)
    _snapshots: SnapshotStream | None = field(init=False, default=None)
    _blocks: BlockAverage | None = field(init=False, default=None)
    _sliding: SlidingAverage | None = field(init=False, default=None)

    def push(self, block: Pressure, reach: float) -> tuple[list[Collected], list[Collected]]:
        """Records and previews that `block` completes, each with the stamp of the block. reach: m
        from hydrophone 0 to the deepest depth that is tracked. Raises `Rejection` for a block
        without a living hydrophone in common with the record, and for one that would take too much
        memory."""
        self._follow(block, reach)
        assert self._snapshots is not None and self._blocks is not None
        self._alive &= block.alive
        self._depths.add(block.reference_depth, len(block))
        records: list[Collected] = []
        previews: list[Collected] = []
        size = max(self._snapshots.length, _SAMPLES_AT_ONCE // block.hydrophones)
        for first in range(0, len(block), size):
            spectra = self._snapshots.push(block.pressure[first : first + size])
            records += [self._record(average, block) for average in self._blocks.push(spectra)]
            sliding = self._sliding.push(spectra) if self._sliding else []
            previews = [self._record(average, block) for average in sliding[-1:]] or previews
        if records:
            self._alive = block.alive.copy()
            self._depths = BlockDepths()
        return records, [] if records else previews

    @property
    def waiting(self) -> int:
        """Snapshots that wait for the rest of their record."""
        return 0 if self._blocks is None else self._blocks.waiting

    def _follow(self, block: Pressure, reach: float) -> None:
        """Begin anew when the array is another one or time has leapt."""
        now, known = Beginning(block.hydrophones, block.sample_rate, reach), self._begun
        gap_ns = block.stamp_ns - self._next_ns
        if known is None or known[:2] != now[:2]:
            self._begun = now
            self.counts['restarted_array'] += known is not None
        elif 2 * abs(gap_ns) > block.duration_ns:
            self.counts['gaps'] += 1
            if self._snapshots is not None:
                self._snapshots.restart()
            if abs(gap_ns) > self.config.record_seconds * 1e9:
                self.counts['records_abandoned'] += 1
                self._begun = now
        self._next_ns = block.stamp_ns + block.duration_ns

    def _begin(self, begun: Beginning | None) -> Beginning | None:
        """Make the streams that follow from `begun`. An array that is refused leaves the one
        before as it was."""
        if begun is None:
            return None
        config, (phones, rate, reach) = self.config, begun
        seconds = config.snapshot_seconds or automatic_snapshot(config, phones, reach)
        length = max(2, round(seconds * rate))
        hop = max(1, round(length * (1.0 - config.overlap)))
        if not config.snapshot_seconds:
            # A whole number of them to a record, so that it ends where the pressure does.
            samples = config.record_seconds * rate
            hop = max(1, math.floor(samples / math.ceil(samples / hop - 1e-9) + 1e-9))
            length = max(2, round(hop / (1.0 - config.overlap)))
        spacing = rate / length
        first = max(1, math.ceil(config.frequency_min / spacing - 1e-9))
        last = min(length // 2, math.floor(config.frequency_max / spacing + 1e-9))
        if last - first < 1:
            raise Rejection(
                'bad_band',
                f'{rate:g} samples a second in snapshots of {seconds:g} s leave '
                'less than 2 frequencies in the band',
            )
        straddling = math.ceil(length / hop) - 1
        count = max(1, round(config.record_seconds * rate / hop) - straddling)
        step = round(config.preview_seconds * rate / hop)
        self._check_memory(phones, length, last - first + 1, count if step else 0)
        self._snapshots = SnapshotStream(length, hop, slice(first, last + 1), config.window)
        self._blocks = BlockAverage(count, straddling)
        self._sliding = SlidingAverage(count, min(step, count)) if step else None
        self._alive = np.ones(phones, np.bool_)
        self._depths = BlockDepths()
        return begun

    def _check_memory(self, phones: int, length: int, rows: int, kept: int) -> None:
        needed = 4 * length * phones + 8 * rows * phones * (phones + kept)
        if needed > MAX_BYTES or rows > MAX_FREQUENCIES:
            raise Rejection(
                'too_large',
                f'{phones} hydrophones in snapshots of {length} samples with {rows} frequencies '
                f'need {needed / 2**20:.0f} MiB; {MAX_BYTES >> 20} MiB and {MAX_FREQUENCIES} '
                'frequencies at most: use shorter snapshots or a narrower band',
            )

    def _record(self, average: Average, block: Pressure) -> Collected:
        assert self._begun is not None and self._snapshots is not None
        spacing, rows = self._begun.rate / self._snapshots.length, self._snapshots.rows
        csdm = average.csdm.copy()
        # A hydrophone that failed in any of the blocks is out for the whole record.
        csdm[:, ~self._alive] = 0.0
        csdm[:, :, ~self._alive] = 0.0
        spectra = CrossSpectra(
            stamp_ns=block.stamp_ns,
            frame_id=block.frame_id,
            frequency=spacing * np.arange(rows.start, rows.stop),
            csdm=csdm,
            snapshots=average.snapshots,
            reference_depth=self._depths.mean,
        )
        config = self.config
        worth = effective_snapshots(config.window, config.overlap, average.snapshots)
        return Collected(spectra, worth, 1.0 / spacing, self._depths.std)


@define(eq=False)
class CompanionDepths:
    """The newest depths of the array, as a companion instrument has them, by stamp. STATE: see
    `trackers.Tracker`."""

    STATE: ClassVar = ('_depths',)

    _depths: list[tuple[int, float]] = field(init=False, factory=list)

    def add(self, depth: ArrayDepth) -> None:
        insort(self._depths, (depth.stamp_ns, depth.depth))
        del self._depths[:-_KEPT]

    def over(self, stamp_ns: int, span_ns: int, config: FathometerConfig) -> float | None:
        """The mean depth, m, over `span_ns` before the stamp; else `nearest`."""
        within = self._within(stamp_ns, span_ns)
        return float(np.mean(within)) if within else self.nearest(stamp_ns, config)

    def nearest(self, stamp_ns: int, config: FathometerConfig) -> float | None:
        """The depth, m, nearest in time; None when there is none that is recent enough."""
        place = bisect_right(self._depths, (stamp_ns, np.inf))
        near = self._depths[max(0, place - 1) : place + 1]
        if near:
            stamp, depth = min(near, key=lambda entry: abs(entry[0] - stamp_ns))
            if abs(stamp - stamp_ns) <= config.array_depth_age * 1e9:
                return depth
        return None

    def spread(self, stamp_ns: int, span_ns: int) -> float:
        """Standard deviation of the depth over `span_ns` before the stamp, m; 0 of nothing."""
        within = self._within(stamp_ns, span_ns)
        return float(np.std(within)) if within else 0.0

    def _within(self, stamp_ns: int, span_ns: int) -> list[float]:
        low = bisect_left(self._depths, (stamp_ns - span_ns, -np.inf))
        high = bisect_right(self._depths, (stamp_ns, np.inf))
        return [depth for _, depth in self._depths[low:high]]


@define(eq=False)
class CompanionPlaces:
    """Latitudes and longitudes of the array, degrees, by stamp, as a companion has them. STATE:
    see `trackers.Tracker`."""

    STATE: ClassVar = ('_fixes',)

    _fixes: list[tuple[int, float, float]] = field(init=False, factory=list)

    def add(self, fix: GeodeticFix) -> None:
        insort(self._fixes, (fix.stamp_ns, fix.latitude, fix.longitude))
        del self._fixes[:-_KEPT]

    def at(self, stamp_ns: int, config: FathometerConfig) -> Origin | None:
        """The place at a stamp, between the fixes before and behind it or at the only one; None
        where there is none that is recent enough."""
        row = bisect_right(self._fixes, (stamp_ns, np.inf, np.inf))
        near = [
            fix
            for fix in self._fixes[max(0, row - 1) : row + 1]
            if abs(fix[0] - stamp_ns) <= config.array_depth_age * 1e9
        ]
        if not near:
            return None
        (before, south, west), (after, north, east) = near[0], near[-1]
        share = (stamp_ns - before) / (after - before) if after > before else 0.0
        # Across the date line the longitude goes on.
        turn = (east - west + 180.0) % 360.0 - 180.0
        return Origin(south + share * (north - south), west + share * turn)


@frozen
class Pace:
    """How many records' time, or way, passes from record to record: whole numbers, so that stamps
    may be off by half an interval and change nothing. A value: `after` makes a new one.

    newest_ns: stamp of the newest record; place: where it was made, if known; intervals: the first
    ones, ns, whose median is that of the tracker where none is configured. While there are two,
    the longer one counts: no gap is seen where there is none."""

    newest_ns: int | None = None
    intervals: tuple[int, ...] = ()
    place: Origin | None = None

    def after(self, stamp_ns: int, place: Origin | None = None) -> Pace:
        if self.newest_ns is None or len(self.intervals) == _INTERVALS:
            return Pace(stamp_ns, self.intervals, place)
        return Pace(stamp_ns, (*self.intervals, stamp_ns - self.newest_ns), place)

    def records(self, stamp_ns: int, config: FathometerConfig, place: Origin | None = None) -> int:
        """How many from the newest one to that of `stamp_ns`, 1 at least."""
        if self.newest_ns is None:
            return 1
        if config.record_distance and place is not None and self.place is not None:
            way = math.hypot(*self.place.local(place.latitude, place.longitude)[:2])
            return max(1, round(way / config.record_distance))
        intervals = sorted(self.after(stamp_ns).intervals)
        interval = config.record_interval * 1e9 or intervals[len(intervals) // 2]
        return max(1, round((stamp_ns - self.newest_ns) / max(interval, 1)))
