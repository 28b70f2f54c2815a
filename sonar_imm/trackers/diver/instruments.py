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

"""The systematic errors of the instruments: which of them the state holds, and where.

Each receiver may lie off where it is said to be and have a late clock; the sound speed may be
wrong for all. These constants stand behind the states of motion of every model and track, and the
receivers that have been heard so far decide how many there are (`Instruments`). New ones come in
with their prior, uncorrelated with all that is known.

How a constant is treated is told in `estimation.consider`. What is considered is one constant for
all models and tracks. What is estimated is a copy in each model and track, mixed like any state:
one posterior shared by tracks would need their joint covariance, and the posterior of one as the
prior of another would count its data twice.
"""

from __future__ import annotations

from attrs import frozen
import numpy as np

from ...acoustics.arrivals_3d import CLOCK, EMISSION, OFFSET, SOUND_SPEED_ERROR, X, Y, Z
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...measurements import Arrivals
from .config import DiverConfig
from .model_set import ModelSet

AT_TRANSMITTER = 0.01
"""Horizontal distance in metres within which a receiver is at the transmitter: the frame hangs on
that place, so that it has no error of position there."""


@frozen
class Instruments:
    """Receivers heard so far, in the order in which their errors stand in the state.

    known: (receiver id, has an offset) each.
    """

    known: tuple[tuple[int, bool], ...] = ()

    def heard(self, ping: Arrivals, config: DiverConfig) -> Instruments:
        """With the receivers of a ping; the same where nothing is to be known of them."""
        if not (config.receiver_position_std or config.receiver_clock_std):
            return self
        ids = {one for one, _ in self.known}
        new = []
        for receiver in np.unique(ping.rx_id).tolist():
            if receiver not in ids:
                row = int(np.flatnonzero(ping.rx_id == receiver)[0])
                apart = np.hypot(*(ping.rx[row] - ping.tx[row])[:2])
                new.append((receiver, not apart <= AT_TRANSMITTER))
        return Instruments((*self.known, *new)) if new else self

    def layout(self, config: DiverConfig, n: int) -> Layout:
        """Where the errors stand behind n states of motion."""
        variances: list[float] = []
        estimated: list[bool] = []
        errors = config.systematic_errors
        sound = -1
        if config.sound_speed_std:
            sound = n
            variances.append((config.sound_speed_std / config.sound_speed) ** 2)
            estimated.append(errors != 'consider')
        offsets, clocks = {}, {}
        for receiver, apart in self.known:
            if config.receiver_position_std and apart:
                offsets[receiver] = n + len(variances)
                variances += [config.receiver_position_std**2] * 2
                estimated += [errors == 'estimate'] * 2
            if config.receiver_clock_std:
                clocks[receiver] = n + len(variances)
                variances.append((config.receiver_clock_std * config.sound_speed) ** 2)
                estimated.append(errors != 'consider')
        return Layout(n, np.array(variances), np.array(estimated, bool), sound, offsets, clocks)


@frozen(eq=False)
class Layout:
    """n states of motion, then q constants with prior `variances` (q,), `estimated` (q,) or only
    considered; sound, offsets, clocks: places in the whole state, -1 or absent for none."""

    n: int
    variances: FloatArray
    estimated: BoolArray
    sound: int
    offsets: dict[int, int]
    clocks: dict[int, int]

    @property
    def size(self) -> int:
        return self.n + len(self.variances)

    @property
    def mask(self) -> BoolArray:
        """(n + q,) True for what an update may move."""
        return np.concatenate([np.ones(self.n, bool), self.estimated])

    def columns(self, models: ModelSet, receivers: IntArray, passive: bool) -> IntArray:
        """(C, 7) for `acoustics.arrivals_3d.observe`; of a tag the emission stands last."""
        out = np.full((len(receivers), 7), -1)
        out[:, X], out[:, Y], out[:, Z], out[:, SOUND_SPEED_ERROR] = (
            0,
            1,
            models.height,
            self.sound,
        )
        out[:, OFFSET] = [self.offsets.get(one, -1) for one in receivers.tolist()]
        out[:, CLOCK] = [self.clocks.get(one, -1) for one in receivers.tolist()]
        if passive:
            out[:, EMISSION] = self.size
        return out

    def widened(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (..., m) and covariances (..., m, m), m <= n + q, with the constants that are new
        at their prior."""
        m, size = x.shape[-1], self.size
        if m == size:
            return x, P
        wide, covariance = np.zeros((*x.shape[:-1], size)), np.zeros((*x.shape[:-1], size, size))
        wide[..., :m], covariance[..., :m, :m] = x, P
        new = range(m, size)
        covariance[..., new, new] = self.variances[m - self.n :]
        return wide, covariance
