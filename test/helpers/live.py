# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What tests of real nodes share."""

import time


def wait_until_ready(nodes, limit=300.0):
    """Wait until each NodeProcess says that it hears its inputs; seconds."""
    end = time.monotonic() + limit
    while not all('ready, hears' in node.log() for node in nodes):
        assert all(node.process.poll() is None for node in nodes)
        assert time.monotonic() < end, [node.log() for node in nodes]
        time.sleep(0.02)


def own_words(log):
    """What a node wrote itself: Fast DDS also tells, in red, of shared memory that processes of
    other ROS domains on this machine reach for in the same moment, and goes on without it."""
    return '\n'.join(line for line in log.splitlines() if 'RTPS_TRANSPORT_SHM' not in line)
