# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pages with measured numbers: each number is that of its file, and one that is missing fails."""

import importlib
import json
import re
import sys

from helpers.source import ROOT
import pytest

if not (ROOT / 'docs' / 'templates').is_dir():
    pytest.skip('these tests read the source tree', allow_module_level=True)

sys.path.insert(0, str(ROOT / 'docs'))  # as for a script there
made = importlib.import_module('result_pages')

FILE = {
    'made': {'command': 'python -m benchmarks.x', 'date': '2026-11-29', 'commit': 'abcd1234'},
    'runs': 20,
    'scenes': {
        'calm': {'RMSE': 0.1234, 'share': 0.5, 'kept': None},
        'rough': {'RMSE': float('nan'), 'share': 0.25, 'cover': 0.9},
    },
    'all': [1.0, 2.5],
}


@pytest.fixture
def numbers(tmp_path):
    (tmp_path / 'x.json').write_text(json.dumps(FILE))
    return made.Numbers(tmp_path)


def test_a_number_has_two_decimals_or_its_format(numbers):
    assert numbers.n('x>scenes>calm>RMSE') == '0.12'
    assert numbers.n('x>scenes>calm>RMSE', '.3f') == '0.123'
    assert numbers.n('x>scenes>calm>share', '.0%') == '50 %'
    assert (numbers.n('x>runs'), numbers.n('x>all>1')) == ('20', '2.50')
    assert numbers.n('x>scenes>calm>kept') == numbers.n('x>scenes>rough>RMSE') == '-'


def test_what_only_some_files_hold_can_be_asked_for(numbers):
    assert numbers.has('x>scenes>calm') and numbers.keys('x>scenes', 'ou') == ['rough']
    for path in ('x>scenes>storm', 'x>runs>RMSE', 'y>scenes'):
        assert not numbers.has(path) and numbers.keys(path) == []
    assert 'text: [x.json](x.json), 2026-11-29, abcd1234<' in numbers.sources()


@pytest.mark.parametrize('path', ['x>scenes>storm>RMSE', 'x>runs>RMSE', 'x>all>2', 'x>all>first'])
def test_a_number_that_is_missing_is_named(numbers, path):
    with pytest.raises(LookupError, match=re.escape(path)):
        numbers.n(path)


def test_a_table_has_a_row_for_each_entry_and_a_caption(numbers):
    columns = {'RMSE, m': 'RMSE|.3f', 'inside': '{share|.0%} ({cover / kept})'}
    assert numbers.table('x>scenes>{row}>{col}', columns, first='scene') == (
        '| scene | RMSE, m | inside |\n|---|---|---|\n'
        '| calm | 0.123 | 50 % (-) |\n| rough | - | 25 % (0.90) |\n\n'
        '<small>[x.json](x.json), 2026-11-29, abcd1234</small>'
    )
    assert numbers.sources() == ''
    short = numbers.table('x>{col}', {'share': 'scenes>@>share'}, {'a': 'rough'}, caption=False)
    assert short.splitlines()[2:] == ['| a | 0.25 |']


@pytest.mark.parametrize('columns', [{'a': 'RMSE', 'b': 'rmse'}, {'a': 'cover'}])
def test_a_row_or_a_column_without_numbers_is_an_error(numbers, columns):
    with pytest.raises(LookupError):
        numbers.table('x>scenes>{row}>{col}', columns)


def test_a_table_replaces_the_one_of_the_same_head():
    page = 'Before.\n\n| a | b |\n|---|---|\n| 1 | 2 |\n| 3 | 4 |\n\nAfter.\n'
    table = '| a | b |\n|---|---|\n| 5 | 6 |\n'
    assert made.with_table(page, table) == f'Before.\n\n{table}\nAfter.\n'
    for other in ('Nothing.\n', page + page):
        with pytest.raises(ValueError, match='not one'):
            made.with_table(other, table)
