# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parts of the reliability run: what falls short is said, what was broken off goes on."""

import json

import pytest

from benchmarks import reliability

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


def test_what_is_good_falls_short_of_nothing():
    assert reliability.short_of(GOOD) == []


@pytest.mark.parametrize(
    'part, row, change',
    [
        ('bounds', 'trace', {'cpu_s': 31.0}),
        ('bounds', 'trace', {'refused': 1.0}),
        ('faults', 0, {'recovered': None}),
        ('faults', 0, {'recovered': 4}),
        ('faults', 0, {'traceback': True}),
        ('signals', 0, {'clean': 19}),
        ('restart', 0, {'equal': 69}),
        ('damage', 0, {'silent': 1}),
        ('damage', 0, {'failed': 1}),
        ('metamorphic', 0, {'states': 2e-6}),
        ('soak', 'diver', {'slope_low': 1.5}),
        ('soak', 'diver', {'p99_last_ms': 2.5}),
        ('soak', 'diver', {'uncounted': 1.0}),
    ],
)
def test_what_falls_short_is_said(part, row, change):
    spoilt = json.loads(json.dumps(GOOD))
    spoilt[part][row] |= change
    assert len(reliability.short_of(spoilt)) == 1


def test_a_part_that_is_missing_is_said():
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
    monkeypatch.setattr(reliability, 'RESULT', tmp_path / 'result.json')
    monkeypatch.setattr(
        reliability, 'PROGRAMS', {'signals': ('-c', program, '{}/signals.json', '{}/notes')}
    )
    monkeypatch.setattr(reliability, 'PARTS', ('signals',))
    return tmp_path / 'parts'


def run(monkeypatch, *words):
    monkeypatch.setattr('sys.argv', ['reliability', *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        reliability.main()
    return ended.value.code


def test_parts_are_run_and_what_was_broken_off_goes_on(toy, monkeypatch, capsys):
    toy.mkdir()
    rows = [{'system': 'diver', 'signal': 'SIGINT', 'tried': 2, 'clean': 2, 'why': []}]
    (toy / 'signals.json').write_text(json.dumps(rows))
    assert run(monkeypatch, toy, '--run') == 0
    assert (toy / 'notes').read_text() == 'SIGHUP '  # the other one was there
    written = json.loads(reliability.RESULT.read_text())
    assert [row['clean'] for row in written['signals']] == [2, 2]
    assert 'signals: ended with exit code 3' in capsys.readouterr().out
    rows = json.loads((toy / 'signals.json').read_text())
    rows[0]['clean'] = 1
    (toy / 'signals.json').write_text(json.dumps(rows))
    assert run(monkeypatch, toy) == 1
    assert run(monkeypatch, toy, '--run', 'signals') == 0
    assert (toy / 'notes').read_text() == 'SIGHUP SIGINT '  # what fell short is tried again
