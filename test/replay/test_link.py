# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How long a link waits, told by a clock that the test moves."""

from types import SimpleNamespace

import pytest

from sonar_imm_tools.replay import link as module
from sonar_imm_tools.replay.link import Link, LinkError


@pytest.fixture
def link(monkeypatch):
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


def test_what_does_not_come_is_waited_for_as_long_as_is_said(link):
    assert link.wait_for(lambda: False, 2.25) is False
    assert link.clock.now == pytest.approx(1002.25)
    assert max(link.clock.spun) <= 0.1 and min(link.clock.spun) > 0.0


def test_what_comes_ends_the_waiting(link):
    assert link.wait_for(lambda: link.clock.now > 1001.0, 60.0) is True
    assert link.clock.now == pytest.approx(1001.1, abs=0.11)


def test_trouble_is_asked_for_ten_times_a_second_and_ends_the_waiting(link):
    asked = []

    def trouble():
        asked.append(link.clock.now)
        return 'the node ended' if len(asked) == 3 else None

    # Callbacks that come in quick succession.
    link.spin = lambda seconds: setattr(link.clock, 'now', link.clock.now + 0.01)
    with pytest.raises(LinkError, match='the node ended'):
        link.wait_for(lambda: False, 60.0, trouble)
    assert asked == pytest.approx([1000.1, 1000.2, 1000.3], abs=0.035)
