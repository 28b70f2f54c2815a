# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The short form of a day at sea: minutes of it, offline."""

import numpy as np
import pytest

from benchmarks import soak

LIMITS = {
    'diver': (0.3, 1.0), 'obstacle': (0.3, 1.5), 'bathymetry': (0.06, 3.0),
    'fathometer': (0.3, 10.0),  # its particles come and go by megabytes
}  # fmt: skip
"""Hours, and MB by which the second half may grow."""


@pytest.mark.statistics
@pytest.mark.parametrize('system', LIMITS)
def test_a_tracker_grows_and_slows_no_more_once_it_is_warm(system):
    hours, limit = LIMITS[system]
    result = soak.offline(system, hours)
    assert result['messages'] > 50 and result['uncounted'] == 0
    assert result['grown_mb'] < limit
    assert result['p50_last_ms'] < 3.0 * result['p50_first_ms'] + 1.0


def test_growth_and_slowing_down_show():
    hours = np.linspace(0.0, 2.0, 200)
    memory = list(zip(hours, 100.0 + 3.0 * hours))
    times = np.linspace(1e-3, 5e-3, 1000)
    result = soak.summary(memory, times, sent=1000, counted=998)
    assert result['slope_mb_per_h'] == pytest.approx(3.0)
    assert result['slope_low'] == pytest.approx(3.0) and 2.0 < result['grown_mb'] < 3.1
    assert result['uncounted'] == 2 and result['p99_last_ms'] > 3.0 * result['p99_first_ms']


def test_stamps_go_on_from_one_turn_to_the_next():
    stamps = [stamp for topic, _, stamp in soak.stamps_of('diver', 0.06)]
    assert len(stamps) > 202 and set(np.diff(stamps)) == {10**9}
