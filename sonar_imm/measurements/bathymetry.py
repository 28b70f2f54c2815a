# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the bathymetry tracker takes in: array snapshots of one ping."""

from __future__ import annotations

from typing import Any, ClassVar

from attrs import field, frozen
import numpy as np
from numpy.typing import NDArray

from ..acoustics.variances import LARGEST, SMALLEST, usable_bins
from ..estimation.arrays import FloatArray
from .checks import check_stamp, column, complexes, positives, Rejection

MAX_BINS, MAX_STAVES = 131_072, 64
FARTHEST_BIN = 20_000.0
"""Metres: no side-scan sonar reaches further."""


def _snapshots(value: Any) -> NDArray[np.complexfloating]:
    """Read-only (n, P), complex64 or complex128 as it came."""
    array = np.asarray(value)
    if array.ndim != 2:
        raise Rejection(
            'bad_shape', f'iq needs a row a bin and a column a stave, not {array.ndim} dimensions'
        )
    return complexes(array)


@frozen(eq=False, kw_only=True)
class Snapshot:
    """What the staves of a side-scan array heard of one ping on one side.

    range: (n,) m, one way, middle of each bin, increasing. iq: (n, P) complex, stave 0 first; bins
    that are not finite or silent are kept and not `usable`. noise_variance, signal_variance: (n,)
    per stave in squared units of iq, NaN where unknown, None when nowhere known.
    two_way_time: (n,) s, when the sonar gave times: `range` is then for `sound_speed`, or for
    1500 m/s when that is None (see `ranges`). sound_speed m/s, frequency Hz, element_spacing m and
    sample_rate Hz are None where the sonar does not say. side: ``'port'`` or ``'starboard'``
    where its topic says so, else empty.
    """

    FRAME: ClassVar[str] = 'own'

    stamp_ns: int
    range: FloatArray = field(converter=column)
    iq: NDArray[np.complexfloating] = field(converter=_snapshots)
    frame_id: str = ''
    noise_variance: FloatArray | None = field(default=None, converter=positives)
    signal_variance: FloatArray | None = field(default=None, converter=positives)
    two_way_time: FloatArray | None = None
    sound_speed: float | None = None
    frequency: float | None = None
    element_spacing: float | None = None
    sample_rate: float | None = None
    side: str = ''
    usable: NDArray[np.bool_] = field(init=False)

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        self._check_size()
        self._check_ranges()
        for name, low, high, unit in _SNAPSHOT_LIMITS:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise Rejection(
                    'out_of_range',
                    f'the snapshot states a {name} of {value:g} {unit}; '
                    f'{low:g} to {high:g} are possible',
                )
        usable = usable_bins(self.iq)
        if not usable.any():
            finite = np.isfinite(self.iq).all(axis=1)
            if not finite.any():
                raise Rejection('nan', 'the snapshot has no bin whose samples are all finite')
            largest = float(np.abs(self.iq[finite]).max())
            if largest == 0.0:
                raise Rejection('silent', 'the snapshot is silent in every bin')
            raise Rejection(
                'out_of_range',
                f'the samples of the snapshot reach {largest:g}; {SMALLEST:g} to {LARGEST:g} are '
                'possible',
            )
        usable.flags.writeable = False
        object.__setattr__(self, 'usable', usable)

    def __len__(self) -> int:
        return len(self.range)

    @property
    def staves(self) -> int:
        return self.iq.shape[1]

    @property
    def bin_width(self) -> float:
        """Mean distance between bins, metres: single differences suffer from single precision."""
        return float(self.range[-1] - self.range[0]) / (len(self) - 1)

    @property
    def spacing_wavelengths(self) -> float | None:
        """Distance between staves in wavelengths, None unless the sonar says all it takes."""
        if None in (self.element_spacing, self.frequency, self.sound_speed):
            return None
        return self.element_spacing * self.frequency / self.sound_speed  # type: ignore[operator]

    def ranges(self, sound_speed: float) -> FloatArray:
        """Ranges (n,) for a sound speed that counts only when the sonar gave times without one."""
        if self.two_way_time is None or self.sound_speed is not None:
            return self.range
        return 0.5 * sound_speed * self.two_way_time

    def _check_size(self) -> None:
        bins, staves = self.iq.shape
        for name in ('range', 'noise_variance', 'signal_variance', 'two_way_time'):
            column = getattr(self, name)
            if column is not None and np.shape(column) != (bins,):
                raise Rejection(
                    'bad_shape',
                    f'the snapshot has {bins} bins of iq and {name} of shape {np.shape(column)}',
                )
        if not 2 <= staves <= MAX_STAVES:
            reason = 'no_staves' if staves == 0 else 'bad_staves'
            raise Rejection(
                reason, f'the snapshot has {staves} staves; 2 to {MAX_STAVES} are needed'
            )
        if bins > MAX_BINS:
            raise Rejection(
                'too_large', f'the snapshot has {bins} bins; at most {MAX_BINS} are read'
            )
        if bins < 2:
            raise Rejection('too_short', f'the snapshot has {bins} range bins; 2 are needed')

    def _check_ranges(self) -> None:
        if not np.isfinite(self.range).all():
            raise Rejection('nan', 'the snapshot has a range that is not finite')
        if (np.diff(self.range) <= 0.0).any():
            raise Rejection('bad_range', 'the ranges of the snapshot do not increase')
        if self.range[0] < 0.0 or self.range[-1] > FARTHEST_BIN:
            raise Rejection(
                'out_of_range',
                f'the snapshot reaches from {self.range[0]:g} m to {self.range[-1]:g} m; '
                f'0 to {FARTHEST_BIN:g} m are possible',
            )


_SNAPSHOT_LIMITS = (
    ('sound_speed', 1300.0, 1700.0, 'm/s'),
    ('frequency', 1e3, 1e7, 'Hz'),
    ('element_spacing', 1e-5, 10.0, 'm'),
    ('sample_rate', 1.0, 1e9, 'Hz'),
    ('spacing_wavelengths', 0.01, 100.0, 'wavelengths'),
)
