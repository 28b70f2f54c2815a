# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whether the last records go with what is configured."""

from __future__ import annotations

from collections import deque
import math
from typing import ClassVar

from attrs import define, field
import numpy as np

from ...acoustics.pulse import Pulse
from .config import FathometerConfig
from .reflectors import Reflectors
from .response import Response

_RECORDS, _LEAST = 100, 10
_DEEP, _OF_STRONGEST = 6.0, 0.25
"""How deep a negative echo is, in sigma and of the strongest one."""
_FULL, _UNEXPLAINED, _NEGATIVE, _LEFT, _NONE = 0.5, 0.05, 1e-9, 0.5, 0.2


@define(eq=False)
class Fit:
    """Whether the last records go with what is configured.

    A filter with another pulse, or a noise that is too low, does not fail: it fills the record
    with reflectors up to its limit, or finds no set that explains the record. Kept are whether a
    set explained each record, how probable the greatest number of reflectors was, and whether it
    has negative samples, and negative echoes that nothing explains. STATE: see
    `trackers.Tracker`."""

    STATE: ClassVar = (
        '_explained',
        '_full',
        '_found',
        '_signed',
        '_negative',
        '_wrapped',
        '_none',
    )

    _explained: deque[bool] = field(init=False, factory=lambda: deque(maxlen=_RECORDS))
    _full: deque[float] = field(init=False, factory=lambda: deque(maxlen=_RECORDS))
    _found: deque[int] = field(init=False, factory=lambda: deque(maxlen=_RECORDS))
    _signed: deque[bool] = field(init=False, factory=lambda: deque(maxlen=_RECORDS))
    _negative: deque[bool] = field(init=False, factory=lambda: deque(maxlen=_RECORDS))
    _none: deque[bool] = field(init=False, factory=lambda: deque(maxlen=_RECORDS))
    _wrapped: float = field(init=False, default=0.0)

    def add(
        self, ok: bool, reflectors: Reflectors, response: Response, full: float, negative: bool
    ) -> None:
        """One record; full: the probability of the greatest number of reflectors; negative: an
        echo of that sign is left."""
        if response.floor is not None and not len(response.floor.posterior):
            return  # too early to judge a line
        self._explained.append(ok)
        self._full.append(full)
        self._found.append(len(reflectors.depth))
        self._signed.append(
            response.floor is None and bool(np.min(response.amplitude) < -_NEGATIVE)
        )
        self._negative.append(negative)
        if response.floor is not None and math.isfinite(response.floor.depth[0]):
            self._none.append(not (reflectors.is_bottom > 0.5).any())
        if response.noise_wraps:
            self._wrapped = response.snapshot_seconds

    def warnings(self, config: FathometerConfig) -> list[str]:
        """What is wrong, with the parameters that it may come from."""
        sentences = []
        if self._wrapped and config.noise_told:
            sentences.append(
                'the noise window lies beyond half a snapshot '
                f'({0.25 * config.sound_speed * self._wrapped:.0f} m below the array with '
                f'{self._wrapped:.3g} s); noise is measured at the mirrored depths'
            )
        if len(self._full) < _LEAST:
            return sentences
        envelope = not any(self._signed)
        advice = 'noise_sigma, pulse and order_max may not fit'
        if envelope and (config.pulse == 'band' or config.water == 'off'):
            advice = 'the records are never negative: envelopes need water auto, and pulse auto, '
            advice += 'gaussian or file'
        full = float(np.mean(self._full))
        if config.orders > 1 and full > _FULL:
            sentences.append(
                f'{np.mean(self._found):.1f} reflectors a record against a limit of '
                f'{config.order_max}, which is reached with probability {full:.2f}; {advice}'
            )
        unexplained = 1.0 - float(np.mean(self._explained))
        if unexplained > _UNEXPLAINED:
            sentences.append(
                f'no set of reflectors explains {100.0 * unexplained:.0f} % of the records; '
                f'{advice}'
            )
        none = float(np.mean(self._none)) if len(self._none) >= _LEAST else 0.0
        if none > _NONE:
            sentences.append(
                f'the floor is none of the reflectors in {100.0 * none:.0f} % of the records'
            )
        negative = float(np.mean(self._negative))
        if negative > _LEFT:
            sentences.append(
                f'{100.0 * negative:.0f} % of the records have negative echoes, of multiples or '
                'of layers that are softer than what is above: polarity both follows them, for '
                'an array with pulse processor'
            )
        return sentences


def has_negative_residual(
    reflectors: Reflectors, response: Response, pulse: Pulse, config: FathometerConfig
) -> bool:
    """Whether a negative echo is left where no reflector is, that no side lobe explains."""
    with np.errstate(all='ignore'):
        b = response.amplitude / response.sigma
    least = max(_DEEP, _OF_STRONGEST * float(b.max()))
    deep = np.flatnonzero(b < -least)
    away = response.depth[deep, None] - reflectors.depth - reflectors.heave
    echoes = pulse(away) @ reflectors.amplitude
    left = b[deep] - echoes / response.sigma[deep] < -least
    return bool(np.any(left & (np.abs(away) > config.min_separation).all(axis=1)))
