# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One cycle of the particle filter for sets."""

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.set_filter import SetFilter, SetStep, Weighted


def cycle(
    filter_: SetFilter, before: Weighted | None, b: FloatArray, key: tuple[int, int]
) -> SetStep:
    """Take the record b in; before: None before the first one."""
    record = filter_.record(b, key)
    sets = filter_.propagate(before or filter_.start(record), record)
    return filter_.move(filter_.resample(filter_.weigh(sets, record), record), record)
