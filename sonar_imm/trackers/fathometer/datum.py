# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How wrong the stated depth of the array is, as the reflectors show it together.

All reflectors change from record t - 1 to t, as they are seen from the array that is told, by

    c_t = g_t + w_t + e_t - e_{t-1},    g_t = g_{t-1} + u_t

g a slope of the floor that bends, w a step of it, both of all layers together, and e the error
of the array's depth, N(0, std^2), new in each record. How large each of the three is (`ERRORS`,
`STEPS`, `BENDS`) is not known: a Kalman filter for each choice of them weighs it by the last
`CHANGES`. A fault of the floor is one change that none of them explains (`_FAULT`). What an error
does to c looks back: c_t and c_{t+1} have the covariance -std^2, where steps have none and slopes
a positive one. An error that is slow, or constant, cannot be told from the floor.

The error that is found, the root of the mean of std^2, counts in the covariance where it is more
than what is told. Once it is far more, for sure, with ``heave: auto`` it becomes a state that all
reflectors share, and they keep their ids.

Jumps that are farther than slopes reach are counted: of a fault, or of a depth or a window that
changed unsaid.
"""

from __future__ import annotations

from functools import lru_cache
import math
from typing import Annotated, ClassVar

from attrs import define, evolve, field
import numpy as np

from ...estimation.arrays import FloatArray
from .config import FathometerConfig
from .reflectors import IdArray, Identities, Reflectors
from .slopes import TURN_REACH

CHANGES, LEAST, LEAST_FOLLOWED, MOST = 40, 4, 8, 1000.0
"""Changes that are remembered; how many it takes until the error counts, and until it is a
state."""
ERRORS = np.append(0.0, 0.02 * 2.0 ** (0.5 * np.arange(15)))
STEPS, STEPS_PRIOR = np.array([0.01, 0.03, 0.1, 0.3, 1.0]), np.array([0.3, 0.3, 0.25, 0.1, 0.05])
BENDS = np.array([0.003, 0.03, 0.1, 0.3, 1.0])
"""Standard deviations, m; floors bend more often than all layers step together."""
_RIGHT, _FAULT, _FAULT_DENSITY = 0.2, 0.005, 0.05
"""Prior of no error at all; probability of a fault, and how dense its changes lie, 1/m."""
_FIRST_SLOPE = 0.4
_TIMES, _LEAST_ERROR, _SURE, _AGAIN = 2.0, 0.05, 0.9, 1.4
_VARIANCES = np.square(ERRORS), np.square(STEPS), np.square(BENDS)
_WRONG = np.append(_RIGHT, np.full(len(ERRORS) - 1, (1.0 - _RIGHT) / (len(ERRORS) - 1)))
_PRIOR = np.multiply.outer(
    np.multiply.outer(_WRONG, STEPS_PRIOR), np.full(len(BENDS), 1.0 / len(BENDS))
).ravel()


@define(eq=False)
class DatumError:
    """Changes of depth, m, that reflectors of two records have in common, and their noise, (n, 2).
    STATE: see `trackers.Tracker`. followed: standard deviation with which the error is a state, m;
    heave: that was taken off the last record, m; _jumps: in how many records all jumped far, and
    _last, by how many m in the last of them."""

    STATE: ClassVar = ('_changes', 'followed', 'heave', '_jumps', '_last')

    _changes: Annotated[FloatArray, 'n2'] = field(init=False, factory=lambda: np.empty((0, 2)))
    followed: float = field(init=False, default=0.0)
    heave: float = field(init=False, default=0.0)
    _jumps: int = field(init=False, default=0)
    _last: float = field(init=False, default=0.0)

    def add(self, change: float, noise: float = 0.0) -> None:
        """One more record; its change, as it is seen from the array that is told, and the variance
        of its depth as that follows from the reflectors' own, m^2."""
        self._changes = np.vstack([self._changes[1 - CHANGES :], [change, noise]])

    def note(
        self,
        known: Identities,
        ids: IdArray,
        found: Reflectors,
        config: FathometerConfig,
        *,
        array: bool,
    ) -> None:
        """Take the reflectors of one more record, with `ids` (K,) those that were `known`; array:
        what moves the floor of a profiler is its ship."""
        before = {e.track_id: e.depth for e in known.reflectors if not e.missed + e.absent}
        seen = zip(ids.tolist(), found.depth, found.relative_variance)
        moved = np.array([(z - before[i], 1.0 / v) for i, z, v in seen if i in before])
        if abs(found.probable_jump) > TURN_REACH * config.slope_std and len(moved) > 1:
            self._jumps, self._last = self._jumps + 1, found.probable_jump
        if len(moved) and array:
            # A reflector that is seen well counts as much as all that are not.
            change, precision = np.average(moved[:, 0], weights=moved[:, 1]), moved[:, 1].sum()
            self.add(float(change) + found.heave - self.heave, float(1.0 / precision))
        self.heave = found.heave

    def require(self) -> None:
        """Raise ValueError where the state, which may come from a file, is impossible."""
        good = np.isfinite(self._changes).all() and 0.0 <= self.followed <= MOST
        good = good and bool((self._changes[:, 1] >= 0.0).all())
        numbers = self._last, self.heave
        if not (good and self._jumps >= 0 and all(map(math.isfinite, numbers))):
            raise ValueError('no array is as deep as that')

    @property
    def weights(self) -> FloatArray:
        """Posterior (15 + 1,) of `ERRORS`."""
        return _weights_of(self._changes.tobytes())

    @property
    def found(self) -> float:
        """Standard deviation, m; 0 while it is not known."""
        if len(self._changes) < LEAST:
            return self.followed
        return math.sqrt(float(self.weights @ np.square(ERRORS)))

    def counted(self, config: FathometerConfig) -> float:
        """What counts in the covariance, m: nothing where no error is told."""
        return self.found if config.array_depth_std else 0.0

    def exceeds(self, config: FathometerConfig) -> bool:
        """Whether the error is far greater than what is told, for sure."""
        if self.followed:
            return True
        least = max(_TIMES * config.array_depth_std, _LEAST_ERROR)
        enough = config.array_depth_std > 0.0 and len(self._changes) >= LEAST_FOLLOWED
        return enough and float(self.weights[least < ERRORS].sum()) > _SURE

    def follow(self, config: FathometerConfig) -> bool:
        """Make the error a state, or one of another size; whether that changes anything."""
        found = self.found
        if not self.exceeds(config) or self.followed / _AGAIN < found < self.followed * _AGAIN:
            return False
        self.followed = found
        return True

    def effective(self, config: FathometerConfig) -> FathometerConfig:
        """`config` with the heave that is followed now."""
        if config.heave != 'auto':
            return config
        if not self.followed:
            return evolve(config, heave='none')
        return evolve(config, heave='independent', array_depth_std=self.followed)

    def warnings(self, config: FathometerConfig) -> list[str]:
        """What all reflectors do together, in sentences."""
        found = []
        if self._jumps:
            found.append(
                f'all reflectors jumped together in {self._jumps} '
                f'{"record" if self._jumps == 1 else "records"}, by {self._last:+.1f} m in the '
                'last: a fault or a slope, or the depth of the array or the window changed unsaid'
            )
        if config.heave in ('auto', 'none') and self.exceeds(config):
            remedy = 'it is followed as heave' if self.followed else 'heave auto follows it'
            found.append(
                f'the depth of the array is wrong by about {self.found:.2f} m from record to '
                f'record, {config.array_depth_std:g} m told (array_depth_std); {remedy}'
            )
        return found


@lru_cache(maxsize=8)
def _weights_of(changes: bytes) -> FloatArray:
    return error_weights(np.frombuffer(changes).reshape(-1, 2))


def error_weights(changes: FloatArray) -> FloatArray:
    """Posterior (16,) of `ERRORS`, from what reflectors change by together and the variance of
    their depth, (n, 2), m and m^2. The state of each filter is the slope g and the last error e,
    with that of the reflectors: their means, variances and covariance."""
    s2, q2, b2 = (x.ravel() for x in np.meshgrid(*_VARIANCES, indexing='ij'))
    log_weight = np.log(_PRIOR)
    g, e, eg = np.zeros((3, len(s2)))
    gg, ee = np.full(len(s2), _FIRST_SLOPE**2), s2 + (changes[0, 1] if len(changes) else 0.0)
    for change, noise in changes:
        gg, e2 = gg + b2, s2 + noise
        S = gg - 2.0 * eg + ee + e2 + q2
        y = change - (g - e)
        density = (1.0 - _FAULT) * np.exp(-0.5 * np.square(y) / S) / np.sqrt(2.0 * np.pi * S)
        log_weight += np.log(density + _FAULT * _FAULT_DENSITY)
        # Of a fault nothing is learned.
        gain = np.where(density > _FAULT * _FAULT_DENSITY, 1.0 / S, 0.0)
        to_g, to_e = (gg - eg) * gain, e2 * gain
        g, e = g + to_g * y, to_e * y
        gg, eg, ee = gg - np.square(to_g) * S, -to_g * to_e * S, e2 - np.square(to_e) * S
    weight = np.exp(log_weight - log_weight.max()).reshape(len(ERRORS), -1).sum(axis=1)
    return np.asarray(weight / weight.sum())
