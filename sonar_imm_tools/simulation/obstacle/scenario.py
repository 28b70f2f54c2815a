# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters of the obstacle scenes, and the named scenarios."""

from __future__ import annotations

from typing import Any

from attrs import frozen

from sonar_imm.acoustics.geometry import AZIMUTH_MODELS
from sonar_imm.parameters import parameter

from ..scenario import Scenario, Scenarios

PLACEMENTS = ('offset', 'tether', 'seabed', 'surface')
MOTIONS = ('fixed', 'swaying', 'swinging', 'moving')
TARGETS = ('point', 'chain', 'float', 'wreck')
FADINGS = ('steady', 'rayleigh')
LATE_DELAY = 2.0
"""Seconds, the largest delay of a ping that is received late."""
PULSE_LENGTH = 0.3
"""-3 dB width of the echo of a point in range, m."""


@frozen(kw_only=True)
class ObstacleScenario(Scenario):
    """Parameters of an obstacle scene; the defaults are the first case of docs/obstacle.md, and
    images like those of a Blueview P450 that looks at moored spheres."""

    INSTRUMENT = (
        'sonar_lever', 'sonar_mount_rpy_deg', 'azimuth_model', 'ping_timing', 'max_range',
        'horizontal_fov_deg', 'vertical_fov_deg', 'detection_profile',
    )  # fmt: skip

    # fmt: off
    # -- the vehicle -----------------------------------------------------------------------------
    speed: float = parameter(1.5, 'm/s', 'speed of the vehicle over ground', range=(0.05, 20.0))
    course_deg: float = parameter(30.0, 'deg', 'course of the vehicle, from north, clockwise')
    random_course: bool = parameter(False, '', 'draw the course at random instead of course_deg')
    depth: float = parameter(20.0, 'm', 'depth of the vehicle', range=(0.0, 12000.0))
    altitude: float = parameter(15.0, 'm',
        'height of the vehicle above the sea floor', range=(0.5, 12000.0))
    seabed_relief: float = parameter(0.0, 'm',
        'amplitude of ripples of the sea floor', range=(0.0, 100.0))
    dive: float = parameter(0.0, 'm',
        'amplitude with which the vehicle goes up and down once per minute', range=(0.0, 100.0))
    roll_rms_deg: float = parameter(1.5, 'deg', 'rms roll of the vehicle', range=(0.0, 30.0))
    pitch_rms_deg: float = parameter(1.0, 'deg', 'rms pitch of the vehicle', range=(0.0, 30.0))
    yaw_rms_deg: float = parameter(1.5, 'deg',
        'rms yaw of the vehicle about its course', range=(0.0, 30.0))
    heave_rms: float = parameter(0.21, 'm', 'rms heave of the vehicle', range=(0.0, 20.0))
    sway_rms: float = parameter(0.14, 'm',
        'rms sway of the vehicle across its course', range=(0.0, 20.0))
    sway_period: float = parameter(20.0, 's', 'period of the sway', range=(0.5, 600.0))

    # -- navigation ------------------------------------------------------------------------------
    ideal_navigation: bool = parameter(False, '', 'whether the navigation has no errors')
    navigation_rate: float = parameter(10.0, 'Hz',
        'poses of the navigation per second', range=(0.1, 1000.0))
    log_scale_error: float = parameter(0.002, '',
        'scale error of the Doppler log, 1 sigma', range=(0.0, 0.2))
    log_bias: float = parameter(0.003, 'm/s',
        'bias of each axis of the Doppler log, 1 sigma', range=(0.0, 1.0))
    log_noise: float = parameter(0.005, 'm/sqrt(s)',
        'random walk of the position from the noise of the Doppler log', range=(0.0, 1.0))
    attitude_std_deg: float = parameter(0.02, 'deg',
        'standard deviation of the noise of roll, pitch and yaw in the navigation',
        range=(0.0, 10.0))
    attitude_bias_deg: float = parameter(0.1, 'deg',
        'bias of roll and pitch in the navigation, 1 sigma', range=(0.0, 10.0))
    yaw_bias_deg: float = parameter(0.2, 'deg',
        'bias of yaw in the navigation, 1 sigma', range=(0.0, 20.0))
    depth_std: float = parameter(0.02, 'm',
        'standard deviation of the noise of the depth in the navigation', range=(0.0, 10.0))
    altimeter: bool = parameter(True, '', 'whether altitudes are sent')
    altitude_std: float = parameter(0.1, 'm',
        'standard deviation of the noise of the altitude', range=(0.0, 10.0))
    navigation_delay: float = parameter(0.0, 's',
        'time by which poses are stamped too late', range=(-5.0, 5.0))
    navigation_latency: float = parameter(0.0, 's',
        'time between the stamp of a pose and its reception', range=(0.0, 60.0))
    navigation_gaps: float = parameter(0.0, '',
        'mean number of gaps in the navigation', range=(0.0, 1000.0))
    navigation_gap: float = parameter(3.0, 's',
        'length of a gap in the navigation', range=(0.0, 600.0))

    # -- the sonar -------------------------------------------------------------------------------
    sonar_lever: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'm',
        'vector from the navigation reference to the sonar, vehicle FLU')
    sonar_mount_rpy_deg: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'deg',
        'roll, pitch, yaw of the sonar in the vehicle, FLU')
    azimuth_model: str = parameter('plane', '',
        'what a bearing is: the angle of the vertical plane of the echo (plane), or of the cone '
        'that a linear array measures (cone)', choices=AZIMUTH_MODELS)
    ping_timing: str = parameter('instant', '',
        'pose to which an echo belongs: at the instant of the ping, or over the two-way travel',
        choices=('instant', 'two_way'))
    ping_rate: float = parameter(2.0, 'Hz', 'pings per second', range=(0.05, 50.0))
    ping_jitter: float = parameter(0.0, '',
        'share of a step by which ping times vary, uniformly', range=(0.0, 0.9))
    ping_loss: float = parameter(0.0, '', 'probability that a ping is lost', range=(0.0, 1.0))
    max_range: float = parameter(100.0, 'm', 'range to which the sonar sees', range=(1.0, 10000.0))
    horizontal_fov_deg: float = parameter(45.0, 'deg',
        'full width of the sector that the sonar sees', range=(1.0, 170.0))
    vertical_fov_deg: float = parameter(15.0, 'deg',
        'full height of the beam of the sonar', range=(0.5, 90.0))
    range_std: float = parameter(0.15, 'm', 'standard deviation of a range', range=(0.0, 10.0))
    bearing_std_deg: float = parameter(0.25, 'deg',
        'standard deviation of a bearing', range=(0.0, 10.0))
    range_step: float = parameter(0.17, 'm', 'sampling step of the range', range=(0.0, 10.0))
    bearing_step_deg: float = parameter(0.18, 'deg',
        'sampling step of the bearing', range=(0.0, 10.0))
    elevation_std_deg: float = parameter(0.0, 'deg',
        'standard deviation of an elevation; 0: the sonar measures none', range=(0.0, 45.0))
    sound_speed_error: float = parameter(0.001, '',
        'scale error of the ranges, 1 sigma', range=(0.0, 0.2))
    detection_probability: float = parameter(1.0, '',
        'probability that a ping shows an obstacle in the beam', range=(0.0, 1.0))
    detection_profile: tuple[float, ...] = parameter((), 'm, 1',
        'pairs of a range and the share of detection_probability that is left there; empty: as '
        'detectable everywhere', range=(0.0, 1e5), kind='float[]')
    outlier_probability: float = parameter(0.0, '',
        'probability that an echo of an obstacle is an outlier, which comes from elsewhere',
        range=(0.0, 1.0))
    clutter: float = parameter(0.0, '',
        'mean number of false detections in a ping', range=(0.0, 1000.0))
    late_fraction: float = parameter(0.0, '', 'share of pings received late', range=(0.0, 1.0))

    # -- obstacles -------------------------------------------------------------------------------
    placement: str = parameter('offset', '',
        'what sets the depth of obstacles: a vertical offset from the sonar at the first ping '
        '(offset), a tether, the sea floor (seabed) or the surface', choices=PLACEMENTS)
    obstacles: int = parameter(1, '', 'number of obstacles', range=(1, 200))
    spacing: float = parameter(8.0, 'm',
        'distance by which each obstacle is further off than the one before', range=(0.0, 1000.0))
    vertical_offset: float = parameter(3.0, 'm',
        'placement offset: distance of obstacles below the sonar at the first ping',
        range=(-100.0, 100.0))
    offset_spread: float = parameter(0.0, 'm',
        'placement offset: half width of the uniform distribution of offsets around '
        'vertical_offset', range=(0.0, 100.0))
    tethers: tuple[float, ...] = parameter((15.0, 12.0), 'm',
        'placement tether: lengths of the tethers, in turn', range=(0.0, None))
    first_range: float = parameter(90.0, 'm',
        'range of the first obstacle at the first ping', range=(2.0, 10000.0))
    last_range: float = parameter(6.0, 'm',
        'range of the first obstacle at the last ping, as if it were passed at no distance',
        range=(-1000.0, 10000.0))
    passing_distance: float = parameter(6.0, 'm',
        'largest distance to either side at which obstacles are passed', range=(0.0, 100.0))
    obstacle_motion: str = parameter('fixed', '',
        'motion of obstacles: fixed, swaying (about their place at random), swinging (about it in '
        'smooth waves) or moving', choices=MOTIONS)
    obstacle_sway: float = parameter(0.5, 'm',
        'motion swaying and swinging: standard deviation of the position along each axis',
        range=(0.0, 100.0))
    obstacle_sway_time: float = parameter(20.0, 's',
        'motion swaying: time over which the position is correlated', range=(0.1, 3600.0))

    obstacle_speed: tuple[float, ...] = parameter((0.3, 1.5), 'm/s',
        'motion moving: least and greatest speed', range=(0.0, 20.0))
    obstacle_starts: float = parameter(-1e9, 's',
        'motion moving: time after the first ping at which obstacles start to move')
    obstacle_stops: float = parameter(1e9, 's',
        'motion moving: time after the first ping at which obstacles stop')

    # -- images ----------------------------------------------------------------------------------
    images: bool = parameter(False, '',
        'whether the sonar sends images, in which a detector has to find the obstacles')
    image_beams: int = parameter(256, '', 'number of beams of an image', range=(2, 4096))
    image_bins: int = parameter(600, '', 'number of ranges of an image', range=(2, 10_000))
    image_gain: float = parameter(4.0, '',
        'counts of an image for the amplitude of the noise; images hold 0 to 255',
        range=(0.01, 255.0))
    beam_width_deg: float = parameter(1.0, 'deg',
        '-3 dB width of a beam, of the power received', range=(0.01, 30.0))
    sidelobe_db: float = parameter(20.0, 'dB',
        'level of the sidelobes of a beam below its maximum', range=(14.0, 80.0))
    target: str = parameter('point', '',
        'what obstacles are: a point, a chain of 60 glints along a level line, a float of 10 '
        'glints, or the outline of a wreck of 80 glints', choices=TARGETS)
    target_size: float = parameter(6.0, 'm',
        'length of a chain or wreck, or diameter of a float', range=(0.0, 100.0))
    target_snr_db: float = parameter(18.0, 'dB',
        'peak power of an echo on the axis of the sonar over the mean power around it',
        range=(-20.0, 80.0))
    target_fading: str = parameter('steady', '',
        'target point: whether the echo is as strong in every ping (steady) or fades (rayleigh); '
        'glints always fade', choices=FADINGS)
    reverberation: float = parameter(30.0, '',
        'power scattered back by the water at 10 m, relative to the noise; falls with the square '
        'of the range', range=(0.0, 1e6))
    seabed_shape: float = parameter(4.0, '',
        'shape of the gamma distribution of the power of the patches of the sea floor: the '
        'smaller, the rougher', range=(0.1, 1000.0))
    seabed_patch: float = parameter(1.0, 'm',
        'side of a patch of the sea floor', range=(0.01, 1000.0))
    # fmt: on

    def feeder_instruments(self) -> dict[str, Any]:
        """What `fls_detector_node` has to know of the images."""
        if not self.images:
            return {}
        return {
            'image_near_range': 0.0,
            'image_far_range': self.max_range,
            'image_fov_deg': self.horizontal_fov_deg,
            'beam_width_deg': self.beam_width_deg,
            'range_resolution': PULSE_LENGTH,
        }

    def check(self) -> list[str]:
        problems = super().check()
        if len(self.obstacle_speed) != 2 or self.obstacle_speed[0] > self.obstacle_speed[-1]:
            problems.append('obstacle_speed needs two values, the least and the greatest')
        if self.last_range >= self.first_range:
            problems.append('last_range must be less than first_range')
        if len(self.detection_profile) % 2:
            problems.append('detection_profile needs pairs of a range and a share')
        if self.images and self.ping_timing != 'instant':
            problems.append('images are made at one instant: ping_timing has to be instant')
        return problems


_LEVEL = {'roll_rms_deg': 0.0, 'pitch_rms_deg': 0.0, 'heave_rms': 0.0}
_STRESS = {
    'detection_probability': 0.7, 'outlier_probability': 0.1, 'ping_jitter': 0.3,
    'ping_loss': 0.05, 'navigation_gaps': 2.0,
}  # fmt: skip
_FIELD = {
    'detection_probability': 0.9, 'clutter': 5.0, 'random_course': True, 'passing_distance': 12.0,
}  # fmt: skip
_IMAGES = {
    'images': True, 'image_beams': 128, 'image_bins': 330, 'max_range': 55.0, 'first_range': 52.0,
    'last_range': 12.0, 'altitude': 6.0, 'roll_rms_deg': 3.0, 'target_snr_db': 26.0,
}  # fmt: skip
_ROUGH = {'seabed_shape': 1.5}

# fmt: off
SCENARIOS: Scenarios = {
    'approach': ('an obstacle 3 m below the sonar', {}),
    'elevation': ('the same, and the sonar measures elevations to 1 degree',
        {'elevation_std_deg': 1.0}),
    'nearly_level': ('an obstacle 0.5 m below the sonar', {'vertical_offset': 0.5}),
    'above': ('an obstacle 6 m above the sonar', {'vertical_offset': -6.0}),
    'float': ('a float at the surface, 6 m above the sonar',
        {'vertical_offset': -6.0, 'depth': 6.0, 'altitude': 29.0}),
    'rolling': ('3 m below, and the vehicle rolls 4 degrees rms', {'roll_rms_deg': 4.0}),
    'calm': ('anywhere within 10 m above or below, and the vehicle moves a fifth as much as usual',
        {'vertical_offset': 0.0, 'offset_spread': 10.0, 'roll_rms_deg': 0.3, 'pitch_rms_deg': 0.2,
         'yaw_rms_deg': 0.3, 'heave_rms': 0.042, 'sway_rms': 0.028}),
    'mirror': ('a level path with perfect navigation: above and below look the same',
        {**_LEVEL, 'vertical_offset': 4.0, 'ideal_navigation': True, 'sound_speed_error': 0.0}),
    'diving': ('3 m below at first, while the vehicle goes up and down 2 m', {'dive': 2.0}),
    'rough_seabed': ('3 m below, over a sea floor with 0.5 m of relief', {'seabed_relief': 0.5}),
    'stress': ('3 m below: misses, outliers, jitter, lost pings, navigation gaps', _STRESS),
    'tethers': ('two moored spheres on tethers of 15 and 12 m, the vehicle 15.5 m above the sea '
        'floor',
        {'placement': 'tether', 'altitude': 15.5, 'obstacles': 2, 'spacing': 12.0,
         'detection_probability': 0.9, 'clutter': 1.0}),
    'seabed': ('objects on the sea floor, 6 m below',
        {'placement': 'seabed', 'altitude': 6.0, 'obstacles': 3, **_FIELD}),
    'surface': ('floats at the surface, 6 m above',
        {'placement': 'surface', 'depth': 6.0, 'obstacles': 3, **_FIELD}),
    'six': ('six obstacles at different depths, in clutter',
        {'obstacles': 6, 'vertical_offset': 0.0, 'offset_spread': 5.0, 'first_range': 55.0,
         'last_range': 0.0, **_FIELD}),
    'swaying': ('an obstacle 3 m below that sways half a metre about its mooring',
        {'obstacle_motion': 'swaying'}),
    'mover': ('an obstacle 3 m below that moves', {'obstacle_motion': 'moving'}),
    'movers': ('three obstacles that move, at different depths, in clutter',
        {'obstacle_motion': 'moving', 'obstacles': 3, 'spacing': 12.0, 'vertical_offset': 0.0,
         'offset_spread': 5.0, 'first_range': 70.0, 'detection_probability': 0.9, 'clutter': 2.0,
         'passing_distance': 12.0}),
    'images': ('an obstacle 3 m below in images of a small sonar, over a sea floor',
        {**_IMAGES, 'target': 'float', 'target_size': 0.5}),
    'rough_chain': ('a chain of 6 m in images over a rough sea floor',
        {**_IMAGES, **_ROUGH, 'target': 'chain', 'target_size': 6.0}),
    'rough_wreck': ('the outline of a wreck of 12 m in images of a rough sea floor, on which it '
        'lies',
        {**_IMAGES, **_ROUGH, 'target': 'wreck', 'target_size': 12.0, 'placement': 'seabed',
         'altitude': 2.5}),
    'late': ('pings and navigation received late and out of order',
        {'late_fraction': 0.3, 'navigation_latency': 0.4, 'ping_jitter': 0.3}),
}
# fmt: on

scenario = ObstacleScenario.among(SCENARIOS)
