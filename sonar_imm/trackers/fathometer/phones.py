# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What was corrected of the hydrophones of an array, over all records, and sentences of it."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Annotated, ClassVar

from attrs import define, field
import numpy as np

from ...acoustics.hydrophones import LEAST_DELAY
from ...estimation.arrays import BoolArray, FloatArray
from .config import FathometerConfig
from .response import Response

_LEAST_DB, _HALF = 1.0, 0.5
_OF_LATEST = 0.15
"""A late hydrophone draws the others along by a tenth of its delay: what is less is not named."""
_NAMED = 6
"""Hydrophones that one sentence names at most."""


@define(eq=False)
class PhoneFaults:
    """Mean response of each hydrophone. STATE: see `trackers.Tracker`.

    _sum (4, M): of `Response.phones`, over the records (4, M) in which each was found; _left
    (M,): records in which a hydrophone was left out; _period: of the highest frequency, s."""

    STATE: ClassVar = ('_sum', '_seen', '_left', '_period')

    _sum: Annotated[FloatArray, '4m'] = field(init=False, factory=lambda: np.zeros((4, 0)))
    _seen: Annotated[FloatArray, '4m'] = field(init=False, factory=lambda: np.zeros((4, 0)))
    _left: Annotated[FloatArray, 'm'] = field(init=False, factory=lambda: np.zeros(0))
    _period: float = field(init=False, default=0.0)

    def add(self, response: Response, config: FathometerConfig) -> bool:
        """One record; whether a hydrophone of it was left out."""
        phones = response.phones
        if phones.shape != self._sum.shape:
            self._sum, self._seen = np.zeros(phones.shape), np.zeros(phones.shape)
            self._left = np.zeros(phones.shape[1])
        self._period = 1.0 / config.frequency_max
        left = phones[3] < config.phone_least_share
        there = np.isfinite(phones)
        # What is foreign has no response that means anything.
        there[:3] &= ~left
        self._sum += np.where(there, phones, 0.0)
        self._seen += there
        self._left += left
        return bool(left.any())

    def _means(self) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Gain in dB, sign, delay and share (4, M), NaN where unknown; which differ (M,) by any of
        them, and which are foreign (M,)."""
        with np.errstate(invalid='ignore', divide='ignore'):
            mean = self._sum / self._seen
            foreign = self._left > 0.5 * self._seen[3]
            differ = np.abs(mean[0]) >= _LEAST_DB
            differ |= (mean[1] < 0.0) | self._late(mean[2])
            differ |= mean[3] < _HALF
        return mean, differ, foreign

    def _late(self, delay: FloatArray) -> BoolArray:
        latest = float(np.max(np.nan_to_num(np.abs(delay)), initial=0.0))
        with np.errstate(invalid='ignore'):
            return np.abs(delay) >= max(LEAST_DELAY * self._period, _OF_LATEST * latest)

    def health(self) -> dict[str, float]:
        """Gain, sign, delay and share of each hydrophone that differs from the others."""
        mean, differ, _ = self._means()
        names = 'phone_gain_db', 'phone_sign', 'phone_delay', 'phone_share'
        return {
            f'{name}_{phone}': float(mean[row, phone])
            for phone in np.flatnonzero(differ)
            for row, name in enumerate(names)
            if math.isfinite(mean[row, phone])
        }

    def warnings(self) -> list[str]:
        """One sentence of each kind of fault."""
        mean, _, foreign = self._means()
        gain, sign, delay, share = np.where(foreign, np.nan, mean)
        late = self._late(delay)

        def level(phone: int) -> str:
            side = 'below' if gain[phone] < 0.0 else 'above'
            return f'{abs(gain[phone]):.1f} dB {side} the others'

        def time(phone: int) -> str:
            return f'{1e6 * abs(delay[phone]):.0f} us {"late" if delay[phone] > 0.0 else "early"}'

        def part(phone: int) -> str:
            return f'{100.0 * max(0.0, mean[3, phone]):.0f} %'

        off = np.abs(gain) >= _LEAST_DB
        found = [
            _sentence(off, 'is', level, 'its signal was levelled'),
            _sentence(sign < 0.0, 'is', lambda _: 'turned', 'it was turned back'),
            _sentence(late, 'is', time, 'it was shifted'),
            _sentence(foreign, 'has', part, "of its neighbours' sound; it was left out"),
            _sentence(share < _HALF, 'has', part, "of its neighbours' sound"),
        ]
        return [sentence for sentence in found if sentence]


def _sentence(which: BoolArray, verb: str, words: Callable[[int], str], end: str) -> str:
    """A sentence of the hydrophones `which` (M,), empty without any."""
    phones = np.flatnonzero(which).tolist()
    if not phones:
        return ''
    joint = ' ' if end.startswith('of ') else '; '
    if len(phones) == 1:
        return f'hydrophone {phones[0]} {verb} {words(phones[0])}{joint}{end}'
    named = ', '.join(f'{phone} {verb} {words(phone)}' for phone in phones[:_NAMED])
    more = f' and {len(phones) - _NAMED} more' if len(phones) > _NAMED else ''
    return f'hydrophones: {named}{more}{joint}{_plural(end)}'


def _plural(end: str) -> str:
    for one, many in (('its signal was', 'their signals were'), ('it was', 'they were')):
        end = end.replace(one, many)
    return end.replace('its neighbours', 'their neighbours')
