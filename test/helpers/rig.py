# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A walker node with everything connected to it, and fixes to send to it."""

import numpy as np
from sensor_msgs.msg import PointCloud2

from msg_adapters.estimates import read_estimate
from msg_adapters.fixes import write_fix
from msg_adapters.table import decode_table
from sonar_imm.measurements import Fix
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import latched_qos, lockstep_qos

FIX = 'geometry_msgs/msg/PoseWithCovarianceStamped'
SECOND = 10**9


def a_fix(seconds, x=1.0, y=2.0, frame_id='map'):
    return write_fix(
        Fix(
            stamp_ns=round(seconds * SECOND),
            position=(x, y, 0.0),
            covariance=np.diag([4.0, 9.0]),
            frame_id=frame_id,
        ),
        make,
    )


class Rig:
    """A walker node with everything connected to it."""

    def __init__(self, bench, *, publish=FIX, qos=10, prefix='', name='walker'):
        self.bench = bench
        self.node = bench.add(TrackerNode('walker', context=bench.context))
        self.name = f'{prefix}/{name}'
        self.estimates = bench.listen(PointCloud2, f'{self.name}/estimate', lockstep_qos())
        self.answers = bench.listen(PointCloud2, f'{self.name}/processed', latched_qos())
        self.fix = bench.peer.create_publisher(message_class(publish), f'{prefix}/fix', qos)
        bench.spin_until(lambda: self.answers and self.fix.get_subscription_count())

    @property
    def answer(self):
        """The last row of ~/processed: messages, refused, estimates."""
        columns = decode_table(self.answers[-1])
        return tuple(int(columns[name][0]) for name in ('messages', 'refused', 'estimates'))

    def send(self, *messages):
        """Publish one after another, each when the one before has been answered."""
        for message in messages:
            answered = self.answer[0]
            self.fix.publish(message)
            self.bench.spin_until(lambda before=answered: self.answer[0] > before)
        self.bench.spin_until(lambda: len(self.estimates) >= self.answer[2])

    def means(self):
        return [(e.stamp_ns / SECOND, *e.state[0, :2]) for e in map(read_estimate, self.estimates)]
