# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Each row of SECURITY.md names a file of tests that exists."""

import re

from helpers.source import ROOT
import pytest

if not (ROOT / 'SECURITY.md').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

ROWS = [
    line
    for line in (ROOT / 'SECURITY.md').read_text(encoding='utf-8').splitlines()
    if line.startswith('| ')
][1:]


@pytest.mark.parametrize('row', ROWS)
def test_every_row_names_a_file_of_tests(row):
    (name,) = re.findall(r'`(test/[\w/]+\.py)` \|$', row)
    assert 'def test_' in (ROOT / name).read_text(encoding='utf-8')
