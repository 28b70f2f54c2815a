# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whatever a wire brings and a parameter file says, a tracker goes on and tells the truth.

400 messages for each system here, and some damaged files; ``make fuzz`` sends 100,000.
"""

import warnings

from helpers.hostile.files import file_results, FILES
from helpers.hostile.runs import Bad, BATCH, batches, MUTATIONS, run, run_extreme, Tally
from helpers.hostile.streams import stream, templates, VARIANTS
from hypothesis import given, HealthCheck, settings
import pytest

from msg_adapters.inputs import inputs_of, made_inputs
from sonar_imm.trackers import SYSTEMS

ONCE = [
    ('diver', 3, {3: 1048575, 15: 11047, 19: 257408}),  # existence above 1
    ('diver', 3, {2: 297, 3: 20451, 7: 1633}),  # the same, of one
    ('fathometer', 0, {2: 146, 9: 300657}),  # a record that no set explains
    # Births where all free cells have lost their weight.
    ('fathometer', 2, {7: 1188873, 10: 33531}),
    ('fathometer', 0, {18: 3606393, 35: 93705795}),
    ('fathometer', 0, {7: 9, 37: 75}),  # all cells are within the aperture
    ('fathometer', 0, {49: 230133}),  # an echo narrower than any pulse
]


@pytest.mark.parametrize('system', SYSTEMS)
def test_no_message_breaks_a_tracker(system):
    tally = Tally()

    @settings(max_examples=400 // BATCH, suppress_health_check=list(HealthCheck))
    @given(batch=batches(system))
    def search(batch):
        run(system, batch, tally)

    search()
    assert tally.cases >= 400
    # Most get past the reader, or nothing behind it would be tried.
    assert tally.read > 0.5 * tally.cases and len(tally.refused) >= 5 and tally.counted


@pytest.mark.parametrize('system, variant, numbers', ONCE)
def test_messages_that_once_broke_a_tracker(system, variant, numbers):
    run(system, (variant, [Bad.of(system, numbers.get(k, 0)) for k in range(50)]))


def test_where_the_last_diver_has_gone_existence_is_a_number_still():
    assert run_extreme('diver', 41)


@pytest.mark.parametrize('system', SYSTEMS)
def test_no_parameter_breaks_a_tracker(system):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        ran = [run_extreme(system, seed) for seed in range(15)]
    assert sum(bool(item) for item in ran) > 5


@pytest.mark.parametrize('system', SYSTEMS)
def test_every_type_of_every_input_is_tried(system):
    tried = {(name, type_name) for name, type_name, _ in templates(system)}
    entries = (*inputs_of(system), *made_inputs(system))
    known = {(entry.name, type_name) for entry in entries for type_name in entry.readers}
    assert tried == known
    for variant in range(len(VARIANTS[system])):
        tally = Tally()
        run(system, (variant, []), tally)
        assert tally.estimates >= len(stream(system, variant)) / 4
    unchanged = next(i for i, mutation in enumerate(MUTATIONS) if mutation.__name__ == 'again')
    tally = Tally()
    run(system, (0, [Bad(i, unchanged, 5) for i in range(len(tried))]), tally)
    assert tally.read >= 0.75 * len(tried)  # good messages are good


@pytest.mark.statistics
@pytest.mark.parametrize('name', FILES)
def test_a_damaged_file_is_read_or_refused(name):
    assert not file_results(name, 8)['failures']
