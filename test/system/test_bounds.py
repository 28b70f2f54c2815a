# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the hardest messages may cost, each in a process of its own, for its peak of memory is one
of a process: docs/reliability.md.

The limits are a few times what was measured there: a loaded machine must not fail, what grows with
the square of a message must.
"""

import pytest

from benchmarks.bounds import CASES, measured

pytestmark = pytest.mark.system

LIMITS = {
    'fixes': (2.0, 100.0), 'fixes_softly': (10.0, 200.0), 'arrivals_wild_tag': (5.0, 50.0),
    'arrivals_many_divers': (40.0, 50.0), 'detections': (2.0, 100.0), 'snapshot': (5.0, 100.0),
    'pressure': (5.0, 500.0), 'csdm': (5.0, 200.0), 'trace': (5.0, 500.0),
}  # fmt: skip
"""Seconds of CPU and megabytes of one message."""


@pytest.mark.parametrize('name', CASES)
def test_the_hardest_message_of_each_kind_is_bounded(name):
    given, (seconds, megabytes) = measured(name), LIMITS[name]
    assert not given['refused'] and 0.0 < given['cpu_s'] < seconds
    assert given['memory_mb'] < megabytes
