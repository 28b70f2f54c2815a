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

"""Errors of instruments that last: constants behind the states of motion.

Each receiver may lie off its stated place and have a late clock; the sound speed may be wrong for
all; a sensor of bearings may be turned by some degrees, because its mount or its heading is off.
These constants stand behind the components of motion of every model and row, and the receivers
that have been heard so far decide how many there are. New ones come in with their prior,
uncorrelated with all that is known.

How a constant is treated is described in `estimation.consider`. What is considered is one constant
for all models and tracks. What is estimated is a copy in each model and track, mixed like any
state: one posterior shared by tracks would need their joint covariance, and the posterior of one
track as the prior of another would count its data twice.
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
"""Horizontal distance in metres within which a receiver is at the transmitter: the frame hangs on
that place, so that it has no error of position there."""

MOST_RECEIVERS = 64
"""Receivers whose errors are part of the state, which grows with its square; those that are heard
first. More are numbers that wander, not instruments."""

TIMES, PLACE, BEARINGS = 'times', 'place', 'bearings'
"""What may be off for good."""


@frozen
class Instruments:
    """Receivers heard so far, in the order in which their errors stand in the state.

    known: each a receiver id or the name of a sensor, and what of it may be off: `TIMES` of
    arrival, `PLACE` as well, or `BEARINGS`.
    """

    known: tuple[tuple[int | str, str], ...] = ()

    def with_receivers(self, ping: Arrivals, config: DiverConfig) -> Instruments:
        """Return these with the receivers of a ping, `MOST_RECEIVERS` in all; the same where
        nothing is to be known of them."""
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
        """Return these with a sensor whose fixes may all be turned about it; the same where it is
        known."""
        return self if (name, BEARINGS) in self.known else self._with([(name, BEARINGS)])

    def _with(self, new: list[tuple[int | str, str]]) -> Instruments:
        new = new[: max(0, MOST_RECEIVERS - len(self.known))]
        return Instruments((*self.known, *new)) if new else self

    def layout(self, config: DiverConfig, models: ModelSet) -> Layout:
        """Return where the errors stand behind the components of `models`."""
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
    """n components of motion, then q constants with prior `variances` (q,).

    mask (n + q,): True for what an update may move, False for what is only considered;
    sound_speed, offsets, clocks, bearings: places among all n + q, -1 or absent for none.
    """

    n: int
    variances: FloatArray
    mask: BoolArray
    sound_speed: int
    offsets: dict[int | str, int]
    clocks: dict[int | str, int]
    bearings: dict[int | str, int]

    @property
    def size(self) -> int:
        return self.n + len(self.variances)

    def estimated_masks(self, models: ModelSet) -> tuple[BoolArray | None, ...]:
        """Return `mask` for the components of each block, None where an update may move all."""
        if self.mask.all():
            return (None,) * len(models.parts)
        return tuple(self.mask[part.indices(self.n, self.size)] for part in models.parts)

    def measurement_columns(
        self, models: ModelSet, receivers: np.ndarray, passive: bool, bearing: BoolArray
    ) -> IntArray:
        """Return (C, 7) for `acoustics.arrivals_3d.observe`, of which some are a `bearing` (C,);
        of a tag the emission stands last."""
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
        """Return states (..., m) and covariances (..., m, m), m <= n + q, with the constants that
        are new at their prior."""
        m, size = x.shape[-1], self.size
        if m == size:
            return x, P
        wide, covariance = np.zeros((*x.shape[:-1], size)), np.zeros((*x.shape[:-1], size, size))
        wide[..., :m], covariance[..., :m, :m] = x, P
        new = range(m, size)
        covariance[..., new, new] = self.variances[m - self.n :]
        return wide, covariance

    def rows_with_new_constants(self, rows: Rows, models: ModelSet) -> Rows:
        """Return the rows with the constants that are new at their prior."""
        known = rows.blocks[0].x.shape[1] - len(models.parts[0].components)
        new = self.variances[known:]
        if not len(new):
            return rows
        blocks = []
        for x, P in rows.blocks:
            N, n, m = x.shape
            wide = np.zeros((N, n + len(new), m))
            covariance = np.zeros((N, n + len(new), n + len(new), m))
            wide[:, :n], covariance[:, :n, :n] = x, P
            at = range(n, n + len(new))
            covariance[:, at, at] = new[:, None]
            blocks.append(Gaussians(wide, covariance))
        return rows.replace(blocks=tuple(blocks))

    def rotate_about_sensor(
        self, rows: Rows, models: ModelSet, sensor: str, place: FloatArray, *, back: bool = False
    ) -> Rows:
        """Return the rows with positions as a `sensor` at `place` (2,) shows them: turned about it
        by the error of its bearings, or `back`.

        So a fix measures the position itself, whoever it is of and wherever he is: what the error
        does to it stands in the covariance of the state, wherever the state goes from there.
        """
        if sensor not in self.bearings:  # there were too many before it
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
    """Return T P, (N, 2, n, m), of matrices T (N, 2, 2, m) and P (N, 2, n, m)."""
    return np.asarray((T[:, :, :, None] * P[:, None]).sum(axis=2))
