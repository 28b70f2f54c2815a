# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The harness of the studies: options from parameters, tables as they come, one file; studies in
their smallest size, whose numbers the pages find; what of reliability falls short is said; and
minutes of a day at sea, offline."""

from collections.abc import Sequence
from datetime import date
import functools
from importlib import import_module
import json
import math
import os
import runpy
import shlex

from helpers.source import ROOT
import numpy as np
import pytest

from benchmarks import reliability, soak, study


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


SMALL = {
    'bathymetry_paper': ({'pings': 1, 'parts': ['methods']}, {}, 'methods>defaults>patch'),
    'bathymetry_sea': ({'pings': 2, 'only': 'nadir'}, {}, 'cases>nadir, terrain>rmse_m'),
    'bathymetry_accuracy': (
        {'object_pings': 1, 'parts': ['resolved']},
        {'SIZES': {'ledge': (2.0, 3.0)}, 'BANDS': ((17.0, 77.0),)}
        | {'SETTINGS': {'8 staves': {}}, 'BARE': {'flat': ('thermal', {'patch_std': 0.0})}},
        'resolved>ledge, 8 staves>rmse_m',
    ),
    'fathometer_sea': (
        {'runs': 1, 'particles': 200, 'drawn': 2, 'parts': ['30 missing, walk 0.1 m']},
        {},
        'gaps>30 missing, walk 0.1 m, Kalman>inside',
    ),
    'obstacle_accuracy': ({'pictures': 5, 'parts': ['images']}, {}, 'images>found>steady>21 dB'),
}
"""Options, what is made smaller besides, and a number."""


@pytest.mark.parametrize('name', SMALL)
def test_a_small_study_has_its_numbers(name, monkeypatch):
    options, changes, place = SMALL[name]
    module = import_module(f'benchmarks.{name}')
    for key, value in changes.items():
        monkeypatch.setattr(module, key, value)
    found = {}
    for part in module.main(**options):
        study.merge(found, part)
    for key in place.split('>'):
        found = next(iter(found.values())) if key == '*' else found[key]
    assert math.isfinite(found)


GOOD = {
    'bounds': {
        'trace': {
            'size_mb': 1.6, 'cpu_s': 0.4, 'memory_mb': 154.0, 'cpu_s_per_mb': 0.23,
            'memory_per_byte': 96.0, 'refused': 0.0,
        },
    },
    'faults': [{
        'fault': 'a burst', 'system': 'diver', 'recovered': 2, 'limit': 3,
        'losses': {'count: too_late': 7}, 'traceback': False,
    }],
    'signals': [{'system': 'diver', 'signal': 'SIGINT', 'tried': 20, 'clean': 20, 'why': []}],
    'restart': [{'system': 'diver', 'tried': 9, 'again': 14, 'estimates': 70, 'equal': 70}],
    'damage': [{'what': 'full disk', 'tried': 3, 'said': 3, 'silent': 0, 'failed': 0}],
    'flood': [],
    'soak': {
        'diver': {
            'hours': 24.0, 'messages': 86400.0, 'memory_mb': 250.0, 'slope_mb_per_h': 0.01,
            'slope_low': 0.0, 'slope_high': 0.02, 'p99_first_ms': 1.0, 'p99_last_ms': 1.1,
            'uncounted': 0.0,
        },
    },
    'soak_live': {},
    'metamorphic': [
        {'system': 'diver', 'how': 'gnn', 'moved': 'later', 'tolerance': 1e-6, 'states': 1e-9},
    ],
    'hostile': {},
}  # fmt: skip


@pytest.mark.parametrize(
    'part, row, change',
    [
        ('bounds', 'trace', {'cpu_s': 31.0}), ('bounds', 'trace', {'refused': 1.0}),
        ('faults', 0, {'recovered': None}), ('faults', 0, {'recovered': 4}),
        ('faults', 0, {'traceback': True}), ('signals', 0, {'clean': 19}),
        ('restart', 0, {'equal': 69}), ('damage', 0, {'silent': 1}), ('damage', 0, {'failed': 1}),
        ('metamorphic', 0, {'states': 2e-6}), ('soak', 'diver', {'slope_low': 1.5}),
        ('soak', 'diver', {'p99_last_ms': 2.5}), ('soak', 'diver', {'uncounted': 1.0}),
    ],
)  # fmt: skip
def test_what_falls_short_is_said(part, row, change):
    spoilt = json.loads(json.dumps(GOOD))
    assert reliability.short_of(spoilt) == []
    spoilt[part][row] |= change
    assert len(reliability.short_of(spoilt)) == 1
    assert reliability.short_of({}) == [f'{name}: not measured' for name in reliability.PARTS]


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """The folder of a part whose program notes each row that it measures."""
    program = """
import json, pathlib, sys
file, notes = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
rows = json.loads(file.read_text()) if file.is_file() else []
known = [row['signal'] for row in rows]
for name in ('SIGINT', 'SIGHUP'):
    if name not in known:
        notes.open('a').write(name + ' ')
        rows.append({'system': 'diver', 'signal': name, 'tried': 2, 'clean': 2, 'why': []})
        file.write_text(json.dumps(rows))
sys.exit(3)
"""
    programs = {'signals': ('-c', program, '{}/signals.json', '{}/notes')}
    monkeypatch.setattr(reliability, 'RESULT', tmp_path / 'result.json')
    monkeypatch.setattr(reliability, 'PROGRAMS', programs)
    monkeypatch.setattr(reliability, 'PARTS', ('signals',))
    return tmp_path / 'parts'


def test_parts_are_run_and_what_was_broken_off_goes_on(toy, monkeypatch, capsys):
    def run(*words):
        monkeypatch.setattr('sys.argv', ['reliability', str(toy), *words])
        with pytest.raises(SystemExit) as ended:
            reliability.main()
        return ended.value.code

    toy.mkdir()
    rows = [{'system': 'diver', 'signal': 'SIGINT', 'tried': 2, 'clean': 2, 'why': []}]
    (toy / 'signals.json').write_text(json.dumps(rows))
    assert run('--run') == 0
    assert (toy / 'notes').read_text() == 'SIGHUP '  # the other one was there
    written = json.loads(reliability.RESULT.read_text())
    assert [row['clean'] for row in written['signals']] == [2, 2]
    assert 'signals: ended with exit code 3' in capsys.readouterr().out
    rows = json.loads((toy / 'signals.json').read_text())
    rows[0]['clean'] = 1
    (toy / 'signals.json').write_text(json.dumps(rows))
    assert run() == 1 and run('--run', 'signals') == 0
    assert (toy / 'notes').read_text() == 'SIGHUP SIGINT '  # what fell short is tried again


LIMITS = {
    'diver': (0.3, 1.0), 'obstacle': (0.3, 1.5), 'bathymetry': (0.06, 3.0),
    'fathometer': (0.3, 10.0),  # its particles come and go by megabytes
}  # fmt: skip
"""Hours, and MB by which the second half may grow."""


@pytest.mark.statistics
@pytest.mark.parametrize('system', LIMITS)
def test_a_tracker_grows_and_slows_no_more_once_it_is_warm(system):
    hours, limit = LIMITS[system]
    result = soak.offline(system, hours)
    assert result['messages'] > 50 and result['uncounted'] == 0
    assert result['grown_mb'] < limit
    assert result['p50_last_ms'] < 3.0 * result['p50_first_ms'] + 1.0


def test_growth_and_slowing_down_show():
    hours = np.linspace(0.0, 2.0, 200)
    memory = list(zip(hours, 100.0 + 3.0 * hours))
    times = np.linspace(1e-3, 5e-3, 1000)
    result = soak.summary(memory, times, sent=1000, counted=998)
    assert result['slope_mb_per_h'] == pytest.approx(3.0)
    assert result['slope_low'] == pytest.approx(3.0) and 2.0 < result['grown_mb'] < 3.1
    assert result['uncounted'] == 2 and result['p99_last_ms'] > 3.0 * result['p99_first_ms']


def test_stamps_go_on_from_one_turn_to_the_next():
    stamps = [stamp for topic, _, stamp in soak.stamps_of('diver', 0.06)]
    assert len(stamps) > 202 and set(np.diff(stamps)) == {10**9}
