# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Input topics of the obstacle tracker, and of the detector that makes detections of images."""

from __future__ import annotations

from sonar_imm.measurements import Altitude, Detections, Ground, Navigation, SonarImage, SonarInfo

from ..detections import (
    read_detections,
    read_detections_3d,
    read_laser_scan,
    read_point_cloud,
    read_pose_array,
    read_sonar_detections,
    read_sonar_ranges,
    write_detections,
)
from ..navigation import (
    doubt_navigation,
    read_dave_dvl,
    read_dvl,
    read_navigation,
    read_range,
    write_navigation,
    write_range,
)
from ..sonar_images import (
    read_oculus_ping,
    read_picture,
    read_ping360_echo,
    read_projected_image,
    read_raw_image,
    read_sonar_info,
    read_sonoptix_echo,
    write_picture,
    write_sonar_info,
)
from ..soundings import read_ground, write_ground
from ..transforms import TF_STATIC
from .topic import InputTopic

TOPICS = (
    InputTopic(
        'detections',
        'echoes of one ping of a forward-looking sonar, also when there are none',
        measurement=Detections,
        readers={
            'sensor_msgs/msg/PointCloud2': read_detections,
            'sensor_msgs/msg/PointCloud': read_point_cloud,
            'sensor_msgs/msg/LaserScan': read_laser_scan,
            'geometry_msgs/msg/PoseArray': read_pose_array,
            'vision_msgs/msg/Detection3DArray': read_detections_3d,
            'marine_acoustic_msgs/msg/SonarDetections': read_sonar_detections,
            'marine_acoustic_msgs/msg/SonarRanges': read_sonar_ranges,
        },
        write=write_detections,
        by_name=frozenset({'vision_msgs/msg/Detection3DArray'}),
        settings=('beam_axes', 'bearing_positive', 'sound_speed'),
        required=lambda settings: True,
    ),
    InputTopic(
        'nav',
        'pose of the vehicle',
        measurement=Navigation,
        readers={'nav_msgs/msg/Odometry': read_navigation},
        write=write_navigation,
        doubt=lambda message, navigation: doubt_navigation(message),
        settings=('nav_twist_frame',),
        required=lambda settings: True,
    ),
    InputTopic(
        'altitude',
        'height above the sea floor',
        measurement=Altitude,
        readers={
            'sensor_msgs/msg/Range': read_range,
            'marine_acoustic_msgs/msg/Dvl': read_dvl,
            'stonefish_ros2/msg/DVL': read_dvl,
            'dave_interfaces/msg/DVL': read_dave_dvl,
        },
        write=write_range,
    ),
    InputTopic(
        'ground',
        'soundings of the sea floor in the frame of nav, such as the soundings of bathymetry_node',
        measurement=Ground,
        readers={'sensor_msgs/msg/PointCloud2': read_ground},
        write=write_ground,
        companion=True,
    ),
    TF_STATIC,
)

IMAGES = (
    InputTopic(
        'image',
        'images of a forward-looking sonar',
        measurement=SonarImage,
        readers={
            'marine_acoustic_msgs/msg/ProjectedSonarImage': read_projected_image,
            'marine_acoustic_msgs/msg/RawSonarImage': read_raw_image,
            'oculus_interfaces/msg/Ping': read_oculus_ping,
            'ping360_sonar_msgs/msg/SonarEcho': read_ping360_echo,
            'sensors/msg/SonoptixECHO': read_sonoptix_echo,
            'sensor_msgs/msg/Image': read_picture,
        },
        write=write_picture,
        one_topic=True,
        makes='detections',
        by_name=frozenset({'sensor_msgs/msg/Image'}),
        settings=(
            'image_order',
            'beam_axes',
            'sound_speed',
            'image_near_range',
            'image_far_range',
            'image_fov_deg',
            'image_first_beam',
            'image_first_range',
        ),
    ),
    InputTopic(
        'sonar_info',
        'what a sonar says of its images, in place of parameters',
        measurement=SonarInfo,
        readers={'marine_interfaces/msg/SonarInfo': read_sonar_info},
        write=write_sonar_info,
        companion=True,
        beside=('detections', 'image'),
        makes='detections',
        latched=True,
    ),
)
"""What the detector before the tracker hears."""
