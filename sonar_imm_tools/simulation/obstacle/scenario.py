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

"""Parameters of the obstacle scenes, and the named scenarios."""

from __future__ import annotations

from typing import Any

from attrs import frozen

from sonar_imm.acoustics.geometry import AZIMUTH_MODELS
from sonar_imm.parameters import parameter

from .image_scenario import ImageScenario

PLACEMENTS = ('offset', 'tether', 'seabed', 'surface')
MOTIONS = ('fixed', 'swaying', 'swinging', 'moving')


@frozen(kw_only=True)
class ObstacleScenario(ImageScenario):
    """Parameters of an obstacle scene; the defaults are the first case of docs/obstacle.md."""

    INSTRUMENT = (
        'sonar_lever',
        'sonar_mount_rpy_deg',
        'azimuth_model',
        'ping_timing',
        'max_range',
        'horizontal_fov_deg',
        'vertical_fov_deg',
    )

    # -- the vehicle -----------------------------------------------------------------------------
    speed: float = parameter(1.5, 'over ground', unit='m/s', low=0.05, high=20.0)
    course_deg: float = parameter(30.0, 'from north, clockwise', unit='deg')
    random_course: bool = parameter(False, 'draw the course at random instead')
    depth: float = parameter(20.0, 'of the vehicle', unit='m', low=0.0, high=12000.0)
    altitude: float = parameter(
        15.0, 'of the vehicle above the sea floor', unit='m', low=0.5, high=12000.0
    )
    seabed_relief: float = parameter(
        0.0, 'amplitude of ripples of the sea floor', unit='m', low=0.0, high=100.0
    )
    dive: float = parameter(
        0.0, 'the vehicle goes up and down by this once per minute', unit='m', low=0.0, high=100.0
    )
    roll_rms_deg: float = parameter(1.5, 'swing in roll', unit='deg', low=0.0, high=30.0)
    roll_period: float = parameter(6.0, 'its period', unit='s', low=0.5, high=600.0)
    pitch_rms_deg: float = parameter(1.0, 'swing in pitch', unit='deg', low=0.0, high=30.0)
    pitch_period: float = parameter(8.0, 'its period', unit='s', low=0.5, high=600.0)
    yaw_rms_deg: float = parameter(1.5, 'swing in yaw', unit='deg', low=0.0, high=30.0)
    yaw_period: float = parameter(11.0, 'its period', unit='s', low=0.5, high=600.0)
    heave_rms: float = parameter(0.21, 'swing of the depth', unit='m', low=0.0, high=20.0)
    heave_period: float = parameter(20.0, 'its period', unit='s', low=0.5, high=600.0)
    sway_rms: float = parameter(0.14, 'swing across the course', unit='m', low=0.0, high=20.0)
    sway_period: float = parameter(20.0, 'its period', unit='s', low=0.5, high=600.0)

    # -- navigation ------------------------------------------------------------------------------
    ideal_navigation: bool = parameter(False, 'navigation without errors')
    navigation_rate: float = parameter(10.0, 'poses per second', unit='Hz', low=0.1, high=1000.0)
    log_scale_error: float = parameter(
        0.002, 'scale error of the Doppler log, 1 sigma', low=0.0, high=0.2
    )
    log_bias: float = parameter(
        0.003, 'bias of each axis of the log, 1 sigma', unit='m/s', low=0.0, high=1.0
    )
    log_noise: float = parameter(
        0.005,
        'random walk of the position that the noise of the log makes',
        unit='m/sqrt(s)',
        low=0.0,
        high=1.0,
    )
    attitude_std_deg: float = parameter(
        0.02, 'noise of roll, pitch and yaw', unit='deg', low=0.0, high=10.0
    )
    attitude_bias_deg: float = parameter(
        0.1, 'bias of roll and pitch, 1 sigma', unit='deg', low=0.0, high=10.0
    )
    yaw_bias_deg: float = parameter(0.2, 'bias of yaw, 1 sigma', unit='deg', low=0.0, high=20.0)
    depth_std: float = parameter(0.02, 'noise of the depth', unit='m', low=0.0, high=10.0)
    altimeter: bool = parameter(True, 'altitudes are sent')
    altitude_std: float = parameter(0.1, 'noise of the altitude', unit='m', low=0.0, high=10.0)
    navigation_delay: float = parameter(
        0.0, 'poses are stamped this much too late', unit='s', low=-5.0, high=5.0
    )
    navigation_latency: float = parameter(
        0.0, 'poses are received this long after their stamp', unit='s', low=0.0, high=60.0
    )
    navigation_gaps: float = parameter(
        0.0, 'number of gaps in the navigation, on average', low=0.0, high=1000.0
    )
    navigation_gap: float = parameter(3.0, 'length of a gap', unit='s', low=0.0, high=600.0)

    # -- the sonar -------------------------------------------------------------------------------
    sonar_lever: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), 'from the navigation reference to the sonar, vehicle FLU', unit='m'
    )
    sonar_mount_rpy_deg: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), 'roll, pitch, yaw of the sonar in the vehicle, FLU', unit='deg'
    )
    azimuth_model: str = parameter('plane', 'what a bearing is', choices=AZIMUTH_MODELS)
    ping_timing: str = parameter(
        'instant', 'to which pose an echo belongs', choices=('instant', 'two_way')
    )
    ping_rate: float = parameter(2.0, 'pings per second', unit='Hz', low=0.05, high=50.0)
    ping_jitter: float = parameter(
        0.0, 'ping times vary uniformly by this much of a step', low=0.0, high=0.9
    )
    ping_loss: float = parameter(0.0, 'that a ping is lost', low=0.0, high=1.0)
    max_range: float = parameter(
        100.0, 'range to which the sonar sees', unit='m', low=1.0, high=10000.0
    )
    horizontal_fov_deg: float = parameter(
        45.0, 'full width of the sector', unit='deg', low=1.0, high=170.0
    )
    vertical_fov_deg: float = parameter(
        15.0, 'full height of the beam', unit='deg', low=0.5, high=90.0
    )
    range_std: float = parameter(0.15, 'error of a range', unit='m', low=0.0, high=10.0)
    bearing_std_deg: float = parameter(0.25, 'error of a bearing', unit='deg', low=0.0, high=10.0)
    range_step: float = parameter(0.17, 'sampling step of the range', unit='m', low=0.0, high=10.0)
    bearing_step_deg: float = parameter(
        0.18, 'sampling step of the bearing', unit='deg', low=0.0, high=10.0
    )
    sound_speed_error: float = parameter(
        0.001, 'scale error of the ranges, 1 sigma', low=0.0, high=0.2
    )
    detection_probability: float = parameter(
        1.0, 'that a ping shows an obstacle in the beam', low=0.0, high=1.0
    )
    outlier_probability: float = parameter(
        0.0, 'that an echo comes from elsewhere', low=0.0, high=1.0
    )
    outlier_range: float = parameter(8.0, 'by how much at most', unit='m', low=0.0, high=100.0)
    outlier_bearing_deg: float = parameter(
        6.0, 'by how much at most', unit='deg', low=0.0, high=90.0
    )
    clutter: float = parameter(0.0, 'false detections per ping, on average', low=0.0, high=1000.0)
    late_fraction: float = parameter(0.0, 'share of pings received late', low=0.0, high=1.0)
    late_delay: float = parameter(2.0, 'most they are late by', unit='s', low=0.0, high=600.0)

    # -- obstacles -------------------------------------------------------------------------------
    placement: str = parameter(
        'offset',
        'how deep they are: a vertical offset from the sonar at the first ping, on tethers, on '
        'the sea floor, at the surface',
        choices=PLACEMENTS,
    )
    obstacles: int = parameter(1, 'number of obstacles', low=1, high=200)
    spacing: float = parameter(
        8.0, 'each further off than the one before by this', unit='m', low=0.0, high=1000.0
    )
    vertical_offset: float = parameter(3.0, 'below the sonar', unit='m', low=-100.0, high=100.0)
    offset_spread: float = parameter(
        0.0, 'uniformly more or less than that', unit='m', low=0.0, high=100.0
    )
    tethers: tuple[float, ...] = parameter(
        (15.0, 12.0), 'lengths of the tethers, in turn', unit='m', low=0.0
    )
    first_range: float = parameter(
        90.0, 'of the first obstacle at the first ping', unit='m', low=2.0, high=10000.0
    )
    last_range: float = parameter(
        6.0,
        'of the first obstacle at the last ping, had it not passed aside',
        unit='m',
        low=-1000.0,
        high=10000.0,
    )
    passing_distance: float = parameter(
        6.0, 'obstacles are passed at up to this on either side', unit='m', low=0.0, high=100.0
    )
    obstacle_motion: str = parameter(
        'fixed',
        'whether they stay, sway about their place at random, swing about it in smooth waves, or '
        'move',
        choices=MOTIONS,
    )
    obstacle_sway: float = parameter(
        0.5, 'swaying, swinging: standard deviation along each axis', unit='m', low=0.0, high=100.0
    )
    obstacle_sway_time: float = parameter(
        20.0, 'swaying: time over which the place is forgotten', unit='s', low=0.1, high=3600.0
    )
    obstacle_swing_period: float = parameter(
        15.0, 'swinging: period of the waves', unit='s', low=0.5, high=3600.0
    )
    obstacle_speed: tuple[float, ...] = parameter(
        (0.3, 1.5), 'moving: least and greatest speed', unit='m/s', low=0.0, high=20.0
    )
    obstacle_starts: float = parameter(
        -1e9, 'moving: it stays until then, counted from the first ping', unit='s'
    )
    obstacle_stops: float = parameter(1e9, 'moving: it stays from then on', unit='s')

    def check(self) -> list[str]:
        problems = super().check()
        if len(self.obstacle_speed) != 2 or self.obstacle_speed[0] > self.obstacle_speed[-1]:
            problems.append('obstacle_speed needs two values, the least and the greatest')
        if self.images and self.ping_timing != 'instant':
            problems.append('images are made at one instant: ping_timing has to be instant')
        return problems


_LEVEL = {'roll_rms_deg': 0.0, 'pitch_rms_deg': 0.0, 'heave_rms': 0.0}
_STRESS = {
    'detection_probability': 0.7,
    'outlier_probability': 0.1,
    'ping_jitter': 0.3,
    'ping_loss': 0.05,
    'navigation_gaps': 2.0,
}
_FIELD = {
    'detection_probability': 0.9,
    'clutter': 5.0,
    'random_course': True,
    'passing_distance': 12.0,
}

SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    'approach': ('an obstacle 3 m below the sonar', {}),
    'nearly_level': ('an obstacle 0.5 m below the sonar', {'vertical_offset': 0.5}),
    'above': ('an obstacle 6 m above the sonar', {'vertical_offset': -6.0}),
    'float': (
        'a float at the surface, 6 m above the sonar',
        {'vertical_offset': -6.0, 'depth': 6.0, 'altitude': 29.0},
    ),
    'rolling': ('3 m below, and the vehicle rolls 4 degrees rms', {'roll_rms_deg': 4.0}),
    'calm': (
        'anywhere within 10 m above or below, and the vehicle moves a fifth as much as usual',
        {
            'vertical_offset': 0.0,
            'offset_spread': 10.0,
            'roll_rms_deg': 0.3,
            'pitch_rms_deg': 0.2,
            'yaw_rms_deg': 0.3,
            'heave_rms': 0.042,
            'sway_rms': 0.028,
        },
    ),
    'mirror': (
        'a level path with perfect navigation: above and below look the same',
        {
            **_LEVEL,
            'vertical_offset': 4.0,
            'ideal_navigation': True,
            'sound_speed_error': 0.0,
        },
    ),
    'diving': ('3 m below at first, while the vehicle goes up and down 2 m', {'dive': 2.0}),
    'rough_seabed': ('3 m below, over a sea floor with 0.5 m of relief', {'seabed_relief': 0.5}),
    'stress': ('3 m below: misses, outliers, jitter, lost pings, navigation gaps', _STRESS),
    'tethers': (
        'two moored spheres on tethers of 15 and 12 m, the vehicle 15.5 m above the sea floor',
        {
            'placement': 'tether',
            'altitude': 15.5,
            'obstacles': 2,
            'spacing': 12.0,
            'detection_probability': 0.9,
            'clutter': 1.0,
        },
    ),
    'seabed': (
        'objects on the sea floor, 6 m below',
        {'placement': 'seabed', 'altitude': 6.0, 'obstacles': 3, **_FIELD},
    ),
    'surface': (
        'floats at the surface, 6 m above',
        {'placement': 'surface', 'depth': 6.0, 'obstacles': 3, **_FIELD},
    ),
    'six': (
        'six obstacles at different depths, in clutter',
        {
            'obstacles': 6,
            'vertical_offset': 0.0,
            'offset_spread': 5.0,
            'first_range': 55.0,
            'last_range': 0.0,
            **_FIELD,
        },
    ),
    'swaying': (
        'an obstacle 3 m below that sways half a metre about its mooring',
        {'obstacle_motion': 'swaying'},
    ),
    'mover': ('an obstacle 3 m below that moves', {'obstacle_motion': 'moving'}),
    'movers': (
        'three obstacles that move, at different depths, in clutter',
        {
            'obstacle_motion': 'moving',
            'obstacles': 3,
            'spacing': 12.0,
            'vertical_offset': 0.0,
            'offset_spread': 5.0,
            'first_range': 70.0,
            'detection_probability': 0.9,
            'clutter': 2.0,
            'passing_distance': 12.0,
        },
    ),
    'images': (
        'an obstacle 3 m below in images of a small sonar, over a sea floor',
        {
            'images': True,
            'image_beams': 128,
            'image_bins': 330,
            'max_range': 55.0,
            'first_range': 52.0,
            'last_range': 12.0,
            'altitude': 6.0,
            'roll_rms_deg': 3.0,
            'target': 'float',
            'target_size': 0.5,
            'target_snr_db': 26.0,
        },
    ),
    'late': (
        'pings and navigation received late and out of order',
        {'late_fraction': 0.3, 'navigation_latency': 0.4, 'ping_jitter': 0.3},
    ),
}
"""Name: (what it is, what differs from the defaults of `ObstacleScenario`)."""
