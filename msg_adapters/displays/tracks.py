# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the displays of tracks have in common.

Only confirmed tracks are drawn, coasting ones too. The probabilities of the models are those of
the track that lasted longest (the smallest ``track_id``): a plotting tool draws one curve per
name, and several tracks in turn would be a zigzag between them. Those of all tracks are columns
of ``~/estimate``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from sonar_imm.estimates import Estimate

from ..estimates import write_model_probabilities
from ..headers import Make, make_header, make_vector

CONFIRMED = 1
"""Least `track_state` of a confirmed track: 0 tentative, 1 confirmed, 2 coasting."""
MODELS = 'model_probabilities'
NAMED_SCALARS = 'sensor_msgs/msg/JointState'
_ADD, _DELETE, _DELETE_ALL = 0, 2, 3
LIFETIME = 5
"""Seconds after which a marker vanishes when nothing is published any more."""
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


def make_marker(
    estimate: Estimate,
    row: int,
    make: Make,
    name: str,
    kind: int,
    size: tuple[float, float, float],
    colour_rgba: tuple[float, ...],
    **more: Any,
) -> Any:
    """Make one marker of the track in `row`.

    name: its namespace; kind: a type of visualization_msgs/Marker; size: metres along its axes;
    colour_rgba: 0 to 1; more: the fields that only this kind has, and the pose.
    """
    return make(
        'visualization_msgs/msg/Marker',
        header=make_header(estimate.stamp_ns, estimate.frame_id, make),
        ns=name,
        id=_number(int(estimate.extras['track_id'][row])),
        type=kind,
        action=_ADD,
        scale=make_vector(size, make),
        color=make('std_msgs/msg/ColorRGBA', **dict(zip('rgba', colour_rgba))),
        lifetime=make('builtin_interfaces/msg/Duration', sec=LIFETIME, nanosec=0),
        **more,
    )


def _number(track_id: int) -> int:
    """The id of a marker has 31 bits, one less than that of a track."""
    return track_id & 0x7FFFFFFF


def write_ended(frame_id: str, track_ids: Iterable[int], names: Iterable[str], make: Make) -> Any:
    """Write what removes the markers of tracks that are over; names: the namespaces they have."""
    markers = [
        make(
            'visualization_msgs/msg/Marker',
            header=make_header(0, frame_id, make),
            ns=name,
            id=_number(track_id),
            action=_DELETE,
        )
        for track_id in track_ids
        for name in names
    ]
    return make('visualization_msgs/msg/MarkerArray', markers=markers)


def write_no_markers(frame_id: str, make: Make) -> Any:
    """Write what removes every marker that was drawn before."""
    header = make_header(0, frame_id, make)
    every = make('visualization_msgs/msg/Marker', header=header, action=_DELETE_ALL)
    return make('visualization_msgs/msg/MarkerArray', markers=[every])
