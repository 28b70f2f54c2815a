# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Instrument errors: constants behind the motion states.

A receiver can have a position error and a late clock. The sound speed can be wrong. A bearing
sensor can be rotated by a mount or heading error. These constants follow the motion components of
every model and row. The receivers received so far determine their number. New constants start with
their prior, uncorrelated with the state.

`estimation.consider` describes how a constant is treated. A considered constant is common to all
models and tracks. An estimated constant is a copy in each model and track, mixed like any state: a
common posterior would need the joint covariance of all tracks.
"""

from __future__ import annotations

from attrs import frozen
import numpy as np

from ...acoustics.arrivals_3d import CLOCK, EMISSION, OFFSET, SOUND_SPEED_ERROR, X, Y, Z
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.bank import Gaussians
from ...estimation.rows import Rows
from ...measurements import Arrivals
from .config import DiverConfig
from .models import ModelSet

AT_TRANSMITTER = 0.01
"""Horizontal distance, m, within which a receiver is at the transmitter. The transmitter defines
the frame, so such a receiver has no position error."""

MOST_RECEIVERS = 64
"""Maximum number of receivers with errors in the state, which grows with its square. The first
received ones are used."""

TIMES, PLACE, BEARINGS = 'times', 'place', 'bearings'
"""Kinds of errors."""


@frozen
class Instruments:
    """Instruments received so far, in order of their errors in the state."""

    known: tuple[tuple[int | str, str], ...] = ()
    """Receiver ID or sensor name, and the kind of error: `TIMES` of arrival, `PLACE` (position and
    times), or `BEARINGS`."""

    def with_receivers(self, ping: Arrivals, config: DiverConfig) -> Instruments:
        """Add the receivers of a ping, up to `MOST_RECEIVERS` in total, if receiver errors are
        configured."""
        new: list[tuple[int | str, str]] = []
        if config.receiver_position_std or config.receiver_clock_std:
            ids = {each for each, what in self.known if what != BEARINGS}
            for receiver in np.unique(ping.rx_id).tolist():
                if receiver not in ids:
                    row = int(np.flatnonzero(ping.rx_id == receiver)[0])
                    apart = np.hypot(*(ping.rx[row] - ping.tx[row])[:2])
                    new.append((receiver, TIMES if apart <= AT_TRANSMITTER else PLACE))
        if config.bearing_bias_std_deg:
            bearing = np.unique(ping.rx_id[np.isfinite(ping.bearing)]).tolist()
            new += [(each, BEARINGS) for each in bearing if (each, BEARINGS) not in self.known]
        return self._with(new)

    def with_sensor(self, name: str) -> Instruments:
        """Add a sensor with a bearing error."""
        return self if (name, BEARINGS) in self.known else self._with([(name, BEARINGS)])

    def _with(self, new: list[tuple[int | str, str]]) -> Instruments:
        new = new[: max(0, MOST_RECEIVERS - len(self.known))]
        return Instruments((*self.known, *new)) if new else self

    def layout(self, config: DiverConfig, models: ModelSet) -> Layout:
        """Return the indices of the errors behind the components of `models`."""
        n = models.n
        variances: list[float] = []
        estimated: list[bool] = []
        errors = config.systematic_errors
        speed = -1
        if config.sound_speed_std:
            speed = n
            variances.append((config.sound_speed_std / config.sound_speed) ** 2)
            estimated.append(errors != 'consider')
        offsets, clocks, bearings = {}, {}, {}
        for receiver, what in self.known:
            if what == BEARINGS:
                bearings[receiver] = n + len(variances)
                variances.append(np.radians(config.bearing_bias_std_deg) ** 2)
                estimated.append(errors == 'estimate')
                continue
            if config.receiver_position_std and what == PLACE:
                offsets[receiver] = n + len(variances)
                variances += [config.receiver_position_std**2] * 2
                estimated += [errors == 'estimate'] * 2
            if config.receiver_clock_std:
                clocks[receiver] = n + len(variances)
                variances.append((config.receiver_clock_std * config.sound_speed) ** 2)
                estimated.append(errors != 'consider')
        mask = np.array([True] * n + estimated)
        return Layout(n, np.array(variances), mask, speed, offsets, clocks, bearings)


@frozen(eq=False)
class Layout:
    """State layout: n motion components, then q constants."""

    n: int
    """Number of motion components."""
    variances: FloatArray
    """(q,) prior variances of the constants."""
    mask: BoolArray
    """(n + q,) True for components that an update may change; False for considered constants."""
    sound_speed: int
    """Index of the sound speed error; -1 for none."""
    offsets: dict[int | str, int]
    """Index of the x offset of each receiver."""
    clocks: dict[int | str, int]
    """Index of the clock error of each receiver."""
    bearings: dict[int | str, int]
    """Index of the bearing error of each sensor or receiver."""

    @property
    def size(self) -> int:
        return self.n + len(self.variances)

    def estimated_masks(self, models: ModelSet) -> tuple[BoolArray | None, ...]:
        """Return `mask` for the components of each block, without tail; None if an update may
        change all."""
        if self.mask.all():
            return (None,) * len(models.parts)
        return tuple(self.mask[part.indices(self.n, self.size)] for part in models.parts)

    def measurement_columns(
        self, models: ModelSet, receivers: np.ndarray, passive: bool, bearing: BoolArray
    ) -> IntArray:
        """Return the component indices (C, 7) for `acoustics.arrivals_3d.observe`.

        :param bearing: (C,) True for bearings.
        :param passive: True for a tag, whose emission time is the last component.
        """
        out = np.full((len(receivers), 7), -1)
        out[:, X], out[:, Y], out[:, Z] = 0, 1, models.height
        out[:, SOUND_SPEED_ERROR] = self.sound_speed
        out[:, OFFSET] = [self.offsets.get(receiver, -1) for receiver in receivers.tolist()]
        out[:, CLOCK] = [
            (self.bearings if angle else self.clocks).get(receiver, -1)
            for receiver, angle in zip(receivers.tolist(), bearing)
        ]
        if passive:
            out[:, EMISSION] = self.size
        return out

    def with_new_constants(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Append new constants at their prior to states (..., m) and covariances (..., m, m)."""
        m, size = x.shape[-1], self.size
        if m == size:
            return x, P
        wide, covariance = np.zeros((*x.shape[:-1], size)), np.zeros((*x.shape[:-1], size, size))
        wide[..., :m], covariance[..., :m, :m] = x, P
        new = range(m, size)
        covariance[..., new, new] = self.variances[m - self.n :]
        return wide, covariance

    def rows_with_new_constants(self, rows: Rows, models: ModelSet) -> Rows:
        """Append new constants at their prior to rows, before their tail."""
        known = rows.blocks[0].x.shape[1] - len(models.parts[0].components) - rows.tail
        new = self.variances[known:]
        if not len(new):
            return rows
        blocks = []
        for x, P in rows.blocks:
            N, n, m = x.shape
            wide = np.zeros((N, n + len(new), m))
            covariance = np.zeros((N, n + len(new), n + len(new), m))
            at = np.arange(len(new)) + n - rows.tail
            old = np.delete(np.arange(n + len(new)), at)
            wide[:, old], covariance[:, old[:, None], old] = x, P
            covariance[:, at, at] = new[:, None]
            blocks.append(Gaussians(wide, covariance))
        return rows.replace(blocks=tuple(blocks))

    def rotate_about_sensor(
        self, rows: Rows, models: ModelSet, sensor: str, place: FloatArray, *, back: bool = False
    ) -> Rows:
        """Rotate the positions of rows about a `sensor` at `place` (2,) by its bearing error.

        In rotated positions, a fix measures the position itself. The covariance of the state
        contains the effect of the bearing error.

        :param back: rotate back.
        """
        if sensor not in self.bearings:  # MOST_RECEIVERS reached
            return rows
        sign, blocks = -1.0 if back else 1.0, []
        for part, (x, P) in zip(models.parts, rows.blocks):
            at = part.index_of(self.bearings[sensor], self.n)
            angle, arm = sign * x[:, at], x[:, :2] - place[:, None]
            cos, sin = np.cos(angle), np.sin(angle)
            turned = np.stack(
                [cos * arm[:, 0] - sin * arm[:, 1], sin * arm[:, 0] + cos * arm[:, 1]], axis=1
            )
            moved = x.copy()
            moved[:, :2] = place[:, None] + turned
            slope = np.stack([-sign * turned[:, 1], sign * turned[:, 0]], axis=1)
            T = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
            # The rows of the position, then its columns.
            left = P.copy()
            left[:, :2] = _multiply(T, P[:, :2]) + slope[:, :, None] * P[:, None, at]
            covariance = left.copy()
            columns = np.swapaxes(left, 1, 2)
            across = _multiply(T, columns[:, :2]) + slope[:, :, None] * columns[:, None, at]
            covariance[:, :, :2] = np.swapaxes(across, 1, 2)
            covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
            blocks.append(Gaussians(moved, covariance))
        return rows.replace(blocks=tuple(blocks))


def _multiply(T: FloatArray, P: FloatArray) -> FloatArray:
    """Return T P (N, 2, n, m) of matrices T (N, 2, 2, m) and P (N, 2, n, m)."""
    return np.asarray((T[:, :, :, None] * P[:, None]).sum(axis=2))
