# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A small recording for tests of what plays and steps, and an ear for what is played."""

import numpy as np

from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Fix
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter

START = 1_700_000_000 * 10**9
STEP = 10**7
COUNT = 20


def write_fixes(path):
    """Twenty fixes 10 ms apart, the fourth not a number, and a second topic with one message."""
    with BagWriter(path) as writer:
        for k in range(COUNT):
            message = write_fix(
                Fix(
                    stamp_ns=START + k * STEP,
                    position=(float(k), 0.0, 0.0),
                    covariance=np.eye(2),
                    frame_id='map',
                ),
                ros_message,
            )
            if k == 3:
                message.pose.pose.position.x = float('nan')
            writer.write('/fix', message, START + k * STEP)
        writer.write('/other', ros_message('std_msgs/msg/Float64', data=1.5), START)
    return path


class Ear:
    """Hears everything on a topic, though it only listens when asked."""

    def __init__(self, link, message_type, topic):
        self.link, self.received = link, []
        self.subscription = link.node.create_subscription(
            message_type, topic, self.received.append, lockstep_qos()
        )

    def positions(self, count):
        assert self.link.wait_for(lambda: len(self.received) >= count, 10.0)
        return [message.pose.pose.position.x for message in self.received]
