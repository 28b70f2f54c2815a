# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The site: every page is in its navigation, every public module in its API, nothing from afar;
pages with measured numbers; the rows of SECURITY.md.

Building it needs mkdocs, and `make docs` is strict itself; these tests need neither.
"""

from __future__ import annotations

import importlib
import json
import re
import sys
from types import SimpleNamespace

from helpers.source import ROOT
import pytest
import yaml

if not (ROOT / 'mkdocs.yml').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

NO_API = {'sonar_imm_tools.cli', 'sonar_imm.nodes'}
"""Packages that are no library: the command has a page, the nodes have topics."""


sys.path.insert(0, str(ROOT / 'docs'))  # as for a script there


result_pages = importlib.import_module('result_pages')


@pytest.fixture(scope='module')
def made():
    return importlib.import_module('site_pages')


def in_navigation(entry):
    if isinstance(entry, str):
        return {entry}
    parts = entry.values() if isinstance(entry, dict) else entry
    return set().union(*map(in_navigation, parts))


def test_every_page_is_in_the_navigation(made, monkeypatch):
    config = yaml.safe_load((ROOT / 'mkdocs.yml').read_text(encoding='utf-8'))
    pages = {path.relative_to(ROOT / 'docs').as_posix() for path in (ROOT / 'docs').rglob('*.md')}
    pages |= {*made.OUTSIDE.values(), *(f'reference/api/{name}.md' for name in made.API)}
    pages |= {f'reference/{name}.md' for name in ('interfaces', 'options', 'bags')}
    pages |= {f'examples/{path.stem}.md' for path in (ROOT / 'examples').glob('*.ipynb')}
    assert in_navigation(config['nav']) == pages
    page = made.recordings()
    for path in (ROOT / 'bags').glob('*/README.md'):
        assert f'| [{path.parent.name}](#' in page and f'## {path.parent.name}\n' in page
    # Links to notebooks lead to their pages; a site alone asks for no list of versions.
    text = '[a](../../examples/own_data.ipynb), [b](../runs.md)'
    shown = made.on_page_markdown(text, None, None, None)
    assert shown == '[a](../examples/own_data.md), [b](../runs.md)'
    given = SimpleNamespace(extra={'version': {'provider': 'mike'}})
    monkeypatch.setenv('SITE_VERSIONS', '1')
    assert 'version' in made.on_config(given).extra
    monkeypatch.delenv('SITE_VERSIONS')
    assert 'version' not in made.on_config(given).extra


def test_the_api_has_every_public_module(made):
    described = set().union(*(made.modules(package) for package, _ in made.API.values()))
    files = [*(ROOT / 'sonar_imm').rglob('*.py'), *(ROOT / 'msg_adapters').rglob('*.py')]
    names = {'.'.join(path.relative_to(ROOT).with_suffix('').parts) for path in files}
    public = {name.removesuffix('.__init__') for name in names}
    assert public - described == {
        name for name in public if any(f'{name}.'.startswith(f'{item}.') for item in NO_API)
    }
    assert '::: sonar_imm.estimation.imm\n' in made.api_page('sonar_imm.estimation', 'x')
    assert 'set_kernels' not in made.api_page('sonar_imm.estimation', 'x')


def test_files_and_tests_named_on_pages_exist():
    rooms = 'sonar_imm sonar_imm_tools msg_adapters test benchmarks docs examples'.split()
    files = [path.relative_to(ROOT) for room in rooms for path in (ROOT / room).rglob('*.py')]
    sources = [(ROOT / file).read_text(encoding='utf-8') for file in files if 'test' in file.parts]
    tests = {name for source in sources for name in re.findall(r'def (test_\w+)', source)}
    missing = set()
    for page in [*(ROOT / 'docs').rglob('*.md'), ROOT / 'README.md']:
        text = page.read_text(encoding='utf-8')
        for name in re.findall(r'`([\w./]+/\w+\.py)', text):
            if not any(f'/{file.as_posix()}'.endswith(f'/{name}') for file in files):
                missing.add(f'{page.name}: {name}')
        named = set(re.findall(r'`(test_\w+)\b(?!\.py)', text))
        missing |= {f'{page.name}: {name}' for name in named - tests}
    assert missing == set()


@pytest.mark.parametrize('name', ['README.md', 'CONTRIBUTING.md', 'CHANGELOG.rst'])
def test_links_of_pages_from_the_root_lead_to_pages(made, name):
    text = made.at_the_root(name)
    assert text.startswith('# ')
    for target in re.findall(r'\]\(([^)#]+)', text):
        known = target in made.OUTSIDE.values() or (ROOT / 'docs' / target).is_file()
        assert '://' in target or known, target


def slug(heading):
    """The anchor of a heading."""
    words = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading).strip().lower()
    return re.sub(r'[^\w\- ]', '', words).replace(' ', '-')


def test_links_between_files_lead_somewhere():
    pages = {
        path: re.sub(r'^```.*?^```', '', path.read_text(encoding='utf-8'), flags=re.M | re.S)
        for path in [*ROOT.glob('*.md'), *(ROOT / 'docs').rglob('*.md')]
    }
    anchors = {
        path: {slug(heading) for heading in re.findall(r'^#+ (.*)$', text, re.M)}
        for path, text in pages.items()
    }
    broken = set()
    for path, text in pages.items():
        for link in re.findall(r'\]\((?!\w+:)([^)\s]+)\)', text):
            name, _, anchor = link.partition('#')
            target = (path.parent / name).resolve() if name else path
            if not target.exists() or (anchor and anchor not in anchors.get(target, {anchor})):
                broken.add(f'{path.name}: {link}')
    assert broken == set()


def test_what_comes_from_another_server_is_seen_and_the_search_needs_none(made):
    config = yaml.safe_load((ROOT / 'mkdocs.yml').read_text(encoding='utf-8'))
    (script,) = config['extra']['polyfills']
    assert 'iframe-worker' in script, 'else the plugin loads one of this name from afar'
    assert 'offline' in config['plugins'] and (ROOT / 'docs' / script).is_file()
    page = (
        '<link rel="canonical" href="https://a.org/"><link rel=stylesheet href=assets/a.css>'
        '<a href="https://b.org">b</a><script src="https://c.org/c.js"></script>'
        '<link rel="stylesheet" href="//d.org/d.css"><img src=https://e.org/e.png>'
    )
    due = ['https://c.org/c.js', '//d.org/d.css', 'https://e.org/e.png']
    assert made.loaded_from_afar(page) == due


def test_on_a_phone_each_cell_has_the_head_of_its_column(made):
    page = (
        '<p><table>\n<thead>\n<tr>\n<th>a</th>\n<th style="x">b <code>c</code></th>\n'
        '</tr>\n</thead>\n'
        '<tbody>\n<tr>\n<td>1</td>\n<td style="x">2</td>\n</tr>\n</tbody>\n</table></p><td>'
    )
    shown = made.on_page_content(page, None, None, None)
    assert '<td data-label="a">1</td>\n<td data-label="b c" style="x">2</td>' in shown
    assert shown.endswith('<td>')


def test_every_row_of_the_page_of_security_names_a_file_of_tests():
    rows = re.findall(r'^\| .*', (ROOT / 'SECURITY.md').read_text(encoding='utf-8'), re.MULTILINE)
    for row in rows[1:]:
        (name,) = re.findall(r'`(test/[\w/]+\.py)` \|$', row)
        assert 'def test_' in (ROOT / name).read_text(encoding='utf-8')
    assert len(rows) > 2


# -- pages with measured numbers: each is that of its file, and one that is missing fails --

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
    return result_pages.Numbers(tmp_path)


def test_a_number_has_two_decimals_or_its_format(numbers):
    assert numbers.n('x>scenes>calm>RMSE') == '0.12'
    assert numbers.n('x>scenes>calm>RMSE', '.3f') == '0.123'
    assert numbers.n('x>scenes>calm>share', '.0%') == '50 %'
    assert (numbers.n('x>runs'), numbers.n('x>all>1')) == ('20', '2.50')
    assert numbers.n('x>scenes>calm>kept') == numbers.n('x>scenes>rough>RMSE') == '-'
    assert 'text: [x.json](x.json), 2026-11-29, abcd1234<' in numbers.sources()  # at the end
    for path in ('x>scenes>storm>RMSE', 'x>runs>RMSE', 'x>all>2', 'x>all>first'):
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
    for missing in ({'a': 'RMSE', 'b': 'rmse'}, {'a': 'cover'}):
        with pytest.raises(LookupError):
            numbers.table('x>scenes>{row}>{col}', missing)


def test_a_table_replaces_the_one_of_the_same_head():
    page = 'Before.\n\n| a | b |\n|---|---|\n| 1 | 2 |\n| 3 | 4 |\n\nAfter.\n'
    table = '| a | b |\n|---|---|\n| 5 | 6 |\n'
    assert result_pages.with_table(page, table) == f'Before.\n\n{table}\nAfter.\n'
    for other in ('Nothing.\n', page + page):
        with pytest.raises(ValueError, match='not one'):
            result_pages.with_table(other, table)
