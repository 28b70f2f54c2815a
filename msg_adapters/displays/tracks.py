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

"""What the displays of tracks have in common.

Only confirmed tracks are drawn, coasting ones too. The probabilities of the models are those of
the track that lasted longest (the smallest ``track_id``): a plotting tool draws one curve per
name, and several tracks in turn would be a zigzag between them. Those of all tracks are columns
of ``~/estimate``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from sonar_imm.estimates import Estimate

from ..estimates import write_model_probabilities
from ..headers import Make
from ..markers import write_ended, write_no_markers

CONFIRMED = 1
"""Least `track_state` of a confirmed track: 0 tentative, 1 confirmed, 2 coasting."""
MODELS = 'model_probabilities'
NAMED_SCALARS = 'sensor_msgs/msg/JointState'
Drawn = Iterator[tuple[str, Any]]
"""Names of topics, without ``~/``, and the messages to publish on them."""


def confirmed_rows(estimate: Estimate) -> np.ndarray:
    """The rows of an estimate whose tracks are confirmed."""
    return np.flatnonzero(estimate.extras['track_state'] >= CONFIRMED)


def models_of_the_oldest(
    estimate: Estimate,
    rows: np.ndarray,
    make: Make,
    is_wanted: Callable[[str], Any],
    sums: Sequence[str] = (),
) -> Drawn:
    """Draw the models of the track in `rows` that lasted longest, and `sums` of them."""
    if len(rows) and is_wanted(MODELS):
        oldest = rows[np.argmin(estimate.extras['track_id'][rows])]
        yield MODELS, write_model_probabilities(estimate, oldest, make, sums)


class Markers:
    """The markers of the tracks of one system: drawn anew with each estimate, and taken away at
    once when a track is over. names: their namespaces; write: ``(estimate, rows, make)``."""

    def __init__(self, names: tuple[str, ...], write: Callable[..., Any]):
        self._names, self._write = names, write
        self._frame_id = ''
        self._shown: set[int] = set()

    def of(
        self, estimate: Estimate, rows: np.ndarray, make: Make, is_wanted: Callable[[str], Any]
    ) -> Drawn:
        """Those of an estimate, before them what removes the ones that are over."""
        self._frame_id = estimate.frame_id
        ids = set(estimate.extras['track_id'][rows].tolist())
        ended, self._shown = sorted(self._shown - ids), ids
        if is_wanted('markers') and ended:
            yield 'markers', write_ended(self._frame_id, ended, self._names, make)
        if is_wanted('markers') and len(rows):
            yield 'markers', self._write(estimate, rows, make)

    def forget(self, make: Make) -> Drawn:
        """What removes all."""
        self._shown = set()
        yield 'markers', write_no_markers(self._frame_id, make)
