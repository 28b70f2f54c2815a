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

"""Parameters of the obstacle tracker, each with its unit, range and meaning."""

from __future__ import annotations

from functools import partial

from attrs import frozen

from ...acoustics.geometry import AZIMUTH_MODELS
from ...measurements import BEAM_AXES
from ...parameters import inherited, parameter
from ..shared_parameters import (
    DetectionParameters,
    MountingParameters,
    StreamParameters,
    TrackLifeParameters,
)

live = partial(parameter, read_only=False)

METHODS = ('gaussian_sum', 'seafloor', 'landmark')
BEHAVIOURS = ('fixed', 'swaying', 'moving', 'seabed')


@frozen(kw_only=True)
class ObstacleConfig(
    DetectionParameters, TrackLifeParameters, MountingParameters, StreamParameters
):
    """Everything the obstacle tracker can be told. The defaults fit a Blueview P450 on a survey
    AUV."""

    method: str = parameter(
        'gaussian_sum',
        'how the vertical offset is treated: estimated by a Gaussian sum over depth slices, '
        'assumed on the sea floor (the paper), or estimated by one filter in world coordinates',
        choices=METHODS,
    )
    components: int = parameter(9, 'depth slices of gaussian_sum', low=1, high=201)

    # -- what an obstacle may do, gaussian_sum only ----------------------------------------------
    behaviours: tuple[str, ...] = parameter(
        BEHAVIOURS,
        'what gaussian_sum holds possible of an obstacle: fixed, swaying on its mooring, moving, '
        'lying on the sea floor; the last is left out while no altitude is known, and needs '
        'another beside it',
        choices=BEHAVIOURS,
    )
    sway_std: float = parameter(
        0.5, 'swaying: standard deviation along each axis', unit='m', low=0.001, high=100.0
    )
    sway_time: float = parameter(
        20.0, 'swaying: time over which it forgets where it was', unit='s', low=0.1, high=3600.0
    )
    max_speed: float = parameter(
        1.5,
        'moving: twice the standard deviation of the velocity along each axis before anything is '
        'known of it',
        unit='m/s',
        low=0.01,
        high=50.0,
    )
    speed_noise: float = parameter(
        0.05, 'moving: random walk of the velocity', unit='m/s/sqrt(s)', low=0.0, high=10.0
    )
    behaviour_time: float = parameter(
        1000.0,
        'mean time for which an obstacle keeps its behaviour',
        unit='s',
        low=1.0,
        high=1e6,
    )
    seabed_std: float = parameter(
        1.0,
        'seabed: error of the depth of the sea floor at the obstacle, against below the vehicle',
        unit='m',
        low=0.01,
        high=100.0,
    )

    # -- where the sonar sits and how things are written -----------------------------------------
    sonar_lever: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        'from the navigation reference to the sonar, x forward, y port, z up (vehicle FLU)',
        unit='m',
        low=-100.0,
        high=100.0,
    )
    sonar_mount_rpy_deg: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        'roll, pitch, yaw of the sonar in the vehicle (FLU: pitch positive nose down)',
        unit='deg',
        low=-180.0,
        high=180.0,
    )
    azimuth_model: str = parameter(
        'plane',
        'what a bearing is: of the vertical plane of the echo, or of the cone a linear array '
        'measures',
        choices=AZIMUTH_MODELS,
    )
    bearing_positive: str = parameter(
        'port',
        'side to which bearings of detections count up once read as their message defines',
        choices=('port', 'starboard'),
    )
    beam_axes: str = parameter(
        'auto',
        'axes of the beam vectors of SonarRanges and sonar images: marine (z forward, y to '
        'starboard, as their definition says), rep103 (x forward, y to port), or by which of the '
        'two the beams point along',
        choices=BEAM_AXES,
    )
    nav_twist_frame: str = parameter(
        'child',
        'axes of the twist of the navigation: those of the vehicle, as Odometry defines it, or '
        'those of the world',
        choices=('child', 'world'),
    )
    ping_timing: str = parameter(
        'instant',
        'instant: an echo belongs to the pose at its stamp; two_way: bearing belongs to the pose '
        'when the echo arrived, range to the mean of both ways',
        choices=('instant', 'two_way'),
    )
    sound_speed: float = parameter(
        1500.0,
        'speed of sound: for two_way, and for travel times that come without one',
        unit='m/s',
        low=1300.0,
        high=1700.0,
    )
    depth_is_absolute: bool = parameter(
        True, "the navigation's vertical is zero at the sea surface: nothing lies higher than that"
    )

    # -- what the sonar measures -----------------------------------------------------------------
    range_std: float = live(
        0.15, 'error of a range that comes without variance', unit='m', low=1e-6, high=100.0
    )
    bearing_std_deg: float = live(
        0.25, 'error of a bearing that comes without variance', unit='deg', low=1e-6, high=45.0
    )
    range_step: float = live(
        0.17, 'sampling step of such a range, adds step^2 / 12', unit='m', low=0.0, high=100.0
    )
    bearing_step_deg: float = live(
        0.18, 'sampling step of such a bearing, adds step^2 / 12', unit='deg', low=0.0, high=45.0
    )
    max_range: float = parameter(
        100.0, 'range to which the sonar sees', unit='m', low=1.0, high=10000.0
    )
    horizontal_fov_deg: float = parameter(
        45.0, 'full width of the sector', unit='deg', low=1.0, high=170.0
    )
    vertical_fov_deg: float = parameter(
        15.0, 'full height of the beam', unit='deg', low=0.5, high=90.0
    )
    vertical_beam_width_deg: float = parameter(
        0.0,
        'the intensity of detections tells the elevation by a beam this high (-3 dB, one way); 0: '
        'it is not used. Worth it where the sonar tilts by degrees and the width is known to a '
        'tenth; gaussian_sum only',
        unit='deg',
        low=0.0,
        high=90.0,
    )
    fading_db: float = live(
        6.4, 'by which echoes fade from ping to ping', unit='dB', low=0.1, high=40.0
    )
    intensity_weight: float = live(
        0.5,
        'power to which the likelihood of an intensity is raised: fading lasts, patterns are not '
        'known well',
        low=0.0,
        high=1.0,
    )
    gate_probability: float = inherited(DetectionParameters, 'gate_probability', 0.9995)
    clutter_density: float = inherited(
        DetectionParameters,
        'clutter_density',
        0.05,
        description='false detections of a ping for each metre of range and radian of bearing',
        unit='1/(m rad)',
        low=1e-9,
    )
    outlier_probability: float = live(
        0.02, 'that a detection inside the gate is not the obstacle', low=0.0, high=0.5
    )
    # -- what is believed of depth and navigation ------------------------------------------------
    max_offset: float = parameter(
        0.0,
        'largest vertical offset believed of a new obstacle; 0: what beam, surface and altitude '
        'allow',
        unit='m',
        low=0.0,
        high=1000.0,
    )
    altitude_std: float = live(
        0.1, 'error of an altitude that comes without variance', unit='m', low=1e-6, high=100.0
    )
    max_altitude_age: float = live(
        5.0, 'age to which an altitude is used', unit='s', low=0.0, high=3600.0
    )
    scale_std: float = parameter(
        0.003,
        "scale error of the navigation's horizontal distances against sonar ranges",
        low=0.0,
        high=0.2,
    )
    range_scale_std: float = live(
        0.001,
        'scale error of ranges, from the speed of sound that the sonar believes in: no ping tells '
        'it, so it is added to the covariance of range, offset and place',
        low=0.0,
        high=0.2,
    )
    position_noise: float = parameter(
        0.01, 'random walk of the horizontal position', unit='m/sqrt(s)', low=0.0, high=10.0
    )
    yaw_noise_deg: float = parameter(
        0.02, 'random walk of the yaw', unit='deg/sqrt(s)', low=0.0, high=10.0
    )
    depth_noise: float = parameter(
        0.01, 'random walk of the depth', unit='m/sqrt(s)', low=0.0, high=10.0
    )

    # -- avoidance -------------------------------------------------------------------------------
    safety_radius: float = live(
        3.0, 'collision: nearer than this horizontally', unit='m', low=0.01, high=1000.0
    )
    safety_height: float = live(
        2.0, 'collision: and less than this above or below', unit='m', low=0.01, high=1000.0
    )
    cpa_horizon: float = live(
        120.0, 'time ahead that is looked at', unit='s', low=1.0, high=3600.0
    )
    course_window: float = parameter(
        10.0,
        'time over which positions of the vehicle make its course',
        unit='s',
        low=1.0,
        high=600.0,
    )
    course_std: float = live(
        0.05, 'error of the velocity along the course, each axis', unit='m/s', low=0.0, high=5.0
    )

    # -- tracks ----------------------------------------------------------------------------------
    max_tracks: int = inherited(TrackLifeParameters, 'max_tracks', 40)
    confirm_hits: int = inherited(TrackLifeParameters, 'confirm_hits', 4)
    confirm_window: int = inherited(TrackLifeParameters, 'confirm_window', 6)
    delete_misses: int = inherited(TrackLifeParameters, 'delete_misses', 10)

    # -- time ------------------------------------------------------------------------------------
    max_navigation_gap: float = parameter(
        1.0,
        'longest time between two poses that is interpolated; pings in longer gaps are skipped',
        unit='s',
        low=0.001,
        high=3600.0,
    )
    max_extrapolation: float = parameter(
        0.0,
        'time by which a ping may be newer than the newest pose and still be used at once; 0: it '
        'waits for the next pose',
        unit='s',
        low=0.0,
        high=10.0,
    )
    history: float = inherited(StreamParameters, 'history', 5.0)
    max_gap: float = inherited(StreamParameters, 'max_gap', 600.0)
    seed: int = parameter(0, 'of random numbers; this tracker draws none', low=0, high=2**31 - 1)

    def check(self) -> list[str]:
        problems = super().check()
        problems += [
            f'{name} needs three values, got {len(getattr(self, name))}'
            for name in ('sonar_lever', 'sonar_mount_rpy_deg')
            if len(getattr(self, name)) != 3
        ]
        if self.vertical_beam_width_deg and self.method != 'gaussian_sum':
            problems.append('vertical_beam_width_deg needs the method gaussian_sum')
        if not set(self.behaviours) & set(BEHAVIOURS[:3]):
            problems.append('behaviours needs one of fixed, swaying, moving at least')
        if len(set(self.behaviours)) < len(self.behaviours):
            problems.append('behaviours names one of them twice')
        return problems
