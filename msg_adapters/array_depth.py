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

"""Depth of the deepest hydrophone of an array, from a companion instrument.

A depth sensor publishes a position, of which only z is read: positive up in east-north-up,
positive down in north-east-down.
"""

from __future__ import annotations

from typing import Any

from sonar_imm.measurements import ArrayDepth

from .headers import Make, make_header, stamp_ns


def read_array_depth(message: Any, *, world_frame: str = 'enu') -> ArrayDepth:
    """Read a PointStamped or PoseWithCovarianceStamped. Raises `Rejection`."""
    point = message.pose.pose.position if hasattr(message, 'pose') else message.point
    down = world_frame == 'ned' or str(message.header.frame_id).endswith('_ned')
    z = float(point.z)
    return ArrayDepth(
        stamp_ns=stamp_ns(message),
        frame_id=str(message.header.frame_id),
        depth=z if down else -z,
    )


def write_array_depth(depth: ArrayDepth, make: Make) -> Any:
    """Write a PointStamped, z up."""
    return make(
        'geometry_msgs/msg/PointStamped',
        header=make_header(depth.stamp_ns, depth.frame_id, make),
        point=make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=-depth.depth),
    )
