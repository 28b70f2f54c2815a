# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Trackers warn of variances that cannot be true, and not of those that are."""

from pathlib import Path

import pytest

from benchmarks.false_warnings import runs

BAGS = Path(__file__).resolve().parents[2] / 'bags'


@pytest.mark.parametrize('name', ['obstacle_movers', 'diver_multistatic'])
@pytest.mark.parametrize('factor, warned', [(1.0, False), (2.0, True), (0.5, True)])
def test_only_variances_that_are_not_true_are_warned_of(name, factor, warned):
    ((_, raised),) = runs(BAGS / name, factor, range(1, 2))
    assert bool(raised) == warned
