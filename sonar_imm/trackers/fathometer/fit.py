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

"""Whether the records go with what the tracker was told of them.

A filter that was given another pulse, or a noise that is too low, does not fail: it fills the
record with reflectors up to its limit, or finds no set that explains the record. Both are counted,
and said once they are common.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from .config import FathometerConfig
from .reflectors import Reflectors
from .response import Response

_RECORDS, _LEAST = 100, 10
_FULL, _UNEXPLAINED, _NEGATIVE = 0.5, 0.05, 1e-9


class Fit:
    """Of the last records: whether a set explained them, how probable the greatest number of
    reflectors was, and whether they have negative samples."""

    def __init__(self) -> None:
        self._explained: deque[bool] = deque(maxlen=_RECORDS)
        self._full: deque[float] = deque(maxlen=_RECORDS)
        self._found: deque[int] = deque(maxlen=_RECORDS)
        self._signed: deque[bool] = deque(maxlen=_RECORDS)

    def add(self, ok: bool, reflectors: Reflectors, response: Response, full: float) -> None:
        """One record; full: the probability of the greatest number of reflectors."""
        self._explained.append(ok)
        self._full.append(full)
        self._found.append(len(reflectors.depth))
        self._signed.append(bool(np.min(response.amplitude) < -_NEGATIVE))

    def warnings(self, config: FathometerConfig) -> list[str]:
        """What is wrong, with the parameters that it may come from."""
        if len(self._full) < _LEAST:
            return []
        envelope = not any(self._signed)
        advice = 'noise_sigma, pulse and order_max may not fit'
        if envelope and (config.pulse == 'band' or not config.scatter_decay):
            advice = 'the records are never negative: envelopes need pulse gaussian or file, '
            advice += 'pulse_width and scatter_decay'
        sentences = []
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
        return sentences
