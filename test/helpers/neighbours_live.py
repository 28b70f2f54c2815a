# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Run by a test as a program of its own: real nodes receive messages of other packages.

Prints one line of JSON: how many messages each input took and refused, and what came out.
"""

import json
import sys

import numpy as np
from rclpy.parameter import Parameter

from helpers.node_bench import Bench
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.fls_detector import FlsDetectorNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import lockstep_qos, transforms_qos

ORIGIN = Origin(54.3, 10.2)
STEPS = 20
MARINE = 'marine_acoustic_msgs/msg/'
BEARINGS = np.radians(np.linspace(-20.0, 20.0, 9))
SAMPLES = np.ones((60, 9), np.uint8)
SAMPLES[30, 4] = 250
"""An echo straight ahead at half the range."""


def xyz(*place):
    return dict(zip('xyz', map(float, place)))


def fields(step):
    """Of each type the fields beside the header; those of a message in it as a mapping."""
    east, north, up = place = np.array([20.0 + 0.5 * step, 10.0, -5.0])
    point = {'position': dict(zip(('latitude', 'longitude', 'altitude'), ORIGIN.geodetic(place)))}
    seen = {'position': xyz(30.0, 2.0, 1.0)}
    ping = {'ping_info': {'frequency': 450e3, 'sound_speed': 1500.0}}
    image = {'image': {'beam_count': 9, 'data': SAMPLES.tobytes()}, **ping}
    rays = [xyz(np.cos(bearing), np.sin(bearing), 0.0) for bearing in (0.1, *BEARINGS)]
    return {
        'geographic_msgs/msg/GeoPointStamped': point,
        'geographic_msgs/msg/GeoPoseStamped': {'pose': point},
        'geographic_msgs/msg/GeoPoseWithCovarianceStamped':
            {'pose': {'pose': point, 'covariance': np.eye(6).ravel()}},
        'seatrac_interfaces/msg/ModemRec': {
            'src_id': 3, 'includes_position': True, 'position_easting': round(10.0 * east),
            'position_northing': round(10.0 * north), 'position_depth': round(-10.0 * up)},
        'acomms_msgs/msg/UsblData': {'enu': xyz(*place), 'remote_address': 3, 'accuracy': 1.0},
        # Forward is east here: starboard is south.
        'stonefish_ros2/msg/BeaconInfo':
            {'beacon_id': 3, 'relative_position': xyz(east, -north, -up)},
        'vision_msgs/msg/Detection3DArray': {'detections': [{
            'header': header(step), 'results': [{'pose': {'pose': seen}}],
            'bbox': {'center': seen}}]},
        MARINE + 'SonarDetections': {'two_way_travel_times': [0.04], 'rx_angles': [0.1], **ping},
        MARINE + 'SonarRanges': {'beam_unit_vec': rays[:1], 'ranges': [30.0], **ping},
        **dict.fromkeys((MARINE + 'Dvl', 'stonefish_ros2/msg/DVL'), {'altitude': 12.0}),
        'dave_interfaces/msg/DVL': {'target': {'type': 'bottom', 'range': 12.0}},
        MARINE + 'ProjectedSonarImage':
            {'beam_directions': rays[1:], 'ranges': 1.0 + 0.5 * np.arange(60), **image},
        MARINE + 'RawSonarImage':
            {'sample_rate': 1500.0, 'samples_per_beam': 60, 'rx_angles': BEARINGS, **image},
        'oculus_interfaces/msg/Ping': {
            'range_resolution': 0.5, 'n_ranges': 60, 'n_beams': 9, 'step': 9, 'sample_size': 1,
            'bearings': np.linspace(-2000, 2000, 9).astype(np.int16),
            'ping_data': SAMPLES.tobytes()},
        'ping360_sonar_msgs/msg/SonarEcho': {  # it turns back once, which ends a sweep
            'angle': 0.05 * abs(10 - step), 'range': 30, 'intensities': SAMPLES[:, 4].tobytes()},
        'sensors/msg/SonoptixECHO': {'array_data': {
            'layout': {'dim': [{'size': n} for n in SAMPLES.shape]}, 'data': SAMPLES.ravel()}},
        'marine_interfaces/msg/SonarInfo': {
            'intensity_quantity': 3, 'intensity_scale': 1, 'pulse_lengths': [4e-4],
            'tx_signal_types': [1]},
    }  # fmt: skip


def header(step):
    return {'stamp': {'sec': 1000 + step}, 'frame_id': 'sensor'}


GEODETIC = {'origin': [ORIGIN.latitude, ORIGIN.longitude, 0.0]}
SCREEN = {'image_far_range': 30.0, 'image_fov_deg': 40.0}
PICTURES = {'input_types': ['image=sensor_msgs/msg/Image']}


def place_of(name):
    """Which node hears a type on which input, with which parameters."""
    package, _, kind = name.split('/')
    if package == 'geographic_msgs':
        return DiverNode, 'fix', GEODETIC
    if kind in ('ModemRec', 'UsblData', 'BeaconInfo'):
        return DiverNode, 'relative', {'vessel': 'fixed'}
    if kind.upper() == 'DVL':
        return ObstacleNode, 'altitude', {}
    if kind in ('Detection3DArray', 'SonarDetections', 'SonarRanges'):
        return ObstacleNode, 'detections', {}
    if kind == 'SonarInfo':
        return FlsDetectorNode, 'sonar_info', PICTURES
    return FlsDetectorNode, 'image', SCREEN if kind == 'SonoptixECHO' else {}


def built(type_name, fields):
    """A message of its fields."""
    kinds = message_class(type_name).get_fields_and_field_types()

    def of(name, value):
        kind = kinds[name].removeprefix('sequence<').removesuffix('>').replace('/', '/msg/')
        if isinstance(value, dict):
            return built(kind, value)
        if isinstance(value, list):
            return [built(kind, each) if isinstance(each, dict) else each for each in value]
        return value

    return make(type_name, **{name: of(name, value) for name, value in fields.items()})


def run(type_name):
    """Publish `STEPS` messages to a node of its own, each when the one before is answered."""
    kind, name, settings = place_of(type_name)
    types = [f'{name}={type_name}'] if name != 'sonar_info' else []
    quality = lockstep_qos() if types else transforms_qos()
    settings = {**settings, 'input_types': [*types, *settings.get('input_types', [])]}
    bench = Bench()
    try:
        overrides = [Parameter(key, value=value) for key, value in settings.items()]
        node = bench.start(kind, parameter_overrides=overrides)
        publisher = bench.publisher(type_name, f'/{name}', quality)
        for step in range(STEPS):
            values = {'header': header(step), **fields(step)[type_name]}
            publisher.publish(built(type_name, values))
            bench.spin_until(lambda step=step: node.answer()['messages'] > step)
        return node.answer()
    finally:
        bench.close()


if __name__ == '__main__':
    wanted = sys.argv[1:] or fields(0)
    print(json.dumps({name: run(name) for name in wanted}))
