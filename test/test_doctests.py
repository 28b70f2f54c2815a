# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The examples in the docstrings of the library do what they say."""

import doctest
from importlib import import_module

from helpers.source import module_name, MODULES, ROOT
import pytest

if not (ROOT / 'setup.py').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

WITH_EXAMPLES = [
    module_name(path) for path in MODULES if '>>> ' in path.read_text(encoding='utf-8')
]


@pytest.mark.parametrize('name', WITH_EXAMPLES)
def test_examples_do_what_they_say(name):
    found = doctest.testmod(import_module(name))
    assert found.attempted > 0 and found.failed == 0


def test_the_rooms_for_others_have_examples():
    rooms = {name.split('.')[1] for name in WITH_EXAMPLES}
    assert {'estimation', 'acoustics', 'trackers'} <= rooms and len(WITH_EXAMPLES) >= 12
