# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Transforms of frames that do not change: tf2_msgs/TFMessage as ``/tf_static`` has it, or a
single geometry_msgs/TransformStamped where tf2 is not installed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sonar_imm.acoustics.geometry import Pose, rotation_of_quaternion
from sonar_imm.measurements import Rejection, StaticTransforms

from .headers import Make, make_header, make_vector, stamp_ns
from .inputs.topic import InputTopic

MOST_TRANSFORMS = 10_000
LONGEST_NAME = 1000
"""Characters of the name of a frame, since frames are remembered."""
FARTHEST = 1e8
"""Most metres between two frames on each axis."""


def read_transforms(message: Any, **_: Any) -> StaticTransforms:
    """Read a TFMessage or a TransformStamped. Raises `Rejection` for one that cannot be used."""
    stamped = message.transforms if hasattr(message, 'transforms') else [message]
    if not stamped:
        raise Rejection('empty', 'the message holds no transform')
    if len(stamped) > MOST_TRANSFORMS:
        raise Rejection('too_large', f'{len(stamped)} transforms; {MOST_TRANSFORMS} are read')
    return StaticTransforms(poses=dict(_pose(item) for item in stamped))


def write_transforms(transforms: StaticTransforms, make: Make) -> Any:
    """Write a TFMessage."""
    return make(
        'tf2_msgs/msg/TFMessage',
        transforms=[
            make(
                'geometry_msgs/msg/TransformStamped',
                header=make_header(transforms.stamp_ns, parent, make),
                child_frame_id=child,
                transform=make(
                    'geometry_msgs/msg/Transform',
                    translation=make_vector(pose.position, make),
                    rotation=make_vector(_quaternion(pose.R), make, 'Quaternion'),
                ),
            )
            for child, (parent, pose) in transforms.poses.items()
        ],
    )


def _pose(stamped: Any) -> tuple[str, tuple[str, Pose]]:
    """The child frame, and its parent and pose in that."""
    stamp_ns(stamped)  # not used, but it has to be one
    parent, child = (
        str(name).removeprefix('/') for name in (stamped.header.frame_id, stamped.child_frame_id)
    )
    if not parent or not child or parent == child:
        raise Rejection('no_frame', f"a transform from '{parent}' to '{child}' says nothing")
    if max(len(parent), len(child)) > LONGEST_NAME:
        raise Rejection('too_large', f'a frame has a name of more than {LONGEST_NAME} characters')
    shift, turn = stamped.transform.translation, stamped.transform.rotation
    position = np.array([shift.x, shift.y, shift.z], np.float64)
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], np.float64)
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise Rejection('nan', f"the transform from '{parent}' to '{child}' is not finite")
    if np.abs(position).max() > FARTHEST or abs(math.hypot(*quaternion) - 1.0) > 0.01:
        raise Rejection(
            'out_of_range',
            f"the transform from '{parent}' to '{child}' is no turn (a quaternion of length 1) "
            'and shift of at most 100,000 km',
        )
    return child, (parent, Pose(position, rotation_of_quaternion(quaternion)))


def _quaternion(R: np.ndarray) -> list[float]:
    """x, y, z, w of a rotation (3, 3): the eigenvector of its largest eigenvalue."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    _, vectors = np.linalg.eigh(K / 3.0)
    q = vectors[:, -1]
    return [float(value) for value in (q if q[3] >= 0.0 else -q)]


TYPES = ('tf2_msgs/msg/TFMessage', 'geometry_msgs/msg/TransformStamped')

TF_STATIC = InputTopic(
    'tf_static',
    'frames that are fixed to each other, e.g. of instruments',
    measurement=StaticTransforms,
    readers=dict.fromkeys(TYPES, read_transforms),
    write=write_transforms,
    companion=True,
    prefix='/',
    latched=True,
    by_name=frozenset(TYPES),
)
