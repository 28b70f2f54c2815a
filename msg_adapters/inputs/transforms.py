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

"""The input that several trackers share: frames that are fixed to each other."""

from __future__ import annotations

from sonar_imm.measurements import StaticTransforms

from ..transforms import read_transforms, write_transforms
from .topic import InputTopic

TYPES = ('tf2_msgs/msg/TFMessage', 'geometry_msgs/msg/TransformStamped')

TF_STATIC = InputTopic(
    'tf_static',
    'frames that are fixed to each other, with use_tf_static or sonar_frame',
    measurement=StaticTransforms,
    readers=dict.fromkeys(TYPES, read_transforms),
    write=write_transforms,
    companion=True,
    prefix='/',
    latched=True,
    by_name=frozenset(TYPES),
    wanted=lambda told: bool(told.get('use_tf_static') or told.get('sonar_frame')),
)
