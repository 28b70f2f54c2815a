# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which tables are listened to."""

import pytest
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from sonar_imm_tools.replay.link import LinkError
from sonar_imm_tools.replay.listening import TableListener


def test_without_names_every_estimate_is_heard_but_the_truth(link):
    kinds = {'/auv/diver/estimate': PointCloud2, '/truth/estimate': PointCloud2}
    kinds |= {'/other/estimate': Float64, '/estimate/raw': PointCloud2}
    out = {name: link.node.create_publisher(kind, name, 10) for name, kind in kinds.items()}
    listener = TableListener(link)
    for table in listener.tables(120.0):
        if table is not None:
            break
        for publisher, kind in zip(out.values(), kinds.values()):
            publisher.publish(kind())
    assert listener.topics == ['/auv/diver/estimate'] and table.topic == '/auv/diver/estimate'


@pytest.mark.parametrize(
    'wanted, said',
    [
        ((), 'no topic that ends in /estimate was found within 0.1 s'),
        (('diver/estimat',), r"nobody publishes /diver/estimat within .* mean '/diver/estimate'"),
        (('diver/estimate',), 'nothing was published on /diver/estimate within 0.1 s'),
        (('fix',), 'std_msgs/msg/Float64 and no table; ros2 topic echo /fix'),
    ],
)
def test_silence_says_what_was_looked_for(link, wanted, said):
    kinds = {'/diver/estimate': PointCloud2, '/fix': Float64} if wanted else {}
    for name, kind in kinds.items():
        link.node.create_publisher(kind, name, 10)
    assert link.wait_for(lambda: all(map(link.node.count_publishers, kinds)), 60.0)
    with pytest.raises(LinkError, match=said):
        list(TableListener(link, wanted).tables(0.1))
