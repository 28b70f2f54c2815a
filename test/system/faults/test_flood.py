# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Input at ten times what a node can process."""

from helpers.faults.cases import CASES
from helpers.faults.figures import long_form
from helpers.faults.flood import flooded
import pytest

pytestmark = pytest.mark.system

MAX_WAIT = 0.3
# One sender in Python publishes about a thousand messages in a second: no flood for the others.
SYSTEMS = ('fathometer', 'bathymetry') if long_form() else ('fathometer',)


@pytest.mark.parametrize('system', SYSTEMS)
def test_a_flooded_node_answers_soon_counts_what_it_drops_and_recovers(system, figures):
    figures.skip_if_measured(system=system)
    flood = flooded(CASES[system], MAX_WAIT, times=10.0, seconds=3.0)
    figures.add({'system': system}, max_wait=MAX_WAIT, **flood._asdict())
    assert flood.rate > 5.0 * flood.capacity
    assert flood.sent == flood.used + flood.dropped + flood.lost
    assert flood.dropped + flood.lost > 0.3 * flood.sent and flood.warned
    patience = max(1.0, 6.0 / flood.capacity)  # a loaded machine is slow with each message
    assert flood.latency_max < MAX_WAIT + patience
    assert flood.recovered < patience
