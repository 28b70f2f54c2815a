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

"""Messages of packages that are not installed, by their fields, as a bag brings them along."""

from functools import cache

from rosbags.typesys import get_types_from_msg, get_typestore, Stores

DEFINITIONS = {
    'vision_msgs/msg/ObjectHypothesis': 'string class_id\nfloat64 score\n',
    'vision_msgs/msg/ObjectHypothesisWithPose': (
        'vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n'
    ),
    'vision_msgs/msg/BoundingBox3D': 'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n',
    'vision_msgs/msg/Detection3D': (
        'std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n'
        'vision_msgs/BoundingBox3D bbox\nstring id\n'
    ),
    'vision_msgs/msg/Detection3DArray': (
        'std_msgs/Header header\nvision_msgs/Detection3D[] detections\n'
    ),
    'geographic_msgs/msg/GeoPoint': 'float64 latitude\nfloat64 longitude\nfloat64 altitude\n',
    'geographic_msgs/msg/GeoPose': (
        'geographic_msgs/GeoPoint position\ngeometry_msgs/Quaternion orientation\n'
    ),
    'geographic_msgs/msg/GeoPoseWithCovariance': (
        'geographic_msgs/GeoPose pose\nfloat64[36] covariance\n'
    ),
    'geographic_msgs/msg/GeoPointStamped': (
        'std_msgs/Header header\ngeographic_msgs/GeoPoint position\n'
    ),
    'geographic_msgs/msg/GeoPoseStamped': (
        'std_msgs/Header header\ngeographic_msgs/GeoPose pose\n'
    ),
    'geographic_msgs/msg/GeoPoseWithCovarianceStamped': (
        'std_msgs/Header header\ngeographic_msgs/GeoPoseWithCovariance pose\n'
    ),
    'marine_interfaces/msg/Classification': 'string class_id\nfloat32 probability\n',
    'marine_interfaces/msg/Kinematics': (
        'geometry_msgs/PoseWithCovariance pose\nuint8 orientation_availability\n'
        'geometry_msgs/TwistWithCovariance twist\n'
    ),
    'marine_interfaces/msg/Shape': (
        'uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions\n'
    ),
    'marine_interfaces/msg/Contact': (
        'std_msgs/Header header\nstring id\nfloat32 existence_probability\n'
        'marine_interfaces/Classification[] classification\n'
        'marine_interfaces/Kinematics kinematics\nmarine_interfaces/Shape shape\n'
        'geographic_msgs/GeoPose geo_pose\nstring source\nuint8 origin_kind\nuint8 status\n'
        'string note\nstring[] observation_ids\ndiagnostic_msgs/KeyValue[] attributes\n'
    ),
    'marine_interfaces/msg/ContactArray': (
        'std_msgs/Header header\nmarine_interfaces/Contact[] contacts\n'
    ),
    'seatrac_interfaces/msg/ModemRec': (
        'std_msgs/Header header\nuint8 msg_id\nbool position_flt_error\nuint8 src_id\n'
        'int16 attitude_yaw\nint16 depth_local\nuint16 vos\nbool includes_range\n'
        'uint16 range_dist\nbool includes_usbl\nint16 usbl_azimuth\nint16 usbl_elevation\n'
        'int16 usbl_fit_error\nbool includes_position\nint16 position_easting\n'
        'int16 position_northing\nint16 position_depth\n'
    ),
    'acomms_msgs/msg/UsblData': (
        'std_msgs/Header header\nfloat64 current_time\nfloat64 measurement_time\n'
        'int32 remote_address\ngeometry_msgs/Vector3 xyz\ngeometry_msgs/Vector3 enu\n'
        'geometry_msgs/Quaternion orientation\nfloat64 propagation_time\nfloat64 rssi\n'
        'int32 integrity\nfloat64 accuracy\n'
    ),
    'stonefish_ros2/msg/BeaconInfo': (
        'std_msgs/Header header\nuint8 beacon_id\nfloat32 range\nfloat32 azimuth\n'
        'float32 elevation\ngeometry_msgs/Point relative_position\n'
        'geometry_msgs/Quaternion local_orientation\nfloat32 local_depth\n'
    ),
}


@cache
def driver_types():
    """A store that knows the types of Jazzy and these."""
    store = get_typestore(Stores.ROS2_JAZZY)
    found = {}
    for name, text in DEFINITIONS.items():
        found.update(get_types_from_msg(text, name))
    store.register(found)
    return store


def driver_message(name, **values):
    """A message with the fields `values`, by dotted names (``position.latitude``); others zero."""
    message = _zero(name)
    for path, value in values.items():
        *way, last = path.split('__')
        target = message
        for step in way:
            target = getattr(target, step)
        object.__setattr__(target, last, value)
    return message


def _zero(name):
    store = driver_types()
    made = []
    for _, (node, detail) in store.fielddefs[name][1]:
        if node.name == 'NAME':
            made.append(_zero(detail))
        elif node.name == 'ARRAY':
            import numpy as np

            made.append(np.zeros(detail[1]))
        elif node.name == 'SEQUENCE':
            made.append([])
        else:
            kind = detail[0]
            made.append(
                ''
                if kind == 'string'
                else 0.0
                if 'float' in kind
                else False
                if kind == 'bool'
                else 0
            )
    return store.types[name](*made)
