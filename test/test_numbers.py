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

"""Every table of the pages says where its numbers come from, and they are still those.

A check of numbers that never fails would pass all of that, so each number is falsified too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import importlib
import json
from pathlib import Path
from random import Random
import sys
from typing import Any

from attrs import evolve
from helpers.source import ROOT
import pytest

if not (ROOT / 'docs' / 'check_numbers.py').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)


sys.path.insert(0, str(ROOT / 'docs'))  # as for a script there


@pytest.fixture(scope='module')
def checker() -> Any:
    return importlib.import_module('check_numbers')


def test_every_number_has_its_source(checker: Any) -> None:
    assert checker.all_doubts() == []


def falsified(number: str) -> Iterator[str]:
    """A number with every other last digit that is 2 to 9 away."""
    place = max(place for place, sign in enumerate(number) if sign.isdigit())
    if 'e' in number:
        place = number.index('e') - 1
    for digit in range(10):
        if abs(digit - int(number[place])) >= 2:
            yield f'{number[:place]}{digit}{number[place + 1 :]}'


def falsified_tables(checker: Any, table: Any, most: int, draw: Random) -> Iterator[Any]:
    """`table` with one of its numbers falsified, for at most so many of them."""
    places = [
        (row, column, found)
        for row, cells in enumerate(table.rows)
        for column, cell in enumerate(cells)
        for found in checker.NUMBER.finditer(checker.without_code(cell))
    ]
    for row, column, found in draw.sample(places, min(most, len(places))):
        wrong = draw.choice(list(falsified(found.group())))
        cells = list(table.rows[row])
        cells[column] = f'{cells[column][: found.start()]}{wrong}{cells[column][found.end() :]}'
        rows = (*table.rows[:row], tuple(cells), *table.rows[row + 1 :])
        yield evolve(table, rows=rows)


def test_a_falsified_number_is_found_out(checker: Any) -> None:
    """In every table: of some of its numbers the last digit, wrong by 2 to 9."""
    sources = checker.known_sources()
    tables = [table for page in checker.pages() for table in checker.tables(page)]
    wrong = [
        of for table in tables for of in falsified_tables(checker, table, 8, Random(table.place))
    ]
    passed = [of for of in wrong if not checker.doubts(of, sources) + checker.unread(of)]
    assert passed == []
    assert len(wrong) > 800


def test_few_tables_with_numbers_are_of_no_result(checker: Any) -> None:
    """Each says why; none of them looks measured."""
    tables = [table for page in checker.pages() for table in checker.tables(page)]
    exempt = {table.place: table.exempt() for table in tables if table.exempt()}
    assert 0 < len(exempt) < 40
    assert all(exempt.values())


RESULT = {
    'runs': 5,
    'rmse': {'near': 1.2512, 'far': 2.5, 'study': 1.4},
    'share': {'near': 0.5, 'far': None},
    'list': [{'name': 'near', 'band': [0.1, 0.25]}, {'name': 'far', 'band': [1, 2]}],
}


@pytest.fixture
def a_page(
    checker: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[..., list[str]]]:
    """Give what is doubted of a table under a mark, beside a result."""
    (tmp_path / 'one.json').write_text(json.dumps(RESULT))
    monkeypatch.setattr(checker, 'ROOT', tmp_path)
    monkeypatch.setattr(checker, 'RESULTS', tmp_path)
    checker.contents.cache_clear()
    known = {'one.json': {'command': 'python -m benchmarks.none', 'date': '2026-11-20'}}

    def doubted(mark: str, *rows: str) -> list[str]:
        page = tmp_path / 'page.md'
        body = '\n'.join(f'| {row} |' for row in rows)
        page.write_text(
            f'# Page\n\n<!-- numbers: {mark} -->\n| case | RMSE |\n|---|---|\n{body}\n'
        )
        (table,) = checker.tables(page)
        return checker.doubts(table, known)

    yield doubted
    checker.contents.cache_clear()


@pytest.mark.parametrize(
    ('mark', 'row', 'doubt'),
    [
        ('one.json; rmse>{row}', 'near | 1.25 m', None),
        ('one.json; rmse>{row}; rest: 1a948f', '**near** | 1.3 (of others 1.4)', None),
        ('one.json; rmse>{row}; rest: 1a948f', 'near | 1.3 (of others 1.6)', '; rest: '),
        ('one.json; rmse>{row}', 'near | 1.3 (of others 1.4)', '1 numbers have no value'),
        ('one.json; rmse>{row}; rest: 1a948f', 'near | 1.3', 'ends with no `rest`'),
        ('one.json; rmse>{row}; rows: near; rest: 1a948f', '1.4 km | 1.25', None),
        ('one.json; -; rest: 1a948f', 'near | 1.4', None),
        ('one.json; rmse>{row} ~ rmse>study', 'near | 1.3 (of others 1.4)', None),
        ('one.json; rmse>{row} ~ rmse>study', 'near | 1.3 (of others 1.5)', '1.5 is 1.4'),
        ('one.json; rmse>{row}', 'near | 2.5', '2.5 is 1.2512 at rmse>near'),
        ('one.json; rmse>{row}', 'close | 1.25', '1.25 for 0 values'),
        ('one.json; rmse>{row}; rows: near', 'close | 1.25', None),
        ('one.json; rmse>{row}; rows: near | far', 'close | 1.25', '2 keys for 1 rows'),
        ('one.json; rmse>{row} | share>{row}', 'near | 1.25', '2 paths for 2 columns'),
        ('one.json; rmse>{row} & share>{row}', 'near | 1.25, 50 %', None),
        ('one.json; rmse>{row} & share>{row}', 'far | 2.5', None),
        ('one.json; rmse>{row} & share>{row}', 'near | 1.25, 49 %', '49% is 0.5'),
        ('one.json; rmse>{near,far}', 'near | 1.25, 2.5', None),
        ('one.json; list>[name={row}]>band', 'far | 1 to 2', None),
        ('one.json; list>[name={row}]>band', 'far | 1', '1 for 2 values'),
        ('one.json; list>0>band>1', 'far | .25', None),
        ('one.json; rmse>{row}', 'near |', 'nothing for 1 values'),
        ('one.json; rmse>{row}', 'near | -', None),
        ('one.json', 'near | 1.25', 'not bound'),
        ('two.json; rmse>{row}', 'near | 1.25', 'does not know two.json'),
        ('none; settings', 'near | 1.24', None),
        ('none', 'near | 1.24', 'needs a reason'),
        ('read 2026-11-20 c63c00; sonar-imm bench', 'near | 1.24 m', None),
        ('read 2026-11-20 c63c00; sonar-imm bench', 'near | 1.25 m', 'not the numbers that were'),
        ('read 2026-11-20; sonar-imm bench', 'near | 1.24 m', 'not the numbers that were'),
        ('read 2026-11-20 c63c00', 'near | 1.24 m', 'no command'),
        ('read today c63c00; sonar-imm bench', 'near | 1.24 m', 'no date'),
        ('read 2999-01-01 c63c00; sonar-imm bench', 'near | 1.24 m', 'not come yet'),
        ('read 2026-11-20 c63c00; python -m benchmarks.no', 'near | 1.24 m', 'there is no'),
    ],
)
def test_what_is_wrong_is_found(a_page: Any, mark: str, row: str, doubt: str | None) -> None:
    found = a_page(mark, row)
    assert not found if doubt is None else len(found) == 1 and doubt in found[0]


def test_an_empty_first_cell_is_that_of_the_row_above(a_page: Any) -> None:
    assert a_page('one.json; rmse>{row}', 'near | 1.25', ' | 1.25') == []


def test_numbers_without_a_mark_are_doubted(
    checker: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checker, 'ROOT', tmp_path)
    page = tmp_path / 'page.md'
    cells = ['1.24 m', '33 %', '82 ms, 186 ms', '7', 'seven', '7 for no reason', '`7.5`', 'f8']
    page.write_text('\n'.join(f'| a | b |\n|---|---|\n| c | {cell} |\n' for cell in cells))
    found = {table.rows[2][1]: checker.doubts(table, {}) for table in checker.tables(page)}
    assert [cell for cell in cells if found[cell]] == cells[:4]
    assert '`<!-- numbers: read 20' in found['7'][0]


@pytest.fixture
def ages(checker: Any) -> Any:
    return importlib.import_module('result_ages')


def test_a_result_is_as_old_as_the_commits_that_touch_what_it_depends_on(ages: Any) -> None:
    log = [
        'e d\n\nM\tpackage/new.py\n',
        'd c\n\nR100\told.py\tpackage/new.py\nM\tother.py\n',
        'c b x\n',
        'x a\n\nM\told.py\n',
        'b a\n\nA\tdocs/results/one.json\n',
        'a\n\nA\told.py\nA\tother.py\n',
    ]
    commits = tuple(map(ages.commit_of, log))
    result = 'docs/results/one.json'
    made = ages.commit_of_result(commits, result)
    assert made == 'b'
    assert ages.age_since(commits, made, frozenset({'package/new.py'})) == 2  # e and x
    assert ages.age_since(commits, made, frozenset({'other.py'})) == 1
    assert ages.age_since(commits, made, frozenset({'unchanged.py'})) == 0
    assert ages.commit_of_result(commits, 'docs/results/none.json') == ''
    assert ages.age_since(commits, '', frozenset()) is None
    assert ages.age_since((), made, frozenset({'other.py'})) is None


def test_numbers_read_by_hand_are_as_old_as_their_day_and_command(
    ages: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = (
        '\0c\n\n+<!-- numbers: read 2026-11-21 ab12cd; sonar-imm bench --runs 3 -->\n'
        '-<!-- numbers: read 2026-11-20 99aa99; sonar-imm bench --runs 3 -->\n'
        '\0b\n\n+<!-- numbers: read 2026-11-20 99aa99; sonar-imm bench\n+  --runs 3 -->\n'
        '\0a\n\n+<!-- numbers: read 2026-11-20; sonar-imm bench --runs 3 -->\n'
    )
    ages.readings.cache_clear()
    monkeypatch.setattr(ages, 'git', lambda *words: log)
    command = 'sonar-imm bench --runs 3'
    assert ages.commit_of_reading('2026-11-20', command) == 'a'
    assert ages.commit_of_reading('2026-11-21', command) == 'c'
    assert ages.commit_of_reading('2026-11-21', 'sonar-imm track') == ''
    ages.readings.cache_clear()


def test_a_result_depends_on_what_its_script_imports(ages: Any) -> None:
    paths = ages.paths_of('diver_sea.json', 'python -m benchmarks.diver_sea --runs 30')
    assert {'benchmarks/diver_sea.py', 'sonar_imm/trackers/diver/tracker.py'} <= paths
    assert 'sonar_imm/estimation/imm_kernels.py' in paths
    assert 'sonar_imm_tools/simulation/obstacle/__init__.py' not in paths
    by_name = ages.paths_of('false_warnings.json', 'python -m benchmarks.false_warnings')
    assert 'sonar_imm_tools/simulation/obstacle/__init__.py' in by_name
    assert not any('trackers/obstacle' in path for path in paths)
    assert paths < ages.paths_of('reliability.json', 'make reliability') | {
        path for path in paths if not path.startswith('sonar_imm')
    }


def test_without_git_no_age_is_known(
    ages: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ages.history.cache_clear()
    monkeypatch.setenv('PATH', str(tmp_path))
    assert ages.history() == ()
    ages.history.cache_clear()
    monkeypatch.undo()
    monkeypatch.setattr(ages, 'ROOT', tmp_path)
    assert ages.history() == ()
    ages.history.cache_clear()
