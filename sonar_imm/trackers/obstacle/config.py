# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters of the obstacle tracker, each with its unit, range and meaning."""

from __future__ import annotations

from itertools import pairwise
import math

from attrs import frozen
import numpy as np

from ...acoustics.geometry import AZIMUTH_MODELS
from ...estimation.arrays import FloatArray
from ...measurements import BEAM_AXES
from ...parameters import constant, inherited, live, MODELS, parameter
from ..own_models import obstacle_behaviour
from ..shared_parameters import (
    DetectionParameters,
    MountingParameters,
    StreamParameters,
    TrackLifeParameters,
)

BEHAVIOURS = ('fixed', 'swaying', 'moving', 'seabed')
MISSES = ('ignored', 'evidence')
GRADES = {
    'ins': (0.01, 0.02, 0.01),
    'dvl': (0.05, 0.05, 0.01),
    'dead_reckoning': (0.3, 0.1, 0.02),
}
"""Random walks of the errors of navigation: horizontal position m/sqrt(s), yaw deg/sqrt(s), depth
m/sqrt(s). Of a compass what wanders within a minute."""
WALKS = np.array([0.0, 0.004, 0.025, 0.025, 0.02])
"""Random walks of scale, yaw, drift (twice) and lateness of the navigation, over sqrt(s), as
shares of their standard deviations."""
LEAST_DETECTION = 1e-3
"""An echo is never quite impossible."""


@frozen(kw_only=True)
class ObstacleConfig(
    DetectionParameters, TrackLifeParameters, MountingParameters, StreamParameters
):
    """All parameters of the obstacle tracker. The defaults fit a Blueview P450 on a survey
    AUV."""

    # fmt: off
    components: int = constant(9, '', 'number of depth slices', range=(1, 201))

    # -- what an obstacle may do -----------------------------------------------------------------
    behaviours: tuple[str, ...] = parameter(BEHAVIOURS, '',
        'behaviours considered: fixed, swaying (on a mooring), moving, seabed (on the sea floor; '
        'needs an altitude, and another behaviour beside it), and those that other packages '
        'register',
        choices=BEHAVIOURS, group=MODELS)
    sway_std: float = parameter(0.5, 'm',
        'behaviour swaying: standard deviation of the position along each axis; twice as much '
        'with a tenth of the prior probability',
        range=(0.001, 100.0))
    sway_time: float = constant(20.0, 's',
        'behaviour swaying: time over which the position is correlated', range=(0.1, 3600.0))
    max_speed: float = parameter(1.5, 'm/s',
        'behaviour moving: twice the prior standard deviation of the velocity along each axis',
        range=(0.01, 50.0))
    speed_noise: float = constant(0.05, 'm/s/sqrt(s)',
        'behaviour moving: random walk of the velocity; slow ones change less', range=(0.0, 10.0))
    behaviour_time: float = constant(1000.0, 's',
        'mean time for which an obstacle keeps its behaviour', range=(1.0, 1e6))
    seabed_std: float = constant(1.0, 'm',
        'behaviour seabed: standard deviation of the depth of the sea floor at the obstacle, '
        'relative to that below the vehicle', range=(0.01, 100.0))

    ground_std: float = constant(0.5, 'm',
        'behaviour seabed: standard deviation of the depth of an obstacle, relative to the '
        'soundings of ground around it', range=(0.01, 100.0))
    ground_radius: float = constant(5.0, 'm',
        'distance to which soundings of ground tell the depth of the sea floor at an obstacle',
        range=(0.5, 1000.0))

    # -- where the sonar sits and how things are written -----------------------------------------
    sonar_lever: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'm',
        'vector from the navigation reference to the sonar: x forward, y port, z up (vehicle FLU)',
        range=(-100.0, 100.0))
    sonar_mount_rpy_deg: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'deg',
        'roll, pitch, yaw of the sonar in the vehicle (FLU: pitch positive nose down)',
        range=(-180.0, 180.0))
    azimuth_model: str = parameter('plane', '',
        'bearing: angle of the vertical plane of the echo (plane), or of the cone that a linear '
        'array measures (cone)', choices=AZIMUTH_MODELS)
    bearing_positive: str = parameter('port', '',
        'side to which bearings count up, once read as their message defines',
        choices=('port', 'starboard'))
    beam_axes: str = parameter('auto', '',
        'axes of the beam vectors of SonarRanges and images: marine (z forward, y to starboard), '
        'rep103 (x forward, y to port), or the one along which they point (auto)',
        choices=BEAM_AXES)
    nav_twist_frame: str = parameter('child', '',
        'axes of the twist of nav: vehicle (child, as Odometry defines it) or world',
        choices=('child', 'world'))
    ping_timing: str = parameter('instant', '',
        'pose of an echo: instant (at its stamp) or two_way (bearing: when the echo arrived; '
        'range: mean of both ways)',
        choices=('instant', 'two_way'))
    sound_speed: float = parameter(1500.0, 'm/s',
        'speed of sound for ping_timing two_way, and for travel times without one',
        range=(1300.0, 1700.0))
    depth_is_absolute: bool = parameter(True, '',
        'z of nav is zero at the sea surface: no obstacle lies above z = 0')

    # -- what the sonar measures -----------------------------------------------------------------
    range_std: float = live(0.15782, 'm',
        'standard deviation of a range that comes without variance', range=(1e-6, 100.0))
    bearing_std_deg: float = live(0.25534, 'deg',
        'standard deviation of a bearing that comes without variance', range=(1e-6, 45.0))
    elevation_std_deg: float = live(1.0, 'deg',
        'standard deviation of an elevation that comes without variance', range=(0.01, 45.0))
    max_range: float = parameter(100.0, 'm', 'range to which the sonar sees', range=(1.0, 10000.0))
    horizontal_fov_deg: float = parameter(45.0, 'deg',
        'full width of the sector that the sonar sees', range=(1.0, 170.0))
    vertical_fov_deg: float = parameter(15.0, 'deg',
        'full height of the beam of the sonar', range=(0.5, 90.0))
    variance_scale_min: float = live(0.1, '',
        'least factor of the variances of detections, learnt from echoes of obstacles; 1 in '
        'both: as stated', range=(1e-3, 1.0))
    variance_scale_max: float = live(30.0, '',
        'largest factor of the variances of detections',
        range=(1.0, 1e4))
    gate_probability: float = inherited(
        DetectionParameters, 'gate_probability', 0.9995, constant=True)
    clutter_density: float = inherited(DetectionParameters, 'clutter_density', 0.0,
        description='false detections expected in a ping, per metre of range and radian of '
        'bearing; 0: learnt for each place', unit='1/(m rad)', range=(0.0, 1e4))
    birth_rate: float = live(0.02, '1/s',
        'new obstacles expected in the sector in a second', range=(1e-9, 1e3))
    detection_profile: tuple[float, ...] = live((), 'm, 1',
        'pairs of a range and the share of detection_probability there, ranges rising, linear '
        'between; empty: the same at every range', range=(0.0, 1e5), kind='float[]')
    misses: str = parameter('ignored', '',
        'effect of pings without an echo on the height: none (ignored), or the obstacle is less '
        'probable in the beam (evidence)', choices=MISSES)
    # -- what is believed of depth and navigation ------------------------------------------------
    max_offset: float = constant(0.0, 'm',
        'largest vertical offset of a new obstacle; 0: what beam, surface and altitude allow',
        range=(0.0, 1000.0))
    altitude_std: float = constant(0.1, 'm',
        'standard deviation of an altitude that comes without variance', range=(1e-6, 100.0))
    max_altitude_age: float = constant(5.0, 's',
        'age up to which an altitude is used', range=(0.0, 3600.0))
    scale_std: float = constant(0.003, '',
        'standard deviation of the scale error of the horizontal distances of nav against sonar '
        'ranges', range=(0.0, 0.2))
    drift_std: float = parameter(0.02, 'm/s',
        'standard deviation of the drift velocity of nav on each axis; 0: none, 0.003 for a good '
        'inertial system', range=(0.0, 10.0))
    yaw_error_std_deg: float = parameter(0.5, 'deg',
        'standard deviation of the angle between heading of nav and sonar; 0: none, 0.1 for a '
        'good inertial system', range=(0.0, 45.0))
    navigation_delay_std: float = parameter(0.15, 's',
        'standard deviation of the lateness of the poses of nav; 0: none, 0.01 for a good '
        'inertial system', range=(0.0, 10.0))
    navigation_good_probability: float = live(0.5, '',
        'prior probability that nav is as good as an inertial system, not as drift_std, '
        'yaw_error_std_deg and navigation_delay_std allow; 0: these hold', range=(0.0, 1.0))
    range_scale_std: float = live(0.001, '',
        'standard deviation of the scale error of ranges (sound speed that the sonar assumes), '
        'part of every covariance', range=(0.0, 0.2))
    navigation_grade: str = parameter('ins', '',
        'growth of the error of nav in a minute: ins (inertial with DVL: 0.08 m, 0.15 deg), dvl '
        '(DVL and compass: 0.4 m, 0.4 deg) or dead_reckoning (water speed and compass: 2.3 m, '
        '0.8 deg)', choices=tuple(GRADES))
    navigation_noise: tuple[float, ...] = constant((), 'm/sqrt(s), deg/sqrt(s), m/sqrt(s)',
        'random walks of horizontal position, yaw and depth; empty: as of navigation_grade',
        range=(0.0, 10.0), kind='float[]')

    # -- avoidance -------------------------------------------------------------------------------
    safety_radius: float = live(3.0, 'm',
        'collision: an obstacle passed nearer than this horizontally and within safety_height '
        'vertically', range=(0.01, 1000.0))
    safety_height: float = live(2.0, 'm',
        'collision: an obstacle passed less than this above or below and within safety_radius',
        range=(0.01, 1000.0))
    cpa_horizon: float = live(120.0, 's',
        'time ahead for which collisions are predicted', range=(1.0, 3600.0))
    course_window: float = constant(10.0, 's',
        'length of the latest positions of the vehicle from which its course is estimated',
        range=(1.0, 600.0))
    course_std: float = live(0.035, 'm/s',
        'standard deviation of the velocity of the vehicle along its course, on each axis; 0.034 '
        'for a sway of 0.14 m within 20 s', range=(0.0, 5.0))

    # -- tracks ----------------------------------------------------------------------------------
    max_tracks: int = inherited(TrackLifeParameters, 'max_tracks', 40)
    confirm_hits: int = inherited(TrackLifeParameters, 'confirm_hits', 3,
        description='expected number of hits that confirm a track, together with '
        'confirm_existence')
    confirm_existence: float = live(0.95, '',
        'probability of being an obstacle that confirms a track, together with confirm_hits',
        range=(0.5, 0.9999))

    # -- memory ----------------------------------------------------------------------------------
    max_landmarks: int = live(200, '',
        'largest number of obstacles remembered out of view, the oldest and least certain going '
        'first; 0: none',
        range=(0, 10000))
    landmark_time: float = constant(86400.0, 's',
        'mean time for which an obstacle that nobody sees stays where it was',
        range=(1.0, 1e8))

    # -- time ------------------------------------------------------------------------------------
    max_navigation_gap: float = constant(1.0, 's',
        'longest time between two poses of nav that is interpolated; pings in longer gaps are '
        'skipped', range=(0.001, 3600.0))
    max_extrapolation: float = parameter(0.0, 's',
        'time by which a ping may be newer than the newest pose and still be used at once; 0: it '
        'waits', range=(0.0, 10.0))
    history: float = inherited(StreamParameters, 'history', 5.0)
    max_gap: float = inherited(StreamParameters, 'max_gap', 600.0)
    # fmt: on

    def check(self) -> list[str]:
        problems = super().check()
        problems += [
            f'{name} needs three values, got {len(getattr(self, name))}'
            for name in ('sonar_lever', 'sonar_mount_rpy_deg')
            if len(getattr(self, name)) != 3
        ]
        for name in self.own_behaviours():
            obstacle_behaviour(name, self)
        if set(self.behaviours) <= {'seabed'}:
            problems.append('behaviours needs one of fixed, swaying, moving at least')
        if len(self.detection_profile) % 2:
            problems.append('detection_profile needs pairs of a range and a share')
        if any(a >= b for a, b in pairwise(self.detection_profile[::2])):
            problems.append('detection_profile: ranges have to rise')
        if any(share > 1.0 for share in self.detection_profile[1::2]):
            problems.append('detection_profile: shares must be between 0 and 1')
        if len(self.navigation_noise) not in (0, 3):
            problems.append('navigation_noise needs three values')
        if len(set(self.behaviours)) < len(self.behaviours):
            problems.append('behaviours names one of them twice')
        return problems

    def own_behaviours(self) -> tuple[str, ...]:
        """The behaviours that other packages bring."""
        return tuple(sorted(set(self.behaviours) - set(BEHAVIOURS)))

    def drift(self) -> tuple[float, float, float]:
        """Return the random walks of horizontal position, yaw (rad) and depth, over sqrt(s)."""
        position, yaw_deg, depth = self.navigation_noise or GRADES[self.navigation_grade]
        return position, math.radians(yaw_deg), depth

    def navigation_errors(self) -> tuple[FloatArray, FloatArray]:
        """Return standard deviations and random walks, over sqrt(s), of the five errors of the
        navigation that all obstacles share (`navigation_errors`)."""
        yaw = math.radians(self.yaw_error_std_deg)
        drift, delay = self.drift_std, self.navigation_delay_std
        std = np.array([self.scale_std, yaw, drift, drift, delay])
        return std, std * WALKS

    def detection_at(self, distance: FloatArray) -> FloatArray:
        """Return the probability that a ping shows obstacles at ranges (T,) in the beam."""
        if not self.detection_profile:
            return np.full(len(distance), self.detection_probability)
        factor = np.interp(distance, self.detection_profile[::2], self.detection_profile[1::2])
        return np.clip(self.detection_probability * factor, LEAST_DETECTION, 1.0)
