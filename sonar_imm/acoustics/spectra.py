# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Cross-spectral density matrices from the pressure at many hydrophones, as it streams in.

Pressure arrives in blocks of any length. It is cut into snapshots of `length` samples that overlap
by half or another share; each is weighted by a window and Fourier transformed, exp(-i w t), and
the outer products of the snapshots at each frequency are averaged::

    snapshots = SnapshotStream(...)      # pressure -> spectra (k, F, M)
    average = BlockAverage(count)        # spectra -> R (F, M, M) once `count` are in, then anew
    average = SlidingAverage(count, step)  # the same over the last `count`, every `step`

R_ij = <p_i conj(p_j)>. The average of one batch is one matrix product per frequency, which costs a
tenth of as many outer products.
"""

from __future__ import annotations

from collections import deque
from functools import lru_cache
from typing import Annotated, ClassVar, NamedTuple

from attrs import define, field
import numpy as np
from numpy.typing import NDArray

from ..estimation.arrays import FloatArray

ComplexArray = NDArray[np.complexfloating]

WINDOWS = ('hann', 'rectangular')


def window_of(name: str, length: int) -> FloatArray:
    """Window (length,) of unit mean square: 'hann' (periodic) or 'rectangular'."""
    if name == 'rectangular':
        return np.ones(length)
    if name != 'hann':
        raise ValueError(f'a window is one of {WINDOWS}, not {name!r}')
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    return window / np.sqrt(np.mean(np.square(window)))


def window_overlap(name: str, share: FloatArray | float) -> FloatArray:
    """What is left of the correlation of two signals that lie `share` of a window apart, 0 .. 1:
    the autocorrelation of the window, one at 0. ``1 - share`` for the rectangular one."""
    x = np.clip(np.abs(np.asarray(share, np.float64)), 0.0, 1.0)
    if name == 'rectangular':
        return 1.0 - x
    return (1.0 - x) * (2.0 + np.cos(2.0 * np.pi * x)) / 3.0 + np.sin(2.0 * np.pi * x) / (
        2.0 * np.pi
    )


def effective_snapshots(window: str, overlap: float, count: int) -> float:
    """How many independent snapshots say as much as `count` that overlap: Hann and half an
    overlap leave 0.95 of them."""
    k = np.arange(1.0, max(1, min(count, int(1.0 / (1.0 - overlap)) + 2)))
    common = np.square(window_overlap(window, np.asarray(k * (1.0 - overlap), np.float64)))
    return count / (1.0 + 2.0 * float(np.sum((1.0 - k / count) * common)))


def noise_taper(window: str, overlap: float, share: FloatArray) -> FloatArray:
    """Standard deviation (...,) of the correlation of two unrelated white noises at lags of
    `share` (...,) of a snapshot, one at lag 0, where many snapshots that overlap are averaged.

    Averaged cross-spectra correlate each snapshot with itself round a circle. What snapshots k
    hops apart have in common is ``v_k(t) = w(t) w(t - k hop)``, so that the variance at a lag is
    the sum over all k of the circular autocorrelation of v_k there.
    """
    table = _noise_variance(window, overlap)
    lag = (np.abs(np.asarray(share, np.float64)) % 1.0) * len(table)
    return np.sqrt(np.interp(lag, np.arange(len(table) + 1), np.append(table, table[0])))


@lru_cache(maxsize=8)
def _noise_variance(window: str, overlap: float, length: int = 1024) -> FloatArray:
    w, hop = window_of(window, length), max(1, round(length * (1.0 - overlap)))
    total = np.zeros(length)
    for delay in range(0, length, hop):
        v = np.zeros(length)
        v[delay:] = w[delay:] * w[: length - delay]
        common = np.fft.irfft(np.square(np.abs(np.fft.rfft(v))), length)
        total += common if delay == 0 else 2.0 * common
    return total / total[0]


@define(eq=False)
class SnapshotStream:
    """Cuts pressure into windowed snapshots and transforms them.

    length: samples of a snapshot; hop: samples from one to the next; rows: which bins of the
    transform are kept, a slice. STATE: see `trackers.Tracker`.
    """

    STATE: ClassVar = ('_left',)

    length: int
    hop: int
    rows: slice
    window: str = 'hann'
    _column: NDArray[np.float32] = field(init=False)
    _left: Annotated[NDArray[np.float32], 'nM'] | None = field(init=False, default=None)

    def __attrs_post_init__(self) -> None:
        if not 0 < self.hop <= self.length:
            raise ValueError('snapshots need 0 < hop <= length')
        self._column = window_of(self.window, self.length).astype(np.float32)[:, None]

    def push(self, pressure: NDArray) -> ComplexArray:
        """Spectra (k, F, M) complex64 of the snapshots that `pressure` (n, M) completes; k may be
        0. ValueError when the number of hydrophones changes; call `restart` then, and after a
        gap."""
        block = np.asarray(pressure, np.float32)
        if self._left is not None:
            if self._left.shape[1] != block.shape[1]:
                raise ValueError('the number of hydrophones changed')
            block = np.concatenate([self._left, block])
        count = max(0, (len(block) - self.length) // self.hop + 1)
        self._left = block[count * self.hop :].copy()
        spectra = [self._transform(block[k * self.hop :][: self.length]) for k in range(count)]
        bins = len(range(*self.rows.indices(self.length // 2 + 1)))
        empty = np.empty((0, bins, block.shape[1]), np.complex64)
        return np.stack(spectra) if spectra else empty

    def restart(self) -> None:
        """Forget the samples that wait for the rest of their snapshot."""
        self._left = None

    @property
    def waiting(self) -> int:
        """Samples that wait for the rest of their snapshot."""
        return 0 if self._left is None else len(self._left)

    def _transform(self, snapshot: NDArray[np.float32]) -> ComplexArray:
        import scipy.fft  # unlike numpy's, it stays in single precision

        # One hydrophone after the other: transforms of contiguous rows are twice as fast.
        rows = np.ascontiguousarray((snapshot * self._column).T)
        return np.asarray(scipy.fft.rfft(rows, axis=1).T[self.rows])


def outer_sum(spectra: ComplexArray) -> ComplexArray:
    """sum_k p p^H (F, M, M) of spectra (k, F, M): one matrix product per frequency."""
    columns = np.ascontiguousarray(spectra.transpose(1, 2, 0))
    return np.matmul(columns, columns.conj().swapaxes(1, 2))


class Average(NamedTuple):
    """R (F, M, M), the mean of `snapshots`."""

    csdm: ComplexArray
    snapshots: int


@define(eq=False)
class BlockAverage:
    """The mean of each `count` snapshots, of which `skip` are passed over after each mean: those
    that overlap with it, so that no sample is in two means. STATE: see `trackers.Tracker`."""

    STATE: ClassVar = ('_sum', '_in', '_to_skip')

    count: int
    skip: int = 0
    _sum: Annotated[ComplexArray, 'FMM'] | None = field(init=False, default=None)
    _in: int = field(init=False, default=0)
    _to_skip: int = field(init=False, default=0)

    def clear(self) -> None:
        self._sum, self._in, self._to_skip = None, 0, 0

    @property
    def waiting(self) -> int:
        return self._in

    def push(self, spectra: ComplexArray) -> list[Average]:
        """The averages that `spectra` (k, F, M) complete."""
        done = []
        while len(spectra):
            passed = min(self._to_skip, len(spectra))
            self._to_skip -= passed
            now, spectra = np.split(spectra[passed:], [self.count - self._in])
            if not len(now):
                break
            product = outer_sum(now)
            self._sum = product if self._sum is None else self._sum + product
            self._in += len(now)
            if self._in == self.count:
                done.append(Average(self._sum / np.float32(self.count), self.count))
                self.clear()
                self._to_skip = self.skip
        return done


@define(eq=False)
class SlidingAverage:
    """The mean of the last `count` snapshots, after every `step` of them. STATE: see
    `trackers.Tracker`."""

    STATE: ClassVar = ('_spectra', '_since')

    count: int
    step: int
    _spectra: deque[Annotated[ComplexArray, 'FM']] = field(init=False)
    _since: int = field(init=False, default=0)

    def __attrs_post_init__(self) -> None:
        if not 0 < self.step <= self.count:
            raise ValueError('a sliding average needs 0 < step <= count')
        self.clear()

    def clear(self) -> None:
        self._spectra, self._since = deque(maxlen=self.count), 0

    def push(self, spectra: ComplexArray) -> list[Average]:
        """The averages due after `spectra` (k, F, M)."""
        done = []
        for snapshot in spectra:
            self._spectra.append(snapshot)
            self._since += 1
            if len(self._spectra) == self.count and self._since >= self.step:
                total = outer_sum(np.stack(self._spectra))
                done.append(Average(total / np.float32(self.count), self.count))
                self._since = 0
        return done
