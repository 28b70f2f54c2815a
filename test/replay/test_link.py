# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How long a link waits, told by a clock that the test moves, and which tables are listened to."""

from types import SimpleNamespace

import pytest
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from sonar_imm_tools.replay import link as module
from sonar_imm_tools.replay.link import Link, LinkError
from sonar_imm_tools.replay.listening import TableListener


@pytest.fixture
def deaf(monkeypatch):
    """A link that hears nothing; each look at its callbacks takes as long as it may."""
    clock = SimpleNamespace(now=1000.0, spun=[])

    def spin(seconds):
        clock.spun.append(seconds)
        clock.now += seconds

    monkeypatch.setattr(module, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    link = object.__new__(Link)
    link.spin = spin
    link.clock = clock
    return link


def test_what_does_not_come_is_waited_for_as_long_as_is_said(deaf):
    assert deaf.wait_for(lambda: False, 2.25) is False
    assert deaf.clock.now == pytest.approx(1002.25)
    assert max(deaf.clock.spun) <= 0.1 and min(deaf.clock.spun) > 0.0


def test_what_comes_ends_the_waiting(deaf):
    assert deaf.wait_for(lambda: deaf.clock.now > 1001.0, 60.0) is True
    assert deaf.clock.now == pytest.approx(1001.1, abs=0.11)


def test_trouble_is_asked_for_ten_times_a_second_and_ends_the_waiting(deaf):
    asked = []

    def trouble():
        asked.append(deaf.clock.now)
        return 'the node ended' if len(asked) == 3 else None

    # Callbacks that come in quick succession.
    deaf.spin = lambda seconds: setattr(deaf.clock, 'now', deaf.clock.now + 0.01)
    with pytest.raises(LinkError, match='the node ended'):
        deaf.wait_for(lambda: False, 60.0, trouble)
    assert asked == pytest.approx([1000.1, 1000.2, 1000.3], abs=0.035)


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
