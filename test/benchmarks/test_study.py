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
import functools
import json
import os
import runpy
import shlex

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
        'runs': 2, 'fast': True, 'table': dict.fromkeys('ac', {'error': 0.25, 'n': 2}),
        'whole': {'x': {'y': 1.0}, 'z': {'y': None}}, 'list': [1.0, 2.0],
    }  # fmt: skip
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


def test_a_run_is_put_beside_what_is_in_the_file(monkeypatch, tmp_path):
    file = tmp_path / 'numbers.json'
    run(monkeypatch, numbers, '--cases', 'a', '--out', file)
    before = json.loads(file.read_text())['made']
    for _ in range(2):
        run(monkeypatch, numbers, '--cases', 'b', '--runs', 2, '--add', '--out', file)
    due = {'a': {'error': 0.375, 'n': 3}, 'b': {'error': 0.25, 'n': 2}}
    assert study.known(file)['table'] == due
    content = json.loads(file.read_text())
    made = content['made']
    assert [*content][0] == 'made' and made['commit']
    assert made['date'] <= date.today().isoformat()
    assert made['date'] == before['date'] and made['command'].startswith(before['command'] + '; ')
    assert made['command'].count(' at commit ') == 1


def test_a_fresh_process_is_another_one_and_its_errors_arrive():
    assert study.in_fresh_process(os.getpid) != os.getpid()
    with pytest.raises(ZeroDivisionError):
        study.in_fresh_process(divmod, 1, 0)


def commands():
    """Every command that a file of results names, but for where it writes."""
    for path in (ROOT / 'docs' / 'results').glob('*.json'):
        made = json.loads(path.read_text(encoding='utf-8'))['made']
        assert made.keys() == {'command', 'date', 'commit'}, path
        for command in made['command'].split('; '):
            if command.startswith('python -m '):
                yield command.removeprefix('python -m ').partition(' --out ')[0]


@pytest.mark.filterwarnings('ignore:.*found in sys.modules')
@pytest.mark.parametrize('command', [*commands()])
def test_the_command_of_every_result_works(command, monkeypatch):
    """Its study is there, and has the options and choices; nothing is run."""
    name, *words = shlex.split(command)
    if name == 'benchmarks.node_latency':
        pytest.importorskip('rclpy')
    taken = []

    def of_nothing(main, **options):
        @functools.wraps(main)
        def nothing(**given):
            taken.append(given)
            return iter(())

        whole(nothing, **options)

    whole = study.study
    monkeypatch.setattr(study, 'study', of_nothing)
    monkeypatch.setattr('sys.argv', [name, *words])
    runpy.run_module(name, run_name='__main__')
    assert len(taken) == 1
