# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a live diver node loses while late messages keep it busy, by the depth of its queue.

    python -m benchmarks.queue_depth --rate 100 --depths 50 200 500

Fixes of one diver come at a steady rate. Every three seconds one comes nine seconds late, and the
tracker computes those nine seconds again. Needs ROS 2. The machine counts: on a faster one less is
lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
import os
from pathlib import Path
import time
from typing import Any

import numpy as np

from benchmarks.study import Parts, study
from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Fix
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import latched_qos, output_qos
from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id
from sonar_imm_tools.replay.link import Link, LinkError

LATE_EVERY, LATE_BY = 3.0, 9.0


def messages(rate: float, seconds: float) -> list[Any]:
    """Fixes of a diver who swims at 0.5 m/s, in the order of their arrival."""
    rng = np.random.default_rng(1)
    times = np.arange(int(rate * seconds)) / rate
    times[int((LATE_BY + 0.5) * rate) :: int(LATE_EVERY * rate)] -= LATE_BY + 0.5 / rate
    return [
        write_fix(
            Fix(
                stamp_ns=10**18 + round(t * 1e9),
                position=(0.5 * t + rng.normal(), rng.normal(), 0.0),
                covariance=np.eye(2),
                frame_id='map',
            ),
            make,
        )
        for t in times
    ]


def row(depth: int, rate: float, seconds: float) -> dict[str, int]:
    """Messages sent and lost, and the memory of the node in MB at the end."""
    arguments = ['-p', f'queue_depth:={depth}']
    with (
        reserved_domain_id() as domain,
        NodeProcess('diver', domain_id=domain, arguments=arguments) as node,
        Link('bench', domain_id=domain) as link,
    ):
        latest: dict[str, Any] = {}
        for kind, topic, qos in (
            ('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics', output_qos()),
            ('sensor_msgs/msg/PointCloud2', '/diver/processed', latched_qos()),
        ):
            take = partial(latest.__setitem__, topic)
            link.node.create_subscription(message_class(kind), topic, take, qos)
        fix = link.node.create_publisher(
            message_class('geometry_msgs/msg/PoseWithCovarianceStamped'), 'fix', output_qos(1000)
        )
        if not link.wait_for(
            lambda: '/diver/processed' in latest and fix.get_subscription_count(), 90.0
        ):
            raise LinkError('the node did not appear')
        sent = messages(rate, seconds)
        begin = time.monotonic()
        for k, message in enumerate(sent):
            time.sleep(max(0.0, begin + k / rate - time.monotonic()))
            fix.publish(message)
        link.wait_for(lambda: False, 5.0)
        values = {pair.key: pair.value for pair in latest['/diagnostics'].status[0].values}
        status = Path(f'/proc/{node.process.pid}/status').read_text(encoding='utf-8')
        memory = next(line for line in status.splitlines() if line.startswith('VmRSS'))
        lost = int(values.get('lost on fix', '0'))
        return {'sent': len(sent), 'lost': lost, 'memory MB': int(memory.split()[1]) // 1024}


def main(
    rate: float = 100.0, seconds: float = 20.0, depths: Sequence[int] = (50, 200, 500)
) -> Parts:
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    for depth in depths:
        yield {'queue_depth': {str(depth): row(depth, rate, seconds)}}


if __name__ == '__main__':
    study(main, rate={'help': 'fixes per second'})
