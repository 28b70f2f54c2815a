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

"""Starts of tracks: geometry_msgs PoseWithCovarianceStamped, as RViz sends them by a click."""

from __future__ import annotations

from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.measurements import Rejection, Start

from .fixes import (
    known_covariance,
    LEAST_VARIANCE,
    make_position,
    MOST_VARIANCE,
    UNKNOWN_VARIANCE,
)
from .headers import Make, stamp_ns, swap_axes, swap_covariance, to_enu


def read_start(message: Any, *, world_frame: str = 'enu') -> Start:
    """Read a PoseWithCovarianceStamped; the orientation is not used. Raises `Rejection`, also
    without a covariance of x and y: how far off the place may be is what a start has to say."""
    point, covariance = message.pose.pose.position, known_covariance(message)
    if covariance is None or np.isnan(covariance[0, 0]):
        raise Rejection(
            'no_covariance',
            'the start has no covariance of x and y: state how far off it may be, in m^2',
        )
    start = Start(
        stamp_ns=stamp_ns(message),
        position=(float(point.x), float(point.y), float(point.z)),
        covariance=covariance,
        frame_id=str(message.header.frame_id),
    )
    least, most = np.linalg.eigvalsh(start.covariance[:2, :2])
    if least < LEAST_VARIANCE or most > MOST_VARIANCE:
        raise Rejection(
            'out_of_range',
            f'the start states a standard deviation from {np.sqrt(least):g} m to '
            f'{np.sqrt(most):g} m',
        )
    return to_enu(start, world_frame, _turned)


def write_start(start: Start, make: Make) -> Any:
    """Write a PoseWithCovarianceStamped."""
    covariance = np.diag(np.full(6, UNKNOWN_VARIANCE))
    stated = np.isfinite(start.covariance)
    covariance[:3, :3][stated] = start.covariance[stated]
    return make_position(start, start.position, covariance, make)


def _turned(start: Start) -> Start:
    """The same start in ENU, of one in NED."""
    turned = swap_covariance(start.covariance)
    return evolve(start, position=swap_axes(start.position), covariance=turned)
