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

"""What markers of tracks have in common: how one is made, and how they are taken away."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sonar_imm.estimates import Estimate

from .headers import Make, make_header

_ADD, _DELETE, _DELETE_ALL = 0, 2, 3
LIFETIME = 5
"""Seconds after which a marker vanishes when nothing is published any more."""


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
        scale=make('geometry_msgs/msg/Vector3', **dict(zip('xyz', size))),
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
