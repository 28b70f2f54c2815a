# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages of packages that need not be installed, as rosbags makes them of the definition that a
bag brings along: those of marine_acoustic_msgs, and of single drivers and simulators."""

from functools import cache

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

PACKAGE = 'marine_acoustic_msgs/msg/'
DEFINITIONS = {
    'PingInfo': 'float32 frequency\nfloat32 sound_speed\nfloat32[] tx_beamwidths\n'
    'float32[] rx_beamwidths',
    'DetectionFlag': 'uint8 flag',
    'SonarDetections': 'std_msgs/Header header\nPingInfo ping_info\nDetectionFlag[] flags\n'
    'float32[] two_way_travel_times\nfloat32[] tx_delays\n'
    'float32[] intensities\nfloat32[] tx_angles\nfloat32[] rx_angles',
    'SonarRanges': 'std_msgs/Header header\nPingInfo ping_info\nDetectionFlag[] flags\n'
    'float32[] transmit_delays\nfloat32[] intensities\n'
    'geometry_msgs/Vector3[] beam_unit_vec\nfloat32[] ranges',
    'Dvl': (
        'std_msgs/Header header\nuint8 DVL_MODE_BOTTOM=1\nuint8 DVL_MODE_WATER=2\n'
        'uint8 velocity_mode\nuint8 dvl_type\ngeometry_msgs/Vector3 velocity\n'
        'float64[9] velocity_covar\nfloat64 altitude\nfloat64 course_gnd\nfloat64 speed_gnd\n'
        'uint8 num_good_beams\nfloat64 sound_speed\nbool beam_ranges_valid\n'
        'bool beam_velocities_valid\ngeometry_msgs/Vector3[] beam_unit_vec\nfloat32[] range\n'
        'float32[] range_covar\nfloat32[] beam_quality\nfloat32[] beam_velocity\n'
        'float32[] beam_velocity_covar\n'
    ),
    'SonarImageData': 'bool is_bigendian\nuint32 dtype\nuint32 beam_count\nuint8[] data',
    'RawSonarImage': 'std_msgs/Header header\nPingInfo ping_info\nfloat32 sample_rate\n'
    'uint32 samples_per_beam\nuint32 sample0\nfloat32[] tx_delays\n'
    'float32[] tx_angles\nfloat32[] rx_angles\nSonarImageData image',
    'ProjectedSonarImage': 'std_msgs/Header header\nPingInfo ping_info\n'
    'geometry_msgs/Vector3[] beam_directions\nfloat32[] ranges\n'
    'SonarImageData image',
}


OTHERS = {
    'oculus_interfaces/msg/Ping': 'std_msgs/Header header\nuint32 ping_id\n'
    'uint32 ping_firing_date\nfloat64 range\nfloat64 gain_percent\nfloat64 frequency\n'
    'float64 speed_of_sound_used\nfloat64 range_resolution\nfloat64 temperature\n'
    'float64 pressure\nuint8 master_mode\nbool has_gains\nuint16 n_ranges\nuint16 n_beams\n'
    'uint32 step\nuint8 sample_size\nint16[] bearings\nuint8[] ping_data',
    'ping360_sonar_msgs/msg/SonarEcho': 'std_msgs/Header header\nfloat32 angle\nuint8 gain\n'
    'uint16 number_of_samples\nuint16 transmit_frequency\nuint16 speed_of_sound\nuint8 range\n'
    'uint8[] intensities',
    'sensors/msg/SonoptixECHO': 'std_msgs/Header header\nstd_msgs/Float32MultiArray array_data',
    'stonefish_ros2/msg/DVL': 'std_msgs/Header header\ngeometry_msgs/Vector3 velocity\n'
    'float64[9] velocity_covariance\nfloat64 altitude',
    'dave_interfaces/msg/DVLTarget': 'string type\nfloat64 range',
    'dave_interfaces/msg/DVL': 'std_msgs/Header header\nstring type\nDVLTarget target\n'
    'geometry_msgs/TwistWithCovariance velocity',
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
    'marine_interfaces/msg/SonarInfo': (
        'std_msgs/Header header\nstring sonar_model\nfloat32[] pulse_lengths\n'
        'float32[] bandwidths\nuint8[] tx_signal_types\nuint8 intensity_quantity\n'
        'uint8 intensity_scale\nuint8 intensity_reference\nfloat32 scale\nfloat32 offset\n'
        'uint8 tvg_model\nfloat32 tvg_absorption_db_per_km\nfloat32 source_level_db\n'
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
"""Messages of single drivers and simulators; of the DVL without their beams, of SonarInfo without
its calibration and curves."""


def definitions():
    """All of them, by full names."""
    return {PACKAGE + name: text for name, text in DEFINITIONS.items()} | OTHERS


@cache
def typestore():
    """A store that knows the types of Jazzy and these."""
    types = get_typestore(Stores.ROS2_JAZZY)
    found = {}
    for name, text in definitions().items():
        found |= get_types_from_msg(text, name)
    types.register(found)
    return types


def floats(values):
    return np.array(values, np.float32)


def make(name, **fields):
    """A message of the package, or of another by its full name."""
    return typestore().types[name if '/' in name else PACKAGE + name](**fields)


def header(sec=100, frame_id='sonar'):
    return make(
        'std_msgs/msg/Header',
        frame_id=frame_id,
        stamp=make('builtin_interfaces/msg/Time', sec=sec, nanosec=5),
    )


def ping_info(sound_speed=1500.0):
    return make(
        'PingInfo',
        frequency=450e3,
        sound_speed=sound_speed,
        tx_beamwidths=floats([]),
        rx_beamwidths=floats([]),
    )


def vectors(rows):
    return [
        make('geometry_msgs/msg/Vector3', x=float(x), y=float(y), z=float(z)) for x, y, z in rows
    ]


def sonar_ranges(beams, ranges, flags=(), intensities=(), **head):
    return make(
        'SonarRanges',
        header=header(**head),
        ping_info=ping_info(),
        flags=[make('DetectionFlag', flag=flag) for flag in flags],
        transmit_delays=floats([]),
        intensities=floats(intensities),
        beam_unit_vec=vectors(beams),
        ranges=floats(ranges),
    )


def sonar_detections(times, rx_angles, flags=(), intensities=(), sound_speed=1500.0, **head):
    return make(
        'SonarDetections',
        header=header(**head),
        ping_info=ping_info(sound_speed),
        flags=[make('DetectionFlag', flag=flag) for flag in flags],
        two_way_travel_times=floats(times),
        tx_delays=floats([]),
        intensities=floats(intensities),
        tx_angles=floats([]),
        rx_angles=floats(rx_angles),
    )


def sent(message):
    """The message after a way through CDR, as a bag gives it."""
    types, name = typestore(), message.__msgtype__
    return types.deserialize_cdr(bytes(types.serialize_cdr(message, name)), name)


def write_bag(path, records, types=None):
    """A bag of (log time in ns, topic, message) as its recorder writes it: in the order of their
    times, with the definitions of their types."""
    types = types or typestore()
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {}
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            name = message.__msgtype__
            if topic not in links:
                links[topic] = writer.add_connection(topic, name, typestore=types)
            writer.write(links[topic], log_ns, types.serialize_cdr(message, name))
    return path


def driver_message(name, **values):
    """A message with the fields `values`, by dotted names (``position.latitude``); others zero."""
    return put(_zero(name), **values)


def put(message, **values):
    """The message, with other values of these fields, of any kind."""
    for path, value in values.items():
        *way, last = path.split('__')
        target = message
        for step in way:
            target = getattr(target, step)
        object.__setattr__(target, last, value)
    return message


def _zero(name):
    store = typestore()
    made = []
    for _, (node, detail) in store.fielddefs[name][1]:
        if node.name == 'NAME':
            made.append(_zero(detail))
        elif node.name == 'ARRAY':
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
