"""From blocks of pressure, as they come, to records of cross-spectra.

Blocks may have any length; snapshots run on across them. Between blocks that do not meet the
snapshot that was being filled is given up, and what was averaged before goes on to count; after a
gap longer than a record, it does not.
"""

from __future__ import annotations

from collections import Counter
import math

import numpy as np
from numpy.typing import NDArray

from ...acoustics.spectra import Average, BlockAverage, SlidingAverage, SnapshotStream
from ...measurements import CrossSpectra, Pressure, Rejection
from .config import FathometerConfig


class PressureStream:
    """Collects `Pressure` into `CrossSpectra`: whole records, and previews from the sliding
    average."""

    def __init__(self, config: FathometerConfig, counts: Counter[str]):
        self.config = config
        self.counts = counts
        self._shape: tuple[int, float] | None = None
        self._next_ns = 0

    def push(self, block: Pressure) -> tuple[list[CrossSpectra], list[CrossSpectra]]:
        """Records and previews that `block` completes, each with the stamp of the block. Raises
        `Rejection` for one without a living hydrophone in common with the record."""
        self._follow(block)
        self._alive &= block.alive
        spectra = self._snapshots.push(block.pressure)
        records = [self._record(one, block) for one in self._blocks.push(spectra)]
        sliding = self._sliding.push(spectra) if self._sliding else []
        previews = [] if records else [self._record(one, block) for one in sliding[-1:]]
        if records:
            self._alive = block.alive.copy()
        return records, previews

    @property
    def waiting(self) -> int:
        """Snapshots that wait for the rest of their record."""
        return 0 if self._shape is None else self._blocks.waiting

    def _follow(self, block: Pressure) -> None:
        """Begin anew when the array is another one or time has leapt."""
        shape = block.hydrophones, block.sample_rate
        gap_ns = block.stamp_ns - self._next_ns
        if shape != self._shape:
            if self._shape is not None:
                self.counts['restarted_array'] += 1
            self._begin(block)
        elif 2 * abs(gap_ns) > block.duration_ns:
            self.counts['gaps'] += 1
            self._snapshots.restart()
            if abs(gap_ns) > self.config.record_seconds * 1e9:
                self.counts['records_abandoned'] += 1
                self._begin(block)
        self._next_ns = block.stamp_ns + block.duration_ns

    def _begin(self, block: Pressure) -> None:
        config, rate = self.config, block.sample_rate
        length = max(2, round(config.snapshot_seconds * rate))
        hop = max(1, round(length * (1.0 - config.overlap)))
        self._spacing = rate / length
        first = max(1, math.ceil(config.frequency_min / self._spacing - 1e-9))
        last = min(length // 2, math.floor(config.frequency_max / self._spacing + 1e-9))
        if last - first < 1:
            raise Rejection(
                'bad_band',
                f'{rate:g} samples a second in snapshots of {config.snapshot_seconds:g} s leave '
                'less than 2 frequencies in the band',
            )
        straddling = math.ceil(length / hop) - 1
        count = max(1, round(config.record_seconds * rate / hop) - straddling)
        self._frequency = self._spacing * np.arange(first, last + 1)
        self._snapshots = SnapshotStream(length, hop, slice(first, last + 1), config.window)
        self._blocks = BlockAverage(count, straddling)
        step = round(config.preview_seconds * rate / hop)
        self._sliding = SlidingAverage(count, min(step, count)) if step else None
        self._alive: NDArray[np.bool_] = np.ones(block.hydrophones, np.bool_)
        self._shape = block.hydrophones, rate

    def _record(self, average: Average, block: Pressure) -> CrossSpectra:
        csdm = average.csdm.copy()
        # A hydrophone that failed in any of the blocks is out for the whole record.
        csdm[:, ~self._alive] = 0.0
        csdm[:, :, ~self._alive] = 0.0
        return CrossSpectra(
            stamp_ns=block.stamp_ns,
            frame_id=block.frame_id,
            frequency=self._frequency,
            csdm=csdm,
            snapshots=average.snapshots,
            reference_depth=block.reference_depth,
        )
