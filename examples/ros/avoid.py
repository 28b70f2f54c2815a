# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles as points for a costmap, and a rule that stops (docs/tutorials/ros_avoidance.md)."""

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Bool

from msg_adapters.table import decode_table, encode_table
from sonar_imm.nodes.messages import make

RISK, SOON, HEIGHT = 0.2, 30.0, 3.0
COLUMNS = (
    'x',
    'y',
    'z',
    'track_id',
    'track_state',
    'vertical_offset_lo',
    'vertical_offset_hi',
    'place_cov_x_x',
    'place_cov_y_y',
    'collision_probability',
    'cpa_time',
    'cpa_distance',
)

rclpy.init()
node = rclpy.create_node('avoid')
points = node.create_publisher(PointCloud2, '~/points', 10)
stop = node.create_publisher(Bool, '~/stop', 10)
stopped = False


def heard(message):
    global stopped
    rows = decode_table(message, COLUMNS)
    sure = rows['track_state'] > 0
    level = sure & (rows['vertical_offset_lo'] < HEIGHT) & (rows['vertical_offset_hi'] > -HEIGHT)
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    size = 2.0 * np.sqrt(np.maximum(rows['place_cov_x_x'], rows['place_cov_y_y']))[level, None]
    x = rows['x'][level, None] + size * np.cos(angle)
    y = rows['y'][level, None] + size * np.sin(angle)
    z = np.repeat(rows['z'][level], len(angle))
    cloud = {name: part.ravel().astype('f4') for name, part in (('x', x), ('y', y), ('z', z))}
    stamp, frame_id = message.header.stamp, message.header.frame_id
    stamp_ns = stamp.sec * 10**9 + stamp.nanosec
    points.publish(encode_table(cloud, stamp_ns=stamp_ns, frame_id=frame_id, make=make))
    hits = sure & (rows['collision_probability'] >= RISK) & (rows['cpa_time'] <= SOON)
    if hits.any() and not stopped:
        worst = np.flatnonzero(hits)[rows['collision_probability'][hits].argmax()]
        print(
            f'stop: obstacle {rows["track_id"][worst]:.0f} in {rows["cpa_time"][worst]:.0f} s, '
            f'collision {rows["collision_probability"][worst]:.0%}',
            flush=True,
        )
    stopped = bool(hits.any())
    stop.publish(Bool(data=stopped))


node.create_subscription(PointCloud2, '/obstacle/estimate', heard, 10)
print('avoiding', flush=True)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
