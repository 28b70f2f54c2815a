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
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import lockstep_qos, transforms_qos

ORIGIN = Origin(54.3, 10.2)
STEPS = 20


def header(step, frame_id='sensor'):
    stamp = make('builtin_interfaces/msg/Time', sec=1000 + step)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


def place(step):
    return np.array([20.0 + 0.5 * step, 10.0, -5.0])


def xyz(kind, place):
    return make(f'geometry_msgs/msg/{kind}', **dict(zip('xyz', map(float, place))))


def geo_point(step):
    degrees = dict(zip(('latitude', 'longitude', 'altitude'), ORIGIN.geodetic(place(step))))
    return make('geographic_msgs/msg/GeoPoint', **degrees)


def geo_pose(step):
    return make('geographic_msgs/msg/GeoPose', position=geo_point(step))


def sure_pose(step):
    covariance = np.eye(6).ravel()
    kind = 'geographic_msgs/msg/GeoPoseWithCovariance'
    return {'pose': make(kind, pose=geo_pose(step), covariance=covariance)}


def modem(step):
    east, north, up = place(step)
    return {
        'src_id': 3, 'includes_position': True, 'position_easting': round(10.0 * east),
        'position_northing': round(10.0 * north), 'position_depth': round(-10.0 * up),
    }  # fmt: skip


def usbl(step):
    return {'enu': xyz('Vector3', place(step)), 'remote_address': 3, 'accuracy': 1.0}


def beacon(step):
    at = place(step) * (1.0, -1.0, -1.0)  # forward is east here: starboard is south
    return {'beacon_id': 3, 'relative_position': xyz('Point', at)}


def detections(step):
    point = xyz('Point', (30.0, 2.0, 1.0))
    pose = make('geometry_msgs/msg/Pose', position=point)
    pose = make('geometry_msgs/msg/PoseWithCovariance', pose=pose)
    result = make('vision_msgs/msg/ObjectHypothesisWithPose', pose=pose)
    seen = make('vision_msgs/msg/Detection3D', header=header(step), results=[result])
    seen.bbox.center.position = point
    return {'detections': [seen]}


MARINE = 'marine_acoustic_msgs/msg/'
BEARINGS = np.radians(np.linspace(-20.0, 20.0, 9))
SAMPLES = np.ones((60, 9), np.uint8)
SAMPLES[30, 4] = 250
"""An echo straight ahead at half the range."""


def vectors(bearings):
    return [xyz('Vector3', (np.cos(b), np.sin(b), 0.0)) for b in bearings]


def ping(**values):
    info = make(MARINE + 'PingInfo', frequency=450e3, sound_speed=1500.0)
    return {'ping_info': info, **values}


def image(**values):
    data = make(MARINE + 'SonarImageData', beam_count=9, data=SAMPLES.tobytes())
    return ping(image=data, **values)


def oculus(step):
    return {
        'range_resolution': 0.5, 'n_ranges': 60, 'n_beams': 9, 'step': 9, 'sample_size': 1,
        'bearings': np.linspace(-2000, 2000, 9).astype(np.int16), 'ping_data': SAMPLES.tobytes(),
    }  # fmt: skip


def ping360(step):
    angle = 0.05 * abs(10 - step)  # it turns back once, which ends a sweep
    return {'angle': angle, 'range': 30, 'intensities': SAMPLES[:, 4].tobytes()}


def sonoptix(step):
    dims = [make('std_msgs/msg/MultiArrayDimension', size=n) for n in SAMPLES.shape]
    layout = make('std_msgs/msg/MultiArrayLayout', dim=dims)
    data = make('std_msgs/msg/Float32MultiArray', layout=layout, data=SAMPLES.ravel())
    return {'array_data': data}


def sonar_info(step):
    return {
        'intensity_quantity': 3, 'intensity_scale': 1, 'pulse_lengths': [4e-4],
        'tx_signal_types': [1],
    }  # fmt: skip


GEODETIC = {'origin': [ORIGIN.latitude, ORIGIN.longitude, 0.0]}
FIXED = {'vessel': 'fixed'}
SCREEN = {'image_far_range': 30.0, 'image_fov_deg': 40.0}
PICTURES = {'input_types': ['image=sensor_msgs/msg/Image']}
CASES = {
    'geographic_msgs/msg/GeoPointStamped':
        (DiverNode, 'fix', lambda step: {'position': geo_point(step)}, GEODETIC),
    'geographic_msgs/msg/GeoPoseStamped':
        (DiverNode, 'fix', lambda step: {'pose': geo_pose(step)}, GEODETIC),
    'geographic_msgs/msg/GeoPoseWithCovarianceStamped': (DiverNode, 'fix', sure_pose, GEODETIC),
    'seatrac_interfaces/msg/ModemRec': (DiverNode, 'relative', modem, FIXED),
    'acomms_msgs/msg/UsblData': (DiverNode, 'relative', usbl, FIXED),
    'stonefish_ros2/msg/BeaconInfo': (DiverNode, 'relative', beacon, FIXED),
    'vision_msgs/msg/Detection3DArray': (ObstacleNode, 'detections', detections, {}),
    MARINE + 'SonarDetections': (ObstacleNode, 'detections', lambda step: ping(
        two_way_travel_times=[0.04], rx_angles=[0.1]), {}),
    MARINE + 'SonarRanges': (ObstacleNode, 'detections', lambda step: ping(
        beam_unit_vec=vectors([0.1]), ranges=[30.0]), {}),
    **dict.fromkeys((MARINE + 'Dvl', 'stonefish_ros2/msg/DVL'), (
        ObstacleNode, 'altitude', lambda step: {'altitude': 12.0}, {})),
    'dave_interfaces/msg/DVL': (ObstacleNode, 'altitude', lambda step: {
        'target': make('dave_interfaces/msg/DVLTarget', type='bottom', range=12.0)}, {}),
    MARINE + 'ProjectedSonarImage': (FlsDetectorNode, 'image', lambda step: image(
        beam_directions=vectors(BEARINGS), ranges=1.0 + 0.5 * np.arange(60)), {}),
    MARINE + 'RawSonarImage': (FlsDetectorNode, 'image', lambda step: image(
        sample_rate=1500.0, samples_per_beam=60, rx_angles=BEARINGS), {}),
    'oculus_interfaces/msg/Ping': (FlsDetectorNode, 'image', oculus, {}),
    'ping360_sonar_msgs/msg/SonarEcho': (FlsDetectorNode, 'image', ping360, {}),
    'sensors/msg/SonoptixECHO': (FlsDetectorNode, 'image', sonoptix, SCREEN),
    'marine_interfaces/msg/SonarInfo': (FlsDetectorNode, 'sonar_info', sonar_info, PICTURES),
}  # fmt: skip
"""Of each type the node, the input, its fields beside the header, and parameters."""


def run(type_name, kind, name, fields, settings):
    """Publish `STEPS` messages to a node of its own, each when the one before is answered."""
    types = [f'{name}={type_name}'] if name != 'sonar_info' else []
    quality = lockstep_qos() if types else transforms_qos()
    settings = {**settings, 'input_types': [*types, *settings.get('input_types', [])]}
    bench = Bench()
    try:
        overrides = [Parameter(key, value=value) for key, value in settings.items()]
        node = bench.start(kind, parameter_overrides=overrides)
        publisher = bench.publisher(type_name, f'/{name}', quality)
        for step in range(STEPS):
            publisher.publish(make(type_name, header=header(step), **fields(step)))
            bench.spin_until(lambda step=step: node.answer()['messages'] > step)
        return node.answer()
    finally:
        bench.close()


if __name__ == '__main__':
    wanted = sys.argv[1:] or CASES
    print(json.dumps({name: run(name, *CASES[name]) for name in wanted}))
