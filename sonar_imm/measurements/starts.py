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

"""Where somebody says that a target is: not measured, but told by a person or another program."""

from __future__ import annotations

from typing import Any

from attrs import field, frozen
import numpy as np

from ..estimation.arrays import FloatArray
from .checks import check_covariance, check_stamp, content_key, floats, point, Rejection
from .diver import FARTHEST_FIX


def plane_covariance(value: Any) -> FloatArray:
    """Read-only (2, 2)."""
    return floats(value, 2, 2)


@frozen(eq=False, kw_only=True)
class Start:
    """A target to begin a track at.

    position: (3,) x, y, z in `frame_id`, the frame of the tracks, m; z is not used by a tracker of
    two dimensions. covariance: (2, 2) of x and y, m^2; there is no start without one.
    """

    stamp_ns: int
    position: FloatArray = field(converter=point)
    covariance: FloatArray = field(converter=plane_covariance)
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.position[:2]).all():
            raise Rejection('nan', 'the start has a position that is not finite')
        if np.abs(self.position[:2]).max() > FARTHEST_FIX:
            raise Rejection(
                'out_of_range',
                f'the start lies at {self.position[:2]}, further than 100,000 km from the origin',
            )
        check_covariance(self.covariance, 'a start')

    def key(self) -> bytes:
        """See `content_key`."""
        return content_key('start', self.position, self.covariance)
