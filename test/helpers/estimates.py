# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Comparing estimates."""


def same(estimate, other):
    """Equal to the last bit: stamp, frame, names, types and contents of all columns."""
    ours, theirs = estimate.columns(), other.columns()
    return (
        (estimate.stamp_ns, estimate.frame_id) == (other.stamp_ns, other.frame_id)
        and list(ours) == list(theirs)
        and all(
            ours[name].dtype == theirs[name].dtype
            and ours[name].tobytes() == theirs[name].tobytes()
            for name in ours
        )
    )
