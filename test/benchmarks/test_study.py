# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The harness of the studies: options from parameters, tables as they come, one file."""

from collections.abc import Sequence
from datetime import date
import json
import os

from helpers.source import ROOT
import pytest

from benchmarks import study


def numbers(runs: int = 3, cases: Sequence[str] = ('a', 'b'), fast: bool = False) -> study.Parts:
    yield {'runs': runs, 'fast': fast}
    for case in cases:
        yield {'table': {case: {'error': runs / 8.0, 'n': runs}}}
    yield {'whole': {'x': {'y': 1.0}, 'z': {'y': None}}, 'list': [1.0, 2.0]}


def run(monkeypatch, main, *words, **options):
    monkeypatch.setattr('sys.argv', ['study', *map(str, words)])
    study.study(main, **options)


def test_parts_become_one_file_and_tables(monkeypatch, tmp_path, capsys):
    file = tmp_path / 'folder' / 'numbers.json'
    run(monkeypatch, numbers, '--runs', 2, '--cases', 'a', 'c', '--fast', '--out', file)
    assert study.known(file) == {
        'runs': 2,
        'fast': True,
        'table': {'a': {'error': 0.25, 'n': 2}, 'c': {'error': 0.25, 'n': 2}},
        'whole': {'x': {'y': 1.0}, 'z': {'y': None}},
        'list': [1.0, 2.0],
    }
    text = capsys.readouterr().out
    assert text.startswith('a: error 0.250, n 2\nc: error 0.250, n 2\n')
    # What came row by row is a table at the end, what came whole is not printed again.
    assert text.count('| error | n |') == 1 and '| c | 0.250 | 2 |' in text
    assert text.count('whole') == 1 and '| z | - |' in text


def test_the_file_holds_what_is_known_when_a_run_is_broken_off(monkeypatch, tmp_path):
    def broken() -> study.Parts:
        yield {'table': {'a': {'n': 1}}}
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(monkeypatch, broken, '--out', tmp_path / 'numbers.json')
    assert study.known(tmp_path / 'numbers.json') == {'table': {'a': {'n': 1}}}
    assert study.known(tmp_path / 'none') == study.known(None) == {}


def test_a_fresh_process_is_another_one_and_its_errors_arrive():
    assert study.in_fresh_process(os.getpid) != os.getpid()
    with pytest.raises(ZeroDivisionError):
        study.in_fresh_process(divmod, 1, 0)


@pytest.mark.skipif(not (ROOT / 'docs').is_dir(), reason='reads the source tree')
def test_every_study_of_the_docs_is_there():
    names = set()
    for path in (ROOT / 'docs' / 'results').glob('*.json'):
        made = json.loads(path.read_text(encoding='utf-8'))['made']
        assert made.keys() == {'command', 'date', 'commit'}, path
        words = made['command'].split()
        if words[:2] == ['python', '-m']:
            names.add(words[2])
    assert names
    for name in names:
        path = ROOT / name.replace('.', '/')
        path = path / '__main__.py' if path.is_dir() else path.with_suffix('.py')
        text = path.read_text(encoding='utf-8')
        assert 'study(' in text or 'write_json(' in text, f'{name} does not use the harness'


def test_a_file_says_how_it_was_made(tmp_path):
    study.write_json(tmp_path / 'numbers.json', {'n': 1})
    content = json.loads((tmp_path / 'numbers.json').read_text())
    assert list(content) == ['made', 'n']
    assert content['made']['command'].startswith('python ')
    assert content['made']['commit'] and content['made']['date'] <= date.today().isoformat()
