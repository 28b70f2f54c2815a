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

"""Every table of the pages says where its numbers come from, and they are still those."""

from __future__ import annotations

import importlib.util
from pathlib import Path
import sys

from helpers.source import ROOT
import pytest

if not (ROOT / 'docs' / 'check_numbers.py').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)


@pytest.fixture(scope='module')
def checker():
    name = 'check_numbers'
    spec = importlib.util.spec_from_file_location(name, ROOT / 'docs' / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # attrs looks its classes up there
    spec.loader.exec_module(module)
    return module


def test_every_number_has_its_source(checker) -> None:
    assert checker.all_doubts() == []


@pytest.fixture
def a_page(checker, monkeypatch, tmp_path: Path):
    """Give what is doubted of a table under a mark, beside a result that holds 1.25."""
    (tmp_path / 'one.json').write_text('{"rmse": 1.2512, "share": 0.5}')
    monkeypatch.setattr(checker, 'ROOT', tmp_path)
    monkeypatch.setattr(checker, 'RESULTS', tmp_path)
    known = {'one.json': {'command': 'python -m benchmarks.none', 'date': '2026-11-20'}}

    def doubted(mark: str, cell: str = '1.25 m, 50 %') -> list[str]:
        page = tmp_path / 'page.md'
        page.write_text(f'# Page\n\n{mark}\n| case | RMSE |\n|---|---|\n| 9.9 | {cell} |\n')
        (table,) = checker.tables(page)
        return checker.doubts(table, known)

    return doubted


@pytest.mark.parametrize(
    ('mark', 'cell', 'doubt'),
    [
        ('<!-- numbers: one.json -->', '1.25 m, 50 %', None),
        ('<!-- numbers: one.json -->', '1.3 m (of others 1.4)', None),
        ('<!-- numbers: one.json -->', '1.24 m', 'not in one.json: 1.24'),
        ('<!-- numbers: one.json -->', '49 %', 'not in one.json: 49%'),
        ('<!-- numbers: one.json; not RMSE -->', '1.24 m', None),
        ('<!-- numbers: one.json; not 2 -->', '1.24 m', None),
        ('<!-- numbers: two.json -->', '1.25 m', 'does not know two.json'),
        ('<!-- numbers: none -->', '1.24 m', None),
        ('<!-- numbers: read 2026-11-20; sonar-imm bench -->', '1.24 m', None),
        ('<!-- numbers: read 2026-11-20 -->', '1.24 m', 'no command'),
        ('<!-- numbers: read today; sonar-imm bench -->', '1.24 m', 'no date'),
        ('<!-- numbers: read 2999-01-01; sonar-imm bench -->', '1.24 m', 'not come yet'),
        ('<!-- numbers: read 2026-11-20; python -m benchmarks.no -->', '1.24 m', 'there is no'),
        ('', '1.24 m', 'without a source'),
        ('', 'seven', None),
    ],
)
def test_what_is_wrong_is_found(a_page, mark: str, cell: str, doubt: str | None) -> None:
    found = a_page(mark, cell)
    assert not found if doubt is None else len(found) == 1 and doubt in found[0]


def test_the_site_shows_the_source_below_the_table(checker) -> None:
    text = '<!-- numbers: read 2026-11-20; sonar-imm bench -->\n| a |\n|---|\n| 1.5 |\n\nAfter.\n'
    assert checker.captioned(text, '') == (
        '| a |\n|---|\n| 1.5 |\n\n*Read on 2026-11-20:* `sonar-imm bench`\n\nAfter.\n'
    )
