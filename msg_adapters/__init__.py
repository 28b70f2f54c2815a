# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""ROS messages to measurements and estimates to ROS messages.

The adapters only look at attributes, so that messages of rclpy (live) and of rosbags (recorded)
are read by the same functions. They import neither library. A message that cannot be used raises
`sonar_imm.measurements.Rejection`. Messages are built through a factory `make(type_name,
**fields)` that the caller brings, because the two libraries disagree about what the fields hold.

This is a top-level module with a common name: another package in a merged ROS 2 workspace may ship
one too and hide this one. `__owner__` and `__version__` let `sonar_imm` notice.
"""

__all__ = [
    'array_records',
    'arrivals',
    'detections',
    'displays',
    'estimates',
    'fixes',
    'headers',
    'inputs',
    'navigation',
    'scans',
    'snapshots',
    'sonar_images',
    'soundings',
    'table',
    'transforms',
]

__owner__ = 'sonar_imm'
__version__ = '1.0.0'
