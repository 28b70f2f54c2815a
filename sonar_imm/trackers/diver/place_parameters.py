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

"""Parameters of positions that are not metres in the frame of the tracks: latitude and longitude,
or relative to a transceiver on a vessel."""

from __future__ import annotations

from attrs import frozen

from ...acoustics.geodesy import Origin
from ...parameters import Config, parameter

VESSELS = ('moving', 'fixed')
RELATIVE_AXES = ('flu', 'frd', 'enu', 'ned')


@frozen(kw_only=True, slots=False)
class PlaceParameters(Config):
    """Where the frame of the tracks lies on Earth, and how the vessel's transceiver sits."""

    # -- latitude and longitude ------------------------------------------------------------------
    origin_latitude: float = parameter(
        0.0,
        'latitude of the origin of the frame of the tracks; latitude and longitude 0: the first '
        'position given in latitude and longitude',
        unit='deg',
        low=-90.0,
        high=90.0,
    )
    origin_longitude: float = parameter(
        0.0, 'longitude of that origin', unit='deg', low=-360.0, high=360.0
    )
    origin_height: float = parameter(
        0.0, 'its height above the ellipsoid', unit='m', low=-12000.0, high=12000.0
    )
    map_frame: str = parameter(
        'map', 'name of the frame of what is placed by latitude and longitude'
    )

    # -- relative to a transceiver ---------------------------------------------------------------
    vessel: str = parameter(
        'moving',
        'what carries the transceiver of relative fixes: moving (its pose comes by nav, or by '
        'nav_fix and heading), fixed (it lies at the origin, x east; transceiver_lever says where '
        'the transceiver is)',
        choices=VESSELS,
    )
    transceiver_lever: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        'from the reference of nav, or the antenna of nav_fix, to the transceiver: x forward, y '
        'port, z up',
        unit='m',
        low=-1e4,
        high=1e4,
    )
    transceiver_lever_std: float = parameter(
        0.0, 'standard deviation of that on each axis', unit='m', low=0.0, high=100.0
    )
    transceiver_mount_rpy_deg: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        'roll, pitch, yaw of the transceiver on the vessel (forward, port, up: pitch positive '
        'nose down)',
        unit='deg',
        low=-180.0,
        high=180.0,
    )
    relative_axes: str = parameter(
        'flu',
        'axes of relative fixes whose message does not say: flu (forward, port, up of the '
        'transceiver), frd (forward, starboard, down), enu or ned (of the world, by its own '
        'compass)',
        choices=RELATIVE_AXES,
    )
    relative_range_std: float = parameter(
        0.5,
        'standard deviation of the range of a relative fix that comes without covariance',
        unit='m',
        low=1e-4,
        high=1e4,
        read_only=False,
    )
    relative_angle_std_deg: float = parameter(
        2.0,
        'standard deviation of the direction of a relative fix that comes without covariance, '
        'each way',
        unit='deg',
        low=1e-3,
        high=45.0,
        read_only=False,
    )
    vessel_position_std: float = parameter(
        1.0,
        "standard deviation on each axis of the vessel's position where its message states none",
        unit='m',
        low=0.0,
        high=1e4,
        read_only=False,
    )
    vessel_heading_std_deg: float = parameter(
        1.0,
        "standard deviation of the vessel's heading where its message states none",
        unit='deg',
        low=0.0,
        high=45.0,
        read_only=False,
    )
    vessel_attitude_std_deg: float = parameter(
        0.5,
        "standard deviation of the vessel's roll and pitch where its message states none",
        unit='deg',
        low=0.0,
        high=45.0,
        read_only=False,
    )
    vessel_max_gap: float = parameter(
        2.0,
        'longest time between two poses of the vessel over which is interpolated; relative fixes '
        'in a longer gap are left out and counted',
        unit='s',
        low=0.01,
        high=600.0,
    )
    vessel_max_extrapolation: float = parameter(
        0.0,
        'a relative fix is used when it is no further than this beyond the newest pose of the '
        'vessel, else it waits for the next one',
        unit='s',
        low=0.0,
        high=60.0,
    )

    def check(self) -> list[str]:
        problems = super().check()
        for name in ('transceiver_lever', 'transceiver_mount_rpy_deg'):
            if len(getattr(self, name)) != 3:
                problems.append(f'{name} needs three values, got {len(getattr(self, name))}')
        return problems

    def origin(self) -> Origin | None:
        """The origin that is stated, None for none."""
        if self.origin_latitude == 0.0 and self.origin_longitude == 0.0:
            return None
        return Origin(self.origin_latitude, self.origin_longitude, self.origin_height)
