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
    'PingInfo': 'float32 frequency sound_speed; float32[] tx_beamwidths rx_beamwidths',
    'DetectionFlag': 'uint8 flag',
    'SonarDetections': 'Header; PingInfo ping_info; DetectionFlag[] flags; float32[] '
    'two_way_travel_times tx_delays intensities tx_angles rx_angles',
    'SonarRanges': 'Header; PingInfo ping_info; DetectionFlag[] flags; float32[] transmit_delays '
    'intensities; geometry_msgs/Vector3[] beam_unit_vec; float32[] ranges',
    'Dvl': 'Header; uint8 DVL_MODE_BOTTOM=1 DVL_MODE_WATER=2 velocity_mode dvl_type; '
    'geometry_msgs/Vector3 velocity; float64[9] velocity_covar; float64 altitude course_gnd '
    'speed_gnd; uint8 num_good_beams; float64 sound_speed; bool beam_ranges_valid '
    'beam_velocities_valid; geometry_msgs/Vector3[] beam_unit_vec; float32[] range range_covar '
    'beam_quality beam_velocity beam_velocity_covar',
    'SonarImageData': 'bool is_bigendian; uint32 dtype beam_count; uint8[] data',
    'RawSonarImage': 'Header; PingInfo ping_info; float32 sample_rate; uint32 samples_per_beam '
    'sample0; float32[] tx_delays tx_angles rx_angles; SonarImageData image',
    'ProjectedSonarImage': 'Header; PingInfo ping_info; geometry_msgs/Vector3[] beam_directions; '
    'float32[] ranges; SonarImageData image',
}  # fmt: skip
"""Each type stands before all its fields in a row; Header is that of std_msgs."""
OTHERS = {
    'oculus_interfaces/msg/Ping': 'Header; uint32 ping_id ping_firing_date; float64 range '
    'gain_percent frequency speed_of_sound_used range_resolution temperature pressure; uint8 '
    'master_mode; bool has_gains; uint16 n_ranges n_beams; uint32 step; uint8 sample_size; '
    'int16[] bearings; uint8[] ping_data',
    'ping360_sonar_msgs/msg/SonarEcho': 'Header; float32 angle; uint8 gain; uint16 '
    'number_of_samples transmit_frequency speed_of_sound; uint8 range; uint8[] intensities',
    'sensors/msg/SonoptixECHO': 'Header; std_msgs/Float32MultiArray array_data',
    'stonefish_ros2/msg/DVL': 'Header; geometry_msgs/Vector3 velocity; float64[9] '
    'velocity_covariance; float64 altitude',
    'dave_interfaces/msg/DVLTarget': 'string type; float64 range',
    'dave_interfaces/msg/DVL': 'Header; string type; DVLTarget target; '
    'geometry_msgs/TwistWithCovariance velocity',
    'vision_msgs/msg/ObjectHypothesis': 'string class_id; float64 score',
    'vision_msgs/msg/ObjectHypothesisWithPose': 'vision_msgs/ObjectHypothesis hypothesis; '
    'geometry_msgs/PoseWithCovariance pose',
    'vision_msgs/msg/BoundingBox3D': 'geometry_msgs/Pose center; geometry_msgs/Vector3 size',
    'vision_msgs/msg/Detection3D': 'Header; vision_msgs/ObjectHypothesisWithPose[] results; '
    'vision_msgs/BoundingBox3D bbox; string id',
    'vision_msgs/msg/Detection3DArray': 'Header; vision_msgs/Detection3D[] detections',
    'geographic_msgs/msg/GeoPoint': 'float64 latitude longitude altitude',
    'geographic_msgs/msg/GeoPose': 'geographic_msgs/GeoPoint position; geometry_msgs/Quaternion '
    'orientation',
    'geographic_msgs/msg/GeoPoseWithCovariance': 'geographic_msgs/GeoPose pose; float64[36] '
    'covariance',
    'geographic_msgs/msg/GeoPointStamped': 'Header; geographic_msgs/GeoPoint position',
    'geographic_msgs/msg/GeoPoseStamped': 'Header; geographic_msgs/GeoPose pose',
    'geographic_msgs/msg/GeoPoseWithCovarianceStamped': 'Header; '
    'geographic_msgs/GeoPoseWithCovariance pose',
    'marine_interfaces/msg/SonarInfo': 'Header; string sonar_model; float32[] pulse_lengths '
    'bandwidths; uint8[] tx_signal_types; uint8 intensity_quantity intensity_scale '
    'intensity_reference; float32 scale offset; uint8 tvg_model; float32 '
    'tvg_absorption_db_per_km source_level_db',
    'seatrac_interfaces/msg/ModemRec': 'Header; uint8 msg_id; bool position_flt_error; uint8 '
    'src_id; int16 attitude_yaw depth_local; uint16 vos; bool includes_range; uint16 range_dist; '
    'bool includes_usbl; int16 usbl_azimuth usbl_elevation usbl_fit_error; bool '
    'includes_position; int16 position_easting position_northing position_depth',
    'acomms_msgs/msg/UsblData': 'Header; float64 current_time measurement_time; int32 '
    'remote_address; geometry_msgs/Vector3 xyz enu; geometry_msgs/Quaternion orientation; '
    'float64 propagation_time rssi; int32 integrity; float64 accuracy',
    'stonefish_ros2/msg/BeaconInfo': 'Header; uint8 beacon_id; float32 range azimuth elevation; '
    'geometry_msgs/Point relative_position; geometry_msgs/Quaternion local_orientation; float32 '
    'local_depth',
}  # fmt: skip
"""Messages of single drivers and simulators; of the DVL without their beams, of SonarInfo without
its calibration and curves."""


def definitions():
    """All of them, by full names."""
    given = {PACKAGE + name: text for name, text in DEFINITIONS.items()} | OTHERS
    return {name: _text(fields) for name, fields in given.items()}


def _text(fields):
    rows = [row.split() for row in fields.replace('Header;', 'std_msgs/Header header;').split(';')]
    return ''.join(f'{kind} {name}\n' for kind, *names in rows for name in names)


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
    stamp = make('builtin_interfaces/msg/Time', sec=sec, nanosec=5)
    return make('std_msgs/msg/Header', frame_id=frame_id, stamp=stamp)


def ping_info(sound_speed=1500.0):
    widths = dict.fromkeys(('tx_beamwidths', 'rx_beamwidths'), floats([]))
    return make('PingInfo', frequency=450e3, sound_speed=sound_speed, **widths)


def vectors(rows):
    kind = 'geometry_msgs/msg/Vector3'
    return [make(kind, **dict(zip('xyz', map(float, row)))) for row in rows]


def image_data(samples, dtype, beams=1):
    """The samples of an image as bytes; dtype: 0 for uint8, 8 for float32."""
    data = np.frombuffer(samples.tobytes(), np.uint8)
    given = {'is_bigendian': False, 'dtype': dtype, 'beam_count': beams}
    return make('SonarImageData', data=data, **given)


def sonar_ranges(beams, ranges, flags=(), intensities=(), **head):
    return make(
        'SonarRanges', header=header(**head), ping_info=ping_info(), transmit_delays=floats([]),
        flags=[make('DetectionFlag', flag=flag) for flag in flags], ranges=floats(ranges),
        intensities=floats(intensities), beam_unit_vec=vectors(beams),
    )  # fmt: skip


def sonar_detections(times, rx_angles, flags=(), intensities=(), sound_speed=1500.0, **head):
    return make(
        'SonarDetections', header=header(**head), ping_info=ping_info(sound_speed),
        flags=[make('DetectionFlag', flag=flag) for flag in flags], tx_delays=floats([]),
        two_way_travel_times=floats(times), intensities=floats(intensities),
        tx_angles=floats([]), rx_angles=floats(rx_angles),
    )  # fmt: skip


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
    """A message with the fields `values`, named as for `put`; others zero."""
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
    def of(node, detail):
        if node.name == 'NAME':
            return _zero(detail)
        if node.name == 'ARRAY':
            return np.zeros(detail[1])
        if node.name == 'SEQUENCE':
            return []
        return {'string': '', 'bool': False, 'float32': 0.0, 'float64': 0.0}.get(detail[0], 0)

    store = typestore()
    return store.types[name](*(of(*field) for _, field in store.fielddefs[name][1]))
