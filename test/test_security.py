# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""SECURITY.md names a test for each sentence of what is defended against."""

import ast
import re

from helpers.source import ROOT
import pytest

if not (ROOT / 'SECURITY.md').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

TEXT = (ROOT / 'SECURITY.md').read_text(encoding='utf-8')
NAMED = re.findall(r'`(test/[\w/]+\.py)(?:::(\w+))?`', TEXT)


@pytest.mark.parametrize('file, test', sorted({*NAMED}))
def test_every_test_that_is_named_exists(file, test):
    tree = ast.parse((ROOT / file).read_text(encoding='utf-8'))
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert test in names if test else any(name.startswith('test_') for name in names)


def test_every_item_and_attack_names_a_test():
    part = TEXT[TEXT.index('What is defended') : TEXT.index('What is not defended')]
    items = re.split(r'^- ', part.split('\n\n| attack')[0], flags=re.MULTILINE)[1:]
    rows = [line for line in part.splitlines() if line.startswith('| ')][1:]
    assert len(items) > 10 and 5 < len(rows) <= 15
    for item in items + rows:
        assert re.search(r'`test/[\w/]+\.py', item), item
