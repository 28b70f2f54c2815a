# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the fathometer takes in: pressure at the hydrophones of a vertical array, their
cross-spectra, or ready-made traces; and the depth of the array, which a companion instrument may
tell.

Hydrophones fail at sea. One that is silent, constant or not finite is *dead*: it is left out by
whoever uses the measurement (`alive`), and only when too few are left is the measurement refused.
"""

from __future__ import annotations

from typing import Any, ClassVar

from attrs import field, frozen
import numpy as np
from numpy.typing import NDArray

from ..estimation.arrays import FloatArray
from .checks import check_stamp, column, complexes, positives, Rejection

MAX_SAMPLES, MAX_HYDROPHONES, MAX_FREQUENCIES = 1_000_000, 256, 131_072
LEAST_HYDROPHONES = 3
DEEPEST = 12_000.0
_SILENT = 1e-9
"""A hydrophone with so little of the median power of the others is dead."""
_HERMITIAN = 1e-3
"""Largest asymmetry of a matrix, against the powers of the two hydrophones."""
_LOUDEST = 1e12
"""No sample is larger, in any unit; the power spectra of larger ones overflow single precision."""
_MOST_POWER = float(np.finfo(np.float32).max)
"""No power is larger: sums of doubles that are would overflow."""


def _depth(value: Any) -> float | None:
    """Depth of an array in metres, or None when it is not known."""
    if value is None:
        return None
    depth = float(value)
    if np.isnan(depth):
        return None
    if not -100.0 <= depth <= DEEPEST:
        raise Rejection(
            'out_of_range',
            f'the array is said to be {depth:g} m deep; -100 to {DEEPEST:g} m are possible',
        )
    return depth


def _samples(value: Any) -> NDArray[np.float32]:
    with np.errstate(over='ignore', invalid='ignore'):  # what is too large becomes infinite
        array = np.array(value, np.float32)
    array.flags.writeable = False
    return array


@frozen(eq=False, kw_only=True)
class ArrayDepth:
    """How deep hydrophone 0, the deepest, was at one instant: depth in m, down positive."""

    FRAME: ClassVar[str] = 'none'

    stamp_ns: int
    depth: float
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if _depth(self.depth) is None:
            raise Rejection('nan', 'the depth of the array is not finite')


@frozen(eq=False, kw_only=True)
class Trace:
    """A depth response made elsewhere, such as one trace of a sub-bottom profiler.

    depth (n,) m, down positive, increasing; amplitude (n,), NaN where there is none; sigma (n,)
    standard deviation of its noise, NaN where unknown, None when nowhere known; reference_depth:
    of the array, m, None when not known.
    """

    stamp_ns: int
    depth: FloatArray = field(converter=column)
    amplitude: FloatArray = field(converter=column)
    frame_id: str = ''
    sigma: FloatArray | None = field(default=None, converter=positives)
    reference_depth: float | None = field(default=None, converter=_depth)

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        n = len(self.depth)
        for name in ('amplitude', 'sigma'):
            column = getattr(self, name)
            if column is not None and np.shape(column) != (n,):
                raise Rejection(
                    'bad_shape', f'the trace has {n} depths and {name} of shape {column.shape}'
                )
        if n < 2:
            raise Rejection('too_short', f'the trace has {n} depth samples; 2 are needed')
        if n > MAX_SAMPLES:
            raise Rejection(
                'too_large', f'the trace has {n} samples; at most {MAX_SAMPLES} are read'
            )
        if not np.isfinite(self.depth).all():
            raise Rejection('nan', 'the trace has a depth that is not finite')
        if (np.diff(self.depth) <= 0.0).any():
            raise Rejection('bad_depth', 'the depths of the trace do not increase')
        if self.depth[0] < -100.0 or self.depth[-1] > DEEPEST:
            raise Rejection(
                'out_of_range',
                f'the trace reaches from {self.depth[0]:g} m to {self.depth[-1]:g} m; '
                f'-100 to {DEEPEST:g} m are possible',
            )
        if not np.isfinite(self.amplitude).any():
            raise Rejection('nan', 'the trace has no finite amplitude')
        if not np.nanmax(np.abs(np.where(np.isfinite(self.amplitude), self.amplitude, 0.0))) > 0.0:
            raise Rejection('silent', 'the trace is silent at every depth')

    def __len__(self) -> int:
        return len(self.depth)

    @property
    def step(self) -> float:
        """Mean distance between samples, m: single differences suffer from single precision."""
        return float(self.depth[-1] - self.depth[0]) / (len(self) - 1)


@frozen(eq=False, kw_only=True)
class CrossSpectra:
    """Cross-spectral density of the hydrophones, averaged over snapshots.

    frequency (F,) Hz, multiples of one spacing, increasing, some may be missing; csdm (F, M, M),
    Hermitian, ``<p_i conj(p_j)>`` for exp(-i w t), hydrophone 0 the deepest; snapshots: how many
    were averaged, 0 when not known; reference_depth: of hydrophone 0, m, None when not known.
    alive (M,): hydrophones that heard something; usable (F,): rows whose living hydrophones are
    all finite.
    """

    stamp_ns: int
    frequency: FloatArray = field(converter=column)
    csdm: NDArray[np.complexfloating] = field(converter=complexes)
    frame_id: str = ''
    snapshots: int = 0
    reference_depth: float | None = field(default=None, converter=_depth)
    alive: NDArray[np.bool_] = field(init=False)
    usable: NDArray[np.bool_] = field(init=False)

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        self._check_size()
        self._check_frequencies()
        power = np.einsum('fmm->fm', self.csdm).real
        power = np.where(np.abs(power) <= _MOST_POWER, power, np.nan).astype(np.float64)
        alive = _alive(power, 'cross-spectra')
        inner = self.csdm[:, alive][:, :, alive]
        finite = np.isfinite(inner).all(axis=(1, 2))
        usable = finite & (power[:, alive] > 0.0).all(axis=1)
        if not usable.any():
            raise Rejection('nan', 'no row of the cross-spectra has only finite, positive powers')
        self._check_matrices(inner[usable], power[usable][:, alive])
        for name, mask in (('alive', alive), ('usable', usable)):
            mask.flags.writeable = False
            object.__setattr__(self, name, mask)

    def __len__(self) -> int:
        return len(self.frequency)

    @property
    def hydrophones(self) -> int:
        return self.csdm.shape[-1]

    def _check_size(self) -> None:
        shape = self.csdm.shape
        F, M = len(self.frequency), shape[-1] if shape else 0
        if self.csdm.ndim != 3 or shape != (F, M, M):
            raise Rejection(
                'bad_shape', f'{F} frequencies need csdm of shape ({F}, M, M), got {shape}'
            )
        if F < 2:
            raise Rejection('too_short', f'the cross-spectra have {F} frequencies; 2 are needed')
        if F > MAX_FREQUENCIES:
            raise Rejection('too_large', f'{F} frequencies; at most {MAX_FREQUENCIES} are read')
        _check_hydrophones(M)

    def _check_frequencies(self) -> None:
        if not np.isfinite(self.frequency).all():
            raise Rejection('nan', 'the cross-spectra have a frequency that is not finite')
        if self.frequency[0] < 0.0 or self.frequency[-1] > 1e6:
            raise Rejection('out_of_range', 'frequencies must lie between 0 and 1 MHz')
        if (np.diff(self.frequency) <= 0.0).any():
            raise Rejection(
                'bad_frequency', 'the frequencies of the cross-spectra do not increase'
            )

    def _check_matrices(self, csdm: NDArray[np.complexfloating], power: FloatArray) -> None:
        root = np.sqrt(power).astype(csdm.real.dtype)
        # Some frequencies at a time: the intermediate results of all would leave the cache.
        for first in range(0, len(csdm), 64):
            R, r = csdm[first : first + 64], root[first : first + 64]
            with np.errstate(over='ignore', invalid='ignore'):  # far above one, maybe infinite
                normalised = R / r[:, :, None] / r[:, None, :]
                asymmetry = np.abs(normalised - normalised.conj().swapaxes(1, 2)).max()
                coherence = np.abs(normalised).max()
            if asymmetry > _HERMITIAN:
                raise Rejection('not_hermitian', 'the cross-spectral matrices are not Hermitian')
            if not coherence <= 1.0 + _HERMITIAN:
                raise Rejection(
                    'not_positive',
                    'the cross-spectra claim a coherence between hydrophones above one',
                )


@frozen(eq=False, kw_only=True)
class Pressure:
    """A block of samples of all hydrophones.

    pressure (n, M) in any linear unit, hydrophone 0 the deepest, samples that are not finite or
    beyond 1e12 made zero; sample_rate Hz; the stamp is that of the first sample; reference_depth:
    of hydrophone 0, m, None when not known; scale: what a step of whole numbers is worth, 0 for
    real ones.
    alive (M,): hydrophones without such a sample that are not constant.
    """

    stamp_ns: int
    pressure: NDArray[np.float32] = field(converter=_samples)
    sample_rate: float
    frame_id: str = ''
    reference_depth: float | None = field(default=None, converter=_depth)
    scale: float = 0.0
    alive: NDArray[np.bool_] = field(init=False)

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if self.pressure.ndim != 2:
            raise Rejection(
                'bad_shape', 'pressure needs a row per sample and a column per hydrophone'
            )
        n, M = self.pressure.shape
        if n < 2:
            raise Rejection('too_short', f'the block of pressure has {n} samples; 2 are needed')
        if n > MAX_SAMPLES:
            raise Rejection('too_large', f'{n} samples in a block; at most {MAX_SAMPLES} are read')
        _check_hydrophones(M)
        if not 1.0 <= self.sample_rate <= 1e7:
            raise Rejection(
                'out_of_range',
                f'the sample rate is {self.sample_rate:g} Hz; 1 Hz to 10 MHz are possible',
            )
        finite = np.abs(self.pressure) <= _LOUDEST
        clean = np.where(finite, self.pressure, np.float32(0.0))
        power = np.var(clean, axis=0, dtype=np.float64)
        alive = _alive(np.where(finite.all(axis=0), power, np.nan)[None], 'pressure')
        for name, value in (('pressure', clean), ('alive', alive)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.pressure)

    @property
    def hydrophones(self) -> int:
        return self.pressure.shape[1]

    @property
    def duration_ns(self) -> int:
        """From the first sample of this block to the first of the next."""
        return round(len(self) * 1e9 / self.sample_rate)


def _check_hydrophones(M: int) -> None:
    if not LEAST_HYDROPHONES <= M <= MAX_HYDROPHONES:
        raise Rejection(
            'bad_hydrophones',
            f'the array has {M} hydrophones; {LEAST_HYDROPHONES} to {MAX_HYDROPHONES} are needed',
        )


def _alive(power: FloatArray, what: str) -> NDArray[np.bool_]:
    """Which hydrophones live, from powers (rows, M), NaN where not finite. A hydrophone of which
    more than half of the rows are not finite is dead; of single rows the row is at fault."""
    lost = np.isnan(power).mean(axis=0) > 0.5
    total = np.nansum(power, axis=0)
    total[lost] = np.nan
    if lost.all():
        raise Rejection('nan', f'{what}: no hydrophone is finite')
    if not np.nanmax(total) > 0.0:
        raise Rejection('silent', f'{what}: every hydrophone is silent')
    alive = ~lost & (np.nan_to_num(total) > _SILENT * np.nanmedian(total[total > 0.0]))
    if alive.sum() < LEAST_HYDROPHONES:
        raise Rejection(
            'dead_hydrophones',
            f'{what}: {int(alive.sum())} hydrophones live; {LEAST_HYDROPHONES} are needed',
        )
    return np.asarray(alive)
