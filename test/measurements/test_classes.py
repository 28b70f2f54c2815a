# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What all measurement classes have in common."""

import attrs
import pytest

from sonar_imm import measurements
from sonar_imm.measurements import check_stamp, Rejection

CLASSES = [
    kind
    for kind in vars(measurements).values()
    if isinstance(kind, type) and attrs.has(kind) and 'stamp_ns' in attrs.fields_dict(kind)
]


@pytest.mark.parametrize('kind', CLASSES)
def test_a_measurement_is_made_by_names_and_is_equal_to_itself_alone(kind):
    """Positions of arguments would mix up units, and arrays have no truth to compare by."""
    assert all(field.kw_only for field in attrs.fields(kind) if field.init)
    assert kind.__eq__ is object.__eq__ and kind.__hash__ is object.__hash__
    assert kind.__setattr__ is not object.__setattr__  # frozen


@pytest.mark.parametrize('stamp_ns', [0, -1, 2**31 * 10**9, 2**62, 2**63, 2**80])
def test_a_stamp_that_is_no_time_of_ros_is_refused_by_name(stamp_ns):
    with pytest.raises(Rejection, match=f'the header stamp is {stamp_ns} ns') as caught:
        check_stamp(stamp_ns)
    assert caught.value.reason == 'bad_stamp'


def test_the_last_stamp_of_ros_is_one():
    check_stamp(2**31 * 10**9 - 1)
    check_stamp(1)
